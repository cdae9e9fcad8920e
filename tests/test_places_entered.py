"""A place of the report that one enters: by a row, the map, a profile, a link; in a browser."""

import base64
import io
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Page, calm, chromium_page, opened
from matplotlib.image import imread
from patience import wait_until
from report_findings import nothing_estimated, whole, without_labels, written

from tilestream.report import Findings
from tilestream.report.clouds import MOST_POINTS, cloud
from tilestream.report.columns import COLUMNS
from tilestream.report.segments import worst_measured, worst_places

MAP = "Bokeh.documents.flatMap((d) => d.roots()).find((r) => r.name === 'city-map')"
CLOUD = "[data-part=cloud] canvas"
SHOWN = f"""[...{MAP}.renderers].filter((r) => r.view && r.view.filter.type === 'BooleanFilter')
  .map((r) => [r.data_source.name, r.view.filter.booleans])"""


@pytest.fixture(scope="module")
def found() -> Findings:
    return whole()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(whole, tmp_path_factory) / "index.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with chromium_page() as tab:
        yield tab


def said(tab: Page, part: str) -> str:
    text = tab.evaluate(f"document.querySelector('#place [data-part={part}]').innerText")
    return str(text).replace("\u00a0", " ")


def test_a_row_of_the_worst_enters_its_place_everywhere(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    row = worst_places(found.places)[3]
    place = found.places.iloc[row]
    assert said(tab, "which") == "worst place 1 of 10"  # until one is chosen
    tab.evaluate("document.querySelectorAll('#worst tbody a.place')[3].click()")
    tab.wait_for("document.querySelector('[data-part=which]').innerText.includes(' 4 of')")
    assert said(tab, "where") == f"{place['route_id']}, {place['arc_length']:.0f} m along"
    facts = said(tab, "facts")
    assert f"{100 * place['estimate']:.1f} cm" in facts
    assert place["reason"] in facts
    ring = tab.evaluate(f"[...{MAP}.references()].find((m) => m.name === 'here').data")
    origin = tab.evaluate(f"{MAP}.tags")
    at = np.array([ring["x"][0], ring["y"][0]]) + origin
    assert at.tolist() == pytest.approx([place["x"], place["y"]], abs=0.06)
    lines = tab.evaluate(
        "Bokeh.documents.flatMap((d) => d.roots()).filter((r) => r.name === 'profile').map((r) =>"
        "[r.tags[0], [...r.references()].find((m) => m.name === 'here')])"
        ".map(([route, line]) => [route, line.visible, line.location])"
    )
    assert [route for route, visible, _ in lines if visible] == [place["route_id"]]
    (arc,) = (where for _, visible, where in lines if visible)
    assert arc == pytest.approx(place["arc_length"])
    picture = "document.querySelector('[data-part=around] img').src"
    assert tab.evaluate(f"{picture} === document.querySelectorAll('#worst figure img')[3].src")
    tab.evaluate("document.querySelector('[data-part=next]').click()")
    tab.wait_for("document.querySelector('[data-part=which]').innerText.includes(' 5 of')")
    link = tab.evaluate("document.querySelector('[data-part=link]').href")
    assert link == tab.evaluate("location.href")
    calm(tab)


def test_a_click_on_the_map_enters_the_nearest_place(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    at = tab.evaluate(
        f"""(() => {{
          const map = {MAP};
          const view = [...Bokeh.index.roots].find((v) => v.model === map);
          view.el.scrollIntoView({{block: 'center', behavior: 'instant'}});
          const data = [...map.references()].find((m) => m.name === 'in_domain').data;
          const k = data.x.length - 1;
          const box = view.el.getBoundingClientRect();
          return [box.left + view.frame.x_scale.compute(data.x[k]) + 2,
                  box.top + view.frame.y_scale.compute(data.y[k]), data.route[k], data.arc[k]];
        }})()"""
    )
    for kind in ("mousePressed", "mouseReleased"):
        tab.command(
            "Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button="left", clickCount=1
        )
    tab.wait_for("location.hash.startsWith('#x=')")
    place = found.places.set_index(["route_id", "arc_length"]).loc[(at[2], at[3])]
    named = dict(part.split("=") for part in tab.evaluate("location.hash.slice(1)").split("&"))
    near = np.hypot(float(named["x"]) - place["x"], float(named["y"]) - place["y"])
    assert near < 3.0  # dots that lie beside one another are nearly one on the screen
    assert said(tab, "where").startswith(at[2])
    calm(tab)


def test_where_starts_end_is_shown_of_a_measured_place(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    label = found.labels.iloc[worst_measured(found.labels)[0]]
    rows = found.places[found.places["route_id"] == label["path"]]
    place = rows.iloc[int((rows["arc_length"] - label["arc_length"]).abs().argmin())]
    tab.evaluate(f"void (location.hash = 'x={place['x']:.1f}&y={place['y']:.1f}')")
    tab.wait_for("document.querySelector('[data-part=ends] img') !== null")
    shown = "document.querySelector('[data-part=ends] img').src"
    assert tab.evaluate(f"{shown} === document.querySelector('#ends img').src")


def choose(tab: Page, **wanted: str) -> dict[str, list[bool]]:
    """Fill in the search; what of each data source of the map is shown then."""
    fields = "; ".join(f"form.elements.{name}.value = {value!r}" for name, value in wanted.items())
    tab.evaluate(
        f"(() => {{ const form = document.getElementById('choose'); {fields};"
        "form.dispatchEvent(new Event('input')); })()"
    )
    return dict(tab.evaluate(SHOWN))


def test_places_are_searched_by_route_reason_error_and_kind(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    data = dict(
        tab.evaluate(
            f"[...{MAP}.renderers].filter((r) => r.view && r.view.filter.type === 'BooleanFilter')"
            ".map((r) => [r.data_source.name, Object.fromEntries(['route', 'reason', 'estimate']"
            ".map((name) => [name, Array.from(r.data_source.data[name])]))])"
        )
    )
    rows = "[...document.querySelectorAll('#worst tr[data-route]')].filter((r) => !r.hidden).length"
    everything = tab.evaluate(rows)
    shown = choose(tab, text="few features", least="12", kind="")
    for name, kept in shown.items():
        if name == "measured":
            continue
        wanted = [
            "few features" in reason and (error or 0.0) >= 12.0
            for reason, error in zip(data[name]["reason"], data[name]["estimate"], strict=True)
        ]
        assert kept == wanted, name
    told = tab.evaluate("document.getElementById('chosen').textContent")
    of_places = {name: kept for name, kept in shown.items() if name != "measured"}
    count = sum(sum(kept) for kept in of_places.values())
    assert told == f"{count} of {len(found.places)} dots of the map are shown."
    assert 0 < count < len(found.places)
    shown = choose(tab, text="ii", least="", kind="")
    for name in ("in_domain", "outside"):
        assert shown[name] == [route.lower() == "ii" for route in data[name]["route"]]
    assert tab.evaluate(rows) < everything
    shown = choose(tab, text="", least="", kind="outside")
    assert all(shown["outside"])
    assert not any(shown["in_domain"])
    tab.evaluate("document.querySelector('#choose button').click()")
    tab.wait_for(f"{SHOWN}.every(([_, kept]) => kept.every(Boolean))")
    assert tab.evaluate(rows) == everything
    calm(tab)


def test_a_worst_place_turns_in_three_dimensions(browser: Page, page: Path) -> None:
    tab = opened(browser, page)
    canvas = "document.querySelector('[data-part=cloud] canvas')"
    assert tab.evaluate("typeof K3D") == "undefined"
    assert tab.evaluate(f"{canvas} === null")  # not before it is asked for
    tab.evaluate("document.querySelector('[data-part=turn]').click()")
    tab.wait_for(f"{canvas} !== null && {canvas}.width > 100")
    wait_until(lambda: colours(tab, CLOUD) > 20, "a cloud is drawn")
    tab.evaluate("document.querySelector('[data-part=next]').click()")
    tab.wait_for("document.querySelector('[data-part=which]').innerText.includes(' 2 of')")
    tab.wait_for(f"{canvas} !== null && {canvas}.width > 100")
    wait_until(lambda: colours(tab, CLOUD) > 20, "a cloud is drawn")
    assert tab.evaluate("document.querySelectorAll('[data-part=cloud] .drawn').length") == 1
    calm(tab)


def colours(tab: Page, element: str) -> int:
    """How many colours are seen of an element."""
    box = tab.evaluate(
        f"(({{x, y, width, height}}) => ({{x: x + scrollX, y: y + scrollY, width, height}}))"
        f"(document.querySelector('{element}').getBoundingClientRect())"
    )
    clip = {**box, "scale": 1}
    seen = tab.command("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)["data"]
    return len(np.unique(imread(io.BytesIO(base64.b64decode(seen))).reshape(-1, 4), axis=0))


def test_a_cloud_is_small_and_the_same_every_time() -> None:
    random = np.random.default_rng(5)
    points = random.uniform(-40.0, 40.0, (60_000, 3)) + np.array([5e5, 4e6, 30.0])
    place, seen = np.array([5e5, 4e6, 30.0]), points[:900]
    first = cloud(points, place, 0.4, 0xFF0000, seen)
    assert first == cloud(points[random.permutation(len(points))], place, 0.4, 0xFF0000, seen)
    assert len(first) < 12 * MOST_POINTS


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 400])
def test_axe_finds_nothing_serious(browser: Page, page: Path, scheme: str, width: int) -> None:
    tab = opened(browser, page)
    try:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        tab.command("Emulation.setEmulatedMedia", features=features)
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        tab.command("Emulation.setDeviceMetricsOverride", **size)
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert serious(tab) == []
        tab.evaluate("document.body.append(document.createElement('img'))")
        assert [found["id"] for found in serious(tab)] == ["image-alt"]  # it does look
    finally:
        tab.command("Emulation.setEmulatedMedia", features=[])


def serious(tab: Page) -> list[dict[str, Any]]:
    """What axe finds of a page that keeps people from using it."""
    axe = files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    found = tab.evaluate(
        f"{axe}; axe.run(document, {{resultTypes: ['violations']}}).then((all) => all.violations"
        ".filter((one) => ['serious', 'critical'].includes(one.impact))"
        ".map((one) => ({id: one.id, where: one.nodes.map((node) => node.target.join(' '))})))"
    )
    return list(found)


def test_everything_can_be_reached_by_keyboard(browser: Page, page: Path) -> None:
    tab = opened(browser, page)
    reached = set()
    for _ in range(60):
        for kind in ("keyDown", "keyUp"):
            key = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
            tab.command("Input.dispatchKeyEvent", type=kind, **key)
        reached.add(
            tab.evaluate(
                "(({name, dataset, className, tagName}) =>"
                "name || dataset.part || className || tagName)(document.activeElement)"
            )
        )
    assert {"text", "least", "kind", "previous", "next", "turn", "link", "place"} <= reached


def test_columns_are_explained_in_words(browser: Page, page: Path) -> None:
    tab = opened(browser, page)
    heads = tab.evaluate(
        "[...document.querySelectorAll('#worst thead th')].map((h) => [h.innerText, h.title])"
    )
    for head, title in heads:
        assert title == COLUMNS.get(head, "")
    told = tab.evaluate("document.querySelector('#worst details').textContent")
    for name in ("estimate", "interval", "starts that fail", "why"):
        assert COLUMNS[name] in told


@pytest.mark.parametrize("make", [without_labels, nothing_estimated])
def test_a_report_without_pictures_says_so(
    browser: Page, make: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    tab = opened(browser, written(make, tmp_path_factory) / "index.html")
    assert tab.evaluate("document.getElementById('k3d') === null")
    assert tab.evaluate("document.querySelector('[data-part=turn]').hidden")
    if make is without_labels:
        assert "worst places only" in said(tab, "none")
    else:
        assert said(tab, "which") == "click a dot to enter a place"
    calm(tab)
