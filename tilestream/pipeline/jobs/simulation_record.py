"""What was simulated in a folder: its record and its routes; what may not be mixed with them."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from tilestream.bounded_yaml import read_yaml
from tilestream.errors import UsageError
from tilestream.files import Files
from tilestream.pipeline.engine.stage import Task
from tilestream.simulation.city import City, data_file
from tilestream.simulation.drive import motion_of
from tilestream.simulation.settings import SimulationSettings
from tilestream.simulation.streets import Street
from tilestream.version import VERSION

SMALL_POINTS = 40
"""Sample points of each path of `size="small"`."""
RECORD, ROUTES = "simulation.yaml", "routes.geojson"
"""Files that say what was simulated, and where its streets run."""
OF_DRIVE = ("preset", "lidar", "odometry_error", "reverse", "side", "scans_per_point", "every")
"""What of a simulation may differ from the one whose survey it uses."""
SIMULATION_VERSION = 1
"""Raised when the code of the simulation changes what it writes."""

Size = Literal["full", "small"]
"""How much of each path."""


def identity_of(
    settings: SimulationSettings, scans_per_point: int, every: int, size: Size
) -> dict[str, Any]:
    """All that decides what the files of a simulation hold, whatever their drive."""
    inputs = {
        name: hashlib.sha256(data_file(name).read_bytes()).hexdigest()
        for name in (settings.city.footprints, settings.city.routes)
    }
    return {
        "settings": settings.model_dump(mode="json", exclude={"drive", "note"}),
        "scans_per_point": scans_per_point,
        "every": every,
        "size": size,
        "inputs_sha256": inputs,
        "tilestream": VERSION,
        "simulation_version": SIMULATION_VERSION,
    }


def require_same(folder: Path, identity: dict[str, Any]) -> None:
    """Refuse to mix two simulations.

    Raises:
        UsageError: the folder holds one with another identity; names what differs.
    """
    record = folder / RECORD
    if not record.exists():
        return
    known = _record(record)
    there = {name: known.get(name) for name in identity}
    other = [f"{name} {there[name]}" for name in identity if there[name] != identity[name]]
    if other:
        raise UsageError(
            f"{folder} holds another simulation, with {'; '.join(other)} ({record}): give another "
            "directory"
        )


def _record(path: Path) -> dict[str, Any]:
    """What was simulated beside it.

    Raises:
        UsageError: it is no record.
    """
    known = read_yaml(path, UsageError)
    if not isinstance(known, dict) or not isinstance(known.get("settings"), dict):
        raise UsageError(f"{path} is no record of a simulation: give another directory")
    return known


def require_surveyed(folder: Path, identity: dict[str, Any], surveys: Sequence[Task]) -> None:
    """Refuse a survey that is not of the same city, or not whole.

    Raises:
        UsageError: names what differs, or how much is missing.
    """
    record = folder / RECORD
    if not record.exists():
        raise UsageError(f"{folder}: no simulation is there: give one whose survey is to be used")
    known = _record(record)
    same = [name for name in identity if name not in ("settings", *OF_DRIVE)]
    settings, there = identity["settings"], known["settings"]
    other = [f"{name} {known.get(name)}" for name in same if known.get(name) != identity[name]]
    other += [
        f"{name} {there.get(name)}"
        for name in settings
        if name not in OF_DRIVE and there.get(name) != settings[name]
    ]
    if other:
        raise UsageError(f"{folder} has the survey of another city, with {'; '.join(other)}")
    missing = [task.key for task in surveys if task.writes.known(task.identity) is None]
    if missing:
        raise UsageError(
            f"{folder}: {len(missing)} of {len(surveys)} blocks of its survey are not there, the "
            f"first {missing[0]}: simulate it first, with these paths"
        )


def begin_folder(folder: Path, city: City, identity: dict[str, Any]) -> None:
    """Make the folders; write what is simulated, and the routes."""
    for part in ("survey", f"logs/drive{city.settings.drive}", "parts"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    facts = identity | {
        "note": city.settings.note,
        "buildings": len(city.footprints.height),
        "buildings_left_out": dict(city.footprints.refused),
        "attribution": city.footprints.attribution,
    }
    end = SMALL_POINTS if identity["size"] == "small" else None
    features = [_feature(street, city, end) for street in city.streets]
    crs = city.settings.city.crs
    named = {} if crs is None else {"crs": {"type": "name", "properties": {"name": crs}}}
    routes = {"type": "FeatureCollection", **named, "features": features}
    _keep(folder / ROUTES, f"{json.dumps(routes)}\n")
    _keep(folder / RECORD, yaml.safe_dump(facts, sort_keys=True, allow_unicode=True))


def _keep(path: Path, text: str) -> None:
    """Write a file whole, unless it says so already: its time tells readers of a change."""
    if not path.exists() or path.read_bytes() != text.encode():
        Files.at(path).write(text.encode())


def _feature(street: Street, city: City, end: int | None) -> dict[str, Any]:
    """A street as GeoJSON, as far as it is simulated, with the height of its road."""
    motion = replace(motion_of(street, city.settings, 0.0), side=0.0)
    line = motion.pose(city.ground, street.arc[:end])[:, :3, 3] + city.settings.city.shift
    properties = {
        "name": street.name,
        "kind": street.kind,
        "driven": street.driven,
        "spots": [vars(spot) for spot in street.spots],
    }
    geometry = {"type": "LineString", "coordinates": np.round(line, 3).tolist()}
    return {
        "type": "Feature",
        "id": street.name,
        "properties": properties,
        "geometry": geometry,
    }
