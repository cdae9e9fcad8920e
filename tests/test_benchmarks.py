"""The benchmarks: each tells its options, runs at its smallest, and no document shows another."""

import argparse
import ast
import os
import re
import runpy
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from streets import write_drive

import tilestream as ts
from tilestream.cli.app import command_of
from tilestream.pipeline.jobs.run_settings import read_settings

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks"
SCRIPTS = sorted(path.name for path in FOLDER.glob("*.py") if "__main__" in path.read_text())
SHIPPED = ROOT / "tilestream" / "data"
DOCUMENTS = (FOLDER / "RESULTS.md", ROOT / "pipelines" / "README.md")
SMALLEST = (
    "coarse.py canyon.mcap --every 4 --tolerance 0.1 --range-max 14",
    "drive.py canyon.mcap --figures figures",
    "drives.py canyon.mcap --out runs --sensor VLP16 --height 2 --range 14 --set starts=16",
    "encryption.py --rounds 1 --turns 1 --tasks 10 --tiles 1",
    "factors.py --tiles 1 --literal 1 --shifts 1 --spacing 0.5",
    "figures.py --spacing 1.0 --figures figures",
    "figures_simulation.py --figures figures",
    "ingest.py --points 0.01 --repeats 1",
    "one_way.py --out one-way --paths IV --metres 20 --rays 500",
    "power_loss.py --points 300",
    "predict.py --rows 10 --share 0.05",
    "raycast.py --metres 1 --rounds 1",
    "registration.py --starts 1",
    "scale.py --tiles 1 --size 20",
    "scale.py --empty 40 --done 1 --plan 4",
    f"sendagaya.py {SHIPPED}/sendagaya_buildings.geojson.gz .",
    "shinjuku_labels.py --size small --paths III --every 40 --out labels",
    "shinjuku_labels.py --size small --paths III --every 40 --out labels --knobs drive",
    "shinjuku_routes.py .",
    "simulate.py --metres 1",
    "trust.py --blocks 1 --rounds 1",
    "update.py --edge 2 --replaced 1 --size 20 --spacing 10",
    "virtual_drive.py cost --tiles 1 --spacing 0.5",
    "walk.py",
)
OF_A_FINISHED_RUN = (
    "covariance.py retrained",
    "covariance.py retrained --drives drive",
    "experiment.py city",
    "filter.py city drive --train city --seeds 2 --train-seeds 1",
    "over_runs.py retrained --competitors physics",
    "page.py city --places 20",
    "predict.py --run city",
    "virtual_drive.py city city --every 20",
)


def started(folder: Path, script: str, *arguments: str, site: str = "") -> str:
    """What a benchmark prints, started in another folder than its own."""
    command = [sys.executable, *site.split(), str(FOLDER / script), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TILESTREAM_DATA": str(folder)}
    told = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return told.stdout


@pytest.mark.parametrize("script", SCRIPTS)
def test_what_it_imports_is_there(script: str) -> None:
    """Of the package: `--help` imports nothing, and a benchmark is run by hand only."""
    for node in ast.walk(ast.parse((FOLDER / script).read_text())):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("tilestream"):
            module = import_module(str(node.module))
            for alias in node.names:
                if not hasattr(module, alias.name):
                    import_module(f"{node.module}.{alias.name}")


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_tells_the_options_and_does_nothing_else(script: str, tmp_path: Path) -> None:
    told = started(tmp_path, script, "--help", site="-S")  # it needs no package but Python's own
    assert told.startswith(f"usage: {script}")
    assert list(tmp_path.iterdir()) == []


def test_every_benchmark_has_a_smallest_size() -> None:
    assert {line.split()[0] for line in SMALLEST + OF_A_FINISHED_RUN} == set(SCRIPTS)


def test_no_helper_of_the_benchmarks_has_the_name_of_one_of_the_tests() -> None:
    """Both folders are on the path of a benchmark."""
    assert not {p.name for p in FOLDER.glob("*.py")} & {p.name for p in ROOT.glob("tests/*.py")}


# --- What the documents show


def shown() -> list[str]:
    """The command lines in the documents' blocks, and those for Python in their text."""
    lines = []
    for document in DOCUMENTS:
        text = document.read_text().replace("\\\n", " ")
        for block in re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL):
            lines += block.strip().splitlines()
        lines += re.findall(r"`(python [^`]*)`", text)
    return sorted(set(lines))


class ParsedError(Exception):
    """The arguments were understood."""


def read_arguments(script: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a script read its command line, and stop it before it does anything.

    Raises:
        SystemExit: it does not know them.
    """
    read = argparse.ArgumentParser.parse_args

    def read_only(parser: argparse.ArgumentParser) -> None:
        read(parser)
        raise ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", read_only)
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(ParsedError):
        runpy.run_path(str(ROOT / script), run_name="__main__")


@pytest.mark.parametrize("line", shown())
def test_every_command_that_is_shown_is_known(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *arguments = shlex.split(line.split(" > ", maxsplit=1)[0], comments=True)
    if program == "python":
        read_arguments(arguments[0], arguments[1:], monkeypatch)
    elif program == "pytest":
        files = [ROOT / name for name in arguments if name.endswith(".py")]
        assert files
        assert all("pytest.mark.slow" in file.read_text() for file in files)
    elif program == "tilestream":
        name, *rest = arguments
        given = command_of(name).make_context(name, rest).params
        if name == "run":
            read_settings(ROOT / given["config"], given["changes"] or ())
    else:
        assert program == "cp"


def test_an_unknown_option_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in (["--tile", "4x"], ["--no-such-option"]):
        with pytest.raises(SystemExit):
            read_arguments("benchmarks/scale.py", wrong, monkeypatch)


# --- At their smallest


@pytest.mark.slow
@pytest.mark.parametrize("line", SMALLEST)
def test_the_smallest_size_runs(line: str, tmp_path: Path) -> None:
    if line.startswith("raycast.py"):
        reason = "Open3D, the other caster, cannot be loaded"
        pytest.importorskip("open3d", reason=reason, exc_type=ImportError)
    write_drive(tmp_path / "canyon.mcap", "canyon")
    assert re.search(r"\d", started(tmp_path, *shlex.split(line)))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of each pipeline, as small as a benchmark can read."""
    folder = tmp_path_factory.mktemp("runs")
    log = write_drive(folder / "canyon.mcap", "canyon")
    few = [
        "label.starts={radius: 0.4, step: 0.2}",
        "observe.starts=16",
        "observe.draws=2",
        "observe.worlds=1",
    ]
    city = [f"out={folder}/city", "simulate.size=small", "simulate.paths=[I, III]", "spacing=2"]
    ts.run(read_settings(ROOT / "pipelines" / "shinjuku.yaml", city + few))
    seen = f"{{log: {log}, every: 2, offset: 1}}"
    blind = f"{{log: {log}, every: 2, offset: 1, name: blind, blind_rear_deg: 120}}"
    drive = [f"out={folder}/drive", f"map.sources=[{log}]", f"drives=[{seen}, {blind}]"]
    physics = ["model.use=null", "model.recipe=physics"]
    ts.run(read_settings(ROOT / "pipelines" / "drive.yaml", drive + few + physics))
    retrained = folder / "retrained" / "runs"
    retrained.mkdir(parents=True)
    (retrained / "shinjuku-paper-0-VLP16-2m-autoware").symlink_to(folder / "city")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("line", OF_A_FINISHED_RUN)
def test_the_tables_of_a_finished_run_are_printed(line: str, runs: Path) -> None:
    assert re.search(r"\d", started(runs, *shlex.split(line)))
