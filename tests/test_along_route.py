"""Virtual drives averaged along their route: a symmetric kernel, the same in any company."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tilestream.factors.along_route import AVERAGED, CUT, REACH, WIDTHS, averaged_along
from tilestream.pipeline.jobs.prediction_tasks import NEIGHBOURS_MM

KERNELS = st.sampled_from([width for width in WIDTHS if width])


def drives(arcs: list[float], failed: list[int], routes: int) -> pd.DataFrame:
    """Sample points of some routes, shuffled, with virtual drives that have no pattern."""
    rng = np.random.default_rng(len(arcs))
    count = len(arcs)
    names = [*AVERAGED, "vd_median"]
    status = np.full(count, "done", dtype=object)
    status[[k for k in failed if k < count]] = "failed"
    table = pd.DataFrame(
        {
            "route_id": [f"r{k % routes}" for k in range(count)],
            "arc_length": arcs,
            "status": status,
            **{name: rng.normal(size=count) for name in names},
        }
    )
    table.loc[table["status"] == "failed", names] = np.nan
    return table.sample(frac=1.0, random_state=0).reset_index(drop=True)


@settings(deadline=None)
@given(
    arcs=st.lists(st.integers(0, 60).map(lambda k: k / 4.0), min_size=1, max_size=30, unique=True),
    failed=st.lists(st.integers(0, 29), max_size=6),
    routes=st.integers(1, 3),
    width=KERNELS,
)
def test_neighbours_are_averaged_in_pairs(
    arcs: list[float], failed: list[int], routes: int, width: float
) -> None:
    """A literal reference: from each place one step behind and one ahead, while both are near."""
    table = drives(arcs, failed, routes)
    found = averaged_along(table, width)
    for _, route in table[table["status"] == "done"].groupby("route_id"):
        rows = route.sort_values("arc_length").to_dict("records")
        order = route.sort_values("arc_length").index
        for k, row in enumerate(rows):
            parts = [(1.0, row)]
            for step in range(1, min(k, len(rows) - 1 - k) + 1):
                pair = [(abs(r["arc_length"] - row["arc_length"]), r) for r in
                        (rows[k - step], rows[k + step])]  # fmt: skip
                if max(pair, key=lambda one: one[0])[0] > CUT * width:
                    break
                parts += [(math.exp(-0.5 * (away / width) ** 2), r) for away, r in pair]
            total = sum(weight for weight, _ in parts)
            for name in AVERAGED:
                expected = sum(weight * r[name] for weight, r in parts) / total
                assert found[name][order[k]] == pytest.approx(expected, abs=1e-12)
    untouched = ["route_id", "arc_length", "status", "vd_median"]
    pd.testing.assert_frame_equal(found[untouched], table[untouched])
    failed_rows = table["status"] == "failed"
    assert found.loc[failed_rows, list(AVERAGED)].isna().all(axis=None)


@settings(deadline=None)
@given(cut=st.floats(0.0, 15.0), failed=st.lists(st.integers(0, 39), max_size=6), width=KERNELS)
def test_company_does_not_show_in_an_average(cut: float, failed: list[int], width: float) -> None:
    table = drives([0.4 * k for k in range(40)], failed, 1)
    whole = averaged_along(table, width)
    part = table[table["arc_length"] <= cut + CUT * width + 1e-6]
    mine = part.index[part["arc_length"] <= cut]
    pd.testing.assert_frame_equal(
        averaged_along(part, width).loc[mine], whole.loc[mine], check_exact=True
    )


@pytest.mark.parametrize("width", WIDTHS)
def test_a_slope_stays_a_slope_to_the_ends(width: float) -> None:
    """A one-sided mean would bend it there."""
    table = drives([float(k) for k in range(20)], [], 1).sort_values("arc_length")
    table[list(AVERAGED)] = 3.0 + 0.1 * table[["arc_length"] * len(AVERAGED)].to_numpy()
    found = averaged_along(table, width)
    np.testing.assert_allclose(found[list(AVERAGED)], table[list(AVERAGED)], atol=1e-12)


def test_noise_falls_as_the_kernel_widens() -> None:
    table = drives([float(k) for k in range(400)], [], 1).sort_values("arc_length")
    spread = [averaged_along(table, width)["vd_mean"].iloc[9:-9].std() for width in WIDTHS]
    assert spread == sorted(spread, reverse=True)
    weight = np.exp(-0.5 * (np.arange(-3, 4) / 1.5) ** 2)
    expected = np.sqrt((weight**2).sum()) / weight.sum()
    assert spread[2] / spread[0] == pytest.approx(expected, rel=0.15)


def test_a_route_may_have_a_name_of_several_columns() -> None:
    """Two drives along the same routes, in one table, as each alone."""
    one, two = (drives([0.3 * k + at for k in range(24)], [5], 2) for at in (0.0, 0.1))
    both = pd.concat([one.assign(group="a"), two.assign(group="b")], ignore_index=True)
    found = averaged_along(both.sample(frac=1.0, random_state=1), 1.5, by=("group", "route_id"))
    alone = pd.concat([averaged_along(table, 1.5) for table in (one, two)], ignore_index=True)
    pd.testing.assert_frame_equal(found.sort_index().drop(columns="group"), alone, check_exact=True)


def test_places_far_apart_stand_for_themselves_and_no_width_changes_nothing() -> None:
    table = drives([0.0, 3.5, 7.0, 10.5], [], 1)
    pd.testing.assert_frame_equal(averaged_along(table, 1.5), table)
    near = drives([0.0, 1.0, 2.0, 3.0], [], 1)
    pd.testing.assert_frame_equal(averaged_along(near, 0.0), near)


def test_tasks_read_the_tiles_as_far_as_the_widest_kernel_reaches() -> None:
    assert CUT * max(WIDTHS) == REACH
    assert NEIGHBOURS_MM > 1000 * REACH
