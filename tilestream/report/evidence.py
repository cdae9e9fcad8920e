"""The sections about the models: what they look at, and how good they are on unseen places."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from tilestream.forest.evaluation import PAPER_TABLE
from tilestream.forest.models import FORESTS, OPPONENTS, OTHERS
from tilestream.forest.protocols import PROTOCOLS
from tilestream.report.colours import ACTUAL, CRITERION, HELD_OUT, OTHER
from tilestream.report.findings import Findings
from tilestream.report.words import (
    DASH,
    bar,
    count,
    empty,
    esc,
    grouped_table,
    known,
    length,
    percent,
    plain_number,
    section,
    table,
)

NAMES = {
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
WEIGHED = {"used": "The forest in use", "paper": "The paper's forest"}
"""Whose importances are told."""
OURS = (*FORESTS, "physics")
"""What the claim is made for."""
MODELS = {
    "paper": "forest, the paper's setting",
    "default": "forest, tuned on held-out blocks",
    "physics": "the virtual drive in the map, without a forest",
    "pcr": "principal component regression",
    "mlp": "multi-layer perceptron",
    "svr": "support vector regression",
    "sgd": "linear, stochastic gradient descent",
    "training median": "the training median everywhere",
    "path median": "the median of the same path",
    "nearest training point": "the nearest training point",
    "footprint forest": "forest on seven 2-D factors: directions of walls, azimuths",
}
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
AGAIN = "a second drive over the same places"
FIGURES = ("MAE", "RMSE", "&lt; 2.5 cm", "&lt; 5 cm", "R²", "skill", "Spearman")
LEAKING = "paper"
"""The protocol whose figures prove nothing."""
LEAKS = '<span class="mark">leaks</span>'


def importances(found: Findings) -> str:
    """What the forest in use looks at, and what the paper's does."""
    meaning = (
        "How much of what a forest explains of its own training points it explains by each factor, "
        "first of the forest that made the estimates, then of the paper's beside its Fig. 14. "
        "Factors that say the same share it, so the tables by criterion are the honest ones: how "
        "much worse unseen blocks are estimated when all factors of a criterion are shuffled."
    )
    parts = []
    if found.importances.empty:
        parts.append(empty("No forest was trained in this run: it has no importances."))
    elif found.criterion_importances.empty:
        parts.append(empty("No permutation by criterion: there were no held-out blocks to judge."))
    for model, name in WEIGHED.items():
        for title, table_, told in (
            ("by factor", found.importances, _of_factors),
            ("by criterion, on held-out blocks", found.criterion_importances, _of_criteria),
        ):
            part = table_[table_["model"] == model] if len(table_) else table_
            if len(part):
                factors = len(part) if told is _of_factors else int(part["factors"].sum())
                parts.append(f"<h3>{name} on {factors} factors, {title}</h3>{told(part)}")
    return section("importances", "What drives the estimates", meaning, "".join(parts))


def _of_factors(found: pd.DataFrame) -> str:
    papers = set(found["factor"]) <= set(PAPER_IMPORTANCES)
    ranked = found.sort_values("importance", ascending=False, kind="stable")
    largest = float(ranked["importance"].max()) or 1.0
    rows = []
    for row in _records(ranked):
        name, criterion = str(row["factor"]), str(row["criterion"])
        colour = CRITERION.get(criterion, OTHER)
        cells = [
            f"<code>{esc(name)}</code>",
            _dot(colour) + f"{esc(criterion)} {NAMES.get(criterion, '')}",
            bar(float(row["importance"]) / largest, colour),
            f"{row['importance']:.3f}",
        ]
        rows.append([*cells, f"{PAPER_IMPORTANCES[name]:.2f}"] if papers else cells)
    head = ["factor", "criterion", "", "importance", *(["the paper's"] if papers else [])]
    return table(head, rows, "bars named")


def _dot(colour: str) -> str:
    return f'<span class="dot" style="background:{colour}"></span>'


def _of_criteria(found: pd.DataFrame) -> str:
    largest = max(float(found["increase"].max()), 1e-9)
    rows = [
        [
            f"{esc(r['criterion'])} {NAMES.get(str(r['criterion']), '')}",
            count(r["factors"]),
            bar(float(r["increase"]) / largest, CRITERION.get(str(r["criterion"]), OTHER)),
            f"{length(r['increase'], 2)} ± {length(r['spread'], 2)}",
        ]
        for r in _records(found)
    ]
    head = ["criterion", "factors", "", "mean error grows by"]
    return table(head, rows, "bars")


def table_iv(found: Findings) -> str:
    """The paper's Table IV beside ours."""
    meaning = (
        "What each criterion adds to the one before. The paper's figures are of a random split at "
        "1 m spacing, where every judged point has a neighbour that trained: the rows marked "
        f"{LEAKS} are comparable with them and prove nothing; the others do."
    )
    if found.table_iv.empty:
        body = empty(f"{_not_judged(found)} The paper's own figures stand alone.")
    else:
        body = ""
    head = ["factors", *FIGURES]
    several = not found.table_iv.empty and len(set(found.table_iv["model"].dropna())) > 1
    groups = [
        (
            f"the paper, random split {LEAKS}",
            [[esc(r["factors"]), *_figures(r)] for r in _records(PAPER_TABLE)],
        )
    ]
    for protocol, rows in _by_protocol(found.table_iv):
        cells = [[_factors(r, several), *_figures(r)] for r in rows if _judged(r)]
        groups.append((_protocol_name(protocol), cells or [_not_followed(rows, len(head))]))
    return section("table-iv", "Table IV", meaning, body + grouped_table(head, groups, "figures"))


def _not_judged(found: Findings) -> str:
    """Why nothing was judged."""
    if found.labels.empty:
        return "There were no labels, so nothing can be judged: the estimates rest on the model."
    return (
        "Nothing was trained on the labels of this run, so no models were judged against each "
        "other; the estimates stand beside what was measured."
    )


def _factors(row: Mapping[str, Any], several: bool) -> str:
    """The factor set, and the model where there are several."""
    return esc(row["factors"]) + (f", {_model(row['model'])}" if several else "")


def protocols(found: Findings) -> str:
    """Every competitor on every protocol, and the ceiling."""
    meaning = (
        "A claim counts only where it beats the opponents, which know no factors or only those of "
        "a 2-D plan, on places that the model has not seen; the ceiling is how well a second drive "
        "over the same places estimates the first."
    )
    if found.protocols.empty:
        return section(
            "protocols", "How good the estimates are", meaning, empty(_not_judged(found))
        )
    parts = [_protocol(name, rows, found.model) for name, rows in _by_protocol(found.protocols)]
    if "error_mean" not in found.ceilings:
        parts.append(empty("No place was driven twice in this run, so no ceiling is known."))
    else:
        cells = [[AGAIN, *_figures(found.ceilings["error_mean"])]]
        text = "<p>Two measurements of one place differ by this much: no map can tell more.</p>"
        parts.append(f"<h3>the ceiling</h3>{text}" + table(["", *FIGURES], cells, "figures"))
    parts.append(_parts(found))
    return section("protocols", "How good the estimates are", meaning, "".join(parts))


def _parts(found: Findings) -> str:
    """How well the parts of the error are estimated on paths left out, beside a repeated drive."""
    title = "<h3>the parts of the error, on paths left out</h3>"
    rows = [row for name, rows in _by_protocol(found.parts) if name == "path" for row in rows]
    if not rows:
        return title + empty("Not judged in this run.")
    head = ["part", "MAE", "skill", "Spearman"]
    groups = []
    for target, meaning in PARTS.items():
        here = [row for row in rows if row["target"] == target]
        cells = [[_model(row["model"]), *_of_part(target, row)] for row in here if _judged(row)]
        if cells and target in found.ceilings:
            cells.append([AGAIN, *_of_part(target, found.ceilings[target])])
        if here:
            groups.append((meaning, cells or [_not_followed(here, len(head))]))
    text = (
        "<p>The skill is that over the training median; a part that a second drive cannot tell "
        "either is chance, not the map's.</p>"
    )
    return title + text + grouped_table(head, groups, "figures")


def _of_part(target: str, row: Mapping[str, Any]) -> list[str]:
    error = percent(row["mae"], 2) if target == "p_fail" else length(row["mae"], 2)
    return [error, plain_number(row.get("skill")), plain_number(row.get("spearman"))]


def _protocol(name: str, rows: list[dict[str, Any]], model: str) -> str:
    meaning = next((p.meaning for p in PROTOCOLS if p.name == name), "")
    text = f"<h3>{_protocol_name(name)}</h3><p>{esc(meaning)} "
    judged = [r for r in rows if _judged(r)]
    if not judged:
        why = esc(rows[0].get("reason") or "no reason given")
        return f"{text}</p>" + empty(f"Not followed in this run: {why}.")
    head = ["model", *FIGURES]
    groups = []
    for title, kind in (
        ("ours", OURS),
        ("the paper's other models", OTHERS),
        ("opponents", OPPONENTS),
    ):
        of_kind = [r for r in judged if r["model"] in kind]
        if of_kind:
            groups.append((title, [[_model(r["model"]), *_figures(r)] for r in of_kind]))
    rest = [r for r in judged if r["model"] not in {*OURS, *OTHERS, *OPPONENTS}]
    if rest:
        groups.append(("others", [[_model(r["model"]), *_figures(r)] for r in rest]))
    verdict = "" if name == LEAKING else _verdict(judged, model)
    return f"{text}{verdict}</p>" + grouped_table(head, groups, "figures")


def _verdict(judged: list[dict[str, Any]], model: str) -> str:
    """Whether the model that made the estimates beats the best opponent, by mean absolute error;
    and which of ours is better than it.
    """
    errors = {str(r["model"]): float(r["mae"]) for r in judged}
    opponents = [name for name in errors if name in OPPONENTS]
    if model not in errors or not opponents:
        return ""
    rival = min(opponents, key=lambda name: errors[name])
    points = next(r["points"] for r in judged if r["model"] == model)
    text = (
        f"<b>The model of these estimates ({length(errors[model], 2)}, {_model(model)}) "
        f"{'beats' if errors[model] < errors[rival] else 'does not beat'} "
        f"the best opponent ({length(errors[rival], 2)}, {_model(rival)})</b> by mean "
        f"absolute error, over {count(points)} points."
    )
    best = min((name for name in errors if name in OURS), key=lambda name: errors[name])
    if errors[best] < errors[model]:
        text += (
            f" Better here than the model in use: {_model(best)} ({length(errors[best], 2)}; "
            f"<code>model.recipe: {best}</code>)."
        )
    return text


def _model(name: object) -> str:
    return MODELS.get(str(name), esc(name))


def _protocol_name(name: str) -> str:
    return f"{PROTOCOL_NAMES.get(name, esc(name))}{' ' + LEAKS if name == LEAKING else ''}"


def _by_protocol(found: pd.DataFrame) -> list[tuple[str, list[dict[str, Any]]]]:
    if found.empty:
        return []
    return [(str(name), _records(part)) for name, part in found.groupby("protocol", sort=False)]


def _records(found: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(k): v for k, v in row.items()} for row in found.to_dict("records")]


def _judged(row: Mapping[str, Any]) -> bool:
    return known(row.get("mae"))


def _not_followed(rows: list[dict[str, Any]], width: int) -> list[str]:
    why = esc(rows[0].get("reason") or "no reason given")
    return [f"not followed: {why}", *([DASH] * (width - 1))]


def _figures(row: Mapping[str, Any]) -> list[str]:
    return [
        length(row["mae"], 2),
        length(row["rmse"], 2),
        percent(row["within_25mm"]),
        percent(row["within_50mm"]),
        plain_number(row.get("r2")),
        plain_number(row.get("skill")),
        plain_number(row.get("spearman")),
    ]


def calibration(found: Findings) -> str:
    """Whether intervals hold what they promise, path by path."""
    meaning = (
        "An interval that promises nine of ten is to hold nine of ten on paths that it was not "
        "calibrated on: fewer is too narrow, more is wider than need be. The bar is what it held, "
        "the line what was promised."
    )
    if found.coverage.empty:
        why = "No interval was checked: that takes a model trained here, on several paths."
        return section("calibration", "Do the intervals hold", meaning, empty(why))
    rows = [
        [
            esc(r["path"]),
            count(r["points"]),
            percent(r["level"]),
            percent(r["covered"]),
            _gauge(r["covered"], r["level"]),
            f"f = {r['factor']:.2f}" if known(r["factor"]) else "not calibrated",
        ]
        for r in _records(found.coverage)
    ]
    head = ["path", "points", "promised", "held", "", "from estimate / f to estimate × f"]
    body = _promise(found.coverage) + table(head, rows, "bars")
    return section("calibration", "Do the intervals hold", meaning, body)


def _promise(coverage: pd.DataFrame) -> str:
    """What was promised and what was held, every point counting the same; "" if none is judged."""
    judged = coverage[coverage["covered"].notna()]
    if judged.empty:
        return ""
    held = float((judged["covered"] * judged["points"]).sum() / judged["points"].sum())
    low, high = float(judged["covered"].min()), float(judged["covered"].max())
    return (
        f"<p><b>Promised {percent(judged['level'].mean(), 0)}, held {percent(held)} on average, "
        f"{percent(low)} to {percent(high)} by path.</b></p>"
    )


def _gauge(covered: Any, level: Any) -> str:
    if not (known(covered) and known(level)):
        return DASH
    mark = f'<u style="left:{100.0 * level:.1f}%;background:{HELD_OUT}"></u>'
    return bar(float(covered), ACTUAL).replace("</span>", f"{mark}</span>")
