"""What estimates are said to be worth follows from what is known, and what is not known is said."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
import stand_in
from hypothesis import example, given
from hypothesis import strategies as st

from tilestream.pipeline.jobs.run_worth import FEW_PLACES, worth_of
from tilestream.report.formatting import cm_about, cm_limit, cm_span
from tilestream.report.worth import BLOCKS, ELSEWHERE, HERE, NOWHERE, OWN, SIMULATION, Worth

NO_LABELS = pd.DataFrame()
CARD = {
    "runs": {"a": {"preset": "paper"}, "b": {"preset": "physical"}},
    "places": 9000,
    "drives": ["a/I", "a/II", "b/I"],
    "paths": ["I", "II"],
    "lidars": ["VLP16", "HDL64"],
    "checked": stand_in.CHECKED,
}


def places(estimate: list[float], in_domain: list[bool | None] | None = None) -> pd.DataFrame:
    values = np.array(estimate)
    like = pd.array(in_domain or [True] * len(values), dtype="boolean")
    table = {"estimate": values, "low": 0.5 * values, "high": 2.0 * values, "in_domain": like}
    return pd.DataFrame(table)


def labels(actual: list[float], held_out: list[float]) -> pd.DataFrame:
    said = np.array(held_out)
    table = {"error_mean": actual, "held_out": said, "low": 0.5 * said, "high": 1.5 * said}
    return pd.DataFrame({"group": "drive", **table})


def worth(of: pd.DataFrame = NO_LABELS, card: dict[str, Any] | None = None, **known: Any) -> Any:
    return worth_of(
        places([0.03, 0.06, 0.1, np.nan], [True, False, True, None]),
        of,
        model="a model",
        card=CARD if card is None else card,
        facts={},
        **known,
    )


def test_measured_errors_of_this_map_prove_more_than_a_card() -> None:
    found = worth(labels([0.04, 0.05, 0.2], [0.05, 0.07, 0.1]), shipped=True)
    assert (found.checked, found.places, found.drives) == (HERE, 3, 1)
    assert found.mae == pytest.approx((0.01 + 0.02 + 0.1) / 3)
    assert (found.spearman, found.coverage) == (1.0, pytest.approx(2 / 3))
    assert (found.median, found.low, found.high) == (0.06, 0.03, 0.12)
    assert found.outside == pytest.approx(1 / 3)
    assert "of the places are unlike" in found.told[-1]


def test_labels_that_no_estimate_was_held_out_for_prove_nothing() -> None:
    nothing = labels([0.04, 0.05], [np.nan, np.nan])
    assert worth(nothing, shipped=True).checked == ELSEWHERE
    found = worth(nothing, blocks={"mae": 0.01, "points": 60, "spearman": np.nan})
    assert (found.checked, found.places, found.mae, found.spearman) == (BLOCKS, 60, 0.01, None)


def test_drives_of_a_simulated_city_are_no_real_ones() -> None:
    assert worth(labels([0.04, 0.05], [0.05, 0.06]), simulated=True).checked == SIMULATION


def test_the_card_says_where_it_was_checked() -> None:
    found = worth(shipped=True)
    assert (found.checked, found.places, found.drives) == (ELSEWHERE, 431, 5)
    assert (found.level_low, found.level_high, found.coverage) == (0.8, 1.25, 0.84)
    assert found.mae == 0.024
    assert found.simulated
    assert "0.8 to 1.2" in " ".join(found.told)
    assert worth().checked == OWN  # a model of one's own, of drives elsewhere
    held = {name: entry for name, entry in stand_in.CHECKED.items() if name != "real drives"}
    found = worth(card={**CARD, "checked": held}, shipped=True)
    assert (found.checked, found.places) == (SIMULATION, 9000)
    real = {**CARD, "runs": {"a": {}}, "checked": held}
    assert worth(card=real).checked == OWN


keys = st.sampled_from(
    ["places", "drives", "spearman", "level", "coverage", "mae_m", "median_m", "skill"]
)
values = st.none() | st.floats() | st.text(max_size=3) | st.lists(st.floats() | st.none())
entries = st.dictionaries(keys, values | st.dictionaries(st.text(max_size=3), values))
names = st.sampled_from(["real drives", "held-out paths", "held-out lidar"])


@example({"real drives": {"mae_m": 1e308, "median_m": 1e-300}})
@example({"real drives": {"mae_m": 1.0, "median_m": -1.0}})
@given(st.none() | st.text(max_size=3) | st.dictionaries(names, entries | values))
def test_a_card_may_lack_anything(checked: Any) -> None:
    found = worth(card={"checked": checked})
    assert found.told
    assert found.mae is None or np.isfinite(found.mae)
    assert all("nan" not in sentence and "None" not in sentence for sentence in found.told)


def test_an_old_model_is_not_known_and_says_so() -> None:
    found = worth(card={})
    assert (found.checked, found.mae, found.trained_places) == (NOWHERE, None, None)
    assert any("not known" in sentence for sentence in found.told)
    assert found.digits == 2


@pytest.mark.parametrize(
    ("card", "said"),
    [
        (
            {"places": FEW_PLACES - 1, "drives": ["a", "b"], "paths": ["I"]},
            [f"{FEW_PLACES - 1} pl"],
        ),
        ({"places": FEW_PLACES, "drives": ["a"], "paths": ["I", "II"]}, []),
        ({"places": 120, "drives": ["a"], "paths": ["I"]}, ["120 places only", "one drive of one"]),
    ],
)
def test_a_model_that_has_seen_little_says_so_first(card: dict[str, Any], said: list[str]) -> None:
    found = worth(card=card)
    assert len(found.warnings) == len(said)
    for warning, part, sentence in zip(found.warnings, said, found.told, strict=False):
        assert part in warning
        assert sentence == warning


def test_of_an_older_card_the_facts_tell_how_much_was_seen() -> None:
    facts = {"points": 120, "groups": ["a"], "paths": ["I"]}
    found = worth_of(places([0.1]), NO_LABELS, model="old", card={}, facts=facts)
    assert (found.trained_places, found.trained_drives, found.trained_streets) == (120, 1, 1)


def test_estimates_have_the_digits_that_they_deserve() -> None:
    assert worth(labels([0.06, 0.07], [0.084, 0.094])).digits == 2  # off by 40 %
    assert worth(labels([0.06, 0.07], [0.061, 0.071])).digits == 3
    assert worth(labels([0.01, 0.02], [0.2, 0.3])).digits == 1
    told = [cm_about(x, 2).replace("\u00a0", " ") for x in (0.01234, 0.1234, 1.234, 0.0996, 0.0)]
    assert told == ["1.2 cm", "12 cm", "120 cm", "10 cm", "0.0 cm"]
    assert cm_about(0.1234, None).replace("\u00a0", " ") == "12.3 cm"
    assert cm_about(float("nan"), 2) == "none"
    assert cm_span(0.0312, 0.1567, 2).replace("\u00a0", " ") == "3.1 to 16 cm"


@given(st.floats(1e-4, 10.0), st.integers(1, 3))
def test_no_more_digits_are_told_and_none_is_wrong(metres: float, digits: int) -> None:
    told = cm_about(metres, digits).split("\u00a0")[0]
    assert float(told) == pytest.approx(100.0 * metres, rel=0.51 * 10.0 ** (1 - digits))
    assert len(told.replace(".", "").strip("0")) <= digits


@pytest.mark.parametrize("entry", ["real drives", "held-out paths"])
def test_elsewhere_estimates_are_off_in_proportion(entry: str) -> None:
    """A street of good places has smaller estimates, which are off by less."""
    card = {**CARD, "checked": {entry: {"places": 900, "mae_m": 0.06, "median_m": 0.12}}}
    found = worth(card=card, shipped=True)
    assert found.median is not None
    assert found.mae == pytest.approx(0.5 * found.median)
    assert found.share == pytest.approx(0.5)
    here = worth(labels([0.04, 0.05], [0.05, 0.06]), card=card, shipped=True)
    assert here.mae == pytest.approx(0.01)  # what was measured here counts as it is


def test_a_limit_keeps_all_digits_that_were_given() -> None:
    told = [cm_limit(x).replace("\u00a0", " ") for x in (0.001, 0.07, 0.125, 0.3, 1.1)]
    assert told == ["0.1 cm", "7 cm", "12.5 cm", "30 cm", "110 cm"]


def test_a_few_places_tell_no_correlation() -> None:
    few, enough = (
        Worth("a model", HERE, places=places, drives=1, spearman=-1.0, coverage=1.0)
        for places in (9, 10)
    )
    assert "too few to tell" in " ".join(few.told)
    assert "correlation" not in " ".join(few.told)
    assert "-1.00" in " ".join(enough.told)
