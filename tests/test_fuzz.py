"""Damaged files of every kind: an error of ours that names the file, or data, in bounds."""

import sys

import pytest
from fuzz import bad, fuzz, table

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")


def test_some_damaged_files_are_refused_by_name_or_read() -> None:
    found = fuzz(300, seed=1)
    assert not bad(found), "\n".join([table(found), *bad(found)])


@pytest.mark.slow
def test_many_damaged_files_are_refused_by_name_or_read() -> None:
    found = fuzz(10_000, seed=2, children=2)
    assert not bad(found), "\n".join([table(found), *bad(found)])
