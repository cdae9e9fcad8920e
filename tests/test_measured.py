"""Measured errors beside estimates: the nearest label counts, of several drives the largest."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.errors import UsageError
from tilestream.model.training import ESTIMATES
from tilestream.report.gate import gate
from tilestream.report.measured import MEASURES, measure_of, measured_column, with_measured
from tilestream.report.summary import headline


def places(count: int = 20) -> pd.DataFrame:
    estimates = {name: np.linspace(0.02, 0.04, count) for name in ESTIMATES.values()}
    own = {"route_id": "a", "arc_length": np.arange(count, dtype=float), "status": "done"}
    return pd.DataFrame(own | estimates)


def labels(group: str, path: str, arc: list[float], error: list[float]) -> pd.DataFrame:
    columns = dict.fromkeys(MEASURES.values(), error)
    return pd.DataFrame({"group": group, "path": path, "arc_length": arc, **columns})


def literal(table: pd.DataFrame, known: pd.DataFrame, reach: float) -> list[float]:
    """Per place the largest of what each drive's nearest label within reach says."""
    found = []
    for _, place in table.iterrows():
        near = []
        for _, drive in known.groupby("group"):
            here = drive[drive["path"] == place["route_id"]]
            away = (here["arc_length"] - place["arc_length"]).abs()
            if len(here) and away.min() <= reach:
                near.append(here.loc[away.idxmin(), "error_mean"])
        found.append(max(near, default=np.nan))
    return found


def test_the_nearest_label_counts_and_of_drives_the_largest() -> None:
    rng = np.random.default_rng(3)
    drives = [
        labels(name, path, list(np.sort(rng.uniform(0, 20, 6))), list(rng.uniform(0, 0.3, 6)))
        for name in ("one", "two")
        for path in ("a", "b")
    ]
    known, table = pd.concat(drives, ignore_index=True), places()
    found = with_measured(table, known, 0.7)["measured"]
    assert found.to_numpy() == pytest.approx(literal(table, known, 0.7), nan_ok=True)
    assert 0 < found.notna().sum() < len(table)


def test_without_labels_nothing_is_measured_and_the_estimate_is_what_is_known() -> None:
    found = with_measured(places(), pd.DataFrame(), 0.5)
    for name, label in MEASURES.items():
        assert found[measured_column(name)].isna().all()
        one = measure_of(found, name)
        assert np.array_equal(one.known, found[ESTIMATES[label]])


def test_what_is_known_is_the_larger_of_the_two() -> None:
    found = with_measured(places(), labels("d", "a", [3.0, 9.0], [0.067, 0.001]), 0.4)
    one = measure_of(found, "tail")
    assert one.known[3] == 0.067
    assert one.known[9] == one.estimate[9]
    blind = found.assign(tail=np.nan)
    assert np.isfinite(measure_of(blind, "tail").known).sum() == 2


def test_an_unknown_measure_is_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"yaw.*mean, along"):
        measure_of(places(), "yaw")


# --- What counts: the gate and the headline


def test_the_gate_counts_measured_errors_and_says_which_it_was() -> None:
    found = with_measured(places(), labels("d", "a", [3.0], [0.067]), 0.4)
    assert gate(places(), 0.05) == []
    (closed,) = gate(found, 0.05)
    assert "mean: 1 of 20 sample points are above 0.05 m, the worst 0.07 m on a at 3 m" in closed
    assert closed.endswith("measured")


def test_the_gate_asks_for_one_part_of_the_error() -> None:
    table = places().assign(p_fail=0.2, tail=0.5)
    assert gate(table, 0.3, measure="p_fail") == []
    assert "20 of 20" in gate(table, 0.3, measure="tail")[0]
    with pytest.raises(UsageError, match="no measure"):
        gate(table, 0.3, measure="yaw")


def test_segments_are_means_so_that_one_place_does_not_close_the_gate() -> None:
    """24 places of 1 m are two segments of 12 m."""
    table = places(24).assign(estimate=np.where(np.arange(24) == 5, 0.25, 0.01))
    assert gate(table, 0.2) != []
    assert gate(table, 0.2, over="segments") == []
    mean = (0.25 + 11 * 0.01) / 12
    (closed,) = gate(table, mean - 1e-6, over="segments")
    assert "1 of 2 segments of 12 m" in closed
    assert closed.endswith("on a at 0 m, estimated")


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30), st.floats(0.01, 1.0))
def test_a_gate_of_segments_is_never_stricter_than_one_of_places(
    errors: list[float], limit: float
) -> None:
    table = places(len(errors)).assign(estimate=errors)
    if gate(table, limit) == []:
        assert gate(table, limit + 1e-12, over="segments") == []


def test_the_headline_tells_what_was_measured_beside_the_estimates() -> None:
    table = places().assign(in_domain=True, reason="", sample=np.arange(20))
    known = with_measured(table, labels("d", "a", [3.0, 7.0], [0.067, 0.02]), 0.4)
    plain, beside = headline(table, 0.05), headline(known, 0.05)
    assert (plain["over"], plain["measured"], plain["measured_max"]) == (0, 0, None)
    assert (beside["over"], beside["measured"], beside["measured_over"]) == (1, 2, 1)
    assert beside["measured_max"] == 0.067
    assert beside["max"] == plain["max"]
