"""Imports go down only: the floors of the house, read from the code itself."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import tilestream

ROOT = Path(tilestream.__file__).parent
FLOORS = (
    ("counts", "errors", "version"),
    (
        "bounded_yaml",
        "config",
        "crs",
        "files",
        "grid",
        "marks",
        "notebook",
        "notes",
        "patterns",
        "user_cache",
    ),
    ("kernels", "lock"),
    ("autoware_matcher", "sensor"),
    ("matcher", "records"),
    ("settings",),
    ("ndt", "preprocessing"),
    ("store", "tables", "formats", "simulation"),
    ("from_above", "local_map", "thinned"),
    ("registration",),
    ("label", "moments"),
    ("factors",),
    ("model",),
    ("report",),
    ("pipeline.engine",),
    ("pipeline.stages",),
    ("pipeline.jobs",),
    ("apps",),
    ("definitions",),
    ("cli",),
    ("__init__", "__main__", "pipeline.__init__"),
)
LEVEL = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
KNOWN_ONLY_BY = {
    "dask": {"pipeline.engine"},
    "distributed": {"pipeline.engine"},
    "zarr": {"store"},
    "sklearn": {"model"},
    "skops": {"model"},
    "numba": {"kernels"},
    "embreex": {"simulation"},
    "open3d": {"simulation", "apps"},
    "typer": {"cli"},
    "jinja2": {"report"},
    "k3d": {"report"},
    "pyogrio": {"report"},
}
OF_FORMATS = re.compile(r"tilestream\.formats\.logs\.(mcap|ros)")
"""One format of logs: everything else reads any log, through `formats.logs`."""


def modules() -> list[Path]:
    return sorted(ROOT.rglob("*.py"))


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def room_of(name: str) -> str:
    """The folder of a module, or a module that lies in no folder."""
    parts = name.split(".")
    return ".".join(parts[:2]) if parts[0] == "pipeline" else parts[0]


def imported(tree: ast.AST) -> Iterator[tuple[ast.stmt, str]]:
    """What is imported, by its whole name; of a folder, each module that is named."""
    known = {name_of(path) for path in modules()}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            assert node.module is not None
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                inside = whole.removeprefix("tilestream.") in known or node.module == "tilestream"
                yield node, whole if inside else node.module


def broken_arrows(path: Path, source: str) -> list[str]:
    room, found = room_of(name_of(path)), []
    for node, name in imported(ast.parse(source)):
        top, _, rest = name.partition(".")
        where = f"{path.name}:{node.lineno}"
        if top in KNOWN_ONLY_BY and room not in KNOWN_ONLY_BY[top]:
            found.append(f"{where} {room} may not know {top}")
        if OF_FORMATS.match(name) and room != "formats":
            found.append(f"{where} {room} may not know {name}")
        if top != "tilestream" or rest in ("", "__version__"):
            continue
        target = room_of(rest)
        if target not in LEVEL:
            found.append(f"{where} imports {name}, of no floor")
        elif target != room and LEVEL[target] >= LEVEL[room]:
            found.append(f"{where} {room} imports {target}")
    return found


def test_no_module_imports_itself_through_others() -> None:
    """Within a folder too, imports have an order."""
    arrows = {
        name_of(path): {
            name.removeprefix("tilestream.") for _, name in imported(ast.parse(path.read_text()))
        }
        for path in modules()
    }
    open_, done = [], set()

    def visit(name: str) -> None:
        assert name not in open_, " -> ".join([*open_, name])
        if name in done or name not in arrows:
            return
        open_.append(name)
        for target in sorted(arrows[name]):
            visit(target)
        done.add(open_.pop())

    for name in arrows:
        visit(name)


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path: Path) -> None:
    assert room_of(name_of(path)) in LEVEL, f"{path} is in no room of the house"
    assert broken_arrows(path, path.read_text()) == []


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_import_hides_inside_a_function(path: Path) -> None:
    hidden = [
        f"{path.name}:{inner.lineno}"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for inner in ast.walk(node)
        if isinstance(inner, ast.Import | ast.ImportFrom)
    ]
    optional = {"e57.py", "raycast.py", "events.py", "view.py", "clouds.py"}
    assert path.name in optional or hidden == []


def test_a_broken_arrow_is_seen() -> None:
    for path, source in (
        (ROOT / "store.py", "from tilestream.pipeline.jobs import run"),
        (ROOT / "ndt.py", "import zarr"),
        (ROOT / "label.py", "from tilestream.factors.table import factors"),
        (ROOT / "pipeline" / "engine" / "plan.py", "from tilestream.pipeline.stages import merge"),
        (ROOT / "ndt.py", "from tilestream import label"),
        (ROOT / "cli" / "maps.py", "from tilestream.formats.logs.mcap import open_mcap"),
    ):
        assert broken_arrows(path, source), source


def test_floors_do_not_import_each_other() -> None:
    source = "from tilestream.formats.points.pcd import write_pcd"
    assert broken_arrows(ROOT / "store.py", source) == ["store.py:1 store imports formats"]
