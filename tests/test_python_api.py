"""What `import tilestream as ts` offers: the API and nothing else, every command as a function."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from scenes import scene

import tilestream as ts
from tilestream.cli.app import COMMANDS
from tilestream.errors import StoreNotFoundError, UsageError
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs.run_settings import read_settings

OLDER = [
    "HDL64",
    "OS1_128",
    "VLP16",
    "Cells",
    "LocalizationError",
    "LogOptions",
    "RegistrationSettings",
    "Registrations",
    "Route",
    "RunSettings",
    "ScanSelection",
    "Sensor",
    "StartSettings",
    "Tile",
    "TileKey",
    "TileStore",
    "VirtualSettings",
    "cells_of",
    "dataset",
    "disc_starts",
    "explain",
    "factors",
    "factors_along",
    "ingest",
    "localization_error",
    "localize",
    "observability",
    "observe_along",
    "open_store",
    "read_all_routes",
    "read_route",
    "read_routes",
    "refined_pose",
    "register",
    "run",
    "sample_points",
    "start_poses",
    "starts_of",
    "train_over",
    "view",
]
"""The names of before, all of which stay."""


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two maps of a street; the second has a tile more."""
    folder = tmp_path_factory.mktemp("maps")
    for name, places in (("old", [0.0]), ("new", [0.0, 40.0])):
        files = []
        for x in places:
            points = scene("canyon", 1, spacing=0.5, offset=(x, 20.0, 0.0))
            files.append(str(write_pcd(folder / f"{x:g}.pcd", points) or folder / f"{x:g}.pcd"))
        ts.ingest(files, folder / name, tile_size=40.0)
    return folder / "old", folder / "new"


def test_dir_shows_the_api_alone() -> None:
    assert dir(ts) == sorted(ts.__all__)
    assert len(set(ts.__all__)) == len(ts.__all__)
    assert set(OLDER) <= set(ts.__all__)
    assert all(getattr(ts, name) is not None for name in ts.__all__)


def test_a_star_brings_the_api_alone() -> None:
    found: dict[str, object] = {}
    exec("from tilestream import *", found)
    assert found.keys() - {"__builtins__"} == set(ts.__all__)


def test_every_name_of_the_api_says_what_it_is() -> None:
    for name in ts.__all__:
        thing = getattr(ts, name)
        assert isinstance(thing, ts.Sensor) or inspect.getdoc(thing), name


def test_every_command_is_a_function() -> None:
    assert set(COMMANDS) <= set(ts.__all__)
    assert all(inspect.isfunction(getattr(ts, name)) for name in COMMANDS)


def test_an_import_does_not_load_what_only_some_need() -> None:
    heavy = ("sklearn", "bokeh", "matplotlib", "typer", "open3d")
    code = f"import sys, tilestream; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="estimat"):
        ts.estimat  # noqa: B018


def test_status_verify_and_diff_of_maps(maps: tuple[Path, Path]) -> None:
    old, new = maps
    assert ts.status(old).whole
    read, damaged = ts.verify(new)
    assert (read > 0, damaged) == (True, [])
    found = ts.diff(old, new)
    assert (len(found.removed), len(found.changed)) == (0, 0)
    assert set(found.added) == set(ts.open_store(new).keys()) - set(ts.open_store(old).keys())
    with pytest.raises(StoreNotFoundError):
        ts.status(old.parent / "none")


def test_what_is_damaged_is_repaired(maps: tuple[Path, Path], tmp_path: Path) -> None:
    source = tmp_path / "map.pcd"
    write_pcd(source, scene("canyon", 1, spacing=0.5))
    store = ts.ingest([str(source)], tmp_path / "map", tile_size=40.0)
    key = store.keys()[0]
    chunk = max((tmp_path / "map" / str(key)).rglob("*"), key=lambda f: f.stat().st_size)
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 255
    chunk.write_bytes(content)
    _, damaged = ts.verify(tmp_path / "map")
    assert damaged
    removed, left = ts.repair(tmp_path / "map")
    assert ([d.path for d in removed], left) == ([d.path for d in damaged], [])
    assert not ts.status(tmp_path / "map").whole


def test_a_plan_is_a_table_of_stages(maps: tuple[Path, Path], tmp_path: Path) -> None:
    route = tmp_path / "route.csv"
    route.write_text("x,y,z\n2,20,0\n18,20,0\n")
    job = ts.RunSettings(
        out=str(tmp_path / "run"),
        map={"store": str(maps[0])},
        routes=[str(route)],
        model={"recipe": "physics"},
    )
    planned = ts.plan(job)
    stages = planned.set_index("stage")
    assert stages.loc["predict", "work"] == stages.loc["observe", "work"] == 17
    assert set(stages.loc["predict", "after"]) == {"factors", "observe"}
    assert (stages["promised_bytes"] > 0).all()
    assert (stages["core_hours"] >= 0.0).all()
    assert isinstance(planned.attrs["notes"], dict)
    assert not (tmp_path / "run").exists()
    with pytest.raises(UsageError):
        ts.plan(write(tmp_path / "job.yaml", "no_such_key: 1\n"))


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_the_template_is_a_job(tmp_path: Path) -> None:
    settings = read_settings(write(tmp_path / "city.yaml", ts.template()))
    assert isinstance(settings, ts.RunSettings)


def test_a_simulation_is_refused_before_it_begins(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="VII"):
        ts.simulate(tmp_path / "sim", paths=["VII"], size="small")
