"""Lanelet2 maps as routes: centre lines, where they join, and which lanelets count."""

from pathlib import Path

import numpy as np
import pytest

from tilestream.errors import CorruptSourceError, CrsError
from tilestream.formats.routes import read_all_routes, read_routes


@pytest.mark.parametrize(
    ("name", "project_to", "lanelets"),
    [
        ("lanelet2_mapping_example_karlsruhe.osm", "EPSG:32632", 345),
        ("lanelet2_kashiwanoha.osm", "EPSG:6677", 77),
    ],
)
def test_real_lanelet2_maps(name: str, project_to: str, lanelets: int, shared_data: Path) -> None:
    path = shared_data / "lanelet2" / name
    with pytest.raises(CrsError, match=r"degrees, not metres.*project_to"):
        read_routes(path)
    routes = read_routes(path, project_to=project_to)
    assert all(r.crs == project_to for r in routes)
    ids = [number for r in routes for number in r.route_id.split("-")]
    assert len(ids) == len(set(ids)) == lanelets
    assert len(routes) < lanelets
    assert all(1.0 < r.arc_length[-1] < 1000.0 for r in routes)
    assert all(np.diff(r.arc_length).max() < 60.0 for r in routes)


def osm(path: Path, bounds: dict[int, tuple[list[int], list[int]]], **more: str) -> Path:
    """Lanelets along x, 10 m per node: node n is at (10 n, 0); node 100 + n at (10 n, -4)."""
    used = sorted({n for pair in bounds.values() for nodes in pair for n in nodes})
    nodes = [
        f'<node id="{n}" lat="35" lon="139"><tag k="local_x" v="{10 * (n % 100)}"/>'
        f'<tag k="local_y" v="{-4 if n >= 100 else 0}"/><tag k="ele" v="2.5"/></node>'
        for n in used
    ]
    ways, relations = [], []
    for number, (left, right) in bounds.items():
        for role, refs in (("1", left), ("2", right)):
            nds = "".join(f'<nd ref="{n}"/>' for n in refs)
            ways.append(f'<way id="{number}{role}">{nds}</way>')
        relations.append(
            f'<relation id="{number}"><member type="way" role="left" ref="{number}1"/>'
            f'<member type="way" role="right" ref="{number}2"/><tag k="type" v="lanelet"/>'
            f'<tag k="subtype" v="{more.get("subtype", "road")}"/></relation>'
        )
    path.write_text(f"<osm>{''.join([*nodes, *ways, *relations])}</osm>")
    return path


def test_centre_lines_join_where_there_is_no_fork(tmp_path: Path) -> None:
    path = osm(
        tmp_path / "a.osm",
        {
            3: ([2, 3], [102, 103]),
            1: ([0, 1], [101, 100]),  # its right bound is drawn backwards
            2: ([1, 2], [101, 102]),
        },
    )
    (route,) = read_routes(path)
    assert route.route_id == "1-2-3"
    assert route.arc_length[-1] == pytest.approx(30.0)
    np.testing.assert_allclose(route.positions[:, 1:], [[-2.0, 2.5]] * len(route.positions))
    np.testing.assert_allclose(route.heading, 0.0, atol=1e-12)
    assert route.crs is None


def test_traffic_keeps_the_left_bound_on_its_left(tmp_path: Path) -> None:
    # the bounds change roles: left is the one at y = -4, so traffic goes towards -x
    (route,) = read_routes(osm(tmp_path / "a.osm", {1: ([100, 101], [0, 1])}))
    np.testing.assert_allclose(np.abs(route.heading), np.pi)
    assert route.positions[0, 0] == 10.0


def test_a_fork_ends_a_route(tmp_path: Path) -> None:
    path = osm(
        tmp_path / "a.osm",
        {1: ([0, 1], [100, 101]), 2: ([1, 2], [101, 102]), 3: ([1, 3], [101, 103])},
    )
    assert [r.route_id for r in read_routes(path)] == ["1", "2", "3"]


def test_lanelets_that_no_vehicle_drives_or_that_are_broken(tmp_path: Path) -> None:
    walk = osm(tmp_path / "walk.osm", {1: ([0, 1], [100, 101])}, subtype="crosswalk")
    with pytest.raises(CorruptSourceError, match="no lanelets for vehicles"):
        read_routes(walk)
    short = osm(tmp_path / "short.osm", {7: ([0, 1], [100])})
    with pytest.raises(CorruptSourceError, match="lanelet 7 has no right bound"):
        read_routes(short)
    lost = osm(tmp_path / "lost.osm", {7: ([0, 1], [100, 101])})
    lost.write_text(lost.read_text().replace('<node id="101"', '<node id="999"'))
    with pytest.raises(CorruptSourceError, match="node 101 is used and not there"):
        read_routes(lost)


def test_a_broken_lanelet_is_left_out(tmp_path: Path) -> None:
    lanes = {1: ([0, 1], [100, 101]), 2: ([1, 2], [101]), 3: ([2, 3], [102, 103])}
    path = osm(tmp_path / "a.osm", lanes)
    path.write_text(path.read_text().replace('<node id="103"', '<node id="999"'))
    read = read_all_routes(path)
    assert [r.route_id for r in read.routes] == ["1"]
    assert [lost.route_id for lost in read.lost] == ["2", "3"]
    assert "lanelet 2 has no right bound" in read.failures["route 2"]
    assert "node 103 is used and not there" in read.failures["route 3"]


@pytest.mark.parametrize("mark", ['action="delete"', 'visible="false"'])
@pytest.mark.parametrize(("element", "lost"), [("relation", []), ("way", ["2"]), ("node", ["2"])])
def test_deleted_elements_are_not_there(
    mark: str, element: str, lost: list[str], tmp_path: Path
) -> None:
    path = osm(tmp_path / "a.osm", {1: ([0, 1], [100, 101]), 2: ([1, 2], [101, 102])})
    number = {"relation": "2", "way": "22", "node": "102"}[element]
    text = path.read_text()
    path.write_text(text.replace(f'<{element} id="{number}"', f'<{element} {mark} id="{number}"'))
    read = read_all_routes(path)
    assert [r.route_id for r in read.routes] == ["1"]
    assert [one.route_id for one in read.lost] == lost
