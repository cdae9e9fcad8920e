"""The paper's Table I and Table III of any measured paths."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.report.paper_tables import (
    LIMITS,
    paper_table_i,
    paper_table_iii,
    table_i,
    table_iii,
)

ERRORS = st.lists(st.floats(0.0, 0.5), min_size=1, max_size=30)


def labels_of(errors: dict[str, list[float]], lidar: str = "as recorded") -> pd.DataFrame:
    return pd.concat(
        [
            pd.DataFrame({
                "group": f"drive-{path}", "path": path, "as_sensor": lidar, "error_mean": of_path,
                "arc_length": 2.0 * np.arange(len(of_path)),
            })
            for path, of_path in errors.items()
        ],
        ignore_index=True,
    )  # fmt: skip


def test_the_papers_tails_are_the_weighted_ones_and_its_937_the_unweighted() -> None:
    """The figures of definitions, section 6.4, and of the paper's section III, from its tables."""
    paper = paper_table_i()
    assert paper["weighted"]["points"] == 3612
    told = [100 * share for share in paper["weighted"]["shares_over"].values()]
    assert told == pytest.approx([41.9, 17.8, 8.45, 4.31], abs=0.05)
    assert 1.0 - paper["unweighted"]["shares_over"]["0.25"] == pytest.approx(0.937, abs=0.002)
    assert sum(row["length"] for row in paper_table_iii()) == pytest.approx(3600.0)
    assert sum(row["points"] for row in paper_table_iii()) == 3612


@given(st.dictionaries(st.sampled_from("ABCDE"), ERRORS, min_size=1))
def test_weighted_shares_count_labels_and_unweighted_ones_paths(
    errors: dict[str, list[float]],
) -> None:
    (found,) = table_i(labels_of(errors))
    assert found["as_sensor"] == "as recorded"
    assert [row["path"] for row in found["paths"]] == sorted(errors)
    every = [error for of_path in errors.values() for error in of_path]
    for limit in LIMITS:
        name = f"{limit:.2f}"
        shares = {p: sum(e > limit for e in of) / len(of) for p, of in errors.items()}
        for row in found["paths"]:
            assert row["shares_over"][name] == pytest.approx(shares[row["path"]])
            assert row["points"] == len(errors[row["path"]])
        weighted, unweighted = found["weighted"], found["unweighted"]
        over = sum(error > limit for error in every)
        assert weighted["shares_over"][name] == pytest.approx(over / len(every))
        mean = sum(shares.values()) / len(shares)
        assert unweighted["shares_over"][name] == pytest.approx(mean)
    assert found["weighted"]["median"] == pytest.approx(float(np.median(every)))


def test_lidars_are_not_mixed_and_what_was_not_measured_does_not_count() -> None:
    good, blind = labels_of({"A": [0.05, np.nan]}), labels_of({"A": [0.3, 0.4]}, "10 m")
    less, usual = table_i(pd.concat([good, blind]))
    assert (less["as_sensor"], usual["as_sensor"]) == ("10 m", "as recorded")
    assert less["weighted"]["shares_over"]["0.25"] == 1.0
    assert usual["weighted"] == {
        "points": 1,
        "median": 0.05,
        "shares_over": dict.fromkeys(("0.10", "0.15", "0.20", "0.25"), 0.0),
    }
    assert table_i(pd.DataFrame()) == []


def test_table_three_tells_what_the_paths_are() -> None:
    labels = labels_of({"A": [0.1] * 5, "B": [0.1] * 3})
    labels["feature_count"] = [10.0, 20.0, 30.0, 40.0, 50.0, 1.0, 2.0, 3.0]
    again = labels[labels["path"] == "B"].assign(group="noon")
    one, two = table_iii(pd.concat([labels, again]), 2.0)
    assert one == {
        "path": "A", "cell_size": 2.0, "length": 8.0, "points": 5, "drives": 1,
        "feature_count": 30.0,
    }  # fmt: skip
    assert (two["length"], two["points"], two["drives"]) == (4.0, 6, 2)
    assert table_iii(pd.DataFrame()) == []
