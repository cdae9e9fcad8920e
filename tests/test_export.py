"""Covariances of a run in Python and as files: equal to the tables, and readable by who they are
for.
"""

import errno
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from hand_made_run import put
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from test_matcher_file import NESTED

import tilestream as ts
from tilestream.apps.export.covariance_files import Format
from tilestream.apps.export.poor_stretches import BESIDE, area, areas, poor_stretches
from tilestream.autoware_matcher import MATCHER, read_matcher
from tilestream.cli import run as command
from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.factors import observability
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS
from tilestream.files import Files
from tilestream.model.correlation import POOLED
from tilestream.model.covariance import COVARIANCE_COLUMNS, as_it_is, calibration_told
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.moments import AXES, PAIRS

PLACES = 80
CIRCLE = 40.0
"""Radius of the bend that is the route [m]."""


def places() -> pd.DataFrame:
    """Two routes a metre apart from place to place: a bend to the left, and its way back."""
    arc = np.arange(float(PLACES))
    turned = arc / CIRCLE
    at = {"arc_length": arc, "sample": np.arange(PLACES), "z": 2.0, "above_ground": 0.0}
    x, y = CIRCLE * np.sin(turned), CIRCLE * (1.0 - np.cos(turned))
    there = pd.DataFrame({"route_id": "=way", **at, "heading": turned, "x": x, "y": y})
    back = {"heading": turned[::-1] - np.pi, "x": x[::-1], "y": y[::-1] + 4.0}
    return pd.concat([there, there.assign(route_id="back", **back)], ignore_index=True)


def covariance_tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    """Estimates and virtual drives of the places, made up; the last place of each has none."""
    rng, at = np.random.default_rng(2), places()
    count = len(at)
    root = 0.03 * rng.normal(size=(count, 6, 6)) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
    matrix = np.einsum("nki,nkj->nij", root, root)
    numbers = [c.name for c in PREDICTION_COLUMNS if c.dtype == "float64"]
    said = at.assign(**dict.fromkeys(numbers, 0.05), in_domain=True, status="done", reason="")
    said.loc[20:24, "estimate"] = 0.4
    for a, b in PAIRS:
        said[f"cov_{a}_{b}"] = matrix[:, AXES.index(a), AXES.index(b)]
    for axis in AXES:
        said[f"bias_{axis}"] = rng.normal(0.0, 0.01, count)
    said["p_lost"] = rng.uniform(0.0, 0.04, count)
    said.loc[100, "p_lost"] = 0.2
    for name, mean in (("nvtl", 3.0), ("tp", 5.0)):
        said[name] = mean + rng.normal(0.0, 0.1, count)
        said[f"{name}_low"], said[f"{name}_high"] = said[name] - 0.5, said[name] + 0.5
    last = at["sample"] == PLACES - 1
    said.loc[last, [column.name for column in COVARIANCE_COLUMNS]] = np.nan
    seen = pd.DataFrame(0.0, at.index, [column.name for column in observability.COLUMNS])
    seen = pd.concat([at, seen], axis=1).assign(status="done", reason="", vd_draws=5.0)
    for axis in AXES:
        bias = 0.05 + np.convolve(rng.normal(0.0, 0.05, count), np.ones(5) / math.sqrt(5.0), "same")
        seen[f"vd_near_{axis}"], seen[f"vd_near_{axis}_{axis}"] = bias, bias**2 + 0.01**2
    return said, seen


def write_covariances(folder: Path) -> Path:
    """A run directory whose tables have covariances."""
    said, seen = covariance_tables()
    columns = (*PLACE_COLUMNS, *PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)
    put(folder / "tables" / "predictions" / "0_0.parquet", said, columns)
    columns = (*PLACE_COLUMNS, *observability.COLUMNS, *STATUS_COLUMNS)
    put(folder / "tables" / "observability" / "0_0.parquet", seen, columns)
    (folder / "config.yaml").write_text("prediction_error: 0.3\n")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_covariances(tmp_path_factory.mktemp("covariances"))


def exported(run: Path, out: Path, **how: Any) -> Any:
    """What is in a file."""
    told = ts.export("covariance", run, out, **how)
    assert told["file"] == str(out)
    return told, table_in(out) if how.get("format", "csv") == "csv" else out.read_text()


def table_in(file: Path) -> pd.DataFrame:
    """A CSV, its numbers to the bit, which not every pandas reads them to."""
    texts = pd.read_csv(file, dtype=str, keep_default_na=False)
    numbers = [name for name in texts if name != "route"]
    return texts.assign(**{str(n): texts[n].map(lambda x: float(x or "nan")) for n in numbers})


# --- In Python


def test_covariances_are_those_of_the_tables_in_both_frames(run: Path) -> None:
    found = ts.covariances(run)
    said, _ = covariance_tables()
    said = said.sort_values(["route_id", "sample"], ignore_index=True)
    assert found.prediction_error == 0.3
    pd.testing.assert_frame_equal(found.places[["route_id", "x"]], said[["route_id", "x"]])
    a, b = AXES.index("across"), AXES.index("yaw_vector")
    expected = said["cov_across_yaw_vector"].to_numpy()
    for matrix in (found.route[:, a, b], found.route[:, b, a]):
        np.testing.assert_array_equal(matrix, expected)
    # a displacement along the heading is the same displacement in the map
    heading = said["heading"].to_numpy()
    ahead = np.zeros((len(said), 6))
    ahead[:, 0], ahead[:, 1] = np.cos(heading), np.sin(heading)
    along = np.einsum("ni,nij,nj->n", ahead, found.in_map, ahead)
    np.testing.assert_allclose(along, said["cov_along_along"], rtol=1e-9)
    yaw = said["cov_yaw_vector_yaw_vector"]
    np.testing.assert_allclose(found.in_map[:, 5, 5], yaw, rtol=1e-9)
    ahead_of_it = np.einsum("ni,ni->n", ahead, found.bias_in_map)
    np.testing.assert_allclose(ahead_of_it, said["bias_along"], atol=1e-15)
    np.testing.assert_array_equal(found.bias[:, 5], found.bias_in_map[:, 5])
    assert set(found.correlations) == {*AXES, POOLED}


def test_a_run_without_covariances_is_refused_with_what_to_do(run: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match="no tables"):
        ts.covariances(tmp_path)
    old = tmp_path / "old"
    said, seen = covariance_tables()
    names = [column.name for column in COVARIANCE_COLUMNS]
    columns = (*PLACE_COLUMNS, *PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)
    put(old / "tables" / "predictions" / "0_0.parquet", said.drop(columns=names), columns)
    (old / "config.yaml").write_text("prediction_error: 0.3\n")
    with pytest.raises(UsageError, match="again"):
        ts.covariances(old)
    put(old / "tables" / "predictions" / "0_0.parquet", said, columns)
    assert len(ts.covariances(old).places) == len(said)
    (old / "config.yaml").write_text("spacing: 1.0\n")
    with pytest.raises(UsageError, match="again"):
        ts.covariances(old)
    (old / "config.yaml").write_text("prediction_error: 0.3\n")
    put(
        old / "tables" / "predictions" / "0_0.parquet", said.assign(cov_along_along=np.nan), columns
    )
    with pytest.raises(UsageError, match="virtual drives"):
        ts.covariances(old)
    columns = (*PLACE_COLUMNS, *observability.COLUMNS, *STATUS_COLUMNS)
    put(tmp_path / "seen" / "observability" / "0_0.parquet", seen, columns)
    with pytest.raises(UsageError, match="no estimates"):
        ts.covariances(tmp_path / "seen")


# --- CSV and JSON


def test_a_row_of_the_table_is_a_place_in_the_order_of_ros(run: Path, tmp_path: Path) -> None:
    told, table = exported(run, tmp_path / "a.csv")
    found = ts.covariances(run)
    assert len(table) == len(found.places) == told["places"] + told["without"]
    assert told["without"] == 2
    first = table.columns.get_loc("map_cov_x_x_m2")
    named = ["map_cov_x_roll_m_rad", "map_cov_yaw_yaw_rad2"]
    assert [table.columns.get_loc(name) - first for name in named] == [3, 35]
    flat = table.iloc[:, first : first + 36].to_numpy()
    np.testing.assert_array_equal(flat.reshape(-1, 6, 6), found.in_map)  # to the bit
    expected = table.loc[:, "map_bias_x_m":"map_bias_yaw_rad"].to_numpy()
    np.testing.assert_array_equal(expected, found.bias_in_map)
    assert table["map_x_m"].tolist() == found.places["x"].tolist()
    assert "'=way" in set(table["route"])  # no formula for a spreadsheet
    again = exported(run, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert told | {"file": ""} == again[0] | {"file": ""}


def test_json_has_all_with_meanings(run: Path, tmp_path: Path) -> None:
    told, text = exported(run, tmp_path / "a.json", format="json")
    found, content = ts.covariances(run), json.loads(text)
    assert told.items() - {("file", told["file"]), ("format", "json")} <= content.items()
    row, last = content["sample_points"][5], content["sample_points"][PLACES - 1]
    assert row["covariance_map"] == found.in_map[5].ravel().tolist()
    assert row["covariance_route"] == found.route[5].ravel().tolist()
    assert row["bias_map"] == found.bias_in_map[5].tolist()
    assert last["covariance_map"] == [None] * 36
    assert set(content["correlation"]) == {*AXES, POOLED}
    assert content["correlation"][POOLED]["inflation"] == content["inflation"]
    areas = content["areas"]
    worst = [feature["properties"]["estimate_max_m"] for feature in areas["features"]]
    assert (worst, told["poor_stretches"]) == ([0.4, 0.05], 2)
    assert "map frame" in areas["coordinates"]
    for feature in areas["features"]:
        (ring,) = feature["geometry"]["coordinates"]
        assert np.array(ring) == pytest.approx(np.array(feature["properties"]["ring"]), abs=1e-3)


def test_one_route_alone_and_other_thresholds(run: Path, tmp_path: Path) -> None:
    told, table = exported(run, tmp_path / "a.csv", route="back", threshold=0.01)
    assert set(table["route"]) == {"back"}
    assert (told["routes"], told["poor_stretches"]) == (1, 1)
    assert told["poor_length_m"] == pytest.approx(PLACES - 1.0)
    assert exported(run, tmp_path / "a.csv", lost=0.5)[0]["poor_stretches"] == 1
    with pytest.raises(UsageError, match=r"north.*=way, back|north.*back, =way"):
        ts.export("covariance", run, tmp_path / "no.csv", route="north")
    assert not (tmp_path / "no.csv").exists()


def test_inflation_is_said_and_applied_only_when_asked_for(run: Path, tmp_path: Path) -> None:
    plain, table = exported(run, tmp_path / "a.csv")
    times, larger = exported(run, tmp_path / "b.csv", inflate=True)
    assert plain["inflation"] == times["inflation"] > 1.5
    assert (plain["inflated"], times["inflated"]) == (False, True)
    name = "map_cov_y_y_m2"
    ratio = (larger[name] / table[name]).dropna()
    assert ratio.to_numpy() == pytest.approx(plain["inflation"])
    assert larger["p_lost"].equals(table["p_lost"])
    assert times["along_m"] == pytest.approx(plain["along_m"] * math.sqrt(plain["inflation"]))
    assert 1.0 <= plain["inflation_low"] <= plain["inflation"] <= plain["inflation_high"]
    rarer, _ = exported(run, tmp_path / "c.csv", every=3.0)
    assert 1.0 <= rarer["inflation"] < plain["inflation"]


# --- Autoware


def parameters(text: str) -> dict[str, Any]:
    """By whole names, as ROS reads a file: every value a number, or a list of doubles."""
    (node,) = yaml.safe_load(text).items()
    assert node[0] == "/**"
    (key, groups), found = next(iter(node[1].items())), {}
    assert key == "ros__parameters"
    for group, members in groups.items():
        for name, value in members.items():
            assert isinstance(value, int | float | list), name
            if isinstance(value, list):
                assert {type(number) for number in value} == {float}, name
            found[f"{group}.{name}"] = value
    return found


def test_autowares_file_is_of_doubles_in_its_own_names(run: Path, tmp_path: Path) -> None:
    _, text = exported(run, tmp_path / "a.yaml", format="autoware")
    found, given = ts.covariances(run), parameters(text)
    known = found.places["p_lost"].notna().to_numpy()
    count = int(known.sum())
    constant = np.array(given["covariance.output_pose_covariance"]).reshape(6, 6)
    mean = found.route[known].mean(axis=0)
    np.testing.assert_allclose(constant[:3, :3], mean[:3, :3], rtol=1e-6)
    in_map = found.in_map[known].mean(axis=0)
    np.testing.assert_allclose(constant[3:, 3:], in_map[3:, 3:], rtol=1e-6)
    assert not constant[:3, 3:].any()
    assert np.linalg.eigvalsh(constant).min() > 0.0
    assert type(given["score_estimation.converged_param_type"]) is int
    group = "score_estimation.converged_param"
    nvtl, tp = (
        given[f"{group}_{name}"]
        for name in ("nearest_voxel_transformation_likelihood", "transform_probability")
    )
    assert (nvtl, tp) == (found.places["nvtl_low"].min(), found.places["tp_low"].min())
    ours = "covariance_by_place"
    assert len(given[f"{ours}.position"]) == 3 * count
    assert len(given[f"{ours}.output_pose_covariance"]) == 36 * count
    assert len(given[f"{ours}.expected_error"]) == 6 * count
    assert [len(given[f"{ours}.{n}"]) for n in ("nvtl_low", "tp_low", "p_lost")] == [count] * 3


def test_the_lookup_that_the_file_describes_finds_each_place(run: Path, tmp_path: Path) -> None:
    _, text = exported(run, tmp_path / "a.yaml", format="autoware", route="back")
    found, given = ts.covariances(run), parameters(text)
    of = {name.split(".")[1]: value for name, value in given.items() if "by_place" in name}
    position = np.array(of["position"]).reshape(-1, 3)
    back = (found.places["route_id"] == "back").to_numpy()
    for row in np.flatnonzero(back & found.places["p_lost"].notna().to_numpy())[::9]:
        p = found.places.loc[row, ["x", "y", "z"]].to_numpy(float) + np.array([0.2, 0.2, 0.1])
        away = np.linalg.norm(position - p, axis=1)
        k = int(away.argmin())
        assert away[k] < of["spacing"] == 1.0
        looked_up = np.array(of["output_pose_covariance"][36 * k : 36 * k + 36]).reshape(6, 6)
        np.testing.assert_allclose(looked_up, found.in_map[row], rtol=1e-6, atol=1e-12)


def test_a_matcher_with_these_parameters_is_still_read(run: Path, tmp_path: Path) -> None:
    """As a vehicle has them: beside the matcher's file, or merged into it."""
    (tmp_path / "matcher").mkdir()
    file = tmp_path / "matcher" / MATCHER
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": NESTED}}))
    alone = read_matcher(str(file))
    beside = tmp_path / "matcher" / "covariance.param.yaml"
    _, text = exported(run, beside, format="autoware")
    assert read_matcher(str(file.parent)).settings == alone.settings
    ours = yaml.safe_load(text)["/**"]["ros__parameters"]
    merged = NESTED | ours | {"covariance": NESTED["covariance"] | ours["covariance"]}
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": merged}}))
    assert read_matcher(str(file)).settings == alone.settings
    with pytest.raises(UsageError, match=r"ndt_scan_matcher.param.yaml"):
        read_matcher(str(beside))


# --- Areas


def inside(ring: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed ring winds round a point."""
    turned = np.unwrap(np.arctan2(*(ring - point).T[::-1]))
    return abs(turned[-1] - turned[0]) > math.pi


def crosses_itself(ring: np.ndarray) -> bool:
    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    pieces = list(itertools.pairwise(ring))
    for i, (a, b) in enumerate(pieces):
        for c, d in pieces[i + 2 :]:
            if side(a, b, c) * side(a, b, d) < -1e-9 and side(c, d, a) * side(c, d, b) < -1e-9:
                return True
    return False


@given(st.floats(0.0, 6.0), st.integers(1, 60), st.sampled_from([-1.0, 1.0]), st.floats(3.0, 100.0))
def test_an_area_is_round_its_route(first: float, count: int, way: float, radius: float) -> None:
    """Bends down to 3 m, tighter than the area is wide, up to half a turn."""
    count = min(count, int(math.pi * radius) + 1)
    heading = first + way * np.arange(count) / radius
    at = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    ring = area(at, heading)
    assert ring[0].tolist() == ring[-1].tolist()
    x, y = ring.T
    size = 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    assert size > 0.0  # counterclockwise
    assert size <= 2.0 * BESIDE * (count - 1 + 2.0 * BESIDE) * 1.07  # mitres of tight bends
    assert all(inside(ring, point) for point in at)
    assert not crosses_itself(ring)
    nearest = np.linalg.norm(ring[:, None] - at[None], axis=2).min(axis=1)
    assert (nearest > BESIDE - 1e-5).all()
    assert (nearest < math.sqrt(2.0) * BESIDE + 1e-5).all()


def test_a_straight_stretch_is_a_rectangle() -> None:
    at = np.column_stack([np.arange(11.0), np.zeros(11)])
    ring = area(at, np.zeros(11))
    assert ring.min(axis=0).tolist() == [-BESIDE, -BESIDE]
    assert ring.max(axis=0).tolist() == [10.0 + BESIDE, BESIDE]
    assert area(at[:1], np.zeros(1)).shape[0] >= 5


def test_areas_of_a_map_with_a_crs_are_in_degrees() -> None:
    said, _ = covariance_tables()
    said[["x", "y"]] += [380_000.0, 3_950_000.0]
    crs = CRS.from_epsg(32654)
    told = areas(said, poor_stretches(said, 0.25, 0.05), crs)
    assert "WGS 84" in told["coordinates"]
    back = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    for feature in told["features"]:
        (ring,) = feature["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        longitude, latitude = np.array(ring).T
        assert (np.abs(longitude - 139.7) < 0.1).all()
        metres = np.column_stack(back.transform(longitude, latitude))
        assert metres == pytest.approx(np.array(feature["properties"]["ring"]), abs=2e-3)


def test_poor_is_what_errs_or_is_lost() -> None:
    said, _ = covariance_tables()
    rows = poor_stretches(said, 0.25, 0.05)
    assert [row.tolist() for row in rows] == [list(range(20, 25)), [100]]
    assert poor_stretches(said, 1.0, 0.5) == []


@pytest.mark.parametrize("kind", ["autoware", "csv", "json"])
def test_only_an_earlier_export_is_written_over(kind: Format, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.txt"
    for _ in range(2):
        exported(run, out, format=kind)
    others = {"autoware", "csv", "json"} - {kind}
    made = out.read_bytes()
    for other in others:
        with pytest.raises(UsageError, match="is no export of this format"):
            exported(run, out, format=other)
    out.write_text("mine\n")
    with pytest.raises(UsageError, match="is no export of this format"):
        exported(run, out, format=kind)
    assert out.read_text() == "mine\n"
    out.write_bytes(b"")  # as `mktemp` makes one
    exported(run, out, format=kind)
    assert out.read_bytes() == made


# --- The command


def test_where_a_run_cannot_be_written_the_option_for_another_place_is_named(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(folder: Files) -> None:
        raise OSError(errno.EROFS, "Read-only file system", folder.root)

    monkeypatch.setattr(Files, "make", refuse)
    assert command(["export", "covariance", str(run)]) == 2
    assert "--out names another place" in capsys.readouterr().err
    assert command(["export", "covariance", str(run), "--out", str(run / "x" / "a.csv")]) == 1
    assert "--out" not in capsys.readouterr().err


def test_the_command_says_and_writes_the_same(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.csv"
    line = ["export", "covariance", str(run), "--out", str(out), "--every", "2", "--inflate"]
    assert command([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == ts.export("covariance", run, out, every=2.0, inflate=True)
    assert command(line) == 0
    said = capsys.readouterr().out
    assert str(out) in said
    assert f"{told['inflation']:.2f} times" in said
    assert command(["export", "covariance", str(run), "--format", "json"]) == 0
    made = run / "export" / "covariance.json"
    assert json.loads(made.read_text())["every_m"] == 1.0
    made.unlink()
    assert command(["export", "covariance", str(run), "--lost", "2"]) == 2
    assert "lost" in capsys.readouterr().err


def test_what_covariances_rest_on_is_told_in_every_file_that_has_words(tmp_path: Path) -> None:
    run = write_covariances(tmp_path / "run")
    report = run / "report" / "report.json"
    report.parent.mkdir()
    for words in (calibration_told(None), calibration_told(replace(as_it_is(1.5), places=1234))):
        report.write_text(json.dumps({"facts": {"model": {"covariances": words}}}))
        told, text = exported(run, tmp_path / "a.json", format="json")
        assert told["rest_on"] == words
        assert f"They are {words}." in json.loads(text)["about"]
    assert "1,234" in words
    report.unlink()
    assert "does not say" in exported(run, tmp_path / "a.csv")[0]["rest_on"]
