"""Why an estimate is high: what raises it, and what the map is like there, in words."""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
from model_data import COLUMNS, drives, joined
from scipy.stats import spearmanr

from tilestream.model.explain import SHARES, UNITS, Typical, compared, in_words, typical_of
from tilestream.model.features import features_of
from tilestream.model.forest import Growth, TunedForest
from tilestream.model.phrases import PHRASES, REASSURING, phrase_of
from tilestream.model.prediction import predict
from tilestream.model.training import train
from tilestream.pipeline.stages.predict import physical
from tilestream.pipeline.stages.samples import COLUMNS as COLUMNS_LEARNT
from tilestream.records import Column

NAMES = [column.name for column in COLUMNS]


def usual(names: list[str], middle: list[float], rho: list[float], unit: str = "1") -> Typical:
    """What is typical, with quartiles 10 % of the median away."""
    spread = 0.1 * np.array(middle)
    units = tuple("m" if name in ("vd_mean", "vd_along") else unit for name in names)
    return Typical(tuple(names), units, np.array(middle), spread, spread, np.array(rho), 0.15)


def test_reasons_are_words_for_what_raises_the_estimate() -> None:
    names = ["feature_count", "D1_count", "normal_H_8", "new_factor"]
    typical = usual(names, [900.0, 50.0, 3.0, 2.0], [-0.4, -0.3, -0.2, 0.1])
    X = np.array([[100.0, 5.0, 1.0, 9.0]])
    (words,) = in_words(np.array([[0.05, -0.01, 0.03, 0.001]]), names, X, typical)
    assert words == (
        "few features in view (feature_count 100, typically 900); "
        "parallel walls, surfaces face few directions (normal_H_8 1, typically 3); "
        "few poles and edges in view (D1_count 5, typically 50)"
    )
    same = ["D3_count", "D3_ratio", *names[2:]]
    (together,) = in_words(
        np.array([[0.03, 0.02, 0.04, 0.0]]), same, X, replace(typical, names=tuple(same))
    )
    assert together.startswith("bare surfaces without detail (D3_count 100, typically 900); ")
    assert in_words(np.full((1, 4), -1.0), names, typical.middle[None], typical) == [""]
    assert phrase_of("new_factor", True) == "high new_factor"


def test_a_symptom_is_followed_by_causes_in_the_map() -> None:
    names = [
        "vd_mean",
        "vd_along",
        "ob_info_along",
        "ob_returns",
        "wall_H",
        "sight_HDOP",
        "D2_count",
    ]
    middle = [0.05, 0.04, 9000.0, 0.8, 4.6, 2.2, 50.0]
    typical = usual(names, middle, [0.8, 0.7, -0.4, 0.3, -0.2, 0.1, -0.3])
    X = np.array([[0.892, 0.5, 600.0, 0.81, 4.0, 3.0, 60.0]])
    added = np.array([[0.5, 0.2, 0.01, 0.02]])
    (words,) = in_words(added, names[:4], X, typical)
    # ob_returns is as usual, sight_HDOP has no clear side, D2_count lies on its good one.
    assert words == (
        "a virtual drive does not hold its place (89\u00a0cm, typically 5\u00a0cm); "
        "nothing fixes the direction of travel (ob_info_along 600, typically 9000); "
        "parallel walls, surfaces face few directions (wall_H 4, typically 4.6)"
    )
    X[0, 4:] = np.nan
    (words,) = in_words(added, names[:4], X, typical)
    assert words.count("; ") == 1
    assert words.endswith(
        "; nothing fixes the direction of travel (ob_info_along 600, typically 9000)"
    )
    reassuring = usual(["vd_mean", "ob_unmapped"], [0.05, 0.1], [0.8, -0.4])
    (words,) = in_words(
        np.array([[0.5, 0.1]]), reassuring.names, np.array([[0.8, 0.0]]), reassuring
    )
    assert words == "a virtual drive does not hold its place (80\u00a0cm, typically 5\u00a0cm)"
    well = usual(["vd_mean", "ob_info_up"], [0.05, 9000.0], [0.8, -0.4])
    (words,) = in_words(np.array([[0.1, 0.5]]), well.names, np.array([[0.06, 99e3]]), well)
    assert words == "a virtual drive does not hold its place (6\u00a0cm, typically 5\u00a0cm)"
    assert in_words(np.array([[0.1, 0.5]]), well.names, np.array([[0.04, 99e3]]), well) == [""]


@pytest.mark.parametrize(
    ("name", "unit", "value", "middle", "told"),
    [
        ("vd_mean", "m", 0.892, 0.0536, "89\u00a0cm, typically 5.4\u00a0cm"),
        ("vd_mean", "m", 1.234, 0.0, "120\u00a0cm, typically 0\u00a0cm"),
        ("r_average", "m", 43.21, 63.35, "43\u00a0m, typically 63\u00a0m"),
        ("euclidean_dist", "m", 0.7512, 0.7466, "75.1\u00a0cm, typically 74.7\u00a0cm"),
        ("vd_p_fail", "1", 0.123, 0.0221, "12\u00a0%, typically 2.2\u00a0%"),
        ("normal_H_8", "bit", 0.41, 0.83, "normal_H_8 0.41 bit, typically 0.83 bit"),
        ("feature_count", "1", 1234.0, 9871.0, "feature_count 1200, typically 9900"),
        ("ob_info_up", "1/m^2", 574.7, 14756.0, "ob_info_up 570 per m², typically 15000 per m²"),
        ("ob_weak_angle", "rad", 0.1, 0.2, "ob_weak_angle 5.7°, typically 11°"),
        ("FDOP", "lux", 0.5, 0.5, "FDOP 0.5 lux, typically 0.5 lux"),
    ],
)
def test_figures_are_told_as_a_person_reads_them(
    name: str, unit: str, value: float, middle: float, told: str
) -> None:
    assert compared(0, value, usual([name], [middle], [0.5], unit)) == told


def test_what_is_typical_has_quartiles_and_a_bad_side() -> None:
    rng = np.random.default_rng(0)
    error = rng.lognormal(size=400)
    rare = (np.arange(400) % 10 == 0).astype(float)
    X = np.column_stack(
        [np.exp(-error), error + 8.0 * rng.normal(size=400), np.full(400, 16.0), rare]
    )
    columns = [Column(name, "FS", "1", "", "") for name in "abcd"]  # type: ignore[arg-type]
    found = typical_of(X, error, columns, 400)
    weak = spearmanr(X[:, 1], error).statistic
    often = spearmanr(rare, error).statistic
    assert found.rho == pytest.approx([-1.0, weak, 0.0, often])
    assert found.clear == 0.15
    assert typical_of(X, error, columns, 25).clear == pytest.approx(0.4)
    low, middle, high = np.percentile(X[:, 0], [25, 50, 75])
    assert found.middle[0] == pytest.approx(middle)
    values = np.array([[low, 0.0, 99.0, 0.0], [high, np.inf, 16.0, 1.0], [np.nan] * 4])
    out = found.out(values)
    assert out[:, 0] == pytest.approx([-1.0, 1.0, 0.0])
    assert (out[1:, 1] == 0.0).all()
    assert (out[:, 2] == 0.0).all()
    assert out[:, 3] == pytest.approx([0.0, 1.0 / rare.std(), 0.0])


def test_the_worst_places_name_a_cause_in_the_map() -> None:
    """The trees ask the virtual drive alone; the map's own factors say why it drifts."""
    factors, labels = drives(3, {"a": 500, "b": 500})
    rng = np.random.default_rng(3)
    seen = (
        Column("vd_mean", "OB", "m", "", "", "observability"),
        Column("ob_info_along", "OB", "1/m^2", "", "", "observability"),
    )
    error = labels["error_mean"].to_numpy()
    factors["vd_mean"] = error * np.exp(0.05 * rng.normal(size=len(error)))
    factors["ob_info_along"] = 500.0 / error * np.exp(rng.normal(size=len(error)))
    factors["angular_H"] = 5.0 - np.log(error) + 0.4 * rng.normal(size=len(error))
    learnt = joined(factors, {"drive": labels}, (*COLUMNS, *seen))
    with pytest.MonkeyPatch.context() as patch:
        growth = asdict(Growth(trees=10, leaf=8, log=True))
        patch.setattr(TunedForest, "tuned", lambda *_: growth)
        model = train(learnt, recipe="forest")
    typical = model.typical
    assert model.factors == ("vd_mean", "ob_info_along")
    found = predict(model, factors)
    worst = factors[found["estimate"] > model.worst]
    reasons = found.loc[worst.index, "reason"].str.split("; unlike").str[0]
    assert reasons.str.startswith("a virtual drive does not hold its place (").all()
    out = np.sign(typical.rho) * typical.out(worst[list(typical.names)].to_numpy())
    own = [name in NAMES for name in typical.names]
    far = (out[:, own] >= 1.2) & (np.abs(typical.rho[own]) >= typical.clear)
    phrases = [phrase_of(n, bool(r > 0.0)) for n, r in zip(NAMES, typical.rho[own], strict=True)]
    causes = far & ~np.isin(phrases, list(REASSURING))
    assert causes.any(axis=1).sum() > 150
    assert reasons[causes.any(axis=1)].str.contains("; ").all()
    assert reasons.str.contains("features on few sides only (angular_H", regex=False).sum() > 150
    lean = predict(model, factors[["vd_mean", "ob_info_along"]])
    pd.testing.assert_frame_equal(lean.drop(columns="reason"), found.drop(columns="reason"))
    assert lean["reason"].str.contains("nothing fixes the direction of travel").sum() > 50
    assert not lean["reason"].str.contains("angular_H").any()


def test_without_training_reasons_rest_on_fixed_bounds() -> None:
    usual = {
        "status": "done", "reason": "", "vd_mean": 0.06, "vd_floor": 0.02, "vd_tail": 0.04,
        "vd_p_fail": 0.1, "vd_along": 0.05, "vd_across": 0.02, "vd_up": 0.01,
        "ob_info_along": 9000.0, "ob_info_across": 12000.0,
        "ob_unmapped": 0.02, "ob_ghosts": 0.1, "ob_returns": 0.8,
    }  # fmt: skip
    tunnel = {"vd_mean": 0.57, "vd_along": 0.55, "ob_info_along": 600.0}
    blind = {"vd_mean": 0.2, "vd_across": 0.18, "ob_info_across": 900.0, "ob_returns": 0.3}
    edge = {"vd_mean": 0.2, "vd_up": 0.19, "ob_unmapped": 0.25, "ob_ghosts": 0.45}
    nothing = {"vd_mean": np.nan, "status": "missing", "reason": "nothing in view"}
    loose = {"vd_mean": 0.3, "ob_info_along": -5.0, "ob_info_across": 0.0}  # H has no maximum
    rows = pd.DataFrame([usual | other for other in ({}, tunnel, blind, edge, nothing, loose)])
    found = physical(rows, 0.01)
    told = found["reason"].str.replace("\u00a0", " ").str.split("; ").tolist()
    assert told == [
        [""],
        [
            "a virtual drive slides along the road (55 cm)",
            "nothing fixes the direction of travel (5 % of what fixes the other)",
        ],
        [
            "a virtual drive slides across the road (18 cm)",
            "nothing fixes the direction across (10 % of what fixes the other)",
            "few beams would come back (30 %)",
        ],
        [
            "a virtual drive rises or sinks (19 cm)",
            "more of the view than usual is not in the map (25 %)",
            "traffic baked into the map stands in view (45 %)",
        ],
        ["nothing in view"],
        ["a virtual drive slides along the road (5 cm)"],
    ]
    assert found["in_domain"].isna().all()
    assert found.loc[:3, "estimate"].tolist() == pytest.approx([0.07, 0.58, 0.21, 0.21])
    empty = ["low", "high", "domain_distance"]
    assert found[empty].isna().all(axis=None)
    pd.testing.assert_frame_equal(physical(rows.iloc[[2]], 0.01), found.iloc[[2]])


def test_every_factor_has_a_phrase_and_its_unit_words() -> None:
    columns = features_of(COLUMNS_LEARNT)
    assert {column.name for column in columns} == set(PHRASES)
    assert set(NAMES) <= set(PHRASES)
    assert {column.unit for column in columns} <= {"m", *UNITS}
    shares = {c.name for c in columns if c.meaning.startswith(("Share", "Mean share"))}
    assert shares == SHARES
