"""What is in a file of routes, in its own coordinates; lengths in metres."""

from pathlib import Path

import numpy as np

from tilestream.apps.info.record import Info
from tilestream.formats.routes import READERS, read_all_routes
from tilestream.formats.routes.base import Path3
from tilestream.formats.routes.degrees import in_degrees
from tilestream.records import Float64
from tilestream.settings import LogOptions

ROUTES = {".osm": "Lanelet2", ".geojson": "GeoJSON", ".json": "GeoJSON", ".csv": "CSV"}
"""Names of the formats, by ending; all others are poses."""


def described(path: str, _: LogOptions) -> Info:
    """A file of routes, in its own coordinates; lengths in metres."""
    ending = Path(path).suffix.lower()
    drawn = [part for part in READERS[ending](path) if isinstance(part, Path3)]
    places = [part.positions for part in drawn]
    every: Float64 = np.concatenate([np.zeros((0, 3)), *places])
    crs = next((part.crs for part in drawn if part.crs is not None), None)
    degrees = bool(drawn) and in_degrees(
        path, places, crs, drawn=not any(part.recorded for part in drawn)
    )
    read = read_all_routes(path, project_to=_here(every) if degrees else None)
    stamps = [part.stamps_s for part in drawn if part.stamps_s is not None]
    coverage = {
        "routes": len(read.routes),
        "length_m": sum(float(route.arc_length[-1]) for route in read.routes),
        "vertices": len(every),
        "vertices_with_z": int(np.isfinite(every[:, 2]).sum()),
    }
    if stamps:
        coverage |= {
            "from": min(float(times[0]) for times in stamps),
            "until": max(float(times[-1]) for times in stamps),
        }
    notes = [note.removeprefix(f"{path}: ") for note in read.notes]
    lost = [f"{name} cannot be used: {reason}" for name, reason in read.failures.items()]
    return Info(
        path=path,
        kind="routes",
        format=ROUTES.get(ending, "poses"),
        state="whole" if not lost else f"{len(lost)} of its routes cannot be used, see the notes",
        size_bytes=Path(path).stat().st_size,
        crs=crs,
        unit="degrees" if degrees else "m",
        coverage=coverage,
        notes=[*notes, *lost],
    ).over(every)


def _here(degrees: Float64) -> str:
    """A projection round the middle of some places, whose lengths are right there."""
    middle = degrees[np.isfinite(degrees[:, :2]).all(axis=1), :2].mean(axis=0)
    longitude, latitude = np.clip(middle, (-180.0, -89.0), (180.0, 89.0))  # others are refused
    return f"+proj=tmerc +lon_0={longitude:.4f} +lat_0={latitude:.4f} +k=1 +datum=WGS84 +units=m"
