"""Factors and errors are joined by place; what is lost is counted; the held-out are far away."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_data import COLUMNS, WEAK_AXIS, dataset, drives, joined

from tilestream.errors import ModelError, UsageError
from tilestream.model.dataset import TARGETS, Dataset, made_with, nearest_along
from tilestream.model.evaluation import factor_sets
from tilestream.model.features import features_of, with_derived
from tilestream.model.join import NOWHERE, ON_PATH, PLACE, join, nearest_pass
from tilestream.model.splits import PROTOCOLS, block_splits, leave_path_out, random_split
from tilestream.records import Column
from tilestream.sensor import VLP16

SHORT = {"a": 260, "b": 410, "c": 90}


@pytest.fixture(scope="module")
def short() -> tuple[pd.DataFrame, pd.DataFrame]:
    return drives(3, SHORT)


def test_rows_are_joined_by_sample_and_not_by_order(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short
    plain = joined(factors, {"drive": labels})
    mixed = joined(factors.sample(frac=1.0, random_state=1), {"drive": labels[::-1]})
    pd.testing.assert_frame_equal(plain.rows, mixed.rows, check_exact=True)
    assert len(plain) == sum(SHORT.values())
    want = dict(
        zip(zip(labels["y"], labels["arc_length"], strict=True), labels["error_mean"], strict=True)
    )
    for row in plain.rows.itertuples():
        assert row.error_mean == want[(row.y, row.arc_length)]
    assert plain.losses == {}


def test_a_label_has_the_factors_of_its_own_place_however_far_the_route(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    """It is on the route within 5 m, at the arc length there; farther away on a path of its own."""
    factors, labels = short
    rng = np.random.default_rng(0)
    beside = factors.assign(
        x=factors["x"] + rng.uniform(-0.5, 0.5, len(factors)),
        y=factors["y"] + rng.uniform(-4.9, 4.9, len(factors)),
        z=factors["z"] + 3.0,
        arc_length=factors["arc_length"] + 7.0,
        sample=factors.index,
    )
    found = join(factors, {"drive": beside}, {"drive": labels}, COLUMNS).rows
    want = beside.sort_values("y").merge(labels, on="sample", suffixes=("", "_label"))
    assert len(found) == len(factors)
    found = found.set_index("sample").loc[want["sample"]]
    for name in ("score_H", "error_mean", "x", "y", "z"):
        assert found[name].tolist() == want[name].tolist()
    assert found["path"].tolist() == want["route_id"].tolist()
    start = factors.groupby("route_id")["x"].min()
    np.testing.assert_allclose(
        found["arc_length"], want["x"].to_numpy() - start[want["route_id"]].to_numpy(), atol=1e-6
    )
    assert found["distance"].between(0.0, 5.0).all()
    far = join(factors, {"drive": beside.assign(y=beside["y"] + 20.0)}, {"drive": labels}, COLUMNS)
    assert set(far.rows["path"]) == {"drive, off the routes"}
    assert far.rows["distance"].isna().all()
    assert far.rows["arc_length"].isin(beside["arc_length"]).all()


def test_a_label_that_is_not_joined_is_counted_with_its_reason(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short[0].copy(), short[1].copy()
    factors.loc[5, "score_H"] = np.nan
    factors.loc[6, ["status", "reason"]] = ["missing", "no map here"]
    labels.loc[10, ["status", "reason"]] = ["failed", "no cell in reach"]
    labels.loc[40, "error_mean"] = np.nan
    labels.loc[60, "sample"] = 10_000
    found = joined(factors, {"drive": labels})
    assert found.losses == {
        "factor score_H is not a number": 1,
        NOWHERE: 2,
        "label failed": 1,
        "label error_mean is not a number": 1,
    }
    assert len(found) + sum(found.losses.values()) == len(labels)
    details = found.lost.set_index("sample")["detail"]
    assert details[10] == "no cell in reach"
    assert details[6] == "no map here"
    assert details[10_000] == "its task failed"
    nobody = join(factors, {}, {"drive": labels}, COLUMNS)
    assert nobody.losses == {NOWHERE: len(labels) - 1, "label failed": 1}


def test_several_drives_over_one_place_are_kept_apart(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short
    again = labels.assign(error_mean=labels["error_mean"] + 0.01)
    both = joined(factors, {"one": labels, "two": again}, COLUMNS)
    assert len(both) == 2 * len(labels)
    assert both.rows.groupby("group").size().to_dict() == {"one": len(labels), "two": len(labels)}
    one = both.groups(["one"])
    assert np.array_equal(one.label(), joined(factors, {"one": labels}, COLUMNS).label())
    with pytest.raises(UsageError, match="no group 'three'; there are one, two"):
        both.groups(["three"])


def test_labels_of_different_making_are_never_mixed(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short
    identities = {"one": {"solver": "raw"}, "two": {"solver": "definite"}}
    mixed = joined(factors, {"one": labels, "two": labels}, COLUMNS, data_sets=identities)
    with pytest.raises(ModelError, match="'one' and 'two' were labelled with different solver"):
        mixed.check()
    mixed.groups(["one"]).check()
    refined = {"one": labels.assign(true_pose="log"), "two": labels.assign(true_pose="refined")}
    with pytest.raises(ModelError, match="different true_pose"):
        joined(factors, refined, COLUMNS).check()


def test_position_name_and_heading_are_never_features() -> None:
    factors, labels = drives(0, SHORT, columns=(*COLUMNS, WEAK_AXIS))
    catalogue = (
        *COLUMNS,
        WEAK_AXIS,
        *(Column(name, "place", "m", "", "") for name in PLACE),
    )
    found = joined(factors, {"drive": labels}, catalogue)
    assert not {*PLACE, "path", "block", "group", "sample", "distance", "weak_axis"} & set(
        found.names
    )
    assert not set(TARGETS) & set(found.names)
    assert "weak_along" in found.names
    turned = factors.assign(heading=factors["heading"] + 1.0, weak_axis=factors["weak_axis"] + 1.0)
    elsewhere = turned.assign(x=turned["x"] + 5e4, route_id="other " + turned["route_id"])
    moved = labels.assign(x=labels["x"] + 5e4)
    there = joined(elsewhere, {"drive": moved}, catalogue)
    assert np.allclose(there.matrix(), found.matrix(), rtol=0, atol=1e-12)
    assert [c.name for c in features_of(catalogue)] == found.names


def test_factors_in_map_axes_are_turned_into_the_routes() -> None:
    names = ("weak_axis", "score_cov_xx", "score_cov_xy", "score_cov_yy")
    columns = tuple(Column(name, "LS", "1", "", "", "robust") for name in names)
    assert [c.name for c in features_of(columns)] == [
        "weak_along",
        "score_var_along",
        "score_var_across",
    ]
    heading, axis = 0.7, np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    C = axis @ np.diag([4.0, 1.0]) @ axis.T
    row = {"heading": heading, "weak_axis": 0.7, "score_cov_xx": C[0, 0], "score_cov_yy": C[1, 1]}
    found = with_derived(pd.DataFrame([row | {"score_cov_xy": C[0, 1]}])).iloc[0]
    assert found["weak_along"] == pytest.approx(1.0)
    assert (found["score_var_along"], found["score_var_across"]) == pytest.approx((4.0, 1.0))


def test_blocks_are_at_least_200_m_and_whole_paths_if_shorter() -> None:
    found = dataset(1, lengths={"a": 199, "b": 401, "c": 700})
    lengths = found.rows.groupby("block")["arc_length"].agg(np.ptp)
    assert list(lengths.index) == ["a#00", "b#00", "b#01", "c#00", "c#01", "c#02"]
    assert (lengths[1:] >= 199.0).all()


def test_blocks_do_not_depend_on_what_was_lost(short: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    factors, labels = short
    whole = joined(factors, {"drive": labels}, COLUMNS).rows.set_index(["path", "arc_length"])
    part = joined(factors, {"drive": labels[100:500]}, COLUMNS).rows.set_index(
        ["path", "arc_length"]
    )
    assert (part["block"] == whole.loc[part.index, "block"]).all()


def test_every_point_is_held_out_once_and_far_from_what_trained() -> None:
    found = dataset(2, lengths={"a": 650, "b": 400, "c": 300})
    at = found.rows[["x", "y"]].to_numpy()
    for splits in (leave_path_out(found), block_splits(found)):
        tested = np.concatenate([split.test for split in splits])
        assert np.array_equal(np.sort(tested), np.arange(len(found)))
        for split in splits:
            apart = np.abs(at[split.train, None] - at[None, split.test])
            assert np.hypot(apart[..., 0], apart[..., 1]).min() > 100.0
    paths = found.rows["path"].to_numpy()
    for split in leave_path_out(found):
        assert not set(paths[split.train]) & set(paths[split.test])


def test_a_street_driven_twice_is_no_other_street() -> None:
    factors, labels = drives(4, {"a": 300, "b": 300})
    beside = factors["route_id"] == "b"
    factors.loc[beside, "y"] = factors["y"].iloc[0] + 5.0
    labels["y"] = factors["y"]
    found = joined(factors, {"drive": labels}, COLUMNS)
    with pytest.raises(ModelError, match="path a: 0 points lie beyond 100 m"):
        leave_path_out(found)


def test_the_random_split_is_the_papers() -> None:
    found = dataset(0)
    (split,) = random_split(found, 7)
    assert (len(split.train), len(split.test)) == (2709, 903)
    assert np.array_equal(np.sort(np.r_[split.train, split.test]), np.arange(3612))
    assert not np.array_equal(split.test, random_split(found, 8)[0].test)
    assert [protocol.name for protocol in PROTOCOLS] == ["paper", "path", "blocks"]


def test_the_tails_are_the_papers() -> None:
    errors = np.concatenate([dataset(seed, related=0.0).label() for seed in range(4)])
    for limit, share in ((0.10, 0.419), (0.15, 0.178), (0.20, 0.0845), (0.25, 0.0431)):
        assert abs((errors > limit).mean() - share) < 0.05


def test_factor_sets_grow_by_the_papers_criteria() -> None:
    sets = factor_sets((*COLUMNS, WEAK_AXIS))
    assert {name: len(columns) for name, columns in sets.items()} == {
        "FS": 8,
        "FS+RQ": 10,
        "FS+RQ+LY": 16,
        "FS+RQ+LY+LS": 20,
        "all + robust": 21,
    }
    assert "all + robust" not in factor_sets(COLUMNS)


def test_what_factors_were_made_with_is_remembered() -> None:
    facts = made_with(COLUMNS, VLP16, 2.0)
    assert facts["sensor"]["name"] == "VLP16"
    assert facts["cell_size"] == 2.0
    assert facts["units"]["FDOP"] == "1"


def small(**changes: object) -> Dataset:
    factors, labels = drives(0, {"a": 60, "b": 60})
    return joined(factors, {"drive": labels.assign(**changes)}, COLUMNS)


def test_what_nothing_can_be_learnt_from_is_refused() -> None:
    with pytest.raises(ModelError, match=r"error_mean is 0\.1 at all 120 points"):
        small(error_mean=0.1).check()
    factors, labels = drives(0, {"a": 60, "b": 60})
    few = joined(factors, {"drive": labels.iloc[:49]}, COLUMNS)
    with pytest.raises(ModelError, match="49 labelled points, and a model needs 50"):
        few.check()
    lonely = joined(factors, {"drive": labels}, COLUMNS).take(np.arange(61))
    with pytest.raises(ModelError, match="path 'b' has one point only"):
        lonely.check()
    with pytest.raises(ModelError, match="one block only"):
        block_splits(few)
    with pytest.raises(ModelError, match="one path only"):
        leave_path_out(few)
    with pytest.raises(ModelError, match="the labels have no nonsense"):
        few.label("nonsense")


def test_a_label_alone_on_its_path_is_lost_and_stops_nothing() -> None:
    factors, labels = drives(0, {"a": 60, "b": 60})
    end = joined(factors, {"drive": labels.iloc[:61]}, COLUMNS)
    end.check()
    assert len(end) == 60
    assert end.losses == {"the only label of its path": 1}
    assert end.lost["sample"].tolist() == [60]
    twice = {"one": labels.iloc[:61], "two": labels.iloc[60:61]}
    assert joined(factors, twice, COLUMNS).losses == {"the only label of its path": 2}
    apart = {"one": labels.iloc[:61], "two": labels.iloc[60:62]}
    assert joined(factors, apart, COLUMNS).losses == {}
    nothing = joined(factors, {"drive": labels.iloc[[3]]}, COLUMNS)
    with pytest.raises(ModelError, match=r"0 labelled points.*1 the only label of its path"):
        nothing.check()


def test_each_path_is_that_of_the_drive_that_knows_most_of_it(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short
    groups = {"one": labels.iloc[:400], "two": labels.iloc[150:]}
    found = joined(factors, groups)
    once = found.rows.iloc[found.rows_of_one_drive()]
    counts = once.groupby(["path", "group"]).size().to_dict()
    assert counts == {("a", "one"): 260, ("b", "two"): 410, ("c", "two"): 90}


@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.floats(0.0, 50.0)), min_size=1, max_size=12),
    st.lists(
        st.tuples(st.sampled_from("ab"), st.integers(0, 50)), min_size=1, max_size=12, unique=True
    ),
    st.floats(0.0, 5.0),
)
def test_the_nearest_along_a_path_is_that_of_a_search(
    rows: list[tuple[str, float]], others: list[tuple[str, int]], reach: float
) -> None:
    left = pd.DataFrame(rows, columns=["path", "arc_length"])
    right = pd.DataFrame(others, columns=["path", "arc_length"]).astype({"arc_length": float})
    found = nearest_along(left, right.assign(at=right["arc_length"]), reach)
    assert found[["path", "arc_length"]].equals(left)
    for (path, arc), at in zip(rows, found["at"], strict=True):
        apart = [abs(other - arc) for way, other in others if way == path]
        if apart and min(apart) <= reach:
            assert abs(at - arc) == min(apart)
        else:
            assert np.isnan(at)


@given(
    st.lists(
        st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(-4.0, 4.0)),
        min_size=1,
        max_size=12,
    ),
    st.lists(
        st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(-4.0, 4.0)), max_size=6
    ),
)
def test_a_place_lies_on_the_pass_that_heads_its_way(
    route: list[tuple[float, float, float]], places: list[tuple[float, float, float]]
) -> None:
    way, at = np.array(route), np.array(places).reshape(-1, 3)
    rows, distance = nearest_pass(way[:, :2], way[:, 2], at[:, :2], at[:, 2])
    for (x, y, heading), row, found in zip(at, rows, distance, strict=True):
        apart = np.hypot(way[:, 0] - x, way[:, 1] - y)
        same = (np.cos(way[:, 2] - heading) >= 0.0) & (apart <= ON_PATH)
        assert found == pytest.approx(apart[row])
        assert found == pytest.approx((apart[same] if same.any() else apart).min())


def test_labels_of_a_street_driven_both_ways_stay_on_their_way() -> None:
    factors, labels = drives(3, {"a": 40})
    back = {"x": labels["x"], "arc_length": 100.0 + labels["arc_length"].to_numpy()[::-1]}
    turn = labels["heading"] + np.pi
    routes = factors[list(PLACE)]
    both = pd.concat([routes, routes.assign(**back, heading=turn)], ignore_index=True)
    for offset, arc in ((0.0, labels["arc_length"]), (np.pi, back["arc_length"])):
        headed = {"heading": labels["heading"] + offset}
        one = join(both, {"d": factors.assign(**headed)}, {"d": labels}, COLUMNS)
        rows = one.rows.sort_values("sample")
        assert rows["arc_length"].tolist() == pytest.approx(list(arc))


def test_broken_tables_are_refused(short: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    factors, labels = short
    own = {"drive": factors.assign(sample=factors.index)}
    with pytest.raises(UsageError, match=r"two rows of route 'a' at 0 m"):
        join(pd.concat([factors, factors.iloc[:1]]), own, {"drive": labels}, COLUMNS)
    with pytest.raises(UsageError, match="group 'drive' has sample 0 twice"):
        joined(factors, {"drive": pd.concat([labels, labels.iloc[:1]])})
    twice = {"drive": pd.concat([own["drive"], own["drive"].iloc[:1]])}
    with pytest.raises(UsageError, match="group 'drive' has the factors of sample 0 twice"):
        join(factors, twice, {"drive": labels}, COLUMNS)
    with pytest.raises(UsageError, match="the table of routes has no column heading"):
        join(factors.drop(columns="heading"), own, {"drive": labels}, COLUMNS)
    with pytest.raises(UsageError, match="group 'drive' has no column error_mean"):
        joined(factors, {"drive": labels.drop(columns="error_mean")})
    with pytest.raises(UsageError, match="none of the catalogue's factors"):
        joined(factors[[*PLACE, "status", "reason"]], {"drive": labels})
    with pytest.raises(UsageError, match="the table of routes has no rows"):
        joined(factors.iloc[:0], {"drive": labels})
    with pytest.raises(UsageError, match="give a positive length"):
        joined(factors, {"drive": labels}, block=0.0)


def test_no_labels_is_an_empty_table_that_says_so(
    short: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    factors, labels = short
    for groups in (
        {},
        {"drive": labels.iloc[:0]},
        {"drive": labels.assign(sample=-1 - labels["sample"])},
    ):
        found = joined(factors, groups, COLUMNS)
        assert len(found) == 0
        with pytest.raises(ModelError, match="0 labelled points"):
            found.check()
