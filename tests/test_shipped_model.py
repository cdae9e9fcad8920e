"""The model that ships: of this package's stages, small, and honest about where it was checked."""

import json
from pathlib import Path

import pytest

import tilestream
from tilestream.model.dataset import TARGETS
from tilestream.model.file import load_model
from tilestream.model.training import Model
from tilestream.pipeline.stages.samples import MAKERS

SHIPPED = Path(tilestream.__file__).parent / "data" / "model.skops"
MOST_BYTES = 4_000_000


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(SHIPPED)


def test_its_factors_and_labels_are_made_as_this_package_makes_them(model: Model) -> None:
    """Else `python pipelines/retrain.py pipelines/retrain.yaml` makes another one."""
    assert model.card["stages"] == {one.name: one.version for one in MAKERS}


def test_it_is_small_and_estimates_all_parts(model: Model) -> None:
    assert SHIPPED.stat().st_size < MOST_BYTES
    assert set(model.regressors) == set(TARGETS)


def test_its_card_says_over_what_and_where_it_was_checked(model: Model) -> None:
    card = model.card
    assert len(card["lidars"]) >= 4
    assert len(card["matchers"]) >= 2
    assert set(card["districts"]) == {"shinjuku", "sendagaya"}
    assert set(card["presets"]) == {"physical", "paper"}
    assert len(card["seeds"]) >= 2
    checked = card["checked"]
    assert {"held-out paths", "held-out lidar", "held-out district", "real drives"} <= set(checked)
    for name in ("held-out paths", "held-out lidar", "held-out district"):
        skill, low, high = checked[name]["skill"]
        assert low <= skill <= high < 1.0
        assert 0.0 < checked[name]["coverage"][0] <= 1.0
    assert checked["real drives"]["places"] > 0
    assert json.loads(json.dumps(card, allow_nan=False)) == card


def test_no_real_drive_has_trained_it(model: Model) -> None:
    assert all("kitti" not in name for name in [*model.card["runs"], *model.card["drives"]])
    assert all(run["preset"] and run["seed"] is not None for run in model.card["runs"].values())
