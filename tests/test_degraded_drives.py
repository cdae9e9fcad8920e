"""A drive that is read as a lesser lidar is observed through that lidar, the estimate is not."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streets import job, street, write_drive

import tilestream as ts
from tilestream.factors.along_route import AVERAGED, WIDTH, averaged_along
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.jobs.run import dataset_of
from tilestream.pipeline.jobs.run_findings import labels_of
from tilestream.pipeline.jobs.run_inputs import degraded_drives, inputs_of, observing_of
from tilestream.pipeline.jobs.run_plan import plan_measure
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.settings import DriveSettings
from tilestream.store import open_store
from tilestream.tables import read_tables

SHORT, USUAL, OFFSET = 9.0, 14.0, 0.02
KEYS = ["route_id", "sample"]
WHERE = ["sample", "arc_length", "heading", "x", "y", "z"]


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
        observe={"range_max": USUAL, "starts": 8, "draws": 2, "worlds": 1},
        model={"recipe": "physics", "offset": OFFSET},
    )
    ts.run(settings)
    return settings


def tables(folder: Path) -> pd.DataFrame:
    found = read_tables([str(path) for path in sorted(folder.glob("*.parquet"))])
    return found.sort_values("sample", ignore_index=True)


def own(run: RunSettings, group: str, kind: str) -> pd.DataFrame:
    return tables(Path(run.out) / "tables" / "drives" / group / kind)


@pytest.mark.parametrize(("group", "range_max"), [("short", SHORT), ("whole", USUAL)])
def test_a_drive_is_looked_from_where_its_scans_were_taken(
    run: RunSettings, group: str, range_max: float
) -> None:
    """With the lidar that it is read as; the factors are of the vehicle's."""
    labels = tables(Path(run.out) / "tables" / "errors" / group)
    observed, factors = own(run, group, "observability"), own(run, group, "factors")
    assert len(labels) > 5
    for table in (observed, factors):
        pd.testing.assert_frame_equal(table[WHERE], labels[WHERE], check_exact=True)
        assert table["above_ground"].tolist() == labels["lidar_height"].tolist()
    store, at = open_store(run.store_url), labels[["x", "y", "z"]].to_numpy()
    assert run.observe is not None
    seeing = run.observe.model_copy(update={"range_max": range_max})
    alone = ts.observability(
        store, at, labels["heading"], seeing=seeing, registration=run.label.registration
    )
    pd.testing.assert_frame_equal(observed[alone.columns], alone, check_exact=True)
    alone = ts.factors(store, at, which="all")
    pd.testing.assert_frame_equal(factors[alone.columns], alone, check_exact=True)


def test_it_sees_less(run: RunSettings) -> None:
    short, whole = (own(run, group, "observability") for group in ("short", "whole"))
    assert (whole["ob_returns"] > short["ob_returns"]).all()


def test_its_labels_are_joined_with_that_and_the_estimate_is_of_the_vehicle(
    run: RunSettings,
) -> None:
    rows = ts.dataset(run.folder)
    names = list(AVERAGED)
    for group in ("short", "whole"):
        mine = rows[rows["group"] == group].set_index("sample")
        seen = own(run, group, "observability").set_index("sample")
        assert len(mine) == len(seen) > 5
        np.testing.assert_array_equal(mine[names], seen.loc[mine.index, names])
        assert set(mine["path"]) == {"canyon"}  # the route is the way of the same log
        np.testing.assert_allclose(mine["arc_length"], seen.loc[mine.index, "arc_length"], atol=0.1)
    places = pd.read_parquet(Path(run.out) / "report" / "places.parquet").set_index(KEYS)
    usual = tables(Path(run.out) / "tables" / "observability")
    vehicle = averaged_along(usual, WIDTH).set_index(KEYS)["vd_mean"] + OFFSET
    np.testing.assert_array_equal(places["estimate"], vehicle[places.index])
    report = json.loads((Path(run.out) / "report" / "report.json").read_text())
    assert any("read as: short;" in note for note in report["notes"]["job"])


@pytest.mark.parametrize("offset", [OFFSET, None])
def test_no_estimate_of_the_vehicle_stands_beside_its_labels(
    run: RunSettings, offset: float | None
) -> None:
    places = pd.read_parquet(Path(run.out) / "report" / "places.parquet")
    dataset = dataset_of(run.folder)
    found = labels_of(dataset, places, None, run.spacing, ["short"], offset).set_index("group")
    short, whole = found.loc["short"], found.loc["whole"]
    if offset is None:  # a model that was trained elsewhere, for the vehicle
        assert short["held_out"].isna().all()
    else:
        np.testing.assert_array_equal(short["held_out"], short["vd_mean"] + OFFSET)
    by_arc = places.set_index("arc_length")["estimate"].sort_index()
    at = [int(np.abs(by_arc.index - arc).argmin()) for arc in whole["arc_length"]]
    np.testing.assert_array_equal(whole["held_out"], by_arc.iloc[at])


def test_another_drive_changes_nothing_of_the_first(run: RunSettings) -> None:
    plain = run.model_copy(update={"drives": run.drives[:1]})
    store, identities = open_store(run.store_url), []
    for settings in (run, plain):
        measure = plan_measure(settings, inputs_of(settings, None, None), MapPlan.of_store(store))
        identities.append({t.key: t.identity for t in measure.tasks})
    assert identities[1].items() <= identities[0].items()
    more = {key.split("-")[0] for key in identities[0].keys() - identities[1].keys()}
    assert more == {"factors_drive", "observe_drive", "register", "label"}


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
