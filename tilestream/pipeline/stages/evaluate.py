"""Evaluate: cross-validate one competitor, on every protocol."""

import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.evaluation import cross_validate, factor_sets
from tilestream.model.splits import PROTOCOLS
from tilestream.pipeline.engine.outputs import Made, Stored
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.samples import BYTES_PER_ROW, DATASET_COLUMNS, FOREST_BYTES
from tilestream.records import Column

HELD_OUT_COLUMNS = (
    *DATASET_COLUMNS,
    Column(
        "protocol",
        "place",
        "",
        "What is held out, and what trains.",
        "definitions, section 6",
        dtype="str",
    ),
    Column("row", "place", "1", "Row of the dataset.", "", dtype="int64"),
    Column("fold", "place", "", "What was held out.", "", dtype="str"),
    Column("arc_length", "place", "m", "Length of the route up to here.", ""),
    Column("actual", "label", "", "What was measured, in the unit of the target.", ""),
    Column("estimate", "label", "", "By a model that had not seen it.", "definitions, section 6"),
    Column("median", "label", "", "Of what that model was trained on.", "definitions, section 6"),
)


@stage(
    "evaluate",
    version=6,
    memory=lambda counts: FOREST_BYTES + BYTES_PER_ROW * counts["places"],
    seconds=45.0,
    columns=HELD_OUT_COLUMNS,
)
def evaluate(dataset: Dataset, competitor: str, target: str, factor_set: str, seed: int) -> Made:
    """The held-out points of every protocol with their estimates, or why there are none.

    All drives of a path are held out together, and a model is evaluated on as many drives as it is
    trained on: all of them.

    Args:
        dataset: what was measured.
        competitor: which model or opponent.
        target: what is estimated.
        factor_set: name of the factors it may use (`evaluation.factor_sets`); empty: all.
        seed: of what is random.
    """
    if factor_set:
        dataset = dataset.with_columns(factor_sets(dataset.columns)[factor_set])
    try:
        dataset.check(target)
    except ModelError as error:  # stands beside the figures; training fails for it
        found: dict[str, pd.DataFrame | str] = {p.name: str(error) for p in PROTOCOLS}
    else:
        found = cross_validate(dataset, competitor, target, seed)
    parts = [p.assign(protocol=name) for name, p in found.items() if not isinstance(p, str)]
    reasons = {name: why for name, why in found.items() if isinstance(why, str)}
    frame = pd.concat(parts, ignore_index=True) if parts else _NOTHING_HELD_OUT
    return Made(frame, {"reasons": reasons, "competitor": competitor})


_NOTHING_HELD_OUT = pd.DataFrame(
    {
        column.name: pd.Series(dtype=column.dtype)
        for column in HELD_OUT_COLUMNS
        if column.name != "distance"
    }
)


def by_protocol(table: Stored) -> dict[str, pd.DataFrame | str]:
    """What was evaluated, as `cross_validate` gives it."""
    found: dict[str, pd.DataFrame | str] = dict(table.facts["reasons"])
    for name, part in table.rows.groupby("protocol", sort=False):
        found[str(name)] = part.drop(columns="protocol").reset_index(drop=True)
    return found
