"""What every number means is shipped, cited right, and told for every name."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import tilestream as ts
from tilestream import definitions
from tilestream.cli import run
from tilestream.config import Settings
from tilestream.errors import UsageError

ROOT = Path(definitions.__file__).parent
CITATION = re.compile(r"definitions, section (\d+(?:\.\d+)?)")
COLUMNS = sorted({column for table in definitions.TABLES.values() for column in table}, key=repr)


def cited(text: str) -> list[str]:
    """The sections that a text cites; a citation in another spelling is an empty one."""
    plain = " ".join(re.sub(r"[\"#]", " ", text).split())
    return [
        found.group(1) if (found := CITATION.match(plain, at.start())) else ""
        for at in re.finditer(r"definitions, (?:\d|sections?\b(?! \{)|no\b|factors? \d)", plain)
    ]


def settings_classes(base: type[Settings] = Settings) -> Iterator[type[Settings]]:
    for inner in base.__subclasses__():
        if inner.__module__.startswith("tilestream."):
            yield inner
        yield from settings_classes(inner)


def settings_written() -> set[str]:
    """Names of the settings classes, read from the code itself."""
    text = "\n".join(path.read_text("utf-8") for path in ROOT.rglob("*.py"))
    return set(
        re.findall(
            r"^class (\w+)\((?:\w*(?:Settings|LogOptions)(?:, )?)+\):", text, flags=re.MULTILINE
        )
    )


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_every_cited_section_is_there(path: Path) -> None:
    assert set(cited(path.read_text("utf-8"))) <= set(definitions.sections())


def test_another_spelling_of_a_citation_is_seen() -> None:
    assert cited("as definitions, section 4.5, has it") == ["4.5"]
    for text in (
        "definitions, 5",
        "definitions, sections 3 and 4",
        "definitions, no. 17",
        "definitions, factor 8",
    ):
        assert cited(text) == [""], text
    assert len([c for p in ROOT.rglob("*.py") for c in cited(p.read_text("utf-8"))]) > 40


def test_sections_and_what_they_refer_to_exist() -> None:
    numbers = list(definitions.sections())
    assert [n for n in numbers if "." not in n] == [str(k) for k in range(1, 10)]
    text = (ROOT / "definitions.md").read_text("utf-8")
    referred = re.findall(r"sections? (\d(?:\.\d)?)(?: and (\d(?:\.\d)?))?", text)
    assert {n for pair in referred for n in pair if n} <= set(numbers)
    assert {n for column in COLUMNS for n in cited(column.source)} <= set(numbers)


@pytest.mark.parametrize("column", COLUMNS, ids=lambda c: c.name)
def test_every_column_is_explained_by_its_own_record(column: ts.records.Column) -> None:
    (entry,) = (
        entry
        for entry in ts.explain(column.name).entries
        if (entry.meaning, entry.source, entry.unit)
        == (column.meaning, column.source, column.unit or column.dtype)
    )
    assert entry.kind == "column"
    assert entry.text
    if column.criterion not in ("place", "label"):
        assert f"`{column.name}`" in entry.text, "no section defines it"
        assert column.criterion in entry.text
        assert column.factor_set in entry.criterion


def test_every_name_of_a_factor_in_the_definitions_is_one_of_the_code() -> None:
    tables = [p for n in ("3", "4.1", "4.4", "4.5") for p in definitions.sections()[n].passages]
    told = [head for p in tables for head in p.heads if "criterion" in p.text]
    factors = [c.name for c in COLUMNS if c.criterion not in ("place", "label")]
    assert sorted(told) == sorted(factors)


def test_every_setting_is_explained_with_its_default() -> None:
    known = list(settings_classes())
    assert {model.__name__ for model in known} == settings_written()
    for model in known:
        for name, field in model.model_fields.items():
            told = " ".join((field.description or "").split())
            assert told, f"{model.__name__}.{name} has no docstring"
            found = [e for e in ts.explain(name).entries if e.meaning == told]
            assert found, f"{model.__name__}.{name}"
            assert all(e.text for e in found), f"{model.__name__}.{name}"


def test_a_setting_has_its_unit_and_default() -> None:
    (entry,) = ts.explain("observe.range_min").entries
    assert (entry.kind, entry.unit, entry.default) == ("setting", "m", "0.9")
    assert "Virtual scan" in entry.text
    assert ts.explain("drives.log").entries[0].default == "required"
    assert json.loads(ts.explain("label.starts.yaw").entries[0].default) == [0.0]


@pytest.mark.parametrize("name", ["cell", "Label", "virtual  drive", "neighbours", "errors", "4.5"])
def test_terms_tables_and_sections_are_explained(name: str) -> None:
    found = ts.explain(name)
    assert any(entry.kind in ("term", "section") and entry.text for entry in found.entries)
    assert found.entries[0].text in str(found)


def test_a_shared_text_is_printed_once() -> None:
    said = str(ts.explain("x"))
    assert said.count("* **Sample point**") == 1
    assert said.count("x: column of") == 2


def test_an_unknown_name_is_told_the_nearest_ones(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(UsageError, match="did you mean vd_tail"):
        ts.explain("vd_tial")
    assert run(["explain", "vd_tial"]) == 2
    assert "vd_tail" in capsys.readouterr().err
    with pytest.raises(UsageError, match=r"sections are 1, 1\.1"):
        ts.explain("42")


def test_the_command_tells_one_or_all(capsys: pytest.CaptureFixture) -> None:
    assert run(["explain", "virtual", "drive"]) == 0
    assert "golden-angle" in capsys.readouterr().out
    assert run(["explain", "score_H", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["entries"]
    assert (entry["kind"], entry["unit"]) == ("column", "bit")
    assert run(["explain"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"columns of factors", "settings of the job file"} <= set(lines)
    listed = {re.split(r"[ :]", line.strip())[0] for line in lines}
    assert {c.name for c in COLUMNS} <= listed
    assert run(["explain", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) == len(definitions.entries())
