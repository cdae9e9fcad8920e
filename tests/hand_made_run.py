"""A run directory of a few places, made by hand: what reads one needs no job."""

from pathlib import Path

import numpy as np
import pandas as pd
from scenes import scene

import tilestream as ts
from tilestream.factors import catalogue
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS
from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.marks import Mark
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.pipeline.jobs.inventory import Entry, write_inventory
from tilestream.pipeline.stages.label import ERROR_COLUMNS
from tilestream.records import Column
from tilestream.tables import write_table

PLACES, LABELS = 6, (1, 4)
"""So many places a metre apart; the numbers of those that a drive measured."""


def places() -> pd.DataFrame:
    x = 4.0 + np.arange(PLACES)
    return pd.DataFrame(
        {
            "route_id": "main street",
            "sample": np.arange(PLACES),
            "arc_length": x - 4.0,
            "heading": 0.0,
            "x": x,
            "y": 0.5,
            "z": 2.0,
            "above_ground": 0.0,
        }
    )


def put(path: Path, frame: pd.DataFrame, columns: tuple[Column, ...]) -> None:
    facts = {"store": "../../map.zarr"}
    write_table(str(path), frame, columns, Mark("done", identity="one", facts=facts))
    write_inventory(Files.at(path.parent), {path.name: Entry("factors", "one")})


def write_run(folder: Path) -> Path:
    """Five estimates (the last place has none), two labels, one factor, and the map."""
    folder.mkdir(exist_ok=True)
    write_pcd(folder / "street.pcd", scene("canyon", 1, spacing=0.8))
    ts.ingest([str(folder / "street.pcd")], folder / "map.zarr", tile_size=40.0)
    done = {"status": "done", "reason": ""}
    at, tables = places(), folder / "tables"
    put(
        tables / "factors" / "0_0.parquet",
        at.assign(r_average=10.0 + np.arange(PLACES), **done),
        (*PLACE_COLUMNS, *catalogue.COLUMNS, *STATUS_COLUMNS),
    )
    numbers = [c.name for c in PREDICTION_COLUMNS if c.dtype == "float64"]
    estimate = np.where(np.arange(PLACES) < PLACES - 1, 0.1 * (1 + np.arange(PLACES)), np.nan)
    said = at.assign(**dict.fromkeys(numbers, 0.0), in_domain=True, **done)
    said["estimate"] = estimate
    said.loc[PLACES - 1, ["status", "reason"]] = "missing", "no map around"
    put(tables / "predictions" / "0_0.parquet", said, (*PLACE_COLUMNS, *PREDICTION_COLUMNS))
    rows = at.loc[list(LABELS)].drop(columns=["route_id", "above_ground"]).assign(**done)
    rows = rows.assign(x=rows["x"] + 0.2, error_mean=[0.3, 0.7], p_fail=0.25)
    put(tables / "errors" / "day" / "0.parquet", rows, ERROR_COLUMNS)
    return folder
