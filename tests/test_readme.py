"""What the README shows works."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scenes import PLACES
from streets import job, write_drive
from streets import street as street_of
from typer.main import get_command

from tilestream.cli import run
from tilestream.cli.app import COMMANDS, app, command_of
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, flags=re.DOTALL)
JOBS = (ROOT / "pipelines" / "README.md").read_text()


def block(containing: str, blocks: list[tuple[str, str]] = BLOCKS) -> str:
    (found,) = [text for _, text in blocks if containing in text]
    return found


@pytest.fixture
def street(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the README's examples name."""
    points = PLACES["crossing"](np.random.default_rng(1), 60.0, 0.3)
    points += (12.0 - points[:, 0].mean(), 34.0 - points[:, 1].mean(), 0.0)
    write_pcd(tmp_path / "scan.pcd", points[::2])
    (tmp_path / "blocks").mkdir()
    write_las(tmp_path / "blocks" / "a.laz", points[1::2])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_python_block_runs(street: Path) -> None:
    names: dict[str, object] = {}
    exec(block("import tilestream as ts"), names)
    error = names["error"]
    assert len(error.error) == 317
    assert error.error_floor < 0.05


def test_the_drive_block_runs(
    shared_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    (tmp_path / "drive.mcap").symlink_to(shared_data / "kitti_drive" / "drive.mcap")
    monkeypatch.chdir(tmp_path)
    of_jobs = re.findall(r"```(\w+)\n(.*?)```", JOBS, flags=re.DOTALL)
    text = block("--blind-rear-deg", of_jobs).replace("\\\n", " ")
    for line in text.strip().splitlines():
        program, *arguments = line.split()
        assert program == "tilestream"
        if arguments[0] == "localize":
            arguments += ["--spacing", "12"]
        assert run(arguments) == 0
    assert "mean error" in capsys.readouterr().out


def test_the_city_block_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    write_pcd(tmp_path / "map_canyon.pcd", street_of("canyon", 1, 0.3))
    few: dict[str, object] = {"spacing": 12.0, "observe": {"starts": 16, "draws": 2, "worlds": 1}}
    routes = [str(write_drive(tmp_path / "canyon.mcap", "canyon"))]
    physics = {"drives": [], "routes": routes, "model": {"recipe": "physics"}}
    own = job(tmp_path, tmp_path / "my-city", **few, **physics).model_dump(mode="json")
    template, *others = block("tilestream template").strip().splitlines()
    assert template == "tilestream template > my-city.yaml"
    assert run(["template"]) == 0
    told = yaml.safe_load(capsys.readouterr().out)
    assert told.keys() <= own.keys()
    as_told = {name: told[name] for name in ("sensor", "label", "report")}  # others name files
    Path("my-city.yaml").write_text(yaml.safe_dump(own | as_told))
    for line in others:
        program, *arguments = line.split("#")[0].split()
        assert program == "tilestream"
        if arguments[0] == "run":
            arguments += ["--workers", "1"]
        assert run(arguments) == int("--fail-over" in arguments and over(0.25))
    assert (tmp_path / "my-city" / "report" / "index.html").is_file()


def over(limit: float) -> bool:
    estimates = pd.read_csv("my-city/report/places.csv")["estimate"]
    assert estimates.notna().all()
    return bool(estimates.max() > limit)


def test_the_map_block_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    write_las(tmp_path / "map.laz", street_of("canyon", 1, 0.3))
    line = {"type": "LineString", "coordinates": [[8.0, 0.0], [34.0, 0.0]]}
    route = {"type": "Feature", "properties": {"route_id": "street"}, "geometry": line}
    (tmp_path / "route.geojson").write_text(json.dumps(route))
    program, *arguments = block("tilestream estimate").split("#")[0].split()
    assert program == "tilestream"
    few = ["--spacing", "12", "--range-max", "14", "--workers", "1"]
    assert run([*arguments, *few]) == 0
    assert "What these estimates are worth" in capsys.readouterr().out
    assert (tmp_path / "tilestream-estimate" / "report" / "index.html").is_file()


def test_no_block_is_left_out() -> None:
    ran = {"import tilestream as ts", "tilestream estimate", "tilestream template"}
    setups = {"tilestream demo", "pytest"}
    for _, text in BLOCKS:
        assert sum(part in text for part in ran | setups) == 1


def test_every_option_in_the_text_is_one_of_a_command() -> None:
    text = re.sub(r"```.*?```", "", README + JOBS, flags=re.DOTALL)
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))
    commands = [get_command(app), *map(command_of, COMMANDS)]
    options = {option for command in commands for p in command.params for option in p.opts}
    assert {"--scheduler", "--host", "--tls-ca", "--tls-cert", "--tls-key"} <= named <= options


def test_both_commands_are_one_line_each_and_ci_runs_both() -> None:
    setups = [text for _, text in BLOCKS if "python3 -m venv" in text]
    assert [text.count("\n") for text in setups] == [1, 1]
    assert setups[0].endswith(".venv/bin/tilestream demo\n")
    assert setups[1].endswith(".venv/bin/pytest -n auto --dist loadfile\n")
    script = (ROOT / ".ci" / "run").read_text()
    (pattern,) = re.findall(r"grep '(.*)' README.md \| while read -r command", script)
    assert re.findall(f"{pattern}.*\n", README, flags=re.MULTILINE) == setups


def test_every_command_of_the_table_has_help(capsys: pytest.CaptureFixture) -> None:
    commands = re.findall(r"^\| `tilestream (\w+)", README, flags=re.MULTILINE)
    assert len(commands) >= 10
    for command in commands:
        assert run([command, "--help"]) == 0
        assert f"tilestream {command}" in capsys.readouterr().out
