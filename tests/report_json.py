"""The data of a report's charts, read back from the page as a browser would get it."""

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

CHART = re.compile(r'<script type="application/json" class="chart-data">(.*?)</script>', re.DOTALL)


def charts(page: Path) -> dict[str, dict[str, Any]]:
    """The charts of a page by the name of the element that they are drawn in."""
    found = map(json.loads, CHART.findall(page.read_text(encoding="utf-8")))
    return {chart["target_id"]: chart for chart in found}


def sources(chart: Any) -> list[dict[str, Any]]:
    """The data sources of a chart: `name`, and `data` by column."""
    found: list[dict[str, Any]] = []
    if isinstance(chart, dict):
        if chart.get("name") == "ColumnDataSource" and "attributes" in chart:
            entries = chart["attributes"]["data"]["entries"]
            data = {name: _column(column) for name, column in entries}
            found.append({"name": chart["attributes"].get("name"), "data": data})
        for value in chart.values():
            found += sources(value)
    elif isinstance(chart, list):
        for value in chart:
            found += sources(value)
    return found


def source(chart: Any, name: str) -> dict[str, Any]:
    """The columns of the one data source of this name."""
    (only,) = [s["data"] for s in sources(chart) if s["name"] == name]
    return dict(only)


def _column(column: Any) -> Any:
    if isinstance(column, list):
        return column
    raw = base64.b64decode(column["array"]["data"])
    if raw[:2] == b"\x1f\x8b":
        raw = zlib.decompress(raw, wbits=31)
    return np.frombuffer(raw, column["dtype"]).reshape(column["shape"])
