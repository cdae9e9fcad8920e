"""The Tilestream page on the scheduler's own dashboard, and the same for machines as JSON.

A plugin on the scheduler gathers the progress of the last run, a Bokeh application shows it, a
client tells it what the scheduler cannot know. It leans on parts of `distributed` that are not
documented (its Bokeh applications and its HTTP server); pyproject.toml caps its version, and a test
runs the page in a browser.
"""

import json
from typing import Any

from bokeh.server.tornado import BokehTornado
from distributed.dashboard.core import BokehApplication
from distributed.dashboard.scheduler import template_variables
from distributed.diagnostics.plugin import SchedulerPlugin
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import RequestHandler

from tilestream.pipeline.engine.dashboard.page import LOOK_EVERY_MS, Page
from tilestream.pipeline.engine.progress import NAME, Progress


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
        op = msg["op"]
        if op == "begin":
            self._begin(msg["client"], set(msg["places"]))
        if msg["client"] != self.progress.client:
            return
        if op == "map":
            self.progress.map.tile_mm, self.progress.map.crs = msg["tile_mm"], msg["crs"]
        elif op == "plan":
            self.progress.plan(msg["stages"], msg["tasks"])
        elif op == "expect":
            self.progress.expect(msg["stages"], msg["complete"])
        elif op == "draw":
            self.progress.map.draw(msg)
        elif op in ("outcomes", "end"):
            self.progress.learn(msg["outcomes"])
            if op == "end":
                self.progress.end("ended")

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:  # noqa: ARG002 - the scheduler's signature
        """Called by the scheduler for each change of each task."""
        if finish == "processing":
            self.progress.seen(_planned(key), running=True)
        elif start == "processing" and finish not in ("memory", "erred"):
            self.progress.seen(_planned(key), running=False)

    def remove_client(self, scheduler: Any, client: str) -> None:  # noqa: ARG002
        """Called when a client leaves, in whatever way."""
        if client == self.progress.client and self.progress.state == "running":
            self.progress.end("lost")

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
        workers = self.scheduler.workers.values()
        facts = self.progress.facts(sum(worker.nthreads for worker in workers))
        promise = max((stage["promised_bytes"] for stage in facts["stages"]), default=0)
        return {**facts, "promised_bytes": promise, "workers": self.workers()}

    def _begin(self, client: str, places: set[str]) -> None:
        """Begin anew where a client does not go on in places of its run before."""
        goes_on = not places or places & self.progress.places
        if client != self.progress.client or not goes_on:
            self.progress = Progress(client)
        self.progress.places |= places

    def _look_at_memory(self) -> None:
        for address, worker in self.scheduler.workers.items():
            now = int(worker.metrics.get("memory", 0))
            self.peaks[address] = max(now, self.peaks.get(address, 0))


def _planned(key: Any) -> str:
    """The key that the plan was told with: a task that is tried again has its number added."""
    return str(key).partition("#")[0]


def has_pages(dask_scheduler: Any) -> bool:
    """Whether the scheduler, in whose process this runs, has a dashboard."""
    return bool(_pages(dask_scheduler))


def _pages(scheduler: Any) -> list[BokehTornado]:
    applications = scheduler.http_application.applications
    return [app for app in applications if isinstance(app, BokehTornado)]


def _serve(plugin: ProgressPlugin) -> None:
    """Add the page and the route to the server that runs; without a dashboard, the route alone."""
    scheduler = plugin.scheduler
    server = scheduler.http_application
    pages = _pages(scheduler)
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
    """`/tilestream.json`; besides with `?tiles=1` the status of every tile, and with `?places=1`
    the estimates that are on the map.
    """

    def initialize(self, plugin: ProgressPlugin) -> None:
        """Called for each request."""
        self.plugin = plugin

    def get(self) -> None:
        """Send the state of the run as JSON."""
        facts = self.plugin.facts()
        if self.get_query_argument("tiles", ""):
            facts["tiles"] = self.plugin.progress.tile_facts()
        if self.get_query_argument("places", ""):
            facts["places"] = self.plugin.progress.map.mark_facts()
        self.set_header("Content-Type", "application/json")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cache-Control", "no-store")
        self.write(json.dumps(facts))
