"""Estimates as tags in a Lanelet2 map: they are read back, and every other byte stays."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_findings import places_of
from test_lanelet2 import osm

from tilestream.errors import CorruptSourceError, SourceNotFoundError
from tilestream.files import Files
from tilestream.formats.routes import read_all_routes, read_lanes, with_tags
from tilestream.report.data import LaneletMap
from tilestream.report.exports.lanelets import NO_PLACE, NO_ROUTE, PREFIX, write_lanelets

REAL = {
    "lanelet2_mapping_example_karlsruhe.osm": "EPSG:32632",
    "lanelet2_kashiwanoha.osm": "EPSG:6677",
}
SAID = {f"{PREFIX}error": "0.083", f"{PREFIX}reason": "a \"b\" <c> & 'd'\n> 10 % ü 東"}


def tags_of(content: bytes) -> dict[str, dict[str, str]]:
    """Our tags by relation, as any reader of XML has them."""
    return {
        str(relation.get("id")): {
            str(tag.get("k")): str(tag.get("v"))
            for tag in relation.findall("tag")
            if str(tag.get("k")).startswith(PREFIX)
        }
        for relation in ET.fromstring(content).iter("relation")
    }


def same_lanes(one: Path, other: Path, project_to: str | None = None) -> bool:
    first, second = (read_all_routes(path, project_to=project_to).routes for path in (one, other))
    return [(r.route_id, r.positions.tobytes()) for r in first] == [
        (r.route_id, r.positions.tobytes()) for r in second
    ]


@pytest.mark.parametrize("name", REAL)
def test_a_real_map_keeps_all_but_the_tags(name: str, shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "lanelet2" / name
    before = path.read_bytes()
    lanes = read_lanes(str(path), project_to=REAL[name], map_crs=None)
    numbers = {number for lane in lanes for number in lane.lanelets}
    after = with_tags(before, dict.fromkeys(numbers, SAID), PREFIX)
    assert {n for n, tags in tags_of(after).items() if tags == SAID} == numbers
    assert sum(map(len, tags_of(after).values())) == len(SAID) * len(numbers) > 100
    assert with_tags(after, dict.fromkeys(numbers, SAID), PREFIX) == after
    assert with_tags(after, {}, PREFIX) == before
    old = set(before.splitlines())
    new = [line for line in after.splitlines() if line not in old]
    assert all(line.lstrip().startswith(b"<tag k=") for line in new)
    indents = {len(line) - len(line.lstrip()) for line in new}
    tags = [line for line in before.splitlines() if b"lanelet" in line]
    assert indents <= {len(line) - len(line.lstrip()) for line in tags}
    (tmp_path / "a.osm").write_bytes(after)
    assert same_lanes(path, tmp_path / "a.osm", REAL[name])


@st.composite
def written_maps(draw: st.DrawFn) -> bytes:
    """Two relations as different programs write them."""
    quote = draw(st.sampled_from("'\""))
    end = draw(st.sampled_from(["/>", " />", "></tag>"]))
    gap = draw(st.sampled_from(["", "\n    ", "\r\n\t", " "]))
    encoding = draw(st.sampled_from(["UTF-8", "UTF-8-sig", "UTF-16", "ISO-8859-1", ""]))
    name = encoding.removesuffix("-sig")
    head = f"<?xml version='1.0' encoding='{name}'?>" if encoding else ""
    comment = draw(st.sampled_from(["", "<!-- <relation id='1'> é > -->"]))
    stale = draw(st.booleans())

    def tag(k: str, v: str) -> str:
        return f"{gap}<tag k={quote}{k}{quote} v={quote}{v}{quote}{end}"

    old = tag(f"{PREFIX}error", "9.9") if stale else ""
    member = (
        f"{gap}<member type={quote}way{quote} ref={quote}5{quote} role={quote}a&gt;b>c{quote} />"
    )
    body = f"{member}{old}{tag('type', 'lanelet')}{comment}{tag('name', 'é &amp; &#252;')}"
    text = f"{head}<osm>{gap}<relation id={quote}1{quote}>{body}\n  </relation>{gap}"
    text += (
        f"<relation id={quote}2{quote} action='delete'>{body}</relation><relation id='3'/></osm>"
    )
    return text.encode(encoding or "utf-8")


@given(written_maps())
def test_tags_are_read_back_and_taken_away_again(content: bytes) -> None:
    numbers = dict.fromkeys("123", SAID)
    after = with_tags(content, numbers, PREFIX)
    assert tags_of(after) == {"1": SAID, "2": {}, "3": {}}  # 2 is deleted, 3 holds nothing
    assert with_tags(after, numbers, PREFIX) == after
    bare = with_tags(content, {}, PREFIX)
    assert with_tags(after, {}, PREFIX) == bare
    if PREFIX.encode() not in content.replace(b"\0", b""):
        assert bare == content
    others = [
        [(child.tag, child.attrib) for child in relation if PREFIX not in child.get("k", "")]
        for text in (content, after)
        for relation in ET.fromstring(text).iter("relation")
    ]
    assert others[:3] == others[3:]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"<osm><relation id='1'>", "no OSM XML"),
        (b"<?xml version='1.0' encoding='UTF-8'?><osm a='\xe9'/>", "not UTF-8"),
        (b"<?xml version='1.0' encoding='foo'?><osm/>", "not foo"),
    ],
)
def test_what_is_no_xml_is_refused(content: bytes, why: str) -> None:
    with pytest.raises(CorruptSourceError, match=why):
        with_tags(content, {}, PREFIX)


def test_what_no_xml_may_have_is_replaced() -> None:
    after = with_tags(
        b"<osm><relation id='1'><tag k='a' v='b'/></relation></osm>",
        {"1": {f"{PREFIX}a": "x\0\x1by\ufffe"}},
        PREFIX,
    )
    assert tags_of(after)["1"] == {f"{PREFIX}a": "x\ufffd\ufffdy\ufffd"}


def test_a_lane_knows_where_its_lanelets_begin(tmp_path: Path) -> None:
    bounds = {
        3: ([3, 4], [103, 104]),
        1: ([0, 1], [101, 100]),
        2: ([1, 2, 3], [101, 102, 103]),
    }
    (lane,) = read_lanes(str(osm(tmp_path / "a.osm", bounds)), project_to=None, map_crs=None)
    assert lane.lanelets == ("1", "2", "3")
    np.testing.assert_allclose(lane.begins, [0.0, 10.0, 30.0])
    (route,) = read_all_routes(tmp_path / "a.osm").routes
    assert lane.route.positions.tobytes() == route.positions.tobytes()


@pytest.mark.parametrize("name", REAL)
def test_lanes_are_the_routes_of_the_map(name: str, shared_data: Path) -> None:
    path = shared_data / "lanelet2" / name
    lanes = read_lanes(str(path), project_to=REAL[name], map_crs=None)
    routes = read_all_routes(path, project_to=REAL[name]).routes
    assert [lane.route.positions.tobytes() for lane in lanes] == [
        route.positions.tobytes() for route in routes
    ]
    for lane, route in zip(lanes, routes, strict=True):
        assert route.route_id.split("-") == list(lane.lanelets)
        assert lane.begins[0] == 0.0
        assert (np.diff([*lane.begins, route.arc_length[-1]]) > 0.0).all()


def test_a_lanelet_has_the_estimates_of_its_sample_points(tmp_path: Path) -> None:
    bounds = {n: ([n, n + 1], [100 + n, 101 + n]) for n in range(4)}
    path = osm(tmp_path / "a.osm", bounds | {7: ([50, 51], [150, 151])})
    joined, apart = read_lanes(str(path), project_to=None, map_crs=None)
    assert joined.lanelets == ("0", "1", "2", "3")
    places = places_of({"street": 30}).assign(  # the fourth lanelet, from 30 m on, has no place
        estimate=np.r_[np.full(9, 0.1), 0.4, np.full(10, 0.2), np.full(10, np.nan)],
        p_fail=np.r_[np.linspace(0.0, 0.9, 10), np.full(20, 0.125)],
        measured=np.r_[np.nan, 0.3, np.full(28, np.nan)],
        in_domain=pd.array([True] * 5 + [False] * 5 + [True] * 20, "boolean"),
        reason="no map here: " + "wall " * 60,
    )
    places.loc[15, "estimate"] = np.nan
    source = LaneletMap(str(path), lambda: [("street", joined), (None, apart)])
    told = write_lanelets(Files.at(tmp_path / "b.osm"), source, places)
    assert told == {"source": str(path), "lanelets": 5, "estimated": 2}
    assert same_lanes(path, tmp_path / "b.osm")
    content = (tmp_path / "b.osm").read_bytes()
    assert with_tags(content, {}, PREFIX) == path.read_bytes()
    found = {
        number: {key.removeprefix(PREFIX): value for key, value in tags.items()}
        for number, tags in tags_of(content).items()
    }
    reason = found["2"].pop("reason")
    assert reason.startswith("no map here: wall wall")
    assert len(reason) <= 255
    assert found == {
        "0": {
            "error": "0.130", "error_max": "0.400", "p_fail": "0.900", "measured": "0.300",
            "in_domain": "no", "places": "10",
        },
        "1": {
            "error": "0.200", "error_max": "0.200", "p_fail": "0.125", "in_domain": "yes",
            "places": "10", "missing": "1",
        },
        "2": {"places": "10"},
        "3": {"reason": NO_PLACE},
        "7": {"reason": NO_ROUTE},
    }  # fmt: skip


def test_a_map_that_has_gone_is_named(tmp_path: Path) -> None:
    source = LaneletMap(str(tmp_path / "a.osm"), list)
    with pytest.raises(SourceNotFoundError, match=r"a\.osm: is no longer there"):
        write_lanelets(Files.at(tmp_path / "b.osm"), source, places_of({"a": 3}))
    assert list(tmp_path.iterdir()) == []
