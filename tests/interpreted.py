"""Kernels as plain Python: tests of a file once more, in a process without the compiler."""

import os
import re
import subprocess
import sys

import pytest

outer = pytest.mark.skipif(
    "NUMBA_DISABLE_JIT" in os.environ, reason="is itself the run without the compiler"
)


def passed(file: str, chosen: str) -> int:
    """How many tests of a file, chosen by their names, pass; none may fail."""
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", chosen, file],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-2000:]
    return int(re.findall(r"(\d+) passed", result.stdout)[-1])
