"""The page: its sections, its chart data, and what a browser makes of it without a network."""

import ast
import base64
import html
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from chromium import TIPS, Page, calm, chromium_page, opened, point_at
from markupsafe import escape
from report_findings import (
    HOSTILE,
    LIMIT,
    hostile,
    nothing_estimated,
    one_place,
    places_of,
    whole,
    without_labels,
    written,
)
from report_json import charts, source

import tilestream.report
from tilestream.from_above import FromAbove
from tilestream.model.dataset import TARGETS
from tilestream.model.registry import COMPETITORS
from tilestream.model.splits import PROTOCOLS
from tilestream.report import Findings, write_report
from tilestream.report.city_map import city_map
from tilestream.report.columns import CATALOGUE
from tilestream.report.evaluation import MODELS, PAPER_IMPORTANCES, PARTS, PROTOCOL_NAMES, worth
from tilestream.report.formatting import cm, cm_by_name, cm_span, percent
from tilestream.report.page import report_page
from tilestream.report.relief import relief_png
from tilestream.report.segments import worst_places
from tilestream.report.summary import AXES, STARTS, summary
from tilestream.report.views import View

TAGS = re.compile(r"<(script|style)[^>]*>.*?</\1>|<[^>]*>", re.DOTALL)


@pytest.fixture(scope="module")
def found() -> Findings:
    return whole()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(whole, tmp_path_factory) / "index.html"


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Pages of findings that lack or have too much of something."""
    makes = (without_labels, one_place, nothing_estimated, hostile)
    return {make.__name__: written(make, tmp_path_factory) / "index.html" for make in makes}


def text_of(page: Path | Findings, section: str) -> str:
    """What a person reads in a section of a page, or of the page that findings give."""
    source = page.read_text(encoding="utf-8") if isinstance(page, Path) else rendered(page)
    (inner,) = re.findall(rf'<section id="{section}">(.*?)</section>', source, re.DOTALL)
    inner = re.sub(r"<details.*?</details>", "", inner, flags=re.DOTALL)
    return " ".join(html.unescape(TAGS.sub(" ", inner)).replace("\u202f", " ").split())


def rendered(found: Findings) -> str:
    """The page alone, without pictures of the worst places."""
    content = summary(found, LIMIT) | {"files": [], "not_written": {}, "foxglove": None}
    return report_page(found, content, [View("not taken")] * 10, ["not drawn"] * 6)


@pytest.mark.parametrize("name", ["whole", "without_labels", "one_place", "nothing_estimated"])
def test_every_section_is_there_in_order_and_says_something(
    name: str, page: Path, others: dict[str, Path]
) -> None:
    path = page if name == "whole" else others[name]
    source = path.read_text(encoding="utf-8")
    there = re.findall(r'<section id="([^"]+)">', source)
    assert there == re.findall(r'<a href="#([^"]+)">', source)
    assert len(there) == {"whole": 14, "hostile": 14, "nothing_estimated": 5}.get(name, 6)
    for section in there:
        assert len(text_of(path, section)) > 80, section


def test_a_section_with_nothing_to_say_is_left_out_and_the_notes_say_why(
    others: dict[str, Path],
) -> None:
    bare = others["without_labels"]
    assert "made without the map" in text_of(bare, "worst")
    notes = text_of(bare, "notes")
    source = bare.read_text(encoding="utf-8")
    for section, why in (
        ("paths", "Measured and estimated: no place was labelled"),
        ("ends", "Where starts end: no place was labelled"),
        ("table-i", "Table I: no place was labelled"),
        ("table-iii", "Table III: no place was labelled"),
        ("importances", "What drives them: nothing was trained"),
        ("table-iv", "Table IV: there were no labels, so nothing can be judged"),
        ("calibration", "Intervals: no interval was checked"),
        ("protocols", "How good: there were no labels, so nothing can be judged"),
    ):
        assert why in notes, section
        assert f'id="{section}"' not in source
    assert "No place has an estimate" in text_of(others["nothing_estimated"], "worst")
    assert "no map here 80" in text_of(others["nothing_estimated"], "headline")
    elsewhere = replace(whole(), protocols=pd.DataFrame(), table_iv=pd.DataFrame(), model="")
    notes = text_of(elsewhere, "notes")
    for section in ("How good", "Table IV"):
        assert f"{section}: nothing was trained on the labels of this run" in notes
    assert "no labels" not in notes


def test_the_headline_is_in_figures_that_a_person_reads(found: Findings, page: Path) -> None:
    text = text_of(page, "headline")
    estimate = found.places["estimate"].dropna()
    for figure in (
        f"{estimate.median() * 100:.1f} cm median",
        f"{estimate.quantile(0.95) * 100:.1f} cm 95 %",
        f"{estimate.max() * 100:.1f} cm the highest",
        f"{(estimate > LIMIT).mean() * 100:.1f} % of the places over 15 cm",
        f"{found.places['estimate'].isna().sum()} places without an estimate",
        "458 m of road, 460 sample points",
    ):
        assert figure in text


def test_table_one_and_three_stand_beside_the_papers(found: Findings, page: Path) -> None:
    text = text_of(page, "table-i")
    assert "V 794 – 86.0 % 33.4 % 15.0 % 7.0 %" in text
    assert "mean of the paths – – 40.4 % 18.8 % 10.3 % 6.2 %" in text
    error = found.labels["error_mean"]
    shares = " ".join(f"{100 * (error > limit).mean():.1f} %" for limit in (0.1, 0.15, 0.2, 0.25))
    assert f"all, every label alike {len(error)} {100 * error.median():.1f} cm {shares}" in text
    described = text_of(page, "table-iii")
    assert "III 2 m 270 m 269 1 residential area" in described
    here = found.labels[found.labels["path"] == "I"]
    length = here["arc_length"].max() - here["arc_length"].min()
    assert f"I – {length:.0f} m {len(here)} 2 –" in described
    lidars = replace(found, labels=found.labels.assign(as_sensor=found.labels["group"]))
    assert "this run, morning" in text_of(lidars, "table-i")
    known = found.labels.assign(feature_count=120.0, D1_ratio=0.1, D2_ratio=0.6, D3_ratio=0.3)
    text = text_of(replace(found, labels=known, cell_size=1.5), "table-iii")
    assert "I 1.5 m" in text
    assert "120 cells in view: 10 % like poles, 60 % like walls, 30 % like bushes" in text


def test_the_map_lies_behind_the_places(found: Findings) -> None:
    """Where it is, and as it looks from above."""
    height = np.add.outer(np.arange(6.0), np.arange(9.0))
    low = found.places[["x", "y"]].min().to_numpy() - 3.0
    above = FromAbove(height, (float(low[0]), float(low[1])), 0.5)
    chart = city_map(replace(found, above=above), "")
    picture = values_of(chart, "ImageURL")[0]  # those that follow are of what is selected
    (url,) = source(chart, "above")["url"]
    assert base64.b64decode(url.removeprefix("data:image/png;base64,")) == relief_png(above)
    assert (picture["w"]["value"], picture["h"]["value"]) == (4.5, 3.0)
    first = source(chart, "in_domain")
    places = found.places.set_index(["route_id", "arc_length"])
    place = places.loc[(first["route"][0], first["arc"][0])]
    apart = picture["x"]["value"] - first["x"][0], picture["y"]["value"] - first["y"][0]
    assert apart == pytest.approx((low[0] - place["x"], low[1] - place["y"]), abs=1e-6)
    assert values_of(city_map(found, ""), "ImageURL") == []


def values_of(chart: Any, kind: str) -> list[dict[str, Any]]:
    """The attributes of all models of a kind in a chart."""
    if isinstance(chart, list):
        return [value for part in chart for value in values_of(part, kind)]
    if not isinstance(chart, dict):
        return []
    own = [chart["attributes"]] if chart.get("name") == kind and "attributes" in chart else []
    return own + [value for part in chart.values() for value in values_of(part, kind)]


def test_the_map_holds_every_place_once(found: Findings, page: Path) -> None:
    chart = charts(page)["city-map"]
    places = found.places.set_index(["route_id", "arc_length"])
    labels = dict(re.findall(r'"axis_label": "([xy]) \[m\] from (\d+) on"', json.dumps(chart)))
    origin = np.array([float(labels["x"]), float(labels["y"])])
    seen = set()
    for kind in ("in_domain", "outside", "missing"):
        data = source(chart, kind)
        assert (np.diff(data["estimate"]) >= 0.0).all() or kind == "missing"
        for k, name in enumerate(zip(data["route"], data["arc"].tolist(), strict=True)):
            place = places.loc[name]
            seen.add(name)
            at = np.array([data["x"][k], data["y"][k]]) + origin
            assert at.tolist() == pytest.approx([place["x"], place["y"]], abs=1e-6)
            assert data["reason"][k] == place["reason"]
            assert data["interval"][k] == cm_span(place["low"], place["high"])
            assert data["fail"][k] == percent(place["p_fail"])
            assert data["axes"][k] == cm_by_name(place, AXES)
            assert data["starts"][k] == cm_by_name(place, STARTS)
            if kind == "missing":
                assert np.isnan(place["estimate"])
                assert data["domain"][k] == "not known"
            else:
                assert data["estimate"][k] == pytest.approx(100.0 * place["estimate"])
                assert place["in_domain"] == (kind == "in_domain")
    assert seen == set(places.index)
    worst = source(chart, "worst")
    rows = worst_places(found.places)
    assert worst["number"] == [str(k) for k in range(1, 11)]
    np.testing.assert_allclose(worst["x"] + origin[0], found.places["x"].iloc[rows])


def test_the_path_charts_hold_measured_and_estimated(found: Findings, page: Path) -> None:
    chart = charts(page)["path-0"]
    here = found.labels[found.labels["path"] == "I"]
    for group in ("morning", "noon"):
        data, part = source(chart, group), here[here["group"] == group]
        kept = np.isfinite(data["arc"])
        np.testing.assert_array_equal(data["arc"][kept], part["arc_length"])
        np.testing.assert_allclose(data["measured"][kept], 100.0 * part["error_mean"])
        (gap,) = np.flatnonzero(~kept)
        assert data["arc"][gap + 1] - data["arc"][gap - 1] > 40.0
    data = source(chart, "estimate")
    kept = np.isfinite(data["arc"])
    one = here[here["group"] == "noon"]
    np.testing.assert_allclose(data["estimate"][kept], 100.0 * one["held_out"])
    np.testing.assert_allclose(data["low"][kept], 100.0 * one["low"])
    np.testing.assert_allclose(data["high"][kept], 100.0 * one["high"])
    assert not np.isfinite(source(charts(page)["path-1"], "estimate")["high"]).any()


def test_table_iv_names_the_model_where_there_are_several(found: Findings) -> None:
    two = pd.concat([found.table_iv, found.table_iv.assign(model="forest")])
    text = text_of(replace(found, table_iv=two), "table-iv")
    assert "FS+RQ, forest, the paper's setting 1.00" in text
    assert "FS+RQ, forest, tuned on held-out blocks 1.00" in text


def test_the_worst_places_are_told_in_words_and_pictures(found: Findings, page: Path) -> None:
    text = text_of(page, "worst")
    for number, row in enumerate(worst_places(found.places), start=1):
        place = found.places.iloc[row]
        start = f"{number} {place['route_id']} , {place['arc_length']:.0f} m along"
        assert start in text
        assert cm(place["estimate"]).replace("\u00a0", " ") in text
    assert page.read_text().count('src="data:image/png;base64,') == 10 + 6  # the ends


def test_table_iv_stands_beside_the_papers_and_names_the_leak(page: Path) -> None:
    text = text_of(page, "table-iv")
    paper = text.index("the paper, random split leaks")
    for figures in ("FS 3.39 cm 5.75 cm 59.4 % 81.8 %", "LS 2.83 cm 4.83 cm 64.1 % 85.7 %"):
        assert text.index(figures) > paper
    assert "random split leaks FS 1.00 cm 1.50 cm 60.0 % 90.0 % 0.50 0.40 0.31 to 0.52" in text
    assert "leave one path out FS 2.00 cm" in text
    assert "not followed: one block only" in text


def test_the_protocols_say_who_wins(page: Path, tmp_path: Path) -> None:
    text = text_of(page, "protocols")
    assert "so these figures prove nothing. model" in text  # no verdict where it leaks
    verdict = (
        f"The model of these estimates (3.20 cm, {MODELS['corrected']}) beats the best "
        "opponent (3.60 cm, the training median everywhere) by mean absolute error, over 400 "
        "points. Better here than the model in use: forest, the paper's setting (2.00 cm; "
        "model.recipe: paper )"
    )
    assert verdict in text
    assert "Not followed in this run: one block only." in text
    assert "a second drive over the same places 1.10 cm 2.00 cm 90.0 % 97.0 % 0.90 0.70 –" in text
    assert "all drives there could be – – – – – 0.79 0.74 to 0.83 – – –" in text
    losing = whole().protocols
    losing.loc[losing["model"] == "nearest training point", "mae"] = 0.001
    from_losers = replace(whole(), protocols=losing, around=None, model="paper")
    write_report(from_losers, tmp_path)
    text = text_of(tmp_path / "index.html", "protocols")
    assert "(2.00 cm, forest, the paper's setting) does not beat the best opponent (0.10" in text
    assert "Better here" not in text
    elsewhere = text_of(replace(whole(), model=""), "protocols")
    assert "beat" not in elsewhere.replace("must beat", "").replace("it beats the opponents", "")


def test_the_model_in_use_is_compared_with_physics(page: Path) -> None:
    text = text_of(page, "protocols")
    assert "the mean error, leave one path out 0.40 cm 0.05 0.02 to 0.09 better" in text
    tail = "tail: what starts farther than 1 m add, leave one path out -0.10 cm -0.01 -0.04 to 0.02"
    assert f"{tail} no difference that is sure" in text
    assert "the mean error, random split" not in text  # where it leaks nothing is compared
    row = {"skill_low": -0.3, "skill_high": -0.1}
    assert worth(row) == "worse"
    assert worth({"skill_low": None, "skill_high": None}) == "not known: one block"


def test_the_parts_of_the_error_are_judged_beside_a_repeated_drive(page: Path) -> None:
    text = text_of(page, "protocols")
    parts = text[text.index("the parts of the error, on paths left out") :]
    again = "a second drive over the same places"
    assert (
        f"tail: what starts farther than 1 m add {MODELS['corrected']} 1.00 cm 0.40 0.31 to 0.52 "
        f"– 0.60 0.45 to 0.72 0.80 {MODELS['physics']} 1.40 cm 0.40 0.31 to 0.52 0.70 0.60"
    ) in parts
    assert "across the road" in parts
    assert f"share of the starts that fail {MODELS['corrected']} 1.00 % 0.40" in parts
    assert f"{again} 2.10 % 0.70 0.81 – –" in parts
    assert parts.endswith("the mean of all drives there could be – 0.79 0.74 to 0.83 – – –")
    assert parts.count(again) == 1  # the ceiling of the others is not known
    alone = text_of(replace(whole(), parts=pd.DataFrame()), "protocols")
    assert "Not judged in this run." in alone
    same = whole().parts.replace({"target": {"error_tail": "error_floor"}})
    same.loc[same["target"] == "error_floor", ["mae", "reason"]] = [np.nan, "all are 0"]
    text = text_of(replace(whole(), parts=same), "protocols")
    assert "floor: what starts within 1 m end with not followed: all are 0 – – –" in text


def test_the_parts_stand_below_the_estimate_of_a_worst_place(found: Findings, page: Path) -> None:
    place = found.places.iloc[worst_places(found.places)[0]]
    axes = ", ".join(f"{name} {100 * place[name]:.1f}" for name in ("along", "across", "up"))
    starts = ", ".join(f"{name} {100 * place[name]:.1f}" for name in ("floor", "tail"))
    estimate = cm(place["estimate"]).replace("\u00a0", " ")
    text = text_of(page, "worst").replace("\u00a0", " ")
    assert f"{estimate} {axes} cm {starts} cm" in text


def test_lengths_leave_out_what_is_not_known() -> None:
    assert cm_by_name({"floor": 0.021, "tail": float("nan")}, STARTS) == "floor 2.1\u00a0cm"
    assert cm_by_name({"floor": None}, STARTS[:1]) == "none"


def test_without_training_no_place_is_called_like_or_unlike(
    found: Findings, tmp_path: Path
) -> None:
    unknown = pd.array([None] * len(found.places), dtype="boolean")
    bare = replace(found, places=found.places.assign(in_domain=unknown))
    write_report(bare, tmp_path, threshold=LIMIT)
    page = tmp_path / "index.html"
    assert "unlike the training places" not in text_of(page, "headline")
    assert text_of(page, "worst").count("not known") >= 10
    chart = charts(page)["city-map"]
    dots = source(chart, "unjudged")
    assert set(dots["domain"]) == {"not known"}
    assert len(dots["domain"]) == found.places["estimate"].notna().sum()
    for label in ("like the training places", "unlike the training places"):
        assert f'"{label}"' not in json.dumps(chart)
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["headline"]["outside_share"] is None
    assert {segment["in_domain"] for segment in told["segments"]} == {None}
    written = pd.read_parquet(tmp_path / "places.parquet")
    assert written["in_domain"].isna().all()


def test_importances_name_their_forest(page: Path) -> None:
    text = text_of(page, "importances")
    used, papers = text.split("The paper's forest on 2 factors, by factor")
    assert "The model in use on 2 factors, by factor" in used
    meaning = CATALOGUE["vd_mean"].meaning
    assert f"vd_mean {meaning} OB observability 0.750 ob_info_up" in used
    assert "OB observability 2 2.00 cm ± 0.30 cm" in used
    assert f"bhatt_sim {CATALOGUE['bhatt_sim'].meaning} LS local similarity 0.600 0.23" in papers
    assert "The paper's forest on 12 factors, by criterion, on held-out blocks" in papers
    assert "LS local similarity 4 1.20 cm ± 0.20 cm" in papers


def test_intervals_are_told_against_their_promise(page: Path) -> None:
    text = text_of(page, "calibration")
    assert "Promised 90 %, held 93.0 % ± 2.1 % on average (standard error by 2 blocks" in text
    assert "93.0 % to 93.0 % by path." in text
    assert "I 480 90.0 % 93.0 % ± 2.1 % 14.0 cm" in text
    assert "II 220 none none – not calibrated" in text


def test_facts_notes_and_attributions_are_told(page: Path) -> None:
    text = text_of(page, "facts")
    for told in ("numpy 2", "seconds 12.5", "nothing –", "CRS EPSG:32654",
                 "Data and attributions Buildings: somebody."):  # fmt: skip
        assert told in text


def test_notes_and_what_was_not_measured_are_told(page: Path) -> None:
    text = text_of(page, "notes")
    for told in (
        "morning 500 500 480 480 480 20 after the last pose",
        "label failed 3 nothing near",
        "job the preset is not calibrated",
    ):
        assert told in text
    headline = text_of(page, "headline")
    assert "480 of 500 scans of the drives measured" in headline


def test_every_competitor_and_protocol_has_a_name() -> None:
    assert set(MODELS) >= set(COMPETITORS)
    assert {"error_mean", *PARTS} == set(TARGETS)
    assert set(PROTOCOL_NAMES) == {protocol.name for protocol in PROTOCOLS}
    assert sum(PAPER_IMPORTANCES.values()) == pytest.approx(1.0, abs=0.03)
    assert len(PAPER_IMPORTANCES) == 20


def test_nothing_that_a_file_says_becomes_markup(others: dict[str, Path]) -> None:
    source = others["hostile"].read_text(encoding="utf-8")
    assert "<script>fail()" not in source
    assert "<img src=x" not in source
    assert escape(HOSTILE) in source
    assert charts(others["hostile"])["city-map"]  # no name ends the data early


def test_markup_is_in_the_templates_alone() -> None:
    sources = sorted(Path(tilestream.report.__file__).parent.glob("*.py"))
    assert len(sources) > 5
    found = [
        f"{path.name}:{node.lineno} {node.value!r}"
        for path in sources
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and re.search(r"</?[a-z][a-z0-9]*( [^>]*)?/?>|&[a-z]+;", node.value)
    ]
    assert found == []


def test_the_page_asks_for_nothing_from_outside(page: Path) -> None:
    source = page.read_text(encoding="utf-8")
    own = re.sub(r"<script>.*?</script>", "", source, flags=re.DOTALL)
    beside = set(re.findall(r'(?:src|href)="(?!data:|#)([^"]*)"', own))
    assert beside == {path.name for path in page.parent.iterdir() if path.is_file()} - {page.name}
    assert "url(" not in own
    assert "@import" not in own


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with chromium_page() as tab:
        yield tab


def test_a_browser_shows_every_chart_and_answers_to_the_mouse(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    assert tab.evaluate("document.documentElement.dataset.charts") == "5"
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    data = source(charts(page)["city-map"], "in_domain")
    top = len(data["arc"]) - 1  # drawn last, so nothing of it is hidden
    point_at(tab, "city-map", "in_domain", top)
    tip = tab.wait_for(TIPS)
    assert f"{data['route'][top]}, {data['arc'][top]:.1f} m along" in tip
    assert f"estimate {data['estimate'][top]:.1f} cm" in tip
    assert f"starts that fail: {data['fail'][top]}".replace("\u00a0", " ") in tip
    assert data["fail"][top].endswith("%")
    words = [data[name][top].replace("\u00a0", " ") for name in ("interval", "axes", "starts")]
    for told in (*words, "few features in view", "yes"):
        assert told in tip
    data = source(charts(page)["path-0"], "estimate")
    point_at(tab, "path-0", "estimate", 30)
    tip = tab.wait_for(f"({TIPS}).includes('measured') && {TIPS}")
    assert f"{data['arc'][30]:.1f} m" in tip
    assert "morning" in tip
    assert f"{data['estimate'][30]:.1f} cm" in tip
    calm(tab)


@pytest.mark.parametrize("name", ["without_labels", "one_place", "nothing_estimated"])
def test_a_browser_shows_what_lacks_something(
    browser: Page, others: dict[str, Path], name: str
) -> None:
    tab = opened(browser, others[name])
    sections = 5 if name == "nothing_estimated" else 6
    assert tab.evaluate("document.querySelectorAll('section').length") == sections
    calm(tab)


def test_a_browser_runs_nothing_that_a_file_says(browser: Page, others: dict[str, Path]) -> None:
    tab = opened(browser, others["hostile"])
    assert tab.evaluate("document.title") == " ".join(HOSTILE.split())
    point_at(tab, "city-map", "outside", 0)
    tip = tab.wait_for(TIPS)
    assert "<script>fail()</script><img src=x onerror=fail()>" in tip
    point_at(tab, "path-0", "estimate", 5)
    tab.wait_for(f"({TIPS}).includes('measured')")
    calm(tab)


def test_no_script_but_ours_runs_and_nobody_is_asked_for_anything(
    browser: Page, page: Path
) -> None:
    """Even if a text of a file came into the page as it is."""
    tab = opened(browser, page)
    refused = tab.evaluate(
        """new Promise((done) => {
          const refused = [];
          document.addEventListener("securitypolicyviolation", (event) => {
            refused.push(event.effectiveDirective);
            if (refused.length == 4) done(refused.sort());
          });
          const script = document.createElement("script");
          script.textContent = "document.title = 'taken'";
          document.body.append(script);
          document.body.insertAdjacentHTML("beforeend",
            "<img src='data:,' onerror=\\"document.title = 'taken'\\"><img src='http://127.0.0.1:9'>");
          fetch("http://127.0.0.1:9").catch(() => {});
        })"""
    )
    assert refused == ["connect-src", "img-src", "script-src-attr", "script-src-elem"]
    assert tab.evaluate("document.title") != "taken"


def test_the_page_is_dark_where_the_reader_wants_it_dark(browser: Page, page: Path) -> None:
    colours: dict[str, Any] = {}
    for scheme in ("light", "dark"):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.command("Emulation.setEmulatedMedia", features=features)
        tab = opened(browser, page)
        ground = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        axis = "[...Bokeh.documents[0].roots()[0].references()].find((m) => m.type=='LinearAxis')"
        colours[scheme] = (ground, tab.evaluate(f"{axis}.major_label_text_color"))
        calm(tab)
    browser.command("Emulation.setEmulatedMedia", features=[])
    assert colours["light"] != colours["dark"]
    assert colours["dark"] == ("rgb(20, 23, 26)", "#c9ced5")


def test_a_city_of_routes_is_listed_by_its_worst(tmp_path: Path) -> None:
    places = places_of({f"street {k:02d}": 3 for k in range(60)})
    write_report(Findings("Many streets", places), tmp_path)
    text = text_of(tmp_path / "index.html", "headline")
    assert "20 routes with lower estimates" in text
    highest = places.loc[places["estimate"].idxmax(), "route_id"]
    assert text.index(f"By route route length places median 95 % highest over 25 cm unlike no "
                      f"estimate {highest}") > 0  # fmt: skip


def test_a_worst_place_is_shown_on_the_map_and_its_address_can_be_sent(
    browser: Page, found: Findings, page: Path
) -> None:
    centre = (
        "(() => { const map = Bokeh.documents.flatMap((d) => d.roots())"
        ".find((r) => r.name === 'city-map'); const mid = (r) => (r.start + r.end) / 2;"
        "return [mid(map.x_range) + map.tags[0], mid(map.y_range) + map.tags[1],"
        "map.x_range.end - map.x_range.start, map.y_range.end - map.y_range.start] })()"
    )
    tab = opened(browser, page)
    row = worst_places(found.places)[2]
    place = found.places.iloc[row]
    tab.evaluate("document.querySelectorAll('#worst tbody a.place')[2].click()")
    tab.wait_for("location.hash.startsWith('#x=')")
    x, y, wide, high = tab.wait_for(f"{centre}[3] < 101 && {centre}")
    assert (x, y) == pytest.approx((place["x"], place["y"]), abs=0.1)
    assert (high, wide > high) == (pytest.approx(100.0), True)
    address = tab.evaluate("location.href")
    again = opened(browser, page)
    again.goto("about:blank")
    again.goto(address)
    found_again = again.wait_for(
        f"window.Bokeh && document.documentElement.dataset.charts && {centre}"
    )
    assert found_again == pytest.approx([x, y, wide, high], rel=0.02)
    assert again.errors == []


def test_a_profile_holds_the_estimates_of_its_route(found: Findings, page: Path) -> None:
    for number, (name, rows) in enumerate(worst_routes(found)):
        chart = charts(page)[f"along-{number}"]
        data, kept = source(chart, "profile"), rows.sort_values("arc_length")
        np.testing.assert_array_equal(data["arc"], kept["arc_length"])
        np.testing.assert_allclose(data["estimate"], 100.0 * kept["estimate"])
        np.testing.assert_array_equal(data["x"], kept["x"])
        assert f"along-{number}" in page.read_text(encoding="utf-8"), name


def worst_routes(found: Findings) -> list[tuple[str, pd.DataFrame]]:
    parts = [(str(name), part) for name, part in found.places.groupby("route_id")]
    return sorted(parts, key=lambda one: -one[1]["estimate"].quantile(0.95))


def test_a_click_into_a_profile_shows_the_place_on_the_map(
    browser: Page, found: Findings, page: Path
) -> None:
    tab = opened(browser, page)
    view = "[...Bokeh.index.roots].find((v) => document.getElementById('along-0').contains(v.el))"
    tab.wait_for(f"{view}.frame.bbox.width > 100")
    tab.evaluate(f"{view}.el.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    _, rows = worst_routes(found)[0]
    place = rows.sort_values("arc_length").iloc[20]
    at = tab.evaluate(
        f"(() => {{ const view = {view}; const box = view.el.getBoundingClientRect();"
        f"return [box.left + view.frame.x_scale.compute({place['arc_length']}),"
        " box.top + view.frame.bbox.vcenter] })()"
    )
    where = {"x": at[0], "y": at[1], "button": "left", "clickCount": 1}
    for kind in ("mousePressed", "mouseReleased"):
        tab.command("Input.dispatchMouseEvent", type=kind, **where)
    said = tab.wait_for("location.hash.startsWith('#x=') && location.hash")
    x, y = (float(part[2:]) for part in said[1:].split("&"))
    assert (x, y) == pytest.approx(
        (place["x"], place["y"]), abs=1.1
    )  # the nearest place, 1 m apart
    assert tab.errors == []
