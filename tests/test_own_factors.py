"""A factor of one's own: a file outside of the package, in tables and models as the others."""

import re
from dataclasses import asdict
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import model_data
import numpy as np
import pandas as pd
import pytest
from scenes import scene

import tilestream as ts
from tilestream.errors import ModelError, SourceNotFoundError, UsageError
from tilestream.factors import own as owns
from tilestream.factors.own import OwnFactors, columns_in, own_factors, own_table
from tilestream.factors.rows import samples_by_tile
from tilestream.formats.points.pcd import write_pcd
from tilestream.model.applicability import check_making
from tilestream.model.file import load_model, save_model
from tilestream.model.prediction import predict
from tilestream.model.training import train
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.outputs import Made, Stored
from tilestream.pipeline.jobs.along_routes import plan_factors
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.stages.factors import Looking
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.pipeline.stages.samples import DatasetFile, samples
from tilestream.settings import DEFAULT_MEMORY

OVERHEAD = re.findall(r"```python\n(.*?)```", str(owns.__doc__), re.DOTALL)[0]
"""What the documentation shows."""
SUMS = """
from tilestream import Column

REACH = 9.0
COLUMNS = (
    Column("sum_z", "FS", "m", "A sum that rounds by its order.", "own"),
    Column("cells_near", "FS", "1", "Cells around.", "own"),
    Column("ahead", "FS", "m", "How far its points lie ahead.", "own"),
)


def factors(around):
    import math
    along = math.cos(around.heading), math.sin(around.heading)
    offset = around.points[:, :2] - around.place[:2]
    return {
        "sum_z": sum(around.points[:, 2] * 1.1),
        "cells_near": len(around.cells),
        "ahead": (offset @ along).mean(),
    }
"""


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> list[ts.TileStore]:
    """One street in tiles of 20 m, and of 10 m."""
    folder = tmp_path_factory.mktemp("maps")
    write_pcd(folder / "street.pcd", scene("canyon", 1, spacing=0.6))
    files = [str(folder / "street.pcd")]
    return [ts.ingest(files, folder / f"{size:g}", tile_size=size) for size in (20.0, 10.0)]


@pytest.fixture
def overhead(tmp_path: Path) -> str:
    (tmp_path / "overhead.py").write_text(OVERHEAD)
    return str(tmp_path / "overhead.py")


def places(*x: float) -> pd.DataFrame:
    frame = pd.DataFrame({"x": x, "y": 0.5, "z": 2.0, "heading": 0.3})
    return frame.assign(status="done")


def test_a_file_is_ten_lines() -> None:
    assert sum(1 for line in OVERHEAD.splitlines() if line.strip()) <= 10


def test_it_sees_the_points_within_reach(stores: list[ts.TileStore], overhead: str) -> None:
    at = places(3.0, 9.0)
    at.loc[2] = at.loc[0]
    at.loc[2, "status"] = "missing"
    found = own_table(own_factors([overhead]), stores[0], at, 2.0)
    points = np.concatenate([stores[0].tile(key).points() for key in stores[0].keys()])
    for row in (0, 1):
        near = np.hypot(*(points[:, :2] - [at.loc[row, "x"], 0.5]).T) <= 10.0
        assert found.loc[row, "overhead"] == pytest.approx((points[near, 2] > 5.0).mean())
    assert np.isnan(found.loc[2, "overhead"])


def test_it_has_the_same_bits_for_any_tiling(stores: list[ts.TileStore]) -> None:
    at = places(3.0, 9.5, 12.0)
    one, other = (own_table([OwnFactors("sums", SUMS)], store, at, 2.0) for store in stores)
    alone = own_table([OwnFactors("sums", SUMS)], stores[0], at.iloc[[1]], 2.0)
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    pd.testing.assert_frame_equal(one.iloc[[1]], alone, check_exact=True)
    mean = np.concatenate([stores[0].tile(key).cells().mean for key in stores[0].keys()])
    near = np.hypot(*(mean[:, :2] - [3.0, 0.5]).T) <= 9.0
    assert one.loc[0, "cells_near"] == near.sum() > 0


def test_a_table_has_it_and_a_changed_file_is_computed_anew(
    stores: list[ts.TileStore], overhead: str, tmp_path: Path
) -> None:
    route = tmp_path / "route.csv"
    route.write_text("x,y,z\n6,0.5,0\n8,0.5,0\n")
    looking = Looking(ts.VLP16.model_copy(update={"range_max": 8.0}), 2.0, "all", 2.0)
    samples = samples_by_tile(stores[0].grid, [ts.read_route(route)], 1.0)

    def run(names: list[str]) -> tuple[pd.DataFrame, dict[str, object], int]:
        map_plan = MapPlan.of_store(stores[0])
        own = own_factors(names)
        plan = plan_factors(map_plan, samples, tmp_path, looking, DEFAULT_MEMORY, own=own)
        outcomes = execute(plan, None, None)
        assert [outcome.reason for outcome in outcomes if not outcome.ok] == []
        (task,) = plan.outputs("factors")
        made = [outcome.made for outcome in outcomes if outcome.stage == "factors"]
        return *task.writes.read(), sum(made)

    plain, facts, made = run([])
    assert ("overhead" in plain, columns_in(facts), made) == (False, (), 1)
    rows, facts, made = run([overhead])
    assert made == 1
    assert [(c.name, c.factor_set) for c in columns_in(facts)] == [("overhead", "own")]
    assert rows["overhead"].between(0.0, 1.0, inclusive="neither").all()
    pd.testing.assert_frame_equal(rows.drop(columns="overhead"), plain, check_exact=True)
    assert run([overhead])[2] == 0
    Path(overhead).write_text(OVERHEAD.replace("+ 3.0", "+ 1.0"))
    again, _, made = run([overhead])
    assert made == 1
    assert (again["overhead"] > rows["overhead"]).all()


def test_models_learn_from_it_and_refuse_what_lacks_it(overhead: str, tmp_path: Path) -> None:
    (own,) = own_factors([overhead])
    factors, labels = model_data.drives(1, {"a": 120, "b": 120})
    factors["overhead"] = labels["error_mean"].to_numpy()
    making = {"cell_size": 2.0, "own": {"overhead": own.hash}}
    facts = {"own": [asdict(column) for column in own.columns]}
    found = samples.function(
        routes=[Stored(factors, facts)],
        factors=[Stored(factors.assign(sample=factors.index), facts)],
        observed=[],
        labels=[Stored(labels, {"data_set": {}})],
        groups={"factors": ["drive"], "observed": [], "labels": ["drive"]},
        making=making,
    )
    assert found.names[-1] == "overhead"
    file = DatasetFile(str(tmp_path / "dataset.parquet"))
    file.write(Made(found), "one", ())
    assert file.read().columns[-1] == own.columns[0]
    save_model(train(file.read(), recipe="forest"), tmp_path / "model.skops")
    model = load_model(tmp_path / "model.skops")
    assert "overhead" in model.factors
    assert check_making(model, making) == []
    with pytest.raises(ModelError, match=r"the factor overhead .* not among those of the job"):
        check_making(model, {"cell_size": 2.0})
    with pytest.raises(ModelError, match=r"the factor overhead .* another one now"):
        check_making(model, making | {"own": {"overhead": "other"}})
    with pytest.raises(ModelError, match=r"lacks factors .* overhead"):
        predict(model, factors.drop(columns="overhead"))


def test_a_model_without_it_takes_tables_with_it() -> None:
    model = train(model_data.dataset(1, lengths={"a": 120, "b": 120}), recipe="paper")
    assert check_making(model, {**model.made_with, "own": {"overhead": "x"}}) == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 +", "SyntaxError"),
        ("COLUMNS = ()\nREACH = 1\ndef factors(a): return {}", "give COLUMNS"),
        (OVERHEAD.replace("REACH = 10.0", "REACH = 1e9"), "REACH is 1000000000"),
        (OVERHEAD.replace('"overhead"', '"r_average"'), "r_average is there already"),
        (OVERHEAD.replace('"overhead"', '"x"'), "x is there already"),
    ],
)
def test_a_file_that_is_none_of_factors_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(UsageError, match=f"factors bad: .*{said}|factors bad: {said}"):
        own_factors([str(tmp_path / "bad.py")])


def test_names_are_found_or_refused(overhead: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceNotFoundError, match=r"none\.py: no such file of factors"):
        own_factors(["none.py"])
    with pytest.raises(UsageError, match="two columns are named overhead"):
        own_factors([overhead, overhead])
    monkeypatch.syspath_prepend(str(Path(overhead).parent))
    points = EntryPoints([EntryPoint("above", "overhead", owns.GROUP)])
    monkeypatch.setattr(owns, "entry_points", lambda group: points.select(group=group))
    (found,) = own_factors(["above"])
    assert (found.name, found.text) == ("above", OVERHEAD)
    with pytest.raises(SourceNotFoundError, match=r"below: .*installed are above"):
        own_factors(["below"])


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("    return {}", "returned nothing: return its COLUMNS, overhead"),
        ("    return 1 / 0", "ZeroDivisionError"),
    ],
)
def test_what_fails_says_where(body: str, said: str, stores: list[ts.TileStore]) -> None:
    text = OVERHEAD[: OVERHEAD.index("    above")] + body
    with pytest.raises(UsageError, match=f"factors mine at x 3.0, y 0.5 m.*{said}"):
        own_table([OwnFactors("mine", text)], stores[0], places(3.0), 2.0)


def test_a_job_names_it_and_its_making_says_so(
    stores: list[ts.TileStore], overhead: str, tmp_path: Path
) -> None:
    values = {
        "out": str(tmp_path),
        "map": {"store": stores[0].url},
        "routes": ["r.csv"],
        "model": {"recipe": "physics"},
    }
    plain, mine = (ts.RunSettings(**values, factors=names) for names in ([], [overhead]))
    assert "own" not in making_of(plain)
    assert making_of(mine)["own"] == {"overhead": own_factors([overhead])[0].hash}
    assert set(making_of(mine)) - set(making_of(plain)) == {"own"}
