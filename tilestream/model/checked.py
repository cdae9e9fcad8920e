"""What a model over several runs is worth where it has not been trained: figures for its card."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.evaluation import held_out
from tilestream.model.figures import difference, with_spans
from tilestream.model.intervals import coverage
from tilestream.model.physics import Physics
from tilestream.model.splits import protocols_of

HELD_OUT = {"path": "held-out paths", "lidar": "held-out lidar", "district": "held-out district"}
"""What the protocols are called on a card."""
SHARES = ("p_fail",)
"""Targets that are no lengths."""
TARGETS = ("error_mean", "p_fail", "error_tail")
"""What is judged besides the mean, on held-out paths."""


def checked_of(dataset: Dataset, recipe: str, seed: int = 0) -> dict[str, Any]:
    """How well a recipe estimates streets, lidars and districts that it has not seen.

    Args:
        dataset: of several runs (`over_runs`).
        recipe: name of a regressor.
        seed: of the fits.

    Returns:
        Plain JSON: for `held-out paths`, `held-out lidar` and `held-out district` the places,
        `mae_m`, `median_m` (of the estimates) [m], `skill`, `segment_skill` and `spearman` (each
        with the ends of its 90 % interval), `coverage` (with its standard error), `over_physics`
        (by how much the skill is larger than that of the virtual drive plus one number, with its
        ends) and, for paths, `p_fail` (whose `mae` and `median` are shares) and `error_tail`
        likewise; of lidars and districts `of_paths`, their skill as a share of that of the same
        places on held-out paths. What cannot be held out is left out.
    """
    protocols = {one.name: one for one in protocols_of(dataset) if one.name in HELD_OUT}
    found: dict[str, Any] = {}
    of_paths = pd.DataFrame()
    for name, protocol in protocols.items():
        try:
            splits = protocol.splits(dataset, seed)
        except ModelError:
            continue
        for target in TARGETS if name == "path" else TARGETS[:1]:
            points = held_out(dataset, splits, recipe, target, seed)
            physics = held_out(dataset, splits, Physics.name, target, seed)
            told = _figures(points, physics)
            unit = "" if target in SHARES else "_m"
            told |= {f"{name}{unit}": told.pop(name) for name in ("mae", "median")}
            if target != TARGETS[0]:
                found[HELD_OUT[name]][target] = told
                continue
            found[HELD_OUT[name]] = told
            if name == "path":
                of_paths = points
            else:
                told["of_paths"] = _share(points, of_paths)
    return found


def _figures(points: pd.DataFrame, physics: pd.DataFrame) -> dict[str, Any]:
    figures, against = with_spans(points), difference(points, physics)
    whole = coverage(points).iloc[0]
    return {
        "places": len(points),
        "blocks": int(points["block"].nunique()),
        "mae": figures["mae"],
        "median": float(points["estimate"].median()),
        **{name: _ended(figures, name) for name in ("skill", "segment_skill", "spearman")},
        "coverage": [float(whole["covered"]), float(whole["error"])],
        "over_physics": _ended(against, "skill"),
    }


def _ended(figures: Mapping[str, float], name: str) -> list[float]:
    """A figure with the ends of its interval."""
    return [float(figures[f"{name}{end}"]) for end in ("", "_low", "_high")]


def _share(points: pd.DataFrame, of_paths: pd.DataFrame) -> float:
    """Skill of held-out points as a share of that of the same points on held-out paths; both
    against the same median.
    """
    both = points.merge(of_paths[["row", "estimate", "median"]], on="row", suffixes=("", "_path"))
    actual, median = both["actual"], both["median_path"]
    of_median = (median - actual).abs().mean()
    skill, most = (
        1.0 - (both[e] - actual).abs().mean() / of_median for e in ("estimate", "estimate_path")
    )
    return float(skill / most)
