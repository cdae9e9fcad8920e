"""A synthetic city by tiling: one block of street as LAZ, copied with offsets. No simulation.

All of a job over it, and what it wrote as one digest, to compare runs that ought to be the same.
"""

import hashlib
import struct
from pathlib import Path
from typing import Any

import laspy
import logs
import numpy as np
from logs import SECOND, START, pose
from scenes import PLACES, in_map

import tilestream as ts
from tilestream.formats.points.las import write_las
from tilestream.formats.routes import route_of
from tilestream.pipeline.engine.executor import Watch
from tilestream.settings import StartSettings

OFFSETS_AT = 155
"""Where the header of a LAS file has its three offsets, then highest and lowest of each axis."""
SCANS = 8


def block(size: float, spacing: float, seed: int = 1) -> np.ndarray:
    """A street along x with its facades, x and y in [0, size) m."""
    points = PLACES["canyon"](np.random.default_rng(seed), size, spacing)
    points = in_map(points, (0.0, size / 2.0, 0.0))
    return points[((points[:, :2] >= 0.0) & (points[:, :2] < size)).all(axis=1)]


def write_city(folder: Path, n: int, size: float, spacing: float) -> int:
    """`blocks/<column>_<row>.laz`, n x n of them, each one tile; the points of one."""
    (folder / "blocks").mkdir(parents=True)
    points = block(size, spacing)
    write_las(folder / "block.laz", points)
    file = (folder / "block.laz").read_bytes()
    for ix in range(n):
        for iy in range(n):
            moved = moved_las(file, ix * size, iy * size)
            (folder / "blocks" / f"{ix:03d}_{iy:03d}.laz").write_bytes(moved)
    return len(points)


def moved_las(file: bytes, dx: float, dy: float) -> bytes:
    """The same compressed points elsewhere: only the header says where they lie."""
    layout = "<9d"
    x, y, z, *bounds = struct.unpack_from(layout, file, OFFSETS_AT)
    moves = (dx, dx, dy, dy, 0.0, 0.0)
    bounds = [value + move for value, move in zip(bounds, moves, strict=True)]
    moved = bytearray(file)
    struct.pack_into(layout, moved, OFFSETS_AT, x + dx, y + dy, z, *bounds)
    return bytes(moved)


def routes(n: int, size: float) -> list[ts.Route]:
    """Down every street of the city."""
    x = np.linspace(1.0, n * size - 1.0, n + 1)
    return [
        route_of(f"street {row}", np.stack([x, np.full_like(x, (row + 0.5) * size), x * np.nan], 1))
        for row in range(n)
    ]


def write_drive(path: Path, size: float, spacing: float) -> Path:
    """A drive down the first street, a scan every two metres."""
    seen = np.vstack([in_map(block(size, spacing), (column * size, 0.0, 0.0)) for column in (0, 1)])
    messages: list[logs.Message] = []
    for i in range(SCANS):
        T_map_lidar = pose(x=10.0 + 2.0 * i, y=size / 2.0, z=2.0)
        points = seen - T_map_lidar[:3, 3]
        near = points[np.linalg.norm(points, axis=1) < 16.0]
        messages.append(logs.odometry_at(START + i * SECOND, T_map_lidar))
        messages.append(logs.cloud_at(START + i * SECOND, near))
    return logs.write(path, messages, chunk_size=200_000)


def run_city(
    folder: str | Path,
    out: str,
    n: int,
    size: float,
    *,
    spacing: float = 2.0,
    reach: float = 25.0,
    client: Any | None = None,
    watch: Watch | None = None,
) -> None:
    """Ingest the city, look at it along every street, localize the drive where there is one.

    Args:
        folder: of `write_city`; `drive.mcap` in it is the drive.
        out: where `map.zarr` and the tables go, a path or any fsspec URL.
        n: blocks along an edge of the city.
        size: edge of a block and of a tile [m].
        spacing: of the sample points [m].
        reach: range of the sensor [m].
        client: a Dask client; None: this process.
        watch: is told of each task that ended.
    """
    folder = Path(folder)
    how: dict[str, Any] = {"client": client, "watch": watch}
    store = ts.ingest(str(folder / "blocks" / "*.laz"), f"{out}/map.zarr", tile_size=size, **how)
    sensor = ts.VLP16.model_copy(update={"name": "city", "range_max": reach})
    ts.factors_along(store, routes(n, size), out, spacing=spacing, sensor=sensor, **how)
    if (folder / "drive.mcap").exists():
        starts = StartSettings(radius=0.4, step=0.2)
        ts.localize(store, folder / "drive.mcap", out, spacing=2.0, starts=starts, **how)


def digest(out: Path) -> dict[str, str]:
    """Hash of every table and of every tile's columns and marks, by path."""
    found = {}
    for path in sorted(out.rglob("*")):
        if path.is_file():
            found[str(path.relative_to(out))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def points_of(path: Path) -> np.ndarray:
    """What laspy reads of a file."""
    with laspy.open(path) as file:
        return np.asarray(file.read().xyz)
