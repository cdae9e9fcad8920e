"""Styles of QGIS (QML): the colours of the report, a rule per step, with a legend in centimetres.

Written as QGIS 3.22 and later read them; what is not named is QGIS's default. Rules and not a
graduated renderer, since a layer may have points and lines, and places without an error are grey.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from matplotlib.colors import to_rgb

from tilestream.report.colours import MISSING, Scale
from tilestream.report.formatting import CM_PER_M

WRITTEN_FOR = "3.22.0"
"""The oldest QGIS that must read them."""
DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
SMALLEST, LARGEST = 1.6, 3.2
"""Diameter of a place of the lowest and of the highest step [mm on the screen]."""
WIDTH = 1.6
"""Of a stretch over the threshold [mm]."""
BLACK, WHITE = "#000000", "#ffffff"


@dataclass(frozen=True)
class Rule:
    """What is drawn of a layer, and how."""

    where: str
    """Expression of QGIS: which features."""
    label: str
    """In the legend."""
    symbol: ET.Element
    """How they look."""


def style_of_places(scale: Scale) -> str:
    """Points by `estimate`, the highest on top, those without one as grey crosses, and beside each
    its `label`, if it has one.
    """
    steps = list(_steps(scale, "estimate"))
    growth = (LARGEST - SMALLEST) / (len(steps) - 1)
    rules = [
        Rule(where, label, _marker("circle", colour, SMALLEST + k * growth, None))
        for k, (where, label, colour) in enumerate(steps)
    ]
    grey = _marker("cross2", MISSING, 1.4 * SMALLEST, MISSING)
    rules.append(Rule('"estimate" IS NULL', "no estimate", grey))
    return _style(rules, "estimate", '"label"')


def style_of_measured(scale: Scale) -> str:
    """Black-edged squares by `measured`, the highest on top."""
    rules = [
        Rule(where, label, _marker("square", colour, LARGEST, BLACK))
        for where, label, colour in _steps(scale, "measured")
    ]
    return _style(rules, "measured")


def style_over_threshold(scale: Scale, threshold: float) -> str:
    """Lines by `worst`, and points where a sample point stands alone: the steps that reach above a
    threshold [m].
    """
    rules = []
    for above, (where, label, colour) in zip(
        (*scale.edges, float("inf")), _steps(scale, "worst"), strict=True
    ):
        if above > threshold:
            for kind, symbol in (
                ("Line", _line(colour)),
                ("Point", _marker("circle", colour, LARGEST, BLACK)),
            ):
                of_kind = f"{where} AND geometry_type($geometry) = '{kind}'"
                rules.append(Rule(of_kind, label, symbol))
    return _style(rules, "worst")


def _steps(scale: Scale, column: str) -> Iterator[tuple[str, str, str]]:
    """Which features have the colours of a scale, as an expression, in words, and the colour: as
    `Scale.step`, an error of an edge has the lower one.
    """
    for low, high, colour in zip(
        (None, *scale.edges), (*scale.edges, None), scale.colours, strict=True
    ):
        bounds = [f'"{column}" > {low!r}'] if low is not None else []
        bounds += [f'"{column}" <= {high!r}'] if high is not None else []
        yield " AND ".join(bounds), _words(low, high), colour


def _words(low: float | None, high: float | None) -> str:
    """A step of errors in centimetres."""
    from_, to = (None if edge is None else f"{edge * CM_PER_M:.3g}" for edge in (low, high))
    if from_ is None:
        return f"up to {to} cm"
    return f"over {from_} cm" if to is None else f"{from_} to {to} cm"


def _style(rules: list[Rule], order: str, label: str = "") -> str:
    """A style of these rules, features of higher values of a column above the others."""
    root = ET.Element("qgis", version=WRITTEN_FOR, styleCategories="Symbology|Labeling")
    root.set("labelsEnabled", "1" if label else "0")
    renderer = ET.SubElement(root, "renderer-v2", type="RuleRenderer", symbollevels="0")
    renderer.set("enableorderby", "1")
    listed = ET.SubElement(renderer, "rules", key="errors")
    symbols = ET.SubElement(renderer, "symbols")
    for k, rule in enumerate(rules):
        ET.SubElement(
            listed, "rule", key=f"step {k}", symbol=f"{k}", filter=rule.where, label=rule.label
        )
        rule.symbol.set("name", f"{k}")
        symbols.append(rule.symbol)
    clause = ET.SubElement(ET.SubElement(renderer, "orderby"), "orderByClause")
    clause.set("asc", "1")
    clause.set("nullsFirst", "1")
    clause.text = f'"{order}"'
    if label:
        root.append(_labels(label))
    ET.indent(root, " ")
    return DOCTYPE + ET.tostring(root, encoding="unicode") + "\n"


def _marker(name: str, colour: str, size: float, edge: str | None) -> ET.Element:
    """A point: a shape of QGIS, its diameter [mm], and the colour of its edge, if it has one."""
    return _symbol(
        "marker",
        "SimpleMarker",
        name=name,
        color=_rgba(colour),
        size=f"{size:.2f}",
        size_unit="MM",
        outline_color=_rgba(edge or colour),
        outline_style="solid" if edge else "no",
        outline_width="0.3",
        outline_width_unit="MM",
    )


def _line(colour: str) -> ET.Element:
    return _symbol(
        "line",
        "SimpleLine",
        line_color=_rgba(colour),
        line_width=f"{WIDTH}",
        line_width_unit="MM",
        line_style="solid",
        capstyle="round",
        joinstyle="round",
    )


def _symbol(kind: Literal["marker", "line"], layer: str, **options: str) -> ET.Element:
    """A symbol of one layer."""
    symbol = ET.Element("symbol", type=kind, alpha="1")
    of_layer = ET.SubElement(symbol, "layer", enabled="1", locked="0")
    of_layer.set("class", layer)
    listed = ET.SubElement(of_layer, "Option", type="Map")
    for name, value in options.items():
        ET.SubElement(listed, "Option", name=name, type="QString", value=value)
    return symbol


def _labels(expression: str) -> ET.Element:
    """Bold texts on a white rim beside the features for which an expression is not null."""
    labeling = ET.Element("labeling", type="simple")
    settings = ET.SubElement(labeling, "settings")
    text = ET.SubElement(settings, "text-style", fieldName=expression, isExpression="1")
    text.attrib |= {"fontSize": "10", "fontSizeUnit": "Point", "fontWeight": "75"}
    text.attrib |= {"textColor": _rgba(BLACK), "textOpacity": "1"}
    rim = {"bufferDraw": "1", "bufferSize": "1", "bufferSizeUnits": "MM", "bufferOpacity": "1"}
    ET.SubElement(text, "text-buffer", rim, bufferColor=_rgba(WHITE))
    where = {"placement": "0", "dist": "3", "distUnits": "MM", "priority": "10"}
    ET.SubElement(settings, "placement", where)
    ET.SubElement(settings, "rendering", drawLabels="1", obstacle="1", scaleVisibility="0")
    return labeling


def _rgba(colour: str) -> str:
    """A colour as QGIS writes it."""
    return ",".join(str(round(255 * part)) for part in (*to_rgb(colour), 1.0))
