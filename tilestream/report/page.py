"""The page: one file that needs no network, the same bytes for the same findings."""

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from bokeh.resources import Resources

from tilestream.report import evidence, places
from tilestream.report.charts import city_map, path_chart
from tilestream.report.findings import Findings
from tilestream.report.words import esc

CONTENTS = (
    ("headline", "In short"),
    ("map", "Map"),
    ("worst", "Worst places"),
    ("paths", "Measured and estimated"),
    ("importances", "What drives them"),
    ("table-iv", "Table IV"),
    ("calibration", "Intervals"),
    ("protocols", "How good"),
    ("facts", "Run facts"),
)


def page(found: Findings, content: Mapping[str, Any], pictures: Mapping[int, bytes | str]) -> str:
    """The whole page as HTML.

    Args:
        found: what is reported.
        content: its `summary`.
        pictures: PNG of each of the worst places by number, or why there is none.
    """
    parts = (
        places.headline(content),
        places.city_map(found, content),
        places.worst(content, pictures),
        places.paths(content),
        evidence.importances(found),
        evidence.table_iv(found),
        evidence.calibration(found),
        evidence.protocols(found),
        places.facts(content),
    )
    charts = [city_map(found)]
    for number, path in enumerate(content["paths"][: places.MOST_PATHS]):
        charts.append(path_chart(found, path["path"]) | {"target_id": f"path-{number}"})
    return document(
        found.title,
        "The localization error of a lidar vehicle, estimated from the point-cloud map alone.",
        CONTENTS,
        "".join(parts),
        charts,
        missing="The charts need JavaScript; they are also in the folder figures.",
        footer=f"Made by tilestream {esc(content['tilestream'])}. The same figures for machines: "
        "<code>report.json</code>, <code>places.parquet</code>, <code>places.csv</code>, "
        "<code>over_threshold.geojson</code>, <code>map.pcd</code>, <code>figures/</code>.",
    )


def document(
    title: str,
    subtitle: str,
    contents: Sequence[tuple[str, str]],
    body: str,
    charts: Sequence[Mapping[str, Any]],
    *,
    missing: str,
    footer: str,
) -> str:
    """A page with charts as one HTML file that asks for nothing.

    Args:
        title: plain text.
        subtitle: plain text.
        contents: the sections, (name, title) each.
        body: their HTML.
        charts: items for the elements of the body that they name.
        missing: plain text instead of the charts, where there is no JavaScript.
        footer: HTML.
    """
    links = "".join(f'<a href="#{name}">{text}</a>' for name, text in contents)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{esc(title)}</title>\n<style>\n{_own('page.css')}</style>\n</head>\n<body>\n"
        f"<header><h1>{esc(title)}</h1><p>{esc(subtitle)}</p></header>\n"
        f'<nav aria-label="Sections"><div>{links}</div></nav>\n'
        f"<main>\n{body}</main>\n"
        f"<noscript><p>{esc(missing)}</p></noscript>\n"
        f"<footer>{footer}</footer>\n"
        + "".join(_data(chart) for chart in charts)
        + f"<script>\n{_bokeh()}\n</script>\n<script>\n{_own('page.js')}</script>\n"
        "</body>\n</html>\n"
    )


def _data(chart: Mapping[str, Any]) -> str:
    """A chart as JSON that no name in it can end: `<` stands as its escape."""
    text = json.dumps(chart, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" class="chart-data">{text}</script>\n'


def _bokeh() -> str:
    """BokehJS without widgets, tables and what needs a server."""
    return str(Resources(mode="inline", components=["bokeh"]).js_raw[0])


def _own(name: str) -> str:
    return (resources.files("tilestream.report") / name).read_text(encoding="utf-8")
