"""One bad thing does not stop the good ones, and a file is one whatever its names."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import streets
from streets import job

import tilestream as ts
from tilestream.cli import run as command
from tilestream.errors import PartialError, SourceError, SourceNotFoundError
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import read_all_routes, read_each
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run_inputs import inputs_of, reading_of
from tilestream.pipeline.jobs.run_plan import plan_measure
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.settings import DriveSettings
from tilestream.store.record import read_record, write_record

UNREADABLE = Path("/proc/self/mem")
"""A file that opens and cannot be read at its begin, whoever asks (Linux)."""


def unreadable(path: Path) -> Path:
    if not UNREADABLE.exists():
        pytest.skip("needs Linux")
    path.symlink_to(UNREADABLE)
    return path


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    """A folder of two good clouds among what is none."""
    folder = tmp_path / "clouds"
    folder.mkdir()
    for number in range(2):
        write_pcd(folder / f"good_{number}.pcd", np.eye(3) + 20.0 * number)
    return folder


def test_a_glob_lists_what_is_no_file_and_reads_the_rest(clouds: Path, tmp_path: Path) -> None:
    (clouds / "gone.pcd").symlink_to(tmp_path / "nowhere.pcd")
    (clouds / "loop.pcd").symlink_to("loop.pcd")
    (clouds / "folder.pcd").mkdir()
    (clouds / "between").mkdir()  # a folder that nobody takes for a file
    unreadable(clouds / "mem.pcd")
    with pytest.raises(PartialError) as told:
        ts.ingest(clouds / "*", tmp_path / "map.zarr", map_leaf=0.0)
    names = {Path(path).name: reason for path, reason in told.value.failures.items()}
    assert set(names) == {"gone.pcd", "loop.pcd", "folder.pcd", "mem.pcd"}
    assert "a link to" in names["gone.pcd"]
    assert "a directory" in names["folder.pcd"]
    assert "error" in names["mem.pcd"]
    store = ts.open_store(tmp_path / "map.zarr")
    assert sum(source["points"] for source in store.sources()) == 6
    arguments = ["ingest", str(clouds / "*.pcd"), "--store", str(tmp_path / "map.zarr")]
    assert command([*arguments, "--map-leaf", "0"]) == 1


def test_a_plan_lists_what_would_be_left_out(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (clouds / "gone.pcd").symlink_to(tmp_path / "nowhere.pcd")
    arguments = ["ingest", str(clouds / "*.pcd"), "--store", str(tmp_path / "map.zarr")]
    assert command([*arguments, "--dry-run"]) == 1
    told = capsys.readouterr()
    assert "scatter" in told.out
    assert "gone.pcd" in told.err
    assert not (tmp_path / "map.zarr").exists()
    (tmp_path / "r.csv").write_text("x,y\n0,0\n9,0\n")
    settings = RunSettings(
        out=str(tmp_path / "run"),
        map={"sources": [str(clouds / "*.pcd")]},
        routes=[str(tmp_path / "r.csv")],
        model={"recipe": "physics"},
    )
    notes = forecast(settings).notes
    assert sum("gone.pcd is left out: " in note for note in notes["plan"]) == 1


def test_a_source_of_many_names_is_read_once_and_that_is_said(
    clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(clouds)
    (clouds / "link.pcd").symlink_to("good_0.pcd")
    good = clouds / "good_0.pcd"
    names = [good, "./good_0.pcd", "../clouds/good_0.pcd", f"file://{good}", "link.pcd"]
    store = ts.ingest(names, tmp_path / "map.zarr", map_leaf=0.0)
    (source,) = store.sources()
    assert source["points"] == 3
    assert source["notes"][-1] == f"named 5 times, also as {clouds / 'link.pcd'}: read once"
    before = made(tmp_path / "map.zarr")
    again = ts.ingest("link.pcd", tmp_path / "map.zarr", map_leaf=0.0)
    assert made(tmp_path / "map.zarr") == before, "it is known by any of its names"
    assert again.sources() == [source | {"path": str(clouds / "link.pcd")}]


def made(path: Path) -> dict[str, int]:
    """When each file below was written, but for the root of a store, which says where sources are
    now.
    """
    return {
        str(file.relative_to(path)): file.stat().st_mtime_ns
        for file in path.rglob("*")
        if file.is_file() and file.name != ".lock" and file.parent.suffix != ".zarr"
    }


def test_a_map_that_moved_with_its_sources_is_not_made_again(clouds: Path, tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    clouds.rename(tmp_path / "old" / "clouds")
    ts.ingest(tmp_path / "old" / "clouds" / "*.pcd", tmp_path / "old" / "map.zarr")
    before = made(tmp_path / "old")
    (tmp_path / "old").rename(tmp_path / "new")
    store = ts.ingest(tmp_path / "new" / "clouds" / "*.pcd", tmp_path / "new" / "map.zarr")
    assert made(tmp_path / "new") == before
    assert [Path(s["path"]).parent for s in store.sources()] == [tmp_path / "new" / "clouds"] * 2
    assert command(["verify", str(tmp_path / "new" / "map.zarr")]) == 0
    (tmp_path / "new").rename(tmp_path / "newest")
    ts.ingest(tmp_path / "newest" / "clouds" / "*.pcd", tmp_path / "newest" / "map.zarr")
    assert made(tmp_path / "newest") == before


def test_a_map_that_moved_without_its_sources_knows_them(clouds: Path, tmp_path: Path) -> None:
    ts.ingest(clouds / "*.pcd", tmp_path / "map.zarr")
    (tmp_path / "elsewhere").mkdir()
    before = made(tmp_path / "map.zarr")
    (tmp_path / "map.zarr").rename(tmp_path / "elsewhere" / "map.zarr")
    store = ts.ingest(clouds / "*.pcd", tmp_path / "elsewhere" / "map.zarr")
    assert made(Path(store.url)) == before
    assert [Path(source["path"]).parent for source in store.sources()] == [clouds, clouds]
    clouds.rename(tmp_path / "away")  # the sources without the store
    store = ts.ingest(tmp_path / "away" / "*.pcd", store.url)
    assert made(Path(store.url)) == before
    assert {Path(s["path"]).parent for s in store.sources()} == {tmp_path / "away"}
    write_pcd(tmp_path / "away" / "good_0.pcd", np.eye(3))
    shutil.move(tmp_path / "away", tmp_path / "again")  # of the old file nothing is left anywhere
    store = ts.ingest(tmp_path / "again" / "*.pcd", store.url)
    fresh = ts.ingest(tmp_path / "again" / "*.pcd", tmp_path / "fresh.zarr")
    assert (store.identities(), store.sources()) == (fresh.identities(), fresh.sources())


def test_a_record_of_before_is_read(clouds: Path, tmp_path: Path) -> None:
    """Without the way from the store to a source."""
    store = ts.ingest(clouds / "*.pcd", tmp_path / "map.zarr")
    record = read_record(store.url)
    older = [{name: s[name] for name in s if name != "way"} for s in record.sources]
    assert older != list(record.sources)
    write_record(store.files, replace(record, sources=older))
    assert store.sources() == older
    before = made(Path(store.url))
    assert ts.ingest(clouds / "*.pcd", store.url).sources() == older
    assert made(Path(store.url)) == before
    write_record(store.files, replace(record, sources=older))
    clouds.rename(tmp_path / "away")
    ts.ingest(tmp_path / "away" / "*.pcd", store.url)
    assert made(Path(store.url)) == before


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    streets.write_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def store(inputs: Path) -> ts.TileStore:
    return ts.ingest(inputs / "map_*.pcd", inputs / "map.zarr", tile_size=50.0)


def planned(settings: RunSettings, store: ts.TileStore) -> Plan:
    read = inputs_of(settings, None, None)
    return plan_measure(settings, read, MapPlan.of_store(store, partial=False))


def test_a_drive_that_cannot_be_read_is_listed_and_the_others_are_measured(
    inputs: Path, store: ts.TileStore, tmp_path: Path
) -> None:
    unreadable(tmp_path / "mem.mcap")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "empty.mcap").touch()
    shutil.copy(inputs / "canyon.mcap", tmp_path / "far.mcap")
    bad = [{"log": str(tmp_path / f"{name}.mcap")} for name in ("mem", "folder", "empty")]
    good = {"log": str(inputs / "canyon.mcap")}
    where = {"map": {"store": store.url}, "routes": [str(inputs / "canyon.mcap")]}
    settings = job(inputs, tmp_path / "run", drives=[*bad, good], **where)
    plan = planned(settings, store)
    assert set(plan.left_out) == {"drive mem", "drive folder", "drive empty"}
    assert {task.name.split("-")[0] for task in plan.outputs("label")} == {"canyon"}
    alone = job(inputs, tmp_path / "run", drives=bad, **where)
    with pytest.raises(SourceError, match=r"no drive is left .*recipe: physics"):
        planned(alone, store)
    with pytest.raises(SourceNotFoundError):
        planned(job(inputs, tmp_path / "run", drives=[{"log": "no.mcap"}, good], **where), store)


def test_a_job_with_a_bad_drive_ends_with_one_and_says_which(
    inputs: Path, store: ts.TileStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "r.csv").write_text("x,y\n8,0\n12,0\n")
    settings = RunSettings(
        out=str(tmp_path / "run"),
        map={"store": store.url},
        drives=[{"log": str(tmp_path / "empty.mcap")}, {"log": str(inputs / "canyon.mcap")}],
        routes=[str(tmp_path / "r.csv")],
        observe={"starts": 8, "draws": 2, "worlds": 1},
        label={"matcher": "default", "starts": {"radius": 0.2, "step": 0.2}},
        model={"recipe": "physics"},
    )
    (tmp_path / "job.yaml").write_text(json.dumps(settings.model_dump(mode="json")))
    assert command(["run", str(tmp_path / "job.yaml"), "--workers", "1"]) == 1
    assert "drive empty" in capsys.readouterr().err
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(record["failures"]) == ["drive empty"]
    assert (tmp_path / "run" / "report" / "index.html").exists()
    labels = sorted((tmp_path / "run" / "tables" / "errors" / "canyon").iterdir())
    (tmp_path / "damaged.mcap").touch()
    shutil.copy(inputs / "canyon.mcap", tmp_path / "other.mcap")
    gone = [DriveSettings(log=str(tmp_path / "damaged.mcap"), name="canyon")]
    other = DriveSettings(log=str(tmp_path / "other.mcap"), until_s=1.0)
    with pytest.raises(PartialError):
        ts.run(settings.model_copy(update={"drives": (*gone, other)}))
    assert sorted((tmp_path / "run" / "tables" / "errors" / "canyon").iterdir()) == labels
    shutil.rmtree(tmp_path / "run" / "tables" / "errors" / "other")
    assert list((tmp_path / "run" / "tables" / "errors").iterdir()) == [
        tmp_path / "run" / "tables" / "errors" / "canyon"
    ]


def test_a_drive_of_two_names_is_measured_once(
    inputs: Path, store: ts.TileStore, tmp_path: Path
) -> None:
    (tmp_path / "link.mcap").symlink_to(inputs / "canyon.mcap")
    log = str(inputs / "canyon.mcap")
    again = [{"log": f"file://{log}"}, {"log": str(tmp_path / "link.mcap")}]
    other = {"log": log, "range_max": 9.0, "name": "short"}
    settings = job(
        inputs, tmp_path / "run", drives=[{"log": log}, *again, other], map={"store": store.url}
    )
    read = inputs_of(settings, None, None)
    assert [drive.group for drive in read.drives] == ["canyon", "short"]
    assert [route.route_id for route in read.routes] == ["canyon"]
    assert sum("is drive canyon again" in note for note in read.notes["job"]) == 2


def test_a_drive_that_moved_is_not_measured_again(inputs: Path, tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    shutil.copy(inputs / "canyon.mcap", old)
    before = reading_of(DriveSettings(log=str(old / "canyon.mcap"))).state
    old.rename(new)
    moved = DriveSettings(log=str(new / "canyon.mcap"))
    assert reading_of(moved).state == before
    shutil.copy(inputs / "tunnel.mcap", new / "canyon.mcap")
    assert reading_of(moved).state != before


def test_routes_that_cannot_be_read_are_listed(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("x,y\n0,0\n9,0\n")
    (tmp_path / "link.csv").symlink_to("r.csv")
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "odd.xyz").write_text("0 0\n")
    unreadable(tmp_path / "mem.csv")
    names = ["r.csv", "./r.csv", "link.csv", "folder.csv", "odd.xyz", "mem.csv"]
    read = read_each([(str(tmp_path / name), {}) for name in names], read_all_routes)
    assert [route.route_id for route in read.routes] == ["r"]
    assert set(read.failures) == {"route folder", "route odd", "route mem"}
    assert sum("read once" in note for note in read.notes) == 2
    with pytest.raises(SourceError, match="a directory"):
        read_each([(str(tmp_path / "folder.csv"), {})], read_all_routes)
    with pytest.raises(SourceNotFoundError):
        read_each([(str(tmp_path / n), {}) for n in ("r.csv", "no.csv")], read_all_routes)


def test_a_route_given_twice_is_evaluated_once(
    store: ts.TileStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "r.csv").write_text("x,y\n8,0\n12,0\n")
    twice = ["--route", str(tmp_path / "r.csv"), "--route", f"file://{tmp_path}/r.csv"]
    out = ["--out", str(tmp_path / "out"), "--json"]
    assert command(["factors", store.url, *twice, *out]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["sample_points"] == 5
    assert "read once" in str(told["notes"])


def test_a_project_that_moved_has_nothing_to_do_again(inputs: Path, tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    shutil.copy2(inputs / "map_canyon.pcd", tmp_path / "old")
    shutil.copy2(inputs / "canyon.mcap", tmp_path / "old")
    (tmp_path / "old" / "r.csv").write_text("x,y\n8,0\n12,0\n")

    def worked(folder: Path) -> list[str]:
        """What a run does in a folder."""
        settings = RunSettings(
            out=str(folder / "run"),
            map={"sources": [str(folder / "*.pcd")], "tile_size": 50.0},
            drives=[{"log": str(folder / "canyon.mcap"), "until_s": 4.0}],
            routes=[str(folder / "r.csv")],
            observe={"starts": 8, "draws": 2, "worlds": 1},
            label={"matcher": "default", "starts": {"radius": 0.2, "step": 0.2}},
            model={"recipe": "physics"},
        )
        did: list[str] = []
        ts.run(
            settings, watch=lambda outcome, *_: did.append(outcome.key) if outcome.made else None
        )
        return did

    assert len(worked(tmp_path / "old")) > 10
    assert worked(tmp_path / "old") == []
    (tmp_path / "old").rename(tmp_path / "new")
    assert worked(tmp_path / "new") == []
