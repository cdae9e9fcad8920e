"""The notebook: from a map to a picture."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import tilestream as ts

TOUR = Path(__file__).resolve().parents[1] / "pipelines" / "tour.ipynb"
CELLS = [
    "".join(cell["source"])
    for cell in json.loads(TOUR.read_text())["cells"]
    if cell["cell_type"] == "code"
]
RUNNER = """
import json, sys
from IPython.core.interactiveshell import InteractiveShell

shell = InteractiveShell.instance()
for source in json.load(sys.stdin):
    shell.run_cell(source).raise_error()
"""


def test_the_notebook_ships_without_outputs_and_uses_what_there_is() -> None:
    for cell in json.loads(TOUR.read_text())["cells"]:
        assert cell.get("outputs", []) == []
    for source in CELLS:
        ast.parse(source)
    named = set(re.findall(r"\bts\.(\w+)", "".join(CELLS)))
    assert named <= set(ts.__all__)
    assert {"simulate", "ingest", "read_route", "plan", "run", "open_run", "progress"} <= named


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    pytest.importorskip("IPython")
    done = subprocess.run(
        [sys.executable, "-c", RUNNER],
        input=json.dumps(CELLS),
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    places = pd.read_parquet(tmp_path / "tour" / "run" / "report" / "places.parquet")
    assert len(places) > 10
    assert places["estimate"].notna().mean() > 0.9
    assert "vd_along" in done.stdout
