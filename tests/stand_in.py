"""A small model in the place of the one that ships: over two lidars, on made-up places."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import model_data

import tilestream as ts
from tilestream.model.file import save_model
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_settings import RunSettings

LENGTHS = {"a": 240, "b": 240, "c": 240}
CHECKED = {
    "real drives": {
        "places": 431,
        "drives": 5,
        "spearman": [0.41, 0.3, 0.52],
        "level": {"VLP16": 0.8, "HDL64": 1.25},
        "coverage": [0.84, 0.03],
    },
    "held-out paths": {"places": 9000, "skill": [0.3, 0.25, 0.35], "mae_m": 0.021},
    "held-out lidar": {"places": 9000, "skill": [0.2, 0.1, 0.3], "mae_m": 0.024},
}
"""What the card says of how it was checked."""


def write(path: Path, settings: RunSettings, checked: Mapping[str, Any] | None = None) -> Path:
    """Write a model that fits a job, and its like with other lidars.

    Args:
        path: the file.
        settings: the job.
        checked: the entry of its card; None: none.
    """
    own = making_of(settings)
    other = {"sensor": ts.HDL64.model_dump(mode="json"), "sensor_height": 1.7}
    seen = {"seeing": {**own["seeing"], "range_max": 80.0}}
    runs = {}
    for seed, (name, making) in enumerate({"own": own, "other": own | other | seen}.items()):
        found = model_data.with_virtual_drives(model_data.dataset(seed, 0.7, LENGTHS), seed=seed)
        found = found.with_columns([c for c in found.columns if not c.name.startswith("ob_")])
        identity = {"as_sensor": "as recorded", "true_pose": "log"}
        runs[name] = replace(found, made_with=making, data_sets={"drive": identity})
    model = ts.train_over(runs, recipe="physics")
    card = {**model.card, **({} if checked is None else {"checked": checked})}
    save_model(replace(model, card=card), path)
    return path
