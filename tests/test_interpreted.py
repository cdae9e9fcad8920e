"""Kernels as plain Python: the tests that are marked, once more, without the compiler."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
QUICK = ("cells", "formats_kernels", "nearest", "score_field", "vicinity", "virtual_scan")


@pytest.mark.parametrize(
    ("files", "least"), [(QUICK, 25), pytest.param(("pairs",), 7, marks=pytest.mark.slow)]
)
def test_kernels_say_the_same_without_the_compiler(files: tuple[str, ...], least: int) -> None:
    paths = [str(HERE / f"test_{name}.py") for name in files]
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider"]
    told = subprocess.run(
        [*command, "-m", "interpreted", *paths],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stdout[-2000:]
    (passed,) = re.findall(r"(\d+) passed", told.stdout)
    assert int(passed) >= least
    assert all(f"test_{name}.py" in told.stdout for name in files)
