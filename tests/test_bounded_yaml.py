"""YAML of any size and shape: what it holds, or an error that names the file, and soon."""

from pathlib import Path

import pytest

from tilestream.bounded_yaml import MAX_VALUES, parse_yaml, read_yaml
from tilestream.errors import CorruptSourceError, SourceNotFoundError, UsageError
from tilestream.pipeline.jobs.run_settings import read_settings

ALIASES = "a0: &a0 [x, x]\n" + "\n".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)
)


def test_plain_values_anchors_and_merged_mappings_are_read() -> None:
    text = "base: &b {x: 1, y: 2.5}\nmore: {<<: *b, x: -7}\nlist: [*b, 0x1F, 9223372036854775807]"
    assert parse_yaml(text) == {
        "base": {"x": 1, "y": 2.5},
        "more": {"x": -7, "y": 2.5},
        "list": [{"x": 1, "y": 2.5}, 31, 2**63 - 1],
    }


@pytest.mark.parametrize(
    "text",
    [
        ALIASES,
        f"{ALIASES}\nout: *a11\nmemory: *a11",
        "out: &a [*a]",
        "out: *nothing",
        "out: " + "[" * 40 + "]" * 40,
        "- " * 100_000,
        "out: [" + "1," * MAX_VALUES + "]",
        "out: " + "9" * 5000,
        "out: 0x" + "f" * 5000,
        "out: 2001-99-99",
        "out: !!timestamp x",
        "out: !!bool maybe",
        "out: run\nout: run",
        "out: '",
        "\x00",
    ],
    ids=lambda text: text[:30],
)
def test_what_cannot_be_is_an_error_that_names_the_file(text: str, tmp_path: Path) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(text)
    with pytest.raises(CorruptSourceError, match=r"some\.yaml"):
        read_yaml(path, CorruptSourceError)
    with pytest.raises(UsageError, match=r"some\.yaml"):
        read_settings(path)


def test_a_key_that_is_there_twice_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("out: run\nmap:\n  tile_size: 50\n  tile_size: 100\n")
    with pytest.raises(UsageError, match=r"line 4: 'tile_size' is there twice"):
        read_settings(path)


def test_a_large_value_is_not_printed_whole(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("a: &a [x, x, x, x]\nb: &b [*a, *a, *a, *a]\nout: [*b, *b, *b, *b]\n")
    with pytest.raises(UsageError) as caught:
        read_settings(path)
    assert len(str(caught.value)) < 1000


def test_text_that_is_none_and_a_file_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"a\.yaml"):
        read_yaml(tmp_path / "a.yaml", UsageError)
    with pytest.raises(SourceNotFoundError, match=r"b\.yaml"):
        read_yaml(tmp_path / "b.yaml", UsageError)


def test_a_value_of_the_command_line_is_bounded_too(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("out: run\n")
    for value in ("9" * 5000, "2001-99-99", "[", "&a [*a]"):
        with pytest.raises(UsageError, match="spacing"):
            read_settings(path, [f"spacing={value}"])


def test_a_job_with_a_key_twice_is_refused(cases: Path) -> None:
    job = cases / "job" / "duplicate_key.yaml"
    with pytest.raises(UsageError, match=r"line 5: 'routes' is there twice"):
        read_settings(job)
