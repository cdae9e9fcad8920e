"""How far estimates are from what was measured, and how sure that is."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from tilestream.errors import ModelError
from tilestream.model.bootstrap import resampled, resampled_spearman, span
from tilestream.records import Float64

SEGMENT = 12.0
"""Length of the segments over which figures are told besides those of single places [m]."""


@dataclass(frozen=True)
class Figures:
    """How far estimates are from what was measured."""

    points: int
    """How many points."""
    rmse: float
    """Root mean square error [unit of the target; m for lengths]."""
    mae: float
    """Mean absolute error [the same]."""
    within_25mm: float
    """Share of the points estimated with an error below 2.5 cm."""
    within_50mm: float
    """Share of the points estimated with an error below 5 cm."""
    r2: float
    """1 - squared error / squared deviation from the mean of the labels; NaN if they are all
    alike."""
    skill: float
    """1 - MAE / MAE of the training median; NaN if that is 0."""
    spearman: float
    """Rank correlation of estimate and label; NaN where one of them is constant."""


def figures(actual: Float64, estimate: Float64, median: Float64) -> Figures:
    """The figures of estimates.

    Args:
        actual: (n,) labels.
        estimate: (n,) estimates of them.
        median: (n,) the training median at each point, for the skill.

    Raises:
        ModelError: no points.
    """
    if not len(actual):
        raise ModelError("no points to evaluate")
    error = np.abs(estimate - actual)
    spread = float(((actual - actual.mean()) ** 2).sum())
    of_median = float(np.abs(median - actual).mean())
    vary, both_vary = np.ptp(actual) > 0.0, np.ptp(actual) > 0.0 and np.ptp(estimate) > 0.0
    return Figures(
        points=len(actual),
        rmse=float(np.sqrt((error**2).mean())),
        mae=float(error.mean()),
        within_25mm=float((error < 0.025).mean()),
        within_50mm=float((error < 0.05).mean()),
        r2=1.0 - float((error**2).sum()) / spread if vary else float("nan"),
        skill=1.0 - float(error.mean()) / of_median if of_median > 0.0 else float("nan"),
        spearman=float(spearmanr(actual, estimate).statistic) if both_vary else float("nan"),
    )


_TRIPLE: Sequence[str] = ("actual", "estimate", "median")


def figures_of(points: pd.DataFrame) -> Figures:
    """The figures of `held_out` points."""
    return figures(*(points[name].to_numpy(np.float64) for name in _TRIPLE))


SPANS = tuple(f"{name}_{end}" for name in ("skill", "spearman") for end in ("low", "high"))
"""Names of the ends of the intervals round skill and rank correlation."""
OF_SEGMENTS = ("points", "mae", "skill", "spearman", *SPANS)
"""What is told of segments, behind `segment_`."""
FIGURES = (
    *(part.name for part in fields(Figures)),
    *SPANS,
    *(f"segment_{name}" for name in OF_SEGMENTS),
)
"""The names of `with_spans`."""


def with_spans(points: pd.DataFrame) -> dict[str, float]:
    """The figures of held-out points, of single places and of segments, with their intervals.

    Args:
        points: `group`, `path`, `block`, `fold`, `arc_length` [m], `actual`, `estimate`, `median`.

    Returns:
        By the names of `FIGURES`: the fields of `Figures`; `skill_low` and so on, the ends of the
        90 % intervals by resampled blocks (NaN of a single block); `segment_skill` and so on, the
        same of means over segments (`segments_of`; NaN where there is none).
    """
    segments = segments_of(points)
    found = asdict(figures_of(points)) | _spans(points)
    of_segments = dict.fromkeys(OF_SEGMENTS, float("nan")) | {"points": 0}
    if len(segments):
        of_segments |= asdict(figures_of(segments)) | _spans(segments)
    return found | {f"segment_{name}": of_segments[name] for name in OF_SEGMENTS}


def segments_of(points: pd.DataFrame) -> pd.DataFrame:
    """Means over windows of `SEGMENT` along each path, of those that have at least half of their
    places: as many as the median step between places gives.

    Returns:
        As `points`, a row per group, path and window. `median` is that of the segments of the other
        folds; of all, where there is one fold.
    """
    keys = ["group", "path"]
    ordered = points.sort_values([*keys, "arc_length"], kind="stable")
    step = ordered.groupby(keys)["arc_length"].agg(lambda arc: arc.diff().median())
    windows = ordered.assign(window=ordered["arc_length"] // SEGMENT).groupby([*keys, "window"])
    table = windows.agg(
        block=("block", "first"),
        fold=("fold", "first"),
        arc_length=("arc_length", "mean"),
        actual=("actual", "mean"),
        estimate=("estimate", "mean"),
        places=("actual", "size"),
    ).reset_index()
    whole = SEGMENT / step.reindex(pd.MultiIndex.from_frame(table[keys])).to_numpy()
    table = table[2.0 * table["places"].to_numpy() >= whole].drop(columns=["window", "places"])
    folds = table["fold"].unique()
    if len(folds) < 2:
        return table.assign(median=table["actual"].median())
    others = {fold: table.loc[table["fold"] != fold, "actual"].median() for fold in folds}
    return table.assign(median=table["fold"].map(others))


def difference(points: pd.DataFrame, others: pd.DataFrame) -> dict[str, float]:
    """How much better some estimates are than others of the same held-out points, paired.

    Args:
        points: as of `with_spans`, and `row`, which names a point.
        others: the same points as another model estimates them.

    Returns:
        `points`; `mae`, by how much their mean absolute error is smaller, and `skill`, by how much
        their skill is larger; `mae_low` and so on, the ends of the 90 % intervals by resampled
        blocks (NaN of a single block).
    """
    pairs = points.merge(others[["row", "estimate"]], on="row", suffixes=("", "_other"))
    actual = pairs["actual"]
    gain = (pairs["estimate_other"] - actual).abs() - (pairs["estimate"] - actual).abs()
    parts = pd.DataFrame(
        {"gain": gain, "median": (pairs["median"] - actual).abs(), "points": 1.0}
    ).groupby(pairs["block"])
    sums = parts.sum()[["gain", "median", "points"]].to_numpy()
    found: dict[str, float] = {"points": len(pairs)}
    for name, of in (("mae", 2), ("skill", 1)):
        found[name] = _ratio(sums.sum(axis=0)[None], of)[0]
        found |= _ends(name, _ratio(resampled(len(sums)) @ sums, of), len(sums))
    return found


def _ratio(sums: Float64, of: int) -> Float64:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = sums[:, 0] / sums[:, of]
    return ratio


def _spans(points: pd.DataFrame) -> dict[str, float]:
    """`SPANS` of points."""
    actual, estimate, median = (points[n].to_numpy(np.float64) for n in _TRIPLE)
    names, block = np.unique(points["block"].to_numpy(str), return_inverse=True)
    counts = resampled(len(names))
    error, of_median = (
        counts @ np.bincount(block, np.abs(values - actual)) for values in (estimate, median)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        skill = 1.0 - error / of_median
    ranks = resampled_spearman(actual, estimate, block, counts)
    return _ends("skill", skill, len(names)) | _ends("spearman", ranks, len(names))


def _ends(name: str, resampled_figures: Float64, blocks: int) -> dict[str, float]:
    """The ends of an interval; a single block tells nothing of others."""
    nothing = float("nan"), float("nan")
    low, high = span(resampled_figures) if blocks > 1 else nothing
    return {f"{name}_low": low, f"{name}_high": high}
