"""The engine: needs before tasks, refusals that travel, the same outcomes here and on Dask."""

import itertools
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import dask
import distributed
import psutil
import pytest
from elsewhere import certificates, scheduler_elsewhere
from hypothesis import given
from hypothesis import strategies as st
from naps import MEMORY, ORDER, After, Nap, Sum
from patience import wait_until

from tilestream.errors import PlanError, TaskError, UsageError
from tilestream.grid import TileKey
from tilestream.pipeline.engine.attempt import Outcome, in_turn
from tilestream.pipeline.engine.cluster import dask_client, report_kept
from tilestream.pipeline.engine.dask_executor import _Workers
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.frontier import Frontier
from tilestream.pipeline.engine.late_client import LateClient
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.stage import BASE_BYTES, Task
from tilestream.pipeline.engine.time_left import LEAST


def planned(tasks: Sequence[Task]) -> Plan:
    return Plan(tuple(tasks), MEMORY)


def graph(edges: list[list[int]], failing: set[int]) -> list[Task]:
    return [
        Sum(n, tuple(f"sum-{need % n}" for need in needs) if n else (), "ours" * (n in failing))
        for n, needs in enumerate(edges)
    ]


@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=30), st.integers(1, 6), st.randoms())
def test_a_stage_begins_with_one_task_alone(stages: list[str], slots: int, chance: Random) -> None:
    """However many may run at once, and in whatever order they end."""
    tasks = [Sum(n, stage=stage) for n, stage in enumerate(stages)]
    frontier = Frontier()
    frontier.add(tasks)
    running: list[Any] = []
    ended: list[Any] = []
    while True:
        while len(running) < slots and (task := frontier.take()) is not None:
            same = [other for other in running if other.stage == task.stage]
            assert not same or any(other.stage == task.stage for other in ended)
            running.append(task)
        if not running:
            break
        task = running.pop(chance.randrange(len(running)))
        assert [o.key for o in frontier.learn(Outcome(task.key, task.stage))] == [task.key]
        ended.append(task)
    assert sorted(ended, key=lambda task: int(task.name)) == tasks


@given(
    st.lists(st.lists(st.integers(0, 20), max_size=3), max_size=15),
    st.sets(st.integers(0, 14), max_size=4),
)
def test_what_needs_a_failure_is_refused_and_all_else_runs_after_its_needs(
    edges: list[list[int]], failing: set[int]
) -> None:
    tasks = graph(edges, failing)
    ORDER.clear()
    outcomes = {outcome.key: outcome for outcome in execute(planned(tasks), None, None)}
    bad: set[str] = set()
    for task in tasks:
        if task.takes["error"] or bad.intersection(task.needs):
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


@given(
    st.lists(st.lists(st.integers(0, 20), max_size=3), max_size=25),
    st.dictionaries(st.integers(0, 24), st.integers(0, 2)),
    st.integers(1, 5),
    st.randoms(),
)
def test_tasks_travel_together_after_their_needs_and_none_is_lost_or_done_twice(
    edges: list[list[int]], failures: dict[int, int], share: int, chance: Random
) -> None:
    """Whatever fails, for good or in passing, and however many a lost worker takes along."""
    tasks = graph(edges, set())
    frontier = Frontier(retries=1)
    frontier.add(tasks)
    tries: Counter[str] = Counter()
    ended: dict[str, Outcome] = {}
    running: list[tuple[Task, ...]] = []

    def outcome_of(task: Task, lost: bool) -> Outcome:
        tries[task.key] += 1
        assert all(ended[need].ok for need in task.needs if need not in keys)
        bad = lost or tries[task.key] <= failures.get(int(task.name), 0)
        return Outcome(task.key, task.stage, {}, not bad, "worn out" * bad, 0.1, passing=bad)

    while True:
        while len(running) < 3 and (together := frontier.take_together(share)):
            assert len(together) == 1 or not any(tries[task.key] for task in together)
            running.append(together)
        if not running:
            break
        together = running.pop(chance.randrange(len(running)))
        keys = [task.key for task in together]
        lost = not chance.randrange(10)
        outcomes = in_turn(together, lambda task, lost=lost: outcome_of(task, lost))
        for outcome in frontier.learn_together(together, outcomes):
            assert outcome.key not in ended
            ended[outcome.key] = outcome
    assert frontier.idle
    assert set(ended) == {task.key for task in tasks}
    for task in tasks:
        assert ended[task.key].refused == any(not ended[need].ok for need in task.needs)


def test_only_short_tasks_travel_together() -> None:
    """By what they took so far in this run; as many as one worker may take, and what they free."""
    frontier = Frontier()
    for stage, seconds in {"a": 0.125, "b": 0.125, "c": 0.75}.items():
        for n in range(1 + LEAST):
            frontier.add([Sum(n, stage=stage)])
            assert len(frontier.take_together(9)) == 1
            list(frontier.learn(Outcome(f"{stage}-{n}", stage, {}, True, seconds=seconds)))
    frontier.add(Sum(n, stage="a") for n in range(10, 30))
    frontier.add([Sum(10, ("a-10",), stage="b"), Sum(10, ("b-10",), stage="c")])
    frontier.add([Sum(11, ("b-10",), stage="c"), Sum(12, ("a-11", "a-29"), stage="b")])

    def keys(share: int) -> list[str]:
        return [task.key for task in frontier.take_together(share)]

    assert keys(1) == ["a-10", "b-10", "c-10"]
    assert keys(3) == ["a-11", "a-12", "a-13"]
    assert keys(99) == [f"a-{n}" for n in range(14, 22)]
    assert keys(99) == [f"a-{n}" for n in range(22, 30)]
    assert keys(99) == []


def test_dask_gives_the_same_outcomes_in_the_same_order(workers: distributed.Client) -> None:
    tasks = graph([[], [0], [], [1, 2], [3], [0], [5, 4]] + [[n] for n in range(40)], {2, 20})
    here = execute(planned(tasks), None, None)
    seen: list[Outcome] = []
    there = execute(planned(tasks), workers, lambda outcome, *_: seen.append(outcome))
    assert [(o.key, o.facts, o.reason) for o in there] == [(o.key, o.facts, o.reason) for o in here]
    assert len(seen) == len(tasks)
    again = execute(planned([Sum(0, error="odd")]), workers, None)
    assert again[0].reason == "ZeroDivisionError: odd"
    assert "Traceback" in again[0].details


def test_watchers_see_the_work_of_each_stage() -> None:
    seen: list[tuple[str, int, int]] = []
    tasks = [Sum(0), Sum(1, work=5), Sum(2, stage="other")]
    execute(planned(tasks), None, lambda outcome, *counts: seen.append((outcome.stage, *counts)))
    assert seen == [("sum", 2, 7), ("sum", 7, 7), ("other", 2, 2)]


def test_no_cluster_is_started_for_one_worker() -> None:
    with dask_client(None, 1, 10**9) as client:
        assert client is None


def row(tasks: int, *, done: bool, stage: str = "nap", needs: tuple[str, ...] = ()) -> list[Task]:
    return [Nap(TileKey(i, 0), stage, needs=needs, done=done) for i in range(tasks)]


def test_what_is_done_starts_no_worker_and_few_tasks_start_few(
    workers: distributed.Client, tmp_path: Path
) -> None:
    started: list[int] = []

    @contextmanager
    def start(count: int) -> Iterator[distributed.Client]:
        started.append(count)
        yield workers

    after = row(5, done=True, stage="after", needs=("nap-0_0", "nap-1_0"))
    with LateClient(8, start) as late, report_kept(late, tmp_path / "dask.html"):
        seen: list[tuple[int, int]] = []
        plan = planned([*row(9, done=True), *after])
        there = execute(plan, late, lambda _, *counts: seen.append(counts))
        assert all(outcome.ok and not outcome.made for outcome in there)
        assert seen[:3] == [(1, 9), (2, 9), (1, 5)]

        def more(outcome: Outcome) -> list[Task]:
            return row(4, done=True, stage="cells") if outcome.stage == "nap" else []

        assert len(execute(planned(row(1, done=True)), late, None, grow=more)) == 5
        assert started == []
    assert not (tmp_path / "dask.html").exists()
    with LateClient(8, start) as late, report_kept(late, tmp_path / "dask.html"):
        some = planned([*row(9, done=True), *row(3, done=False, stage="cells")])
        assert [o.made for o in execute(some, late, None)] == [False] * 9 + [True] * 3
        assert execute(planned(row(9, done=True)), late, None)[8].facts == {"result": "of before"}
    with LateClient(8, start) as late:  # how far a plan grows is not known
        assert len(execute(planned(row(1, done=False)), late, None, grow=more)) == 5
    assert started == [3, 8]
    assert "<html" in (tmp_path / "dask.html").read_text()[:200]


def test_a_plan_names_the_task_that_does_not_fit() -> None:
    tasks = (Sum(0), Sum(1, count=2 * 10**9 - BASE_BYTES))
    plan = Plan.of(tasks, 2 * 10**9)
    assert plan.promised_bytes == 2 * 10**9
    assert list(plan.describe()) == [("sum", 2, 2 * 10**9)]
    with pytest.raises(PlanError, match=r"sum-1 needs 2,000 MB and may use 1,000 MB"):
        Plan.of(tasks, 10**9)


@pytest.mark.parametrize(
    ("how", "failures", "runs", "reason"),
    [
        ("disk", 2, 3, ""),
        ("disk", 9, 3, "[Errno 28] No space left on device (OSError) (tried 3 times)"),
        ("memory", 1, 2, ""),
        ("path", 1, 1, "[Errno 20] Not a directory (NotADirectoryError)"),
        ("no such tile", 1, 1, "no such tile"),
        ("bug", 1, 1, "ZeroDivisionError: bug"),
    ],
)
def test_what_may_pass_is_tried_again_and_a_verdict_stands(
    how: str, failures: int, runs: int, reason: str, tmp_path: Path
) -> None:
    nap = Nap(TileKey(0, 0), failures=failures, how=how, notes=str(tmp_path))
    after = Nap(TileKey(0, 0), "after", needs=(nap.key,))
    other = Nap(TileKey(1, 0))
    first, second, third = execute(planned([nap, after, other]), None, None, retries=2)
    assert len(list(tmp_path.iterdir())) == runs
    assert first.reason == reason
    assert second.reason == (f"not run, since {nap.key} failed: {reason}" if reason else "")
    assert third.ok


def test_a_tile_goes_through_all_stages_before_the_last_one_has_begun() -> None:
    tiles = [TileKey(i, 0) for i in range(50)]
    stages = [
        Nap(tile, stage, needs=(f"{before}-{tile}",) if before else ())
        for before, stage in itertools.pairwise(("", "cells", "terms", "factors"))
        for tile in tiles
    ]
    order: list[str] = []
    execute(planned(stages), None, lambda outcome, *_: order.append(outcome.key))
    assert order[:3] == ["cells-0_0", "terms-0_0", "factors-0_0"]
    assert len(order) == len(set(order)) == 150


@pytest.mark.parametrize("on_dask", [False, True])
def test_a_plan_grows_while_it_runs(on_dask: bool, request: pytest.FixtureRequest) -> None:
    """What is added may need what is done, what is open and what has failed."""
    client = request.getfixturevalue("workers") if on_dask else None
    more = {
        "sum-0": [Sum(2, ("sum-0",)), Sum(3, ("sum-1",)), Sum(4, ("sum-2",)), Sum(5, ("sum-3",))],
        "sum-4": [Sum(6, ("sum-1", "sum-4")), Sum(7)],
    }
    totals: list[int] = []
    outcomes = execute(
        planned([Sum(0), Sum(1, error="ours")]),
        client,
        lambda _, ended, total: totals.append(total - ended),
        grow=lambda outcome: more.get(outcome.key, ()),
    )
    assert [outcome.key for outcome in outcomes] == [f"sum-{n}" for n in range(8)]
    assert [outcome.key for outcome in outcomes if not outcome.ok] == [
        "sum-1",
        "sum-3",
        "sum-5",
        "sum-6",
    ]
    assert {o.reason for o in outcomes if o.refused} == {
        "not run, since sum-1 failed: no such number"
    }
    assert totals[-1] == 0


def test_what_a_finished_task_frees_runs_before_anything_new() -> None:
    """One tile's factors before another tile's merge, also of tasks that came while it ran."""
    tiles = [TileKey(i, 0) for i in range(6)]
    late = ("cells", "terms", "factors")

    def after(tile: TileKey) -> list[Task]:
        chain = zip(("merge", *late), late, strict=False)
        return [Nap(tile, stage, needs=(f"{before}-{tile}",)) for before, stage in chain]

    merges = [Nap(tile, "merge") for tile in tiles]
    rest = [task for tile in tiles for task in after(tile)]
    order: list[str] = []
    execute(
        planned([Nap(tiles[0])]),
        None,
        lambda outcome, *_: order.append(outcome.key),
        grow=lambda outcome: [*merges, *rest] if outcome.stage == "nap" else (),
    )
    stages = [key.split("-")[0] for key in order[1:]]
    assert stages == ["merge", *late] * len(tiles)


def test_what_reads_more_than_was_expected_is_refused_by_name_before_it_runs(
    tmp_path: Path,
) -> None:
    nap = Nap(TileKey(0, 0), notes=str(tmp_path))
    large = replace(nap, reads={"after": After((), {"bytes": MEMORY})})
    (outcome,) = execute(planned([large]), None, None)
    assert outcome.reason.startswith("nap-0_0 needs 1,350 MB and may use 1,000 MB: allow more")
    assert not list(tmp_path.iterdir())


def test_a_long_chain_of_refusals_is_no_recursion() -> None:
    chain = [Nap(TileKey(0, 0), notes="/nowhere/at/all", how="bug")]
    chain += [Nap(TileKey(i, 0), needs=(f"nap-{i - 1}_0",)) for i in range(1, 5000)]
    outcomes = execute(planned(chain), None, None)
    assert sum(outcome.ok for outcome in outcomes) == 0
    assert outcomes[-1].reason.startswith("not run, since nap-0_0 failed: [Errno 2]")


def test_a_local_cluster_listens_on_loopback_alone(workers: distributed.Client) -> None:
    assert workers.dashboard_link.startswith("http://127.0.0.1:")
    sockets = psutil.Process().net_connections("tcp")
    for child in psutil.Process().children(recursive=True):
        sockets += child.net_connections("tcp")
    heard = {socket.laddr.ip for socket in sockets if socket.status == psutil.CONN_LISTEN}
    assert heard == {"127.0.0.1"}


def test_nobody_joins_a_local_cluster_without_its_certificates(
    workers: distributed.Client, tmp_path: Path
) -> None:
    """Nor as the owner of others, whatever process of this machine it is."""
    address = workers.scheduler.address
    assert address.startswith("tls://127.0.0.1:")
    with (
        pytest.raises(UsageError, match="wants certificates"),
        dask_client(address, None, 1),
    ):
        pass
    with dask.config.set({"distributed.comm.timeouts.connect": "2s"}):
        for stranger in (address.replace("tls:", "tcp:"), address):
            tls = certificates(tmp_path) if stranger == address else None
            with pytest.raises(TaskError, match="answers"), dask_client(stranger, 1, 1, tls=tls):
                pass


def test_a_worker_is_one_thread_with_a_limit(workers: distributed.Client) -> None:
    names = [f"{library}_NUM_THREADS" for library in ("NUMBA", "OPENBLAS", "OMP", "MKL")]
    found = workers.run(lambda: [os.environ.get(name) for name in names])
    assert list(found.values()) == [["1"] * 4] * 2
    assert list(workers.nthreads().values()) == [1, 1]
    limits = [w["memory_limit"] for w in workers.scheduler_info()["workers"].values()]
    assert limits == [4 * 10**9] * 2  # twice the memory that the fixture gives a task


@contextmanager
def kinds(**limits: int) -> Iterator[distributed.Client]:
    """A client of workers in this process that may use different amounts of memory [bytes]."""
    scheduler = {"cls": distributed.Scheduler, "options": {"dashboard_address": ":0"}}
    workers = {
        name: {"cls": distributed.Worker, "options": {"nthreads": 1, "memory_limit": limit}}
        for name, limit in limits.items()
    }
    with (
        # What this process holds of earlier tests must not make a small one pause.
        dask.config.set({"distributed.worker.memory.pause": False}),
        distributed.SpecCluster(workers, scheduler) as cluster,
        distributed.Client(cluster) as client,
    ):
        client.wait_for_workers(len(limits))
        yield client


def test_workers_of_two_kinds_share_the_work_if_each_holds_any_task() -> None:
    naps = [Nap(TileKey(i, 0), seconds=0.1) for i in range(12)]
    with kinds(large=4 * MEMORY, small=MEMORY) as client:
        client.get_task_stream()  # from now on it is kept
        assert all(outcome.ok for outcome in execute(planned(naps), client, None))
        assert {task["worker"] for task in client.get_task_stream()} == set(client.nthreads())
    with (
        kinds(large=4 * MEMORY, small=MEMORY // 2) as client,
        pytest.raises(UsageError, match=r"may use 500 MB, and a task 1,000 MB: start it with more"),
    ):
        execute(planned(naps), client, None)


def test_a_killed_worker_is_replaced_and_its_task_done(
    workers: distributed.Client, tmp_path: Path
) -> None:
    naps = [Nap(TileKey(i, 0)) for i in range(20)]
    naps[3] = Nap(TileKey(3, 0), failures=1, how="killed", notes=str(tmp_path))
    outcomes = execute(planned(naps), workers, None)
    assert [o.facts["result"] for o in outcomes] == [f"{i}_0" for i in range(20)]
    assert len(list(tmp_path.iterdir())) == 2


def test_each_stage_is_one_span_and_keys_name_stage_and_tile(workers: distributed.Client) -> None:
    keys: list[str] = []

    class Keys(distributed.SchedulerPlugin):
        def transition(self, key: str, *args: Any, **kwargs: Any) -> None:  # noqa: ARG002
            keys.append(key)

    scheduler = workers.cluster.scheduler
    wait_until(lambda: not scheduler.tasks, "the tasks of the test before are forgotten")
    scheduler.add_plugin(Keys(), name="keys")
    before = set(scheduler.extensions["spans"].spans)
    naps = [Nap(TileKey(i, -1), stage) for stage in ("spa", "spb") for i in range(9)]
    execute(planned(naps), workers, None)
    scheduler.remove_plugin("keys")
    spans = scheduler.extensions["spans"].spans
    named = Counter(spans[key].name for key in spans if key not in before)
    assert named[("tilestream", "spa")] == named[("tilestream", "spb")] == 1
    assert {key.split("-")[0] for key in keys} == {"spa", "spb"}
    assert {key.split("-", 2)[2] for key in keys} <= {f"{i}_-1" for i in range(9)}
    assert len(scheduler.task_prefixes["spa"].groups) <= 1


def test_a_report_is_kept_and_a_lost_scheduler_does_not_hide_the_reason(
    workers: distributed.Client, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with report_kept(workers, tmp_path / "dask.html"):
        execute(planned([Nap(TileKey(0, 0))]), workers, None)
    assert "<html" in (tmp_path / "dask.html").read_text()[:200]
    impossible = tmp_path / "dask.html" / "below-a-file.html"
    with pytest.raises(ZeroDivisionError), report_kept(workers, impossible):
        raise ZeroDivisionError
    assert f"no Dask performance report at {impossible}" in caplog.text
    with report_kept(None, tmp_path / "none.html"):
        pass
    assert not (tmp_path / "none.html").exists()


def test_another_address_than_loopback_is_warned_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(**_: object) -> None:
        raise OSError("no cluster in this test")

    monkeypatch.setattr(distributed, "LocalCluster", refuse)
    with pytest.raises(OSError, match="no cluster"), dask_client(None, 2, 1, host="127.0.0.2"):
        pass
    assert "whoever reaches them can watch the run" in caplog.text


def test_a_worker_that_is_busy_is_waited_for_and_that_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "tilestream")

    class Client:
        status = "running"
        scheduler = SimpleNamespace(address="tcp://10.0.0.1:8786")
        asked = 0

        def run(self, *_: object, **__: object) -> dict[str, list[str]]:
            self.asked += 1
            if self.asked <= 2:
                raise TimeoutError
            return {"tcp://10.0.0.2:1234": []}

    client = Client()
    _Workers(client, patience=60.0, meet=lambda _: None).wait_for_orphans()
    assert client.asked == 3
    assert caplog.text.count("busy and does not answer yet") == 1
    with pytest.raises(TaskError, match="has not answered for 0 s"):
        _Workers(Client(), patience=0.0, meet=lambda _: None).wait_for_orphans()


def test_workers_of_our_own_live_through_an_interrupt(workers: distributed.Client) -> None:
    before = set(workers.run(os.getpid).values())
    for worker in before:
        os.kill(worker, signal.SIGINT)
    assert set(workers.run(os.getpid).values()) == before


@pytest.mark.slow
def test_workers_print_nothing(tmp_path: Path) -> None:
    script = tmp_path / "quiet.py"
    script.write_text(QUIET.format(tests=str(Path(__file__).parent)))
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    command = [sys.executable, script]
    told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    assert told.stdout == "3 of 4\n"
    assert told.stderr == ""


QUIET = """
import sys
sys.path.insert(0, {tests!r})
from elsewhere import scheduler_elsewhere
from naps import MEMORY, Nap
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.plan import Plan
from tilestream.grid import TileKey

if __name__ == "__main__":
    naps = [Nap(TileKey(i, 0)) for i in range(3)]
    naps.append(Nap(TileKey(3, 0), how="killed", failures=9, notes=sys.path[1]))
    with dask_client(None, 2, 10**9) as client:
        outcomes = execute(Plan(tuple(naps), MEMORY), client, None, retries=1)
    print(sum(outcome.ok for outcome in outcomes), "of", len(outcomes))
"""


def test_a_scheduler_without_workers_is_given_up() -> None:
    with (
        scheduler_elsewhere(0, plain=True) as (address, _),
        dask_client(address, None, 1) as client,
        pytest.raises(TaskError, match=r"has had no worker for 1 s: start workers"),
    ):
        execute(planned([Nap(TileKey(0, 0))]), client, None, patience=1.0)


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """A scheduler in a process of its own, with a worker."""
    with scheduler_elsewhere(1, plain=True) as found:
        yield found


def test_a_run_waits_for_what_a_killed_client_left_behind(
    elsewhere: tuple[str, list["subprocess.Popen[bytes]"]], tmp_path: Path
) -> None:
    address, _ = elsewhere
    script = tmp_path / "killed.py"
    notes = tmp_path / "notes"
    notes.mkdir()
    script.write_text(KILLED.format(tests=str(Path(__file__).parent)))
    first = subprocess.Popen([sys.executable, script, address, tmp_path / "notes"])
    wait_until(lambda: list(notes.glob("nap-*")), "the first client's task runs")
    first.kill()
    first.wait()
    began = time.time_ns()
    with dask_client(address, None, 1) as client:
        execute(planned([Nap(TileKey(1, 0), notes=str(notes))]), client, None)
    (left,) = notes.glob("nap-0_0-*")
    (right,) = notes.glob("nap-1_0-*")
    ends = int(left.name.rsplit("-", 1)[1]) + 3 * 10**9
    assert began < ends < int(right.name.rsplit("-", 1)[1])


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from elsewhere import scheduler_elsewhere
from naps import MEMORY, Nap
from tilestream.pipeline.engine.cluster import dask_client
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.plan import Plan
from tilestream.grid import TileKey

with dask_client(sys.argv[1], None, 1) as client:
    execute(Plan((Nap(TileKey(0, 0), after=3.0, notes=sys.argv[2]),), MEMORY), client, None)
"""


def test_the_loss_of_a_scheduler_is_told(
    elsewhere: tuple[str, list["subprocess.Popen[bytes]"]],
) -> None:
    """The last one with this scheduler."""
    address, processes = elsewhere
    with dask_client(address, None, 1) as client:
        naps = [Nap(TileKey(i, 0)) for i in range(10)]
        assert all(outcome.ok for outcome in execute(planned(naps), client, None))

        def kill(outcome: Outcome, ended: int, total: int) -> None:
            if ended == 3:
                processes[0].kill()

        naps = [Nap(TileKey(i, 0), seconds=0.05) for i in range(200)]
        with pytest.raises(TaskError, match=rf"{address} is gone: run the same command again"):
            execute(planned(naps), client, kill)


def test_certificates_are_passed_through(tmp_path: Path) -> None:
    tls = certificates(tmp_path)
    with scheduler_elsewhere(0, tls, plain=True) as (address, _):
        with dask_client(address, None, 1, tls=tls) as client:
            assert client.scheduler.address == address
        with (
            pytest.raises(UsageError, match=r"wants certificates: give --tls-ca"),
            dask_client(address, None, 1),
        ):
            pass
        (tmp_path / "other").mkdir()
        strange = certificates(tmp_path / "other")
        with (
            pytest.raises(TaskError, match=r"no Dask .* answers at .* or not to these certificate"),
            dask_client(address, None, 1, tls=strange),
        ):
            pass
        with (
            pytest.raises(UsageError, match=r"is no scheduler that can be asked: .*ncryption"),
            dask_client(address.replace("tls", "tcp"), None, 1, tls=tls),
        ):
            pass


def test_certificates_that_do_not_fit_together_are_named(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    ours, theirs = certificates(tmp_path), certificates(tmp_path / "other")
    for wrong in (replace(ours, key=theirs.key), replace(ours, ca=__file__)):
        with pytest.raises(UsageError, match=r"key\.pem are no certificates that fit together"):
            wrong.security()


def test_nobody_answers() -> None:
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "500ms"}),
        pytest.raises(TaskError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"),
        dask_client("tcp://127.0.0.1:9", None, 1),
    ):
        pass


def test_a_client_that_failed_is_closed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it closes itself when it is collected, which may be inside of Dask's own lock."""
    made: list[distributed.Client] = []
    start = distributed.Client.start

    def noted(client: distributed.Client, **how: Any) -> None:
        made.append(client)
        start(client, **how)

    monkeypatch.setattr(distributed.Client, "start", noted)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "200ms"}),
        pytest.raises(TaskError, match="no Dask scheduler answers"),
        dask_client("tcp://127.0.0.1:1", None, 1),
    ):
        pass
    (client,) = made
    assert client.status == "closed"
    assert not client._loop_runner.is_started()


def test_an_address_that_is_none() -> None:
    with (
        pytest.raises(UsageError, match="'no where' is no scheduler"),
        dask_client("no where", 1, 1),
    ):
        pass
