"""A page as a person gets it: headless Chromium, driven over its DevTools protocol."""

import asyncio
import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from patience import PATIENCE
from tornado.httpclient import AsyncHTTPClient
from tornado.websocket import WebSocketClientConnection, websocket_connect

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)


class Page:
    """One tab. `errors` and `requests` gather what its console says and what it asks for."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: WebSocketClientConnection) -> None:
        self._loop = loop
        self._socket = socket
        self._number = 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._loaded = False
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.command(f"{domain}.enable")

    def goto(self, url: str) -> None:
        """Open an address (`http://…`, `file://…`) and wait until it has loaded."""
        self._loaded = False
        answer = self.command("Page.navigate", url=url)
        assert "errorText" not in answer, f"{url}: {answer['errorText']}"
        until = time.monotonic() + PATIENCE
        while not self._loaded:
            assert time.monotonic() < until, f"{url} has not loaded within {PATIENCE:g} s"
            self._hear(self._receive(until - time.monotonic()))

    def evaluate(self, expression: str) -> Any:
        """What a JavaScript expression (or the promise that it is) gives, as Python has it."""
        answer = self.command(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, f"{expression}: {answer['exceptionDetails']}"
        return answer["result"].get("value")

    def wait_for(self, expression: str, seconds: float = PATIENCE) -> Any:
        """The value of an expression as soon as it is true; fails after `seconds`."""
        until = time.monotonic() + seconds
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < until, f"not within {seconds:g} s: {expression}"
            time.sleep(0.1)
        return value

    def screenshot(self, path: Path, width: int = 1280, height: int = 900) -> Path:
        """Write what is seen as PNG."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        picture = self.command("Page.captureScreenshot", format="png")["data"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(picture))
        return path

    def command(self, method: str, **params: Any) -> dict[str, Any]:
        """The answer to any command of the DevTools protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        self._loop.run_until_complete(_send(self._socket, json.dumps(message)))
        while True:
            heard = self._receive(PATIENCE)
            if heard.get("id") == self._number:
                assert "error" not in heard, f"{method}: {heard['error']}"
                return dict(heard["result"])
            self._hear(heard)

    def _receive(self, seconds: float) -> dict[str, Any]:
        waiting = asyncio.wait_for(_next(self._socket), max(0.1, seconds))
        heard = self._loop.run_until_complete(waiting)
        assert heard is not None, "the browser has gone"
        return dict(json.loads(heard))

    def _hear(self, event: dict[str, Any]) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            said = (str(part.get("value", part.get("description"))) for part in params["args"])
            self.errors.append(" ".join(said))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])


async def _send(socket: WebSocketClientConnection, message: str) -> None:
    await socket.write_message(message)


async def _close(socket: WebSocketClientConnection) -> None:
    socket.close()


async def _next(socket: WebSocketClientConnection) -> str | bytes | None:
    return await socket.read_message()


@contextmanager
def chromium_page() -> Iterator[Page]:
    """A tab of a fresh headless Chromium; skips the test where none is installed."""
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no Chromium: install Debian's package chromium")
    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        loop = asyncio.new_event_loop()
        try:
            port = _port(browser, Path(profile) / "DevToolsActivePort")
            socket = loop.run_until_complete(_connect(port))
            yield Page(loop, socket)
            loop.run_until_complete(_close(socket))
        finally:
            browser.terminate()
            browser.wait(PATIENCE)
            loop.close()


def _port(browser: "subprocess.Popen[bytes]", told: Path) -> int:
    """The port that the browser chose."""
    until = time.monotonic() + PATIENCE
    while not (told.is_file() and told.read_text().strip()):
        assert browser.poll() is None, "Chromium ended as soon as it was started"
        assert time.monotonic() < until, "Chromium does not say where it listens"
        time.sleep(0.05)
    return int(told.read_text().split()[0])


async def _connect(port: int) -> WebSocketClientConnection:
    """The first tab's own socket."""
    from_browser = await _get(f"http://127.0.0.1:{port}/json/list")
    page = next(tab for tab in from_browser if tab["type"] == "page")
    return await websocket_connect(page["webSocketDebuggerUrl"], max_message_size=100_000_000)


async def _get(url: str) -> list[dict[str, Any]]:
    answer = await AsyncHTTPClient().fetch(url)
    return list(json.loads(answer.body))


def opened(browser: Page, page: Path) -> Page:
    """A report without a network, its charts drawn."""
    browser.errors.clear()
    browser.requests.clear()
    browser.command("Network.emulateNetworkConditions", offline=True, latency=0,
                    downloadThroughput=0, uploadThroughput=0)  # fmt: skip
    browser.command("Emulation.setDeviceMetricsOverride", width=1280, height=900,
                    deviceScaleFactor=1, mobile=False)  # fmt: skip
    browser.goto(page.as_uri())
    browser.wait_for("document.documentElement.dataset.charts")
    return browser


def calm(browser: Page) -> None:
    """Nothing failed, and nothing was asked for but the file and what is inside it."""
    assert browser.errors == []
    assert {url.split(":", 1)[0] for url in browser.requests} <= {"file", "data", "blob"}
    assert sum(url.startswith("file:") for url in browser.requests) == 1


TIPS = """(() => {
  const found = [];
  const walk = (node) => {
    if (node.classList && node.classList.contains("bk-Tooltip") && node.shadowRoot)
      found.push([...node.shadowRoot.children].filter((c) => c.tagName != "STYLE")
        .map((c) => c.innerText).join(""));
    if (node.shadowRoot) walk(node.shadowRoot);
    for (const child of node.children || []) walk(child);
  };
  walk(document.body);
  return found.join("\\n").replaceAll("\\u00a0", " ").trim();
})()"""
"""What the tips say that are shown."""


def point_at(browser: Page, chart: str, kind: str, row: int) -> None:
    """Move the mouse onto a row of a data source."""
    view = f"[...Bokeh.index.roots].find((v) => document.getElementById({chart!r}).contains(v.el))"
    browser.wait_for(f"{view}.frame.bbox.width > 100")
    browser.evaluate(f"{view}.el.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    y = "anchor" if kind == "estimate" else "y"
    x, y = browser.evaluate(
        f"""(() => {{
          const view = {view};
          const found = [...view.model.references()].find((m) => m.name == {kind!r});
          const box = view.el.getBoundingClientRect();
          const at = found.data.{"arc" if kind == "estimate" else "x"}[{row}];
          return [box.left + view.frame.x_scale.compute(at),
                  box.top + view.frame.y_scale.compute(found.data.{y}[{row}])];
        }})()"""
    )
    browser.command("Input.dispatchMouseEvent", type="mouseMoved", x=x - 1, y=y)
    browser.command("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
