"""What a factor's value says about a place, in words."""

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
IN_LINE = "what is in view lies along one line"
LEVEL = "what is in view lies at one height"
SPANNED = "directions spread all round"
LOOSE = "more of the map than usual in cells with too few points"
DENSE = "dense cells throughout"
SLIDES_ALONG = "a virtual drive slides along the road"
SLIDES_ACROSS = "a virtual drive slides across the road"
SINKS = "a virtual drive rises or sinks"
DRIFTS = "a virtual drive does not hold its place"
STRAYS = "a virtual drive goes astray from distant starts"
LOST = "a virtual drive gets lost from many starts"
HOLDS = "a virtual drive holds its place"
WEAK = "nothing fixes the position in one direction"
FIRM = "every direction is well fixed"
TURNS = "nothing fixes the heading"
HEIGHT = "nothing fixes the height"
UNLIKE = "the map blurs what a scan would see there"
ALIKE = "the map is just what a scan would see there"
UNSEEN = "few beams would come back"
UNMAPPED = "more of the view than usual is not in the map"
MAPPED = "all of the view is in the map"
TRAFFIC = "traffic baked into the map stands in view"
EMPTY = "no traffic baked into the map"
SPARSE = "a sparse map, surveyed once or from afar"
OFTEN = "a dense map, surveyed often or from near"
THIN = "thin walls, as a single pass leaves them"
THICK = "thick walls, passes that disagree or rough surfaces"

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
    "sight_HDOP": (SPANNED, IN_LINE),
    "sight_VDOP": (SPANNED, LEVEL),
    "normal_HDOP": (SCATTERED, PARALLEL),
    "normal_VDOP": (SPANNED, HEIGHT),
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
    "ob_points": (FEW, CROWDED),
    "ob_cells": (FEW, CROWDED),
    "ob_returns": (UNSEEN, CLOSED),
    "ob_unmapped": (MAPPED, UNMAPPED),
    "ob_ghosts": (EMPTY, TRAFFIC),
    "ob_density": (SPARSE, OFTEN),
    "ob_thickness": (THIN, THICK),
    "vd_mean": (HOLDS, DRIFTS),
    "vd_floor": (HOLDS, DRIFTS),
    "vd_tail": (HOLDS, STRAYS),
    "vd_p_fail": (HOLDS, LOST),
    "vd_along": (HOLDS, SLIDES_ALONG),
    "vd_across": (HOLDS, SLIDES_ACROSS),
    "vd_up": (HOLDS, SINKS),
}
"""What a value below, or above, that of a typical training place says about a place."""
REASSURING = frozenset({ALL_SIDES, SPANNED, DENSE, STEEP, HOLDS, FIRM, ALIKE, MAPPED, EMPTY, OFTEN})
"""What explains no error, on whichever side the factor is bad."""


def phrase_of(name: str, high: bool) -> str:
    """What a high or low value of a factor says about a place."""
    known = PHRASES.get(name)
    return known[high] if known else f"{'high' if high else 'low'} {name}"
