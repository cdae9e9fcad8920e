"""A run whose map is drawn: tiles from above, and made-up estimates of places, behind gates."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from naps import MEMORY, After, Nap
from scenes import UTM, scene

import tilestream as ts
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import TileKey
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import Task, stage
from tilestream.pipeline.stages.map_part import MapPart
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.store import TileStore

TILE = 10.0
"""Edge of a tile [m]."""
Place = tuple[float, float, float]
"""x, y and the estimate of a place [m]; NaN: there is none."""


@stage(
    "predict",
    version=1,
    memory=lambda _: 0,
    seconds=0.1,
    columns=(*PLACE_COLUMNS, *PREDICTION_COLUMNS),
)
def estimated(after: object, places: tuple[Place, ...]) -> pd.DataFrame:
    """A table of estimates."""
    x, y, estimate = np.array(places).T
    columns: dict[str, Any] = {c.name: 0.0 for c in (*PLACE_COLUMNS, *PREDICTION_COLUMNS)}
    columns |= {"x": x, "y": y, "estimate": estimate, "sample": np.arange(len(x))}
    columns |= {"route_id": "main", "in_domain": True, "status": "done", "reason": ""}
    return pd.DataFrame(columns)


def small_map(folder: Path, crs: str | None = "EPSG:32654") -> TileStore:
    """A street far from the origin, in tiles of 10 m."""
    write_pcd(folder / "street.pcd", scene("canyon", 1, spacing=0.5, offset=UTM))
    return ts.ingest(
        [str(folder / "street.pcd")], folder / "map.zarr", tile_size=TILE, map_leaf=0.2, crs=crs
    )


def estimates_task(
    folder: Path, tile: TileKey, places: list[Place], needs: tuple[str, ...] = ()
) -> Task:
    """The task that writes the estimates of a tile."""
    return Task(
        estimated,
        str(tile),
        Parquet(f"{folder}/predictions/{tile}.parquet"),
        takes={"places": tuple(places)},
        reads={"after": After(needs)},
        work=len(places),
        tile=tile,
    )


def places_of(store: TileStore, tile: TileKey, estimates: list[float]) -> list[Place]:
    """Places along the middle of a tile, a metre apart."""
    box = store.grid.core(tile)
    y = (box.y_lo + box.y_hi) / 2000.0
    return [(box.x_lo / 1000.0 + 0.5 + i, y, error) for i, error in enumerate(estimates)]


def drawn_plan(store: TileStore, folder: Path, estimates: list[float], reason: str) -> Plan:
    """Tiles from above once `folder/above` is there, and when all are, their estimates once
    `folder/predict` is; a task of the first tile fails, and one that needs it is not run.
    """
    (folder / "predictions").mkdir()
    plan = MapPlan.of_store(store)
    first, *_ = tiles = sorted(plan.points)
    closed = Nap(first, "cells", gate=str(folder / "above"))
    above = [_after(plan.above(tile), closed) for tile in tiles]
    needs = tuple(task.key for task in above)
    drawn = Nap(first, "merge", gate=str(folder / "predict"), needs=needs)
    predict = [
        estimates_task(folder, tile, places_of(store, tile, estimates), (drawn.key,))
        for tile in tiles
    ]
    bad = Nap(first, "terms", how=reason, notes=str(folder), failures=9)
    factors = Nap(first, "factors", needs=(bad.key,))
    return Plan((closed, *above, drawn, *predict, bad, factors), MEMORY)


def _after(task: Task, gate: Task) -> Task:
    part = task.reads["map_part"]
    assert isinstance(part, MapPart)
    return replace(task, reads={"map_part": replace(part, makers=(gate.key,))})
