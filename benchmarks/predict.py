"""How fast a model is applied: rows per second of one core, by part.

    python benchmarks/predict.py [--rows N] [--json FILE]

Trains both recipes on synthetic drives as long as the paper's five paths, then times `predict` on
one core: the whole, and its parts. Smallest of three repeats each.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
from forest_data import COLUMNS, dataset, drives  # noqa: E402

from tilestream.forest.model_file import load_model, save_model  # noqa: E402
from tilestream.forest.reasons import contributions  # noqa: E402
from tilestream.forest.training import predict, train  # noqa: E402

REPEATS = 3


def seconds(work: Callable[[], object]) -> float:
    """Smallest time of some repeats [s]."""
    best = float("inf")
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begin)
    return best


def measure(recipe: str, rows: int, file: Path) -> dict[str, float | str]:
    """Figures of one recipe."""
    begin = time.perf_counter()
    save_model(train(dataset(0), recipe=recipe), file)
    trained = time.perf_counter() - begin
    model = load_model(file)
    some = drives(1, {"a": 2000})[0]
    table = pd.concat([some] * -(-rows // len(some)), ignore_index=True).iloc[:rows]
    X = table[[column.name for column in COLUMNS]].to_numpy(np.float64)
    forest, few = model.forests["error_mean"], X[: rows // 10]
    return {
        "recipe": recipe,
        "train_s": trained,
        "file_mb": file.stat().st_size / 1e6,
        "load_s": seconds(lambda: load_model(file)),
        "predict_rows_per_s": rows / seconds(lambda: predict(model, table)),
        "error_mean_alone_rows_per_s": rows / seconds(lambda: forest.estimate(X)),
        "domain_rows_per_s": rows / seconds(lambda: model.domain.distance(X)),
        "contributions_rows_per_s": len(few) / seconds(lambda: contributions(forest.trees, few)),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    file = Path(os.environ.get("TMPDIR", "/tmp")) / f"predict-{os.getpid()}.skops"
    try:
        found = [measure(recipe, options.rows, file) for recipe in ("default", "paper")]
    finally:
        file.unlink(missing_ok=True)
    for figures in found:
        print(
            "".join(
                f"{name:>30s} {value:>12.6g}\n" if not isinstance(value, str) else f"{value}\n"
                for name, value in figures.items()
            )
        )
    if options.json:
        options.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
