"""The words, bars and tables of the dashboard page. Everything that is not ours is escaped."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

from tilestream.counts import count_of
from tilestream.pipeline.engine.dashboard.map import COLOURS, HATCHES
from tilestream.pipeline.engine.plan import megabytes
from tilestream.pipeline.engine.progress import STATUSES
from tilestream.report.colours import FIXED, MISSING
from tilestream.report.formatting import CM_PER_M, DASH

MOST_WORKERS = 40
"""Workers on the page."""
MOST_REASONS = 30
"""Reasons of failures on the page."""
WORDS = dict(zip(STATUSES, ("waiting", "running", "done", "failed", "not run"), strict=True))
"""What the statuses are called on the page."""
STYLE = """
:host { color: var(--ink); font: 13px/1.4 system-ui, "DejaVu Sans", Helvetica, Arial, sans-serif; }
.bk-clearfix { width: 100%; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { padding: 1px 5px; text-align: right; white-space: nowrap; font-size: 12px; }
td:first-child, th:first-child { text-align: left; padding-left: 0; }
th { color: var(--soft); font-weight: 500; }
td.bar { width: 40%; min-width: 44px; }
@media (max-width: 500px) {
  td, th { padding: 1px 3px; font-size: 11px; }
  td:nth-child(7), th:nth-child(7) { display: none; }
}
h2 { margin: 0 0 2px; font-size: 13px; font-weight: 650; }
.big { font-size: 17px; font-weight: 650; }
.soft { color: var(--soft); }
.track { position: relative; display: flex; height: 10px; background: var(--track);
  border-radius: 2px; overflow: hidden; }
.track i { display: block; height: 100%; }
.track u { position: absolute; top: 0; bottom: 0; width: 2px; background: var(--ink); }
.line { display: flex; flex-wrap: wrap; gap: 2px 18px; align-items: baseline; }
.line .track { flex: 1 1 160px; align-self: center; }
ul { margin: 0; padding-left: 16px; overflow-wrap: anywhere; }
.key { display: inline-flex; align-items: center; gap: 5px; }
.key i { width: 13px; height: 13px; border: 1px solid; box-sizing: border-box; }
.ramp { display: inline-flex; }
.ramp b { display: block; width: 28px; font-weight: 400; font-size: 11px; text-align: right; }
.ramp b::before { content: ""; display: block; height: 10px; background: var(--of); }
select.bk-input { color: inherit; background-color: var(--panel); border-color: var(--line); }
"""
"""Of all of them; the colours with names are those of the page."""
PATTERNS = {
    "x": "repeating-linear-gradient(45deg,{0} 0 1px,transparent 1px 5px),"
    "repeating-linear-gradient(-45deg,{0} 0 1px,transparent 1px 5px)",
    "/": "repeating-linear-gradient(-45deg,{0} 0 1px,transparent 1px 5px)",
}
"""The hatches of the map, as CSS."""


def head_html(facts: Mapping[str, Any]) -> str:
    """What runs, how far it is and how long it will take."""
    if not facts["stages"]:
        return "<div class='big'>Tilestream</div>no run has been told of yet"
    said = {"running": "running", "ended": "ended", "lost": "its client is gone"}[facts["state"]]
    tasks, ended = (
        sum(sum(stage[name] for name in names) for stage in facts["stages"])
        for names in (STATUSES, STATUSES[2:])
    )
    share = facts["share_done"]
    sizes = [f"{ended:,} of {count_of(tasks, 'task')}", count_of(facts["map"]["tiles"], "tile")]
    sizes.append(count_of(len(facts["workers"]), "worker"))
    then = {
        "running": f"<b>{left_words(facts['left'])}</b>",
        "ended": "",
        "lost": "<b>run the same command again, it continues where it was</b>",
    }[facts["state"]]
    parts = [
        f"<span class='big'>Tilestream: {said}</span>",
        _bar([(share, COLOURS["done"])], f"{share:.0%} of the work is done"),
        f"<b>{share:.0%} done</b>",
        then,
        f"<span>{clock(facts['seconds'])} passed</span>",
        f"<span class='soft'>{' · '.join(sizes)}</span>",
    ]
    return f"<div class='line'>{''.join(parts)}</div>"


def left_words(left: Mapping[str, Any]) -> str:
    """The time left, with how sure it is."""
    if left["seconds"] is None:
        return "no worker yet"
    about = f"about {clock(left['seconds'])} left"
    if left["low"] is not None and left["seconds"]:
        low, high = (clock(left[end]) for end in ("low", "high"))
        about += f" ({low} to {high})" if low != high else ""
    elif left["share_known"] < 1.0:
        about += f" (rough: {1.0 - left['share_known']:.0%} of it by earlier figures)"
    return about if left["complete"] else f"{about}, more follows"


def legend_html(seen: Mapping[str, Any]) -> str:
    """What the colours of the map mean."""
    keys = []
    for status, word in WORDS.items():
        pattern = PATTERNS.get(HATCHES.get(status, ""), "none").format(COLOURS[status])
        width = 3 if status == "running" else 1
        shade = "" if status == "waiting" else f"background-color:{COLOURS[status]}55;"
        style = f"border:{width}px solid {COLOURS[status]};{shade}background-image:{pattern}"
        keys.append(f"<span class='key'><i style=\"{style}\"></i>{word}</span>")
    edges = [*(f"{edge * CM_PER_M:.3g}" for edge in FIXED.edges), ""]
    steps = "".join(
        f"<b style='--of:{colour}'>{edge}</b>"
        for colour, edge in zip(FIXED.colours, edges, strict=True)
    )
    error = f"<span class='key'>error [cm] <span class='ramp'>{steps}</span></span>"
    none = f"<span class='key'><b style='color:{MISSING}'>×</b>no estimate</span>"
    where = html.escape(seen["crs"] or "local frame") if seen["tile_m"] else ""
    told = [f"<span class='soft'>{where}</span>"]
    if seen["places"]:
        many = count_of(seen["places"], "place")
        fewer = seen["places_kept"] < seen["places"]
        worst = f", of squares of {seen['worst_of_squares_m']:g} m the worst" if fewer else ""
        told.insert(0, f"<span class='soft'>{many}{worst}</span>")
    return f"<div class='line'>{''.join([*keys, error, none, *told])}</div>"


def stages_html(stages: Sequence[Mapping[str, Any]]) -> str:
    """A line per stage: a bar of what became of its tasks, counts, rate, time left."""
    head = ("stage", "", "ended", *(WORDS[s] for s in ("running", "failed", "refused")), "per s")
    lines = []
    for stage in stages:
        whole = stage["tasks"] + stage["expected"]
        counts = {status: stage[status] for status in STATUSES[1:]}
        ended = sum(stage[status] for status in STATUSES[2:])
        order = ("done", "failed", "refused", "running")
        shares = [(counts[s] / whole if whole else 0.0, COLOURS[s]) for s in order]
        words = ", ".join(f"{count:,} {WORDS[s]}" for s, count in counts.items())
        told = [f"{counts[s]:,}" if counts[s] else DASH for s in ("running", "failed", "refused")]
        rate = f"{stage['tasks_per_second']:,.2f}" if stage["tasks_per_second"] else DASH
        name = html.escape(stage["stage"])
        lines.append([name, _bar(shares, words), f"{ended:,} of {whole:,}", *told, rate])
    return "<h2>Stages</h2>" + _table(
        (*head, "core time"),
        [
            [*line, clock(stage["core_seconds_left"]) if stage["core_seconds_left"] else DASH]
            for line, stage in zip(lines, stages, strict=True)
        ],
    )


def workers_html(workers: Sequence[Mapping[str, Any]], promise: int) -> str:
    """A line per worker: its memory now and at most, against the promise; the largest first."""
    lines = []
    for worker in sorted(workers, key=lambda w: -int(w["peak_bytes"])):
        now, peak = worker["bytes"], worker["peak_bytes"]
        scale = max(peak, promise, 1)
        colour = COLOURS["failed" if promise and peak > promise else "running"]
        shares = [(now / scale, colour), ((peak - now) / scale, f"{colour}66")]
        words = f"{megabytes(now)} now, {megabytes(peak)} at most, {megabytes(promise)} promised"
        over = " over" if promise and peak > promise else ""
        bar = _bar(shares, words, promise / scale if promise else None)
        name = html.escape(worker["worker"])
        lines.append([name, bar, megabytes(now), megabytes(peak) + over])
    promised = f"memory: {megabytes(promise)} promised" if promise else "memory"
    shown = _table(("worker", promised, "now", "at most"), lines[:MOST_WORKERS])
    more = len(lines) - MOST_WORKERS
    rest = f"and {count_of(more, 'worker')} that used less" if more > 0 else ""
    return f"<h2>Workers</h2>{shown}{rest}"


def failures_html(facts: Mapping[str, Any]) -> str:
    """What failed, a line for each reason, as the terminal tells it."""
    failed, not_run = (
        sum(stage[status] for stage in facts["stages"]) for status in ("failed", "refused")
    )
    if not failed:
        return "<h2>Failures</h2><span class='soft'>none</span>"
    then = f", {not_run:,} not run because of that" if not_run else ""
    reasons = facts["reasons"]
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in reasons[:MOST_REASONS])
    more = (
        [count_of(len(reasons) - MOST_REASONS, "more reason")]
        if len(reasons) > MOST_REASONS
        else []
    )
    unread = facts["failures_not_listed"]
    more += [count_of(unread, "more failure")] if unread else []
    rest = f"<span class='soft'>and {', '.join(more)}: the run lists them</span>" if more else ""
    return f"<h2>Failures: {failed:,} failed{then}</h2><ul>{lines}</ul>{rest}"


def _bar(shares: Sequence[tuple[float, str]], words: str, mark: float | None = None) -> str:
    """Parts of a whole side by side, and maybe a mark at a share of it."""
    parts = "".join(
        f"<i style='width:{100.0 * share:.1f}%;background:{colour}'></i>"
        for share, colour in shares
        if share > 0
    )
    line = "" if mark is None else f"<u style='left:calc({100.0 * mark:.1f}% - 2px)'></u>"
    return f"<div class='track' role='img' title='{words}' aria-label='{words}'>{parts}{line}</div>"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """An HTML table; what it is given is HTML already. The second column holds bars."""

    def line(cells: Sequence[str], tag: str) -> str:
        told = (
            f"<{tag}{' class=bar' if place == 1 else ''}>{cell}</{tag}>"
            for place, cell in enumerate(cells)
        )
        return f"<tr>{''.join(told)}</tr>"

    body = "".join(line(cells, "td") for cells in lines)
    return f"<table>{line(head, 'th')}{body}</table>"


def clock(seconds: float) -> str:
    """A duration as a person reads it: `42 s`, `3 min`, `2 h 5 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60} min"
