"""The examples of the docstrings, run in a folder with a small map, a route, a job and a run."""

import doctest
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hand_made_run import write_run

import tilestream as ts

JOB = "out: planned\nmap: {store: map.zarr}\nroutes: [route.csv]\nmodel: {recipe: physics}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    run = write_run(folder / "run")
    (run / "map.zarr").rename(folder / "map.zarr")
    (run / "map.zarr").symlink_to(folder / "map.zarr")
    (run / "street.pcd").rename(folder / "street.pcd")
    (folder / "route.csv").write_text("x,y,z\n4,0.5,0\n10,0.5,0\n")
    (folder / "job.yaml").write_text(JOB)
    return folder


@pytest.fixture(autouse=True)
def _there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(folder)
    pyplot = import_module("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")


def examples() -> dict[str, doctest.DocTest]:
    finder = doctest.DocTestFinder(exclude_empty=True)
    found: dict[str, doctest.DocTest] = {}
    for name in ts.__all__:
        for test in finder.find(getattr(ts, name), name, globs={"ts": ts, "np": np}):
            if test.examples:
                found[test.name] = test
    return found


EXAMPLES = examples()


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_does_what_it_says(name: str) -> None:
    told: list[str] = []
    result = doctest.DocTestRunner().run(EXAMPLES[name], out=told.append)
    assert result.failed == 0, "".join(told)


def test_the_functions_that_a_beginner_meets_have_one() -> None:
    first = {"ingest", "open_store", "read_route", "factors", "factors_along", "cells_of"}
    first |= {"plan", "status", "verify", "info", "diff", "explain", "template"}
    assert first | {"open_run", "read_run"} <= set(EXAMPLES)
