"""How fast a model is applied: rows per second of one core, by part.

    python benchmarks/predict.py [--rows N] [--share S] [--json FILE]
    python benchmarks/predict.py --run DIR [--json FILE]

Without a run: trains each regressor on synthetic drives as long as the paper's five paths, then
times `predict` on one core: the whole, and its parts.

With a finished run directory: the whole district's estimate, from its tables of factors to
GeoParquet, as the main job makes it: the model is loaded once, each tile's tables are read,
estimated and written, then all are gathered and written as the report does. The run directory is
not touched. The fixed cost of a tile is the intercept of a line through the times of all tiles.

Core-seconds (of the process, which has one thread), the smallest of three repeats each.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=20_000, help="places to estimate")
    parser.add_argument("--share", type=float, default=1.0, help="of the paths that are learnt")
    parser.add_argument("--run", type=Path, metavar="DIR", help="a finished run directory")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
import os
import sys
import time
from collections.abc import Callable
from tempfile import TemporaryDirectory

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import numpy as np
import pandas as pd
from model_data import LENGTHS, dataset, with_virtual_drives

from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.model.file import load_model, save_model
from tilestream.model.prediction import predict
from tilestream.model.registry import REGRESSORS
from tilestream.model.training import train
from tilestream.pipeline.engine.attempt import perform
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.stage import Product, Task
from tilestream.pipeline.jobs.run_done import Done
from tilestream.pipeline.jobs.run_findings import places_of
from tilestream.pipeline.stages import factors as factors_stage
from tilestream.pipeline.stages import observe as observe_stage
from tilestream.pipeline.stages import predict as predict_stage
from tilestream.pipeline.stages.samples import places_with_factors
from tilestream.pipeline.stages.train import ModelInUse
from tilestream.report import Findings
from tilestream.report.exports.tables import write_geoparquet
from tilestream.settings import PREDICTION_ERROR

REPEATS = 3


def seconds(work: Callable[[], object]) -> float:
    """Smallest time of some repeats [s]."""
    best = float("inf")
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return best


def measure(recipe: str, rows: int, share: float, file: Path) -> dict[str, float | str]:
    """Figures of one regressor, trained on the first part of each path."""
    lengths = {path: round(share * metres) for path, metres in LENGTHS.items()}
    begin = time.process_time()
    save_model(train(with_virtual_drives(dataset(0, lengths=lengths)), recipe=recipe), file)
    trained = time.process_time() - begin
    model = load_model(file)
    some = with_virtual_drives(dataset(1, lengths={"a": 2000})).rows
    table = pd.concat([some] * -(-rows // len(some)), ignore_index=True).iloc[:rows]
    X = table[list(model.factors)].to_numpy(np.float64)
    regressor, few = model.regressors["error_mean"], table[: rows // 10]
    return {
        "recipe": recipe,
        "train_s": trained,
        "file_mb": file.stat().st_size / 1e6,
        "load_s": seconds(lambda: load_model(file)),
        "predict_rows_per_s": rows / seconds(lambda: predict(model, table)),
        "error_mean_alone_rows_per_s": rows / seconds(lambda: regressor.predict(table)),
        "domain_rows_per_s": rows / seconds(lambda: model.domain.distance(X)),
        "contributions_rows_per_s": len(few) / seconds(lambda: regressor.contributions(few)),
    }


def tasks_of(run_dir: Path, out: Path) -> list[Task]:
    """The predict tasks of a finished run, as `plan_estimate` plans them, but written elsewhere."""
    model = ModelInUse.of(str(run_dir / "model.skops"))
    making = dict(model.read().made_with)
    tasks = []
    for factors in sorted((run_dir / "tables" / "factors").glob("*.parquet")):
        x, y = map(int, factors.stem.split("_"))
        around = [f"{x + i}_{y + j}" for i in (-1, 0, 1) for j in (-1, 0, 1)]
        tables = [run_dir / "tables" / "observability" / f"{name}.parquet" for name in around]
        observed = tuple(Product(Parquet(str(path)), "", ()) for path in tables if path.exists())
        tasks.append(
            Task(
                predict_stage.predict,
                factors.stem,
                Parquet(str(out / factors.name)),
                takes={"making": making, "offset": 0.0, "prediction_error": PREDICTION_ERROR},
                reads={
                    "model": model,
                    "factors": Product(Parquet(str(factors)), "", ()),
                    "observed": observed,
                },
                work=len(pd.read_parquet(factors, columns=["sample"])),
                tile=TileKey(x, y),
            )
        )
    return tasks


def measured(run_dir: Path, tasks: list[Task]) -> Done:
    """All tasks whose tables the report gathers: those that are applied, and what they read."""
    folders = ((factors_stage.factors, "factors"), (observe_stage.observe, "observability"))
    made = [
        Task(stage, path.stem, Parquet(str(path)))
        for stage, folder in folders
        for path in sorted((run_dir / "tables" / folder).glob("*.parquet"))
    ]
    return Done((*made, *tasks))


def district(run_dir: Path) -> dict[str, float | str]:
    """Figures of a whole run."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "predictions"
        tasks = tasks_of(run_dir, out)
        file = run_dir / "model.skops"
        model = load_model(file)
        perform(tasks[0], None)  # from here on the process holds the model, as a worker does

        def again(task: Task) -> None:
            (out / f"{task.name}.parquet").unlink(missing_ok=True)
            perform(task, None)

        def read(task: Task) -> pd.DataFrame:
            what = task.arguments()
            return places_with_factors([what["factors"]], what["observed"], model.width)

        points = np.array([task.work for task in tasks], np.float64)
        spent = np.array([seconds(lambda task=task: again(task)) for task in tasks])
        per_point, per_tile = np.polyfit(points, spent, 1)
        tables = [read(task) for task in tasks]
        done = measured(run_dir, tasks)
        parquet = Files.at(Path(folder) / "places.parquet")
        gather = seconds(lambda: write_geoparquet(parquet, Findings("all", places_of(done))))
        load = seconds(lambda: load_model(file))
        reading = seconds(lambda: [read(task) for task in tasks])
        alone = seconds(lambda: [predict(model, table) for table in tables])
        together = pd.concat(tables, ignore_index=True)
        at_once = seconds(lambda: predict(model, together))
    return {
        "run": str(run_dir),
        "points": points.sum(),
        "tiles": float(len(tasks)),
        "points_per_s_factors_to_geoparquet": points.sum() / (load + spent.sum() + gather),
        "load_s": load,
        "tiles_s": spent.sum(),
        "gather_and_write_geoparquet_s": gather,
        "fixed_ms_per_tile": 1e3 * per_tile,
        "ms_per_point_beside_it": 1e3 * per_point,
        "of_a_tile_reading_ms": 1e3 * reading / len(tasks),
        "of_a_tile_predict_ms": 1e3 * alone / len(tasks),
        "predict_alone_rows_per_s": points.sum() / at_once,
    }


def main(given: argparse.Namespace) -> None:
    """Measure and print."""
    if given.run:
        found = [district(given.run)]
    else:
        file = Path(os.environ.get("TMPDIR", "/tmp")) / f"predict-{os.getpid()}.skops"
        try:
            found = [measure(recipe, given.rows, given.share, file) for recipe in REGRESSORS]
        finally:
            file.unlink(missing_ok=True)
    for figures in found:
        print(
            "".join(
                f"{name:>36s} {value:>12.6g}\n" if not isinstance(value, str) else f"{value}\n"
                for name, value in figures.items()
            )
        )
    if given.json:
        given.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main(GIVEN)
