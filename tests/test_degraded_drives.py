"""A drive that is read as a lesser lidar is observed through that lidar, the estimate is not."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streets import job, street, write_drive

import tilestream as ts
from tilestream.factors.virtual_drive import AVERAGED, averaged_along
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.routes import read_routes
from tilestream.pipeline.jobs.run_findings import labels_of
from tilestream.pipeline.jobs.run_inputs import degraded_drives, inputs_of, observing_of
from tilestream.pipeline.jobs.run_plan import plan_estimate, plan_measure
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.settings import DriveSettings
from tilestream.store import open_store
from tilestream.tables import read_tables

SHORT, USUAL, OFFSET = 9.0, 14.0, 0.02
KEYS = ["route_id", "sample"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunSettings:
    """A job on one street, driven twice: as recorded, and as if the lidar saw 9 m."""
    folder = tmp_path_factory.mktemp("street")
    write_pcd(folder / "map_canyon.pcd", street("canyon", 1, 0.3))
    log = str(write_drive(folder / "canyon.mcap", "canyon"))
    settings = job(
        folder,
        folder / "run",
        spacing=3.0,
        drives=[{"log": log, "name": "whole"}, {"log": log, "name": "short", "range_max": SHORT}],
        routes=[log],
        observe={"range_max": USUAL, "starts": 8},
        model={"recipe": "physics", "offset": OFFSET},
    )
    ts.run(settings)
    return settings


def observed(run: RunSettings, range_max: float, out: Path) -> pd.DataFrame:
    """The observe table of a job whose lidar sees so far."""
    assert run.observe is not None
    return ts.observe_along(
        open_store(run.store_url),
        read_routes(run.routes[0]),
        out,
        spacing=run.spacing,
        seeing=run.observe.model_copy(update={"range_max": range_max}),
        registration=run.label.registration,
    )


def tables(folder: Path) -> pd.DataFrame:
    return read_tables([str(path) for path in sorted(folder.glob("*.parquet"))])


def test_a_degraded_drive_is_observed_as_a_job_of_that_lidar_would_be(
    run: RunSettings, tmp_path: Path
) -> None:
    of_drive = tables(Path(run.out) / "tables" / "drives" / "9m" / "observability")
    alone = observed(run, SHORT, tmp_path)
    assert len(of_drive) == len(alone) > 5
    order = {"by": KEYS, "ignore_index": True}
    pd.testing.assert_frame_equal(
        of_drive.sort_values(**order), alone.sort_values(**order), check_exact=True
    )
    usual = tables(Path(run.out) / "tables" / "observability").sort_values(**order)
    pd.testing.assert_frame_equal(
        usual, observed(run, USUAL, tmp_path / "usual").sort_values(**order), check_exact=True
    )
    assert (usual["ob_returns"] > alone.sort_values(**order)["ob_returns"]).all()


def test_its_labels_are_joined_with_that_and_the_estimate_is_of_the_vehicle(
    run: RunSettings,
) -> None:
    rows = ts.dataset(run.folder).rows
    of_drive = tables(Path(run.out) / "tables" / "drives" / "9m" / "observability")
    usual = tables(Path(run.out) / "tables" / "observability")
    names = list(AVERAGED)
    for group, table in (("short", of_drive), ("whole", usual)):
        mine = rows[rows["group"] == group]
        seen = averaged_along(table).rename(columns={"route_id": "path"})
        joined = mine[["path", "arc_length"]].merge(seen, on=["path", "arc_length"])
        assert len(joined) == len(mine) > 5
        np.testing.assert_array_equal(joined[names], mine[names])
    places = pd.read_parquet(Path(run.out) / "report" / "places.parquet").set_index(KEYS)
    vehicle = averaged_along(usual).set_index(KEYS)["vd_mean"] + OFFSET
    np.testing.assert_array_equal(places["estimate"], vehicle[places.index])
    report = json.loads((Path(run.out) / "report" / "report.json").read_text())
    assert any("read as: short;" in note for note in report["facts"]["notes"])


@pytest.mark.parametrize("offset", [OFFSET, None])
def test_no_estimate_of_the_vehicle_stands_beside_its_labels(
    run: RunSettings, offset: float | None
) -> None:
    places = pd.read_parquet(Path(run.out) / "report" / "places.parquet")
    found = labels_of(ts.dataset(run.folder), places, None, ["short"], offset).set_index("group")
    short, whole = found.loc["short"], found.loc["whole"]
    if offset is None:  # a model that was trained elsewhere, for the vehicle
        assert short["held_out"].isna().all()
    else:
        np.testing.assert_array_equal(short["held_out"], short["vd_mean"] + OFFSET)
    np.testing.assert_array_equal(whole["held_out"], whole["vd_mean"] + OFFSET)


def test_a_job_without_degraded_drives_stays_as_it_is(run: RunSettings) -> None:
    plain = run.model_copy(update={"drives": run.drives[:1]})
    grid, identities = open_store(run.store_url), []
    for settings in (run, plain):
        map_plan = MapPlan.of_store(grid)
        measure = plan_measure(settings, inputs_of(settings, None, None), map_plan)
        identities.append({t.key: t.identity for t in measure.tasks})
    assert identities[1].items() <= identities[0].items()
    assert not [key for key in identities[1] if key.startswith("observe_drive")]
    joined = plan_estimate(plain, grid.grid, measure, []).outputs("samples")
    assert not any("own_of" in task.takes for task in joined)


def test_what_a_lidar_cannot_lose_changes_nothing(run: RunSettings) -> None:
    assert run.observe is not None
    for more in ({"beams": 16}, {"beams": 64}, {"range_max": USUAL}, {"blind_rear_deg": 0.0}, {}):
        drive = DriveSettings(log="a.mcap", **more)
        assert degraded_drives(run, [drive]) == {}
    drive = DriveSettings(log="a.mcap", beams=4, blind_rear_deg=120.0)
    (observing,) = degraded_drives(run, [drive]).values()
    assert observing.sensor.elevations_deg == (-11.0, -3.0, 5.0, 13.0)
    assert observing.seeing.blind_rear_deg == 120.0
    assert observing.range_max == USUAL
    assert observing_of(run, run.observe).sensor == ts.VLP16
