"""What a client sends to the scheduler about a run, so that its dashboard can show it."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.progress import DONE, FAILED, LONGEST_REASON, NAME, REFUSED
from tilestream.pipeline.engine.stage import Task

logger = logging.getLogger(__name__)

TASKS_PER_MESSAGE = 500
"""Most tasks or outcomes in a message."""
SEND_EVERY = 0.5
"""How often outcomes are sent [s]."""


def page_url(client: Any | None) -> str | None:
    """Address of the page for people; None where there is no dashboard."""
    link = "" if client is None else client.dashboard_link
    return f"{link.removesuffix('status')}{NAME}" if link else None


def serve_page(client: Any) -> bool:
    """Have the scheduler serve the page, as it does from now on; whether it can.

    One that serves it already goes on.
    """
    try:
        # Bokeh is heavy, and most processes that import this one have no scheduler.
        from tilestream.pipeline.engine.dashboard import ProgressPlugin  # noqa: PLC0415

        client.register_plugin(ProgressPlugin())
    except Exception as error:  # noqa: BLE001 - whatever the scheduler lacks
        logger.warning("no Tilestream page on the dashboard: %s", error or repr(error))
        return False
    return True


@contextmanager
def dashboard_client(client: Any, named: Callable[[str], str]) -> Iterator["DashboardClient"]:
    """Sends a run to the scheduler, for its page: planned tasks, then their outcomes.

    Nothing that goes wrong here disturbs the run: the page is a view, the store is the truth.

    Args:
        client: a Dask client.
        named: the Dask key of a task, from its own.

    Yields:
        What takes tasks and outcomes.
    """
    page = DashboardClient(client, named)
    try:
        yield page
    finally:
        page.send("end")


class DashboardClient:
    """Sends tasks and outcomes in messages of bounded size."""

    def __init__(self, client: Any, named: Callable[[str], str]) -> None:
        self._client = client
        self._named = named
        self._outcomes: list[list[Any]] = []
        self._sent = time.monotonic()
        self._open = serve_page(client)

    def plan(self, tasks: Sequence[Task]) -> None:
        """Send the tasks of a plan."""
        for first in range(0, len(tasks), TASKS_PER_MESSAGE):
            part = tasks[first : first + TASKS_PER_MESSAGE]
            stages: dict[str, int] = {}
            for task in part:
                stages[task.stage] = max(task.promised_bytes, stages.get(task.stage, 0))
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
            self._send({"op": "plan", "stages": [list(s) for s in stages.items()], "tasks": lines})

    def learn(self, outcome: Outcome) -> None:
        """Take an outcome; every now and then, send what has gathered."""
        status = DONE if outcome.ok else REFUSED if outcome.refused else FAILED
        name = outcome.key if status == FAILED else ""
        reason = outcome.reason[:LONGEST_REASON] if status == FAILED else ""
        self._outcomes.append([self._named(outcome.key), status, name, reason])
        full = len(self._outcomes) >= TASKS_PER_MESSAGE
        if full or time.monotonic() - self._sent > SEND_EVERY:
            self.send("outcomes")

    def send(self, op: str) -> None:
        """Send what has gathered."""
        self._send({"op": op, "outcomes": self._outcomes})
        self._outcomes, self._sent = [], time.monotonic()

    def _send(self, message: dict[str, Any]) -> None:
        if not self._open or self._client.status != "running":
            return
        try:
            self._client.log_event(NAME, {**message, "client": self._client.id})
        except Exception as error:  # noqa: BLE001 - the run itself sees a lost scheduler
            logger.debug("not sent: %s", error or repr(error))
