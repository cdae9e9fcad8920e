"""Ingest: the same tiles from any blocks, workers and interruptions; bad input is named."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import distributed
import numpy as np
import pytest
import zstandard
from fuzz_mutations import mcap_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from killed import killed_after
from mcap.records import Chunk

import tilestream as ts
from tilestream.errors import (
    CrsError,
    PartialError,
    PlanError,
    SourceError,
    SourceNotFoundError,
    UsageError,
)
from tilestream.formats import open_source
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs import ingest as ingest_map
from tilestream.pipeline.jobs import sources
from tilestream.pipeline.stages import merge, scatter
from tilestream.settings import DEFAULT_MEMORY, IngestSettings
from tilestream.store import POINTS


def stored_points(store: ts.TileStore) -> np.ndarray:
    return np.concatenate([store.tile(key).points_mm() for key in store.keys()])


def as_set(points: np.ndarray) -> list[tuple[float, ...]]:
    return sorted(map(tuple, points.tolist()))


def tree_digest(folder: str | Path) -> dict[str, str]:
    """Hash of every file, but for what a killed writer of Zarr left, which none reads."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.suffix != ".partial"
    }


def literal_thinning(points: np.ndarray, leaf: int) -> list[tuple[int, ...]]:
    """definitions, section 1, map points: read word by word, with Python's exact integers."""
    voxels: dict[tuple[int, ...], list[list[int]]] = {}
    for point in np.rint(points * 1000.0).astype(int).tolist():
        voxels.setdefault(tuple(c // leaf for c in point), []).append(point)
    found = []
    for members in voxels.values():
        sums = [sum(column) for column in zip(*members, strict=True)]
        found.append(tuple(half_even(total, len(members)) for total in sums))
    return sorted(found)


def half_even(total: int, count: int) -> int:
    low = total // count
    rest = 2 * (total - low * count)
    return low + (rest > count or (rest == count and low % 2 == 1))


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A map in three overlapping files, far from the origin."""
    folder = tmp_path_factory.mktemp("clouds")
    rng = np.random.default_rng(11)
    paths = []
    for number in range(3):
        lo = np.array([368_000.0 + 20.0 * number, 3_955_000.0, -3.0])
        path = folder / f"{number}.pcd"
        write_pcd(path, rng.uniform(lo, lo + np.array([35.0, 40.0, 12.0]), (40_000, 3)))
        paths.append(path)
    return paths


@pytest.fixture(scope="module")
def reference(clouds: list[Path], tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    url = tmp_path_factory.mktemp("reference") / "map.zarr"
    return ts.ingest(clouds, url, tile_size=10.0, map_leaf=0.5)


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    tile=st.sampled_from([2.0, 5.0, 12.5, 100.0]),
    leaf=st.sampled_from([0.0, 0.1, 0.25, 0.5]),
    block=st.sampled_from([17, 100, 1000]),
    span=st.sampled_from([50, 333, 5000]),
    seed=st.integers(0, 3),
)
def test_any_tile_and_block_size_stores_the_points_of_the_definition(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tile: float,
    leaf: float,
    block: int,
    span: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.normal(0.0, 2.0, (800, 3))
    write_pcd(tmp_path / "a.pcd", cloud[:500])
    write_pcd(tmp_path / "b.pcd", cloud[500:])
    monkeypatch.setattr(scatter, "MAX_BLOCK_POINTS", block)
    monkeypatch.setattr(scatter, "MIN_BLOCK_POINTS", block)
    monkeypatch.setattr(sources, "POINTS_PER_TASK", span)
    url = tmp_path / "map.zarr"
    shutil.rmtree(url, ignore_errors=True)
    store = ts.ingest([tmp_path / "b.pcd", tmp_path / "a.pcd"], url, tile_size=tile, map_leaf=leaf)
    mm = np.rint(cloud * 1000.0).astype(np.int64)
    expected = literal_thinning(cloud, round(leaf * 1000)) if leaf else as_set(mm)
    assert as_set(stored_points(store)) == expected
    assert not (url / "fragments").exists()


@pytest.mark.parametrize("leaf", [0.05, 0.125, 0.333])
def test_many_voxels_of_any_edge_sum_every_point_once(tmp_path: Path, leaf: float) -> None:
    cloud = np.random.default_rng(1).uniform(-4.0, 4.0, (60_000, 3))
    write_pcd(tmp_path / "map.pcd", cloud.astype(np.float64))
    tile_size = round(leaf * 200, 3)
    store = ts.ingest(
        tmp_path / "map.pcd", tmp_path / "map.zarr", tile_size=tile_size, map_leaf=leaf
    )
    assert as_set(stored_points(store)) == literal_thinning(
        raw_points(tmp_path), round(leaf * 1000)
    )


def raw_points(folder: Path) -> np.ndarray:
    """The points as the file holds them, which may have rounded them to float32."""
    source = open_source(str(folder / "map.pcd"))
    (span,) = source.spans(10**9)
    return np.concatenate([block.points for block in source.blocks(span, 10**6)])


def test_strips_change_nothing(
    clouds: list[Path], reference: ts.TileStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strips: list[object] = []
    thin = merge.thin
    monkeypatch.setattr(merge, "thin", lambda *what: strips.append(what) or thin(*what))
    monkeypatch.setattr(merge, "strips_fitting", lambda *_: 5)
    store = ts.ingest(clouds, tmp_path / "map.zarr", tile_size=10.0, map_leaf=0.5)
    assert len(strips) == 5 * len(store.keys())
    assert store.marks() == reference.marks()
    for key in store.keys():
        np.testing.assert_array_equal(store.tile(key).points(), reference.tile(key).points())


@given(
    st.lists(st.tuples(*[st.floats(-1.0, 1.0, allow_subnormal=False)] * 3), min_size=1, max_size=30)
)
@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_the_round_trip_errs_by_half_a_millimetre_at_most(
    tmp_path: Path, offsets: list[tuple[float, float, float]]
) -> None:
    cloud = np.array([4_000_000.0, -4_000_000.0, 300.0]) + np.array(offsets)
    write_pcd(tmp_path / "far.pcd", cloud)
    shutil.rmtree(tmp_path / "map.zarr", ignore_errors=True)
    store = ts.ingest(tmp_path / "far.pcd", tmp_path / "map.zarr", tile_size=2.0, map_leaf=0.0)
    stored = np.concatenate([store.tile(key).points() for key in store.keys()])
    distance = np.abs(stored[:, None] - cloud[None]).max(axis=2)
    assert len(stored) == len(cloud)
    assert distance.min(axis=1).max() <= 0.5e-3 + 1e-9
    assert distance.min(axis=0).max() <= 0.5e-3 + 1e-9


def test_dask_workers_write_the_same_bytes(
    clouds: list[Path], reference: ts.TileStore, tmp_path: Path, workers: distributed.Client
) -> None:
    url = tmp_path / "map.zarr"
    ts.ingest(clouds, url, tile_size=10.0, map_leaf=0.5, client=workers)
    assert tree_digest(url) == tree_digest(reference.url)


def test_a_killed_worker_is_made_up_for(
    clouds: list[Path], reference: ts.TileStore, tmp_path: Path, workers: distributed.Client
) -> None:
    url = tmp_path / "map.zarr"
    victim = next(iter(workers.run(os.getpid).values()))
    seen: list[str] = []

    def watch(outcome: object, ended: int, total: int) -> None:
        seen.append("")
        if len(seen) == 8:
            os.kill(victim, signal.SIGKILL)

    ts.ingest(clouds, url, tile_size=10.0, map_leaf=0.5, client=workers, watch=watch)
    assert len(seen) >= 8  # the worker was killed
    assert tree_digest(url) == tree_digest(reference.url)


@pytest.mark.parametrize(
    ("stage", "tasks"), [pytest.param("scatter", 1, marks=pytest.mark.slow), ("merge", 5)]
)
def test_a_killed_ingest_continues_to_the_same_bytes(
    clouds: list[Path], tmp_path: Path, stage: str, tasks: int
) -> None:
    whole, broken = tmp_path / "whole.zarr", tmp_path / "broken.zarr"
    ts.ingest(clouds, whole, tile_size=6.0, map_leaf=0.1)
    call = "ts.ingest(sys.argv[2:], sys.argv[1], tile_size=6.0, map_leaf=0.1, watch=watch)"
    killed_after(tasks, stage, call, str(broken), *map(str, clouds))
    assert (broken / "fragments").exists()
    assert tree_digest(broken) != tree_digest(whole)
    ts.ingest(clouds, broken, tile_size=6.0, map_leaf=0.1)
    assert tree_digest(broken) == tree_digest(whole)


def test_a_full_disk_is_named_and_the_rest_resumes(clouds: list[Path], tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = (
        f"mount -t tmpfs -o size=300k tmpfs {disk} || exit 77; "
        f"{sys.executable} -m tilestream ingest {clouds[0]} --store {disk}/map.zarr"
    )
    shell = ["unshare", "-rm", "sh", "-c", command]
    if shutil.which("unshare") is None:
        pytest.skip("no unshare here: cannot make a small disk")
    ended = subprocess.run(shell, capture_output=True, text=True, check=False)
    if ended.returncode not in (0, 1, 2) or "unshare" in ended.stderr:
        pytest.skip(f"cannot mount a small disk here: {ended.stderr.strip()}")
    assert ended.returncode == 1
    assert "No space left on device" in ended.stderr
    assert "0.pcd" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_an_unchanged_map_is_not_read_again(clouds: list[Path], reference: ts.TileStore) -> None:
    before = tree_digest(reference.url)
    seen: list[object] = []
    ts.ingest(
        clouds,
        reference.url,
        tile_size=10.0,
        map_leaf=0.5,
        watch=lambda *what: seen.append(what),
    )
    assert seen == []
    assert tree_digest(reference.url) == before


def written_at(store: ts.TileStore) -> dict[ts.TileKey, int]:
    marks = {key: Path(store.url) / str(key) / POINTS / "zarr.json" for key in store.keys()}
    return {key: path.stat().st_mtime_ns for key, path in marks.items()}


def test_a_changed_source_redoes_its_tiles_only(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    near, far = rng.uniform(0.0, 30.0, (500, 3)), rng.uniform(100.0, 130.0, (500, 3))
    write_pcd(tmp_path / "near.pcd", near)
    write_pcd(tmp_path / "far.pcd", far)
    sources, url = [tmp_path / "near.pcd", tmp_path / "far.pcd"], tmp_path / "map.zarr"
    store = ts.ingest(sources, url, tile_size=10.0)
    times = written_at(store)
    write_pcd(tmp_path / "far.pcd", far[far[:, 0] < 120.0] + (0.0, 0.0, 0.01))
    store = ts.ingest(sources, url, tile_size=10.0)
    after = written_at(store)
    assert {key for key in times if after.get(key) == times[key]} == {k for k in times if k[0] < 10}
    assert {key for key in times if key not in after} == {k for k in times if k[0] == 12}
    fresh = ts.ingest(sources, tmp_path / "fresh.zarr", tile_size=10.0)
    assert tree_digest(url) == tree_digest(fresh.url)


def test_a_forgotten_source_and_another_setting_are_refused(
    clouds: list[Path], reference: ts.TileStore
) -> None:
    with pytest.raises(UsageError, match=r"also made from .*2\.pcd"):
        ts.ingest(clouds[:2], reference.url, tile_size=10.0, map_leaf=0.5)
    with pytest.raises(UsageError, match=r"has tile_size 10\.0, asked for is 20\.0"):
        ts.ingest(clouds, reference.url, tile_size=20.0, map_leaf=0.5)


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    cloud = np.arange(30.0).reshape(10, 3)
    cloud[3, 1], cloud[7, 0], cloud[8] = np.nan, np.inf, -np.inf
    write_pcd(tmp_path / "gaps.pcd", cloud)
    store = ts.ingest(tmp_path / "gaps.pcd", tmp_path / "map.zarr")
    assert len(stored_points(store)) == 7
    (source,) = store.sources()
    assert (source["points"], source["dropped"]) == (7, 3)


def test_sources_without_points_are_an_error_that_names_them(tmp_path: Path) -> None:
    write_pcd(tmp_path / "empty.pcd", np.zeros((0, 3)))
    with pytest.raises(SourceError, match=r"hold no points: .*empty\.pcd"):
        ts.ingest(tmp_path / "empty.pcd", tmp_path / "map.zarr")
    assert ts.open_store(str(tmp_path / "map.zarr")).keys() == []


def test_the_good_sources_are_ingested_and_the_bad_one_leaves_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    good, bad = tmp_path / "good.pcd", tmp_path / "bad.pcd"
    write_pcd(good, rng.uniform(0.0, 20.0, (1000, 3)))
    write_pcd(bad, rng.uniform(0.0, 20.0, (1000, 3)))
    whole = bad.read_bytes()
    bad.write_bytes(whole[:-100])
    url = tmp_path / "map.zarr"
    with pytest.raises(PartialError, match=r"1 failed, the rest.*\n.*bad\.pcd") as caught:
        ts.ingest([good, bad], url, tile_size=10.0)
    assert list(caught.value.failures) == [str(bad)]
    alone = ts.ingest(good, tmp_path / "alone.zarr", tile_size=10.0)
    assert ts.open_store(str(url)).marks() == alone.marks()
    bad.write_bytes(whole)
    both = ts.ingest([good, bad], url, tile_size=10.0)
    fresh = ts.ingest([good, bad], tmp_path / "fresh.zarr", tile_size=10.0)
    assert tree_digest(both.url) == tree_digest(fresh.url)


def test_a_bomb_is_named_and_the_good_source_is_ingested(tmp_path: Path) -> None:
    good, bomb = tmp_path / "good.pcd", tmp_path / "bomb.mcap"
    write_pcd(good, np.random.default_rng(5).uniform(0.0, 20.0, (1000, 3)))
    packed = zstandard.compress(bytes(10**7))
    bomb.write_bytes(mcap_of([Chunk("zstd", packed, 0, 0, 0, 1000)]))
    with pytest.raises(PartialError) as caught:
        ts.ingest([good, bomb], tmp_path / "map.zarr", tile_size=10.0)
    assert list(caught.value.failures) == [str(bomb)]
    alone = ts.ingest(good, tmp_path / "alone.zarr", tile_size=10.0)
    assert ts.open_store(str(tmp_path / "map.zarr")).marks() == alone.marks()


def test_a_source_that_needs_too_much_memory_does_not_end_the_ingest_of_others(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(5)
    small, large = tmp_path / "small.pcd", tmp_path / "large.pcd"
    write_pcd(small, rng.uniform(0.0, 20.0, (1000, 3)))
    write_pcd(large, rng.uniform(0.0, 20.0, (2_000_000, 3)), encoding="binary_compressed")
    needed = [scatter.needed_to_open(open_source(str(path)).info()) for path in (small, large)]
    memory = sum(needed) // 2
    with pytest.raises(PartialError, match=r"large\.pcd: needs .*--memory"):
        ts.ingest([small, large], tmp_path / "map.zarr", memory=memory)
    assert ts.open_store(str(tmp_path / "map.zarr")).condition().whole
    with pytest.raises(PlanError, match="--memory"):
        ts.ingest(large, tmp_path / "other.zarr", memory=memory)


def test_sources_that_all_fail_leave_the_map_as_it_was(tmp_path: Path) -> None:
    path, url = tmp_path / "a.pcd", tmp_path / "map.zarr"
    write_pcd(path, np.random.default_rng(5).uniform(0.0, 20.0, (1000, 3)))
    marks = ts.ingest(path, url, tile_size=10.0).marks()
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(PartialError, match=r"as it was:\n.*a\.pcd: ") as caught:
        ts.ingest(path, url, tile_size=10.0)
    store = ts.open_store(str(url))
    assert store.marks() == marks
    assert {s["path"]: s["reason"] for s in store.sources()} == caught.value.failures
    path.write_bytes(whole)
    again = ts.ingest(path, url, tile_size=10.0)
    assert again.marks() == marks
    assert [source["reason"] for source in again.sources()] == [""]


def test_of_a_map_that_never_was_nobody_says_that_it_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_las(path, np.random.default_rng(5).uniform(0.0, 20.0, (1000, 3)))
    content = bytearray(path.read_bytes())
    content[-400:-200] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(PartialError, match=r"no source could be read:\n"):
        ts.ingest(path, tmp_path / "map.zarr")


@pytest.mark.parametrize("place", [(2e8, 0.0, 0.0), (0.0, -2e8, 0.0), (0.0, 0.0, 2e6)])
def test_coordinates_that_do_not_fit_the_grid_are_named(
    tmp_path: Path, place: tuple[float, float, float]
) -> None:
    write_pcd(tmp_path / "stray.pcd", np.array([[0.0, 0.0, 0.0], place]))
    with pytest.raises(PartialError, match=r"stray\.pcd.*outside of the tile grid: 1 of 2 points"):
        ts.ingest(tmp_path / "stray.pcd", tmp_path / "map.zarr")
    write_pcd(tmp_path / "few.pcd", np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], place]))
    (source,) = ts.ingest(tmp_path / "few.pcd", tmp_path / "few.zarr").sources()
    assert source["points"] == 2
    x, y, z = (f"{value:.6g}" for value in place)
    assert f"1 of 3 points, first ({x}, {y}, {z}) m: left out" in "".join(source["notes"])


def test_a_stray_point_does_not_take_all_memory(tmp_path: Path) -> None:
    write_pcd(tmp_path / "stray.pcd", np.array([[0.0, 0.0, 0.0], [9e7, 9e7, 0.0]]))
    with pytest.raises(PartialError, match=r"stray\.pcd: 10 km from all others: 1 of 2 points"):
        ts.ingest(tmp_path / "stray.pcd", tmp_path / "map.zarr", tile_size=1.0)


def test_points_all_over_the_place_are_refused(tmp_path: Path) -> None:
    everywhere = np.random.default_rng(0).uniform(-9e7, 9e7, (5000, 3)) / [1, 1, 100]
    write_pcd(tmp_path / "a.pcd", everywhere)
    with pytest.raises(PartialError, match=r"a\.pcd.*spans .* tiles of 1 m, all over them"):
        ts.ingest(tmp_path / "a.pcd", tmp_path / "map.zarr", tile_size=1.0)


def test_two_districts_of_a_file_are_one_map(tmp_path: Path) -> None:
    here = np.random.default_rng(0).uniform(0.0, 50.0, (200, 3))
    write_pcd(tmp_path / "a.pcd", np.concatenate([here, here + np.array([4e5, 3e5, 0.0])]))
    (source,) = ts.ingest(tmp_path / "a.pcd", tmp_path / "map.zarr").sources()
    assert (source["points"], source["notes"]) == (400, [])


def test_what_is_a_stray_does_not_depend_on_how_a_source_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = np.random.default_rng(0).uniform(0.0, 90.0, (2000, 3))
    cloud[:, :2] += 381_000.0, 3_950_000.0
    cloud[::300] = 0.0
    write_pcd(tmp_path / "a.pcd", cloud)
    whole = ts.ingest(tmp_path / "a.pcd", tmp_path / "a.zarr")
    monkeypatch.setattr(sources, "POINTS_PER_TASK", 300)
    split = ts.ingest(tmp_path / "a.pcd", tmp_path / "b.zarr")
    assert split.identities() == whole.identities()
    assert split.sources()[0]["notes"] == whole.sources()[0]["notes"]
    assert whole.sources()[0]["points"] == 1993


@pytest.mark.parametrize("gap", [9_000.0, 11_000.0, 14_000.0, 19_000.0, 21_000.0])
@pytest.mark.parametrize("begins", [0.0, 9_900.0, -3_210.0])
def test_what_is_a_stray_does_not_depend_on_the_tiles(
    gap: float, begins: float, tmp_path: Path
) -> None:
    """Of tiles that divide 10 km: nothing nearer than that is one, all twice as far away are."""
    cloud = np.random.default_rng(0).uniform(0.0, 50.0, (2000, 3))
    cloud[:, 0] += begins
    cloud[:3, 0] = cloud[:, 0].max() + gap
    write_pcd(tmp_path / "a.pcd", cloud)
    left = {
        ts.ingest(tmp_path / "a.pcd", tmp_path / f"{size:g}.zarr", tile_size=size).sources()[0][
            "points"
        ]
        for size in (20.0, 50.0, 125.0, 1000.0)
    }
    assert len(left) == 1
    if gap < 10_000.0 or gap > 20_000.0:
        assert left == {2000 if gap < 10_000.0 else 1997}


def test_two_crs_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    cloud = np.zeros((10, 3))
    write_las(tmp_path / "a.las", cloud, crs="EPSG:6677")
    write_las(tmp_path / "b.las", cloud, crs="EPSG:32654")
    with pytest.raises(CrsError, match=r"(?s)a\.las is .*b\.las is "):
        ts.ingest([tmp_path / "a.las", tmp_path / "b.las"], tmp_path / "map.zarr")
    with pytest.raises(CrsError, match="asked for"):
        ts.ingest(tmp_path / "a.las", tmp_path / "map.zarr", crs="EPSG:32654")
    with pytest.raises(CrsError, match="no CRS that pyproj reads"):
        ts.ingest(tmp_path / "a.las", tmp_path / "map.zarr", crs="EPSG:nonsense")
    assert not (tmp_path / "map.zarr").exists()
    store = ts.ingest([tmp_path / "a.las"], tmp_path / "map.zarr")
    assert "6677" in str(store.settings.crs)


def test_what_cannot_be_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", np.zeros((10, 3)))
    url = tmp_path / "map.zarr"
    for bad in (
        {"tile_size": 0.0},
        {"tile_size": float("nan")},
        {"tile_size": 10.0, "map_leaf": 0.3},
        {"map_leaf": -1.0},
        {"halo": -1.0},
    ):
        with pytest.raises(UsageError):
            ts.ingest(tmp_path / "a.pcd", url, **bad)
    with pytest.raises(SourceNotFoundError, match="nothing"):
        ts.ingest([tmp_path / "a.pcd", tmp_path / "nothing*.pcd"], url)
    with pytest.raises(UsageError, match="no sources"):
        ts.ingest([], url)
    assert not url.exists()


def test_a_job_that_does_not_fit_its_memory_is_refused_with_advice(clouds: list[Path]) -> None:
    with pytest.raises(PlanError, match="--memory"):
        ingest_map.plan_ingest(clouds, "map.zarr", IngestSettings(), memory=10_000_000)
    made = ingest_map.plan_ingest(clouds, "map.zarr", IngestSettings()).scatters
    assert list(made.describe()) == [("scatter", 3, made.promised_bytes)]
    assert made.promised_bytes <= DEFAULT_MEMORY


def test_two_ingests_at_once_into_two_stores_do_not_meet(
    clouds: list[Path], reference: ts.TileStore, tmp_path: Path
) -> None:
    def work(name: str) -> None:
        ts.ingest(clouds, tmp_path / name, tile_size=10.0, map_leaf=0.5)

    threads = [threading.Thread(target=work, args=(f"{n}.zarr",)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in range(2):
        assert tree_digest(tmp_path / f"{number}.zarr") == tree_digest(reference.url)


@pytest.mark.parametrize(
    "name", ["hdl64_street.pcd", "vls128_street.pcd", "251370668.pcd", "251371071.pcd"]
)
def test_real_scans_ingest_with_the_right_counts(
    shared_data: Path, tmp_path: Path, name: str
) -> None:
    (path,) = shared_data.glob(f"*/{name}")
    raw = path.read_bytes()
    head, body = raw.split(b"DATA binary\n", 1)
    header = dict(line.split(maxsplit=1) for line in head.decode().splitlines()[1:])
    width = len(header["FIELDS"].split())
    cloud = np.frombuffer(body, np.float32, int(header["POINTS"]) * width).reshape(-1, width)
    finite = cloud[np.isfinite(cloud[:, :3]).all(axis=1), :3].astype(np.float64)
    store = ts.ingest(path, tmp_path / "map.zarr", map_leaf=0.0)
    stored = stored_points(store)
    assert len(stored) == len(finite)
    mm = np.rint(finite * 1000.0)
    np.testing.assert_array_equal(stored.min(axis=0), mm.min(axis=0))
    np.testing.assert_array_equal(stored.max(axis=0), mm.max(axis=0))
    np.testing.assert_array_equal(stored.sum(axis=0), mm.sum(axis=0))


MEMORY_PROBE = """
import re, sys
from pathlib import Path
from tilestream.cli import run
code = run(sys.argv[1:])
kilobytes = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]
print("PEAK", int(kilobytes) * 1024)
sys.exit(code)
"""


@pytest.mark.slow
@pytest.mark.parametrize("leaf", ["0.2", "0"])
def test_a_source_far_larger_than_the_promise_ingests_within_it(tmp_path: Path, leaf: str) -> None:
    points, chunk = 170_000_000, 5_000_000
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {points}\nDATA binary\n"
    )
    rng = np.random.default_rng(0)
    with (tmp_path / "large.pcd").open("wb") as file:
        file.write(header.encode())
        for _ in range(points // chunk):
            file.write(rng.uniform(0.0, (1500.0, 1500.0, 5.0), (chunk, 3)).astype("<f4").tobytes())
    assert (tmp_path / "large.pcd").stat().st_size > 2e9
    ended = subprocess.run(
        [
            *(sys.executable, "-c", MEMORY_PROBE, "ingest", str(tmp_path / "large.pcd")),
            *("--store", str(tmp_path / "map.zarr"), "--memory", "512MB", "--map-leaf", leaf),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    peak = int(ended.stdout.rsplit("PEAK", 1)[1])
    print(f"peak {peak / 1e6:.0f} MB of 512 MB promised")  # noqa: T201
    assert peak <= 512e6
