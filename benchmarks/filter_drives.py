"""Labelled drives of finished runs, as a filter drives along them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.grid import Box
from tilestream.kernels.fixed_order import norms
from tilestream.local_map import LocalCells, reach_of
from tilestream.pipeline.jobs.inventory import tables_in
from tilestream.pipeline.jobs.run_inputs import drives_of, reading_of
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.pipeline.jobs.train_over import dataset_over
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.store import open_store
from tilestream.tables import read_tables

Floats = NDArray[np.float64]
AROUND = 4.0
"""Registrations start no farther than this from the truth [m]."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A labelled drive; a row per scan that was measured, in the order of the way."""

    name: str
    """`<run>/<group>`."""
    street: str
    """`<district>/<path>`: none trains where it is tested."""
    road: str
    """Equal for drives along one road only: real districts are named by nobody."""
    settings: RunSettings
    """Of its run."""
    reading: Reading
    """How its log is read, as if by which lidar."""
    labels: pd.DataFrame
    """The table `errors`."""
    seen: pd.DataFrame
    """The virtual drive of each place (`virtual_drives`), on the index of `labels`."""

    @property
    def spacing(self) -> float:
        """Middle distance between scans [m]."""
        return float(self.labels["arc_length"].diff().median())

    @cached_property
    def T_map_lidar(self) -> Floats:
        """(n, 4, 4) true poses."""
        poses: Floats = self.reading.open().T_map_lidar[self.labels["scan"].to_numpy()]
        return poses

    def scans(self) -> Iterator[tuple[Floats, LocalCells]]:
        """Each scan as it is to be localized, and the map around."""
        log, matcher = self.reading.open(), self.settings.label.registration
        seen = [self.reading.seen(s, log).points for s in log.scans_at(self.labels["scan"])]
        size = self.settings.cell_size
        reach = max(float(norms(points).max()) for points in seen) + 4.0 * AROUND
        places = self.T_map_lidar[:, :3, 3]
        store = open_store(self.settings.store_url)
        cells = store.cells_in(Box.around(places[:, :2], reach), size)
        for points, place in zip(seen, places, strict=True):
            reach = reach_of(points, matcher, size) + AROUND
            yield points, LocalCells.around(cells, place[None], reach, matcher)


def drives_in(run: Path) -> list[Drive]:
    """The drives of a run directory that have labels and virtual drives."""
    settings = read_settings(run / "config.yaml")
    dataset = dataset_over({run.name: run})
    streets = dataset.rows.groupby("group")["street"].agg(lambda names: names.mode()[0])
    seen = dict(iter(dataset.virtual_drives.groupby("group")))
    found = []
    for drive in drives_of(settings):
        name = f"{run.name}/{drive.group}"
        if name not in streets or name not in seen:
            continue
        labels = read_tables(tables_in(str(run / "tables" / "errors" / drive.group)))
        labels = labels[labels["status"] == "done"].sort_values("arc_length", ignore_index=True)
        own = seen[name].set_index("sample").reindex(labels["sample"]).set_index(labels.index)
        own = own.assign(arc_length=labels["arc_length"], status=own["status"].fillna("missing"))
        own = own.assign(route_id=name)
        street = streets[name]
        road = street if settings.simulate is not None else f"{run.name}/{street}"
        found.append(Drive(name, street, road, settings, reading_of(drive), labels, own))
    return found
