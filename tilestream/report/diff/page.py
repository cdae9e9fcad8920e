"""The page of a comparison of two maps: before and after, what got worse and why."""

from collections.abc import Mapping
from typing import Any

from tilestream.report.diff.data import MapDiff
from tilestream.report.diff.map import (
    MOST_NUMBERS,
    MOST_OUTLINES,
    SHOWN,
    diff_map,
    places_shown_every,
)
from tilestream.report.diff.profile import diff_profile
from tilestream.report.diff.summary import diff_cards
from tilestream.report.formatting import cm_limit
from tilestream.report.page import MOST_PROFILES, MOST_ROUTES, MOST_SEGMENTS, render_page, template
from tilestream.report.segments import BRIDGE

SECTIONS = (
    ("headline", "In short"),
    ("map", "Map"),
    ("worse", "What got worse"),
    ("better", "What got better"),
    ("along", "Along the routes"),
    ("lost", "Lost and new estimates"),
    ("notes", "Notes"),
    ("facts", "Before and after"),
)
"""The sections of the page in their order, and how they are called."""
FILES = {
    "diff.json": "all figures of this page, for machines",
    "worse.geojson": "stretches that got worse or lost their estimates, for a web map or GIS",
}
"""What lies beside the page."""


def diff_page(found: MapDiff, content: Mapping[str, Any]) -> str:
    """The page as HTML; the same comparison gives the same bytes.

    Args:
        found: what is compared.
        content: its `diff_content`.
    """
    absent = _absent(content)
    changed = [r for r in content["routes"] if r["worse"] or r["better"] or r["lost"]]
    profiles = changed[:MOST_PROFILES]
    map_item = [] if "map" in absent else [diff_map(found, template("diff_tip.html.j2").render())]
    return render_page(
        "diff.html.j2",
        content,
        map_item
        + [
            diff_profile(found, route["route_id"], f"along-{k}") for k, route in enumerate(profiles)
        ],
        FILES,
        scripts=("page.js", "enter.js", "change.js"),
        sections=SECTIONS,
        absent=absent,
        cards=diff_cards(content),
        digits=content["digits"],
        limit=cm_limit(content["limit"]),
        bridge=BRIDGE,
        profiles=profiles,
        changed=changed,
        routes=content["routes"][:MOST_ROUTES],
        most=MOST_SEGMENTS,
        numbered=MOST_NUMBERS,
        outlined=MOST_OUTLINES,
        shown=SHOWN,
        shown_every=places_shown_every(found),
        hollow=bool(found.places.interpolated.any()),
    )


def _absent(content: Mapping[str, Any]) -> dict[str, str]:
    """Why sections have nothing to say, by section: they are left out."""
    places = content["compared"] or content["lost"] or content["appeared"] or content["left"]
    tiles = any(content[kind] for kind in ("added", "removed", "changed"))
    limit = cm_limit(content["limit"])
    none = "no place has an estimate in both"
    if content["without_estimates"]:
        none = f"there are no estimates in {' and '.join(content['without_estimates'])}"
    changed = content["worse"] or content["better"] or content["lost"]
    compared = content["compared"]
    why = {
        "map": (places or tiles, "no tile differs, and no place has an estimate to draw"),
        "worse": (
            content["stretches"],
            _unless(compared, f"nothing grew by more than {limit}", none),
        ),
        "better": (
            content["stretches_better"],
            _unless(compared, f"nothing fell by more than {limit}", none),
        ),
        "along": (changed, _unless(compared, f"no route has changed by more than {limit}", none)),
        "lost": (
            content["lost"] or content["appeared"] or content["left"],
            _unless(compared, "all places that had an estimate have one, and no others do", none),
        ),
    }
    return {name: reason for name, (there, reason) in why.items() if not there}


def _unless(compared: int, nothing: str, none: str) -> str:
    return nothing if compared else none
