"""What failed is told in a line for each reason, and every failure is kept."""

from hypothesis import given
from hypothesis import strategies as st

from tilestream.errors import NOT_RUN, PartialError, alike, counted

NAMES = st.one_of(
    st.builds("tile {}_{}".format, st.integers(-9, 9), st.integers(-9, 9)),
    st.builds("cells-{}_{}".format, st.integers(0, 9), st.integers(0, 9)),
    st.sampled_from(["a.pcd", "/maps/b-1.laz", "route", "tile", ""]),
)


@given(st.dictionaries(NAMES, st.sampled_from(["no space", "cut short", "damaged: 3 of 4"])))
def test_every_failure_is_in_the_line_of_its_reason(failures: dict[str, str]) -> None:
    lines = alike(failures)
    assert len(lines) == len(set(failures.values()))
    for reason in set(failures.values()):
        names = [name for name, why in failures.items() if why == reason]
        (line,) = [line for line in lines if f": {reason}" in line]
        if len(names) > 1:
            assert int(line.split()[0]) == len(names)
        else:
            assert line == f"{names[0]}: {reason}"
    error = PartialError("map.zarr:", failures)
    assert error.failures == failures
    assert str(error) == "\n  ".join(["map.zarr:", *lines])


def test_many_of_a_kind_are_told_by_number_and_first_names() -> None:
    tiles = {f"tile {i}_0": "no space" for i in (10, 9, 2, 1)}
    assert alike(tiles) == ["4 tiles: no space (1_0, 2_0, 9_0, …)"]
    assert alike({"merge-0_0": "x", "merge-0_1": "x"}) == ["2 of merge: x (0_0, 0_1)"]
    assert alike({"b.pcd": "x", "a.pcd": "x"}) == ["2 alike: x (a.pcd, b.pcd)"]
    assert alike({"tile 1_0": "x", "scan 1": "x"}) == ["2 alike: x (scan 1, tile 1_0)"]
    assert alike({"a.pcd": "x", "scan 9": "y", "scan 10": "y"}) == [
        "a.pcd: x",
        "2 scans: y (9, 10)",
    ]


def test_what_was_not_run_is_told_apart_by_what_it_needs() -> None:
    failures = {f"merge-{i}_0": "no space" for i in range(3)}
    failures |= {f"cells-{i}_0": f"{NOT_RUN}merge-{i}_0 failed: no space" for i in range(3)}
    told = alike(failures)
    assert told == [
        "3 of merge: no space (0_0, 1_0, 2_0)",
        "3 of cells: not run, since what they need failed: no space (0_0, 1_0, 2_0)",
    ]
    assert counted(failures) == "3 failed, 3 not run"
    assert counted({"a": "x"}) == "1 failed"
    (single,) = alike({"cells-0_0": f"{NOT_RUN}merge-0_0 failed: no space"})
    assert single == "cells-0_0: not run, since merge-0_0 failed: no space"
