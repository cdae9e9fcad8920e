"""Keeps `versions.json`: per stage its version, a hash of its code, and hashes of golden tables.

    python tests/versions.py

renews it after the code of a stage has changed, and refuses where a table of the golden job has
changed and no version was raised: a store that is continued would mix old tables with new ones.

After a change of the golden job itself the list is removed first, and made anew by unchanged code.
Tables of two processors or of other libraries differ in their last bits. Where the list was made
elsewhere, the tables to compare with are made here, by the code of the last commit.
"""

import ast
import hashlib
import importlib
import importlib.metadata
import importlib.util
import io
import json
import os
import pkgutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent
LIST = TESTS / "versions.json"
BEYOND = ("tilestream.pipeline.engine", "tilestream.errors", "tilestream.version")
"""Modules whose code changes no table: a stage's code ends there."""
OF_SYNTAX = ("ctx", "kind", "type_comment", "type_params")
"""Fields of syntax trees that say nothing of what code does, or that not all Pythons have."""


# --- The code of a stage


@dataclass(frozen=True)
class Module:
    """What the names of a module mean."""

    defined: Mapping[str, ast.stmt]
    """Functions, classes and constants."""
    imported: Mapping[str, tuple[str, str]]
    """Name: module and the name there, empty for the module itself; of the package only."""


Source = Callable[[str], str | None]
"""The source of a module of the package by its name; None: it is none."""


@cache
def source_of(name: str) -> str | None:
    """The source of an installed module."""
    if name.split(".", maxsplit=1)[0] != "tilestream":
        return None
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        return None
    return None if spec is None or spec.origin is None else Path(spec.origin).read_text()


@cache
def module_of(name: str, source: Source) -> Module:
    """What the names of a module mean."""
    text = source(name)
    assert text is not None, name
    defined: dict[str, ast.stmt] = {}
    imported: dict[str, tuple[str, str]] = {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            defined[node.name] = node
        elif isinstance(node, ast.ImportFrom) and node.module and source(node.module) is not None:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                is_module = source(whole) is not None
                place = (whole, "") if is_module else (node.module, alias.name)
                imported[alias.asname or alias.name] = place
        else:
            for name_node in ast.walk(node):
                if isinstance(name_node, ast.Name) and isinstance(name_node.ctx, ast.Store):
                    defined[name_node.id] = node
    return Module(defined, imported)


def reached(roots: Iterable[tuple[str, str]], source: Source) -> dict[tuple[str, str], ast.stmt]:
    """All definitions of the package that some of them lead to, by module and name."""
    found: dict[tuple[str, str], ast.stmt] = {}
    open_ = list(roots)
    while open_:
        place = open_.pop()
        if place in found or place[0].startswith(BEYOND):
            continue
        module = module_of(place[0], source)
        if place[1] in module.defined:
            found[place] = node = module.defined[place[1]]
            open_ += names_in(node, place[0], module)
        elif place[1] in module.imported:
            open_.append(module.imported[place[1]])
    return found


def names_in(node: ast.stmt, where: str, module: Module) -> Iterator[tuple[str, str]]:
    """The names of the package that a definition uses: as (module, name)."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name):
            if inner.id in module.defined:
                yield where, inner.id
            elif module.imported.get(inner.id, ("", ""))[1]:
                yield module.imported[inner.id]
        elif isinstance(inner, ast.Attribute) and isinstance(inner.value, ast.Name):
            target, name = module.imported.get(inner.value.id, ("", "-"))
            if not name:
                yield target, inner.attr


def tree(node: Any) -> Any:
    """A syntax tree without docstrings and places, alike for every Python that we run on."""
    if isinstance(node, list):
        return [tree(one) for one in node if not is_text(one)]
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = {name: value for name, value in ast.iter_fields(node) if name not in OF_SYNTAX}
    if isinstance(node, ast.FunctionDef):
        fields["decorator_list"] = [d for d in node.decorator_list if not is_stage(d)]
    kept = {name: tree(value) for name, value in fields.items() if value not in (None, [])}
    return [type(node).__name__, kept]


def is_text(node: Any) -> bool:
    """Whether a statement is but a text, which documents what stands before it."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def is_stage(decorator: ast.expr) -> bool:
    """Whether it makes a stage: version, memory and cost are no part of what a stage makes."""
    return isinstance(decorator, ast.Call) and getattr(decorator.func, "id", "") == "stage"


def code_hash(module: str, function: str, source: Source = source_of) -> str:
    """Hash of a stage's function, of what of its module reads and writes, and of all they call."""
    there = module_of(module, source).defined
    roots = [(module, function)]
    roots += [(module, name) for name, node in there.items() if reads_or_writes(node)]
    text = json.dumps(
        [[*place, tree(node)] for place, node in sorted(reached(roots, source).items())]
    )
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def reads_or_writes(node: ast.stmt) -> bool:
    """Whether a definition is a class that a task reads from or writes to."""
    methods = {one.name for one in getattr(node, "body", ()) if isinstance(one, ast.FunctionDef)}
    return isinstance(node, ast.ClassDef) and bool(methods & {"read", "write"})


def stages() -> dict[str, Any]:
    """All stages by name."""
    package = importlib.import_module("tilestream.pipeline.stages")
    kind = importlib.import_module("tilestream.pipeline.engine.stage").Stage
    found = {}
    for info in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        for value in vars(importlib.import_module(info.name)).values():
            if isinstance(value, kind) and value.function.__module__ == info.name:
                found[value.name] = value
    return dict(sorted(found.items()))


def codes() -> dict[str, dict[str, Any]]:
    """Version and code of all stages, as the list holds them."""
    return {
        name: {
            "version": one.version,
            "code": code_hash(one.function.__module__, one.function.__name__),
        }
        for name, one in stages().items()
    }


# --- The golden job


def here() -> dict[str, str]:
    """What bits depend on besides the code."""
    llvm = importlib.import_module("llvmlite.binding")
    names = ("llvmlite", "numba", "numpy", "pandas", "scikit-learn", "scipy")
    libraries = {name: importlib.metadata.version(name) for name in names}
    blas = importlib.import_module("threadpoolctl").threadpool_info()
    cores = sorted({str(one.get("architecture", "")) for one in blas})
    return {"processor": llvm.get_host_cpu_name(), "blas": " ".join(cores).strip(), **libraries}


def golden(folder: Path) -> dict[str, Any]:
    """Run the golden job, in this process.

    Returns:
        `tables`: by stage the hash of all that its tasks made; `needs`: by stage those that it
        reads from.
    """
    executor = importlib.import_module("tilestream.pipeline.engine.executor")
    ts, streets = importlib.import_module("tilestream"), importlib.import_module("streets")
    attempt, made, needs = executor.attempt, {}, {}

    def noted(task: Any, memory: int | None = None) -> Any:
        outcome = attempt(task, memory)
        assert outcome.ok, f"{task.key}: {outcome.reason}\n{outcome.details}"
        made.setdefault(task.stage, {})[task.key] = content(task.writes)
        needs.setdefault(task.stage, set()).update(key.split("-")[0] for key in task.needs)
        return outcome

    def of_whole_jobs(task: Any, memory: int | None = None) -> Any:
        """Which places a coarse job looks from is no matter of the stage that looks."""
        return (attempt if task.stage == "observe" else noted)(task, memory)

    executor.attempt = noted
    streets.write_inputs(folder)
    settings = importlib.import_module("tilestream.simulation.settings").load_preset("physical")
    simulating = importlib.import_module("tilestream.pipeline.jobs.simulate")
    simulating.simulate(settings, folder / "city", paths=("III",), size="small")
    observing = {"range_max": streets.REACH, "starts": 8}
    starts = {"radius": 0.6, "step": 0.2}
    label = {"matcher": "autoware", "starts": starts, "true_pose": "refined"}
    ts.run(streets.job(folder, folder / "run", observe=observing, label=label))
    near = [{"log": str(folder / "canyon.mcap"), "name": "near", "range_max": 10.0}]
    physics = {"drives": near, "model": {"recipe": "physics"}}
    ts.run(streets.job(folder, folder / "near", observe=observing, label=label, **physics))
    logs = [str(folder / f"{kind}.mcap") for kind in streets.STREETS]
    coarse = {"drives": [], "routes": logs, "model": {"recipe": "physics", "offset": 0.0}}
    executor.attempt = of_whole_jobs
    coarse |= {"coarse": {"every": 2, "tolerance": 1.0, "high": 9.0}}
    ts.run(streets.job(folder, folder / "coarse", observe=observing, label=label, **coarse))
    executor.attempt = attempt
    return {
        "tables": {name: digest(sorted(keys.items())) for name, keys in sorted(made.items())},
        "needs": {name: sorted(others) for name, others in sorted(needs.items())},
    }


def content(output: Any) -> str:
    """Hash of what a task wrote."""
    kind = type(output).__name__
    if kind == "ModelFile":
        return ""  # all that a model does is in the tables that it makes
    if kind == "FragmentFile":
        return digest(Path(output.store_url, "fragments", f"{output.name}.bin").read_bytes())
    if kind in ("SurveyBlock", "DriveLog"):
        return digest(Path(output.path).read_bytes())
    read = output.read()
    if kind == "ScanParts":
        return digest([vars(scan) for scan in read])
    return digest(read if kind == "TileArrays" else read.rows)


def digest(value: Any) -> str:
    """Hash of tables, arrays and what holds them."""
    hashed = hashlib.blake2b(digest_size=16)
    _update(hashed, value)
    return hashed.hexdigest()


def _update(hashed: Any, value: Any) -> None:
    if hasattr(value, "to_csv"):
        value = {name: value[name].to_numpy() for name in value}
    if isinstance(value, Mapping):
        value = list(value.items())
    if hasattr(value, "dtype") and value.dtype != object:
        hashed.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, bytes):
        hashed.update(value)
    elif isinstance(value, list | tuple) or hasattr(value, "dtype"):
        for one in value:
            _update(hashed, one)
    else:
        hashed.update(repr(value).encode())


def golden_of(root: Path) -> dict[str, Any]:
    """The golden job by the code of a checkout, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(TESTS / "versions.py"), "--golden", folder]
        path = os.pathsep.join([str(root), str(root / "tests")])
        made = subprocess.run(
            command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, check=True
        )
        return dict(json.loads(made.stdout.splitlines()[-1]))


def golden_of_commit() -> dict[str, Any]:
    """The golden job by the code of the last commit."""
    root = TESTS.parent
    command = ["git", "-C", str(root), "archive", "HEAD", "tilestream", "tests"]
    packed = subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(folder, filter="data")
        return golden_of(Path(folder))


# --- The list


def forgotten(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The stages whose tables have changed although no version says so: not their own, and none of
    a stage that they read from.

    Args:
        before: `stages` (version and code of each), `tables`.
        now: the same, and `needs`.
    """

    def raised(name: str, seen: tuple[str, ...] = ()) -> bool:
        was = before["stages"].get(name, {}).get("version")
        return was != now["stages"][name]["version"] or any(
            raised(other, (*seen, name)) for other in now["needs"][name] if other not in seen
        )

    tables = now["tables"].items()
    return [
        name for name, table in tables if before["tables"].get(name) != table and not raised(name)
    ]


def renew() -> int:
    """Renew the list; 0 if it holds, 1 if a version must be raised first."""
    known = json.loads(LIST.read_text()) if LIST.exists() else None
    now: dict[str, Any] = {"stages": codes()}
    if known is not None and known["stages"] == now["stages"]:
        print(f"{LIST.name} is of this code")
        return 0
    print("the code of a stage has changed: running the golden job, some minutes", flush=True)
    now |= golden_of(TESTS.parent)
    before = known or now
    if known is not None and known["made_on"] != here():
        print("the list was made elsewhere: the last commit runs the golden job too", flush=True)
        before = known | golden_of_commit()
    if wrong := forgotten(before, now):
        print(f"other tables under an unchanged version: {', '.join(wrong)}")
        print("raise the version of the stage that changed (its @stage), or mend it")
        return 1
    LIST.write_text(json.dumps({"made_on": here(), **now}, indent=1) + "\n")
    print(f"{LIST.name} is renewed")
    return 0


if __name__ == "__main__":
    sys.path[:0] = [str(TESTS)]
    if sys.argv[1:2] == ["--golden"]:
        print(json.dumps(golden(Path(sys.argv[2]))))
    else:
        sys.exit(renew())
