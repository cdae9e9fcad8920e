"""What is in files that others have made: points, logs, routes."""

from pathlib import Path

import numpy as np

from tilestream.apps.info.record import Info, Kind, heights_of, utc
from tilestream.formats import FORMATS, describe
from tilestream.formats.logs import is_log, open_log
from tilestream.formats.registry import format_of_directory, format_of_ending
from tilestream.formats.routes import READERS, read_all_routes
from tilestream.formats.routes.base import Path3
from tilestream.formats.routes.degrees import in_degrees
from tilestream.records import Float64
from tilestream.settings import LogOptions

ROUTES = {".osm": "Lanelet2", ".geojson": "GeoJSON", ".json": "GeoJSON", ".csv": "CSV"}
"""Names of the formats of routes, by ending; all others are poses."""


def _of_points(path: str, _: LogOptions) -> Info:
    """A file of points, or a map directory."""
    found = describe(path)
    return Info(
        path=found.path,
        kind="points",
        format=found.format,
        size_bytes=found.size_bytes,
        crs=found.crs,
        bounds=found.bounds,
        heights=heights_of(found.bounds),
        points=found.points,
        fields=found.fields,
        contents=found.contents,
        notes=found.notes,
    )


def _of_log(path: str, options: LogOptions) -> Info:
    """A log: its scans, their poses, and the map that they would make."""
    log, found = open_log(path, options), describe(path, **options.given)
    return Info(
        path=found.path,
        kind="log",
        format=found.format,
        size_bytes=found.size_bytes,
        frames={"scans": log.frame},
        bounds=found.bounds,
        heights=heights_of(found.bounds),
        points=found.points,
        fields=found.fields,
        coverage={
            "length_m": log.length_m(np.arange(len(log))),
            "scans": len(log),
            "scans_with_pose": int(log.posed.sum()),
            "poses": len(log.trajectory.stamps_ns),
            "from": utc(int(log.stamps_ns[0])),
            "until": utc(int(log.stamps_ns[-1])),
        },
        contents=found.contents,
        notes=found.notes,
    )


def _of_routes(path: str, _: LogOptions) -> Info:
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


def _is_points(path: str, _: frozenset[str]) -> bool:
    known = format_of_ending(path, FORMATS) or format_of_directory(path, FORMATS)
    return known is not None and not is_log(path)


KINDS = (
    Kind("logs of drives", lambda path, _: is_log(path), _of_log),
    Kind("files and folders of points", _is_points, _of_points),
    Kind(
        "files of routes",
        lambda path, _: Path(path).is_file() and Path(path).suffix.lower() in READERS,
        _of_routes,
    ),
)
