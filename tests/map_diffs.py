"""Comparisons of maps made up for tests: estimates before and after, tiles of each kind."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from report_findings import LENGTHS, places_of

from tilestream.apps.changes import changes
from tilestream.grid import TileKey
from tilestream.report.diff.data import MapDiff, Side

TILE = 50.0
LIMIT = 0.02
UTM = "EPSG:32654"


def between(old: pd.DataFrame | None, new: pd.DataFrame | None, **more: Any) -> MapDiff:
    """A comparison of estimates, of a map of which a tile of each kind differs."""
    keys = [TileKey(7360 + k, 79000) for k in range(3)]
    tiles = {"added": keys[:1], "removed": keys[1:2], "changed": keys[2:]}
    usual: dict[str, Any] = {name: tuple(of) for name, of in tiles.items()}
    usual |= {"same": 12, "limit": LIMIT, "notes": {}, "tile_size": TILE, "crs": UTM}
    usual |= {"sides": (Side("old.zarr", {"tiles": 14}), Side("new.zarr", {"tiles": 14}))}
    return MapDiff(**(usual | {"places": changes(old, new, LIMIT)} | more))


def updated() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Two streets; of the first a stretch got worse, another better, and one lost its estimates;
    the end of the second is no longer asked for, and has a place with a first estimate.
    """
    old = places_of(LENGTHS | {"III": 40})
    new, sample = old.copy(), old["sample"]
    first, second = old["route_id"] == "I", old["route_id"] == "II"
    for name in ("estimate", "low", "high", "along"):
        new.loc[first & sample.between(20, 40), name] += 0.3
        new.loc[first & sample.between(120, 130), name] *= 0.5
        new.loc[first & sample.between(200, 220), name] = np.nan
        old.loc[second & (sample == 50), name] = np.nan
        new.loc[second & (sample == 50), name] = 0.4
    new.loc[first & sample.between(200, 220), "reason"] = "no map around"
    return old, new[~(second & (sample >= 100)) & (old["route_id"] != "III")]


def words(page: Path) -> str:
    """What a person reads of a page, without its charts."""
    text = re.sub(r"<(script|style).*?</\1>|<[^>]*>", " ", page.read_text(), flags=re.DOTALL)
    return " ".join(text.replace("\u202f", " ").replace("\xa0", " ").replace("&nbsp;", " ").split())
