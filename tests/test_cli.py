"""The commands: what they print, what they exit with, one clear line for each error."""

import io
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import logs
import numpy as np
import psutil
import pytest
import zarr
from elsewhere import certificates, scheduler_elsewhere
from logs import START, pose
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from patience import PATIENCE
from points import write_ply
from rich.console import Console
from scenes import PLACES, in_map
from scipy.spatial.transform import Rotation

import tilestream as ts
from tilestream.cli import fields, run
from tilestream.cli.app import COMMANDS, command_of
from tilestream.cli.printing import err
from tilestream.cli.progress import progress
from tilestream.errors import UsageError
from tilestream.formats.logs import open_log
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.cluster import TlsFiles
from tilestream.pipeline.jobs.run_inputs import inputs_of, read_map
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.settings import bytes_of

Told = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    return in_map(PLACES["canyon"](np.random.default_rng(1), 40.0, 0.3))


@pytest.fixture(scope="module")
def pcd(cloud: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pcd") / "street.pcd"
    write_pcd(path, cloud)
    return path


@pytest.fixture(scope="module")
def store(pcd: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    url = str(tmp_path_factory.mktemp("store") / "map.zarr")
    ts.ingest(pcd, url, tile_size=20.0)
    return url


@pytest.fixture(scope="module")
def log(cloud: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five scans along the street, and one of too few points."""
    messages: list[logs.Message] = []
    for i in range(6):
        stamp, T = START + i * logs.SECOND, pose(x=10.0 + 3.0 * i, z=2.0)
        seen = (cloud - T[:3, 3])[i::5]
        seen = seen[np.linalg.norm(seen, axis=1) < 15.0]
        messages.append(logs.odometry_at(stamp, T))
        messages.append(logs.cloud_at(stamp, seen if i < 5 else seen[:4]))
    path = tmp_path_factory.mktemp("log") / "drive.mcap"
    return logs.write(path, messages, chunk_size=20_000)


def fails(arguments: list[str], code: int, told: Told) -> str:
    """The error line of a command that must end with this code, and without a traceback."""
    told.readouterr()
    assert run(arguments) == code
    error = told.readouterr().err
    assert "Traceback" not in error
    (line,) = [line for line in error.splitlines() if line.startswith("error: ")]
    return line


def damaged(path: Path, target: Path, **change: Any) -> Path:
    """A copy with its end cut off (`keep`, a share), or with a byte flipped (`flip`, an offset)."""
    content = bytearray(path.read_bytes())
    if "flip" in change:
        content[change["flip"]] ^= 0x40
    target.write_bytes(content[: int(len(content) * change.get("keep", 1.0))])
    return target


# --- The program


def test_help_names_every_command(capsys: Told) -> None:
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    for command in ("ingest", "status", "info", "localize", "demo"):
        assert command in shown
        assert run([command, "--help"]) == 0
        assert "Usage" in capsys.readouterr().out
    assert run(["ingest", "--help"]) == 0
    assert "Edge of a tile [m]" in capsys.readouterr().out


def test_the_list_of_commands_says_what_each_says_of_itself() -> None:
    for name, (_, told) in COMMANDS.items():
        assert command_of(name).help.split("\n\n")[0] == told


def test_options_are_grouped_with_the_usual_ones_first(capsys: Told) -> None:
    assert run(["estimate", "--help"]) == 0
    shown = capsys.readouterr().out
    first = shown[: shown.index(fields.PLACES)]
    assert all(f"{name} " in first for name in ("--route", "--sensor", "--matcher", "--out"))
    at = [
        shown.index(heading)
        for heading in (
            fields.PLACES,
            fields.MAP,
            fields.LOGS,
            fields.REPORT,
            fields.GATE,
            fields.TASKS,
        )
    ]
    assert at == sorted(at)
    options = {p.name for name in COMMANDS for p in command_of(name).params}
    assert set(fields.PANELS) <= options, "no heading for what no command has"


def test_the_list_of_commands_comes_without_what_they_need() -> None:
    heavy = "{'numpy', 'pandas', 'dask', 'sklearn', 'bokeh', 'matplotlib'} & set(sys.modules)"
    code = f"import sys; from tilestream.cli import run; run(['--help']); sys.exit(bool({heavy}))"
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert listed.returncode == 0
    assert all(name in listed.stdout.decode() for name in COMMANDS)


def test_without_a_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    clock = iter([0.0, 1.0, 31.0, 31.0, 50.0, 62.0, 62.0])
    # not time.monotonic itself, which Dask's event loop in another thread asks too
    own = SimpleNamespace(monotonic=lambda: next(clock))
    monkeypatch.setattr("tilestream.cli.progress.time", own)
    with progress() as watch:
        for stage, ended in (("merge", 1), ("cells", 1), ("cells", 2), ("cells", 3)):
            watch(Outcome(f"{stage}-{ended}", stage), ended, 3)
    assert capsys.readouterr().err == "merge 1/3, cells 1/3\ncells 3/3\n"


def test_on_a_terminal_progress_shows_at_once_that_it_lives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=100)
    monkeypatch.setattr("tilestream.cli.progress.err", screen)
    with progress() as watch:
        began = screen.file.getvalue()
        watch(Outcome("merge-1", "merge", reason="no space left"), 1, 2)
    assert "starting" in began
    shown = screen.file.getvalue()
    assert "merge-1: no space left" in shown
    assert "starting" not in shown.split("no space left")[1]
    assert "1/2" in shown


def test_version_is_that_of_the_package(capsys: Told) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == ts.__version__


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["ingest"],
        ["ingest", "a.pcd"],
        ["ingest", "a.pcd", "--store", "m.zarr", "--tile-size", "wide"],
        ["ingest", "a.pcd", "--store", "m.zarr", "--workers", "0"],
        ["localize", "map.zarr", "drive.mcap"],
        ["localize", "map.zarr", "drive.mcap", "--out", "run", "--matcher", "magic"],
        ["status"],
        ["info", "a.pcd", "--colour"],
        ["ingest", "a.pcd", "--store", "m.zarr", "--workers", "2", "--tls-ca", "no.pem"],
    ],
)
def test_a_line_that_is_no_command_exits_with_2(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_traceback_only_with_debug(tmp_path: Path, capsys: Told) -> None:
    arguments = ["status", str(tmp_path / "none.zarr")]
    assert run(arguments) == 2
    plain = capsys.readouterr()
    assert run([*arguments, "--debug"]) == 2
    debug = capsys.readouterr()
    assert plain.out == ""
    assert plain.err.startswith(f"error: {tmp_path}/none.zarr: no tile store")
    assert plain.err.count("\n") == 1
    assert "Traceback" not in plain.err
    assert "Traceback" in debug.err
    assert plain.err in debug.err


@pytest.fixture
def bad_log(log: Path, tmp_path: Path) -> Path:
    """A log cut short, of which a note says so."""
    return damaged(log, tmp_path / "cut.mcap", keep=0.6)


@pytest.mark.parametrize("before", [False, True])
def test_quiet_leaves_results_and_errors(
    before: bool, bad_log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    line = ["localize", store, str(bad_log), "--radius", "0.4", "--json"]
    assert run([*line, "--out", str(tmp_path / "told")]) == 0
    told = capsys.readouterr()
    assert "note: " in told.err
    quietly = ["--quiet", *line] if before else [*line, "--quiet"]
    assert run([*quietly, "--out", str(tmp_path / "quiet")]) == 0
    quiet = capsys.readouterr()
    assert quiet.out == told.out
    assert "cut short" in quiet.out  # what was noticed is in the JSON
    assert quiet.err == ""
    assert run([*quietly, "--out", str(bad_log)]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert run([*line, "--out", str(tmp_path / "told")]) == 0
    assert "note: " in capsys.readouterr().err  # it was for that line alone


@pytest.mark.parametrize(
    ("options", "levels"),
    [
        ([], {"INFO", "WARNING", "ERROR"}),
        (["--quiet"], {"ERROR"}),
        (["--log-level", "debug"], {"DEBUG", "INFO", "WARNING", "ERROR"}),
        (["--log-level=error"], {"ERROR"}),
        (["--quiet", "--log-level", "warning"], {"WARNING", "ERROR"}),
    ],
)
def test_log_lines_are_shown_from_a_level_on(
    options: list[str],
    levels: set[str],
    pcd: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def logged(*_: object) -> None:
        for level in ("DEBUG", "INFO", "WARNING", "ERROR"):
            logging.getLogger("tilestream.apps").log(getattr(logging, level), "x")
        raise UsageError("enough")

    monkeypatch.setattr("tilestream.apps.info.info", logged)
    assert run(["info", str(pcd), *options]) == 2
    assert {record.levelname for record in caplog.records} == levels
    assert run(["info", str(pcd), "--log-level", "loud"]) == 2


def test_an_interrupt_is_told_in_one_line(
    pcd: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tilestream.apps.info.info", interrupted)
    assert run(["info", str(pcd)]) == 130
    told = capsys.readouterr().err.strip()
    assert told == "stopped; the same command continues where it was"


@pytest.mark.parametrize("whole_group", [False, True])
def test_a_run_that_is_terminated_says_so_and_takes_its_workers_along(
    whole_group: bool, tmp_path: Path
) -> None:
    """Batch systems send the signal to the workers too."""
    job = tmp_path / "job.yaml"
    job.write_text(f"out: {tmp_path}/run\nsimulate: {{size: small, paths: [III]}}\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "tilestream", "run", job, "--workers", "2"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    assert any(line.startswith("Watch it at") for line in process.stderr)  # the workers are there
    book = tmp_path / "run" / "run.json"
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    if whole_group:
        os.killpg(process.pid, signal.SIGTERM)
    else:
        process.terminate()
    _, told = process.communicate()
    assert process.returncode == 143
    assert told.splitlines()[-1] == "stopped; the same command continues where it was"
    assert "Traceback" not in told
    assert json.loads(book.read_text())["state"] == "stopped"
    assert json.loads(book.read_text())["stopped_by"] == "SIGTERM"
    assert not psutil.wait_procs(workers, timeout=PATIENCE)[1]


def test_a_request_to_end_is_heard_while_errors_are_ignored() -> None:
    """An error raised in a callback of the garbage collector is ignored by Python."""
    script = """
import gc, os, signal, sys, time
from tilestream.cli import app

def asked(phase, info):
    gc.callbacks.remove(asked)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)
    raise AssertionError("the request is heard before this line")

def command(arguments):
    gc.callbacks.append(asked)
    gc.collect()
    time.sleep(60)

app.app = lambda args, prog_name: command(args)
app.main()
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 143
    assert ended.stderr.strip() == "stopped; the same command continues where it was"


def test_a_full_disk_is_told_in_one_line(
    pcd: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tilestream.apps.info.info", full)
    told = "error: [Errno 28] No space left on device: make room; the same command continues"
    assert fails(["info", str(pcd)], 1, capsys) == f"{told} where it was"


EVIL = "a\x1b]0;taken\x07\x9b31m[red]:car:\u202e"
"""A name that would steer a terminal."""
SEEN = "a\\x1b]0;taken"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["info", f"{EVIL}.pcd"], 0),
        (["info", f"{EVIL}.las"], 1),
        (["info", f"{EVIL}.pcd", f"{EVIL}.pcd"], 0),
        (["template", f"{EVIL}.pcd"], 2),
        (["info", f"--{EVIL}"], 2),
        (["ingest", f"{EVIL}.pcd", f"{EVIL}.las", "--store", f"{EVIL}.zarr"], 1),
        (["status", f"{EVIL}.zarr", "--debug"], 2),
        (["run", f"{EVIL}.yaml"], 2),
    ],
)
def test_names_of_files_do_not_steer_the_terminal(
    arguments: list[str],
    code: int,
    pcd: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Told,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(f"{EVIL}.pcd").write_bytes(pcd.read_bytes())
    Path(f"{EVIL}.las").write_text("none")
    Path(f"{EVIL}.yaml").write_text(f"out: [{EVIL!r}]")
    assert run(arguments) == code
    told = "".join(capsys.readouterr())
    assert SEEN in told
    assert not set("\x1b\x07\r\x9b\u202e") & set(told)
    assert "[red]:car:" in told.replace("\n", "")


def test_names_in_log_lines_and_names_that_are_no_text_are_shown(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "tilestream"]
    how = {"cwd": tmp_path, "capture_output": True}
    (tmp_path / "\udcff.mcap").write_bytes(b"none")
    told = subprocess.run([*program, "info", b"\xff.mcap"], **how)
    assert told.stderr.startswith(b"error: \\xff.mcap: ")
    where = ["--store", "map.zarr", "--scheduler", f"tcp://{EVIL}:1"]
    told = subprocess.run([*program, "ingest", "\udcff.mcap", *where], **how)
    assert f"connecting to tcp://{SEEN}" in told.stderr.decode()
    assert b"Traceback" not in told.stderr
    assert not set(b"\x1b\x07") & set(told.stderr)


def test_only_our_own_styles_reach_a_terminal() -> None:
    screen = type(err)(file=io.StringIO(), force_terminal=True, width=100)
    screen.print(EVIL, style="red", highlight=False)
    shown = screen.file.getvalue()
    assert shown.count("\x1b") == 2
    assert SEEN in shown


def test_amounts_of_memory() -> None:
    assert bytes_of("512MB") == 512_000_000
    assert bytes_of(" 1.5 gb ") == 1_500_000_000
    for wrong in ("512", "MB", "many GB", "nan GB", "inf MB", "-1GB", "0MB"):
        with pytest.raises(UsageError, match="memory"):
            bytes_of(wrong)


# --- Where the tasks run


def tls_options(tls: TlsFiles) -> list[str]:
    return ["--tls-ca", tls.ca, "--tls-cert", tls.cert, "--tls-key", tls.key]


def test_a_scheduler_elsewhere_is_reached_over_tls(
    pcd: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    tls, url = certificates(tmp_path), str(tmp_path / "map.zarr")
    command = ["ingest", str(pcd), "--store", url, "--tile-size", "20"]
    with scheduler_elsewhere(1, tls, plain=True) as (address, _):
        assert run([*command, "--scheduler", address]) == 2
        assert "wants certificates: give --tls-ca" in capsys.readouterr().err
        assert not Path(url).exists()
        assert run([*command, "--scheduler", address, *tls_options(tls)]) == 0
    assert ts.open_store(url).marks() == ts.open_store(store).marks()


def test_a_cluster_of_our_own_listens_where_it_is_told_to(
    pcd: Path, tmp_path: Path, capsys: Told, caplog: pytest.LogCaptureFixture
) -> None:
    tls, url = certificates(tmp_path), str(tmp_path / "map.zarr")
    where = ["--workers", "2", "--host", "127.0.0.2", *tls_options(tls)]
    assert run(["ingest", str(pcd), "--store", url, *where]) == 0
    assert "Watch it at http://127.0.0.2:" in capsys.readouterr().err
    assert "listen on 127.0.0.2" in caplog.text
    assert "only certificates let them act" in caplog.text


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--tls-ca"], "belong together"),
        (["--tls-ca", "--tls-cert", "--tls-key"], "nobody listens"),
        (["--host", "0.0.0.0"], "nobody listens"),
        (["--host", "0.0.0.0", "--scheduler", "tcp://127.0.0.1:1"], "leave out --scheduler"),
    ],
)
def test_options_that_would_say_nothing_are_refused(
    options: list[str], reason: str, pcd: Path, tmp_path: Path, capsys: Told
) -> None:
    told = [part for o in options for part in ([o, str(pcd)] if "tls" in o else [o])]
    assert run(["ingest", str(pcd), "--store", str(tmp_path / "map.zarr"), *told]) == 2
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def processes_of(*arguments: object) -> tuple[int, int]:
    """The exit code of a command in a process of its own, and how many more it started."""
    program = [sys.executable, "-m", "tilestream", *map(str, arguments)]
    started: set[int] = set()
    with psutil.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as command:
        while command.poll() is None:
            with suppress(psutil.NoSuchProcess):
                started |= {child.pid for child in command.children(recursive=True)}
            time.sleep(0.1)
    return command.returncode, len(started)


def test_only_a_command_that_has_something_to_do_starts_processes(
    pcd: Path, store: str, tmp_path: Path
) -> None:
    few = ("--store", tmp_path / "map.zarr", "--tile-size", "20", "--workers", "2")
    code, started = processes_of("ingest", pcd, *few)
    assert code == 0
    assert started >= 2
    assert processes_of("ingest", pcd, *few) == (0, 0)
    assert processes_of("ingest", pcd, "--store", store, "--workers", "2") == (2, 0)


def test_a_command_whose_work_is_done_needs_no_workers(
    pcd: Path, log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    route = tmp_path / "route.csv"
    route.write_text("x,y,z\n8,0,0\n12,0,0\n")
    for number, line in enumerate(
        (
            ["factors", store, "--route", str(route), "--spacing", "2"],
            ["localize", store, str(log), "--radius", "0.4", "--until-s", "3"],
            ["estimate", store, "--route", str(route), "--spacing", "4", "--model", "physics"],
        )
    ):
        again = [*line, "--out", str(tmp_path / str(number))]
        assert run([*again, "--workers", "1"]) == 0
        first = capsys.readouterr().out
        assert run([*again, "--workers", "2"]) == 0
        told = capsys.readouterr()
        assert told.out == first
        assert "Watch it at" not in told.err


# --- ingest


def test_ingest_makes_a_map_and_prints_its_tiles(
    pcd: Path, cloud: np.ndarray, tmp_path: Path, capsys: Told
) -> None:
    url = str(tmp_path / "map.zarr")
    assert run(["ingest", str(pcd), "--store", url, "--tile-size", "20", "--map-leaf", "0"]) == 0
    shown = capsys.readouterr().out
    assert f"{pcd}: pcd binary, {len(cloud):,} points" in shown
    store = ts.open_store(url)
    assert sum(len(store.tile(key).points()) for key in store.keys()) == len(cloud)
    for key in store.keys():
        assert f" {key} " in shown
        assert f" {len(store.tile(key).points()):,} " in shown
    assert "lowest [m]" in shown
    assert run(["ingest", str(pcd), "--store", url, "--tile-size", "20", "--map-leaf", "0"]) == 0


def test_a_dry_run_prints_the_plan_and_writes_nothing(
    pcd: Path, log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    url, out = tmp_path / "map.zarr", tmp_path / "run"
    assert run(["ingest", str(pcd), "--store", str(url), "--dry-run"]) == 0
    assert "scatter" in capsys.readouterr().out
    assert run(["localize", store, str(log), "--out", str(out), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert all(stage in shown for stage in ("cells", "register", "label"))
    assert not list(tmp_path.iterdir())


def test_a_bad_source_among_good_ones_is_listed_and_the_rest_is_done(
    pcd: Path, cloud: np.ndarray, tmp_path: Path, capsys: Told
) -> None:
    url = str(tmp_path / "map.zarr")
    short = damaged(pcd, tmp_path / "short.pcd", keep=0.9)
    wrong = tmp_path / "notes.pcd"
    wrong.write_text("not a point cloud\n")
    sources = [str(path) for path in (pcd, short, wrong)]
    assert run(["ingest", *sources, "--store", url]) == 1
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert f"error: {url}: 2 failed, the rest is done:" in told.err
    assert f"  {short}: {short}" in told.err
    assert f"  {wrong}: {wrong}" in told.err
    assert f"{pcd}: pcd binary, {len(cloud):,} points" in told.out
    assert run(["status", url]) == 1
    assert str(short) in capsys.readouterr().err


def test_a_source_that_cannot_be_is_one_line(
    pcd: Path, store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    monkeypatch.chdir(tmp_path)
    new = ["--store", "map.zarr"]
    (tmp_path / "cloud.xyz").write_text("1 2 3\n")
    (tmp_path / "empty").mkdir()
    refused = {
        "none.pcd": ["ingest", "none.pcd", *new],
        "*.laz": ["ingest", "*.laz", *new],
        "tile_size": ["ingest", str(pcd), *new, "--tile-size", "-1"],
        "--map-leaf": ["ingest", str(pcd), *new, "--map-leaf", "nan"],
        "'much'": ["ingest", str(pcd), *new, "--memory", "much"],
        "--memory": ["ingest", str(pcd), *new, "--memory", "1MB"],
        "has tile_size 20.0, asked for is 50.0": [
            *("ingest", str(pcd), "--store", store, "--tile-size", "50")
        ],
        "every = 2, offset = 2": ["ingest", str(pcd), *new, "--every", "2", "--offset", "2"],
    }
    for says, arguments in refused.items():
        assert says in fails(arguments, 2, capsys), arguments
    assert not (tmp_path / "map.zarr").exists() or not ts.open_store("map.zarr").keys()
    assert run(["ingest", "cloud.xyz", "--store", "other.zarr"]) == 1
    told = capsys.readouterr().err
    assert "cloud.xyz" in told
    assert "Traceback" not in told


def test_two_crs_are_refused(cloud: np.ndarray, tmp_path: Path, capsys: Told) -> None:
    paths = []
    for name, crs in (("a.las", "EPSG:6677"), ("b.las", "EPSG:32654")):
        write_las(tmp_path / name, cloud[:100], crs=crs)
        paths.append(str(tmp_path / name))
    line = fails(["ingest", *paths, "--store", str(tmp_path / "map.zarr")], 1, capsys)
    assert all(path in line for path in paths)
    assert not (tmp_path / "map.zarr").exists()


def test_a_map_directory_that_points_outside_is_refused(
    cloud: np.ndarray, tmp_path: Path, capsys: Told
) -> None:
    folder = tmp_path / "pointcloud_map"
    folder.mkdir()
    write_pcd(tmp_path / "secret.pcd", cloud[:100])
    (folder / "pointcloud_map_metadata.yaml").write_text(
        "x_resolution: 20.0\ny_resolution: 20.0\n../secret.pcd: [0, 0]\n"
    )
    assert run(["ingest", str(folder), "--store", str(tmp_path / "map.zarr")]) == 1
    told = capsys.readouterr().err
    assert "pointcloud_map_metadata.yaml" in told
    assert "secret.pcd" in told
    assert "Traceback" not in told


# --- Logs as sources


def test_a_log_becomes_a_map(log: Path, tmp_path: Path, capsys: Told) -> None:
    url = str(tmp_path / "map.zarr")
    assert run(["ingest", str(log), "--store", url, "--every", "2", "--offset", "1"]) == 0
    shown = capsys.readouterr().out
    assert "3 scans of /points" in shown
    count = sum(len(scan.points) for scan in open_log(log).scans_at([1, 3, 5]))
    assert f"mcap, {count:,} points" in shown


def test_a_part_of_a_log_becomes_a_map(log: Path, tmp_path: Path, capsys: Told) -> None:
    """The scans are a second apart: two of the six lie in these two seconds."""
    part = ["--from-s", "2", "--until-s", "4"]
    assert run(["ingest", str(log), "--store", str(tmp_path / "map.zarr"), *part]) == 0
    count = sum(len(scan.points) for scan in open_log(log).scans_at([2, 3]))
    assert f"mcap, {count:,} points" in capsys.readouterr().out
    how = {"sources": (str(log),), "from_s": 2.0, "until_s": 4.0}
    job = RunSettings(out=str(tmp_path / "run"), map=how, drives=[{"log": str(log)}])
    reading = read_map(job, inputs_of(job, None, None))
    assert reading is not None
    (source,) = reading.found
    assert source.info is not None
    assert source.info.points == count


def test_a_log_cut_short_is_recovered_and_the_loss_reported(
    log: Path, tmp_path: Path, capsys: Told
) -> None:
    cut = damaged(log, tmp_path / "cut.mcap", keep=0.6)
    assert run(["ingest", str(cut), "--store", str(tmp_path / "map.zarr")]) == 0
    shown = capsys.readouterr().out
    whole = len(open_log(cut))
    assert 1 <= whole < 6
    assert "cut short" in shown
    assert f"{whole} whole scans recovered" in shown
    assert run(["info", str(cut), "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    assert f"{whole} whole scans recovered" in notes


def test_a_flipped_byte_in_a_log_is_named_by_its_crc(
    log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    bad = damaged(
        log, tmp_path / "bad.mcap", flip=chunk.chunk_start_offset + chunk.chunk_length // 2
    )
    for arguments in (
        ["info", str(bad)],
        ["localize", store, str(bad), "--out", str(tmp_path / "run")],
    ):
        line = fails(arguments, 1, capsys)
        assert "CRC" in line
        assert str(bad) in line
        assert str(chunk.chunk_start_offset) in line
    assert run(["ingest", str(bad), "--store", str(tmp_path / "map.zarr")]) == 1
    assert "CRC" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("lacking", ["poses", "clouds"])
def test_a_log_without_poses_or_clouds_is_named(
    lacking: str, store: str, tmp_path: Path, capsys: Told
) -> None:
    points = logs.street_points(np.random.default_rng(0))
    made = (
        logs.cloud_at(START, points) if lacking == "poses" else logs.odometry_at(START, np.eye(4))
    )
    log = logs.write(tmp_path / "half.mcap", [made])
    line = fails(["localize", store, str(log), "--out", str(tmp_path / "run")], 1, capsys)
    assert str(log) in line
    assert {"poses": "pose", "clouds": "PointCloud2"}[lacking] in line
    assert run(["ingest", str(log), "--store", str(tmp_path / "map.zarr")]) == 1
    assert str(log) in capsys.readouterr().err


# --- status and info


def test_status_shows_the_tiles(store: str, capsys: Told) -> None:
    assert run(["status", store]) == 0
    shown = capsys.readouterr().out
    for key, mark in ts.open_store(store).marks().items():
        (line,) = [line for line in shown.splitlines() if line.split()[:1] == [str(key)]]
        assert line.split()[1:3] == ["done", f"{mark.facts['points']:,}"]
        corner = " ".join(f"{value:z.1f}" for value in mark.facts["highest"])
        assert corner in line


def test_status_for_machines(store: str, pcd: Path, capsys: Told) -> None:
    assert run(["status", store, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    opened = ts.open_store(store)
    assert told["settings"]["tile_size"] == 20.0
    assert [source["path"] for source in told["sources"]] == [str(pcd)]
    assert set(told["tiles"]) == {str(key) for key in opened.keys()}
    for key in opened.keys():
        tile = told["tiles"][str(key)]
        points = opened.tile(key).points()
        assert tile["status"] == "done"
        assert tile["facts"]["points"] == len(points)
        np.testing.assert_array_equal(tile["facts"]["lowest"], points.min(axis=0))


def test_a_newer_store_is_refused(pcd: Path, tmp_path: Path, capsys: Told) -> None:
    url = str(tmp_path / "map.zarr")
    ts.ingest(pcd, url)
    group = zarr.open_group(url, mode="r+")
    ours = dict(group.attrs["tilestream"])
    group.attrs["tilestream"] = ours | {"schema": ours["schema"] + 1}
    for arguments in (["status", url], ["ingest", str(pcd), "--store", url]):
        line = fails(arguments, 1, capsys)
        assert url in line
        assert "install the newer tilestream" in line


@pytest.mark.parametrize("ending", ["pcd", "las", "laz", "ply", "mcap", "directory"])
def test_info_tells_what_is_in_a_file(
    ending: str, cloud: np.ndarray, log: Path, tmp_path: Path, capsys: Told
) -> None:
    path, count = tmp_path / f"street.{ending}", len(cloud)
    if ending == "mcap":
        path, count = log, sum(len(scan.points) for scan in open_log(log).scans())
    elif ending == "directory":
        path.mkdir()
        write_pcd(path / "0.pcd", cloud)
        (path / "pointcloud_map_metadata.yaml").write_text(
            "x_resolution: 100.0\ny_resolution: 100.0\n0.pcd: [0, 0]\n"
        )
    else:
        {"pcd": write_pcd, "ply": write_ply}.get(ending, write_las)(path, cloud)
    assert run(["info", str(path)]) == 0
    assert f"{count:,}" in capsys.readouterr().out
    assert run(["info", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["points"] == count
    assert told["format"].startswith("autoware" if ending == "directory" else ending)
    if ending != "directory":
        assert told["size_bytes"] == path.stat().st_size
        assert {"x", "y", "z"} <= {name.lower() for name, _ in told["fields"]}
    if told["bounds"] and ending != "mcap":
        np.testing.assert_allclose(
            told["bounds"], [cloud.min(axis=0), cloud.max(axis=0)], atol=1e-3
        )


def test_info_of_what_cannot_be_read(pcd: Path, tmp_path: Path, capsys: Told) -> None:
    (tmp_path / "notes.txt").write_text("hello\n")
    assert "notes.txt" in fails(["info", str(tmp_path / "notes.txt")], 1, capsys)
    assert "none.pcd" in fails(["info", str(tmp_path / "none.pcd")], 2, capsys)
    short = damaged(pcd, tmp_path / "short.pcd", keep=0.5)
    assert str(short) in fails(["info", str(short)], 1, capsys)


# --- localize and demo


def test_localize_prints_the_errors(log: Path, store: str, tmp_path: Path, capsys: Told) -> None:
    few = ["--radius", "0.4", "--out", str(tmp_path)]
    assert run(["localize", store, str(log), *few, "--until-s", "5"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r" 5 +sample points", shown)
    assert re.search(r" autoware +the matcher", shown)
    assert re.search(r" \d+\.\d cm +mean error", shown)
    assert shown.count("of the worst places") == 3
    assert "mean_m" not in shown
    assert f"{tmp_path}/errors" in shown.replace("\n", "")
    assert run(["localize", store, str(log), *few, "--json"]) == 1
    told = capsys.readouterr()
    assert "1 of 6 scans failed" in told.err
    assert "scan 5: the scan has 4 points" in told.err
    facts = json.loads(told.out)
    labels = ts.localize(
        ts.open_store(store), log, tmp_path / "again", starts=ts.StartSettings(radius=0.4)
    )
    assert (facts["sample_points"], facts["failed"]) == (6, 1)
    assert facts["matcher"] == "autoware"
    assert facts["mean_m"] == pytest.approx(labels["error_mean"].mean())
    assert facts["max_m"] == labels["error_mean"].max()
    assert facts["share_over_0.10_m"] == (labels["error_mean"].dropna() > 0.1).mean()


def test_the_json_of_a_drive_where_all_failed_is_json(
    log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    sparse = ["--max-range", "0.5", "--out", str(tmp_path / "run"), "--json"]
    assert run(["localize", store, str(log), *sparse]) == 1

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    facts = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert facts["failed"] == facts["sample_points"] == 6
    assert facts["mean_m"] is None
    assert run(["localize", store, str(log), *sparse[:-1]]) == 1
    assert "6 of 6 scans failed" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["taken", "taken/below"])
def test_a_folder_that_is_a_file_is_refused_at_once(
    place: str, log: Path, pcd: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    (tmp_path / "taken").write_text("mine")
    out = str(tmp_path / place)
    for arguments in (
        ["ingest", str(pcd), "--store", out],
        ["localize", store, str(log), "--out", out],
        ["factors", store, "--route", str(log), "--out", out],
        ["compare", store, "--route", str(log), "--out", out],
    ):
        line = fails(arguments, 2, capsys)
        assert out in line
        assert "is a file, or below one" in line
    assert (tmp_path / "taken").read_text() == "mine"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (["--spacing", "0"], "spacing"),
        (["--range-max", "-1"], "--range-max"),
        (["--blind-rear-deg", "400"], "--blind-rear-deg"),
        (["--beams", "0"], "--beams"),
        (["--sweep-s", "0"], "--sweep-s"),
        (["--step", "0"], "--step"),
        (["--cell-size", "3"], "cell_size"),
        (["--scan-leaf", "-1"], "--scan-leaf"),
        (["--offset", "3"], "offset"),
        (["--starts-per-task", "0"], "starts_per_task"),
    ],
)
def test_localize_refuses_what_cannot_be(
    wrong: list[str], says: str, log: Path, store: str, tmp_path: Path, capsys: Told
) -> None:
    out = tmp_path / "run"
    assert says in fails(["localize", store, str(log), "--out", str(out), *wrong], 2, capsys)
    assert not out.exists()


@pytest.mark.slow
def test_the_demo_ends_with_a_report(tmp_path: Path, capsys: Told) -> None:
    assert run(["demo", "--out", str(tmp_path / "demo")]) == 0
    page = tmp_path / "demo" / "report" / "index.html"
    told = capsys.readouterr().out
    assert f"The report is at {page}" in told
    assert "the model that ships" in told
    assert "PLATEAU" in page.read_text()
    assert len(ts.dataset(tmp_path / "demo")) >= 55
    report = json.loads((tmp_path / "demo" / "report" / "report.json").read_text())
    assert report["crs"] is not None
    assert "6677" in report["crs"]
    head = report["headline"]
    assert head["estimated"] >= 290
    assert head["measured"] >= 55
    assert head["max"] > 2.0 * head["median"]  # the hot spots stand out
    assert report["worst"][0]["reason"]


# --- Real data


@pytest.mark.slow
def test_the_real_drive_is_ingested_whole(shared_data: Path, tmp_path: Path) -> None:
    drive = shared_data / "kitti_drive" / "drive.mcap"
    clouds, poses = [], {}
    with drive.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for message in reader.iter_decoded_messages():
            seen = message.decoded_message
            stamp = (seen.header.stamp.sec, seen.header.stamp.nanosec)
            if message.channel.topic == "/odometry":
                p, q = seen.pose.pose.position, seen.pose.pose.orientation
                R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                poses[stamp] = R, np.array([p.x, p.y, p.z])
            else:
                rows = np.frombuffer(seen.data, "<f4").reshape(-1, seen.point_step // 4)
                clouds.append((stamp, rows[:, :3].astype(np.float64)))
    points = np.concatenate([xyz @ poses[stamp][0].T + poses[stamp][1] for stamp, xyz in clouds])
    store = ts.ingest(drive, tmp_path / "map.zarr", map_leaf=0.0)
    stored = np.concatenate([store.tile(key).points() for key in store.keys()])
    assert len(clouds) == 52
    assert store.sources()[0]["points"] == len(stored) == len(points)
    np.testing.assert_allclose(stored.min(axis=0), points.min(axis=0), atol=0.6e-3)
    np.testing.assert_allclose(stored.max(axis=0), points.max(axis=0), atol=0.6e-3)
    np.testing.assert_allclose(stored.mean(axis=0), points.mean(axis=0), atol=1e-4)


def test_of_dask_s_own_log_nothing_is_shown() -> None:
    """Whenever it is imported: its logger may have its own handler, which we silence."""
    code = """
import logging
from tilestream.cli.telling import telling
telling.apply()
import distributed
own = logging.getLogger("distributed").handlers
assert own and not logging.getLogger("distributed").propagate, own
logging.getLogger("tilestream.here").info("what we say")
"""
    found = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=600
    )
    assert found.stderr.split() == ["what", "we", "say"]
