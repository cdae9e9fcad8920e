"""What can be described, and how it is known by its name and by what lies in it.

A file of this folder describes each kind, imported when something is of that kind: what reads a
model takes seconds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from tilestream.apps.info.record import Info
from tilestream.apps.info.scenes import is_scene
from tilestream.files import Files
from tilestream.formats import FORMATS
from tilestream.formats.logs import is_log
from tilestream.formats.registry import format_of_directory, format_of_ending
from tilestream.formats.routes import READERS
from tilestream.pipeline.jobs.run_names import INVENTORY, RECORD, TABLES
from tilestream.settings import LogOptions
from tilestream.store import NODE

MODEL = ".skops"
"""How a model's file ends."""
COMPARISON = "compare.json"
"""The figures of a comparison, in its folder."""


@dataclass(frozen=True)
class Kind:
    """Something that can be described."""

    name: str
    """What it is, in words."""
    fits: Callable[[str, frozenset[str]], bool]
    """Whether a path is one, by its name and the names of what lies in it."""
    file: str
    """The file here that describes it, by its function `described`."""

    def describe(self, path: str, log_options: LogOptions) -> Info:
        """What is in it, logs read as these options say."""
        found: Info = import_module(f"tilestream.apps.info.{self.file}").described(
            path, log_options
        )
        return found


def _is_run(path: str, names: frozenset[str]) -> bool:
    """Whether a job has written there: its record, or a folder of tables with an inventory."""
    return RECORD in names or any(
        Files.at(path).under(f"{table}/{INVENTORY}").there() for table in TABLES if table in names
    )


def _is_points(path: str, _: frozenset[str]) -> bool:
    known = format_of_ending(path, FORMATS) or format_of_directory(path, FORMATS)
    return known is not None and not is_log(path)


def _ends_in(*endings: str) -> Callable[[str, frozenset[str]], bool]:
    """Whether a path is a file of these endings."""
    return lambda path, _: Path(path).is_file() and Path(path).suffix.lower() in endings


KINDS = (
    Kind("tile stores", lambda _, names: NODE in names, "stores"),
    Kind("run directories", _is_run, "runs"),
    Kind(f"models ({MODEL})", _ends_in(MODEL), "models"),
    Kind(
        f"folders of `compare` (with {COMPARISON})",
        lambda _, names: COMPARISON in names,
        "comparisons",
    ),
    Kind("pictures for Foxglove", lambda path, _: is_scene(path), "scenes"),
    Kind("logs of drives", lambda path, _: is_log(path), "logs"),
    Kind("files and folders of points", _is_points, "points"),
    Kind("files of routes", _ends_in(*READERS), "routes"),
)
"""The first that fits is it."""
