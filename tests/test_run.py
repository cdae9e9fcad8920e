"""The engine: needs before tasks, refusals that travel, the same outcomes here and on Dask."""

from collections.abc import Iterator
from dataclasses import dataclass

import distributed
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.dataflow.plan import Plan
from tilestream.dataflow.run import dask_client, execute
from tilestream.dataflow.tasks import Outcome, perform
from tilestream.errors import PlanError, TilestreamError


@dataclass(frozen=True)
class Sum:
    """A task that fails where it is told to."""

    number: int
    needs: tuple[str, ...] = ()
    error: str = ""
    promised_bytes: int = 1
    work: int = 2
    stage: str = "sum"

    @property
    def key(self) -> str:
        return f"sum-{self.number}"


ORDER: list[str] = []


@perform.register
def _sum(task: Sum) -> int:
    ORDER.append(task.key)
    if task.error == "ours":
        raise TilestreamError("no such number")
    if task.error:
        raise ZeroDivisionError(task.error)
    return task.number


def graph(edges: list[list[int]], failing: set[int]) -> list[Sum]:
    return [
        Sum(n, tuple(f"sum-{need % n}" for need in needs) if n else (), "ours" * (n in failing))
        for n, needs in enumerate(edges)
    ]


@given(
    st.lists(st.lists(st.integers(0, 20), max_size=3), max_size=15),
    st.sets(st.integers(0, 14), max_size=4),
)
def test_what_needs_a_failure_is_refused_and_all_else_runs_after_its_needs(
    edges: list[list[int]], failing: set[int]
) -> None:
    tasks = graph(edges, failing)
    ORDER.clear()
    outcomes = {outcome.key: outcome for outcome in execute(tasks, None, None)}
    bad: set[str] = set()
    for task in tasks:
        if task.error or bad.intersection(task.needs):
            bad.add(task.key)
    assert {key for key, outcome in outcomes.items() if not outcome.ok} == bad
    assert len(ORDER) == len(set(ORDER))
    for task in tasks:
        refused = bool(bad.intersection(task.needs))
        assert (task.key in ORDER) is not refused
        if refused:
            assert outcomes[task.key].reason.endswith("failed: no such number")
        else:
            assert all(ORDER.index(need) < ORDER.index(task.key) for need in task.needs)


@pytest.fixture(scope="module")
def client() -> Iterator[distributed.Client]:
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def test_dask_gives_the_same_outcomes_in_the_same_order(client: distributed.Client) -> None:
    tasks = graph([[], [0], [], [1, 2], [3], [0], [5, 4]] + [[n] for n in range(40)], {2, 20})
    here = execute(tasks, None, None)
    seen: list[Outcome] = []
    there = execute(tasks, client, lambda outcome, *_: seen.append(outcome))
    assert [(o.key, o.result, o.reason) for o in there] == [
        (o.key, o.result, o.reason) for o in here
    ]
    assert len(seen) == len(tasks)
    again = execute([Sum(0, error="odd")], client, None)
    assert again[0].reason == "ZeroDivisionError: odd"
    assert "Traceback" in again[0].details


def test_watchers_see_the_work_of_each_stage() -> None:
    seen: list[tuple[str, int, int]] = []
    tasks = [Sum(0), Sum(1, work=5), Sum(2, stage="other")]
    execute(tasks, None, lambda outcome, *counts: seen.append((outcome.stage, *counts)))
    assert seen == [("sum", 2, 7), ("sum", 7, 7), ("other", 2, 2)]


def test_no_cluster_is_started_for_one_worker() -> None:
    with dask_client(None, 1, 10**9) as client:
        assert client is None


def test_a_plan_names_the_task_that_does_not_fit() -> None:
    plan = Plan((Sum(0), Sum(1, promised_bytes=2 * 10**9)), memory=10**9)
    assert plan.promised_bytes == 2 * 10**9
    assert list(plan.describe()) == [("sum", 2, 2 * 10**9)]
    with pytest.raises(PlanError, match=r"sum-1 needs 2,000 MB and may use 1,000 MB"):
        plan.check()
