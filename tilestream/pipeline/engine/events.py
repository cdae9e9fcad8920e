"""What a client tells the scheduler of a run, so that its dashboard can show it."""

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
"""How many tasks or outcomes a client tells at a time."""
TELL_EVERY = 0.5
"""How often a client tells outcomes [s]."""


def page_url(client: Any | None) -> str | None:
    """Address of the page for people; None where there is no dashboard."""
    link = "" if client is None else client.dashboard_link
    return f"{link.removesuffix('status')}{NAME}" if link else None


@contextmanager
def telling(client: Any, named: Callable[[str], str]) -> Iterator["DashboardClient"]:
    """Tell the scheduler of a run, for its page: tasks as they are planned, outcomes as they come.

    Nothing that goes wrong here disturbs the run: the page is a view, the store is the truth.

    Args:
        client: a Dask client.
        named: the Dask key of a task, from its own.

    Yields:
        What is to be told of tasks and outcomes.
    """
    page = DashboardClient(client, named)
    try:
        yield page
    finally:
        page.tell("end")


class DashboardClient:
    """Tells outcomes some at a time."""

    def __init__(self, client: Any, named: Callable[[str], str]) -> None:
        self._client = client
        self._named = named
        self._outcomes: list[list[Any]] = []
        self._told = time.monotonic()
        try:
            # Bokeh is heavy, and most processes that import this one have no scheduler to tell.
            from tilestream.pipeline.engine.dashboard import ProgressPlugin  # noqa: PLC0415

            client.register_plugin(ProgressPlugin())
            self._open = True
        except Exception as error:  # noqa: BLE001 - whatever the scheduler lacks
            logger.warning("no Tilestream page on the dashboard: %s", error or repr(error))
            self._open = False

    def plan(self, tasks: Sequence[Task]) -> None:
        """Tell the tasks, in messages of bounded size."""
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
        """Note an outcome; tell what has gathered every now and then."""
        status = DONE if outcome.ok else REFUSED if outcome.refused else FAILED
        name = outcome.key if status == FAILED else ""
        reason = outcome.reason[:LONGEST_REASON] if status == FAILED else ""
        self._outcomes.append([self._named(outcome.key), status, name, reason])
        full = len(self._outcomes) >= TASKS_PER_MESSAGE
        if full or time.monotonic() - self._told > TELL_EVERY:
            self.tell("outcomes")

    def tell(self, op: str) -> None:
        """Tell what has gathered."""
        self._send({"op": op, "outcomes": self._outcomes})
        self._outcomes, self._told = [], time.monotonic()

    def _send(self, message: dict[str, Any]) -> None:
        if not self._open or self._client.status != "running":
            return
        try:
            self._client.log_event(NAME, {**message, "client": self._client.id})
        except Exception as error:  # noqa: BLE001 - the run itself sees a lost scheduler
            logger.debug("not told: %s", error or repr(error))
