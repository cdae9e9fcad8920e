"""What a map update changes."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hand_made import listed
from hypothesis import given
from hypothesis import strategies as st
from map_diffs import words
from scenes import scene

import tilestream as ts
from tilestream.apps.changes import BETWEEN, NOTHING, changes
from tilestream.apps.diff import diff
from tilestream.cli import run
from tilestream.errors import DamagedError, StoreNotFoundError, UsageError
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.factors.stations import INTERPOLATED
from tilestream.formats.points.pcd import write_pcd
from tilestream.marks import Mark
from tilestream.model.phrases import NO_POLES, SLIDES_ALONG
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.report import write_diff
from tilestream.tables import write_table


def made(folder: Path, name: str, points: np.ndarray, tile_size: float = 10.0) -> Path:
    cloud = folder / f"{name}.pcd"
    write_pcd(cloud, points)
    ts.ingest(cloud, folder / name / "map.zarr", tile_size=tile_size)
    return folder / name


def estimated(run_dir: Path, x: list[float], estimate: list[float]) -> None:
    rows: dict[str, object] = {c.name: [0.1] * len(x) for c in PREDICTION_COLUMNS}
    rows |= {"in_domain": [True] * len(x), "status": ["done"] * len(x), "reason": [""] * len(x)}
    rows |= {"route_id": ["r"] * len(x), "sample": range(len(x)), "arc_length": x}
    rows |= {"heading": [0.0] * len(x), "x": x, "y": [0.0] * len(x), "z": [2.0] * len(x)}
    frame = pd.DataFrame(rows).assign(estimate=estimate)
    columns = (*PLACE_COLUMNS, *PREDICTION_COLUMNS)
    write_table(
        str(run_dir / "tables" / "predictions" / "0_0.parquet"), frame, columns, Mark("done")
    )
    listed(run_dir)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("maps")
    points = scene("canyon", 1)
    old = made(folder, "old", points[points[:, 0] < 20.0])
    moved = points + np.where(points[:, :1] >= 10.0, (0.0, 0.0, 0.4), 0.0)
    more = scene("canyon", 2, offset=(20.0, 0.0, 0.0))
    new = made(folder, "new", np.vstack([moved[moved[:, 0] < 20.0], more]))
    estimated(old, [1.0, 2.0, 3.0, 4.0], [0.10, 0.10, 0.10, 0.30])
    estimated(new, [1.1, 2.0, 3.0, 40.0], [0.15, 0.09, 0.30, 0.90])
    return old, new


def test_tiles_are_added_removed_changed_or_the_same(two: tuple[Path, Path]) -> None:
    found = diff(*two)
    assert {key.ix for key in found.changed} == {1}
    assert {key.ix for key in found.added} >= {2, 3}
    assert found.removed == ()
    assert found.same >= 2
    back = diff(two[1], two[0])
    assert (back.added, back.removed) == (found.removed, found.added)
    assert back.changed == found.changed
    assert diff(two[0], two[0]).changed == ()


def test_points_that_got_worse_are_listed_the_worst_first(two: tuple[Path, Path]) -> None:
    found = diff(*two)
    assert found.compared == 3  # the one at 40 m is new
    assert found.worse["arc_length"].tolist() == [3.0, 1.1]
    assert found.worse["change"].tolist() == pytest.approx([0.2, 0.05])
    assert diff(*two, worse=0.1).worse["arc_length"].tolist() == [3.0]


def test_lengths_stretches_and_what_got_better_or_lost(two: tuple[Path, Path]) -> None:
    found = diff(*two, worse=0.005)
    worse, better = found.places.worse, found.places.better
    # places at 1.1, 2 and 3 m, then 40 m: each stands for half the way to its neighbours
    assert worse["length"].tolist() == pytest.approx([(3.0 - 2.0) / 2 + 37.0 / 2, 0.9 / 2])
    assert better["change"].tolist() == pytest.approx([-0.01])
    assert better["length"].tolist() == pytest.approx([(3.0 - 1.1) / 2])
    assert found.places.length == pytest.approx(worse["length"].sum() + better["length"].sum())
    (stretch,) = found.places.stretches.to_dict("records")
    assert (stretch["begin"], stretch["end"], stretch["at"]) == (1.1, 3.0, 3.0)
    assert (stretch["before"], stretch["after"], stretch["places"]) == (0.1, 0.3, 3)
    assert found.places.lost == 0
    back = diff(two[1], two[0], worse=0.005)
    assert back.places.worse["change"].tolist() == pytest.approx([0.01])
    assert len(back.places.better) == 2


def places(**columns: object) -> pd.DataFrame:
    """Ten places a metre apart."""
    x = np.arange(10.0)
    at = {"route_id": "r", "sample": np.arange(10), "arc_length": x, "x": x, "y": 0.0, "z": 2.0}
    return pd.DataFrame(at | {"heading": 0.0, "estimate": 0.1, "status": "done"} | columns)


def test_why_an_estimate_grew_is_the_part_and_the_factor_that_changed() -> None:
    grown = np.where(np.arange(10) == 4, 0.5, 0.1 + 0.001 * np.arange(10))
    poles = np.where(np.arange(10) == 4, 5.0, 100.0 - np.arange(10))
    drive = dict.fromkeys(("vd_across", "vd_up"), 0.01)
    old = places(D1_count=100.0 - np.arange(10), r_average=20.0, vd_along=0.02, **drive)
    new = places(D1_count=poles, r_average=20.0, vd_along=grown, estimate=grown, **drive)
    found = changes(old, new, 0.02)
    assert found.worse["arc_length"].tolist() == [4.0]
    (why,) = found.worse["why"]
    assert why == (
        f"{SLIDES_ALONG} (50\u00a0cm, before 2\u00a0cm); {NO_POLES} (D1_count 5, before 96)"
    )
    same = changes(old, old.assign(estimate=grown), 0.02)
    assert same.worse["why"].tolist() == [NOTHING]
    status = np.where(np.arange(10) == 4, INTERPOLATED, "done")
    for one, other in ((old.assign(status=status), old), (old, old.assign(status=status))):
        unsure = changes(one, other.assign(estimate=grown), 0.02)
        assert unsure.worse["why"].tolist() == [BETWEEN]


def test_a_place_whose_map_is_gone_has_lost_its_estimate() -> None:
    gone = np.arange(10) > 6
    now = places(estimate=np.where(gone, np.nan, 0.1)).assign(z=np.where(gone, np.nan, 2.0))
    found = changes(places(), now, 0.02)
    assert (found.lost, found.compared, len(found.worse)) == (3, 7, 0)
    assert found.length == pytest.approx(6.5)


@given(
    st.lists(st.floats(0.0, 1.0), min_size=10, max_size=10),
    st.lists(st.floats(0.0, 1.0), min_size=10, max_size=10),
    st.permutations(range(10)),
)
def test_worse_and_better_change_places_with_the_maps(
    one: list[float], other: list[float], order: list[int]
) -> None:
    a, b = places(estimate=one), places(estimate=other).iloc[order]
    there, back = changes(a, b, 0.02), changes(b, a, 0.02)
    assert set(there.worse["arc_length"]) == set(back.better["arc_length"])
    assert set(there.better["arc_length"]) == set(back.worse["arc_length"])
    assert there.worse["length"].sum() + there.better["length"].sum() <= there.length + 1e-9


def test_stores_without_estimates_are_compared_by_tiles(two: tuple[Path, Path]) -> None:
    found = diff(two[0] / "map.zarr", two[1] / "map.zarr")
    assert found.changed
    assert (found.compared, len(found.worse)) == (0, 0)


def test_what_cannot_be_compared_is_refused(two: tuple[Path, Path], tmp_path: Path) -> None:
    other = made(tmp_path, "other", scene("canyon", 1), tile_size=20.0)
    with pytest.raises(UsageError, match="one tile size"):
        diff(two[0], other)
    with pytest.raises(StoreNotFoundError):
        diff(two[0], tmp_path / "nothing")


def test_the_command_tells_people_and_machines(
    two: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["diff", str(two[0]), str(two[1]), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["compared"] == 3
    assert [row["arc_length"] for row in told["worse"]] == [3.0, 1.1]
    assert "1_0" in told["changed"]
    assert run(["diff", str(two[0]), str(two[1])]) == 0
    assert "got worse" in capsys.readouterr().out


def test_the_command_closes_the_gate_and_writes_the_page(
    two: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = two
    line = ["diff", str(old), str(new), "--report", str(tmp_path / "page")]
    assert run([*line, "--fail-worse", "0.1", "--json"]) == 1
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert told == json.loads((tmp_path / "page" / "diff.json").read_text())
    assert told["gate"]["passed"] is False
    assert (told["gate"]["fail_worse"], told["gate"]["over"]) == (0.1, "places")
    assert "0.2 m on r at 3 m" in said.err
    assert "The gate is closed" in words(tmp_path / "page" / "diff.html")

    assert run([*line, "--fail-worse", "0.25"]) == 0
    assert run(["diff", str(old), str(old), "--fail-worse", "0.25"]) == 0
    assert "the gate is open" in capsys.readouterr().err
    assert run(["diff", str(old / "map.zarr"), str(new / "map.zarr"), "--fail-worse", "9"]) == 1
    assert "no place is compared" in capsys.readouterr().err
    assert run(["diff", str(old), str(new), "--report", str(tmp_path / "other"), "--quiet"]) == 0
    assert json.loads((tmp_path / "other" / "diff.json").read_text())["gate"] is None
    assert "gate" not in words(tmp_path / "other" / "diff.html")


# --- Where the maps are


@pytest.fixture(scope="module")
def made_once(two: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`project/` with a store of each map and an estimate on each, which was asked for with paths
    that are relative to where one was then.
    """
    project = tmp_path_factory.mktemp("made") / "project"
    (project / "maps").mkdir(parents=True)
    (project / "runs").mkdir()
    for name, made_before in zip(("old", "new"), two, strict=True):
        shutil.copytree(made_before / "map.zarr", project / "maps" / f"{name}.zarr")
    (project / "r.csv").write_text("x,y\n4,0\n16,0\n")
    with contextlib.chdir(project / "runs"):
        for name in ("old", "new"):
            how = {"model": "physics", "spacing": 6.0}
            ts.estimate(f"../maps/{name}.zarr", project / "r.csv", out=name, **how)
    return project


@pytest.fixture
def runs(made_once: Path) -> Iterator[Path]:
    """The project as it was made, at the place where it was made."""
    kept = made_once.with_name("kept")
    if not kept.exists():
        shutil.copytree(made_once, kept)
    yield made_once
    shutil.rmtree(made_once, ignore_errors=True)
    shutil.copytree(kept, made_once)


def compared(old: Path, new: Path) -> tuple[object, ...]:
    found = diff(old, new)
    return found.changed, found.added, found.same, found.compared, dict(found.gone)


def test_the_map_of_a_run_is_found_wherever_they_went(runs: Path, tmp_path: Path) -> None:
    usual = compared(runs / "runs" / "old", runs / "runs" / "new")
    assert usual[0], "a tile has changed"
    assert usual[1:3] == (diff(runs / "maps" / "old.zarr", runs / "maps" / "new.zarr").added, 2)
    assert usual[3:] == (3, {})
    assert diff(runs / "runs" / "old", runs / "runs" / "new").notes == {}

    link = tmp_path / "link"  # from which `../..` leads elsewhere
    link.symlink_to(runs / "runs" / "old")
    assert compared(link, runs / "runs" / "new") == usual

    moved = tmp_path / "archive" / "2026" / "old"  # the run directory alone
    moved.parent.mkdir(parents=True)
    (runs / "runs" / "old").rename(moved)
    assert compared(moved, runs / "runs" / "new") == usual
    (told,) = diff(moved, runs / "runs" / "new").notes[str(moved)]
    assert str(runs / "maps" / "old.zarr") in told

    runs.rename(tmp_path / "renamed")  # a project as a whole
    there = tmp_path / "renamed" / "runs" / "new"
    assert compared(there, there)[2:] == (usual[2] + len(usual[0]) + len(usual[1]), 3, {})


def test_a_page_knows_what_both_runs_are_and_sees_the_newer_map(
    runs: Path, two: tuple[Path, Path], tmp_path: Path
) -> None:
    old, new = runs / "runs" / "old", runs / "runs" / "new"
    found = diff(old, new)
    before, after = (side.facts for side in found.sides)
    assert [side.name for side in found.sides] == [str(old), str(new)]
    assert before["map"] == str(runs / "maps" / "old.zarr")
    store = ts.open_store(after["map"])
    assert before["tiles"] < after["tiles"] == len(store.identities())
    assert (after["sensor"], after["CRS"]) == ("VLP16", "none: a local frame")
    assert after["sample points"] == after["with an estimate"] == 3
    assert after["run began"] == json.loads((new / "run.json").read_text())["began"]
    above = found.above()
    assert above is not None
    highest = max(store.tile(key).points()[:, 2].max() for key in found.changed)
    assert np.nanmax(above.height) >= highest - 0.001
    write_diff(found, tmp_path)
    assert "data:image/png;base64," in (tmp_path / "diff.html").read_text()
    assert diff(*two).above() is None, "nobody has made pictures of these tiles"
    was = found.sides[0].facts
    shutil.rmtree(runs / "maps" / "old.zarr")
    gone = diff(old, new).sides[0].facts
    assert dict(gone) == {name: was[name] for name in gone}
    assert "tiles" not in gone


def test_tables_that_moved_are_of_the_map_that_they_were_made_on(runs: Path) -> None:
    """With settings that name no store: of a job that made its own map, then of none."""
    both = runs / "runs" / "old", runs / "runs" / "new"
    usual = compared(*both)
    for run_dir in both:
        (run_dir / "config.yaml").unlink()
    assert compared(*both) == usual
    shutil.move(runs / "maps" / "old.zarr", both[0] / "map.zarr")
    assert compared(*both) == usual


def test_estimates_are_compared_where_a_map_is_gone(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = runs / "runs" / "old", runs / "runs" / "new"
    usual = diff(old, new, worse=0.0)
    shutil.rmtree(runs / "maps" / "old.zarr")
    found = diff(old, new, worse=0.0)
    assert list(found.gone) == [str(old)]
    assert str(runs / "maps" / "old.zarr") in found.gone[str(old)]
    assert (found.changed, found.same, found.compared) == ((), 0, 3)
    pd.testing.assert_frame_equal(found.worse, usual.worse)

    assert run(["diff", str(old), str(new), "--json"]) == 1
    told = capsys.readouterr()
    facts = json.loads(told.out)
    assert (facts["changed"], facts["same"], facts["compared"]) == (None, None, 3)
    assert str(runs / "maps" / "old.zarr") in told.err
    with pytest.raises(StoreNotFoundError, match=r"old\.zarr"):
        diff(old, runs / "maps" / "new.zarr")  # which has no estimates
    (old / "map.zarr").symlink_to(runs / "maps" / "new.zarr")
    assert diff(old, new).gone == {}, "a link says where it is"


def test_settings_that_are_damaged_are_named(runs: Path) -> None:
    (runs / "runs" / "old" / "config.yaml").write_text("map: {store")
    with pytest.raises(DamagedError, match=r"config\.yaml"):
        diff(runs / "runs" / "old", runs / "runs" / "new")
