"""What a map and scans of it give on this processor; as a program, written to a file."""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import PLACES

import tilestream as ts
from tilestream.factors.beams import Beams
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import surfel_mm, surfels_in
from tilestream.factors.virtual_scan import look, virtual_scan
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import Box
from tilestream.settings import VirtualSettings


def figures(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Cells, factors of 30 places, Hessians and 3D errors of 317 starts at three of them."""
    folder.mkdir()
    write_pcd(folder / "map.pcd", PLACES["canyon"](np.random.default_rng(3), 40.0, 0.2))
    store = ts.ingest(folder / "map.pcd", folder / "map.zarr", tile_size=20.0)
    at = np.linspace(0.0, 1.0, 30)
    places = np.column_stack([5.0 + 30.0 * at, np.sin(9.0 * at), 2.0 + 0.1 * at])
    factors = ts.factors(store, places, which="all").drop(columns=["status", "reason"])
    cells = ts.cells_of(np.concatenate([store.tile(key).points() for key in store.keys()]))
    surfels = surfels_in(store, Box(-10_000, -30_000, 50_000, 30_000))
    seeing, error, hessian = VirtualSettings(), [], []
    for place in places[5::10]:
        T_map_lidar = np.eye(4)
        T_map_lidar[:3, 3] = place = np.round(place, 3)
        place_mm = np.rint(place * 1000.0).astype(np.int64)
        scene = Scene.of(surfels, place_mm[None], surfel_mm(store))
        beams = Beams.of(ts.VLP16, seeing)
        found = look(scene, place_mm, 0.0, seeing, beams)
        scan = virtual_scan(scene, found, place_mm, seeing, beams).points
        still = ts.RegistrationSettings(iterations_max=0)
        hessian.append(ts.register(cells, scan, T_map_lidar, still).hessian[0])
        error.append(ts.localization_error(cells, scan, T_map_lidar).error)
    return {
        "cells": np.column_stack([cells.mean, cells.covariance.reshape(-1, 9), cells.normal]),
        "factors": factors.to_numpy(np.float64),
        "hessian": np.array(hessian),
        "error": np.array(error),
    }


if __name__ == "__main__":
    np.savez(Path(sys.argv[1]) / "figures.npz", **figures(Path(sys.argv[1]) / "map"))
