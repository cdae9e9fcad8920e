"""A run directory in Python: one table of its places, and a picture."""

import json
import shutil
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import yaml
from hand_made_run import LABELS, PLACES, places, write_run
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

import tilestream as ts
from tilestream.apps import runs
from tilestream.apps.runs import places_of, with_labels
from tilestream.errors import DamagedError, IncompleteError, SourceNotFoundError, UsageError
from tilestream.files import Files
from tilestream.marks import sealed
from tilestream.model.join import ON_PATH
from tilestream.pipeline.jobs.run_book import checksums
from tilestream.report.colours import FIXED


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def without_geopandas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "find_spec", lambda _: None)


@pytest.mark.usefixtures("without_geopandas")
def test_a_row_has_place_label_estimate_and_factors(folder: Path) -> None:
    table = ts.read_run(folder)
    assert type(table) is pd.DataFrame
    assert len(table) == PLACES
    assert list(table.columns[:3]) == ["route_id", "sample", "arc_length"]
    assert table["estimate"].tolist()[:-1] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert table["r_average"].tolist() == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    measured = table[table["measured"].notna()]
    assert measured["sample"].tolist() == list(LABELS)
    assert measured["measured"].tolist() == [0.3, 0.7]
    assert measured["measured_p_fail"].tolist() == [0.25, 0.25]
    assert measured["measured_distance"].tolist() == pytest.approx([0.2, 0.2])
    assert set(measured["drive"]) == {"day"}
    last = table.iloc[-1]
    assert (last["status"], last["reason"]) == ("missing", "no map around")
    assert np.isnan(last["estimate"])


@pytest.mark.usefixtures("without_geopandas")
def test_a_drive_without_routes_has_rows_of_its_own(folder: Path, tmp_path: Path) -> None:
    """As `localize` leaves them: `errors/` below the folder."""
    shutil.copytree(folder / "tables" / "errors" / "day", tmp_path / "errors")
    table = ts.read_run(tmp_path)
    assert table["measured"].tolist() == [0.3, 0.7]
    assert table["x"].tolist() == pytest.approx([5.2, 8.2])
    assert table["status"].tolist() == ["done", "done"]


@pytest.mark.usefixtures("without_geopandas")
def test_what_a_lesser_lidar_measured_does_not_stand_beside_estimates(
    folder: Path, tmp_path: Path
) -> None:
    """The labels of `day` are of a drive that is read as 8 beams; the job estimates for 16."""
    shutil.copytree(folder, tmp_path / "run")
    job = {"out": str(tmp_path / "run"), "map": {"store": str(tmp_path / "run" / "map.zarr")}}
    drive = {"log": "drive.mcap", "name": "day"}
    for more, known in (({}, len(LABELS)), ({"beams": 8}, 0)):
        told = yaml.safe_dump({**job, "drives": [{**drive, **more}]})
        (tmp_path / "run" / "config.yaml").write_text(told)
        table = ts.read_run(tmp_path / "run")
        assert len(table) == PLACES
        measured = table["measured"].notna().sum() if "measured" in table else 0
        assert measured == known
    (tmp_path / "run" / "config.yaml").write_text("out: [")
    with pytest.raises(UsageError, match=r"config.yaml"):
        ts.read_run(tmp_path / "run")


def test_where_geopandas_is_the_places_are_points_in_the_maps_crs(folder: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    table = ts.read_run(folder)
    assert isinstance(table, geopandas.GeoDataFrame)
    assert table.geometry.x.tolist() == table["x"].tolist()
    assert table.geometry.z.tolist() == table["z"].tolist()
    assert table.crs is None  # of a map without one


def test_places_of_a_report_that_are_not_as_they_were_written_are_refused(
    folder: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    whole = pd.concat([places(), pd.DataFrame({"estimate": [0.1] * PLACES})], axis=1)
    (run / "report").mkdir()
    whole.to_parquet(run / "report" / "places.parquet")
    facts = {"state": "done", "files": checksums(Files.at(run))}
    (run / "run.json").write_text(json.dumps(sealed(facts)))
    assert places_of(run)["estimate"].tolist() == [0.1] * PLACES
    whole.assign(estimate=0.0).to_parquet(run / "report" / "places.parquet")
    with pytest.raises(DamagedError, match="checksum does not fit"):
        places_of(run)


def test_what_is_no_run_or_not_whole_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match="no tables of a run"):
        ts.read_run(tmp_path)
    with pytest.raises(SourceNotFoundError):
        ts.open_run(tmp_path / "none")
    shutil.copytree(folder, tmp_path / "run")
    (tmp_path / "run" / "tables" / "predictions" / "0_0.parquet").unlink()
    with pytest.raises(IncompleteError):
        ts.read_run(tmp_path / "run")


@given(
    st.lists(st.tuples(*[st.integers(0, 30)] * 2), min_size=1, max_size=8, unique=True),
    st.lists(st.tuples(*[st.integers(0, 30)] * 2), min_size=1, max_size=8, unique=True),
)
def test_a_label_stands_at_its_nearest_place_or_for_itself(
    places: list[tuple[int, int]], labels: list[tuple[int, int]]
) -> None:
    frame = pd.DataFrame(places, columns=["x", "y"]).assign(
        z=0.0, heading=0.0, route_id="r", estimate=1.0
    )
    told = pd.DataFrame(labels, columns=["x", "y"]).assign(z=0.0, heading=0.0, drive="d")
    told["error_mean"] = np.arange(len(told)) + 0.5
    table = with_labels(frame, told)
    here, rest = table.iloc[: len(frame)], table.iloc[len(frame) :]
    assert here["x"].tolist() == [x for x, _ in places]
    distance = np.hypot(*(np.array(labels)[:, None] - np.array(places)[None]).transpose(2, 0, 1))
    far = distance.min(axis=1) > ON_PATH
    assert rest["measured"].tolist() == told["error_mean"][far].tolist()
    assert set(rest["route_id"]) <= {"d"}
    for place, row in enumerate(here.itertuples()):
        mine = [k for k in np.flatnonzero(~far) if distance[k, place] <= distance[k].min()]
        if np.isfinite(row.measured):
            k = int(row.measured - 0.5)
            assert k in mine
            assert row.measured_distance == pytest.approx(distance[k, place])
        else:  # each of those would do was nearer to none, or stands at an equally near one
            assert all((distance[k] == distance[k].min()).sum() > 1 for k in mine)


def test_a_street_is_coloured_by_error(folder: Path) -> None:
    ax = ts.open_run(folder).plot(ax=Figure().add_subplot())
    small, large, neither = ax.collections
    assert small.get_offsets()[:, 0].tolist() == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert large.get_offsets()[:, 0].tolist() == [5.0, 8.0]
    assert neither.get_offsets()[:, 0].tolist() == [9.0]
    colours = [mpl.colors.to_hex(one) for one in small.get_facecolors()]
    table = ts.read_run(folder).set_index("x")
    assert colours == FIXED.shades(np.sort(table.loc[4.0:8.0, "estimate"].to_numpy()))
    measured = np.sort(table["measured"].dropna().to_numpy())
    assert [mpl.colors.to_hex(c) for c in large.get_facecolors()] == FIXED.shades(measured)
    assert ax.figure.axes[1].get_ylabel() == "localization error [cm]"


def test_a_factor_may_colour_it(folder: Path) -> None:
    run = ts.open_run(folder)
    ax = run.plot("r_average", ax=Figure().add_subplot())
    assert len(ax.collections[0].get_offsets()) == PLACES
    with pytest.raises(UsageError, match="reason"):
        run.plot("reason", ax=Figure().add_subplot())


def test_a_run_shows_itself(folder: Path) -> None:
    run = ts.open_run(folder)
    page = run._repr_html_()
    assert "main street" in page
    assert "2 places, 0.300 to 0.700 m" in page
    assert run.report == {}
    assert run.store.url.endswith("map.zarr")
    assert "geopandas" not in sys.modules or len(run.table) == PLACES
