"""What a map shows of its survey: by hand, a pole seen from one side, a street driven once."""

import math
from pathlib import Path

import numpy as np
import pytest
from scenes import PLACES, pole

import tilestream as ts
from tilestream.factors.observability import observability
from tilestream.factors.seen_from import survey_factors
from tilestream.formats.points.pcd import write_pcd
from tilestream.records import Cells
from tilestream.settings import VirtualSettings

SEEING = VirtualSettings(starts=8, draws=2, worlds=1)
SENSOR = ts.VLP16.model_copy(update={"name": "short", "range_max": 15.0, "azimuth_step_deg": 3.0})


def test_density_weighs_returns_and_thickness_cells() -> None:
    index = np.array([[k, 0, 0] for k in range(5)])
    count = np.array([10, 20, 30, 40, 1000])
    deviation = np.array([0.02, 0.05, 0.03, 0.04, 0.001])
    covariance = np.array([np.diag([0.3, 0.2, s**2]) for s in deviation])
    cells = Cells(index, count, 2.0 * index + 1.0, covariance)
    in_cells = np.array([0, 0, 0, 1, 2, 3])  # none in the last, and one point in no cell
    points = np.vstack([2.0 * index[in_cells] + 0.5, [[1.0, 1.0, 90.0]]])
    found = survey_factors(cells, points, np.eye(4))
    assert found["ob_density"] == pytest.approx((3 * 10 + 20 + 30 + 40) / 6)
    assert found["ob_thickness"] == pytest.approx(0.03)
    nowhere = survey_factors(cells, points[-1:], np.eye(4))
    assert nowhere["ob_density"] == 0.0
    assert math.isnan(nowhere["ob_thickness"])


def test_a_pole_seen_from_one_side_is_sparser_and_thinner() -> None:
    """Across a half shell of radius r the deviation is r sqrt(1/2 - 4/pi^2), across a whole one
    r sqrt(1/2).
    """
    radius = 0.3
    whole = pole(np.random.default_rng(0), 1.0, 1.0, 2.0, 0.02, radius)
    whole = whole[(whole[:, 2] > 0.0) & (whole[:, 2] < 2.0)]
    half = whole[whole[:, 1] < 1.0]
    found = {
        name: survey_factors(ts.cells_of(points, 2.0), whole[::50], np.eye(4))
        for name, points in (("whole", whole), ("half", half))
    }
    assert found["half"]["ob_density"] == len(half)
    assert found["whole"]["ob_density"] == len(whole)
    assert found["half"]["ob_thickness"] == pytest.approx(
        radius * math.sqrt(0.5 - 4.0 / math.pi**2), rel=0.05
    )
    assert found["whole"]["ob_thickness"] == pytest.approx(radius * math.sqrt(0.5), rel=0.05)


def test_a_street_surveyed_once_shows_it(tmp_path: Path) -> None:
    """One pass against two that are 8 cm apart."""
    once, again = (PLACES["canyon"](np.random.default_rng(k), 40.0, 0.25) for k in (3, 4))
    passes = {"once": once, "twice": np.vstack([once, np.add(again, (0.0, 0.08, 0.02))])}
    found = {}
    for name, points in passes.items():
        path = tmp_path / f"{name}.pcd"
        write_pcd(path, points)
        store = ts.ingest(path, tmp_path / f"{name}.zarr", map_leaf=0.05)
        table = observability(store, [(20.0, 0.5, 2.0)], [0.0], SENSOR, SEEING)
        assert table["status"].tolist() == ["done"], table["reason"][0]
        found[name] = table.iloc[0]
    assert found["once"]["ob_density"] < 0.7 * found["twice"]["ob_density"]
    assert found["once"]["ob_thickness"] < found["twice"]["ob_thickness"]
