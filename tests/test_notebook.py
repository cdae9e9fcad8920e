"""How stores, tiles, cells and routes look in a notebook."""

from pathlib import Path

import model_data
import numpy as np
import pytest
from matplotlib.figure import Figure
from scenes import scene

import tilestream as ts
from tilestream import notebook
from tilestream.formats.points.pcd import write_pcd


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    folder = tmp_path_factory.mktemp("map")
    write_pcd(folder / "street.pcd", scene("canyon", 1, spacing=0.8))
    return ts.ingest([str(folder / "street.pcd")], folder / "map", tile_size=20.0)


@pytest.fixture
def route(tmp_path: Path) -> ts.Route:
    (tmp_path / "r<1>.csv").write_text("x,y,z\n2,1,0\n8,1,0\n12,4,0\n")
    return ts.read_route(tmp_path / "r<1>.csv")


def test_a_store_is_drawn_as_tiles_coloured_by_their_points(store: ts.TileStore) -> None:
    ax = store.plot(Figure().add_subplot())
    (tiles,) = ax.collections
    marks = store.marks()
    assert tiles.get_array().tolist() == [mark.facts["points"] for mark in marks.values()]
    corners = [path.vertices.min(axis=0).tolist() for path in tiles.get_paths()]
    assert corners == [[20.0 * key.ix, 20.0 * key.iy] for key in marks]


def test_a_tile_is_drawn_from_above(store: ts.TileStore, monkeypatch: pytest.MonkeyPatch) -> None:
    tile = store.tile_at(5.0, 5.0)
    (drawn,) = tile.plot(Figure().add_subplot()).collections
    points = tile.points()
    assert len(drawn.get_offsets()) == len(points)
    assert np.diff(drawn.get_array()).min() >= 0.0  # the highest is drawn last
    monkeypatch.setattr(notebook, "MOST_POINTS", 100)
    (some,) = tile.plot(Figure().add_subplot()).collections
    assert len(some.get_offsets()) == 100


def test_cells_are_ellipses_of_two_deviations() -> None:
    covariance = np.array([np.diag([1.0, 0.25, 0.01]), np.diag([0.04, 0.04, 0.04])])
    cells = ts.Cells([[0, 0, 0], [1, 0, 0]], [9, 9], [[1.0, 1, 1], [3.0, 1, 1]], covariance)
    ax = cells.plot(Figure().add_subplot())
    (drawn,) = ax.collections
    ends = sorted([2.0 * drawn._widths[0], 2.0 * drawn._heights[0]])
    assert ends == pytest.approx([2.0 * 0.5 * 2.0, 2.0 * 1.0 * 2.0])
    assert drawn.get_offsets()[:, 0].tolist() == [1.0, 3.0]
    assert ax.get_xlim() != (0.0, 1.0)


def test_a_route_is_a_line_that_begins_with_a_dot(route: ts.Route) -> None:
    line, dot = route.plot(Figure().add_subplot()).lines
    assert line.get_xdata().tolist() == route.positions[:, 0].tolist()
    assert (dot.get_xdata()[0], dot.get_ydata()[0]) == (2.0, 1.0)


def test_everything_has_a_table_in_which_names_are_only_text(
    store: ts.TileStore, route: ts.Route
) -> None:
    tile = store.tile_at(5.0, 5.0)
    assert f"<td>{len(tile.points()):,}</td>" in tile._repr_html_()
    assert "<td>0 to 20</td>" in tile._repr_html_()
    cells = tile.cells()
    assert f"<td>{len(cells):,}</td>" in cells._repr_html_()
    assert "r&lt;1&gt;" in route._repr_html_()
    assert "<1>" not in route._repr_html_()
    assert "<td>11.0</td>" in route._repr_html_()
    assert repr(route).startswith("Route r<1> (3 points, 11.0 m")


def test_a_dataset_shows_its_first_rows() -> None:
    found = model_data.dataset(1, lengths={"a<b": 60})
    page = found._repr_html_()
    assert repr(found).startswith("Dataset of 60 labelled places on 1 paths, ")
    assert page.count("<tr>") == 1 + notebook.MOST_ROWS
    assert f"and {60 - notebook.MOST_ROWS} more" in page
    assert "a&lt;b" in page


def test_a_new_figure_has_metres_to_scale(route: ts.Route) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    ax = route.plot()
    assert (ax.get_xlabel(), ax.get_aspect()) == ("x [m]", 1.0)
    pyplot.close(ax.figure)
