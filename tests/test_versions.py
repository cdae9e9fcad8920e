"""Versions cannot be forgotten: the hash of a stage's code, and what its list refuses."""

import json
from collections.abc import Mapping
from typing import Any

import pytest
import versions

CODE = {
    "tilestream.stages": """
from tilestream.pipeline.engine.stage import stage
from tilestream import kernels
from tilestream.helpers import halved as half, LEAST

EDGE = 2.0
UNUSED = 1

@stage("cells", version=1, memory=lambda counts: 10)
def cells(points):
    '''What it does.'''
    return kernels.summed(half(points), EDGE)

class Source:
    def read(self):
        return LEAST
""",
    "tilestream.kernels": """
def summed(points, edge):
    '''Sum.'''
    return sum(points) * edge

def other():
    return 3
""",
    "tilestream.helpers": """
LEAST = 3

def halved(points):
    return [deeper(p) for p in points]

def deeper(p):
    return p / 2
""",
    "tilestream.pipeline.engine.stage": "def stage(name, **how): ...",
    "tilestream": "",
}


def hash_with(module: str = "tilestream", old: str = "", new: str = "") -> str:
    assert old in CODE[module]
    changed = CODE | {module: CODE[module].replace(old, new)}
    return versions.code_hash("tilestream.stages", "cells", changed.get)


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("tilestream.stages", "EDGE = 2.0", "EDGE = 3.0"),
        ("tilestream.stages", "half(points), EDGE", "half(points), 2 * EDGE"),
        ("tilestream.kernels", "* edge", "/ edge"),
        ("tilestream.helpers", "p / 2", "p / 3"),
        ("tilestream.helpers", "LEAST = 3", "LEAST = 4"),  # of what it reads
    ],
)
def test_what_a_stage_calls_is_its_code(module: str, old: str, new: str) -> None:
    assert hash_with(module, old, new) != hash_with()


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("tilestream.stages", "UNUSED = 1", "UNUSED = 2"),
        ("tilestream.stages", "'''What it does.'''", "'''What it does, better said.'''"),
        ("tilestream.stages", "    '''What it does.'''\n", "    # said nowhere\n"),
        ("tilestream.stages", "version=1, memory=lambda counts: 10", "version=2, memory=max"),
        ("tilestream.kernels", "return 3", "return 4"),
        ("tilestream.pipeline.engine.stage", "...", "return None"),
    ],
)
def test_words_costs_and_other_code_are_not(module: str, old: str, new: str) -> None:
    assert hash_with(module, old, new) == hash_with()


def listed(tables: Mapping[str, str], **raised: int) -> dict[str, Any]:
    names = ("merge", "cells", "terms")
    return {
        "stages": {name: {"version": raised.get(name, 1), "code": "a"} for name in names},
        "tables": {"merge": "m", "cells": "c", "terms": "t"} | dict(tables),
        "needs": {"merge": [], "cells": ["merge"], "terms": ["cells", "terms"]},
    }


def test_other_tables_need_another_version() -> None:
    before = listed({})
    assert versions.forgotten(before, listed({})) == []
    assert versions.forgotten(before, listed({"cells": "d"})) == ["cells"]
    assert versions.forgotten(before, listed({"cells": "d", "terms": "u"})) == ["cells", "terms"]
    assert versions.forgotten(before, listed({"cells": "d", "terms": "u"}, cells=2)) == []
    assert versions.forgotten(before, listed({"terms": "u"}, merge=2)) == []
    assert versions.forgotten(before, listed({"cells": "d"}, terms=2)) == ["cells"]


def test_the_list_is_of_this_code() -> None:
    known = json.loads(versions.LIST.read_text())
    assert known["stages"] == versions.codes(), "run `python tests/versions.py` and commit its list"
    # a model is seen by the tables that it makes
    assert set(known["tables"]) == set(known["stages"])
