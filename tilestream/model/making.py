"""What a model was trained with as numbers, and what of it may differ where it is used."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tilestream.sensor import Carrier, rim_of, sensor_of

MAY_DIFFER = ("sensor", "sensor_height", "matcher")
"""What of a making the virtual drive knows, so that a model on top of it may have seen several."""
SEEING = ("range_max", "blind_rear_deg", "seed")
"""What of how the virtual drive sees, likewise; the seed is no property of a lidar."""
SIGNIFICANT = 6
"""Digits of a number in words."""

Value = float | str
"""A number, or one of some words."""


@dataclass(frozen=True)
class Outside:
    """An input that lies outside of what a model was trained over."""

    name: str
    """Of the input."""
    value: Value
    """What it is."""
    trained: str
    """What it was where the model was trained."""

    def __str__(self) -> str:
        return f"{self.name} {_told(self.value)}, trained over {self.trained}"


def shared(making: Mapping[str, Any], judged: Sequence[str]) -> dict[str, Any]:
    """A making without what is judged by a card: `name`, or `seeing.name`."""
    kept = {name: value for name, value in making.items() if name not in judged}
    seeing = kept.get("seeing")
    if isinstance(seeing, Mapping):
        kept["seeing"] = {k: v for k, v in seeing.items() if f"seeing.{k}" not in judged}
    return kept


def judged_of(makings: Sequence[Mapping[str, Any]]) -> list[str]:
    """What a card judges of makings: of several lidars all that may differ, of one what does."""
    may = [*MAY_DIFFER, *(f"seeing.{name}" for name in SEEING)]
    if len({lidar_of(making) for making in makings}) > 1:
        return may
    first = makings[0]
    differ = [[one.get(name) != first.get(name) for one in makings] for name in MAY_DIFFER]
    found = [name for name, there in zip(MAY_DIFFER, differ, strict=True) if any(there)]
    seen = [one.get("seeing", {}) for one in makings]
    more = [name for name in SEEING if any(one.get(name) != seen[0].get(name) for one in seen)]
    return [*found, *(f"seeing.{name}" for name in more)]


def inputs_of(making: Mapping[str, Any]) -> dict[str, Value]:
    """The lidar and the matcher of a making as numbers and words, by name.

    The lidar's are of its vehicle: `lidars`, `beams`, `elevation_low_deg` and `elevation_high_deg`
    (above the horizontal of the vehicle, tilt included), `azimuth_step_deg`, `view_deg`,
    `range_noise` [m], `range_m` (usable), `blind_rear_deg`, `height_m` (mean of the lidars above
    the road), `offset_m` (of the farthest from the vehicle's origin); `cell_size` [m]; the
    matcher's begin with `matcher.`.
    """
    found: dict[str, Value] = {}
    if "sensor" in making:
        found |= _of_lidar(sensor_of(making["sensor"]), making)
    if "cell_size" in making:
        found["cell_size"] = float(making["cell_size"])
    for name, value in making.get("matcher", {}).items():
        plain = not isinstance(value, bool) and isinstance(value, int | float)
        found[f"matcher.{name}"] = float(value) if plain else str(value)
    return found


def _of_lidar(vehicle: Carrier, making: Mapping[str, Any]) -> dict[str, Value]:
    seeing, sensors = making.get("seeing", {}), vehicle.sensors
    usable = seeing.get("range_max") or vehicle.range_max
    tilts = [sensor.mount.tilt_deg for sensor in sensors]
    lows = [s.elevations_deg[0] - tilt for s, tilt in zip(sensors, tilts, strict=True)]
    highs = [s.elevations_deg[-1] + tilt for s, tilt in zip(sensors, tilts, strict=True)]
    above = float(np.mean([sensor.mount.z for sensor in sensors]))
    return {
        "lidars": float(len(sensors)),
        "beams": float(sum(len(sensor.elevations_deg) for sensor in sensors)),
        "elevation_low_deg": max(min(lows), -90.0),
        "elevation_high_deg": min(max(highs), 90.0),
        "azimuth_step_deg": max(sensor.azimuth_step_deg for sensor in sensors),
        "view_deg": max(sensor.view_deg for sensor in sensors),
        "range_noise": max(sensor.range_noise for sensor in sensors),
        "range_m": float(min(usable, vehicle.range_max)),
        "blind_rear_deg": float(seeing.get("blind_rear_deg", 0.0)),
        "height_m": float(making.get("sensor_height", 0.0)) + above,
        "offset_m": rim_of(vehicle),
    }


def lidar_of(making: Mapping[str, Any]) -> str:
    """A lidar in words: name, beams, usable range, blind sector; empty: none is named."""
    if "sensor" not in making:
        return ""
    vehicle = sensor_of(making["sensor"])
    found = _of_lidar(vehicle, making)
    blind = float(found["blind_rear_deg"])
    hidden = f", {blind:g} deg blind" if blind else ""
    return f"{vehicle.name}, {found['beams']:g} beams, {found['range_m']:g} m{hidden}"


def ranges_of(inputs: Sequence[Mapping[str, Value]]) -> dict[str, list[Value]]:
    """What each input was: of numbers the lowest and the highest, then the words."""
    names = sorted({name for one in inputs for name in one})
    found: dict[str, list[Value]] = {}
    for name in names:
        values = [one[name] for one in inputs if name in one]
        numbers = [value for value in values if isinstance(value, float)]
        words = sorted({value for value in values if isinstance(value, str)})
        found[name] = [*([min(numbers), max(numbers)] if numbers else []), *words]
    return found


def outside(ranges: Mapping[str, Sequence[Value]], making: Mapping[str, Any]) -> list[Outside]:
    """The inputs of a making that lie outside of ranges (`ranges_of`)."""
    found = []
    for name, value in inputs_of(making).items():
        known = ranges.get(name, ())
        numbers = [one for one in known if not isinstance(one, str)]
        if isinstance(value, str):
            inside = value in known
        else:
            # a range read from JSON is exact, a tilt may not be
            slack = 1e-9 * max(1.0, abs(value))
            inside = bool(numbers) and numbers[0] - slack <= value <= numbers[-1] + slack
        if not inside:
            found.append(Outside(name, value, range_told(known)))
    return found


def range_told(known: Sequence[Value]) -> str:
    """Of `ranges_of` one entry in words."""
    numbers = [_told(one) for one in known if not isinstance(one, str)]
    words = [one for one in known if isinstance(one, str)]
    told = " to ".join(dict.fromkeys(numbers))
    return ", ".join([*([told] if told else []), *words]) or "nothing of it"


def _told(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.{SIGNIFICANT}g}"
