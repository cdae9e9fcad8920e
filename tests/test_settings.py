"""Settings once: what YAML, the command line and Python call a setting is one field."""

import inspect
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import tilestream as ts
from tilestream.apps.compare import compare
from tilestream.cli.app import COMMANDS, command_of
from tilestream.cli.fields import help_of
from tilestream.config import Settings
from tilestream.errors import UsageError
from tilestream.formats.registry import state_of
from tilestream.marks import hash_of
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.sensor import sensor_of
from tilestream.settings import (
    DriveSettings,
    LabelSettings,
    LogOptions,
    MapSettings,
    PlaceSettings,
    RegistrationSettings,
    ReportSettings,
    SimulateSettings,
    StartSettings,
    VirtualSettings,
)
from tilestream.simulation.settings import SimulationSettings

GROUPS: tuple[type[Settings], ...] = (
    PlaceSettings,
    MapSettings,
    DriveSettings,
    LabelSettings,
    RegistrationSettings,
    StartSettings,
    ReportSettings,
    SimulateSettings,
    SimulationSettings,
    VirtualSettings,
)
OWN = {
    ("compare", "spacing"): "a comparison needs fewer places than an estimate",
    ("compare", "sensor"): "several",
    ("compare", "cell_size"): "several",
    ("simulate", "paths"): "with commas between them",
}
"""Options that share a setting's name and have a default of their own."""
FILES = {"store", "folder", "name", "sources", "city", "log"}
"""What a command works on: no settings of it, whatever a job's file calls so."""
JOBS = (ts.estimate, ts.ingest, ts.localize, ts.factors_along, ts.observe_along, compare)


def options() -> Iterator[tuple[str, Any]]:
    for command in COMMANDS:
        for option in command_of(command).params:
            yield command, option


def fields_called(name: str) -> list[Any]:
    """The fields of this name."""
    known = [group.model_fields for group in GROUPS]
    return [fields[name] for fields in known if name in fields and name not in FILES]


@pytest.mark.parametrize("command", COMMANDS)
def test_an_option_that_names_a_setting_has_its_default_and_its_help(command: str) -> None:
    for option in command_of(command).params:
        known = fields_called(option.name)
        if not known or (command, option.name) in OWN:
            continue
        of_help = [field for field in known if help_of(field) == option.help]
        assert of_help, f"{command} --{option.name}: {option.help}"
        (default,) = {field.default for field in of_help if not field.is_required()} or {None}
        assert option.default == default, f"{command} --{option.name}"
        if option.param_type_name == "option":
            assert option.opts[0] == f"--{option.name.replace('_', '-')}"


def test_the_commands_have_settings_as_options() -> None:
    found = {(command, option.name) for command, option in options() if fields_called(option.name)}
    for command, name in (
        ("ingest", "from_s"),
        ("ingest", "map_leaf"),
        ("localize", "range_max"),
        ("localize", "extrinsic"),
        ("ingest", "map_frame"),
        ("factors", "pose_frame"),
        ("compare", "lidar_frame"),
        ("info", "max_speed_mps"),
        ("localize", "matcher"),
        ("factors", "sensor"),
        ("compare", "matcher"),
        ("estimate", "blind_rear_deg"),
        ("estimate", "matcher"),
        ("estimate", "sensor_height"),
        ("simulate", "seed"),
    ):
        assert (command, name) in found
    assert set(OWN) <= found


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.__name__)
def test_a_keyword_of_python_that_names_a_setting_has_its_default(job: Any) -> None:
    places = PlaceSettings()
    for name, parameter in inspect.signature(job).parameters.items():
        known = fields_called(name)
        given = parameter.default
        if not known or given in (inspect.Parameter.empty, None) or (job.__name__, name) in OWN:
            continue
        defaults = [field.default for field in known]
        if name in PlaceSettings.model_fields:
            defaults = [getattr(places, "looking_sensor" if name == "sensor" else name)]
        assert given in defaults, f"{job.__name__}({name}=…)"


@pytest.mark.parametrize(
    ("old", "new"),
    [("max-range", "range-max"), ("blind-rear", "blind-rear-deg"), ("sweep", "sweep-s")],
)
def test_flags_of_the_first_version_are_still_taken(old: str, new: str) -> None:
    both = [option.opts for command, option in options() if f"--{new}" in option.opts]
    assert both
    assert all(f"--{old}" in opts or "--range" in opts for opts in both)


def test_memory_is_an_amount_everywhere() -> None:
    assert PlaceSettings().memory == PlaceSettings(memory="2GB").memory == 2_000_000_000
    assert PlaceSettings(memory=2_000_000).memory == 2_000_000
    with pytest.raises(UsageError, match="'much' is no amount of memory"):
        PlaceSettings(memory="much")


def test_a_matcher_says_its_name_and_what_it_has_otherwise() -> None:
    assert LabelSettings().registration.told == "autoware"
    assert RegistrationSettings().told == "default"
    changed = RegistrationSettings.autoware(scan_leaf=1.0)
    assert changed.told == "autoware, but scan_leaf 1.0"


def test_a_sensor_is_a_name_or_a_file_or_its_fields(tmp_path: Any) -> None:
    fields = ts.VLP16.model_dump(mode="json") | {"name": "mine"}
    (tmp_path / "mine.yaml").write_text(str(fields))
    of_file = PlaceSettings(sensor=str(tmp_path / "mine.yaml"))
    assert of_file == PlaceSettings(sensor=fields)
    assert PlaceSettings(sensor="HDL64").looking_sensor == ts.HDL64


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{name: mine}", "range_max"),
        ("{name: VLP16, 7: 1}", "7"),
        ("[{path}]", "names itself"),
        ("[VLP16, {path}]", "names itself"),
        ("[[[7]]]", "sensor is 7"),
    ],
)
def test_a_sensor_that_cannot_be_is_named_with_its_file(
    text: str, told: str, tmp_path: Any
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace("{path}", str(path)))
    with pytest.raises(UsageError, match=rf"mine\.yaml: .*{told}"):
        sensor_of(str(path))


@pytest.mark.parametrize(
    "given",
    ["1,0,1.8,0,0,90", " 1, 0 ,1.8,0,0,9e1", [1, 0, 1.8, 0, 0, 90], (1.0, 0, 1.8, 0, 0, 90)],
)
def test_a_mount_is_metres_and_degrees(given: Any) -> None:
    options = LogOptions(extrinsic=given)
    assert options == LogOptions(extrinsic="1,0,1.8,0,0,90")
    assert LogOptions(**options.given) == options
    assert options.mount is not None
    x, y, z = options.mount.T_base_lidar[:3, 3]
    assert (x, y, z) == (1.0, 0.0, 1.8)
    np.testing.assert_allclose(options.mount.T_base_lidar[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("wrong", ["1,2,3", "1,2,3,0,0,0,1", "1,2,3,0,0,x", "", "1,2,3,0,0,inf", 7])
def test_what_is_no_mount_is_refused(wrong: Any) -> None:
    with pytest.raises(UsageError, match=r"extrinsic is .*: give x,y,z,roll,pitch,yaw"):
        LogOptions(extrinsic=wrong)


def test_a_mount_is_that_of_one_lidar() -> None:
    for one in ({"extrinsic": "1,0,1.8,0,0,90"}, {"lidar_frame": "front"}):
        with pytest.raises(UsageError, match="has several lidars, /front,/rear"):
            LogOptions(points_topic="/front,/rear", **one)


def test_log_options_are_the_same_of_maps_drives_and_alone() -> None:
    options = {"pose_topic": "/pose", "map_frame": "odom", "max_speed_mps": 90.0}
    for settings in (MapSettings(**options), DriveSettings(log="a.mcap", **options)):
        assert settings.log_options == LogOptions(**options)
        assert settings.log_options.given == options
    assert MapSettings(every=2).log_options == LogOptions()


def test_what_changes_the_poses_of_a_log_changes_its_state(tmp_path: Any) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"x")
    names = ("beams", "range_max", "blind_rear_deg", "sweep_s", "points_topic", "pose_topic")
    as_before = {"path": log.name, "deskew": False, **dict.fromkeys(names)}
    assert Reading(str(log)).state == hash_of(as_before, *state_of(log))
    named = Reading(str(log), LogOptions(pose_topic="/pose"))
    assert named.state == hash_of({**as_before, "pose_topic": "/pose"}, *state_of(log))
    others = [
        {"extrinsic": "1,0,1.8,0,0,90"},
        {"extrinsic": "1,0,1.8,0,0,91"},
        {"map_frame": "odom"},
        {"pose_frame": "base"},
        {"lidar_frame": "lidar"},
        {"max_gap_s": 2.0},
        {"max_speed_mps": 90.0},
    ]
    states = {Reading(str(log), LogOptions(**other)).state for other in ({}, *others)}
    assert len(states) == 1 + len(others)
