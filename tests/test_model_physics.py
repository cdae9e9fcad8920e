"""Physics, and what corrects it: judged as they are shipped, corrected only where it pays."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_data import OBSERVED, Floats, dataset, with_virtual_drives
from sklearn.tree import DecisionTreeRegressor

from tilestream.errors import ModelError
from tilestream.factors.along_route import WIDTH, WIDTHS
from tilestream.model.corrected import WEIGHTS, Corrected
from tilestream.model.dataset import TARGETS, Dataset
from tilestream.model.evaluation import held_out
from tilestream.model.physics import VIRTUAL, Physics, at_each_width, possible, width_of
from tilestream.model.prediction import predict
from tilestream.model.splits import leave_path_out
from tilestream.model.training import ESTIMATES, train

LENGTHS = {"a": 210, "b": 210, "c": 210}


@pytest.fixture(scope="module")
def plain() -> Dataset:
    """Nothing but noise between the virtual drive and the labels."""
    return with_virtual_drives(dataset(1, lengths=LENGTHS))


@pytest.fixture(scope="module")
def hinted() -> Dataset:
    """A factor tells much of what the virtual drive does not see."""
    return with_virtual_drives(dataset(1, lengths=LENGTHS), noise=0.1, hidden=0.6)


def test_physics_is_the_virtual_drive_and_the_median_of_what_it_lacks(plain: Dataset) -> None:
    for target, column in VIRTUAL.items():
        fitted = Physics.fit(plain, target)
        seen = plain.rows[column].to_numpy()
        assert fitted.added == np.median(plain.label(target) - seen)
        raw = seen + fitted.added
        expected = np.clip(raw, 0.0, 1.0) if target == "p_fail" else np.maximum(raw, 0.0)
        if target != "error_tail":
            np.testing.assert_array_equal(fitted.predict(plain.rows), expected)


def test_without_training_it_is_the_virtual_drive_as_it_is(plain: Dataset) -> None:
    for target, column in VIRTUAL.items():
        added = 0.03 if target in ("error_mean", "error_floor") else 0.0
        found = Physics.as_it_is(target, 0.03).predict(plain.rows)
        np.testing.assert_array_equal(found, plain.rows[column] + added)


@pytest.mark.parametrize("recipe", ["physics", "corrected"])
def test_what_is_judged_is_what_is_shipped(recipe: str, hinted: Dataset) -> None:
    """The model of a training part, with its own width, says what the evaluation held out."""
    split = leave_path_out(hinted)[0]
    model = train(hinted.take(split.train), recipe=recipe)
    places = hinted.averaged(model.width).take(split.test).rows
    shipped = predict(model, places)
    assert shipped[["low", "high", "domain_distance"]].notna().all(axis=None)
    for target in ("error_mean", "error_tail", "p_fail"):
        judged = held_out(hinted, [split], recipe, target)["estimate"]
        np.testing.assert_array_equal(shipped[ESTIMATES[target]], judged)


def test_a_dataset_without_a_virtual_drive_is_refused(plain: Dataset) -> None:
    without = plain.with_columns([c for c in plain.columns if not c.name.startswith("vd_")])
    for kind in (Physics, Corrected):
        with pytest.raises(ModelError, match="no virtual drive"):
            kind.fit(without, "error_mean")
    lean = plain.with_columns([c for c in OBSERVED if c.name != "vd_floor"])
    with pytest.raises(ModelError, match="no virtual drive of error_tail"):
        Physics.fit(lean, "error_tail")


# --- The correction


def test_nothing_is_corrected_where_nothing_is_known(plain: Dataset) -> None:
    """What labels add to the virtual drive is pure chance; by chance a few shares pay."""
    weights = []
    for seed in range(8):
        chance = 0.02 * np.random.default_rng(seed).exponential(size=len(plain))
        labels = plain.rows.assign(across_mean=plain.rows["vd_across"] + chance)
        world = replace(plain, rows=labels)
        fitted = Corrected.fit(world, "across_mean")
        weights.append(fitted.weight)
        if not fitted.weight:
            physics = Physics.fit(world, "across_mean")
            np.testing.assert_array_equal(fitted.predict(world.rows), physics.predict(world.rows))
            assert not fitted.importances().any()
            assert fitted.trees == ()
    assert weights.count(0.0) >= 6


def test_what_observability_tells_is_learnt(hinted: Dataset) -> None:
    split = leave_path_out(hinted)[0]
    errors = {}
    for name in ("physics", "corrected"):
        points = held_out(hinted, [split], name)
        errors[name] = (points["estimate"] - points["actual"]).abs().mean()
    assert errors["corrected"] < 0.85 * errors["physics"]
    fitted = Corrected.fit(hinted, "error_mean")
    assert fitted.weight in WEIGHTS
    assert fitted.factors[int(np.argmax(fitted.importances()))] == "ob_hint"


def test_the_weight_is_chosen_for_each_target(hinted: Dataset) -> None:
    chance = np.random.default_rng(0).permutation([0.04, 0.05, 0.06] * 210)
    other = hinted.rows.assign(across_mean=hinted.rows["vd_across"] + chance)
    fewer = other.drop(columns=[t for t in TARGETS if t not in ("error_mean", "across_mean")])
    world = replace(hinted, rows=fewer, virtual_drives=hinted.virtual_drives.iloc[:0])
    learnt = train(world, recipe="corrected").facts["learnt"]
    assert learnt["error_mean"]["correction"] > 0.0
    assert learnt["across_mean"] == {"offset": pytest.approx(0.05), "correction": 0.0}


def test_contributions_add_up_to_what_is_above_a_typical_place(hinted: Dataset) -> None:
    fitted = Corrected.fit(hinted, "error_mean")
    places = hinted.rows[:60]
    step = fitted.weight * fitted.settings["rate"]
    roots = step * sum(tree.tree_.value[0, 0, 0] for tree in fitted.trees)
    total = fitted.contributions(places).sum(axis=1) + roots
    typical = fitted.physics.middle + fitted.physics.added
    np.testing.assert_allclose(np.maximum(total + typical, 0.0), fitted.predict(places), atol=1e-9)
    for tree in fitted.trees:  # an inner node is the mean of its leaves
        leaf = tree.tree_.children_left < 0
        at, count = tree.tree_.value[:, 0, 0], tree.tree_.weighted_n_node_samples
        assert at[0] == pytest.approx(at[leaf] @ count[leaf] / count[leaf].sum())


def test_a_correction_that_was_tampered_with_is_refused(hinted: Dataset) -> None:
    fitted = Corrected.fit(hinted, "error_mean")

    def load(**changes: object) -> Corrected:
        saved = fitted.save() | changes
        return Corrected.load(saved, "error_mean", fitted.factors, fitted.settings)

    other = DecisionTreeRegressor().fit([[1.0], [2.0]], [1.0, 2.0])
    numbers = fitted.physics.save()
    for name, value in (
        ("trees", [other]),
        ("trees", ["tree"]),
        ("weight", np.array([7.0])),
        ("weight", 0.5),
        ("physics", None),
        ("physics", numbers | {"numbers": np.array([np.nan, 0.0])}),
        ("physics", numbers | {"numbers": np.zeros(3)}),
        ("physics", numbers | {"factors": ["ob_noise"]}),
    ):
        with pytest.raises(ModelError, match="a damaged model file"):
            load(**{name: value})


# --- What is possible


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=9),
    st.sampled_from(TARGETS),
    st.floats(0.0, 1.0),
)
def test_estimates_are_possible(values: list[float], target: str, floor: float) -> None:
    given_, places = np.array(values), pd.DataFrame({"vd_floor": np.full(len(values), floor)})
    found = possible(target, given_, places)
    least = -floor if target == "error_tail" else 0.0
    most = 1.0 if target == "p_fail" else np.inf
    assert ((found >= least) & (found <= most)).all()
    inside = (given_ >= least) & (given_ <= most)
    np.testing.assert_array_equal(found[inside], given_[inside])
    np.testing.assert_array_equal(possible(target, found, places), found)


# --- The kernel along the route


@pytest.mark.parametrize(("noise", "expected"), [(0.0, WIDTHS[:1]), (0.8, WIDTHS[3:])])
def test_the_kernel_is_as_wide_as_the_noise_asks_for(
    noise: float, expected: tuple[float, ...]
) -> None:
    world = with_virtual_drives(dataset(2, lengths=LENGTHS), noise=noise)
    width = width_of(world, at_each_width(world))
    assert width in expected
    assert train(world, recipe="physics").width == width


def test_the_kernel_is_chosen_on_what_trains(plain: Dataset) -> None:
    """Labels that are held out have no say in the width, nor in anything else."""
    split = leave_path_out(plain)[0]
    blind = replace(plain, rows=plain.rows.copy())
    blind.rows.loc[split.test, list(TARGETS)] = 0.5
    for name in ("physics", "corrected"):
        one, two = (held_out(world, [split], name)["estimate"] for world in (plain, blind))
        np.testing.assert_array_equal(one, two)


def test_without_blocks_or_virtual_drives_the_kernel_is_the_usual_one() -> None:
    short = with_virtual_drives(dataset(2, lengths={"a": 120}))
    for world in (short, dataset(2, lengths={"a": 210, "b": 210})):
        assert width_of(world, at_each_width(world)) == WIDTH


def test_a_dataset_is_averaged_along_its_drives(plain: Dataset) -> None:
    found = plain.averaged(2.0)
    means = found.rows["vd_mean"].to_numpy()
    path = plain.rows["path"].to_numpy() == "a"
    seen: Floats = plain.rows["vd_mean"].to_numpy()[path]
    weight = np.exp(-0.5 * (np.arange(-4, 5) / 2.0) ** 2)
    expected = np.convolve(seen, weight / weight.sum(), "valid")
    np.testing.assert_allclose(means[path][4:-4], expected)
    back = found.averaged(0.0).rows
    np.testing.assert_array_equal(back["vd_mean"], plain.rows["vd_mean"])
    some = np.arange(0, len(plain), 7)  # labels of few places, neighbours of all
    np.testing.assert_array_equal(plain.take(some).averaged(2.0).rows["vd_mean"], means[some])


@pytest.mark.parametrize(
    ("part", "forged"),
    [
        ("trees", 3),
        ("trees", [3]),
        ("trees", None),
        ("weight", np.array([0.3])),
        ("weight", 0.5),
        ("physics", {}),
        ("physics", None),
    ],
)
def test_a_forged_correction_is_refused_by_name(part: str, forged: object, hinted: Dataset) -> None:
    fitted = Corrected.fit(hinted, "error_mean")
    whole = fitted.save()
    known = (fitted.factors, dict(fitted.settings))
    again = Corrected.load(whole, "error_mean", *known)
    np.testing.assert_array_equal(again.predict(hinted.rows), fitted.predict(hinted.rows))
    with pytest.raises(ModelError, match="a damaged model file"):
        Corrected.load({**whole, part: forged}, "error_mean", *known)
