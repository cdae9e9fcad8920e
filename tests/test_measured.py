"""Measured errors beside estimates: the nearest label counts, of several drives the largest."""

import numpy as np
import pandas as pd
import pytest

from tilestream.errors import UsageError
from tilestream.model.training import ESTIMATES
from tilestream.report.measured import MEASURES, measure_of, measured_column, with_measured


def places(count: int = 20) -> pd.DataFrame:
    estimates = {name: np.linspace(0.02, 0.04, count) for name in ESTIMATES.values()}
    return pd.DataFrame({"route_id": "a", "arc_length": np.arange(count, dtype=float), **estimates})


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
    found = with_measured(table, known, 0.7)["measured_mean"]
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
