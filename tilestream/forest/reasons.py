"""Why an estimate is high, in words: from the factors that drive the trees there."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from sklearn.ensemble import RandomForestRegressor

from tilestream.records import Float64

WORDS_MAX = 2
"""Most causes named for a place."""
SHARE_MIN = 0.2
"""A cause is named when it has at least this share of all that raises the estimate."""

FEW = "few features in view"
CROWDED = "a crowded view: features everywhere"
NO_POLES = "few poles and edges in view"
POLES = "thin structures, many poles and edges"
NO_WALLS = "few walls in view"
PLANES = "bare planes all round, little else"
PLANTS = "vegetation and clutter"
BARE = "bare surfaces without detail"
OPEN = "open surroundings, much of the view is empty"
CLOSED = "closed-in surroundings, nothing far away"
BLURRED = "cells that blur what stands there"
SHARP = "thin flat cells that pull hard"
FAR = "features far away"
PARALLEL = "parallel walls, surfaces face few directions"
SCATTERED = "surfaces that face every way, as foliage does"
ONE_SIDE = "features on few sides only"
ALL_SIDES = "features on every side"
FLAT = "a matching score without a clear peak"
MISTAKEN = "repeated structure, places that could be mistaken for this one"
STEEP = "a matching score with a narrow peak"
REPEATED = "repeated structure, neighbours look alike"
IRREGULAR = "irregular structure, neighbours look unlike"
ALONG = "nothing fixes the direction of travel"
ACROSS = "nothing fixes the direction across"
DILUTED = "directions that leave a position weak"
SPANNED = "directions spread all round"
LOOSE = "much of the map in cells with too few points"
DENSE = "dense cells throughout"
SLIDES_ALONG = "a virtual drive slides along the road"
SLIDES_ACROSS = "a virtual drive slides across the road"
SINKS = "a virtual drive rises or sinks"
DRIFTS = "a virtual drive does not hold its place"
LOST = "a virtual drive gets lost from many starts"
HOLDS = "a virtual drive holds its place"
WEAK = "nothing fixes the position in one direction"
FIRM = "every direction is well fixed"
TURNS = "nothing fixes the heading"
HEIGHT = "nothing fixes the height"
UNLIKE = "the map blurs what a scan would see there"
ALIKE = "the map is just what a scan would see there"
UNSEEN = "few beams would come back"
SEEN = "beams come back from everywhere"
UNMAPPED = "much of the view is not in the map"
MAPPED = "all of the view is in the map"
TRAFFIC = "traffic baked into the map stands in view"
EMPTY = "no traffic baked into the map"

PHRASES: dict[str, tuple[str, str]] = {
    "feature_count": (FEW, CROWDED),
    "D1_count": (NO_POLES, POLES),
    "D2_count": (NO_WALLS, PLANES),
    "D3_count": (BARE, PLANTS),
    "D1_ratio": (NO_POLES, POLES),
    "D2_ratio": (NO_WALLS, PLANES),
    "D3_ratio": (BARE, PLANTS),
    "D1_share": (NO_POLES, POLES),
    "D2_share": (NO_WALLS, PLANES),
    "D3_share": (BARE, PLANTS),
    "occupancy_ratio": (OPEN, CLOSED),
    "loose_share": (DENSE, LOOSE),
    "euclidean_dist": (SHARP, BLURRED),
    "mahalanobis_dist": (SHARP, BLURRED),
    "r_average": (CLOSED, FAR),
    "FDOP": (FAR, CLOSED),
    "normal_H_8": (PARALLEL, SCATTERED),
    "normal_H_16": (PARALLEL, SCATTERED),
    "normal_H_90": (PARALLEL, SCATTERED),
    "angular_H": (ONE_SIDE, ALL_SIDES),
    "sight_HDOP": (SPANNED, DILUTED),
    "sight_VDOP": (SPANNED, DILUTED),
    "normal_HDOP": (SCATTERED, PARALLEL),
    "normal_VDOP": (SPANNED, DILUTED),
    "wall_H": (PARALLEL, SCATTERED),
    "wall_major": (NO_WALLS, PLANES),
    "wall_minor": (PARALLEL, PLANES),
    "wall_balance": (PARALLEL, SCATTERED),
    "weak_along": (ACROSS, ALONG),
    "empty_sector": (ALL_SIDES, ONE_SIDE),
    "score_H": (STEEP, FLAT),
    "score_soft_H": (STEEP, FLAT),
    "score_curvature_min": (FLAT, STEEP),
    "score_curvature_max": (FLAT, STEEP),
    "score_var_along": (ACROSS, ALONG),
    "score_var_across": (ALONG, ACROSS),
    "score_peaks": (STEEP, MISTAKEN),
    "pfh_sim_H": (REPEATED, IRREGULAR),
    "pfh_sim_mnht": (REPEATED, IRREGULAR),
    "bhatt_sim": (REPEATED, IRREGULAR),
    "pfh_mean": (REPEATED, IRREGULAR),
    "bhatt_mean": (REPEATED, IRREGULAR),
    "ob_info_along": (ALONG, FIRM),
    "ob_info_across": (ACROSS, FIRM),
    "ob_info_up": (HEIGHT, FIRM),
    "ob_info_yaw": (TURNS, FIRM),
    "ob_weak_info": (WEAK, FIRM),
    "ob_weak_angle": (ALONG, ACROSS),
    "ob_score": (UNLIKE, ALIKE),
    "ob_nvtl": (UNLIKE, ALIKE),
    "ob_points": (UNSEEN, SEEN),
    "ob_cells": (FEW, CROWDED),
    "ob_returns": (UNSEEN, SEEN),
    "ob_unmapped": (MAPPED, UNMAPPED),
    "ob_ghosts": (EMPTY, TRAFFIC),
    "vd_mean": (HOLDS, DRIFTS),
    "vd_floor": (HOLDS, DRIFTS),
    "vd_tail": (HOLDS, LOST),
    "vd_p_fail": (HOLDS, LOST),
    "vd_along": (HOLDS, SLIDES_ALONG),
    "vd_across": (HOLDS, SLIDES_ACROSS),
    "vd_up": (HOLDS, SINKS),
}
"""What a value below, or above, that of a typical training place says about a place."""


def contributions(forest: RandomForestRegressor, X: Float64) -> Float64:
    """(n, f) what each factor adds to each estimate along the paths through the trees.

    On the way from root to leaf, a step changes the mean of the labels at hand; the change belongs
    to the factor that was asked there (Saabas 2014). The sum over the factors, plus the mean over
    the roots, is the estimate in the trees' own unit.
    """
    total = np.zeros(X.shape)
    X32 = np.ascontiguousarray(X, np.float32)
    for estimator in forest.estimators_:
        tree = estimator.tree_
        value = tree.value[:, 0, 0]
        inner = np.flatnonzero(tree.children_left >= 0)
        child = np.concatenate([tree.children_left[inner], tree.children_right[inner]])
        parent = np.concatenate([inner, inner])
        change = csr_matrix(
            (value[child] - value[parent], (child, tree.feature[parent])),
            shape=(tree.node_count, X.shape[1]),
        )
        total += (tree.decision_path(X32) @ change).toarray()
    return total / len(forest.estimators_)


def in_words(
    contribution: Float64, X: Float64, typical: Float64, names: Sequence[str]
) -> list[str]:
    """The causes of each estimate, the largest first; "" where nothing raises it.

    Factors that say the same (the counts are all correlated) are added up before they are ranked.
    Each cause names the factor behind it that weighs most, its value, and a typical one.

    Args:
        contribution: (n, f) what each factor adds (`contributions`).
        X: (n, f) the factors.
        typical: (f,) median of each among the training places.
        names: their names; one without a phrase speaks for itself.
    """
    return [_causes(contribution[row], X[row], typical, names) for row in range(len(X))]


def _causes(added: Float64, x: Float64, typical: Float64, names: Sequence[str]) -> str:
    raised = np.maximum(added, 0.0)
    by_phrase: dict[str, float] = {}
    foremost: dict[str, int] = {}
    for k in np.argsort(-raised, kind="stable"):
        if raised[k] > 0.0:
            phrase = phrase_of(names[k], bool(x[k] > typical[k]))
            by_phrase[phrase] = by_phrase.get(phrase, 0.0) + float(raised[k])
            foremost.setdefault(phrase, int(k))
    total = sum(by_phrase.values())
    ranked = sorted(by_phrase, key=lambda phrase: (-by_phrase[phrase], phrase))
    named = ranked[:1] + [p for p in ranked[1:WORDS_MAX] if by_phrase[p] >= SHARE_MIN * total]
    return "; ".join(
        f"{phrase} ({names[k]} {x[k]:.3g}, typically {typical[k]:.3g})"
        for phrase, k in ((phrase, foremost[phrase]) for phrase in named)
    )


def phrase_of(name: str, high: bool) -> str:
    """What a high or low value of a factor says about a place."""
    known = PHRASES.get(name)
    return known[high] if known else f"{'high' if high else 'low'} {name}"
