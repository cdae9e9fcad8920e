"""The catalogue of all factor columns: docs, checks and reports are made from this one table."""

from typing import Literal

from tilestream.factors import (
    feature_sufficiency,
    layout,
    local_similarity,
    representation_quality,
)
from tilestream.records import Column

Which = Literal["faithful", "robust", "all"]

CRITERIA = feature_sufficiency, representation_quality, layout, local_similarity
"""In the order of the paper's Table IV."""
COLUMNS: tuple[Column, ...] = tuple(
    column
    for factor_set in ("faithful", "robust")
    for criterion in CRITERIA
    for column in criterion.COLUMNS
    if column.factor_set == factor_set
)
"""All columns: the paper's 20 in the order of the definitions, then their robust twins."""
COUNTS = frozenset({"feature_count", "D1_count", "D2_count", "D3_count"})
"""Columns that are 0, not NaN, where the vicinity is empty."""


def columns_of(which: Which) -> tuple[Column, ...]:
    """The columns of the paper's set, of the robust one, or of both."""
    return tuple(column for column in COLUMNS if which in ("all", column.factor_set))


def markdown() -> str:
    """The catalogue as a Markdown table."""
    rows = ["| column | criterion | set | unit | meaning | formula |", "|---|---|---|---|---|---|"]
    for c in COLUMNS:
        formula = c.source.replace("|", "\\|")
        rows.append(
            f"| `{c.name}` | {c.criterion} | {c.factor_set} | {c.unit} | {c.meaning} | {formula} |"
        )
    return "\n".join(rows) + "\n"
