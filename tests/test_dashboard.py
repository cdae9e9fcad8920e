"""The Tilestream page: what it counts, that it escapes, that a browser sees tiles change."""

import http.client
import io
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import dask
import distributed
import pytest
from bokeh.util.token import generate_jwt_token
from chromium import chromium_page
from elsewhere import scheduler_elsewhere
from hypothesis import given
from hypothesis import strategies as st
from naps import MEMORY, Nap
from patience import wait_until
from PIL import Image
from scenes import scene

from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import TileKey
from tilestream.pipeline.engine.cluster import ORIGINS, dask_client
from tilestream.pipeline.engine.dashboard import (
    GREY,
    RED,
    clock,
    failures_html,
    look,
    stages_html,
    workers_html,
)
from tilestream.pipeline.engine.events import page_url
from tilestream.pipeline.engine.executor import execute
from tilestream.pipeline.engine.plan import Plan
from tilestream.pipeline.engine.progress import (
    DONE,
    FAILED,
    MOST_FAILURES,
    NAME,
    REFUSED,
    RUNNING,
    STATUSES,
    WAITING,
    Progress,
)

EVIL = "<img src=x onerror=\"document.title='taken'\"> & 'quotes'"


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def planned(tasks: int, work: int = 1, clock: Clock | None = None) -> Progress:
    progress = Progress("client", clock or Clock())
    lines = [[f"terms-{i}", 0, work, i, -i] for i in range(tasks)]
    progress.plan([["terms", 10**9]], lines)
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
            progress.learn([[f"terms-{number}", STATUSES.index(event), "x", "why"]])
            ended.setdefault(number, event)
            running.discard(number)
    facts = progress.facts()["stages"][0]
    found = Counter(ended.values())
    assert [facts[status] for status in STATUSES[2:]] == [found[s] for s in STATUSES[2:]]
    assert facts["running"] == len(running)
    assert sum(facts[status] for status in STATUSES) == facts["tasks"] == 10
    assert progress.failed == found["failed"]
    tiles = progress.tile_facts()
    for number in range(10):
        status = ended.get(number, "running" if number in running else "waiting")
        assert tiles[f"{number}_{-number}"] == {"terms": status}
    shown = {progress.tiles[place][0] for place in progress.changes}
    assert set(ended) | running <= shown


def test_rate_and_time_left() -> None:
    now = Clock()
    progress = planned(100, work=5, clock=now)
    assert progress.facts()["stages"][0]["seconds_left"] is None
    for number in range(40):
        progress.seen(f"terms-{number}", running=True)
        now.now += 0.5
        progress.learn([[f"terms-{number}", DONE, "", ""]])
    facts = progress.facts()["stages"][0]
    assert facts["tasks_per_second"] == 2.0
    assert facts["seconds_left"] == 30.0
    progress.learn([[f"terms-{number}", REFUSED, "", ""] for number in range(40, 70)])
    facts = progress.facts()["stages"][0]
    assert facts["tasks_per_second"] == 2.0
    assert facts["seconds_left"] == 15.0
    now.now += 1000.0
    assert progress.facts()["stages"][0]["seconds_left"] is None


def test_a_second_plan_adds_to_the_first() -> None:
    progress = planned(3)
    progress.plan([["factors", 7], ["terms", 2 * 10**9]], [["f-0", 0, 9, 0, 0], ["t", 1, 1, 5, 5]])
    progress.plan([["report", 7]], [["report-all", 0, 1, None, None]])
    assert [stage.name for stage in progress.stages] == ["terms", "factors", "report"]
    assert progress.stages[0].promised_bytes == 2 * 10**9
    assert sum(progress.stages[0].counts) == 4
    assert progress.tile_facts()["0_0"] == {"terms": "waiting", "factors": "waiting"}
    assert len(progress.tiles) == 4


def test_failures_are_kept_up_to_a_bound() -> None:
    progress = planned(MOST_FAILURES + 5)
    for number in range(MOST_FAILURES + 5):
        progress.learn([[f"terms-{number}", FAILED, f"terms-{number}", "why"]])
    facts = progress.facts()
    assert len(facts["failures"]) == MOST_FAILURES
    assert facts["failures_not_listed"] == 5


def test_the_state_of_a_hundred_thousand_tasks_is_small() -> None:
    progress = Progress("client")
    for first in range(0, 100_000, 500):
        lines = [
            [f"terms-ts0abcde-{i}_0", 0, 1, i % 300, i // 300] for i in range(first, first + 500)
        ]
        progress.plan([["terms", 1]], lines)
    began = time.process_time()
    progress.learn([[f"terms-ts0abcde-{i}_0", DONE, "", ""] for i in range(100_000)])
    assert time.process_time() - began < 3.0  # 0.2 s; with a look at all tasks for each, minutes
    assert progress.stages[0].counts == [0, 0, 100_000, 0, 0]
    assert not progress._open


@pytest.mark.parametrize(
    ("statuses", "fill", "line"),
    [
        ([(0, WAITING), (1, WAITING)], GREY, GREY),
        ([(0, DONE), (1, WAITING)], "#a", "#a"),
        ([(0, DONE), (1, RUNNING)], "#b", "black"),
        ([(0, DONE), (1, DONE)], "#b", "#b"),
        ([(0, FAILED), (1, REFUSED)], RED, RED),
        ([(0, RUNNING), (1, FAILED)], RED, RED),
    ],
)
def test_a_tile_looks_as_its_most_telling_stage(
    statuses: list[tuple[int, int]], fill: str, line: str
) -> None:
    assert look(statuses, ["#a", "#b"])[::2] == (fill, line)


def test_what_is_shown_is_escaped() -> None:
    stage = planned(1).facts()["stages"][0]
    worker = {"worker": EVIL, "bytes": 1, "peak_bytes": 2, "limit_bytes": 3}
    for shown in (
        failures_html([{"key": EVIL, "reason": EVIL}], 0),
        stages_html([{**stage, "stage": EVIL}], ["#abc"]),
        workers_html([worker], 10),
    ):
        assert "&lt;img src=x" in shown
        assert "<img" not in shown


def test_a_worker_beyond_its_promise_is_red() -> None:
    worker = {"worker": "1", "bytes": 1, "peak_bytes": 2 * 10**9, "limit_bytes": 3}
    assert RED in workers_html([worker], 10**9)
    assert RED not in workers_html([worker], 3 * 10**9)
    assert "and 3 workers" in workers_html([worker] * 43, 10**9)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (99.0, "99 s"), (130.0, "2 min"), (7500.0, "2 h 5 min"), (4e6, "1,111 h 7 min")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def city(n: int, notes: Path, gate: str = "") -> Plan:
    """n x n tiles in three stages; those on the diagonal fail in the second. The first waits
    for a gate."""
    tiles = [TileKey(i, j) for i in range(n) for j in range(n)]
    merges = [Nap(tile, "merge", gate=gate) for tile in tiles]
    terms = [
        Nap(
            tile,
            "terms",
            needs=(f"merge-{tile}",),
            how=EVIL,
            notes=str(notes) if tile.ix == tile.iy else "",
            failures=9,
        )
        for tile in tiles
    ]
    factors = [Nap(tile, "factors", needs=(f"terms-{tile}",)) for tile in tiles]
    return Plan((*merges, *terms, *factors), MEMORY)


def get_json(url: str) -> dict[str, Any]:
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        assert answer.headers["Content-Type"] == "application/json"
        return dict(json.loads(answer.read()))


@pytest.fixture
def new_workers() -> Iterator[distributed.Client]:
    with dask_client(None, 2, 10**9) as client:
        yield client


TILES = "Bokeh.documents[0].get_model_by_name('tiles').data"
READY = f"window.Bokeh && Bokeh.documents.length && {TILES} && {TILES}.x.length"
WORDS = """[...document.querySelectorAll('*')].filter(e => e.shadowRoot).map(function walk(e) {
    return e.shadowRoot ? e.shadowRoot.textContent + [...e.shadowRoot.querySelectorAll('*')]
        .filter(c => c.shadowRoot).map(walk).join(' ') : ''; }).join(' ')"""


def test_a_browser_sees_tiles_change(new_workers: distributed.Client, tmp_path: Path) -> None:
    artefacts = Path(os.environ.get("TILESTREAM_ARTEFACTS", tmp_path))
    url = page_url(new_workers)
    assert url is not None
    n = 6
    gate = tmp_path / "gate"
    tasks = city(n, tmp_path, str(gate))
    run = threading.Thread(target=execute, args=(tasks, new_workers, None))
    with chromium_page() as page:
        run.start()
        wait_until(lambda: answers(f"{url}.json"), "the dashboard answers")
        page.goto(url)
        page.wait_for(READY)
        first = page.evaluate(f"[...{TILES}.fill]")
        assert len(first) == n * n
        page.wait_for(f"{TILES}.line.includes('black')")  # one runs
        early = page.screenshot(artefacts / "dashboard-early.png")
        gate.touch()
        run.join()
        page.wait_for(f"[...{TILES}.fill].filter(c => c == '{RED}').length == {n}")
        page.wait_for(f"!{TILES}.line.includes('black')")
        end = page.screenshot(artefacts / "dashboard-end.png")
        assert page.evaluate(f"new Set({TILES}.fill).size") == 2
        words = page.evaluate(WORDS)
        assert "terms-3_3" in words
        assert EVIL in words  # as text, not as an element
        assert page.evaluate("document.title") == "Tilestream"
        assert page.errors == []
        elsewhere = [r for r in page.requests if not r.startswith((url.rsplit("/", 1)[0], "data:"))]
        assert elsewhere == []
        page.goto(url.replace("tilestream", "status"))
        assert page.evaluate("!!document.querySelector('.navbar a[href=tilestream]')")
    assert coloured(early, RED) < coloured(end, RED)
    assert coloured(early, GREY) > coloured(end, GREY)


@pytest.mark.parametrize("page", ["status", NAME])
def test_only_pages_of_the_dashboard_itself_talk_to_it(
    workers: distributed.Client, page: str
) -> None:
    """Not those of a site that somebody looks at who can reach it, whatever name it goes by."""
    execute(Plan((Nap(TileKey(0, 0)),), MEMORY), workers, None)
    port = int(workers.dashboard_link.split(":")[2].split("/")[0])
    for own in (f"http://127.0.0.1:{port}", f"http://localhost:{port}"):
        assert handshake(port, page, own) == 101
    for foreign in ("http://evil.example", f"http://evil.example:{port}", "http://localhost:1"):
        assert handshake(port, page, foreign) == 403


def test_names_of_a_proxy_are_given_to_dask() -> None:
    with (
        dask.config.set({ORIGINS: ["city.example:80"]}),
        dask_client(None, 2, 10**9, host="127.0.0.2") as client,
    ):
        port = int(client.dashboard_link.split(":")[2].split("/")[0])
        where = ("127.0.0.2", f"127.0.0.2:{port}", f"{socket.gethostname()}:{port}")
        for own in ("city.example", *where[1:]):
            assert handshake(port, "status", f"http://{own}", where[0]) == 101
        assert handshake(port, "status", "http://evil.example", where[0]) == 403


def handshake(port: int, page: str, origin: str, host: str = "127.0.0.1") -> int:
    """What the dashboard answers to a page of this origin that asks for a WebSocket."""
    connection = http.client.HTTPConnection(host, port)
    wanted = {
        "Origin": origin,
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"bokeh, {generate_jwt_token('stranger')}",
    }
    connection.request("GET", f"/{page}/ws", headers=wanted)
    status = connection.getresponse().status
    connection.close()
    return status


def answers(url: str) -> bool:
    try:
        get_json(url)
    except urllib.error.HTTPError:
        return False
    return True


def coloured(picture: Path, colour: str) -> int:
    """Pixels of a colour."""
    wanted = tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))
    with Image.open(io.BytesIO(picture.read_bytes())) as image:
        return sum(count for count, rgb in image.convert("RGB").getcolors(2**24) if rgb == wanted)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_page_is_there_when_its_address_is_printed(elsewhere: bool, tmp_path: Path) -> None:
    write_pcd(tmp_path / "street.pcd", scene("canyon", 1, spacing=0.5))
    program = [sys.executable, "-m", "tilestream", "ingest", "street.pcd", "--store", "map.zarr"]
    with ExitStack() as stack:
        where = ["--workers", "2"]
        if elsewhere:
            where = ["--scheduler", stack.enter_context(scheduler_elsewhere(1))[0]]
        run = stack.enter_context(
            subprocess.Popen([*program, *where], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        )
        assert run.stderr is not None
        (told,) = islice((line for line in run.stderr if line.startswith("Watch it at")), 1)
        with urllib.request.urlopen(told.split()[-1], timeout=60.0) as page:
            assert page.status == 200
            assert "Tilestream" in page.read().decode()
        run.communicate()
    assert run.returncode == 0


def test_machines_get_the_same_from_a_scheduler_in_another_process(tmp_path: Path) -> None:
    with scheduler_elsewhere(1) as (address, _):
        with dask_client(address, None, 1) as client:
            url = page_url(client)
            assert url is not None
            plan = city(3, tmp_path)
            execute(plan, client, None)
            execute(Plan((Nap(TileKey(9, 9), "report"),), MEMORY), client, None)
            facts = get_json(f"{url}.json?tiles=1")
        assert facts["state"] == "ended"
        found = {stage["stage"]: [stage[name] for name in STATUSES] for stage in facts["stages"]}
        assert found == {
            "merge": [0, 0, 9, 0, 0],
            "terms": [0, 0, 6, 3, 0],
            "factors": [0, 0, 6, 0, 3],
            "report": [0, 0, 1, 0, 0],
        }
        assert {failure["key"] for failure in facts["failures"]} == {
            f"terms-{i}_{i}" for i in range(3)
        }
        assert facts["failures"][0]["reason"] == EVIL
        assert facts["tiles"]["1_1"] == {"merge": "done", "terms": "failed", "factors": "refused"}
        assert facts["promised_bytes"] == plan.promised_bytes > 10**8
        (worker,) = facts["workers"]
        assert worker["peak_bytes"] >= worker["bytes"] > 10**7
        with dask_client(address, None, 1) as client:
            execute(Plan((Nap(TileKey(0, 0)),), MEMORY), client, None)
            facts = get_json(f"{url}.json")
        assert [stage["stage"] for stage in facts["stages"]] == ["nap"]


def test_no_dashboard_no_page_and_no_harm() -> None:
    assert page_url(None) is None
    with (
        distributed.LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        assert execute(Plan((Nap(TileKey(0, 0)),), MEMORY), client, None)[0].ok
