"""What the dashboard counts of a run: tasks, failures, pace and the time left."""

import time
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tilestream.errors import alike
from tilestream.pipeline.engine.progress import (
    DONE,
    FAILED,
    MOST_FAILURES,
    REFUSED,
    STATUSES,
    Progress,
)
from tilestream.pipeline.engine.time_left import (
    LEAST,
    MOST_SLOWER,
    Left,
    Pace,
    slower_than_before,
    time_left,
)

BEFORE = 2.0
"""Seconds per unit of work in earlier runs."""


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def planned(tasks: int, work: int = 1, clock: Clock | None = None) -> Progress:
    progress = Progress("client", clock or Clock())
    lines = [[f"terms-{i}", 0, work, i, -i] for i in range(tasks)]
    progress.plan([["terms", 10**9, BEFORE]], lines)
    return progress


@given(st.lists(st.tuples(st.integers(0, 9), st.sampled_from(["runs", "lost", *STATUSES[2:]]))))
def test_every_task_is_counted_once_whatever_happens(events: list[tuple[int, str]]) -> None:
    progress = planned(10, work=3)
    ended: dict[int, str] = {}
    running: set[int] = set()
    for number, event in events:
        if event in ("runs", "lost"):
            progress.seen(f"terms-{number}", running=event == "runs")
            if number not in ended:
                (running.add if event == "runs" else running.discard)(number)
        else:
            progress.learn([[f"terms-{number}", STATUSES.index(event), "x", "why", 0.0]])
            ended.setdefault(number, event)
            running.discard(number)
    whole = progress.facts(1)
    facts = whole["stages"][0]
    found = Counter(ended.values())
    assert [facts[status] for status in STATUSES[2:]] == [found[s] for s in STATUSES[2:]]
    assert facts["running"] == len(running)
    assert sum(facts[status] for status in STATUSES) == facts["tasks"] == 10
    assert progress.failed == found["failed"]
    assert whole["share_done"] == pytest.approx(len(ended) / 10)
    tiles = progress.tile_facts()
    for number in range(10):
        status = ended.get(number, "running" if number in running else "waiting")
        assert tiles[f"{number}_{-number}"] == {"terms": status}
    shown = {progress.tiles[place][0] for place in progress.changes}
    assert set(ended) | running <= shown


def test_rate_of_a_stage() -> None:
    now = Clock()
    progress = planned(100, work=5, clock=now)
    for number in range(40):
        progress.seen(f"terms-{number}", running=True)
        now.now += 0.5
        progress.learn([[f"terms-{number}", DONE, "", "", 0.5]])
    assert progress.facts(1)["stages"][0]["tasks_per_second"] == 2.0
    progress.learn([[f"terms-{number}", REFUSED, "", "", 0.0] for number in range(40, 70)])
    assert progress.facts(1)["stages"][0]["tasks_per_second"] == 2.0
    now.now += 1000.0
    assert progress.facts(1)["stages"][0]["tasks_per_second"] == 0.0


def test_time_left_by_earlier_runs_then_by_this_one() -> None:
    progress = planned(20, work=5)
    left = progress.facts(threads=4)["left"]
    assert left["seconds"] == pytest.approx(20 * 5 * BEFORE / 4)
    assert (left["low"], left["share_known"], left["complete"]) == (None, 0.0, False)
    for number in range(1 + LEAST):  # the first compiles kernels, and does not count
        progress.learn([[f"terms-{number}", DONE, "", "", 90.0 if number == 0 else 1.0]])
    left = progress.facts(threads=4)["left"]
    assert left["seconds"] == left["low"] == left["high"] == pytest.approx(16 * 1.0 / 4)
    assert left["share_known"] == 1.0
    progress.learn([[f"terms-{number}", REFUSED, "", "", 0.0] for number in range(10, 20)])
    assert progress.facts(threads=4)["left"]["seconds"] == pytest.approx(6 * 1.0 / 4)
    assert progress.facts(threads=0)["left"]["seconds"] is None


def test_what_is_expected_counts_until_it_is_planned() -> None:
    progress = planned(2)
    progress.expect([["terms", 1, BEFORE, 5, 5], ["train", 1, 7.0, 1, 1]], complete=True)
    facts = progress.facts(threads=1)
    assert facts["left"]["seconds"] == pytest.approx(5 * BEFORE + 7.0)
    assert facts["left"]["complete"]
    assert [stage["expected"] for stage in facts["stages"]] == [3, 1]
    progress.plan([["terms", 1, BEFORE]], [[f"terms-{i}", 0, 1, i, 0] for i in range(2, 5)])
    assert progress.facts(threads=1)["left"]["seconds"] == facts["left"]["seconds"]
    progress.expect([], complete=True)
    assert progress.facts(threads=1)["left"]["seconds"] == pytest.approx(5 * BEFORE)


def test_the_longest_task_bounds_the_time_left() -> None:
    stages = [Left(Pace(60.0), 1, 1), Left(Pace(1.0), 10, 10)]
    assert time_left(stages, threads=100).seconds == 60.0
    assert time_left(stages, threads=1).seconds == 70.0


def test_earlier_figures_are_scaled_by_what_this_run_takes() -> None:
    pace, other = Pace(1.0), Pace(10.0)
    assert slower_than_before([pace, other]) == 1.0
    for seconds in (60.0, 2.0, 2.0, 2.0):  # the first does not count
        pace.learn(1, seconds)
    left = [Left(pace, 5, 5), Left(other, 2, 2)]
    assert slower_than_before([pace, other]) == 2.0
    told = time_left(left, threads=1)
    assert told.seconds == 5 * 2.0 + 2 * 20.0
    assert told.share_known == pytest.approx(0.2)
    for _ in range(50):
        pace.learn(1, 100.0)
    assert slower_than_before([pace, other]) == MOST_SLOWER


def test_the_span_holds_what_it_takes() -> None:
    """Of runs whose tasks scatter, about as many end within the span as two sigmas say."""
    rng = np.random.default_rng(0)
    within = []
    for _ in range(400):
        work = rng.integers(1, 20, 60)
        seconds = rng.gamma(4.0 * work, 0.1)  # a variance that grows with the work
        pace = Pace(1.0)
        for some in zip(work[:20].tolist(), seconds[:20].tolist(), strict=True):
            pace.learn(*some)
        told = time_left([Left(pace, float(work[20:].sum()), 40)], threads=1)
        assert told.low is not None
        assert told.high is not None
        within.append(told.low <= seconds[20:].sum() <= told.high)
    assert 0.88 < np.mean(within) < 0.99


def test_a_second_plan_adds_to_the_first() -> None:
    progress = planned(3)
    stages = [["factors", 7, 1.0], ["terms", 2 * 10**9, 1.0]]
    progress.plan(stages, [["f-0", 0, 9, 0, 0], ["t", 1, 1, 5, 5]])
    progress.plan([["report", 7, 1.0]], [["report-all", 0, 1, None, None]])
    assert [stage.name for stage in progress.stages] == ["terms", "factors", "report"]
    assert progress.stages[0].promised_bytes == 2 * 10**9
    assert sum(progress.stages[0].counts) == 4
    assert progress.tile_facts()["0_0"] == {"terms": "waiting", "factors": "waiting"}
    assert len(progress.tiles) == 4


def test_failures_are_kept_up_to_a_bound_and_told_by_reason() -> None:
    progress = planned(MOST_FAILURES + 5)
    for number in range(MOST_FAILURES + 5):
        key = f"terms-{number}_0"
        why = "no space left" if number % 2 else "no memory left"
        progress.learn([[f"terms-{number}", FAILED, key, why, 0.0]])
        if number == 1:
            assert len(progress.facts(1)["reasons"]) == 2
    facts = progress.facts(1)
    assert len(facts["failures"]) == MOST_FAILURES
    assert facts["failures_not_listed"] == 5
    assert facts["reasons"] == alike({f["key"]: f["reason"] for f in facts["failures"]})
    assert facts["reasons"][0] == "500 of terms: no memory left (0_0, 2_0, 4_0, …)"


def test_time_stands_still_once_a_run_has_ended() -> None:
    now = Clock()
    progress = planned(1, clock=now)
    now.now += 3.0
    progress.end("ended")
    now.now += 3.0
    assert progress.facts(1)["seconds"] == 3.0
    assert progress.facts(1)["state"] == "ended"
    assert progress.facts(1)["left"]["complete"]
    progress.plan([["more", 1, 1.0]], [["more-0", 0, 1, None, None]])
    now.now += 4.0
    assert progress.facts(1)["seconds"] == 7.0
    assert progress.facts(1)["state"] == "running"
    assert not progress.facts(1)["left"]["complete"]


def test_the_state_of_a_hundred_thousand_tasks_is_small() -> None:
    progress = Progress("client")
    for first in range(0, 100_000, 500):
        lines = [
            [f"terms-ts0abcde-{i}_0", 0, 1, i % 300, i // 300] for i in range(first, first + 500)
        ]
        progress.plan([["terms", 1, 1.0]], lines)
    began = time.process_time()
    progress.learn([[f"terms-ts0abcde-{i}_0", DONE, "", "", 1.0] for i in range(100_000)])
    assert time.process_time() - began < 3.0  # 0.2 s; with a look at all tasks for each, minutes
    assert progress.stages[0].counts == [0, 0, 100_000, 0, 0]
    assert not progress._open
