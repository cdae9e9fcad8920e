"""Options that several commands have, and what their words mean."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import yaml

from tilestream.errors import UsageError
from tilestream.formats.routes import read_routes
from tilestream.records import Route
from tilestream.sensor import SENSORS, Sensor
from tilestream.settings import RegistrationSettings

Matcher = Annotated[
    Literal["default", "autoware"], typer.Option(help="Ours, or the production matcher.")
]
PointsTopic = Annotated[
    str | None, typer.Option(help="Topic of the scans in a log; default: found by type.")
]
PoseTopic = Annotated[
    str | None, typer.Option(help="Topic of the poses in a log; default: found by type.")
]
Every = Annotated[int, typer.Option(min=1, help="Use every n-th scan of a log …")]
Offset = Annotated[
    int, typer.Option(min=0, help="… from this one on: another offset uses other scans.")
]
FromS = Annotated[
    float, typer.Option(help="Use the scans of a log from this time on [s after its first].")
]
UntilS = Annotated[
    float | None, typer.Option(help="Use the scans of a log before this time [s after its first].")
]
Memory = Annotated[str, typer.Option(help="What one task may use, e.g. 512MB or 2GB.")]
StoreUrl = Annotated[str, typer.Argument(help="The tile store.")]
Routes = Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or MCAP.")]
ProjectTo = Annotated[str | None, typer.Option(help="CRS for routes in degrees.")]
Spacing = Annotated[float, typer.Option(help="Distance between sample points [m].")]
SensorHeight = Annotated[float, typer.Option(help="Of the lidar above the road [m].")]
CellSize = Annotated[float, typer.Option(help="Edge of an NDT cell [m].")]
Config = Annotated[str, typer.Argument(help="A YAML file, begun with `tilestream template`.")]
Changes = Annotated[
    list[str], typer.Option("--set", help="key=value over the file, e.g. model.seed=1.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]


def parse_bytes(text: str) -> int:
    """`512MB` or `2GB` as bytes (powers of ten).

    Raises:
        UsageError: it is not of that form.
    """
    for unit, factor in (("KB", 10**3), ("MB", 10**6), ("GB", 10**9), ("TB", 10**12)):
        number = text.strip().upper().removesuffix(unit)
        if number != text.strip().upper():
            try:
                amount = int(float(number) * factor)
            except (ValueError, OverflowError):
                break
            if amount > 0:
                return amount
    raise UsageError(f"{text!r} is no amount of memory: give a form like 512MB or 2GB")


def numbers(lists: list[str], option: str) -> list[float]:
    """The numbers of an option that takes several, also with commas between them.

    Raises:
        UsageError: one is no number.
    """
    parts = [part.strip() for text in lists for part in text.split(",")]
    try:
        return [float(part) for part in parts]
    except ValueError:
        told = ", ".join(lists)
        raise UsageError(f"{option} {told}: give numbers, with commas between them") from None


def matcher_of(name: str, **changes: Any) -> RegistrationSettings:
    """The settings of a matcher by its name."""
    preset = RegistrationSettings.autoware if name == "autoware" else RegistrationSettings
    return preset(**changes)


def routes_of(files: list[str], project_to: str | None) -> list[Route]:
    """The routes of all files."""
    return [route for path in files for route in read_routes(path, project_to=project_to)]


def sensor_of(name: str) -> Sensor:
    """A sensor by its name, or from a YAML file with the fields of `tilestream.Sensor`.

    Raises:
        UsageError: no such file or sensor, no mapping of fields, a field that cannot be.
    """
    if name in SENSORS:
        return SENSORS[name]
    if not Path(name).is_file():
        raise UsageError(f"{name}: no such sensor or file; known are {', '.join(SENSORS)}")
    try:
        fields = yaml.safe_load(Path(name).read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{name}: no YAML: {error}") from None
    if not isinstance(fields, dict):
        raise UsageError(f"{name}: give the fields of a sensor, e.g. range_max: 100.0")
    return Sensor(**fields)
