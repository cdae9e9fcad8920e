"""Kernels run wherever they are installed, and are never read from a folder that others can write.

Each test starts Python anew in a small installation of its own: the folder of the kernels, copied.
"""

import ast
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tilestream

KERNELS = Path(tilestream.__file__).parent / "kernels"
posix = pytest.mark.skipif(sys.platform == "win32", reason="folders have no owner and mode there")

SUMS = """
from tilestream.kernels.rows import finite_points
import numpy as np
one, out = np.ones(3), np.empty((3, 3))
assert finite_points(one, one, one, one, one, out) == 3 and (out == 2.0).all()
print(finite_points.stats.cache_path, sum(finite_points.stats.cache_hits.values()))
"""

TOLD = f"""
import logging, sys
logging.basicConfig(level="INFO", format="%(message)s", stream=sys.stdout)
from tilestream.kernels.cache import are_kept
print("kept" if are_kept() else "not kept")
{SUMS}
"""

IN_WORKERS = """
import multiprocessing
from tilestream.kernels import rows
def kept(_):
    return rows.finite_points.stats.cache_path
if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        print(*pool.map(kept, range(2)), rows.finite_points.stats.cache_path)
"""


class Installation:
    """The kernels in `site`, started with a home and a temporary folder that belong to it alone."""

    def __init__(self, root: Path) -> None:
        self.site, self.home, self.temporary = root / "site", root / "home", root / "tmp"
        self.kernels = self.site / "tilestream" / "kernels"
        shutil.copytree(KERNELS, self.kernels, ignore=shutil.ignore_patterns("__pycache__"))
        self.kernels.parent.joinpath("__init__.py").touch()
        self.pycache = self.kernels / "__pycache__"
        self.own = self.temporary / f"tilestream-numba-{os.getuid()}"
        for folder in (self.home, self.temporary, self.pycache):
            folder.mkdir()

    def start(
        self, program: str = SUMS, *, cache: Path | None = None, home: str | None = None
    ) -> tuple[list[str], list[str]]:
        """Words and lines that a program prints, to standard output and error."""
        left_out = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "NUMBA_DISABLE_JIT")
        env = {name: value for name, value in os.environ.items() if name not in left_out}
        env |= {
            "PYTHONPATH": str(self.site),
            "HOME": home or str(self.home),
            "TMPDIR": str(self.temporary),
        }
        env |= {"PYTHONDONTWRITEBYTECODE": "1"}
        if cache is not None:
            env["NUMBA_CACHE_DIR"] = str(cache)
        script = self.temporary / "program.py"
        script.write_text(program)
        ran = subprocess.run(
            [*unprivileged(), sys.executable, str(script)],
            env=env,
            cwd=self.temporary,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
        return ran.stdout.split(), ran.stderr.splitlines()

    def make_read_only(self) -> None:
        self.home.rmdir()
        for folder in (
            self.pycache,
            self.kernels,
            self.kernels.parent,
            self.site,
            self.site.parent,
        ):
            folder.chmod(0o555)

    def make_writable(self) -> None:
        for folder in (self.site.parent, self.site, self.kernels.parent, self.kernels):
            folder.chmod(0o755)


def unprivileged() -> list[str]:
    """What a command begins with to be bound by permissions, also where root runs the tests."""
    if os.getuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("permissions do not bind root: needs setpriv, of util-linux")
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search", "--"]


@pytest.fixture
def installation(tmp_path: Path) -> Iterator[Installation]:
    made = Installation(tmp_path / "root")
    yield made
    made.make_writable()


@posix
def test_a_second_start_reads_what_the_first_compiled(installation: Installation) -> None:
    for hits in ("0", "1"):
        assert installation.start() == ([str(installation.pycache), hits], [])


@posix
def test_compiling_is_told_once_and_only_where_something_is_compiled(
    installation: Installation,
) -> None:
    first, _ = installation.start(TOLD)
    assert " ".join(first).count("compiling kernels") == 1
    assert first[:2] == ["not", "kept"]
    again, _ = installation.start(TOLD)
    assert "compiling" not in again
    assert again[0] == "kept"


@posix
@pytest.mark.parametrize("home", [None, "~"], ids=["a home that is missing", "that is not known"])
def test_a_read_only_installation_without_home_keeps_kernels_in_a_folder_of_the_user(
    installation: Installation, home: str | None
) -> None:
    installation.make_read_only()
    for hits in ("0", "1"):
        (folder, found), (line,) = installation.start(home=home)
        assert (Path(folder).parent, found) == (installation.own, hits)
        assert "NUMBA_CACHE_DIR" in line
    assert stat.S_IMODE(installation.own.stat().st_mode) == 0o700
    assert list(installation.own.rglob("*.nbi"))


@posix
@pytest.mark.parametrize("taken", ["by a link", "by a folder that all can write"])
def test_without_a_safe_folder_kernels_run_uncached(installation: Installation, taken: str) -> None:
    installation.make_read_only()
    if taken == "by a link":
        elsewhere = installation.temporary / "elsewhere"
        elsewhere.mkdir()
        installation.own.symlink_to(elsewhere)
    else:
        installation.own.mkdir()
        installation.own.chmod(0o777)
    (folder, hits), (line,) = installation.start()
    assert (folder, hits) == ("None", "0")
    assert "NUMBA_CACHE_DIR" in line
    assert not list(installation.temporary.rglob("*.nb?"))


@posix
@pytest.mark.parametrize(
    ("place", "mode"), [("of the package", 0o757), ("given", 0o777), ("given", 0o1777)]
)
def test_a_folder_that_others_can_write_is_not_used(
    installation: Installation, place: str, mode: int
) -> None:
    given = installation.home / "numba"
    given.mkdir()
    (given if place == "given" else installation.pycache).chmod(mode)
    (folder, _), (line,) = installation.start(cache=given if place == "given" else None)
    assert Path(folder).parent == installation.own
    assert "NUMBA_CACHE_DIR" in line
    assert not [*installation.pycache.iterdir(), *given.rglob("*.nb?")]


@posix
def test_a_folder_of_another_user_is_not_used(installation: Installation) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give a folder to another user")
    given = installation.home / "numba"
    given.mkdir()
    os.chown(given, 65534, 65534)
    given.chmod(0o757)
    (folder, _), (line,) = installation.start(cache=given)
    assert Path(folder).parent == installation.own
    assert "NUMBA_CACHE_DIR" in line


@posix
def test_a_folder_that_the_user_names_is_used(installation: Installation) -> None:
    installation.make_read_only()
    given = installation.temporary / "numba"
    for hits in ("0", "1"):
        (folder, found), lines = installation.start(cache=given)
        assert (Path(folder).parent, found, lines) == (given, hits, [])


@posix
@pytest.mark.parametrize("safe", [True, False])
def test_workers_decide_alike_and_in_silence(installation: Installation, safe: bool) -> None:
    installation.make_read_only()
    if not safe:
        installation.own.touch()
    folders, lines = installation.start(IN_WORKERS)
    assert len(folders) == 3
    assert len(set(folders)) == len(lines) == 1
    assert (folders[0] == "None") is not safe


def test_every_kernel_takes_this_decision() -> None:
    decorators = {
        alias.name
        for path in KERNELS.glob("*.py")
        if path.name != "cache.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom | ast.Import)
        for alias in node.names
        if isinstance(node, ast.Import) or node.module == "numba"
    }
    assert not decorators & {"numba", "njit", "jit", "vectorize", "guvectorize"}


COMPILED = """
from multiprocessing import get_context
import numba.core.event as event

class Listener(event.Listener):
    def __init__(self):
        self.names = []
    def on_start(self, started):
        self.names.append(started.data["dispatcher"].__name__)
    def on_end(self, ended):
        pass

def compiled(_):
    heard = Listener()
    event.register("numba:compile", heard)
    import numpy as np
    from tilestream.kernels import newton
    newton.raw_step(np.ones(6), np.eye(6), 0.1, 0.0, np.empty(6))
    return [name for name in heard.names if hasattr(newton, name)]

if __name__ == "__main__":
    with get_context("spawn").Pool(3) as pool:
        each = pool.map(compiled, range(3), chunksize=1)
    print(*(name for names in each for name in names))
"""


@posix
def test_of_several_processes_one_compiles_a_kernel(installation: Installation) -> None:
    names, _ = installation.start(COMPILED)
    assert "raw_step" in names
    assert len(names) == len(set(names))


@posix
def test_a_process_that_is_killed_while_it_compiles_stops_nobody(
    installation: Installation,
) -> None:
    killed = SUMS.replace(
        "one, out",
        "import os, signal, numba.core.event as event\n"
        "class Kill(event.Listener):\n"
        "    def on_start(self, started): os._exit(0)\n"
        "    def on_end(self, ended): pass\n"
        "event.register('numba:compile', Kill())\n"
        "one, out",
        1,
    )
    assert installation.start(killed) == ([], [])
    assert list(installation.pycache.glob("*.lock"))
    assert installation.start() == ([str(installation.pycache), "0"], [])


NOTHING_LEFT = """
import sys, tempfile
import numba.core.event as event
from tilestream.apps.warm import SMALLEST, warm
from tilestream.pipeline.jobs.run import run
from tilestream.pipeline.jobs.run_settings import RunSettings

class Listener(event.Listener):
    def __init__(self):
        self.names = []
    def on_start(self, started):
        kernel = started.data["dispatcher"].py_func
        if kernel.__module__.startswith("tilestream."):
            self.names.append(kernel.__name__)
    def on_end(self, ended):
        pass

heard = Listener()
event.register("numba:compile", heard)
if sys.argv[1] == "warm":
    print(warm())
else:
    model = {"use": "shipped"}
    with tempfile.TemporaryDirectory() as folder:
        settings = {"out": folder, **SMALLEST, "model": model, "observe": {"range_max": 30.0}}
        run(RunSettings.model_validate(settings))
print(len(heard.names), *heard.names)
"""


@posix
@pytest.mark.slow
def test_after_warm_no_job_compiles(tmp_path: Path) -> None:
    cache = tmp_path / "kernels"
    script = tmp_path / "program.py"
    script.write_text(NOTHING_LEFT)
    told = {}
    for what in ("warm", "run"):
        ran = subprocess.run(
            [sys.executable, str(script), what],
            env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
        told[what] = ran.stdout.splitlines()
    folder, compiled = told["warm"]
    assert Path(folder).parent == cache
    assert int(compiled.split()[0]) > 50
    assert told["run"][-1].split() == ["0"]


@posix
def test_a_file_system_without_locks_stops_nobody(installation: Installation) -> None:
    unlocked = SUMS.replace(
        "one, out",
        "import fcntl\n"
        "def refused(*_): raise OSError('no locks available')\n"
        "fcntl.flock = refused\n"
        "one, out",
        1,
    )
    assert installation.start(unlocked) == ([str(installation.pycache), "0"], [])
