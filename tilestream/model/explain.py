"""Why an estimate is high, in words: what raises it there, and what the map is like."""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import rankdata

from tilestream.model.phrases import (
    ACROSS,
    ALONG,
    REASSURING,
    SINKS,
    SLIDES_ACROSS,
    SLIDES_ALONG,
    TRAFFIC,
    UNMAPPED,
    UNSEEN,
    phrase_of,
)
from tilestream.records import Column, Float64

CLEAR = 0.15
"""Least rank correlation with the error [abs] at which one side of a factor counts as bad."""
ERRORS = 2.0
"""The correlation must also be this many of its standard errors."""
PIECE = 20.0
"""Points within this along a path count as one observation [m] (the correlation length of
definitions, section 6)."""
OUT = 1.0
"""A factor is named as a cause from this distance on [median to training quartile = 1]."""
OUT_MOST = 5.0
"""Larger distances count as this."""
NOTICEABLE = 0.03
"""A cause also differs from the median by this share of it: the quartiles of a factor that hardly
varies are too close to notice."""

AXES = {"vd_along": SLIDES_ALONG, "vd_across": SLIDES_ACROSS, "vd_up": SINKS}
"""The phrase for the direction in which a virtual drive errs most."""
BOUNDS = (
    ("ob_unmapped", 0.15, 1.0, UNMAPPED),
    ("ob_ghosts", 0.4, 1.0, TRAFFIC),
    ("ob_returns", 0.0, 0.5, UNSEEN),
)
"""Without training, a share between these bounds is unusual: by each of them fewer than a tenth of
the places of the simulated Shinjuku are."""
HALF = 0.5
"""A direction that is fixed less than this share of the one across to it is the weak one."""
SHARES = frozenset(
    {
        *(f"D{d}_{kind}" for d in (1, 2, 3) for kind in ("ratio", "share")),
        *("occupancy_ratio", "loose_share", "ob_returns", "ob_unmapped", "ob_ghosts", "vd_p_fail"),
    }
)
"""Factors that are written in percent."""
UNITS = {
    "1": (1.0, ""),
    "bit": (1.0, " bit"),
    "m^2": (1.0, "\u00a0m²"),
    "rad": (180.0 / np.pi, "°"),
    "1/m": (1.0, " per m"),
    "1/m^2": (1.0, " per m²"),
    "1/rad^2": (1.0, " per rad²"),
}
"""How a unit is written: the factor that values are multiplied by, and the text behind them."""


@dataclass(frozen=True, eq=False)
class Typical:
    """What factors are at the training places, and on which side of that errors are larger."""

    names: tuple[str, ...]
    """All factors of the dataset, also those that the regressor does not read."""
    units: tuple[str, ...]
    """Their units (`Column.unit`)."""
    middle: Float64
    """(f,) median of each."""
    below: Float64
    """(f,) from the lower quartile to the median; the standard deviation where they are equal."""
    above: Float64
    """(f,) from the median to the upper quartile, likewise."""
    rho: Float64
    """(f,) rank correlation with the error; 0 for a factor that is the same everywhere."""
    clear: float
    """Least correlation [abs] that says on which side a factor is bad: `CLEAR`, and more on a short
    drive, where any factor may correlate with the error by chance."""

    def out(self, values: Float64) -> Float64:
        """(n, f) how far values lie above (> 0) or below the median; 1 is the quartile on that
        side, NaN becomes 0.
        """
        away = values - self.middle
        with np.errstate(invalid="ignore", divide="ignore"):
            out = away / np.where(away > 0.0, self.above, self.below)
        return np.where(np.isfinite(out), out, 0.0)


def typical_of(X: Float64, error: Float64, columns: Sequence[Column], pieces: int) -> Typical:
    """What is typical of training places.

    Args:
        X: (n, f) their factors.
        error: (n,) their errors.
        columns: the factors.
        pieces: how many independent observations the places are: pieces of `PIECE` of the paths.
    """
    low, middle, high = np.percentile(X, [25, 50, 75], axis=0)
    deviation = X.std(axis=0)
    ranks, of_error = rankdata(X, axis=0), rankdata(error)
    varies = (np.ptp(ranks, axis=0) > 0.0) & (np.ptp(of_error) > 0.0)
    rho = np.zeros(len(columns))
    for k in np.flatnonzero(varies):
        rho[k] = np.corrcoef(ranks[:, k], of_error)[0, 1]
    return Typical(
        tuple(column.name for column in columns),
        tuple(column.unit for column in columns),
        middle,
        np.where(middle > low, middle - low, deviation),
        np.where(high > middle, high - middle, deviation),
        rho,
        max(CLEAR, ERRORS / math.sqrt(pieces)),
    )


def in_words(
    contribution: Float64, names: Sequence[str], values: Float64, typical: Typical
) -> list[str]:
    """Why each estimate is high: a symptom, then causes; "" where nothing that raises it says why.

    1. What raises the estimate most and does not sound reassuring (`REASSURING`). Where there is a
       virtual drive it is what that does there.
    2. What else that the regressor reads raises it most, but for the virtual drive: what a scan
       would see there.
    3. What of the map's own factors lies farthest out, times how clearly errors go with it (those
       with which they do not go clearly are left out). The regressor need not read it.

    A cause, 2 or 3, lies beyond the training quartile, on the side that goes with larger errors and
    noticeably away from the median, and sounds like one. Factors that say the same (the counts are
    all correlated) are added up before they are ranked; nothing is said twice. Each phrase comes
    with the factor that weighs most in it, its value there and the median of the training places.

    Args:
        contribution: (n, k) what each factor adds (`Regressor.contributions`).
        names: (k,) those factors, each of them in `typical`.
        values: (n, f) the factors of `typical`; NaN where the table has none.
        typical: of the training places.
    """
    raised = np.zeros(values.shape)
    raised[:, [typical.names.index(name) for name in names]] = np.maximum(contribution, 0.0)
    high, out = values > typical.middle, typical.out(values)
    phrases = np.array(
        [[phrase_of(name, side) for name in typical.names] for side in (False, True)]
    )
    virtual, scan = (
        np.array([name.startswith(prefix) for name in typical.names]) for prefix in ("vd_", "ob_")
    )
    seen = np.abs(values - typical.middle) >= NOTICEABLE * np.abs(typical.middle)
    reassuring = np.isin(np.where(high, phrases[1], phrases[0]), list(REASSURING))
    bad = typical.rho * np.clip(out, -OUT_MOST, OUT_MOST)
    cause = (np.abs(out) >= OUT) & (bad > 0.0) & seen & ~reassuring & ~virtual
    own = ~scan & (np.abs(typical.rho) >= typical.clear)
    steps = (
        np.where(reassuring, 0.0, raised),
        np.where(cause, raised, 0.0),
        np.where(cause & own, bad, 0.0),
    )
    return [
        _reason(
            [step[row] for step in steps],
            phrases[high[row].astype(int), np.arange(len(virtual))],
            values[row],
            typical,
        )
        for row in range(len(values))
    ]


def _reason(
    steps: Sequence[Float64], phrases: NDArray[np.str_], x: Float64, typical: Typical
) -> str:
    """The heaviest phrase of each step that no step before has said."""
    said: dict[str, str] = {}
    for weight in steps:
        total: dict[str, float] = {}
        foremost: dict[str, int] = {}
        for k in np.argsort(-weight, kind="stable")[: np.count_nonzero(weight)]:
            phrase = str(phrases[k])
            total[phrase] = total.get(phrase, 0.0) + float(weight[k])
            foremost.setdefault(phrase, int(k))
        left = sorted(set(total) - set(said), key=lambda phrase: (-total[phrase], phrase))
        if left:
            said[left[0]] = compared(foremost[left[0]], float(x[foremost[left[0]]]), typical)
    return "; ".join(f"{phrase} ({figures})" for phrase, figures in said.items())


def compared(k: int, value: float, typical: Typical, *, named: bool = False) -> str:
    """A factor's value beside the typical one, in units that a person reads: `89 cm, typically
    5 cm`. Lengths and shares are named only if `named` is set: their unit shows what they are.
    """
    told = typical.names[k], typical.units[k], value, float(typical.middle[k])
    return told_beside(*told, named=named, word="typically")


def told_beside(
    name: str, of: str, value: float, other: float, *, named: bool = False, word: str
) -> str:
    """A value of a factor beside another one, in units that a person reads: `89 cm, before 5 cm`.

    Args:
        name: the factor.
        of: its unit (`Column.unit`).
        value: the value.
        other: the other one.
        named: name the factor also where it is a length or a share.
        word: what the other one is.
    """
    times, unit = UNITS.get(of, (1.0, f" {of}"))
    named = named or not (name in SHARES or of == "m")
    if name in SHARES:
        times, unit = 100.0, "\u00a0%"
    elif of == "m":
        times, unit = (100.0, "\u00a0cm") if abs(other) < 1.0 else (1.0, "\u00a0m")
    here, there = _apart(value * times, other * times)
    return f"{name + ' ' if named else ''}{here}{unit}, {word} {there}{unit}"


def _apart(value: float, other: float) -> tuple[str, str]:
    """Two numbers with as few digits as show that they differ, at least two and at most five."""
    for digits in range(2, 6):
        here, there = (
            np.format_float_positional(x, digits, unique=False, fractional=False, trim="-")
            for x in (value, other)
        )
        if here != there:
            break
    return here, there


def without_training(places: pd.DataFrame) -> list[str]:
    """Why the virtual drive errs at places where no training says what is usual: the direction in
    which it errs most, and what lies outside fixed bounds (`BOUNDS`). Each place for itself.

    Args:
        places: observability factors, none of them NaN.
    """
    needed = [*AXES, "ob_info_along", "ob_info_across", *(name for name, *_ in BOUNDS)]
    return [_of_drive(row) for row in places[needed].to_dict("records")]


def _of_drive(place: Mapping[Hashable, float]) -> str:
    axis = max(AXES, key=lambda name: place[name])
    said = [f"{AXES[axis]} ({100.0 * place[axis]:.0f}\u00a0cm)"]
    fixed = {ALONG: place["ob_info_along"], ACROSS: place["ob_info_across"]}
    weak, strong = sorted(fixed, key=lambda phrase: fixed[phrase])
    if fixed[strong] > 0.0 and fixed[weak] < HALF * fixed[strong]:
        share = 100.0 * max(fixed[weak], 0.0) / fixed[strong]
        said.append(f"{weak} ({share:.0f}\u00a0% of what fixes the other)")
    for name, low, high, phrase in BOUNDS:
        if low <= place[name] <= high:
            said.append(f"{phrase} ({100.0 * place[name]:.0f}\u00a0%)")
    return "; ".join(said)
