"""Importance: how much each factor and criterion matters to the model, and to the paper's."""

import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.evaluation import criterion_importances, importances_of
from tilestream.model.forest import PaperForest
from tilestream.model.training import MAIN, Model
from tilestream.pipeline.engine.outputs import Made
from tilestream.pipeline.engine.stage import stage
from tilestream.pipeline.stages.samples import BYTES_PER_ROW, FOREST_BYTES
from tilestream.records import Column

WEIGHT_COLUMNS = (
    Column("model", "place", "", "`used`: the model in use; `paper`.", "", dtype="str"),
    Column("factor", "place", "", "The factor; empty: its whole criterion.", "", dtype="str"),
    Column("criterion", "place", "", "Its criterion.", "Table IV", dtype="str"),
    Column(
        "importance",
        "label",
        "1",
        "The regressor's own: they sum to 1, or to 0.",
        "impurity decrease",
    ),
    Column("factors", "label", "1", "Factors of the criterion.", ""),
    Column("increase", "label", "m", "Of the error when the criterion is permuted.", "held out"),
    Column("spread", "label", "m", "Standard deviation of that over repeats.", ""),
)


@stage(
    "importance",
    version=5,
    memory=lambda counts: FOREST_BYTES + BYTES_PER_ROW * counts["places"],
    seconds=100.0,
    columns=WEIGHT_COLUMNS,
)
def importance(dataset: Dataset, model: Model, seed: int) -> Made:
    """A row per factor and model with its importance, and one per criterion permuted.

    Args:
        dataset: what was measured.
        model: the one in use, trained on it.
        seed: of permutations and of what is fitted without held-out blocks.

    Raises:
        ModelError: nothing can be learnt from this dataset. Without two blocks there are no rows
            of criteria; a fact of the table says why.
    """
    dataset.check()
    dataset = dataset.averaged(model.width)
    used = dataset.with_columns([c for c in dataset.columns if c.name in model.factors])
    papers = dataset.with_columns([c for c in dataset.columns if c.factor_set == "faithful"])
    main, paper = model.regressors[MAIN], PaperForest.fit(papers, MAIN, seed)
    tables = [
        importances_of(main, used.columns).assign(model="used"),
        importances_of(paper, papers.columns).assign(model="paper"),
    ]
    reason = ""
    try:
        permuted = [
            criterion_importances(used, type(main), main.settings, MAIN, seed).assign(model="used"),
            criterion_importances(dataset, PaperForest, None, MAIN, seed).assign(model="paper"),
        ]
    except ModelError as error:
        reason = str(error)
    else:
        tables += [table.assign(factor="") for table in permuted]
    return Made(pd.concat(tables, ignore_index=True), {"reason": reason})
