"""What the evaluations of a run say, as the tables of its report."""

from collections.abc import Mapping, Sequence

import pandas as pd

from tilestream.errors import ModelError
from tilestream.model.dataset import Dataset
from tilestream.model.evaluation import differences_by_protocol, figures_by_protocol
from tilestream.model.intervals import coverage
from tilestream.model.registry import REGRESSORS, UNTRAINED
from tilestream.model.repeats import repeated
from tilestream.model.training import MAIN


def evaluation_of(
    found: Mapping[tuple[str, str, str], Mapping[str, pd.DataFrame | str]],
    sets: Sequence[str],
    recipe: str,
) -> dict[str, pd.DataFrame]:
    """Evaluations as tables: `protocols`, `table_iv`, `coverage`, `parts` for other targets, and
    `differences` between the model in use and physics.

    Args:
        found: what was evaluated (`Done.evaluations`).
        sets: the factor sets of Table IV in its order; the last has all factors.
        recipe: the model in use.
    """
    rows = {key: figures_by_protocol(points, key[1]) for key, points in found.items()}
    protocols = [
        table for (target, _, chosen), table in rows.items() if (target, chosen) == (MAIN, "")
    ]
    stored_as = {name: "" if name == sets[-1] else name for name in sets}
    four = [
        rows[MAIN, model, chosen].assign(factors=name)
        for model in REGRESSORS
        for name, chosen in stored_as.items()
        if (MAIN, model, chosen) in rows
    ]
    parts = [table.assign(target=t) for (t, _, _), table in rows.items() if t != MAIN]
    differences = [
        differences_by_protocol(points, found[target, UNTRAINED, ""]).assign(target=target)
        for (target, model, chosen), points in found.items()
        if (model, chosen) == (recipe, "") and recipe != UNTRAINED
        if (target, UNTRAINED, "") in found
    ]
    held = found.get((MAIN, recipe, ""), {}).get("path", "")
    return {
        "protocols": _joined(protocols),
        "table_iv": _joined(four),
        "parts": _joined(parts),
        "differences": _joined(differences),
        "coverage": pd.DataFrame() if isinstance(held, str) else coverage(held),
    }


def _joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def ceilings(dataset: Dataset | None, targets: Sequence[str]) -> dict[str, dict[str, float]]:
    """What a repeated drive knows of each target, and what any estimate could know (`repeated`);
    empty without one.
    """
    found: dict[str, dict[str, float]] = {}
    for target in targets:
        if dataset is not None and target in dataset.rows:
            try:
                found[target] = repeated(dataset, target)
            except ModelError:
                return {}
    return found
