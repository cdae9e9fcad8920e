"""Settings and sensors: every wrong key or value is named, none is swallowed."""

import pytest

import tilestream as ts
from tilestream.config import Settings
from tilestream.errors import TilestreamError, UsageError
from tilestream.settings import IngestSettings, RegistrationSettings


class Job(Settings):
    """Settings within settings, as a job's configuration has them."""

    ingest: IngestSettings = IngestSettings()
    name: str = "job"


def test_a_misspelt_key_is_named_with_the_nearest_right_one() -> None:
    with pytest.raises(UsageError, match=r"tile_sise is no setting: did you mean tile_size\?"):
        IngestSettings(tile_sise=10.0)
    with pytest.raises(UsageError, match="tile_size, halo, map_leaf, crs"):
        IngestSettings(colour="red")


def test_a_misspelt_key_is_refused_at_every_level() -> None:
    assert Job(ingest={"halo": 4.0}).ingest.halo == 4.0
    with pytest.raises(UsageError, match="did you mean halo"):
        Job(ingest={"hallo": 4.0})


@pytest.mark.parametrize("value", ["wide", None, float("nan"), float("inf")])
def test_a_value_that_cannot_be_is_named(value: object) -> None:
    with pytest.raises(UsageError, match="IngestSettings: tile_size is"):
        IngestSettings(tile_size=value)


def test_settings_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        IngestSettings().tile_size = 3.0


def test_the_production_matcher_is_a_preset_that_can_be_varied() -> None:
    preset = RegistrationSettings.autoware(iterations_max=25)
    assert (preset.neighbours, preset.solver, preset.iterations_max) == ("radius", "raw", 25)
    with pytest.raises(UsageError, match="outlier_ratio"):
        RegistrationSettings.autoware(outlier_ratio=2.0)


def test_the_papers_sensor_is_as_its_data_sheet_says() -> None:
    assert ts.VLP16.range_max == 100.0
    assert ts.VLP16.elevations_deg == tuple(float(e) for e in range(-15, 16, 2))
    assert ts.VLP16.fov_deg == (-15.0, 15.0)
    assert round(360.0 / ts.VLP16.azimuth_step_deg) == 904
    assert len(ts.HDL64.elevations_deg) == 64
    assert len(ts.OS1_128.elevations_deg) == 128


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov_deg": (5.0, -5.0)}, "lowest < highest"),
        ({"elevations_deg": (3.0, 1.0)}, "must rise"),
        ({"elevations_deg": (-95.0, 1.0)}, "within"),
        ({"range_max": 0.0}, "range_max is 0.0"),
        ({"beams": 16}, "beams is no setting"),
    ],
)
def test_an_impossible_sensor_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(TilestreamError, match=message):
        ts.Sensor(**{**ts.VLP16.model_dump(), **change})
