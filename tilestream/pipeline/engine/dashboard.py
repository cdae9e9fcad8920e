"""The Tilestream page on the scheduler's own dashboard, and the same for machines as JSON.

A plugin on the scheduler gathers the progress of the last run, a Bokeh application shows it, a
client tells it what the scheduler cannot know. It leans on parts of `distributed` that are not
documented (its Bokeh applications and its HTTP server); pyproject.toml caps its version, and a test
runs the page in a browser.
"""

import html
import json
import logging
from collections.abc import Iterable, Sequence
from typing import Any

from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, HoverTool
from bokeh.models.widgets import Div, Select
from bokeh.palettes import viridis
from bokeh.plotting import figure
from bokeh.server.tornado import BokehTornado
from distributed.dashboard.components.scheduler import BOKEH_THEME, env
from distributed.dashboard.core import BokehApplication
from distributed.dashboard.scheduler import template_variables
from distributed.diagnostics.plugin import SchedulerPlugin
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import RequestHandler

from tilestream.pipeline.engine.plan import megabytes
from tilestream.pipeline.engine.progress import (
    DONE,
    FAILED,
    NAME,
    REFUSED,
    RUNNING,
    STATUSES,
    WAITING,
    Progress,
)

logger = logging.getLogger(__name__)

LOOK_EVERY_MS = 1000
"""How often the memory of the workers is looked at, and the page redrawn [ms]."""
EVERY_STAGE = "every stage"
NOTHING = "–"
MOST_WORKERS = 40
"""Workers on the page."""
GREY, RED, DARK = "#d9d9d9", "#d62728", "#8c8c8c"


class ProgressPlugin(SchedulerPlugin):
    """Keeps the progress of the run that was begun last, and serves it."""

    name = NAME
    idempotent = True

    async def start(self, scheduler: Any) -> None:
        """Called by the scheduler that it was registered on."""
        self.scheduler = scheduler
        self.progress = Progress("")
        self.peaks: dict[str, int] = {}
        self._look = PeriodicCallback(self._look_at_memory, LOOK_EVERY_MS)
        self._look.start()
        _serve(self)

    async def close(self) -> None:
        """Called when the scheduler ends."""
        self._look.stop()

    def log_event(self, topic: str, msg: Any) -> None:
        """Called for each message of a client."""
        if topic != NAME:
            return
        if msg["op"] == "plan":
            if msg["client"] != self.progress.client:
                self.progress = Progress(msg["client"])
            self.progress.plan(msg["stages"], msg["tasks"])
        elif msg["client"] == self.progress.client:
            self.progress.learn(msg["outcomes"])
            if msg["op"] == "end":
                self.progress.state = "ended"

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:  # noqa: ARG002 - the scheduler's signature
        """Called by the scheduler for each change of each task."""
        if finish == "processing":
            self.progress.seen(_planned(key), running=True)
        elif start == "processing" and finish not in ("memory", "erred"):
            self.progress.seen(_planned(key), running=False)

    def remove_client(self, scheduler: Any, client: str) -> None:  # noqa: ARG002
        """Called when a client leaves, in whatever way."""
        if client == self.progress.client and self.progress.state == "running":
            self.progress.state = "lost"

    def workers(self) -> list[dict[str, Any]]:
        """Memory of each worker, now and at most since it was first looked at, and its limit."""
        self._look_at_memory()
        return [
            {
                "worker": str(worker.name),
                "address": address,
                "bytes": int(worker.metrics.get("memory", 0)),
                "peak_bytes": self.peaks[address],
                "limit_bytes": int(worker.memory_limit or 0),
            }
            for address, worker in self.scheduler.workers.items()
        ]

    def facts(self) -> dict[str, Any]:
        """Everything for machines."""
        facts = self.progress.facts()
        promise = max((stage["promised_bytes"] for stage in facts["stages"]), default=0)
        return {**facts, "promised_bytes": promise, "workers": self.workers()}

    def _look_at_memory(self) -> None:
        for address, worker in self.scheduler.workers.items():
            now = int(worker.metrics.get("memory", 0))
            self.peaks[address] = max(now, self.peaks.get(address, 0))


def _planned(key: Any) -> str:
    """The key that the plan was told with: a task that is tried again has its number added."""
    return str(key).partition("#")[0]


def _serve(plugin: ProgressPlugin) -> None:
    """Add the page and the route to the server that runs; without a dashboard, the route alone."""
    scheduler = plugin.scheduler
    server = scheduler.http_application
    pages = [app for app in server.applications if isinstance(app, BokehTornado)]
    prefix = pages[0].prefix if pages else ""
    server.add_handlers(".*$", [(rf"{prefix}/{NAME}\.json", JsonHandler, {"plugin": plugin})])
    if pages:
        variables = template_variables(scheduler)
        variables["pages"].append(NAME)  # the other pages share this list: all now link to ours
        shown = {f"/{NAME}": lambda _, extra, doc: Page(plugin, extra, doc)}
        ours = BokehApplication(
            shown, scheduler, prefix=prefix or "/", template_variables=variables
        )
        ours.websocket_origins.clear()  # what Dask's configuration says here
        ours.websocket_origins.update(pages[0].websocket_origins)
        server.add_application(ours)
        ours.initialize(IOLoop.current())
        ours.start()


class JsonHandler(RequestHandler):
    """`/tilestream.json`; with `?tiles=1`, the status of every tile besides."""

    def initialize(self, plugin: ProgressPlugin) -> None:
        """Called for each request."""
        self.plugin = plugin

    def get(self) -> None:
        """Send the state of the run as JSON."""
        facts = self.plugin.facts()
        if self.get_query_argument("tiles", ""):
            facts["tiles"] = self.plugin.progress.tile_facts()
        self.set_header("Content-Type", "application/json")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cache-Control", "no-store")
        self.write(json.dumps(facts))


class Page:
    """One viewer's page: the city in tiles, the stages, the workers, what failed."""

    def __init__(self, plugin: ProgressPlugin, extra: dict[str, Any], doc: Document) -> None:
        self._plugin = plugin
        self._progress = plugin.progress
        self._read = 0
        self._source = ColumnDataSource(name="tiles", data=self._columns([]))
        offered: list[Any] = [EVERY_STAGE]
        self._select = Select(options=offered, value=EVERY_STAGE, width=220, name="stage")
        self._select.on_change("value", lambda attr, old, new: self._redraw())  # noqa: ARG005 - Bokeh asks for just these
        self._head, self._stages, self._workers, self._failures = (
            Div(name=name, width=620, margin=(4, 12, 4, 12))
            for name in ("head", "stages", "workers", "failures")
        )
        side = column(self._stages, self._workers, self._failures)
        left = column(self._select, self._map())
        doc.add_root(column(self._head, row(left, side)))
        doc.title = "Tilestream"
        doc.template = env.get_template("simple.html")
        doc.template_variables.update(extra)
        doc.theme = BOKEH_THEME
        doc.add_periodic_callback(self.update, LOOK_EVERY_MS)
        self._redraw()
        self._write()

    def update(self) -> None:
        """Show what has changed."""
        if self._plugin.progress is not self._progress:
            self._progress = self._plugin.progress
            self._redraw()
        elif len(self._source.data["x"]) != len(self._progress.tiles):
            self._redraw()
        else:
            changed = sorted(set(self._progress.changes[self._read :]))
            self._read = len(self._progress.changes)
            fresh = self._columns(changed)
            if changed:
                self._source.patch(
                    {
                        name: list(zip(changed, fresh[name], strict=True))
                        for name in ("fill", "alpha", "line", "what")
                    }
                )
        self._write()

    def _map(self) -> Any:
        plot = figure(
            width=680,
            height=640,
            match_aspect=True,
            title=None,
            x_axis_label="tile column",
            y_axis_label="tile row",
            tools="pan,wheel_zoom,box_zoom,reset",
            active_scroll="wheel_zoom",
        )
        plot.grid.visible = False
        plot.rect(
            x="x",
            y="y",
            width=0.94,
            height=0.94,
            fill_color="fill",
            fill_alpha="alpha",
            line_color="line",
            line_width=2,
            source=self._source,
        )
        plot.add_tools(HoverTool(tooltips=[("tile", "@tile"), ("stages", "@what")]))
        return plot

    def _redraw(self) -> None:
        """Show all tiles anew."""
        self._read = len(self._progress.changes)
        columns: Any = self._columns(range(len(self._progress.tiles)))
        self._source.data = columns

    def _columns(self, places: Iterable[int]) -> dict[str, list[Any]]:
        """How the tiles at these places look."""
        found: dict[str, list[Any]] = {
            name: [] for name in ("x", "y", "tile", "fill", "alpha", "line", "what")
        }
        colours = stage_colours(self._progress)
        names = [stage.name for stage in self._progress.stages]
        for place in places:
            ix, iy = self._progress.tiles[place]
            statuses = self._progress.statuses(place)
            what = ", ".join(f"{names[stage]}: {STATUSES[status]}" for stage, status in statuses)
            if self._select.value != EVERY_STAGE:
                statuses = [(s, status) for s, status in statuses if names[s] == self._select.value]
            fill, alpha, line = look(statuses, colours)
            values = (ix + 0.5, iy + 0.5, f"{ix}_{iy}", fill, alpha, line, what)
            for name, value in zip(found, values, strict=True):
                found[name].append(value)
        return found

    def _write(self) -> None:
        """The words beside the map. Everything that is not ours is escaped."""
        facts = self._plugin.facts()
        names = [stage["stage"] for stage in facts["stages"]]
        if self._select.options != [EVERY_STAGE, *names]:
            self._select.options = [EVERY_STAGE, *names]
            self._redraw()
        self._head.text = head_html(facts, len(self._progress.tiles))
        self._stages.text = stages_html(facts["stages"], stage_colours(self._progress))
        self._workers.text = workers_html(facts["workers"], facts["promised_bytes"])
        self._failures.text = failures_html(facts["failures"], facts["failures_not_listed"])


def stage_colours(progress: Progress) -> list[str]:
    """A colour for each stage: the later, the lighter; red and grey mean something else."""
    return list(viridis(max(2, len(progress.stages) + 1)))


def look(statuses: Sequence[tuple[int, int]], colours: Sequence[str]) -> tuple[str, float, str]:
    """Fill, opacity and outline of a tile.

    What has failed is red, and what was refused because of it dark grey. Else the stage that runs,
    pale with a dark outline; else the last one that is done, full; else it waits, light grey.
    """
    by_status: dict[int, list[int]] = {status: [] for status in range(len(STATUSES))}
    for stage, status in statuses:
        by_status[status].append(stage)
    if by_status[FAILED]:
        return RED, 1.0, RED
    if by_status[RUNNING]:
        return colours[max(by_status[RUNNING])], 0.45, "black"
    if by_status[REFUSED]:
        return DARK, 1.0, DARK
    if by_status[DONE]:
        return colours[max(by_status[DONE])], 1.0, colours[max(by_status[DONE])]
    return GREY, 1.0 if by_status[WAITING] else 0.3, GREY


def head_html(facts: dict[str, Any], tiles: int) -> str:
    """What runs, in a line."""
    if not facts["stages"]:
        return "<h2 style='margin:0'>Tilestream</h2>no run has been told of yet"
    said = {
        "running": "running",
        "ended": "ended",
        "lost": "its client is gone: run the same command again, it continues where it was",
    }[facts["state"]]
    tasks, ended = (
        sum(sum(stage[name] for name in names) for stage in facts["stages"])
        for names in (STATUSES, STATUSES[2:])
    )
    return (
        f"<h2 style='margin:0'>Tilestream</h2>{said} · {ended:,} of {tasks:,} tasks ended "
        f"· {tiles:,} tiles · {len(facts['workers']):,} workers"
    )


def stages_html(stages: Sequence[dict[str, Any]], colours: Sequence[str]) -> str:
    """A line per stage: counts, rate, time left."""
    head = ("", "stage", *STATUSES, "per second", "left")
    lines = []
    for stage, colour in zip(stages, colours, strict=False):
        swatch = f"<span style='background:{colour};padding:0 8px'></span>"
        counts = [f"{stage[status]:,}" for status in STATUSES]
        rate = f"{stage['tasks_per_second']:,.2f}" if stage["tasks_per_second"] else NOTHING
        left = NOTHING if stage["seconds_left"] is None else clock(stage["seconds_left"])
        cells = [html.escape(stage["stage"]), *counts, rate, left]
        lines.append([swatch, *cells])
    return _table(head, lines)


def workers_html(workers: Sequence[dict[str, Any]], promise: int) -> str:
    """A line per worker: its memory against the promise; the largest first."""
    lines = []
    for worker in sorted(workers, key=lambda w: -int(w["peak_bytes"])):
        peak = worker["peak_bytes"]
        colour = RED if promise and peak > promise else "#1f77b4"
        width = round(100 * min(1.0, peak / promise)) if promise else 0
        bar = (
            f"<div style='width:140px;background:{GREY}'><div style='width:{width}%;"
            f"background:{colour}'>&nbsp;</div></div>"
        )
        sizes = [megabytes(size) for size in (worker["bytes"], peak, promise)]
        lines.append([html.escape(worker["worker"]), *sizes, bar])
    shown = _table(("worker", "memory", "most", "promised", ""), lines[:MOST_WORKERS])
    more = len(lines) - MOST_WORKERS
    return shown + (f"and {more:,} workers that have used less" if more > 0 else "")


def failures_html(failures: Sequence[dict[str, Any]], more: int) -> str:
    """A line per failed task, with its reason."""
    if not failures:
        return ""
    lines = [[html.escape(failure[name]) for name in ("key", "reason")] for failure in failures]
    rest = f"and {more:,} more: the run lists them when it ends" if more else ""
    return _table(("failed", "reason"), lines) + rest


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """An HTML table; what it is given is HTML already. Columns of numbers are set to the right."""
    sides = [
        "right" if all(cell[:1].isdigit() or cell == NOTHING for cell in cells) else "left"
        for cells in zip(*lines, strict=True)
    ] or ["left"] * len(head)

    def line(cells: Sequence[str], tag: str) -> str:
        styled = (
            f"<{tag} style='padding:1px 8px;text-align:{side}'>{cell}</{tag}>"
            for cell, side in zip(cells, sides, strict=True)
        )
        return f"<tr>{''.join(styled)}</tr>"

    body = "".join(line(cells, "td") for cells in lines)
    return f"<table style='border-collapse:collapse'>{line(head, 'th')}{body}</table>"


def clock(seconds: float) -> str:
    """A duration as a person reads it: `42 s`, `3 min`, `2 h 5 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60} min"
