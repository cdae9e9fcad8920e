"""Paths and patterns: what is there is meant by its name."""

from pathlib import Path

import pytest

from tilestream.counts import count_of
from tilestream.patterns import paths_of


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("map[1]/a.pcd", "map[1]/b[x].pcd", "map1/c.pcd", "map1/deep/d.pcd", "*.pcd"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("pattern", "named"),
    [
        ("map[1]/a.pcd", ["map[1]/a.pcd"]),
        ("map[1]/b[x].pcd", ["map[1]/b[x].pcd"]),
        ("map[1]/*.pcd", ["map[1]/a.pcd", "map[1]/b[x].pcd"]),
        ("map[12]/*.pcd", ["map1/c.pcd"]),
        ("map?/**/*.pcd", ["map1/c.pcd", "map1/deep/d.pcd"]),
        ("map1/deep/../*.pcd", ["map1/deep/../c.pcd"]),
        ("*.pcd", ["*.pcd"]),
        ("gone.pcd", []),
        ("gone[1]/*.pcd", []),
    ],
)
def test_what_is_there_is_taken_by_its_name(pattern: str, named: list[str], here: Path) -> None:
    assert paths_of(pattern) == named
    assert paths_of(str(here / pattern)) == [str(here / name) for name in named]


def test_one_of_a_thing_is_told_as_one() -> None:
    told = [count_of(number, "sample point") for number in (0, 1, 2, 2000)]
    assert told == ["0 sample points", "1 sample point", "2 sample points", "2,000 sample points"]
