"""Waiting for other processes, as long as a busy machine takes."""

import time
from collections.abc import Callable

PATIENCE = 900.0
"""Until something is given up [s]: no verdict on speed, and less than pytest gives a test."""


def wait_until(true: Callable[[], object], what: str) -> None:
    """Return as soon as something is true.

    Raises:
        AssertionError: it is not for `PATIENCE`; says `what`.
    """
    until = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < until, f"not within {PATIENCE:g} s: {what}"
        time.sleep(0.01)
