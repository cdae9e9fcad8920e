"""What the page says about the models: which there are, and how good each is on unseen places."""

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from tilestream.model.registry import COMPETITORS
from tilestream.model.regressor import Kind
from tilestream.model.splits import PROTOCOLS
from tilestream.report.formatting import known

Row = Mapping[str, Any]

CRITERIA = {
    "FS": "feature sufficiency",
    "RQ": "representation quality",
    "LY": "layout",
    "LS": "local similarity",
    "OB": "observability",
}
PAPER_IMPORTANCES = {
    "feature_count": 0.01, "D1_count": 0.01, "D2_count": 0.02, "D3_count": 0.02,
    "D1_ratio": 0.05, "D2_ratio": 0.01, "D3_ratio": 0.02, "occupancy_ratio": 0.04,
    "euclidean_dist": 0.03, "mahalanobis_dist": 0.02,
    "r_average": 0.02, "normal_H_8": 0.05, "normal_H_16": 0.05, "normal_H_90": 0.03,
    "angular_H": 0.16, "FDOP": 0.03,
    "score_H": 0.02, "pfh_sim_H": 0.10, "pfh_sim_mnht": 0.06, "bhatt_sim": 0.23,
}  # fmt: skip
"""The last column of the paper's Table IV."""
KINDS: dict[str, list[str]] = {
    kind: [name for name, one in COMPETITORS.items() if one.kind == kind] for kind in get_args(Kind)
}
"""Models by what they stand for."""
OURS, OPPONENTS = KINDS["ours"], KINDS["opponents"]
"""What the claim is made for, and what it must beat."""
MODELS = {name: one.words for name, one in COMPETITORS.items()}
"""What a competitor is, in words."""
PROTOCOL_NAMES = {
    "paper": "random split",
    "path": "leave one path out",
    "blocks": "held-out blocks",
}
PARTS = {
    "error_tail": "tail: what starts farther than 1 m add",
    "error_floor": "floor: what starts within 1 m end with",
    "along_mean": "along the road",
    "across_mean": "across the road",
    "up_mean": "in height",
    "p_fail": "share of the starts that fail",
}
"""The targets beside the mean error, in words."""
LEAKING = "paper"
"""The protocol whose figures prove nothing."""


def evaluated(rows: Sequence[Row]) -> list[Row]:
    """The rows that have figures; the others have a reason."""
    return [row for row in rows if known(row.get("mae"))]


def by_protocol(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of `summary` by their protocol, in the order in which they come."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["protocol"], []).append(row)
    return found


def by_kind(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows with figures by the kind of their model: `KINDS`, and `others`."""
    found: dict[str, list[Row]] = {kind: [] for kind in (*KINDS, "others")}
    for row in rows:
        kinds = (kind for kind, names in KINDS.items() if row["model"] in names)
        found[next(kinds, "others")].append(row)
    return {kind: part for kind, part in found.items() if part}


def meaning_of(protocol: str) -> str:
    """A sentence on what a protocol's figures mean; empty for one that is not ours."""
    return next((p.meaning for p in PROTOCOLS if p.name == protocol), "")


def verdict(rows: Sequence[Row], model: str) -> dict[str, Any] | None:
    """Whether the model that made the estimates beats the best opponent, by mean absolute error.

    Args:
        rows: of one protocol, with figures.
        model: which of them made the estimates.

    Returns:
        The rows of the model (`used`), the best opponent (`rival`) and ours that is better than
        the model (`better`, or None), and whether it `beats` the opponent; None where there is
        nothing to compare.
    """
    errors = {row["model"]: row for row in rows}
    opponents = [row for name, row in errors.items() if name in OPPONENTS]
    if model not in errors or not opponents:
        return None
    used, rival = errors[model], min(opponents, key=_mae)
    best = min((row for name, row in errors.items() if name in OURS), key=_mae, default=used)
    return {
        "used": used,
        "rival": rival,
        "beats": used["mae"] < rival["mae"],
        "better": best if best["mae"] < used["mae"] else None,
    }


def _mae(row: Row) -> float:
    return float(row["mae"])


def on_all(coverage: Sequence[Row]) -> Row | None:
    """What intervals held on all points (the row without a path), and `low` and `high` by path;
    None where no path was evaluated.
    """
    rows = [row for row in coverage if row["path"] and known(row["covered"])]
    every = [row for row in coverage if not row["path"] and known(row["covered"])]
    if not rows or not every:
        return None
    covered = [row["covered"] for row in rows]
    return {**every[0], "low": min(covered), "high": max(covered)}


def worth(row: Row) -> str:
    """What a paired difference says, in words."""
    low, high = row["skill_low"], row["skill_high"]
    if not (known(low) and known(high)):
        return "not known: one block"
    if low > 0.0:
        return "better"
    return "worse" if high < 0.0 else "no difference that is sure"
