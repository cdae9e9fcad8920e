"""The sections of the page, in its order; each says what it means, also where it is empty."""

import base64
from collections.abc import Mapping
from typing import Any

import pandas as pd

from tilestream.forest.evaluation import PAPER_TABLE
from tilestream.forest.models import FORESTS, OPPONENTS, OTHERS
from tilestream.forest.protocols import PROTOCOLS
from tilestream.report.charts import shown_every
from tilestream.report.colours import ACTUAL, CLIP, CRITERION, HELD_OUT, OTHER
from tilestream.report.findings import AROUND, Findings
from tilestream.report.judgement import APART
from tilestream.report.pictures import ABOVE, BELOW, heights_ramp
from tilestream.report.words import (
    DASH,
    bar,
    count,
    esc,
    grouped_table,
    known,
    length,
    percent,
    plain_number,
    road,
    span,
    table,
)

MOST_REASONS = 8
"""Reasons for missing estimates that are listed; the rest is summed up."""
MOST_SEGMENTS = 15
"""Segments that the page lists; the file has all."""
MOST_PATHS = 24
"""Labelled paths that have a chart."""
MOST_ROUTES = 40
"""Routes that the page lists, the worst by their 95 % quantile; `report.json` has all."""
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
    "footprint forest": "forest on seven 2-D factors",
}
"""What a competitor is, in words."""
PROTOCOL_NAMES = {
    "paper": "random split",
    "path": "leave one path out",
    "blocks": "held-out blocks",
}
FIGURES = ("MAE", "RMSE", "&lt; 2.5 cm", "&lt; 5 cm", "R²", "skill", "Spearman")
LEAKING = "paper"
"""The protocol whose figures prove nothing."""
LEAKS = '<span class="mark">leaks</span>'


def section(name: str, title: str, meaning: str, body: str) -> str:
    """A section of the page: a heading, what it means in a sentence, and its content."""
    return (
        f'<section id="{name}"><h2>{title}</h2><p class="meaning">{meaning}</p>{body}</section>\n'
    )


def empty(why: str) -> str:
    """What stands where there is nothing to show."""
    return f'<p class="empty">{why}</p>'


def headline(content: Mapping[str, Any]) -> str:
    """The figures that a map team asks for first."""
    head, limit = content["headline"], length(content["threshold"], 0)
    over = f"{percent(head['over_share'])} over {limit}"
    cards = [
        (road(head["length"]), f"of road, {count(head['places'])} sample points"),
        (length(head["median"]), "median estimated error"),
        (length(head["p95"]), "95 % of the places are estimated below this"),
        (length(head["max"]), "the highest estimate"),
        (
            percent(head["over_share"]),
            f"of the places over {limit}: {road(head['over_length'])} of road",
        ),
        (percent(head["outside_share"]), "of the places unlike the training places"),
        (count(head["labelled"]), "measured errors to train on and to judge by"),
        (count(head["missing"]), f"places without an estimate ({percent(head['missing_share'])})"),
    ]
    body = '<div class="cards">' + "".join(
        f'<div class="card"><b>{figure}</b><span>{what}</span></div>' for figure, what in cards
    )
    body += "</div>" + _missing(head) + _routes(content, limit)
    if not head["estimated"]:
        meaning = "No place has an estimate; below is why."
    else:
        meaning = (
            f"Half of the places are estimated below {length(head['median'])}, and {over}; an "
            "estimate is the mean 3D error that a vehicle's scan matching is expected to have "
            "there."
        )
    return section("headline", "In short", meaning, body)


def _missing(head: Mapping[str, Any]) -> str:
    reasons = list(head["missing_by_reason"].items())
    if not reasons:
        return empty("Every place has an estimate.")
    rows = [[esc(reason), count(number)] for reason, number in reasons[:MOST_REASONS]]
    if rest := reasons[MOST_REASONS:]:
        rows.append([f"{len(rest)} other reasons", count(sum(number for _, number in rest))])
    return "<h3>Places without an estimate</h3>" + table(["why", "places"], rows, "narrow")


def _routes(content: Mapping[str, Any], limit: str) -> str:
    head = ["route", "length", "places", "median", "95 %", "highest", f"over {limit}", "unlike",
            "no estimate"]  # fmt: skip
    rows = [
        [
            esc(r["route_id"]),
            road(r["length"]),
            count(r["places"]),
            length(r["median"]),
            length(r["p95"]),
            length(r["max"]),
            percent(r["over_share"]),
            percent(r["outside_share"]),
            count(r["missing"]),
        ]
        for r in _listed(content["routes"])
    ]
    more = len(content["routes"]) - len(rows)
    note = f"<p>{more} routes with lower estimates are in <code>report.json</code>.</p>"
    return "<h3>By route</h3>" + table(head, rows) + (note if more else "")


def _listed(routes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    if len(routes) <= MOST_ROUTES:
        return routes
    return sorted(routes, key=lambda r: (-(r["p95"] or 0.0), r["route_id"]))[:MOST_ROUTES]


def city_map(found: Findings, content: Mapping[str, Any]) -> str:
    """The map, coloured by estimate."""
    every = shown_every(found.places)
    meaning = (
        "Every dot is a sample point, coloured and sized by its estimated error; colours end at "
        f"the {percent(CLIP, 0)} quantile of the estimates, and what lies above has the last "
        "colour. Point at one for its interval and reason (of several, the worst is shown); click "
        "a name in the legend to hide it."
    )
    if every > 1:
        meaning += f" Each dot stands for {every} consecutive sample points and shows the worst."
    body = '<div class="chart" id="city-map"></div>' + _segments(content)
    return section("map", "The map", meaning, body)


def _segments(content: Mapping[str, Any]) -> str:
    limit, found = length(content["threshold"], 0), content["segments"]
    title = f"<h3>Stretches over {limit}</h3>"
    if not found:
        return title + empty(f"No estimate exceeds {limit}.")
    ranked = sorted(found, key=lambda s: (-s["worst"], s["route_id"], s["begin"]))
    rows = [
        [
            esc(s["route_id"]),
            f"{s['begin']:.0f} to {s['end']:.0f} m",
            road(s["length"]),
            length(s["worst"]),
            length(s["mean"]),
            percent(s["p_fail"]),
            esc(s["reason"]) or DASH,
        ]
        for s in ranked[:MOST_SEGMENTS]
    ]
    head = ["route", "from, to", "length", "worst", "mean", "starts that fail", "why at its worst"]
    more = len(found) - len(rows)
    note = f"<p>{more} more are in <code>over_threshold.geojson</code>.</p>" if more else ""
    return title + table(head, rows, "words") + note


def worst(content: Mapping[str, Any], pictures: Mapping[int, bytes | str]) -> str:
    """The worst places in words and from above.

    Args:
        content: the summary.
        pictures: PNG by number of the place, or why there is none.
    """
    rows = [
        [
            str(number),
            f"<b>{esc(p['route_id'])}</b>, {p['arc_length']:.0f}\u00a0m along" + _small(_at(p)),
            f"<b>{length(p['estimate'])}</b>",
            span(p["low"], p["high"]),
            percent(p["p_fail"]),
            "yes" if p["in_domain"] else "no",
            esc(p["reason"] or "") or DASH,
        ]
        for number, p in enumerate(content["worst"], start=1)
    ]
    head = ["", "where", "estimate", "interval", "starts that fail", "like training", "why"]
    meaning = (
        f"The highest estimates that lie at least {APART:.0f} m apart, and what drives each of "
        "them; numbers as on the map."
    )
    title = f"The worst {len(rows)} places" if len(rows) > 1 else "The worst place"
    if not rows:
        return section("worst", title, meaning, empty("No place has an estimate."))
    views = "".join(_view(n, p, pictures) for n, p in enumerate(content["worst"], start=1))
    body = table(head, rows, "words worst") + _HEIGHTS + f'<div class="views">{views}</div>'
    return section("worst", title, meaning, body)


def _at(p: Mapping[str, Any]) -> str:
    return f"x {p['x']:.1f}, y {p['y']:.1f}" if known(p["x"]) and known(p["y"]) else "no position"


def _small(text: str) -> str:
    return f'<br><span class="small">{text}</span>'


def _view(number: int, p: Mapping[str, Any], pictures: Mapping[int, bytes | str]) -> str:
    """A place from above, or why there is no picture of it."""
    picture = pictures.get(number, "none was taken")
    if isinstance(picture, str):
        shown = f'<span class="none">no picture: {esc(picture)}</span>'
    else:
        data = base64.b64encode(picture).decode("ascii")
        text = f"The map round place {number} from above"
        shown = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    where = f"{esc(p['route_id'])}, {p['arc_length']:.0f}\u00a0m"
    return f"<figure>{shown}<figcaption><b>{number}</b> {where}</figcaption></figure>"


_HEIGHTS = (
    '<p class="ramp">Each picture is the map within '
    f"{AROUND:.0f} m from above, its y axis up, the arrow the direction of travel; height from the "
    f'lidar: {-BELOW:.0f}\u00a0m <span style="background:linear-gradient(to right,'
    f'{",".join(heights_ramp())})"></span> {ABOVE:.0f}\u00a0m and more</p>'
)


def paths(content: Mapping[str, Any]) -> str:
    """Measured against estimated error along each labelled path."""
    meaning = (
        "The measured error beside the estimate of a model that has never seen that path (the "
        "paper's Fig. 12 and 13, without its random split); the band should hold nine of ten "
        "measured errors."
    )
    body = "".join(
        f'<h3>Path {esc(p["path"])}</h3><p>{_of_path(p)}</p><div class="chart" id="path-{k}"></div>'
        for k, p in enumerate(content["paths"][:MOST_PATHS])
    )
    if more := len(content["paths"][MOST_PATHS:]):
        body += f"<p>{more} more paths are in <code>report.json</code>.</p>"
    why = "No place was labelled: without a log of scans there is no measured error to show."
    return section("paths", "Measured and estimated error", meaning, body or empty(why))


def _of_path(p: Mapping[str, Any]) -> str:
    drives = f"{len(p['groups'])} drives" if len(p["groups"]) > 1 else "one drive"
    text = f"{count(p['points'])} labels of {drives}, median {length(p['actual_median'])}"
    if not p["judged"]:
        return text + "; no model was trained without this path, so there is no estimate to show."
    text += (
        f"; estimates are off by {length(p['mae'])} on average, rank correlation "
        f"{plain_number(p['spearman'])}."
    )
    return text if p["interval"] else text + " No interval could be calibrated on the other paths."


def importances(found: Findings) -> str:
    """What the forest looks at."""
    meaning = (
        "How much of what the forest explains of its own training points it explains by each "
        "factor, beside the paper's Fig. 14. The counts are all correlated and share it, so the "
        "second table is the honest one: how much worse unseen blocks are estimated when a "
        "criterion's factors are shuffled."
    )
    parts = []
    if found.importances.empty:
        parts.append(empty("No forest was trained in this run: it has no importances."))
    else:
        parts.append(_of_factors(found.importances))
    if found.criterion_importances.empty:
        parts.append(empty("No permutation by criterion: there were no held-out blocks to judge."))
    else:
        parts.append(_of_criteria(found.criterion_importances))
    return section("importances", "What drives the estimates", meaning, "".join(parts))


def _of_factors(found: pd.DataFrame) -> str:
    ranked = found.sort_values("importance", ascending=False, kind="stable")
    largest = float(ranked["importance"].max()) or 1.0
    rows = []
    for row in _records(ranked):
        name, criterion = str(row["factor"]), str(row["criterion"])
        colour = CRITERION.get(criterion, OTHER)
        papers = PAPER_IMPORTANCES.get(name)
        rows.append(
            [
                f"<code>{esc(name)}</code>",
                _dot(colour) + f"{esc(criterion)} {NAMES.get(criterion, '')}",
                bar(float(row["importance"]) / largest, colour),
                f"{row['importance']:.3f}",
                DASH if papers is None else f"{papers:.2f}",
            ]
        )
    return "<h3>By factor</h3>" + table(
        ["factor", "criterion", "", "importance", "the paper's"], rows, "bars named"
    )


def _dot(colour: str) -> str:
    return f'<span class="dot" style="background:{colour}"></span>'


def _of_criteria(found: pd.DataFrame) -> str:
    largest = max(float(found["increase"].max()), 1e-9)
    rows = [
        [
            f"{esc(r['criterion'])} {NAMES.get(str(r['criterion']), '')}",
            str(r["factors"]),
            bar(float(r["increase"]) / largest, CRITERION.get(str(r["criterion"]), OTHER)),
            f"{length(r['increase'], 2)} ± {length(r['spread'], 2)}",
        ]
        for r in _records(found)
    ]
    head = ["criterion", "factors", "", "mean error grows by"]
    return "<h3>By criterion, on held-out blocks</h3>" + table(head, rows, "bars")


def table_iv(found: Findings) -> str:
    """The paper's Table IV beside ours."""
    meaning = (
        "What each criterion adds to the one before. The paper's figures are of a random split at "
        "1 m spacing, where every judged point has a neighbour that trained: the rows marked "
        f"{LEAKS} are comparable with them and prove nothing; the others do."
    )
    if found.table_iv.empty:
        why = "There were no labels to judge estimates with; the paper's own figures stand alone."
        body = empty(why)
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
        why = "There were no labels, so nothing can be judged: the estimates rest on the model."
        return section("protocols", "How good the estimates are", meaning, empty(why))
    parts = [_protocol(name, rows) for name, rows in _by_protocol(found.protocols)]
    if found.ceiling is None:
        parts.append(empty("No place was driven twice in this run, so no ceiling is known."))
    else:
        cells = [["a second drive over the same places", *_figures(found.ceiling)]]
        text = "<p>Two measurements of one place differ by this much: no map can tell more.</p>"
        parts.append(f"<h3>the ceiling</h3>{text}" + table(["", *FIGURES], cells, "figures"))
    return section("protocols", "How good the estimates are", meaning, "".join(parts))


def _protocol(name: str, rows: list[dict[str, Any]]) -> str:
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
    verdict = "" if name == LEAKING else _verdict(judged)
    return f"{text}{verdict}</p>" + grouped_table(head, groups, "figures")


def _verdict(judged: list[dict[str, Any]]) -> str:
    """Whether the best of our models beats the best opponent, by mean absolute error."""
    ours = [r for r in judged if r["model"] in OURS]
    opponents = [r for r in judged if r["model"] in OPPONENTS]
    if not (ours and opponents):
        return ""
    best = min(ours, key=lambda r: float(r["mae"]))
    rival = min(opponents, key=lambda r: float(r["mae"]))
    wins = best["mae"] < rival["mae"]
    return (
        f"<b>The best of ours ({length(best['mae'], 2)}, {_model(best['model'])}) "
        f"{'beats' if wins else 'does not beat'} "
        f"the best opponent ({length(rival['mae'], 2)}, {_model(rival['model'])})</b> by mean "
        f"absolute error, over {count(best['points'])} points."
    )


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
        "An interval that promises nine of ten must hold nine of ten on a path that it was not "
        "calibrated on; the bar is what it held, the line what was promised."
    )
    if found.coverage.empty:
        why = "Without labels on several paths no interval can be checked."
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
    judged = [r for r in _records(found.coverage) if known(r["covered"])]
    held = sum(r["covered"] >= r["level"] for r in judged)
    verdict = f"<p><b>The promise was held on {held} of {len(judged)} paths.</b></p>"
    body = (verdict if judged else "") + table(head, rows, "bars")
    return section("calibration", "Do the intervals hold", meaning, body)


def _gauge(covered: Any, level: Any) -> str:
    if not (known(covered) and known(level)):
        return DASH
    mark = f'<u style="left:{100.0 * level:.1f}%;background:{HELD_OUT}"></u>'
    return bar(float(covered), ACTUAL).replace("</span>", f"{mark}</span>")


def facts(content: Mapping[str, Any]) -> str:
    """What was run, with which settings, and whose data it is."""
    given = dict(content["facts"])
    lists = [(title, given.pop(name, [])) for name, title in _LISTS]
    single = {"tilestream": content["tilestream"], "CRS": content["crs"] or "none: a local frame"}
    single |= {name: value for name, value in given.items() if not isinstance(value, dict)}
    parts = [_facts("run", single)]
    parts += [_facts(name, value) for name, value in given.items() if isinstance(value, dict)]
    for title, sentences in lists:
        lines = [sentences] if isinstance(sentences, str) else list(sentences)
        if lines:
            items = "".join(f"<li>{esc(line)}</li>" for line in lines)
            parts.append(f"<h3>{title}</h3><ul>{items}</ul>")
    meaning = "With these versions and settings the same input gives the same figures."
    return section("facts", "Run facts", meaning, "".join(parts))


_LISTS = (("notes", "Notes"), ("attributions", "Data and attributions"))


def _facts(title: str, values: Mapping[str, Any]) -> str:
    rows = [[esc(name), esc(value)] for name, value in _flat("", values)]
    if not rows:
        return ""
    return f"<h3>{esc(title.replace('_', ' '))}</h3>" + table(["", ""], rows, "facts")


def _flat(prefix: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Nested facts as lines, the names joined by dots."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict):
            lines += _flat(f"{prefix}{name}.", value)
        elif isinstance(value, list):
            lines.append((f"{prefix}{name}", ", ".join(map(str, value)) or DASH))
        elif isinstance(value, bool):
            lines.append((f"{prefix}{name}", "yes" if value else "no"))
        elif isinstance(value, float):
            lines.append((f"{prefix}{name}", f"{value:.6g}"))
        else:
            lines.append((f"{prefix}{name}", DASH if value is None else str(value)))
    return lines
