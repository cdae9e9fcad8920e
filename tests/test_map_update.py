"""A map of several files of which some change: what they reach is made again, and nothing else."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import streets
from city_tiles import block, digest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from killed import killed_after
from scenes import in_map
from streets import STREETS, job

import tilestream as ts
from tilestream.apps.verbs import plan
from tilestream.apps.verify import repair, verify
from tilestream.cli import run as command
from tilestream.errors import PartialError, UsageError
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.jobs.map_reading import GONE
from tilestream.pipeline.jobs.run_settings import RunSettings

TILE = 20.0
BLOCKS = 8
"""Files of the city, one a tile, along a street."""


@pytest.fixture(scope="module", autouse=True)
def small_jobs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with streets.small(tmp_path_factory.mktemp("cache")):
        yield


def times(folder: str | Path) -> dict[str, int]:
    """When each file below was written, but for what a run writes at its end, and the root of a
    store, which says where its sources are.
    """
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.name != ".lock" and path.parent.suffix != ".zarr"
    }


class Told:
    """The outcomes of a job."""

    def __init__(self) -> None:
        self.outcomes: list[Outcome] = []

    def __call__(self, outcome: Outcome, *_: int) -> None:
        self.outcomes.append(outcome)

    def made(self, stage: str) -> set[str]:
        """The names of the tasks of a stage that made something."""
        return {o.key[len(stage) + 1 :] for o in self.outcomes if o.stage == stage and o.made}


# --- The map alone


def cloud(number: int, seed: int) -> np.ndarray:
    """What a file has: over its own tile, and over the rim of the next one."""
    points = np.random.default_rng(seed).uniform((0.0, 0.0, 0.0), (22.0, TILE, 5.0), (300, 3))
    return in_map(np.round(points, 3), (number * TILE, 0.0, 0.0))


class Sources:
    """The files of a map, which change."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written = 0
        self.blocks: dict[str, int] = {}
        folder.mkdir()
        for number in range(4):
            self.write(f"{number}.pcd", number, number)

    def write(self, name: str, number: int, seed: int) -> None:
        """A file of a block."""
        write_pcd(self.folder / name, cloud(number, seed))
        self.blocks[name] = number
        self.date(name)

    def date(self, name: str) -> None:
        """A time of its own, however fast files follow each other."""
        self.written += 1
        os.utime(self.folder / name, ns=(self.written * 10**9, self.written * 10**9))

    def change(self, how: str, which: int, seed: int) -> set[int]:
        """Replace, add, take away, rename or touch a file; the blocks that it is in, of before and
        now, where points change.
        """
        name = sorted(self.blocks)[which % len(self.blocks)]
        number = self.blocks[name]
        if how == "replace":
            self.write(name, number, 10 + seed)
        elif how == "add":
            number = 3 + seed % 3
            self.write(f"new{self.written}.pcd", number, 20 + seed)
        elif how == "take" and len(self.blocks) > 1:
            (self.folder / name).unlink()
            del self.blocks[name]
        elif how == "rename":
            other = f"other{self.written}-{which}{seed}.pcd"
            (self.folder / name).rename(self.folder / other)
            self.blocks[other] = self.blocks.pop(name)
            return set()
        else:
            self.date(name)
            return set()
        return {number}


def ingested(folder: Path, url: Path, watch: Told | None = None) -> ts.TileStore:
    return ts.ingest(f"{folder}/*.pcd", url, tile_size=TILE / 2, map_leaf=0.5, watch=watch)


@settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    changes=st.lists(
        st.tuples(
            st.sampled_from(["replace", "add", "take", "rename", "touch"]),
            st.integers(0, 5),
            st.integers(0, 5),
        ),
        min_size=1,
        max_size=3,
    ),
    together=st.booleans(),
)
def test_a_map_that_is_updated_is_the_map_from_nothing(
    tmp_path_factory: pytest.TempPathFactory,
    changes: list[tuple[str, int, int]],
    together: bool,
) -> None:
    """Every byte of it; and the tiles that no changed file touches are not written again."""
    folder = tmp_path_factory.mktemp("update")
    sources = Sources(folder / "map")
    ingested(sources.folder, folder / "map.zarr")
    blocks: set[int] = set()
    for number, change in enumerate(changes):
        blocks |= sources.change(*change)
        if together and number < len(changes) - 1:
            continue
        before = times(folder / "map.zarr")
        ingested(sources.folder, folder / "map.zarr")
        fresh = ingested(sources.folder, folder / f"fresh{number}.zarr")
        assert digest(folder / "map.zarr") == digest(Path(fresh.url))
        after = times(folder / "map.zarr")
        again = {name.split("/")[0] for name, at in after.items() if before.get(name) != at}
        columns = {2 * number + tile for number in blocks for tile in range(3)}
        reached = {f"{column}_{row}" for column in columns for row in (0, 1)}
        assert {name for name in again if not name.startswith(("manifest", "shares"))} <= reached
        blocks = set()


def test_only_what_gives_to_tiles_that_differ_is_read(tmp_path: Path) -> None:
    sources = Sources(tmp_path / "map")
    ingested(sources.folder, tmp_path / "map.zarr")
    sources.change("replace", 2, 0)
    told = Told()
    ingested(sources.folder, tmp_path / "map.zarr", told)
    assert told.made("scatter") == {"1-0", "2-0", "3-0"}, "the changed one, and its neighbours"
    assert told.made("merge") == {f"{x}_{y}" for x in (4, 5, 6) for y in (0, 1)}
    sources.change("rename", 0, 0)
    told = Told()
    ingested(sources.folder, tmp_path / "map.zarr", told)
    assert len(told.made("scatter")) == 1, "what is in it is only known by reading it"
    assert told.made("merge") == set()
    told = Told()
    ingested(sources.folder, tmp_path / "map.zarr", told)
    assert told.outcomes == []


def test_a_file_that_changed_behind_its_time_is_noticed_where_it_is_read(tmp_path: Path) -> None:
    """Of the same size and time; the tile that it shares with a changed one says so."""
    sources = Sources(tmp_path / "map")
    ingested(sources.folder, tmp_path / "map.zarr")
    sly = tmp_path / "map" / "1.pcd"
    stat = sly.stat()
    write_pcd(sly, cloud(1, 99))
    os.utime(sly, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert (sly.stat().st_size, sly.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
    sources.change("replace", 2, 0)
    ingested(sources.folder, tmp_path / "map.zarr")
    fresh = ingested(sources.folder, tmp_path / "fresh.zarr")
    assert digest(tmp_path / "map.zarr") == digest(Path(fresh.url))


def test_a_source_that_cannot_be_read_again_gives_nothing_as_in_a_new_map(tmp_path: Path) -> None:
    sources = Sources(tmp_path / "map")
    ingested(sources.folder, tmp_path / "map.zarr")
    (tmp_path / "map" / "1.pcd").write_bytes(b"no points")
    sources.change("replace", 2, 0)
    with pytest.raises(PartialError, match=r"1\.pcd"):
        ingested(sources.folder, tmp_path / "map.zarr")
    with pytest.raises(PartialError, match=r"1\.pcd"):
        ingested(sources.folder, tmp_path / "fresh.zarr")
    assert digest(tmp_path / "map.zarr") == digest(tmp_path / "fresh.zarr")
    sources.write("1.pcd", 1, 1)
    ingested(sources.folder, tmp_path / "map.zarr")
    assert ts.status(tmp_path / "map.zarr").whole


def test_without_its_shares_all_sources_are_read_to_the_same_map(tmp_path: Path) -> None:
    """As of a map that an older version made; and what is damaged is named, and removed."""
    sources = Sources(tmp_path / "map")
    store = ingested(sources.folder, tmp_path / "map.zarr")
    (shares,) = Path(store.url).glob("shares_*/c/0")
    content = bytearray(shares.read_bytes())
    content[len(content) // 2] ^= 1
    shares.write_bytes(bytes(content))
    _, (damage,) = verify(store.url)
    assert "what each source gave" in damage.path
    told = Told()
    sources.change("replace", 3, 0)
    ingested(sources.folder, tmp_path / "map.zarr", told)
    assert len(told.made("scatter")) == 4
    assert verify(store.url)[1] == []
    shares = next(Path(store.url).glob("shares_*/c/0"))
    shares.unlink()
    removed, left = repair(store.url)
    assert (len(removed), left) == (1, [])
    assert ts.status(store.url).whole
    sources.change("replace", 3, 1)
    ingested(sources.folder, tmp_path / "map.zarr")
    fresh = ingested(sources.folder, tmp_path / "fresh.zarr")
    assert digest(tmp_path / "map.zarr") == digest(Path(fresh.url))


def test_an_update_that_is_killed_is_no_whole_map_and_goes_on(tmp_path: Path) -> None:
    sources = Sources(tmp_path / "map")
    ingested(sources.folder, tmp_path / "map.zarr")
    sources.change("replace", 1, 0)
    sources.change("take", 3, 0)
    how = f"tile_size={TILE / 2}, map_leaf=0.5, watch=watch"
    call = f"ts.ingest(sys.argv[2] + '/*.pcd', sys.argv[1], {how})"
    killed_after(2, "merge", call, str(tmp_path / "map.zarr"), str(sources.folder))
    assert not ts.status(tmp_path / "map.zarr").whole
    ingested(sources.folder, tmp_path / "map.zarr")
    fresh = ingested(sources.folder, tmp_path / "fresh.zarr")
    assert digest(tmp_path / "map.zarr") == digest(Path(fresh.url))


def test_the_command_says_how_many_tiles_change_before_and_after(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = Sources(tmp_path / "map")
    line = ["ingest", f"{sources.folder}/*.pcd", "--store", str(tmp_path / "map.zarr")]
    line += ["--tile-size", "10"]
    assert command(line) == 0
    assert "tiles changed" not in capsys.readouterr().out
    sources.change("take", 3, 0)
    before = times(tmp_path)
    assert command([*line, "--dry-run"]) == 0
    assert "map: at most 2 of 14 tiles change, 4 removed" in capsys.readouterr().out
    assert times(tmp_path) == before
    assert command([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["update"]
    assert (told["tiles_changed"], told["tiles_of"], told["tiles_removed"]) == (2, 14, 4)


# --- A whole run


def write_block(folder: Path, number: int, seed: int, points: np.ndarray | None = None) -> None:
    points = block(TILE, 0.6, seed) if points is None else points
    write_las(folder / f"{number}.las", in_map(points, (number * TILE, 0.0, 0.0)))


def bare(seed: int) -> np.ndarray:
    """A block whose houses are gone."""
    points = block(TILE, 0.6, seed)
    return points[points[:, 2] < 0.4]


def city_job(folder: Path, out: Path) -> RunSettings:
    """The whole street, from the map alone, by a lidar that sees about a tile."""
    return RunSettings(
        out=str(out),
        map={"sources": [f"{folder}/*.las"], "tile_size": TILE},
        routes=[str(folder / "route.csv")],
        spacing=4.0,
        sensor=ts.VLP16.model_copy(update={"name": "near", "range_max": 15.0}),
        observe={"range_max": 12.0, "starts": 8, "draws": 2, "worlds": 1},
        model={"recipe": "physics", "offset": 0.0},
    )


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`map/`, and `run/` made of it."""
    folder = tmp_path_factory.mktemp("city")
    (folder / "map").mkdir()
    for number in range(BLOCKS):
        write_block(folder / "map", number, number)
    x = np.linspace(1.0, BLOCKS * TILE - 1.0, 40)
    rows = [f"{at},{TILE / 2 + 0.3 * np.sin(at / 7.0)},2.0\n" for at in x]
    (folder / "map" / "route.csv").write_text("x,y,z\n" + "".join(rows))
    ts.run(city_job(folder / "map", folder / "run"))
    return folder.rename(folder.with_name("elsewhere"))  # of a copy nothing is left there


@pytest.fixture
def copied(city: Path, tmp_path: Path) -> Path:
    """A copy with the times of its files, so that the sources are those of before."""
    shutil.copytree(city, tmp_path / "city")
    return tmp_path / "city"


def tables(run: Path) -> dict[str, str]:
    """All tiles and all tables of a run."""
    parts = (run / "map.zarr", run / "tables")
    found = {f"{part.name}/{name}": one for part in parts for name, one in digest(part).items()}
    return {name: one for name, one in found.items() if not name.endswith("evaluation.json")}


CHANGES: dict[str, Callable[[Path], object]] = {
    "replaced": lambda folder: write_block(folder, 1, 0, bare(1)),
    "added": lambda folder: write_block(folder, BLOCKS, 9),
    "taken away": lambda folder: (folder / "0.las").unlink(),
    "renamed": lambda folder: (folder / "2.las").rename(folder / "two.las"),
}
WHERE = {"replaced": 1, "added": BLOCKS, "taken away": 0}
"""The tile that an update changes."""
AWAY = {"factors": 2, "observability": 3, "predictions": 4}
"""So many tiles away tables may change: the tile beside has terms and surfels of its own near the
border, the range is less than a tile (with the margin of a virtual scan two), and estimates are
averaged over the border of a tile."""


def reached(how: str, table: str) -> set[str]:
    """The tables that an update may reach."""
    near = range(WHERE[how] - AWAY[table], WHERE[how] + AWAY[table] + 1) if how in WHERE else ()
    return {f"{table}/{tile}_0.parquet" for tile in near}


@pytest.mark.parametrize("how", CHANGES)
def test_an_update_recomputes_what_it_reaches_and_nothing_else(how: str, copied: Path) -> None:
    before = times(copied / "run" / "tables")
    CHANGES[how](copied / "map")
    wanted = city_job(copied / "map", copied / "run")
    there = digest(copied)
    expected = plan(wanted)
    assert digest(copied) == there, "a plan writes nothing"
    told = Told()
    ts.run(wanted, watch=told)
    ts.run(city_job(copied / "map", copied / "fresh"))
    assert tables(copied / "run") == tables(copied / "fresh")

    after = times(copied / "run" / "tables")
    for table in AWAY:
        written = {name for name in after if name.startswith(table) and name.endswith("parquet")}
        again = {name for name in written if before.get(name) != after[name]}
        assert again <= reached(how, table) & written < written
        assert bool(again) == (how in WHERE)
    assert len(told.made("scatter")) == (how != "taken away")
    notes = json.loads((copied / "run" / "run.json").read_text())["notes"]
    gone = [Path(source).name for source, told_of in notes.items() if GONE in told_of]
    assert gone == (["0.las"] if how == "taken away" else [])
    assert not [o for o in told.outcomes if o.stage == "scatter" and not o.made]

    found = json.loads((copied / "run" / "run.json").read_text()).get("update")
    if how == "renamed":
        assert found is None
        assert not (copied / "run" / "before").exists()
        return
    most, stages = expected.attrs["update"], expected.set_index("stage")
    made = sum(1 for o in told.outcomes if o.stage == "predict" and o.made)
    assert 0 < made < BLOCKS
    assert 0 < found["places_recomputed"] <= most["places_recomputed"] < found["places"]
    assert stages.loc["predict", "to_do"] == most["places_recomputed"]
    assert found["tiles_changed"] == (how != "taken away") <= most["tiles_changed"]
    assert found["tiles_removed"] == (how == "taken away")
    assert found["told"].startswith("map: ")
    was = (copied / "run" / "before" / "places.parquet").read_bytes()
    assert pd.read_parquet(copied / "run" / "before" / "places.parquet")["estimate"].notna().all()
    assert verify(copied / "run")[1] == []
    changed = ts.diff(copied / "run")
    assert len(changed.changed) + len(changed.added) == found["tiles_changed"]
    ts.run(wanted)  # which has nothing to do, and leaves what was before
    assert (copied / "run" / "before" / "places.parquet").read_bytes() == was


def test_a_run_that_is_killed_in_an_update_goes_on_and_keeps_what_was_before(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    was = pd.read_parquet(copied / "run" / "report" / "places.parquet")
    write_block(copied / "map", 1, 0, bare(1))
    wanted = city_job(copied / "map", copied / "run")
    config = copied / "job.yaml"
    config.write_text(json.dumps(wanted.model_dump(mode="json")))
    killed_after(1, "predict", "ts.run(sys.argv[1], watch=watch)", str(config))
    with pytest.raises(Exception, match="half-made"):
        ts.diff(copied / "run", copied / "run")
    assert command(["run", str(config), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert f"map: 1 of {BLOCKS} tiles changed" in said
    assert f"`tilestream diff {copied / 'run'}`" in said
    ts.run(city_job(copied / "map", copied / "fresh"))
    assert tables(copied / "run") == tables(copied / "fresh")
    kept = pd.read_parquet(copied / "run" / "before" / "places.parquet")
    pd.testing.assert_frame_equal(kept, was)

    found = ts.diff(copied / "run")
    assert [str(key) for key in found.changed] == ["1_0"]
    now = pd.read_parquet(copied / "run" / "report" / "places.parquet")
    grown = now["estimate"] - was["estimate"]
    assert found.worse["change"].tolist() == sorted(grown[grown > 0.02], reverse=True)
    assert found.places.better["change"].tolist() == sorted(grown[grown < -0.02])
    assert len(found.worse)
    assert (found.worse["why"] != "").all()
    assert command(["diff", str(copied / "run"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["worse_m"] == pytest.approx(found.worse["length"].sum())
    assert told["stretches"][0]["why"] == found.worse["why"].iloc[0]


# --- With drives


def test_a_map_that_changes_far_from_the_drives_trains_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    streets.write_inputs(folder)
    how: dict[str, Any] = {
        "drives": [{"log": str(folder / f"{kind}.mcap")} for kind in ("canyon", "crossing")],
        "routes": [str(folder / f"{kind}.mcap") for kind in STREETS],
    }
    ts.run(job(folder, tmp_path / "run", **how))
    streets.write_pcd(folder / "map_tunnel.pcd", streets.street("tunnel", 2, 0.3))
    told = Told()
    ts.run(job(folder, tmp_path / "run", **how), watch=told)
    for stage in ("register", "label", "factors_drive", "samples", "train", "evaluate"):
        assert told.made(stage) == set(), stage
    tiles = {int(name.split("_")[0]) for name in told.made("predict")}
    assert tiles
    assert tiles <= {7, 8, 9}  # the tunnel begins at x = 400 m; tiles are 50 m wide
    ts.run(job(folder, tmp_path / "fresh", **how))
    assert tables(tmp_path / "run") == tables(tmp_path / "fresh")


def test_a_run_that_was_never_updated_says_so(city: Path) -> None:
    with pytest.raises(UsageError, match="was not updated"):
        ts.diff(city / "run")
