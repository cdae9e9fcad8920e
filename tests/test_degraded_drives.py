"""A drive that is read as a lesser lidar is observed through that lidar, the estimate is not."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streets import job, street, write_drive

import tilestream as ts
from tilestream.apps.scene import route_of
from tilestream.errors import UsageError
from tilestream.factors.along_route import AVERAGED, WIDTH, averaged_along
from tilestream.formats.points.pcd import write_pcd
from tilestream.model import dataset as dataset_module
from tilestream.model.dataset import Dataset
from tilestream.model.file import load_model
from tilestream.pipeline.jobs import estimator as estimator_module
from tilestream.pipeline.jobs import run_settings as run_settings_module
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run import dataset_of
from tilestream.pipeline.jobs.run_findings import labels_of
from tilestream.pipeline.jobs.run_inputs import (
    check_lidars,
    degraded_drives,
    inputs_of,
    observing_of,
)
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


def test_a_drive_of_a_lesser_lidar_trains_nothing(
    run: RunSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Model and estimates are those of the job without it; its labels stand alone."""
    few = 5
    for module in (dataset_module, estimator_module, run_settings_module):
        monkeypatch.setattr(module, "POINTS_MIN", few)
    learning = {"map": {"store": run.store_url}, "model": {"recipe": "physics"}}
    values = run.model_dump() | learning
    found = {}
    for name, drives in (("both", run.drives), ("whole", run.drives[:1])):
        ts.run(RunSettings(**values | {"out": str(tmp_path / name), "drives": drives}))
        model = load_model(str(tmp_path / name / "model.skops"))
        places = pd.read_parquet(tmp_path / name / "report" / "places.parquet")
        found[name] = (model.facts["groups"], model.facts["learnt"], places["estimate"].to_numpy())
    assert found["both"][:2] == found["whole"][:2]
    assert found["both"][0] == ["whole"]
    np.testing.assert_array_equal(found["both"][2], found["whole"][2])
    assert set(ts.read_run(tmp_path / "both")["drive"].dropna()) == {"whole"}
    seen = [route_of(tmp_path / name)[1:3] for name in ("both", "whole")]
    for of_both, of_whole in zip(*seen, strict=True):
        np.testing.assert_array_equal(of_both, of_whole)


def test_what_is_held_out_stays_with_its_label() -> None:
    """Rows of a model that leaves paths out count the labels that it knows."""
    groups = ["a", "b", "a", "b", "a"]
    rows = pd.DataFrame({"group": groups, "error_mean": np.arange(5.0)})
    dataset = Dataset(rows, (), pd.DataFrame({"group": []}))
    points = pd.DataFrame({"row": [2, 0], "estimate": [4.0, 0.0], "low": 0.0, "high": 9.0})
    found = labels_of(dataset, pd.DataFrame(), points, 1.0, ["b"])
    np.testing.assert_array_equal(found["held_out"], [0.0, np.nan, np.nan, np.nan, 4.0])


def test_drives_of_different_lidars_train_no_one_model(run: RunSettings) -> None:
    """Told before anything is made, where none of them is the vehicle's by its virtual drive."""
    blind = {"observe": None, "model": {"recipe": "paper"}}
    settings = RunSettings(**run.model_dump() | blind)
    with pytest.raises(UsageError, match=r"whole .as recorded., short .9m."):
        forecast(settings)
    check_lidars(RunSettings(**run.model_dump() | blind | {"drives": run.drives[1:]}))
    check_lidars(run)


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
