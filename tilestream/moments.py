"""Where starts end, in moments: what a covariance is made of (definitions, section 5.4).

Of starts near the truth the held ones, which end within 0.5 m of it, make a core that has moments;
how many do not is told apart from it.
"""

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tilestream.records import Column, Criterion, FactorSet, Float64, Int64

AXES = ("along", "across", "up", "roll", "pitch", "yaw_vector")
"""The six signed errors of a start (`start_errors`)."""
PAIRS = tuple(itertools.combinations_with_replacement(AXES, 2))
"""Of which there are products: the upper triangle of a matrix, row by row."""
INDICES = tuple((AXES.index(a), AXES.index(b)) for a, b in PAIRS)
"""Row and column of each pair in that matrix."""
SCORES = ("nvtl", "tp")
"""What a matcher says of its own result."""


def unit_of(*axes: str) -> str:
    """The unit of the product of errors in some axes."""
    turns = sum(axis not in AXES[:3] for axis in axes)
    metres = len(axes) - turns
    parts = [unit + (f"^{n}" if n > 1 else "") for unit, n in (("m", metres), ("rad", turns)) if n]
    return " ".join(parts)


def moment_columns(
    prefix: str, starts: str, criterion: Criterion, source: str, factor_set: FactorSet = "faithful"
) -> tuple[Column, ...]:
    """The columns of `moments_of` by name: `<prefix>_p_fail`, `<prefix>_along`, …

    Args:
        prefix: of their names.
        starts: which starts, in words.
        criterion: of what kind they are.
        source: where they are defined.
        factor_set: to which they belong.
    """

    def column(name: str, unit: str, meaning: str) -> Column:
        return Column(f"{prefix}_{name}", criterion, unit, meaning, source, factor_set)

    held = f"of {starts} that hold"
    return (
        column("p_fail", "1", f"Share of {starts} that end more than 0.5 m away."),
        *(column(axis, unit_of(axis), f"Mean signed error in {axis} {held}.") for axis in AXES),
        *(column(f"{a}_{b}", unit_of(a, b), f"Mean of {a} times {b} {held}.") for a, b in PAIRS),
    )


def score_columns(
    prefix: str, starts: str, criterion: Criterion, source: str, factor_set: FactorSet = "faithful"
) -> tuple[Column, ...]:
    """The columns of `scores_of`; arguments as of `moment_columns`."""
    found = []
    for name, words in (("nvtl", "NVTL as Autoware says it"), ("tp", "transform probability")):
        for end, of in (("", "Mean"), ("_sd", "Standard deviation of the")):
            meaning = f"{of} {words}, of {starts} that hold."
            named = f"{prefix}_{name}{end}"
            found.append(Column(named, criterion, "1", meaning, source, factor_set))
    return tuple(found)


def moments_of(prefix: str, axes: Float64, held: NDArray[np.bool_]) -> dict[str, float]:
    """Moments of the held starts and the share of the others, in the columns of `moment_columns`.

    Args:
        prefix: of the names.
        axes: (k, 6) signed errors, `AXES` [m, rad].
        held: (k,) which starts end within 0.5 m.

    Returns:
        By name; NaN where nothing holds, all of it where there is no start.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        core, count = axes[held], np.float64(held.sum())
        mean = core.sum(axis=0) / count
        square = [(core[:, i] * core[:, j]).sum() / count for i, j in INDICES]
        p_fail = (~held).sum() / np.float64(len(held))
    return {
        f"{prefix}_p_fail": float(p_fail),
        **{f"{prefix}_{axis}": float(value) for axis, value in zip(AXES, mean, strict=True)},
        **{f"{prefix}_{a}_{b}": float(x) for (a, b), x in zip(PAIRS, square, strict=True)},
    }


def scores_of(prefix: str, nvtl: Float64, tp: Float64, held: NDArray[np.bool_]) -> dict[str, float]:
    """Means and standard deviations (over n) of the scores of held starts; NaN of nothing.

    Args:
        prefix: of the names.
        nvtl: (k,) NVTL as Autoware says it (`autoware_nvtl`).
        tp: (k,) transform probabilities.
        held: (k,) which starts end within 0.5 m.
    """
    found = dict.fromkeys((f"{prefix}_{n}{end}" for n in SCORES for end in ("", "_sd")), np.nan)
    if held.any():
        for name, values in zip(SCORES, (nvtl[held], tp[held]), strict=True):
            found[f"{prefix}_{name}"] = float(values.mean())
            found[f"{prefix}_{name}_sd"] = float(values.std())
    return found


def autoware_scores(
    nvtl: Float64, score: Float64, hits: Int64, points: ArrayLike
) -> tuple[Float64, Float64]:
    """(k,) NVTL and transform probability as Autoware publishes them.

    Its NVTL is over the points that have a cell, ours over all (definitions, section 5.1); its
    transform probability is the score per point.

    Args:
        nvtl: (k,) ours (`Registrations`).
        score: (k,) sums over the points.
        hits: (k,) points that have a cell.
        points: (k,) or one: points that were registered.
    """
    count = np.asarray(points, np.float64)
    return nvtl * count / hits, score / count


NEAR_COLUMNS = (
    *moment_columns("near", "starts within 1 m", "label", "definitions, section 5.4"),
    *score_columns("near", "starts within 1 m", "label", "definitions, section 5.4"),
)
"""Of a label: the starts that a filter's registration could have."""
