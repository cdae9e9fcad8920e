"""The gate of a map update: what grew, what is lost, and that nothing passes unseen."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_diffs import between

from tilestream.errors import UsageError
from tilestream.model.figures import SEGMENT
from tilestream.report import diff_gate

N = 40


def places(route: str = "r", **columns: object) -> pd.DataFrame:
    """Places a metre apart."""
    x = np.arange(float(N))
    at = {"route_id": route, "sample": np.arange(N), "arc_length": x, "x": x, "y": 0.0, "z": 2.0}
    parts: dict[str, Any] = {
        "estimate": 0.1,
        "along": 0.05,
        "p_fail": 0.0,
        "reason": "",
        "status": "done",
    }
    return pd.DataFrame(at | parts | columns)


def grown(by: object, **columns: object) -> pd.DataFrame:
    return places(estimate=0.1 + np.asarray(by, np.float64), **columns)


GROWTH = st.lists(st.floats(-0.05, 0.5), min_size=N, max_size=N)


@settings(max_examples=40)
@given(GROWTH, st.floats(0.01, 0.5))
def test_it_is_open_exactly_where_nothing_grew_by_more_than_the_limit(
    growth: list[float], limit: float
) -> None:
    old, new = places(), grown(growth)
    verdict = diff_gate(between(old, new), limit)
    most = (new["estimate"] - old["estimate"]).max()
    assert bool(verdict.closed) == (most > limit)
    assert verdict.judged == N


@settings(max_examples=40)
@given(GROWTH, st.floats(0.01, 0.5))
def test_over_segments_it_is_never_stricter_and_judges_their_means(
    growth: list[float], limit: float
) -> None:
    found = between(places(), grown(growth))
    one, means = diff_gate(found, limit), diff_gate(found, limit, over="segments")
    change = found.places.change
    parts = [change[k : k + int(SEGMENT)].mean() for k in range(0, N, int(SEGMENT))]
    assert means.judged == len(parts)
    assert bool(means.closed) == (max(parts) > limit)
    assert one.closed or not means.closed


def test_it_names_what_grew_most_and_by_how_much() -> None:
    growth = np.where(np.arange(N) == 7, 0.3, np.where(np.arange(N) == 9, 0.2, 0.0))
    (closed,) = diff_gate(between(places(), grown(growth)), 0.1).closed
    for said in ("2 of 40", "0.1 m", "0.3 m", "on r at 7 m"):
        assert said in closed
    assert diff_gate(between(places(), grown(growth)), 0.1, over="segments").closed == ()


def test_it_asks_for_one_part_of_the_error() -> None:
    found = between(places(), places(along=0.25, p_fail=0.5))
    assert diff_gate(found, 0.1).closed == ()
    (along,) = diff_gate(found, 0.1, "along").closed
    assert "along" in along
    assert "0.2 m" in along
    (fails,) = diff_gate(found, 0.1, "p_fail").closed
    assert "by 0.5 on" in fails
    with pytest.raises(UsageError, match="no measure"):
        diff_gate(found, 0.1, "yaw")  # type: ignore[arg-type]


def missing(count: int) -> pd.DataFrame:
    return places(estimate=np.where(np.arange(N) < count, np.nan, 0.1))


UNSEEN: dict[str, tuple[Callable[[], pd.DataFrame], Callable[[], pd.DataFrame], str]] = {
    "5 % are lost": (places, lambda: missing(2), ""),
    "more are lost": (places, lambda: missing(3), "3 of 40"),
    "all are lost": (places, lambda: missing(N), "no place is compared"),
    "a route is gone": (
        lambda: pd.concat([places(), places("other").assign(y=50.0)]),
        places,
        "compared on other (0 of 40)",
    ),
    "a route lies elsewhere": (
        lambda: pd.concat([places(), places("other").assign(y=50.0)]),
        lambda: pd.concat([places(), places("other").assign(y=52.0)]),
        "compared on other (0 of 40)",
    ),
    "a route has another name": (places, lambda: places("new name"), ""),
    "every second place": (places, lambda: places().iloc[::2], ""),
    "a first estimate": (lambda: missing(5), places, ""),
    "no part of that name": (
        lambda: places().drop(columns="along"),
        places,
        "along is not in the estimates of both",
    ),
}


@pytest.mark.parametrize("name", UNSEEN)
def test_what_is_not_compared_does_not_pass(name: str) -> None:
    old, new, why = UNSEEN[name]
    measure: Any = "along" if "part" in name else "mean"
    closed = diff_gate(between(old(), new()), 9.0, measure).closed
    assert bool(closed) == bool(why)
    assert why in "; ".join(closed)


def test_two_maps_without_estimates_do_not_pass() -> None:
    verdict = diff_gate(between(None, None, without=("old.zarr", "new.zarr")), 0.1)
    assert "old.zarr and new.zarr" in verdict.told
    assert not verdict.plain()["passed"]


def test_what_is_not_judged_is_said_though_the_gate_is_open() -> None:
    found = between(missing(5), places(), otherwise=True)
    verdict = diff_gate(found, 0.1)
    assert verdict.plain()["passed"]
    assert "5 sample points had no estimate before" in verdict.told
    assert "other settings" in verdict.told


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_a_limit_is_a_length(limit: float) -> None:
    with pytest.raises(UsageError, match="fail_worse"):
        diff_gate(between(places(), places()), limit)
