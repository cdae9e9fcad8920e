"""The matcher of a vehicle, read from Autoware's own parameter files.

`ndt_scan_matcher.param.yaml` gives the matcher. A folder with it may hold, beside it or in
`pointcloud_preprocessor/`, what is done to a scan before: the crop box, the voxel grid and the
random sample, in this order. What has no effect on a registration is named in a note; what is not
known is refused.
"""

import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tilestream.bounded_yaml import read_yaml
from tilestream.errors import UsageError
from tilestream.files import local_path

MATCHER = "ndt_scan_matcher.param.yaml"
"""The file of the matcher."""
BELOW = "pointcloud_preprocessor"
"""The folder beside it in which Autoware keeps the filters."""
EFFECT = {
    "ndt.trans_epsilon": "epsilon",
    "ndt.step_size": "step_max",
    "ndt.resolution": "resolution",
    "ndt.max_iterations": "iterations_max",
    "sensor_points.required_distance": "required_distance",
}
"""What decides a registration, by its key in the file: the setting that it is here. The older, flat
layout has the last part of the key alone."""
SEARCH = "neighborhood_search_method"
"""In the older layout: how the cells of a point are found."""
SEARCHES = {0: "radius", 2: "direct7", 3: "direct1"}
"""Its numbers, but for 26 neighbours, which nothing here has."""
REGULARIZATION = ("ndt.regularization.enable", "regularization_enabled")
"""Whether a GNSS pose pulls the result along the road."""
GROUPS = (
    "frame",
    "ndt.regularization",
    "initial_pose_estimation",
    "validation",
    "score_estimation",
    "covariance",
    "covariance_by_place",
    "dynamic_map_loading",
)
"""Groups of keys without effect on where a registration from a given start ends."""
WITHOUT = (
    "sensor_points.timeout_sec",
    "ndt.num_threads",
    # of the older layout
    "num_threads",
    "omp_num_threads",
    "ndt_implement_type",
    "use_dynamic_map_loading",
    "base_frame",
    "ndt_base_frame",
    "map_frame",
    "input_sensor_points_queue_size",
    "lidar_topic_timeout_sec",
    "converged_param_type",
    "converged_param_transform_probability",
    "converged_param_nearest_voxel_transformation_likelihood",
    "initial_estimate_particles_num",
    "n_startup_trials",
    "initial_pose_timeout_sec",
    "initial_pose_distance_tolerance_m",
    "initial_to_result_distance_tolerance_m",
    "critical_upper_bound_exe_time_ms",
    "skipping_publish_num",
    "output_pose_covariance",
    "use_covariance_estimation",
    "initial_pose_offset_model_x",
    "initial_pose_offset_model_y",
    "offset_array_x",
    "offset_array_y",
    "regularization_enabled",
    "regularization_scale_factor",
    "dynamic_map_loading_update_distance",
    "dynamic_map_loading_map_radius",
    "lidar_radius",
    "estimate_scores_for_degrounded_scan",
    "estimate_scores_by_no_ground_points",
    "z_margin_for_ground_removal",
)
"""Keys without such an effect."""
OF_A_NODE = ("input_frame", "output_frame", "max_queue_size", "processing_time_threshold_sec")
"""Keys of every filter."""


@dataclass(frozen=True)
class AutowareMatcher:
    """What the files say."""

    settings: Mapping[str, Any]
    """Settings of a registration that differ from those of the preset `autoware`, maybe."""
    notes: tuple[str, ...]
    """What was read, what has no effect here, what was assumed."""


def read_matcher(path: str) -> AutowareMatcher:
    """The matcher in a parameter file, or in a folder of them.

    Raises:
        UsageError: no such file; no parameters of one node; a key that is not known, or a value
            that cannot be followed here; names file and key.
    """
    place = Path(local_path(path))
    folder = place if place.is_dir() else None
    file = place / MATCHER if folder else place
    if not file.is_file():
        raise UsageError(f"{file}: no such matcher or file of one")
    found, notes = _matcher(file)
    if folder is None:
        told = f"how scans are thinned before is not in this file: its folder, with {BELOW}, has it"
        return AutowareMatcher(found, (*notes, f"{file}: {told}"))
    for names, read, otherwise in FILTERS:
        files = [f for name in names for f in _named(folder, name)]
        if len(files) > 1:
            raise UsageError(f"{files[0]} and {files[1]} both say what one filter does: keep one")
        if not files:
            notes.append(f"{folder}: has no {' or '.join(names)}: {otherwise}")
            continue
        settings, more = read(files[0], _parameters(files[0]))
        found |= settings
        notes += more
    return AutowareMatcher(found, tuple(notes))


def _named(folder: Path, name: str) -> list[Path]:
    return [f for f in (folder / name, folder / BELOW / name) if f.is_file()]


def _matcher(file: Path) -> tuple[dict[str, Any], list[str]]:
    """The settings that a matcher's file gives, and its notes."""
    given = _parameters(file)
    flat = {key.rsplit(".", 1)[1]: name for key, name in EFFECT.items()}
    known = EFFECT | flat
    found = {known[key]: value for key, value in given.items() if key in known}
    if not found:
        raise UsageError(f"{file}: has none of {', '.join(EFFECT)}: is it a {MATCHER}?")
    for key in (SEARCH, f"ndt.{SEARCH}", f"omp_{SEARCH}"):
        if key in given:
            if not isinstance(given[key], int) or given[key] not in SEARCHES:
                raise UsageError(f"{file}: {key} {given[key]} is not known here: 0, 2 or 3 are")
            found["neighbours"] = SEARCHES[given[key]]
            known[key] = "neighbours"
    idle = [key for key in given if key not in known and _has_no_effect(key)]
    _refuse_others(file, given, {*known, *idle, *WITHOUT})
    notes = [f"{file}: without effect here: {', '.join(idle)}"] if idle else []
    if any(given.get(key) is True for key in REGULARIZATION):
        told = "the vehicle is pulled to its GNSS pose (regularization), which nothing here does"
        notes.append(f"{file}: {told}")
    missing = [key for key, name in EFFECT.items() if name not in found and name != WHOLE]
    if missing:
        notes.append(f"{file}: says nothing of {', '.join(missing)}: as in the preset autoware")
    return found, notes


WHOLE = "required_distance"
"""What older files do not have."""


def _has_no_effect(key: str) -> bool:
    return key in WITHOUT or key.startswith(tuple(f"{group}." for group in GROUPS))


def _crop(file: Path, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The crop box; points on its faces are inside."""
    ends = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    _refuse_others(file, given, {*ends, "negative", *OF_A_NODE})
    missing = [end for end in ends if end not in given]
    if missing:
        raise UsageError(f"{file}: the box has no {', '.join(missing)}")
    box = {
        "lowest": [given[end] for end in ends[:3]],
        "highest": [given[end] for end in ends[3:]],
        "negative": given.get("negative", False),
    }
    frame = given.get("input_frame") or "the sensor's"
    told = f"the box is in the frame {frame}: give `mount`, where the lidar is in it, if it differs"
    return {"crop": box}, [f"{file}: {told} from that of the scans"]


def _voxels(file: Path, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The voxel grid: a centroid per voxel."""
    edges = [f"voxel_size_{axis}" for axis in "xyz"]
    _refuse_others(file, given, {*edges, *OF_A_NODE})
    first, *others = (given.get(edge) for edge in edges)
    if first is None or any(other != first for other in others):
        told = ", ".join(f"{edge} {given.get(edge)}" for edge in edges)
        raise UsageError(f"{file}: {told}: voxels here are cubes, give one size for all")
    return {"scan_leaf": first}, []


def _sample(file: Path, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The random sample."""
    _refuse_others(file, given, {"sample_num", *OF_A_NODE})
    if "sample_num" not in given:
        raise UsageError(f"{file}: has no sample_num")
    return {"random_sample": given["sample_num"]}, []


Read = Callable[[Path, Mapping[str, Any]], tuple[dict[str, Any], list[str]]]
FILTERS: tuple[tuple[tuple[str, ...], Read, str], ...] = (
    (("crop_box_filter_measurement_range.param.yaml",), _crop, "scans are not cropped"),
    (
        ("voxel_grid_filter.param.yaml", "voxel_grid_downsample_filter.param.yaml"),
        _voxels,
        "scans are thinned to scan_leaf, as it is set here",
    ),
    (("random_downsample_filter.param.yaml",), _sample, "all points of a thinned scan are used"),
)
"""The files of the filters, in the order in which a scan goes through them, and what is done
without one."""


def _parameters(file: Path) -> dict[str, Any]:
    """The parameters of the one node of a file, by their whole names.

    Raises:
        UsageError: it is no file of parameters, or of several nodes.
    """
    content = read_yaml(file, UsageError)
    nodes = content if isinstance(content, dict) else {}
    inside = [node.get("ros__parameters") for node in nodes.values() if isinstance(node, dict)]
    if len(nodes) != 1 or len(inside) != 1 or not isinstance(inside[0], dict):
        raise UsageError(f"{file}: no parameters of one node: /**: ros__parameters: … is expected")
    found: dict[str, Any] = {}
    for key, value in _flat(inside[0], ""):
        if key in found:
            raise UsageError(f"{file}: {key} is there twice")
        if isinstance(value, str) and value.startswith("$("):
            raise UsageError(f"{file}: {key} is {value}, which a launch file sets: give the value")
        found[key] = value
    return found


def _flat(values: Mapping[Any, Any], above: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _refuse_others(file: Path, given: Mapping[str, Any], known: set[str]) -> None:
    for key in given:
        if key not in known:
            near = difflib.get_close_matches(key, sorted(known), n=1)
            hint = f"did you mean {near[0]}? If not, " if near else ""
            raise UsageError(
                f"{file}: {key} is no parameter that is known here: {hint}take it out if it does "
                "not change where a registration ends"
            )
