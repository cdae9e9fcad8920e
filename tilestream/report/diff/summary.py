"""The figures of a comparison of two maps as plain values, for machines and for the page alike."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tilestream.report.diff.data import TILES, Changes, MapDiff
from tilestream.report.diff.gate import Verdict
from tilestream.report.formatting import cm_about, cm_limit, distance, thousands
from tilestream.report.summary import plain
from tilestream.version import VERSION


def diff_content(found: MapDiff, verdict: Verdict | None) -> dict[str, Any]:
    """All figures of a comparison; lengths in metres, None for what could not be compared.

    Args:
        found: what is compared.
        verdict: of the gate; None: none was asked for.
    """
    places = found.places
    tiles: dict[str, Any] = dict.fromkeys((*TILES, "same"))
    if not found.gone:
        tiles = {kind: [str(key) for key in getattr(found, kind)] for kind in TILES}
        tiles["same"] = found.same
    content = {
        "tilestream": VERSION,
        **tiles,
        "compared": places.compared,
        "compared_interpolated": places.compared_interpolated,
        "compared_m": places.length,
        "limit": found.limit,
        "worse_m": places.length_of("worse"),
        "better_m": places.length_of("better"),
        "lost": places.lost,
        "lost_m": places.length_of("lost"),
        "appeared": places.appeared,
        "left": len(places.left),
        "worst_growth": _largest(places),
        "gate": None if verdict is None else verdict.plain(),
        "routes": routes(places),
        "stretches": places.stretches.to_dict("records"),
        "stretches_better": places.stretches_of("better").to_dict("records"),
        "stretches_lost": places.stretches_of("lost").to_dict("records"),
        "stretches_appeared": places.stretches_of("appeared").to_dict("records"),
        "routes_left": left(places),
        "worse": places.worse.to_dict("records"),
        "better": places.better.to_dict("records"),
        "sides": [{"name": side.name, "facts": dict(side.facts)} for side in found.sides],
        "without_estimates": list(found.without),
        "other_settings": found.otherwise,
        "crs": found.crs,
        "digits": found.digits,
        "notes": found.notes,
        "gone": found.gone,
    }
    return dict(plain(content))


def _largest(places: Changes) -> float | None:
    """How much the estimate grew that grew most [m]; None: nothing is compared."""
    known = places.change[np.isfinite(places.change)]
    return float(known.max()) if known.size else None


def routes(places: Changes) -> list[dict[str, Any]]:
    """What became of each route, the one whose estimates grew most first."""
    table = places.places.assign(
        change=places.change,
        length=places.reach,
        kind=places.kind,
        interpolated=places.interpolated,
    )
    found = []
    for name, part in table.groupby("route_id", sort=True):
        both = part[part["change"].notna()]
        of_kind = {kind: part["kind"] == kind for kind in ("worse", "better", "lost", "appeared")}
        found.append(
            {
                "route_id": str(name),
                "places": len(part),
                "compared": len(both),
                "compared_interpolated": int(both["interpolated"].sum()),
                "compared_m": float(both["length"].sum()),
                "worse": int(of_kind["worse"].sum()),
                "better": int(of_kind["better"].sum()),
                "worse_m": float(part.loc[of_kind["worse"], "length"].sum()),
                "better_m": float(part.loc[of_kind["better"], "length"].sum()),
                "lost": int(of_kind["lost"].sum()),
                "appeared": int(of_kind["appeared"].sum()),
                "median_before": both["before"].median(),
                "median_after": both["after"].median(),
                "worst_growth": both["change"].max(),
            }
        )
    return sorted(
        found, key=lambda r: (-np.nan_to_num(r["worst_growth"], nan=-np.inf), r["route_id"])
    )


def left(places: Changes) -> list[dict[str, Any]]:
    """The older routes that are left behind, in whole or in parts."""
    return [
        {
            "route_id": str(name),
            "places": len(part),
            "begin": part["arc_length"].min(),
            "end": part["arc_length"].max(),
            "x": part["x"].iloc[0],
            "y": part["y"].iloc[0],
            "median": part["before"].median(),
        }
        for name, part in places.left.groupby("route_id", sort=True)
    ]


def diff_cards(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures that a map team asks for first, and what each of them is.

    Args:
        content: `diff_content`.
    """
    cards = []
    if content["same"] is not None:
        changed, added, removed = (len(content[kind]) for kind in ("changed", "added", "removed"))
        both = changed + content["same"]
        cards += [
            (f"{thousands(changed)} of {thousands(both)}", "tiles that both have changed"),
            (thousands(added), "tiles added"),
            (thousands(removed), "tiles removed"),
        ]
    if content["compared"]:
        between = content["compared_interpolated"]
        by, digits = f"by more than {cm_limit(content['limit'])}", content["digits"]
        growth = content["worst_growth"]
        cards += [
            (distance(content["compared_m"]), f"of road compared, {_points(content['compared'])}"),
            *([(thousands(between), "of them interpolated before or after")] if between else []),
            (distance(content["worse_m"]), f"got worse {by}, {_points(len(content['worse']))}"),
            (distance(content["better_m"]), f"got better {by}, {_points(len(content['better']))}"),
            (f"{'+' if growth > 0.0 else ''}{cm_about(growth, digits)}", "the largest growth"),
        ]
    if not content["without_estimates"]:
        lost, appeared = content["lost"], content["appeared"]
        cards.append((thousands(lost), "places lost their estimate"))
        cards += [(thousands(appeared), "places have one for the first time")] if appeared else []
    if content["left"]:
        cards.append((thousands(content["left"]), "places are not asked for any more"))
    return cards


def _points(count: int) -> str:
    return f"{thousands(count)} sample point{'' if count == 1 else 's'}"
