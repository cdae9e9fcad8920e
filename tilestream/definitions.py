"""What every factor, column, setting and term means: `definitions.md` and the code's own records.

Columns are told by their `Column` records, settings by the docstrings of their fields, terms and
formulas by `definitions.md`. Nothing is written down twice.
"""

import difflib
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal, get_args

from pydantic import TypeAdapter
from pydantic.fields import FieldInfo

from tilestream.config import Settings
from tilestream.errors import UsageError
from tilestream.factors import catalogue, observability
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.dataset import TARGETS
from tilestream.model.features import features_of
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.moments import NEAR_COLUMNS
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.evaluate import HELD_OUT_COLUMNS
from tilestream.pipeline.stages.importance import WEIGHT_COLUMNS
from tilestream.pipeline.stages.label import ERROR_COLUMNS
from tilestream.pipeline.stages.register import START_COLUMNS
from tilestream.pipeline.stages.samples import COLUMNS as ALL_FACTORS
from tilestream.pipeline.stages.samples import DATASET_COLUMNS, LOST_COLUMNS
from tilestream.records import Column
from tilestream.report.diff.gate import DiffGateSettings
from tilestream.report.gate import GateSettings
from tilestream.simulation.settings import SimulationSettings

TABLES: dict[str, tuple[Column, ...]] = {
    "factors": (*PLACE_COLUMNS, *catalogue.COLUMNS, *STATUS_COLUMNS),
    "observability": (*PLACE_COLUMNS, *observability.COLUMNS, *STATUS_COLUMNS),
    "starts": START_COLUMNS,
    "errors": ERROR_COLUMNS,
    "samples": (
        *DATASET_COLUMNS,
        *(column for column in PLACE_COLUMNS if column.name != "route_id"),
        *(
            column
            for column in ERROR_COLUMNS
            if column.name in (*TARGETS, "true_pose", "as_sensor") or column in NEAR_COLUMNS
        ),
        *features_of(ALL_FACTORS),
    ),
    "lost": LOST_COLUMNS,
    "judged": HELD_OUT_COLUMNS,
    "weights": WEIGHT_COLUMNS,
    "predictions": (*PLACE_COLUMNS, *PREDICTION_COLUMNS, *COVARIANCE_COLUMNS),
}
"""The columns of each kind of table in a run directory."""
GIVEN: dict[str, type[Settings]] = {
    "the job file": RunSettings,
    "the simulation file": SimulationSettings,
    "options of estimate and run": GateSettings,
    "options of diff": DiffGateSettings,
}
"""The settings, by where they are given."""

Kind = Literal["column", "setting", "term", "section"]

TABLE_ROWS, SETTING_ROWS = "7", "8"
"""Sections with a row per table, and per group of settings: what there is to say of those that no
other section names."""

_HEADING = re.compile(r"^##+ (?P<number>\d+(\.\d+)?)\.? (?P<title>.+)$")
_TERM = re.compile(r"\*\*(.+?)\*\*")
_CODE = re.compile(r"`([^`]+)`")
_UNIT = re.compile(r"\[([^\]]+)\]")


@dataclass(frozen=True)
class Passage:
    """A paragraph, a bullet or a row of a table of `definitions.md`."""

    section: str
    """Number of its section, e.g. `4.5`."""
    heads: tuple[str, ...]
    """Names and terms that it defines: its bold words, or the first cell of its row."""
    text: str
    """Its Markdown; of a row the cells with the table's headings."""


@dataclass(frozen=True)
class Section:
    """A section of `definitions.md`, without those below it."""

    number: str
    """Its number, e.g. `4` or `4.5`."""
    title: str
    """Its heading."""
    text: str
    """Its Markdown, without the heading."""
    passages: tuple[Passage, ...]
    """Its parts, in order."""


@dataclass(frozen=True)
class Entry:
    """One meaning of a name. What does not apply to its kind is empty."""

    name: str
    """The column, the setting's key with dots between levels, the term, or the section's title."""
    kind: Kind
    """What it is."""
    where: str
    """Tables that have the column; file and class of the setting; section of the term."""
    meaning: str
    """What it says, in a sentence or two."""
    criterion: str = ""
    """Criterion and set of a factor."""
    unit: str = ""
    """Unit of its values; `1`: a plain number."""
    default: str = ""
    """Default of a setting, as YAML has it; `required`: there is none."""
    source: str = ""
    """Formula of a column, and where it comes from."""
    text: str = ""
    """What `definitions.md` says of it."""

    def __str__(self) -> str:
        facts = ("meaning", "criterion", "unit", "default", "source")
        lines = [f"{self.name}: {self.kind} of {self.where}"]
        return "\n".join(lines + [f"  {f:<10} {said}" for f in facts if (said := getattr(self, f))])


@dataclass(frozen=True)
class Explanation:
    """All that a name means; printing it tells it."""

    name: str
    """As it was asked for."""
    entries: tuple[Entry, ...]
    """Its meanings, at least one: a name can be a column of two tables and a setting."""

    def __str__(self) -> str:
        texts = dict.fromkeys(entry.text for entry in self.entries)
        return "\n\n".join([*(str(entry) for entry in self.entries), *texts])


def explain(name: str) -> Explanation:
    """What a factor, a column, a setting, a term or a section of the definitions means.

    Args:
        name: of a column (`vd_tail`), a setting (`range_max`, or with its level
            `observe.range_max`), a term (`cell`, `virtual drive`), or the number of a section of
            `definitions.md` (`4` or `4.5`). Upper and lower case are the same.

    Raises:
        UsageError: nothing has this name; the message tells the nearest ones.

    Examples:
        >>> "Place of the lidar" in str(ts.explain("x"))
        True
    """
    wanted = " ".join(name.split()).lower()
    found = [entry for entry in entries() if wanted in _names(entry)]
    section = sections().get(wanted.removeprefix("section").strip())
    if section is not None:
        found.append(_section_entry(section))
    if found:
        return Explanation(name, tuple(found))
    known = sorted({said for entry in entries() for said in _names(entry)})
    near = difflib.get_close_matches(wanted, known, n=5)
    hint = f"did you mean {', '.join(near)}?" if near else f"sections are {', '.join(sections())};"
    raise UsageError(f"nothing is called {name!r}: {hint} `tilestream explain` lists all names")


@cache
def entries() -> tuple[Entry, ...]:
    """Every column, setting and term, in the order of the tables, the files and the sections."""
    return (*_column_entries(), *_setting_entries(), *_term_entries())


@cache
def sections() -> dict[str, Section]:
    """The sections of `definitions.md` by number, in order; `4` does not hold `4.1`."""
    text = (resources.files("tilestream") / "definitions.md").read_text("utf-8")
    found: dict[str, Section] = {}
    number, title, body = "", "", list[str]()
    for line in [*text.splitlines(), "## 0 end"]:
        heading = _HEADING.match(line)
        if heading is None:
            body.append(line)
            continue
        if number:
            told = "\n".join(body).strip()
            found[number] = Section(number, title, told, tuple(_passages(number, told)))
        number, title, body = heading["number"], heading["title"], []
    return found


def _passages(number: str, text: str) -> Iterator[Passage]:
    for block in re.split(r"\n\n|\n(?=\* )", text):
        if not block.startswith("|"):
            yield Passage(number, tuple(_TERM.findall(block)), block)
            continue
        head, _, *rows = (
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in block.replace("\\|", "\0").splitlines()
        )
        for row in rows:
            cells = [cell.replace("\0", "|") for cell in row]
            names = tuple(_CODE.findall(cells[0])) or (cells[0],)
            pairs = zip(head[1:], cells[1:], strict=True)
            yield Passage(number, names, f"{cells[0]}. " + " ".join(_told(*pair) for pair in pairs))


def _told(heading: str, cell: str) -> str:
    """A cell of a row in a sentence; long ones need no heading."""
    return cell if heading in ("definition", "decides", "a row is") else f"{heading} {cell};"


def _all_passages() -> Iterator[Passage]:
    for section in sections().values():
        yield from section.passages


def _text_on(names: Set[str], otherwise: str, groups: Sequence[str]) -> str:
    """What the definitions say of a column or setting: where they define it, else where they name
    it, else the rows of its groups in the section `otherwise`.
    """
    passages = [p for p in _all_passages() if p.section not in (TABLE_ROWS, SETTING_ROWS)]
    defined = [p for p in passages if names & set(p.heads)]
    named = [p for p in passages if names & set(_CODE.findall(p.text))]
    rows = [p for p in sections()[otherwise].passages if set(groups) & set(p.heads)]
    return "\n".join(_cited(passage) for passage in defined or named or rows)


def _cited(passage: Passage) -> str:
    title = sections()[passage.section].title
    return f"definitions, section {passage.section} ({title}):\n{passage.text}"


def _names(entry: Entry) -> set[str]:
    """What an entry is found by, in lower case: a setting also without its levels."""
    name = entry.name.lower()
    return {name, name.rsplit(".", 1)[-1]} if entry.kind == "setting" else {name}


def _column_entries() -> Iterator[Entry]:
    tables: dict[Column, list[str]] = {}
    for table, columns in TABLES.items():
        for column in columns:
            tables.setdefault(column, []).append(table)
    for column, where in tables.items():
        factor = column.criterion not in ("place", "label")
        yield Entry(
            column.name,
            "column",
            ", ".join(where),
            column.meaning,
            f"{column.criterion}, set {column.factor_set}" if factor else "",
            column.unit or column.dtype,
            source=column.source,
            text=_text_on({column.name}, TABLE_ROWS, where),
        )


def _setting_entries() -> Iterator[Entry]:
    fields = [(where, *field) for where, model in GIVEN.items() for field in _fields(model, ())]
    owners = Counter(name for _, name in {(owner, levels[-1]) for _, levels, owner, _ in fields})
    columns = {column.name for table in TABLES.values() for column in table}
    for where, levels, owner, field in fields:
        meaning = " ".join((field.description or "").split())
        unit = _UNIT.search(meaning)
        # A name that is also another's names this setting only with its levels.
        shared = owners[levels[-1]] > 1 or levels[-1] in columns
        names = {".".join(levels[k:]) for k in range(len(levels) - shared)}
        yield Entry(
            ".".join(levels),
            "setting",
            f"{where}, {owner.__name__} in Python",
            meaning,
            unit=unit[1] if unit else "",
            default=_default(field),
            text=_text_on(names, SETTING_ROWS, levels[:1]),
        )


def _fields(
    model: type[Settings], above: tuple[str, ...], told: Set[type[Settings]] = frozenset()
) -> Iterator[tuple[tuple[str, ...], type[Settings], FieldInfo]]:
    """The fields of settings and of those inside them: levels of the key, class, field. What a
    field may hold as it is and in a list is told once.
    """
    for name, field in model.model_fields.items():
        yield (*above, name), model, field
        inside = list(_settings_in(field.annotation))
        for inner in inside:
            if inner not in told:
                yield from _fields(inner, (*above, name), frozenset(inside))


def _settings_in(annotation: Any) -> Iterator[type[Settings]]:
    """The settings classes that a field may hold."""
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        yield annotation
    for part in get_args(annotation):
        yield from _settings_in(part)


def _default(field: FieldInfo) -> str:
    """A default as YAML has it; those of settings in settings are told one by one."""
    if field.is_required():
        return "required"
    if isinstance(field.default, Settings):
        return ""
    return json.dumps(TypeAdapter(Any).dump_python(field.default, mode="json"))


def _term_entries() -> Iterator[Entry]:
    elsewhere = {
        entry.name.rsplit(".", 1)[-1] for entry in (*_column_entries(), *_setting_entries())
    }
    told: dict[str, list[Passage]] = {}
    for passage in _all_passages():
        for head in passage.heads:
            if head not in elsewhere or passage.section == TABLE_ROWS:
                told.setdefault(head, []).append(passage)
    for term, passages in told.items():
        numbers = ", ".join(dict.fromkeys(passage.section for passage in passages))
        text = "\n".join(_cited(passage) for passage in passages)
        yield Entry(term, "term", f"definitions, section {numbers}", "", text=text)


def _section_entry(section: Section) -> Entry:
    below = [s for s in sections().values() if s.number.startswith(f"{section.number}.")]
    text = "\n\n".join([section.text, *(f"### {s.number} {s.title}\n\n{s.text}" for s in below)])
    return Entry(section.title, "section", f"definitions, section {section.number}", "", text=text)
