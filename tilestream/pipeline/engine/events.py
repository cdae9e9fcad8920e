"""What a client sends to the scheduler about a run, so that its dashboard can show it."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from tilestream.crs import named as crs_named
from tilestream.marks import hash_of
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.costs import seconds_per_work
from tilestream.pipeline.engine.outputs import TileArrays
from tilestream.pipeline.engine.progress import DONE, FAILED, LONGEST_REASON, NAME, REFUSED
from tilestream.pipeline.engine.stage import Task
from tilestream.store import open_store

logger = logging.getLogger(__name__)

TASKS_PER_MESSAGE = 500
"""Most tasks or outcomes in a message."""
SEND_EVERY = 0.5
"""How often outcomes are sent [s]."""


def serve_page(client: Any) -> str | None:
    """Have the scheduler serve the page, as it does from now on.

    One that serves it already goes on.

    Returns:
        Its address; of a scheduler without a dashboard that of `tilestream.json`, for machines;
        None: it can serve nothing.
    """
    link = client.dashboard_link.removesuffix("status")
    if not link:
        return None
    try:
        # Bokeh is heavy, and most processes that import this one have no scheduler.
        from tilestream.pipeline.engine.dashboard.plugin import (  # noqa: PLC0415
            ProgressPlugin,
            has_pages,
        )

        client.register_plugin(ProgressPlugin())
        name = NAME if client.run_on_scheduler(has_pages) else f"{NAME}.json"
    except Exception as error:  # noqa: BLE001 - whatever the scheduler lacks
        logger.warning("no Tilestream page on the dashboard: %s", error or repr(error))
        return None
    return f"{link}{name}"


@contextmanager
def dashboard_client(
    client: Any, named: Callable[[str], str], shared: Iterable[str]
) -> Iterator["DashboardClient"]:
    """Sends a run to the scheduler, for its page: planned tasks, then their outcomes.

    Nothing that goes wrong here disturbs the run: the page is a view, the store is the truth.

    Args:
        client: a Dask client.
        named: the Dask key of a task, from its own.
        shared: the folders and stores that the run writes; one that shares none with the run before
            is another run.

    Yields:
        What takes tasks and outcomes.
    """
    page = DashboardClient(client, named, shared)
    try:
        yield page
    finally:
        page.end()


class DashboardClient:
    """Sends tasks and outcomes in messages of bounded size."""

    def __init__(self, client: Any, named: Callable[[str], str], shared: Iterable[str]) -> None:
        self._client = client
        self._named = named
        self._outcomes: list[list[Any]] = []
        self._sent = time.monotonic()
        self._before = seconds_per_work()
        self._map = False
        self._ahead: Sequence[Task] | None = None
        self._sender: Any = None
        if serve_page(client):
            # It draws with what reports are drawn with, which is as heavy as Bokeh.
            from tilestream.pipeline.engine.map_sender import MapSender  # noqa: PLC0415

            self._sender = MapSender(lambda message: self._send({"op": "draw", **message}))
            # Hashed: who looks at the page need not know where the run writes.
            self._send({"op": "begin", "places": [hash_of([place]) for place in shared]})

    def plan(self, tasks: Sequence[Task]) -> None:
        """Send the tasks of a plan."""
        if self._sender is None:
            return
        self._tell_map(tasks)
        for first in range(0, len(tasks), TASKS_PER_MESSAGE):
            part = tasks[first : first + TASKS_PER_MESSAGE]
            stages = self._stages(part)
            numbers = {name: number for number, name in enumerate(stages)}
            lines = [
                [
                    self._named(task.key),
                    numbers[task.stage],
                    task.work,
                    *(task.tile or (None, None)),
                ]
                for task in part
            ]
            told = [stage[:3] for stage in stages.values()]
            self._send({"op": "plan", "stages": told, "tasks": lines})
        for task in tasks:
            self._sender.plan(task)

    def expect(self, ahead: Sequence[Task] | None) -> None:
        """Send which tasks will follow, if that has changed; None: it is not known yet."""
        if self._sender is not None and ahead is not None and ahead is not self._ahead:
            self._ahead = ahead
            stages = list(self._stages(ahead).values())
            self._send({"op": "expect", "stages": stages, "complete": True})

    def learn(self, outcome: Outcome, task: Task) -> None:
        """Take an outcome; every now and then, send what has gathered."""
        if self._sender is None:
            return
        status = DONE if outcome.ok else REFUSED if outcome.refused else FAILED
        name = outcome.key if status == FAILED else ""
        reason = outcome.reason[:LONGEST_REASON] if status == FAILED else ""
        seconds = outcome.seconds if outcome.made else 0.0
        self._outcomes.append([self._named(outcome.key), status, name, reason, seconds])
        full = len(self._outcomes) >= TASKS_PER_MESSAGE
        if full or time.monotonic() - self._sent > SEND_EVERY:
            self._send_outcomes("outcomes")
        if outcome.ok:
            self._sender.learn(task)

    def end(self) -> None:
        """Send what has gathered, and that it was the last."""
        if self._sender is not None:
            self._send_outcomes("outcomes")
            self._sender.close()
            self._send_outcomes("end")

    def _send_outcomes(self, op: str) -> None:
        self._send({"op": op, "outcomes": self._outcomes})
        self._outcomes, self._sent = [], time.monotonic()

    def _stages(self, tasks: Iterable[Task]) -> dict[str, list[Any]]:
        """By name: name, largest promise, seconds per work, tasks and work of each stage."""
        stages: dict[str, list[Any]] = {}
        for task in tasks:
            before = self._before.get(task.stage, task.applies.seconds)
            stage = stages.setdefault(task.stage, [task.stage, 0, before, 0, 0])
            stage[1] = max(stage[1], task.promised_bytes)
            stage[3] += 1
            stage[4] += task.work
        return stages

    def _tell_map(self, tasks: Sequence[Task]) -> None:
        """Send which map the tasks work on, as soon as one says it."""
        url = next((t.writes.store_url for t in tasks if isinstance(t.writes, TileArrays)), "")
        if not url or self._map:
            return
        self._map = True
        try:
            store = open_store(url)
        except Exception as error:  # noqa: BLE001 - who works on it says what is wrong with it
            logger.debug("the map is not told of: %s", error or repr(error))
            return
        crs = None if store.settings.crs is None else crs_named(store.settings.crs)
        self._send({"op": "map", "tile_mm": store.grid.tile_mm, "crs": crs})

    def _send(self, message: dict[str, Any]) -> None:
        if self._client.status != "running":
            return
        try:
            self._client.log_event(NAME, {**message, "client": self._client.id})
        except Exception as error:  # noqa: BLE001 - the run itself sees a lost scheduler
            logger.debug("not sent: %s", error or repr(error))
