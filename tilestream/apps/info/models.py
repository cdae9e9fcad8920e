"""What is in a model: what it was trained on, and for which vehicle."""

import os

from tilestream.apps.info.record import Info
from tilestream.model.card import card_told
from tilestream.model.file import load_model
from tilestream.settings import LogOptions

MADE_WITH = ("cell_size", "sensor_height", "map_leaf")
"""What of the making of its factors is told, besides the sensor."""


def described(path: str, _: LogOptions) -> Info:
    """A model: what it was trained on, and for which vehicle."""
    model = load_model(path)
    sensor = model.made_with.get("sensor", {})
    sensors = sensor.get("sensors", [sensor] if sensor else [])
    made = {name: model.made_with[name] for name in MADE_WITH if name in model.made_with}
    return Info(
        path=path,
        kind="model",
        format="model",
        size_bytes=os.stat(path).st_size,  # noqa: PTH116
        coverage={"factors": len(model.factors), "targets": len(model.regressors)},
        contents=[
            *(f"for {one['name']}" for one in sensors),
            *([] if sensors else [f"for {lidar}" for lidar in model.card.get("lidars", [])]),
            f"factors: {', '.join(model.factors)}",
            f"targets: {', '.join(model.regressors)}",
            *(f"{name}: {value}" for name, value in {**made, **model.facts}.items()),
            *(f"labels: {name}: {value}" for name, value in model.data_set.items()),
            *(f"card: {line}" for line in card_told(model.card)),
        ],
    )
