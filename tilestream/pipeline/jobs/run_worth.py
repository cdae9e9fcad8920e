"""What the estimates of a run are worth, from its own labels and from the card of its model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from tilestream.model.card import CHECKED
from tilestream.report.data import estimates, like_training
from tilestream.report.formatting import known
from tilestream.report.worth import (
    BLOCKS,
    ELSEWHERE,
    HELD_OUT,
    HERE,
    NOWHERE,
    OWN,
    SIMULATION,
    Worth,
)

FEW_PLACES = 500
"""A model of fewer places says so."""
REAL = "real drives"
"""The entry of a card's `checked` that is of real drives; the others are what was held out of the
data that it was trained on."""


def worth_of(
    places: pd.DataFrame,
    labels: pd.DataFrame,
    *,
    model: str,
    card: Mapping[str, Any],
    facts: Mapping[str, Any],
    blocks: Mapping[str, Any] | None = None,
    simulated: bool = False,
    shipped: bool = False,
    warnings: Sequence[str] = (),
) -> Worth:
    """What the estimates of a run are worth.

    Args:
        places: every sample point with its estimate.
        labels: measured places, with `held_out` estimates, `low` and `high`.
        model: what makes the estimates, in words.
        card: its card; one of an older version is empty, and nothing trained has none.
        facts: how it was trained, likewise.
        blocks: of a model that was trained here, how it estimates held-out blocks (`Figures`).
        simulated: whether city and drives of the run are simulated.
        shipped: whether it came with tilestream.
        warnings: why to trust them less, besides what the model itself tells.
    """
    estimate = estimates(places)
    at = _median_place(estimate)
    like = like_training(places)
    compared = int((like != "not known").sum())
    trained = _trained(card, facts)
    checks = _checks(labels, card, blocks, shipped, (simulated, trained["simulated"]))
    median, there = None if at is None else float(estimate[at]), checks.pop("median", None)
    if there is not None and there > 0.0 and median is not None and checks["mae"] is not None:
        checks["mae"] = _number(checks["mae"] * median / there)  # larger ones are off by more
    return Worth(
        model=model,
        **checks,
        median=median,
        **_ends(places, at),
        outside=int((like == "no").sum()) / compared if compared else None,
        **trained,
        warnings=(*warnings, *_small(trained)),
    )


def _ends(places: pd.DataFrame, at: int | None) -> dict[str, Any]:
    """`low` and `high` of a place [m]; of one that has none, as it is interpolated, those of the
    nearest estimate that has them.
    """
    if at is None:
        return {}
    estimate, has = estimates(places), np.flatnonzero(places["low"].notna())
    if has.size:
        at = int(has[np.argmin(np.abs(estimate[has] - estimate[at]))])
    return {name: _number(places[name].iloc[at]) for name in ("low", "high")}


def _median_place(estimate: Any) -> int | None:
    """The place with the median estimate; the upper one of an even number."""
    there = np.flatnonzero(np.isfinite(estimate))
    if not there.size:
        return None
    order = there[np.argsort(estimate[there], kind="stable")]
    return int(order[len(order) // 2])


def _trained(card: Mapping[str, Any], facts: Mapping[str, Any]) -> dict[str, Any]:
    """On what a model was trained, as far as card or facts say it."""
    runs = card.get("runs") or {}
    presets = [of.get("preset") for of in runs.values() if isinstance(of, Mapping)]
    return {
        "trained_places": _whole(card.get("places", facts.get("points"))),
        "trained_drives": _length(card.get("drives", facts.get("groups"))),
        "trained_streets": _length(card.get("paths", facts.get("paths"))),
        "trained_runs": len(runs) or None,
        "lidars": _length(card.get("lidars")),
        "simulated": bool(presets) and all(presets),
    }


def _small(trained: Mapping[str, Any]) -> list[str]:
    """What a model is warned of that has seen little."""
    places, one = trained["trained_places"], (trained["trained_drives"], trained["trained_streets"])
    said = []
    if places is not None and places < FEW_PLACES:
        said.append(f"The model has seen {places} places only: few of what a city has.")
    if one == (1, 1):
        said.append("The model has seen one drive of one street only.")
    return said


def _checks(
    labels: pd.DataFrame,
    card: Mapping[str, Any],
    blocks: Mapping[str, Any] | None,
    shipped: bool,
    simulated: tuple[bool, bool],
) -> dict[str, Any]:
    """The check that proves most of those that there are; whether drives here and the model's are
    simulated.
    """
    here = _of_labels(labels, SIMULATION if simulated[0] else HERE)
    if here:
        return here
    if blocks is not None and known(blocks.get("mae")):
        names = ("mae", "spearman", "spearman_low", "spearman_high")
        figures = {name: _number(blocks.get(name)) for name in names}
        where = SIMULATION if simulated[0] else BLOCKS
        found = {"checked": where, "mae_of": where, "places": _whole(blocks.get("points"))}
        return {**found, **figures}
    return _of_card(card.get(CHECKED), shipped, simulated[1])


def _of_labels(labels: pd.DataFrame, where: str) -> dict[str, Any]:
    """How estimates are off on the measured places that no model was trained on."""
    if labels.empty:
        return {}
    there = labels[np.isfinite(labels["held_out"]) & np.isfinite(labels["error_mean"])]
    if there.empty:
        return {}
    actual, said = there["error_mean"], there["held_out"]
    vary = min(np.ptp(actual), np.ptp(said)) > 0.0
    spans = there[there["low"].notna()]
    inside = spans["error_mean"].between(spans["low"], spans["high"])
    return {
        "checked": where,
        "mae_of": where,
        "places": len(there),
        "drives": int(there["group"].nunique()),
        "mae": float((said - actual).abs().mean()),
        "spearman": float(spearmanr(actual, said).statistic) if vary else None,
        "coverage": float(inside.mean()) if len(spans) else None,
    }


def _of_card(checked: Any, shipped: bool, simulated: bool) -> dict[str, Any]:
    """What a card says of how its model was checked; what it does not say is not known."""
    entries = {} if not isinstance(checked, Mapping) else dict(checked)
    real = entries.pop(REAL, None)
    held = [one for one in entries.values() if isinstance(one, Mapping)]
    # of what was held out, the protocol with the largest error: the most honest one
    errors = [one for one in held if _number(one.get("mae_m")) is not None]
    worst = _off(max(errors, key=lambda one: float(one["mae_m"]))) if errors else _off({})
    if isinstance(real, Mapping):
        where, own = ELSEWHERE if shipped else OWN, _off(real)
        of = worst | {"mae_of": HELD_OUT} if own["mae"] is None else own | {"mae_of": where}
        return {"checked": where, **_entry(real), **of}
    if not held:
        return {"checked": NOWHERE}
    most = max(held, key=lambda one: _whole(one.get("places")) or 0)
    where = SIMULATION if shipped or simulated else OWN
    return {"checked": where, **_entry(most), **worst, "mae_of": where}


def _off(of: Mapping[str, Any]) -> dict[str, Any]:
    """How far estimates were off on average, and their median [m]."""
    return {"mae": _number(of.get("mae_m")), "median": _number(of.get("median_m"))}


def _entry(of: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of a card's `checked`."""
    middle, low, high = _triple(of.get("spearman"))
    levels = of.get("level")
    ratios = levels.values() if isinstance(levels, Mapping) else ()
    found = [ratio for value in ratios if (ratio := _number(value)) is not None]
    return {
        "places": _whole(of.get("places")),
        "drives": _whole(of.get("drives")),
        "spearman": middle,
        "spearman_low": low,
        "spearman_high": high,
        "coverage": _triple(of.get("coverage"))[0],
        "level_low": min(found, default=None),
        "level_high": max(found, default=None),
    }


def _triple(value: Any) -> tuple[float | None, float | None, float | None]:
    """A figure and the ends of its interval, as far as they are there."""
    several = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    numbers = [_number(one) for one in several[:3]] + [None] * 3
    return numbers[0], numbers[1], numbers[2]


def _number(value: Any) -> float | None:
    plain = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return float(value) if plain and np.isfinite(value) else None


def _whole(value: Any) -> int | None:
    number = _number(value)
    return None if number is None else int(number)


def _length(values: Any) -> int | None:
    return len(values) if isinstance(values, Sequence) and not isinstance(values, str) else None
