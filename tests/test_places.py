"""A path means one thing: each place has one spelling, whoever names it, and however."""

import json
import uuid
from pathlib import Path

import numpy as np
import pytest
import streets
from hypothesis import given
from hypothesis import strategies as st

import tilestream as ts
from tilestream.apps.verify import verify
from tilestream.cli import run as command
from tilestream.errors import LockedError, UsageError
from tilestream.files import Files, local_path, place_of
from tilestream.formats import expand_sources, open_source
from tilestream.formats.logs import open_log
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import read_routes
from tilestream.lock import only_writer
from tilestream.model.file import load_model
from tilestream.pipeline.jobs.run_folder import map_of, rows_of
from tilestream.pipeline.jobs.run_settings import RunSettings


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the process works in, which is also the user's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    return Path.cwd()


def names_in(folder: Path) -> list[str]:
    """What lies there, but for caches of libraries."""
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


@pytest.mark.parametrize(
    "spelling",
    [
        "a/b",
        "./a/b",
        "a//b/",
        "a/c/../b",
        "~/a/b",
        "{here}/a/b",
        "file://{here}/a/b",
        "file:{here}/a/b",
        "file://localhost{here}/a/b/",
        "FILE://{here}/a/b",
        "local://{here}/a/b",
        "file://~/a/b",
    ],
)
def test_a_local_place_has_one_spelling(spelling: str, here: Path) -> None:
    named = spelling.format(here=here)
    assert place_of(named) == str(here / "a" / "b")
    assert Files.at(named).root == Files.at(named).address == str(here / "a" / "b")
    assert place_of(local_path(named)) == str(here / "a" / "b")


@given(st.lists(st.sampled_from(["a", "b", ".", "..", "x y", "é", "*", "[0-9]"]), min_size=1))
def test_a_spelling_is_its_own(parts: list[str]) -> None:
    place = place_of("/".join(parts))
    assert place == place_of(place) == place_of(f"file://{place}")
    assert Path(place).is_absolute()
    assert ".." not in Path(place).parts


def test_a_step_up_from_a_link_is_where_the_system_says(here: Path) -> None:
    (here / "far" / "away").mkdir(parents=True)
    (here / "link").symlink_to(here / "far" / "away")
    Path("link/../x").mkdir()
    assert place_of("link/../x") == str(here / "far" / "x")
    assert place_of("link/x") == str(here / "link" / "x")


@pytest.mark.parametrize("url", ["memory://a/b", "s3://bucket/a", "simplecache::s3://bucket/a"])
def test_a_url_stays_what_it_is(url: str) -> None:
    assert place_of(url) == place_of(f"{url}/") == url
    with pytest.raises(UsageError, match="copy it here"):
        local_path(url)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nowhere://a/b", "nowhere:// is no protocol"),
        (Path("s3://bucket/map.zarr"), "lost a slash: give s3://"),
        ("memory:/a", "lost a slash: give memory://"),
    ],
)
def test_what_is_no_place_is_refused_and_makes_no_folder(
    url: str, said: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pcd(here / "a.pcd", np.eye(3))
    for refused in (
        lambda: place_of(url),
        lambda: ts.ingest(here / "a.pcd", url),
        lambda: ts.open_store(url),
        lambda: RunSettings(out=str(url), map={"sources": ["a.pcd"]}, routes=["r.csv"]),
    ):
        with pytest.raises(UsageError, match=said):
            refused()
    assert command(["ingest", "a.pcd", "--store", str(url)]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert names_in(here) == ["a.pcd"]


def test_a_store_is_one_by_all_its_names(here: Path) -> None:
    write_pcd(here / "a.pcd", np.eye(3))
    store = ts.ingest("file://" + str(here / "a.pcd"), f"file://{here}/map.zarr", map_leaf=0.0)
    for name in ("map.zarr", "~/map.zarr", f"local://{here}/map.zarr", here / "map.zarr"):
        assert ts.open_store(name).url == store.url == str(here / "map.zarr")
    with only_writer("map.zarr"), pytest.raises(LockedError):
        ts.ingest("a.pcd", f"file://{here}/map.zarr", map_leaf=0.0)
    assert names_in(here) == ["a.pcd", "map.zarr"]
    assert [source["path"] for source in store.sources()] == [str(here / "a.pcd")]


def test_settings_are_made_absolute_where_they_enter(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = RunSettings(
        out="run",
        map={"sources": ["~/a/*.pcd"], "store": f"file://{here}/map.zarr"},
        drives=[{"log": "d.mcap"}],
        routes=["./r.csv"],
    )
    monkeypatch.chdir("/")
    assert settings.out == str(here / "run")
    assert settings.map.sources == (str(here / "a" / "*.pcd"),)
    assert settings.store_url == str(here / "map.zarr")
    assert settings.drives[0].log == str(here / "d.mcap")
    assert settings.routes == (str(here / "r.csv"),)


@pytest.mark.parametrize("read", [open_source, expand_sources, read_routes, open_log])
def test_a_source_elsewhere_is_to_be_copied_here(read: object) -> None:
    with pytest.raises(UsageError, match=r"s3://bucket/a\.mcap is not on this machine.*copy it"):
        read("s3://bucket/a.mcap")


@pytest.mark.parametrize(
    "arguments",
    [
        ["ingest", "memory://a.pcd", "--store", "map.zarr"],
        ["info", "memory://a.pcd"],
        ["localize", "map.zarr", "memory://a.mcap", "--out", "run"],
        ["run", "memory://job.yaml"],
    ],
)
def test_a_command_says_so_in_a_line(
    arguments: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(arguments) == 2
    assert "copy it here" in capsys.readouterr().err.replace("\n", " ")
    assert names_in(here) == []


def a_job_on(url: str, inputs: Path) -> RunSettings:
    """A job without drives: a map, a route, the virtual drive as it is."""
    streets.write_inputs(inputs)
    (inputs / "r.csv").write_text("x,y\n8,0\n14,0\n")
    return RunSettings(
        out=url,
        map={"sources": [str(inputs / "map_canyon.pcd")], "tile_size": 50.0},
        routes=[str(inputs / "r.csv")],
        observe={"starts": 8, "draws": 2, "worlds": 1},
        model={"recipe": "physics"},
    )


def the_job_is_there(settings: RunSettings, capsys: pytest.CaptureFixture[str]) -> None:
    url = settings.out
    assert ts.run(settings) == url
    record = json.loads(Files.at(url).under("run.json").read())
    assert record["state"] == "done"
    assert {"config.yaml", "report/index.html", "report/places.csv"} <= set(record["files"])
    estimates = rows_of(url, "predictions")
    assert len(estimates) == 7
    assert estimates["estimate"].notna().all()
    assert map_of(url).url == Files.at(f"{url}/map.zarr").address
    read, damaged = verify(url)
    assert read > 10
    assert damaged == []
    Files.at(url).under("report/places.csv").write(b"other")
    assert len(verify(url)[1]) == 1
    assert command(["diff", url, url]) == 0
    assert "7" in capsys.readouterr().out


def test_a_bucket_that_is_misspelt_is_not_made(here: Path, s3_bucket: str) -> None:
    other = f"{s3_bucket}-misspelt"
    settings = a_job_on(f"{other}/run", here)
    with pytest.raises(UsageError, match="create it first"):
        ts.run(settings)
    with pytest.raises(UsageError, match="create it first"):
        ts.ingest(settings.map.sources, f"{other}/map.zarr")
    assert not Files.at(other).there()
    with pytest.raises(UsageError, match="nothing is there"):
        ts.info(f"{s3_bucket}/nosuch.zarr")


def test_a_run_directory_in_an_object_store(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = a_job_on(f"memory://{uuid.uuid4().hex}/run", here)
    before = names_in(here)
    the_job_is_there(settings, capsys)
    assert names_in(here) == before


def test_a_run_directory_on_s3(
    here: Path, s3_bucket: str, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = a_job_on(f"{s3_bucket}/city/run", here)
    before = names_in(here)
    the_job_is_there(settings, capsys)
    gate = ["run", str(here / "job.yaml"), "--workers", "2", "--fail-over", "0.000001"]
    other = settings.model_dump(mode="json") | {"spacing": 2.0}  # so that workers have work
    (here / "job.yaml").write_text(json.dumps(other))
    assert command(gate) == 1
    assert "sample points without an estimate" in capsys.readouterr().err
    assert Files.at(f"{settings.out}/dask-performance.html").there()
    assert names_in(here) == sorted([*before, "job.yaml"])


def test_a_city_is_simulated_to_a_disk(here: Path) -> None:
    settings = RunSettings(out="memory://x/run", simulate={"size": "small"})
    with pytest.raises(UsageError, match=r"give simulate\.folder"):
        ts.run(settings)
    assert names_in(here) == []


def test_a_model_in_an_object_store(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such model file"):
        load_model(f"memory://{uuid.uuid4().hex}/model.skops")


def test_an_object_store_that_nobody_serves_is_told_in_a_line(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    s3fs = pytest.importorskip("s3fs", reason="needs the extra s3")
    write_pcd(here / "a.pcd", np.eye(3))
    for name, value in {
        "AWS_ENDPOINT_URL": "http://127.0.0.1:9",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_MAX_ATTEMPTS": "1",
        "NO_PROXY": "127.0.0.1",
    }.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    try:
        assert command(["ingest", "a.pcd", "--store", "s3://bucket/map.zarr"]) == 1
    finally:
        s3fs.S3FileSystem.clear_instance_cache()
    told = " ".join(capsys.readouterr().err.split())
    assert told.startswith("error: ")
    assert "s3://bucket/map.zarr" in told
    assert "cannot be reached (EndpointConnectionError" in told


def test_an_empty_path_is_refused(here: Path) -> None:
    for refused in (lambda: place_of(""), lambda: RunSettings(out="", routes=["r.csv"])):
        with pytest.raises(UsageError, match="a path is empty"):
            refused()
