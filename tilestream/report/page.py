"""The pages: templates filled with figures, each one file that needs no network.

The same findings give the same bytes.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tilestream.errors import alike
from tilestream.notes import shared
from tilestream.report import charts, evaluation, formatting
from tilestream.report.city_map import city_map, map_shows_every
from tilestream.report.clouds import packed, viewer
from tilestream.report.colours import ACTUAL, CRITERION, HELD_OUT, OTHER
from tilestream.report.columns import CATALOGUE, COLUMNS
from tilestream.report.comparison import QUANTILE, Comparison
from tilestream.report.data import AROUND, Findings
from tilestream.report.drives import EVALUATED
from tilestream.report.pictures import ABOVE, BELOW, heights_ramp
from tilestream.report.segments import APART, BRIDGE
from tilestream.report.summary import AXES, STARTS, cards, digits_of
from tilestream.report.views import View

MOST_ROUTES = 40
"""Routes that the page lists, the worst by their 95 % quantile; `report.json` has all."""
MOST_PROFILES = 12
"""Routes that have a profile, likewise."""
MOST_SEGMENTS = 15
"""Segments that the page lists; the file has all."""
MOST_CHARTS = 24
"""Labelled paths, or compared routes, that have a chart."""
MOST_TILES = 60
"""Tiles that the page lists of each vehicle; `compare.json` has all."""


FILES = {
    "places.csv": "all places with their estimates and factors, for a spreadsheet",
    "places.gpkg": "places and stretches in the colours of this page, for QGIS",
    "places.parquet": "all places with their estimates and factors as GeoParquet, for Python",
    "over_threshold.geojson": "stretches over the threshold, for a web map or GIS",
    "over_threshold.qml": "the style of the same for QGIS",
    "map.pcd": "the places coloured by error, for a viewer of point clouds",
    "foxglove.mcap": "map, route and worst places in 3D, for Foxglove and rviz",
    "report.json": "all figures of this page, for machines",
}
"""What may lie beside the report."""
LANELETS = "a Lanelet2 map of the routes whose lanelets carry the estimates as tags"
COMPARE_FILES = {
    "compare.csv": "all places with the estimate of each choice",
    "compare.json": "all figures of this page, for machines",
}
"""What lies beside a comparison."""


def _environment() -> Environment:
    """Templates that escape every value, and refuse a name that is not there."""
    environment = Environment(
        loader=PackageLoader("tilestream.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    filters = (
        formatting.cm, formatting.cm_about, formatting.cm_by_name, formatting.percent,
        formatting.number, formatting.distance, formatting.thousands, formatting.megabytes,
        formatting.fact,
    )  # fmt: skip
    environment.filters |= {function.__name__: function for function in filters}
    environment.filters["alike"] = alike
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    environment.filters["explained"] = COLUMNS.__getitem__
    environment.filters["meaning"] = lambda name: CATALOGUE[name].meaning
    environment.tests["factor"] = CATALOGUE.__contains__
    environment.tests["known"] = formatting.known
    environment.tests["explained"] = COLUMNS.__contains__
    environment.globals |= {"cm_span": formatting.cm_span, "evaluation": evaluation}
    environment.globals |= {"CRITERION": CRITERION, "OTHER": OTHER}
    environment.globals |= {"ACTUAL": ACTUAL, "HELD_OUT": HELD_OUT}
    return environment


_ENVIRONMENT = _environment()
template = _ENVIRONMENT.get_template
"""A template by its name."""


def report_page(
    found: Findings,
    content: Mapping[str, Any],
    views: Sequence[View],
    ends: Sequence[bytes | str],
) -> str:
    """The page of a run as HTML.

    Args:
        found: what is reported.
        content: its `summary`.
        views: what is shown of each of the worst places.
        ends: PNG of where the starts of each of the worst measured places ended, or why there is
            none.
    """
    paths = content["paths"][:MOST_CHARTS]
    segments = sorted(content["segments"], key=lambda s: (-s["worst"], s["route_id"], s["begin"]))
    profiles = [route for route in _worst_first(content["routes"]) if route["p95"] is not None]
    profiles = profiles[:MOST_PROFILES]
    tip = template("map_tip.html.j2").render()
    turning = any(view.cloud for view in views)
    return render_page(
        "report.html.j2",
        content,
        [city_map(found, tip)]
        + [
            charts.profile_chart(found, route["route_id"], f"along-{k}")
            for k, route in enumerate(profiles)
        ]
        + [charts.path_chart(found, path["path"], f"path-{k}") for k, path in enumerate(paths)],
        _files(content["files"]),
        scripts=("page.js", "enter.js", "cloud.js", "place.js", "choose.js"),
        later=[viewer()] if turning else [],
        limit=formatting.cm_limit(content["threshold"]),
        cards=cards(content),
        digits=digits_of(content),
        routes=_listed_routes(content["routes"]),
        segments=segments[:MOST_SEGMENTS],
        paths=paths,
        profiles=profiles,
        absent=_absent(content, ends),
        views=views,
        viewer=packed(viewer()) if turning else "",
        entered=_entered(content["worst"]),
        unseen=sorted({view.unseen for view in views} - {""}),
        ends=ends,
        shown_every=map_shows_every(found),
        own_range=found.own_range,
        bridge=BRIDGE,
        apart=APART,
        heights={"around": AROUND, "low": -BELOW, "high": ABOVE, "ramp": heights_ramp()},
        parts=(AXES, STARTS),
    )


def _files(written: Sequence[str]) -> dict[str, str]:
    """What lies beside the page, and what it is for."""
    known = {name: what for name, what in FILES.items() if name in (*written, "report.json")}
    return known | {name: LANELETS for name in written if name not in FILES}


def _entered(worst: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Where the worst places are, by number, as the addresses of the page name them."""
    return [
        {"number": number, "x": round(place["x"], 1), "y": round(place["y"], 1)}
        for number, place in enumerate(worst, start=1)
        if formatting.known(place["x"]) and formatting.known(place["y"])
    ]


def _absent(content: Mapping[str, Any], ends: Sequence[bytes | str]) -> dict[str, str]:
    """Why sections of a run's page have nothing to say, by section: they are left out."""
    labelled = content["headline"]["labelled"]
    judged = (
        "nothing was trained on the labels of this run, so no models were judged against each "
        "other; the estimates stand beside what was measured"
        if labelled
        else "there were no labels, so nothing can be judged: the estimates rest on the model"
    )
    unlabelled = "no place was labelled: without a log of scans there is no measured error"
    missing = [end for end in ends if isinstance(end, str)]
    why = {
        "along": (content["headline"]["estimated"], "no place has an estimate"),
        "paths": (content["paths"], unlabelled),
        "ends": (len(missing) < len(ends), [*missing, unlabelled][0]),
        "table-i": (content["table_i"], unlabelled),
        "table-iii": (content["table_iii"], unlabelled),
        "importances": (content["importances"], "nothing was trained in this run"),
        "table-iv": (content["table_iv"], judged),
        "calibration": (
            content["coverage"],
            "no interval was checked: that takes a model trained here, on several paths",
        ),
        "protocols": (content["protocols"], judged),
    }
    return {name: reason for name, (there, reason) in why.items() if not there}


def comparison_page(found: Comparison, content: Mapping[str, Any]) -> str:
    """The page of a comparison as HTML.

    Args:
        found: what is compared.
        content: its `content`.
    """
    routes = content["routes"][:MOST_CHARTS]
    return render_page(
        "comparison.html.j2",
        content,
        [charts.route_chart(found, name, f"route-{k}") for k, name in enumerate(routes)],
        COMPARE_FILES,
        limit=formatting.cm_limit(content["threshold"]),
        routes=routes,
        absent={},
        vehicles=[(of, _listed_tiles(of["tiles"])) for of in content["cell_sizes"]],
        shown_every=charts.line_shows_every(found),
        apart=APART,
        quantile=QUANTILE,
    )


def render_page(
    name: str,
    content: Mapping[str, Any],
    items: Sequence[Mapping[str, Any]],
    files: Mapping[str, str],
    *,
    scripts: Sequence[str] = ("page.js",),
    later: Sequence[str] = (),
    **more: Any,
) -> str:
    """A template filled: with its content, its charts, and what they and the page need to run.

    Args:
        name: of the template.
        content: what is told.
        items: its charts.
        files: what lies beside the page and what it is for, by name.
        scripts: templates of scripts, in order.
        later: other scripts, which these may begin.
        more: what else the template asks for.
    """
    # BokehJS without widgets, tables and what needs a server
    bokeh = Resources(mode="inline", components=["bokeh"]).js_raw[0]
    run = [bokeh, "\n".join(template(script).render() for script in scripts)]
    return template(name).render(
        content=content,
        noticed=shared(content["notes"]),
        evaluated_share=EVALUATED,
        charts=items,
        scripts=[Markup(script) for script in run],
        policy=_policy([*run, *later]),
        files=files.items(),
        **more,
    )


def _policy(scripts: Sequence[str]) -> str:
    """The Content-Security-Policy of a page: it runs these scripts and asks nobody for anything.

    Styles are allowed as they are: BokehJS and our bars make them. K3D has fonts inside, and makes
    a worker.
    """
    digests = (hashlib.sha256(script.encode("utf-8")).digest() for script in scripts)
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; font-src data:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def _listed_routes(routes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    if len(routes) <= MOST_ROUTES:
        return routes
    return _worst_first(routes)[:MOST_ROUTES]


def _worst_first(routes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By the 95 % quantile of their estimates."""
    return sorted(routes, key=lambda r: (-(r["p95"] or 0.0), r["route_id"]))


def _listed_tiles(tiles: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """First those where no size suffices, last those without a sample point."""
    ranked = sorted(tiles, key=lambda t: (t["suffices"] is not False, not t["places"], t["tile"]))
    return ranked[:MOST_TILES]
