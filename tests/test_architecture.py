"""Imports go down only: the floors of the house, read from the code itself."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import tilestream

ROOT = Path(tilestream.__file__).parent
FLOORS = (
    ("errors", "version"),
    ("tiling", "config"),
    ("kernels", "sensors"),
    ("records",),
    ("ndt",),
    ("store", "tables", "formats", "simulation"),
    ("localization",),
    ("factors", "forest"),
    ("report", "ingest"),
    ("dataflow",),
    ("cli",),
    ("__init__", "__main__"),
)
LEVEL = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
KNOWN_ONLY_BY = {
    "dask": {"dataflow"},
    "distributed": {"dataflow"},
    "zarr": {"store"},
    "sklearn": {"forest"},
    "skops": {"forest"},
    "numba": {"kernels"},
    "open3d": {"simulation", "formats"},
    "typer": {"cli"},
    "jinja2": {"report"},
}


def step_in_dataflow(name: str) -> int:
    """plan < tasks < dashboard < telling < run < a job's tasks < the jobs < those made of jobs."""
    first = ("plan", "progress", "tasks", "dashboard", "telling", "run", "run_settings")
    above = {"compare": 7, "estimate_tasks": 7, "main_plan": 8, "main_findings": 8}
    above |= {"main_estimate": 9, "main_forecast": 10, "main_job": 10}
    if name in above:
        return above[name]
    return first.index(name) if name in first else 5 if name.endswith("_tasks") else 6


def modules() -> list[Path]:
    return sorted(ROOT.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(tree: ast.AST) -> Iterator[tuple[ast.stmt, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            assert node.module is not None
            if node.module in ("tilestream", "tilestream.dataflow"):
                for alias in node.names:
                    yield node, f"{node.module}.{alias.name}"
            else:
                yield node, node.module


def broken_arrows(path: Path, source: str) -> list[str]:
    room, found = room_of(path), []
    for node, name in imported(ast.parse(source)):
        top, *rest = name.split(".")
        if top in KNOWN_ONLY_BY and room not in KNOWN_ONLY_BY[top]:
            found.append(f"{path.name}:{node.lineno} {room} may not know {top}")
        if top != "tilestream" or not rest:
            continue
        target = rest[0]
        if target == "__version__":
            continue
        if target not in LEVEL:
            found.append(f"{path.name}:{node.lineno} imports {name}, of no floor")
        elif target == room:
            within = room == "dataflow" and len(rest) > 1
            if within and step_in_dataflow(rest[1]) >= step_in_dataflow(path.stem):
                found.append(f"{path.name}:{node.lineno} {path.stem} imports {rest[1]}")
        elif LEVEL[target] >= LEVEL[room]:
            found.append(f"{path.name}:{node.lineno} {room} imports {target}")
    return found


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path: Path) -> None:
    assert room_of(path) in LEVEL, f"{path} is in no room of the house"
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
    optional = {"e57.py", "raycast.py", "telling.py"}
    assert path.name in optional or hidden == []


def test_a_broken_arrow_is_seen() -> None:
    for path, source in (
        (ROOT / "store.py", "from tilestream.dataflow import run"),
        (ROOT / "ndt.py", "import zarr"),
        (ROOT / "localization.py", "from tilestream.factors.table import factors"),
        (ROOT / "dataflow" / "plan.py", "from tilestream.dataflow.run import run"),
        (ROOT / "ndt.py", "from tilestream import localization"),
    ):
        assert broken_arrows(path, source), source


def test_floors_do_not_import_each_other() -> None:
    source = "from tilestream.formats.pcd import write_pcd"
    assert broken_arrows(ROOT / "store.py", source) == ["store.py:1 store imports formats"]
