"""What the page says of a filter's registration at a place."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from chromium import calm, chromium_page, opened
from hypothesis import given
from hypothesis import strategies as st
from report_findings import places_of

from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.report import Findings, write_report
from tilestream.report.covariance import ellipses, registrations_told

COLUMNS = [column.name for column in COVARIANCE_COLUMNS]


def places(along: float, both: float, across: float) -> pd.DataFrame:
    """Two places of a street, of which the second is not known."""
    known = dict.fromkeys(COLUMNS, 0.0) | {"p_lost": 0.083}
    known |= {"cov_along_along": along, "cov_along_across": both, "cov_across_across": across}
    known |= {"nvtl": 3.1, "nvtl_low": 2.6, "nvtl_high": 3.6, "tp": 5.0, "tp_low": 4.0}
    table = pd.DataFrame([known | {"tp_high": 6.0}, dict.fromkeys(COLUMNS, math.nan)])
    return pd.concat([places_of({"I": 2}), table], axis=1)


@given(st.floats(0.01, 3.0), st.floats(0.001, 3.0), st.floats(-1.5, 1.5))
def test_an_ellipse_is_that_of_the_covariance(longer: float, shorter: float, turn: float) -> None:
    longer, shorter = max(longer, 1.01 * shorter), min(longer, shorter)
    ahead, left = (
        np.array([math.cos(turn), math.sin(turn)]),
        np.array([-math.sin(turn), math.cos(turn)]),
    )
    matrix = longer**2 * np.outer(ahead, ahead) + shorter**2 * np.outer(left, left)
    axes, angle = ellipses(places(matrix[0, 0], matrix[0, 1], matrix[1, 1]))
    assert axes[0] == pytest.approx(2.4477 * np.array([longer, shorter]), rel=1e-3, abs=1e-6)
    assert angle[0] == pytest.approx(turn, abs=1e-6)
    assert np.isnan(axes[1]).all()


def test_the_ellipse_holds_95_percent() -> None:
    matrix = np.array([[0.04, 0.01], [0.01, 0.01]])
    (axes, _), (angle, _) = ellipses(places(0.04, 0.01, 0.01))
    drawn = np.random.default_rng(0).multivariate_normal([0.0, 0.0], matrix, 100_000)
    ahead = np.array([math.cos(angle), math.sin(angle)])
    turned = np.column_stack([drawn @ ahead, drawn @ [-ahead[1], ahead[0]]])
    assert (((turned / axes) ** 2).sum(axis=1) <= 1.0).mean() == pytest.approx(0.95, abs=0.003)


def test_it_is_told_in_words_and_not_where_it_is_not_known() -> None:
    told = registrations_told(places(0.01, 0.0, 0.0001))
    assert told["ellipse"] == ["semi-axes 24.5 × 2.4 cm, the longer ahead", ""]
    assert told["lost"] == ["8.3\u00a0%", ""]
    assert told["nvtl"] == ["3.10, normal 2.60 to 3.60", ""]
    assert told["tp"] == ["5.00, normal 4.00 to 6.00", ""]
    assert "90° left" in registrations_told(places(0.0001, 0.0, 0.01))["ellipse"][0]
    assert "27° right" in registrations_told(places(0.02, -0.01, 0.005))["ellipse"][0]
    older = places(0.01, 0.0, 0.0001).drop(columns=COLUMNS)
    assert set(map(tuple, registrations_told(older).values())) == {("", "")}


def test_the_panel_of_a_place_shows_it(tmp_path: Path) -> None:
    findings = Findings("a street", places(0.01, 0.0, 0.0001))
    write_report(findings, tmp_path)
    panel = "document.querySelector('#place').innerText"
    note = "document.querySelector('[data-part=filter]').hidden"
    with chromium_page() as browser:
        tab = opened(browser, tmp_path / "index.html")
        for row, known in ((0, True), (1, False)):
            x, y = findings.places.loc[row, ["x", "y"]]
            tab.evaluate(f"entered.forEach((show) => show({x}, {y}))")
            said = str(tab.evaluate(panel))
            assert ("semi-axes 24.5 × 2.4 cm" in said) is known
            assert ("2.60 to 3.60" in said) is known
            assert tab.evaluate(note) is not known
        calm(tab)
