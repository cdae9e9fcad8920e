"""The virtual scan, from the map alone, beside the simulator's own of the same place."""

from pathlib import Path

import numpy as np
import pytest

import tilestream as ts
from tilestream.factors.observability import whole_places
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import surfel_mm, surfels_in
from tilestream.formats.logs import open_log
from tilestream.grid import Box
from tilestream.kernels.virtual_scan import cast
from tilestream.pipeline.jobs.simulate import simulate
from tilestream.simulation.settings import load_preset

NEAR, REACH = 1_000.0, 76_000.0
"""Of the beams that are cast [mm]."""
AGREE = 0.2
"""Ranges that differ by less agree [m]."""
AT_LEAST = {(1.0, 10.0): 0.5, (10.0, 30.0): 0.6, (1.0, 75.0): 0.55}
"""Share of the beams that must agree, by range [m].."""


@pytest.mark.slow
def test_most_beams_end_where_those_of_the_simulator_did(tmp_path: Path) -> None:
    simulate(load_preset("paper"), tmp_path, paths=["III"])
    store = ts.ingest(tmp_path / "survey" / "*", tmp_path / "map.zarr")
    pairs = []
    for scan in open_log(str(tmp_path / "logs" / "drive0" / "III.mcap")).scans_at(
        [30, 90, 150, 210]
    ):
        assert scan.T_map_lidar is not None
        place = scan.T_map_lidar[:3, 3]
        surfels = surfels_in(store, Box.around(place[None], REACH / 1e3))
        seen = surfels.where(~surfels.ghost)
        scene = Scene.of(seen, whole_places(place)[None], surfel_mm(store))
        true = np.linalg.norm(scan.points, axis=1)
        beams = np.ascontiguousarray(scan.points / true[:, None] @ scan.T_map_lidar[:3, :3].T)
        met, cosine = np.empty(len(true)), np.empty(len(true))
        row = np.empty(len(true), np.int32)
        cast(scene.bricks, whole_places(place), beams, NEAR, REACH, met, cosine, row)
        pairs.append(np.column_stack([true, met]))
    true, met = np.concatenate(pairs).T
    assert len(true) > 20_000
    for (low, high), share in AT_LEAST.items():
        some = (true >= low) & (true < high)
        found = (np.abs(met - true)[some] < AGREE).mean()
        assert found > share, f"{low:g} to {high:g} m: {found:.1%} of {some.sum()} beams"
