"""The Tilestream page: it escapes, and a browser sees tiles, map and estimates come."""

import http.client
import io
import json
import os
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
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
from drawn_run import TILE, drawn_plan, small_map
from elsewhere import scheduler_elsewhere
from naps import MEMORY, Nap
from patience import wait_until
from PIL import Image
from scenes import scene

from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import TileKey
from tilestream.pipeline.engine.attempt import Outcome
from tilestream.pipeline.engine.cluster import ORIGINS, dask_client
from tilestream.pipeline.engine.dashboard.map import COLOURS, HATCHES, look
from tilestream.pipeline.engine.dashboard.plugin import ProgressPlugin
from tilestream.pipeline.engine.dashboard.words import (
    clock,
    failures_html,
    head_html,
    left_words,
    legend_html,
    stages_html,
    workers_html,
)
from tilestream.pipeline.engine.events import serve_page
from tilestream.pipeline.engine.executor import Ahead, execute
from tilestream.pipeline.engine.plan import Plan
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
from tilestream.pipeline.engine.stage import Task
from tilestream.report.colours import FIXED

EVIL = "<img src=x onerror=\"document.title='taken'\"> & 'quotes'"


@pytest.mark.parametrize(
    ("statuses", "state", "words"),
    [
        ([], "waiting", "no task"),
        ([WAITING, WAITING], "waiting", "waiting, 0 of 2 tasks done"),
        ([DONE, WAITING], "done", "waiting, 1 of 2 tasks done"),
        ([DONE, RUNNING], "running", "running, 1 of 2 tasks done"),
        ([DONE, DONE], "done", "done, 2 of 2 tasks done"),
        ([FAILED, REFUSED], "failed", "failed, 0 of 2 tasks done"),
        ([RUNNING, FAILED], "failed", "failed, 0 of 2 tasks done"),
        ([REFUSED, RUNNING], "refused", "refused, 0 of 2 tasks done"),
    ],
)
def test_a_tile_looks_as_its_most_telling_task(statuses: list[int], state: str, words: str) -> None:
    colour, alpha, width, hatch, told = look(statuses)
    assert (colour, hatch, told) == (COLOURS[state], HATCHES.get(state, ""), words)
    assert (width > 1.0) == (state == "running")
    assert (alpha == 0.0) == (state == "waiting")


def test_states_are_told_by_more_than_colour() -> None:
    """In grey too, and where two colours look the same: by pattern, outline, or no fill at all."""
    looks = [look([status])[1:4] for status in range(len(STATUSES))]
    ways = {(alpha == 0.0, width, hatch) for alpha, width, hatch in looks}
    assert len(ways) == len(STATUSES)
    assert len(set(COLOURS.values())) == len(STATUSES)


def test_the_more_of_a_tile_is_done_the_fuller_it_is() -> None:
    alphas = [look([DONE] * done + [WAITING] * (5 - done))[1] for done in range(6)]
    assert alphas == sorted(set(alphas))


def facts_of(progress: Progress) -> dict[str, Any]:
    return {**progress.facts(2), "workers": [], "promised_bytes": 10}


def test_what_is_shown_is_escaped() -> None:
    progress = Progress("client")
    progress.plan([[EVIL, 1, 1.0]], [["a", 0, 1, 0, 0]])
    progress.learn([["a", FAILED, EVIL, EVIL, 1.0]])
    progress.map.tile_mm, progress.map.crs = 1000, EVIL
    facts = facts_of(progress)
    worker = {"worker": EVIL, "bytes": 1, "peak_bytes": 2, "limit_bytes": 3}
    for shown in (
        failures_html(facts),
        stages_html(facts["stages"]),
        legend_html(facts["map"]),
        workers_html([worker], 10),
    ):
        assert "&lt;img src=x" in shown
        assert "<img" not in shown


def test_a_worker_beyond_its_promise_is_told() -> None:
    worker = {"worker": "1", "bytes": 1, "peak_bytes": 2 * 10**9, "limit_bytes": 3}
    assert "2,000 MB over" in workers_html([worker], 10**9)
    assert "over" not in workers_html([worker], 3 * 10**9)
    assert "and 3 workers" in workers_html([worker] * 43, 10**9)


def test_failures_are_told_by_reason_with_what_was_not_run() -> None:
    progress = Progress("client")
    progress.plan([["terms", 1, 1.0]], [[f"t{i}", 0, 1, i, 0] for i in range(5)])
    assert "none" in failures_html(facts_of(progress))
    progress.learn([[f"t{i}", FAILED, f"terms-{i}_0", "no space left", 1.0] for i in range(4)])
    progress.learn([["t4", REFUSED, "", "", 0.0]])
    told = failures_html(facts_of(progress))
    assert "4 of terms: no space left (0_0, 1_0, 2_0, …)" in told
    assert told.count("<li>") == 1
    assert "4 failed, 1 not run" in told


@pytest.mark.parametrize(
    ("left", "words"),
    [
        ((None, None, None, 1.0, True), "no worker yet"),
        ((60.0, None, None, 0.25, True), "about 60 s left (rough: 75% of it by earlier figures)"),
        ((60.0, 50.0, 70.0, 1.0, True), "about 60 s left (50 s to 70 s)"),
        ((60.0, 60.0, 60.0, 1.0, False), "about 60 s left, more follows"),
    ],
)
def test_the_time_left_says_how_sure_it_is(left: tuple[Any, ...], words: str) -> None:
    names = ("seconds", "low", "high", "share_known", "complete")
    assert left_words(dict(zip(names, left, strict=True))) == words


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (99.0, "99 s"), (130.0, "2 min"), (7500.0, "2 h 5 min"), (4e6, "1,111 h 7 min")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def told(plugin: ProgressPlugin, client: str, op: str, **message: Any) -> None:
    plugin.log_event(NAME, {"op": op, "client": client, **message})


def test_the_plugin_shows_the_run_that_was_begun_last() -> None:
    plugin = ProgressPlugin()
    plugin.progress = Progress("")
    tile = {"stages": [["nap", 1, 1.0]], "tasks": [["nap-0_0", 0, 1, 0, 0]]}
    told(plugin, "one", "begin", places=["map"])
    told(plugin, "one", "map", tile_mm=10_000, crs=None)
    told(plugin, "one", "plan", **tile)
    first = plugin.progress
    for places in ([], ["tables", "map"]):  # it goes on
        told(plugin, "one", "begin", places=places)
        assert plugin.progress is first
        assert first.map.tile_mm == 10_000
    told(plugin, "one", "begin", places=["another map"])
    assert (plugin.progress.client, plugin.progress.tiles) == ("one", [])
    assert plugin.progress.map.tile_mm is None
    told(plugin, "one", "plan", **tile)
    told(plugin, "two", "outcomes", outcomes=[["nap-0_0", DONE, "", "", 1.0]])
    assert plugin.progress.stages[0].counts[DONE] == 0  # who has begun nothing is not heard
    told(plugin, "two", "begin", places=["map"])
    told(plugin, "two", "plan", **tile)
    told(plugin, "two", "outcomes", outcomes=[["nap-0_0", DONE, "", "", 1.0]])
    assert plugin.progress.stages[0].counts[DONE] == 1
    plugin.remove_client(None, "one")
    assert plugin.progress.state == "running"
    plugin.remove_client(None, "two")
    assert plugin.progress.state == "lost"
    assert "run the same command again" in head_html(facts_of(plugin.progress))
    told(plugin, "two", "plan", **tile)
    told(plugin, "two", "end", outcomes=[])
    plugin.remove_client(None, "two")
    assert plugin.progress.state == "ended"


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


def model(name: str) -> str:
    return f"Bokeh.documents[0].get_model_by_name('{name}')"


def data(name: str) -> str:
    return f"{model(name)}.data"


def artefacts(folder: Path) -> Path:
    return Path(os.environ.get("TILESTREAM_ARTEFACTS", folder))


TILES = data("tiles")
READY = f"window.Bokeh && Bokeh.documents.length && {TILES} && {TILES}.x.length"
WORDS = """[...document.querySelectorAll('*')].filter(e => e.shadowRoot).map(function walk(e) {
    return e.shadowRoot ? e.shadowRoot.textContent + [...e.shadowRoot.querySelectorAll('*')]
        .filter(c => c.shadowRoot).map(walk).join(' ') : ''; }).join(' ')"""


def test_a_browser_sees_tiles_change(new_workers: distributed.Client, tmp_path: Path) -> None:
    url = serve_page(new_workers)
    assert url is not None
    n = 6
    gate = tmp_path / "gate"
    tasks = city(n, tmp_path, str(gate))
    run = threading.Thread(target=execute, args=(tasks, new_workers, None))
    failed, running = COLOURS["failed"], COLOURS["running"]
    with chromium_page() as page:
        run.start()
        wait_until(lambda: answers(f"{url}.json"), "the dashboard answers")
        page.goto(url)
        page.wait_for(READY)
        assert len(page.evaluate(f"[...{TILES}.colour]")) == n * n
        page.wait_for(f"{TILES}.colour.includes('{running}')")
        early = page.screenshot(artefacts(tmp_path) / "dashboard-early.png", 1280, 800)
        gate.touch()
        run.join()
        page.wait_for(f"[...{TILES}.colour].filter(c => c == '{failed}').length == {n}")
        page.wait_for(f"!{TILES}.colour.includes('{running}')")
        end = page.screenshot(artefacts(tmp_path) / "dashboard-end.png", 1280, 800)
        words = page.evaluate(WORDS)
        assert f"{n} of terms" in words
        assert EVIL in words  # as text, not as an element
        assert page.evaluate("document.title") == "Tilestream"
        page.evaluate(f"{model('stage')}.value = 'merge'")
        page.wait_for(f"new Set({TILES}.colour).size == 1")
        assert page.errors == []
        elsewhere = [r for r in page.requests if not r.startswith((url.rsplit("/", 1)[0], "data:"))]
        assert elsewhere == []
        page.goto(url.replace("tilestream", "status"))
        assert page.evaluate("!!document.querySelector('.navbar a[href=tilestream]')")
    assert coloured(early, failed) < coloured(end, failed)
    assert coloured(early, running) > coloured(end, running)


def test_a_browser_sees_the_map_and_the_estimates_come(
    new_workers: distributed.Client, tmp_path: Path
) -> None:
    """Also who comes late; all of it on one screen, and the same as JSON."""
    url, store = serve_page(new_workers), small_map(tmp_path)
    assert url is not None
    estimates = [0.02, 0.07, 0.12, 0.17, 0.22, 0.3, 0.8, float("nan")]
    plan = drawn_plan(store, tmp_path, estimates, "no space left")
    run = threading.Thread(target=execute, args=(plan, new_workers, None))
    with ExitStack() as stack:
        page = first = stack.enter_context(chromium_page())
        run.start()
        wait_until(lambda: answers(f"{url}.json"), "the dashboard answers")
        page.goto(url)
        page.wait_for(READY)
        origin = float(page.evaluate(f"{model('map')}.below[0].axis_label").split()[3])
        lefts = {store.grid.core(key).x_lo / 1000.0 for key in store.keys()}
        shown = page.evaluate(f"[...{TILES}.x].map((x, i) => x - {TILES}.edge[i] / 2)")
        assert {origin + x for x in shown} == lefts
        assert page.evaluate(f"{data('relief')}.x.length + {data('places')}.x.length") == 0
        (tmp_path / "above").touch()
        page.wait_for(f"{data('relief')}.x.length")
        wait_until(lambda: get_json(f"{url}.json")["map"]["relief_tiles"] == 4, "all is drawn")
        before = page.screenshot(artefacts(tmp_path) / "dashboard-relief.png", 1280, 800)
        (tmp_path / "predict").touch()
        run.join()
        second = stack.enter_context(chromium_page())  # opened late, beside the first
        second.goto(url)
        second.wait_for(READY)
        for name, page in (("first", first), ("second", second)):
            page.wait_for(f"{data('places')}.x.length == {4 * len(estimates)}")
            steps = page.evaluate(f"[...{data('places')}.step]")
            assert steps == sorted(steps)  # the worst on top
            assert page.evaluate(f"[...{data('relief')}.image].some(i => i.some(v => v > 0))")
            page.wait_for(f"{TILES}.state.filter(s => s.startsWith('done')).length == 3")
            after = page.screenshot(artefacts(tmp_path) / f"dashboard-{name}.png", 1280, 800)
            for colour in FIXED.colours:
                assert coloured(after, colour) > coloured(before, colour)
            assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
            words = page.evaluate(WORDS)
            for part in ("terms-37000_394999: no space left", "1 not run", "EPSG:32654"):
                assert part in words
            assert page.errors == []
        facts = get_json(f"{url}.json?places=1&tiles=1")
        xs = page.evaluate(f"[...{data('places')}.px]")
    assert sorted(place["x"] for place in facts["places"]) == sorted(xs)
    known = sorted(p["estimate"] for p in facts["places"] if p["estimate"] is not None)
    assert known == sorted(4 * estimates[:-1])
    assert facts["map"]["tile_m"] == TILE
    assert facts["map"]["places"] == 4 * len(estimates)
    assert facts["reasons"] == ["terms-37000_394999: no space left"]
    assert facts["share_done"] == 1.0
    assert facts["left"]["seconds"] == 0.0
    assert facts["state"] == "ended"


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
            url = serve_page(client)
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


def test_what_will_follow_counts_for_the_time_left(
    new_workers: distributed.Client, tmp_path: Path
) -> None:
    gate, url = tmp_path / "gate", serve_page(new_workers)
    first = Nap(TileKey(0, 0), gate=str(gate))
    later = [Nap(TileKey(i, 0), "report") for i in range(3)]
    given: list[Task] = []

    def more(outcome: Outcome) -> list[Task]:
        given.extend(later if outcome.stage == "nap" else [])
        return later if outcome.stage == "nap" else []

    def seen(ahead: Ahead | None, complete: bool) -> list[int]:
        """What is expected of each stage while the first task runs."""
        gate.unlink(missing_ok=True)
        given.clear()
        args, how = (Plan((first,), MEMORY), new_workers, None), {"grow": more, "ahead": ahead}
        run = threading.Thread(target=execute, args=args, kwargs=how)
        run.start()
        wait_until(lambda: answers(f"{url}.json"), "the dashboard answers")

        def begun() -> bool:
            facts = get_json(f"{url}.json")
            runs = sum(stage["running"] for stage in facts["stages"]) == 1
            return runs and facts["left"]["complete"] == complete

        wait_until(begun, "its first task runs")
        expected = [stage["expected"] for stage in get_json(f"{url}.json")["stages"]]
        gate.touch()
        run.join()
        facts = get_json(f"{url}.json")
        assert facts["left"]["complete"]
        assert all(stage["expected"] == 0 for stage in facts["stages"])
        return expected

    everything = tuple(later)
    assert seen(lambda: () if given else everything, complete=True) == [0, 3]
    assert seen(None, complete=False) == [0, 0]


def test_no_dashboard_no_page_and_no_harm() -> None:
    with (
        distributed.LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        url = serve_page(client)  # for machines it is there
        assert url is not None
        assert execute(Plan((Nap(TileKey(0, 0)),), MEMORY), client, None)[0].ok
        assert get_json(url)["state"] == "ended"
