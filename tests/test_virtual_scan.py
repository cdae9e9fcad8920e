"""The virtual scan: closed forms, a literal reference, invariances, any tiling, no leaks."""

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import PLACES

import tilestream as ts
from tilestream.factors.beams import Beams
from tilestream.factors.scene import Scene
from tilestream.factors.surfels import (
    Surfels,
    surfel_mm,
    surfels_in,
    surfels_table,
    tile_surfels,
)
from tilestream.factors.virtual_scan import (
    VirtualScan,
    look,
    look_past,
    near_share,
    probability,
    virtual_scan,
)
from tilestream.factors.worlds import Dice
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import Box
from tilestream.kernels.surfels import NORMAL_ONE, surfels_of
from tilestream.kernels.thinning import thinned
from tilestream.kernels.virtual_scan import cast
from tilestream.marks import Mark
from tilestream.settings import VirtualSettings

Floats = np.ndarray
EDGE = 200
FEW = ts.Sensor(
    name="few",
    range_max=40.0,
    elevations_deg=(-15.0, -7.0, -1.0, 5.0, 14.0),
    fov_deg=(-15.0, 15.0),
    azimuth_step_deg=6.0,
    rate_hz=10.0,
)
CLEAN = VirtualSettings(fading=0.0, grazing_deg=89.9)


def surfels_from(points: Floats) -> Surfels:
    """The surfels of points [m]."""
    index, centroids = thinned(np.rint(points * 1000).astype(np.int64), EDGE)
    own = np.ones(len(index), np.bool_)
    made = surfels_of(centroids, index, EDGE, own)
    return Surfels(*made, np.zeros(len(index), np.bool_))


def scene_of(points: Floats, place_mm: Floats, rim: float = 0.0) -> Scene:
    """The scene of points [m] for sensors within `rim` [m] of a place."""
    around = np.array([place_mm - round(rim * 1000), place_mm + round(rim * 1000)])
    return Scene.of(surfels_from(points), around, EDGE)


def scan_at(
    points: Floats, place: Floats, heading: float = 0.0, seeing: VirtualSettings = CLEAN
) -> tuple[VirtualScan, Beams]:
    """What `FEW` sees in points [m] from a place."""
    place_mm, beams = np.rint(np.array(place) * 1000).astype(np.int64), Beams.of(FEW, seeing)
    scene = scene_of(points, place_mm)
    found = look(scene, place_mm, heading, seeing, beams)
    return virtual_scan(scene, found, place_mm, seeing, beams), beams


def sheet(rng: np.random.Generator, length: float, width: float, spacing: float = 0.2) -> Floats:
    """(n, 2) jittered points over length x width, centred."""
    a, b = np.meshgrid(np.arange(0, length, spacing), np.arange(0, width, spacing), indexing="ij")
    grid = np.column_stack([a.ravel() - length / 2, b.ravel() - width / 2])
    return grid + rng.uniform(0.0, spacing, grid.shape)


def room(rng: np.random.Generator, half: float = 6.0, height: float = 4.0) -> Floats:
    """The inside of a box: floor at -1.5 m, ceiling, four walls."""
    floor = sheet(rng, 2 * half, 2 * half)
    wall = sheet(rng, 2 * half, height) + np.array([0.0, height / 2 - 1.5])
    at = np.full(len(wall), half)
    return np.vstack(
        [
            np.column_stack([floor, np.full(len(floor), -1.5)]),
            np.column_stack([floor, np.full(len(floor), height - 1.5)]),
            *(np.column_stack([wall[:, 0], sign * at, wall[:, 1]]) for sign in (-1, 1)),
            *(np.column_stack([sign * at, wall[:, 0], wall[:, 1]]) for sign in (-1, 1)),
        ]
    )


def test_ranges_on_a_plane_are_those_of_the_closed_form() -> None:
    rng = np.random.default_rng(0)
    ground = sheet(rng, 40.0, 40.0)
    found, beams = scan_at(np.column_stack([ground, np.full(len(ground), -2.0)]), np.zeros(3))
    down = -beams.direction[:, 2]
    expected = np.where(down > 0.05, 2.0 / np.where(down > 0.05, down, 1.0), np.inf)
    inside = np.isfinite(expected) & (expected < 18.0)
    assert inside.sum() == 2 * 60
    np.testing.assert_allclose(found.ranges[inside], expected[inside], atol=0.01)
    np.testing.assert_allclose(found.cosine[inside], down[inside], atol=1e-3)
    assert not np.isfinite(found.ranges[down < 0]).any()


def test_ranges_in_a_room_are_those_of_the_closed_form() -> None:
    found, beams = scan_at(room(np.random.default_rng(1)), np.array([0.4, -0.3, 0.0]))
    with np.errstate(divide="ignore"):
        to_faces = np.where(
            beams.direction > 0,
            (np.array([5.6, 6.3, 2.5])) / beams.direction,
            (np.array([-6.4, -5.7, -1.5])) / beams.direction,
        )
    expected = np.nanmin(np.where(to_faces > 0, to_faces, np.inf), axis=1)
    met = expected[:, None] * beams.direction
    high, low = np.array([5.6, 6.3, 2.5]), np.array([-6.4, -5.7, -1.5])
    to_face = np.minimum(np.abs(met - high), np.abs(met - low))
    clear = np.sort(to_face, axis=1)[:, 1] > 0.7  # where faces meet, points make no plane
    assert clear.mean() > 0.6
    np.testing.assert_allclose(found.ranges[clear], expected[clear], atol=0.02)
    assert np.isfinite(found.ranges).mean() > 0.95


def test_no_beam_passes_between_the_points_of_a_near_wall() -> None:
    rng = np.random.default_rng(2)
    near, far = sheet(rng, 8.0, 8.0), sheet(rng, 60.0, 30.0)
    walls = np.vstack(
        [
            np.column_stack([np.full(len(near), 1.5), near]),
            np.column_stack([np.full(len(far), 12.0), far]),
        ]
    )
    for heading in np.linspace(0.0, 0.1, 4):
        found, beams = scan_at(walls, np.zeros(3), heading)
        azimuth = np.arctan2(beams.direction[:, 1], beams.direction[:, 0]) + heading
        at_it = np.abs(azimuth) < np.radians(60.0)
        assert at_it.sum() > 80
        expected = 1.5 / (beams.direction @ np.array([np.cos(heading), -np.sin(heading), 0.0]))
        np.testing.assert_allclose(found.ranges[at_it], expected[at_it], atol=0.02)


def test_a_sparse_wall_does_not_leak_either() -> None:
    """Points 0.25 m apart leave every third voxel empty: the discs next door close most of them."""
    wall = sheet(np.random.default_rng(3), 12.0, 8.0, 0.25)
    found, beams = scan_at(np.column_stack([np.full(len(wall), 3.05), wall]), np.zeros(3))
    azimuth = np.arctan2(beams.direction[:, 1], beams.direction[:, 0])
    at_it = np.abs(azimuth) < np.radians(45.0)
    assert np.isfinite(found.ranges[at_it]).mean() > 0.95


# --- The literal reference


def owners(surfels: Surfels) -> dict[tuple[int, int, int], int]:
    """The surfel of each voxel, one look at each pair."""
    found: dict[tuple[int, int, int], tuple[float, tuple[int, ...], int]] = {}
    for row, (centre, normal, radius) in enumerate(
        zip(surfels.centre_mm, surfels.normal / NORMAL_ONE, surfels.radius_mm, strict=True)
    ):
        normal = normal.astype(np.float32).astype(np.float64)
        low, high = (centre - radius) // EDGE, (centre + radius) // EDGE
        for voxel in product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))):
            away = (np.array(voxel) + 0.5) * EDGE - centre
            off = abs(normal @ away)
            beside = away @ away - off**2 > (radius + EDGE / 8) ** 2
            own = np.abs(away).max() <= EDGE / 2
            if normal.any() and not own and (off > EDGE / 2 * np.abs(normal).sum() or beside):
                continue
            claim = (float(away @ away), tuple(centre.tolist()), row)
            found[voxel] = min(found.get(voxel, claim), claim)
    return {voxel: row for voxel, (_, _, row) in found.items()}


def literal_range(
    surfels: Surfels, owner: dict[tuple[int, int, int], int], place: Floats, d: Floats
) -> float:
    """Range of one ray [mm]: every face of the lattice that it crosses, voxel after voxel."""
    reach = 8_000.0
    crossings = [0.0, reach]
    for axis in range(3):
        if d[axis] != 0.0:
            faces = np.arange(-60, 61) * EDGE + place[axis] // EDGE * EDGE
            crossings += [t for t in (faces - place[axis]) / d[axis] if 0.0 < t < reach]
    best = np.inf
    steps = sorted(crossings)
    for t, t_next in pairwise(steps):
        if best <= t:
            break
        voxel = tuple(int(v) for v in (place + d * (t + t_next) / 2.0) // EDGE)
        row = owner.get(voxel)
        if row is None:
            continue
        to = surfels.centre_mm[row] - place
        normal = (surfels.normal[row] / NORMAL_ONE).astype(np.float32).astype(np.float64)
        slope = float(normal @ d) if normal.any() else 1.0
        met = float(normal @ to) / slope if normal.any() else float(d @ to)
        miss = met * d - to
        covered = miss @ miss <= surfels.radius_mm[row] ** 2
        solid = normal.any() and t - 1e-3 <= met <= t_next + 1e-3
        if 0.0 <= met < best and (covered or solid):
            best = met
    return best if best <= reach else np.inf


@pytest.mark.interpreted
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_marching_is_that_of_the_literal_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surfels = Surfels(
        rng.integers(-3000, 3000, (60, 3)),
        np.rint(directions(rng, 60) * NORMAL_ONE).astype(np.int16),
        rng.integers(60, 200, 60).astype(np.int32),
        np.zeros(60, np.bool_),
    )
    surfels.normal[::4] = 0
    place = rng.integers(-1500, 1500, 3)
    beams = directions(rng, 25)
    beams[0] = (1.0, 0.0, 0.0)
    owner, scene = owners(surfels), Scene.of(surfels, place[None], EDGE)
    ranges, cosine = np.empty(len(beams)), np.empty(len(beams))
    row = np.empty(len(beams), np.int32)
    cast(scene.bricks, place, beams, 0.0, 8_000.0, ranges, cosine, row)
    expected = [literal_range(surfels, owner, place, d) / 1000.0 for d in beams]
    np.testing.assert_allclose(ranges, expected, rtol=1e-9)


def directions(rng: np.random.Generator, count: int) -> Floats:
    free = rng.normal(size=(count, 3))
    return free / np.linalg.norm(free, axis=1, keepdims=True)


# --- Invariances


@pytest.fixture(scope="module")
def street() -> Floats:
    """A short street whose coordinates are odd millimetres: on no face of the lattice."""
    points = PLACES["crossing"](np.random.default_rng(4), 16.0, 0.3)
    return (2 * np.rint(points * 500).astype(np.int64) + 1) / 1000.0


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_what_is_left_out_changes_no_beam_that_met_something_else(
    street: Floats, share: float
) -> None:
    place_mm, beams = np.array([8101, 303, 2001]), Beams.of(FEW, CLEAN)
    scene = scene_of(street, place_mm)
    whole = look(scene, place_mm, 0.3, CLEAN, beams)
    assert ((whole[0].surfel >= 0) == np.isfinite(whole[0].ranges)).all()
    gone = np.random.default_rng(7).random(len(scene.bricks.surfels)) < share
    fewer = scene.without(gone)
    (past,), (anew,) = (
        look_past(fewer, whole, CLEAN, beams),
        look(fewer, place_mm, 0.3, CLEAN, beams),
    )
    for name in ("ranges", "cosine", "surfel"):
        np.testing.assert_array_equal(getattr(past, name), getattr(anew, name))
    changed = past.ranges != whole[0].ranges
    assert changed.any() == (share > 0.0)
    assert gone[whole[0].surfel[changed]].all()


def test_whole_voxels_of_translation_do_not_show(street: Floats) -> None:
    place = np.array([8.101, 0.303, 2.001])
    here, _ = scan_at(street, place, 0.3)
    for shift in ((0.2, 0.0, 0.0), (-35.0, 1234.2, 6.4), (370_000.0, 3_950_000.0, 0.0)):
        beams = Beams.of(FEW, CLEAN)
        place_mm = np.rint((place + shift) * 1000).astype(np.int64)
        scene = Scene.of(surfels_from(street + shift), place_mm[None], EDGE)
        (met,) = look(scene, place_mm, 0.3, CLEAN, beams)
        np.testing.assert_array_equal(met.ranges, here.ranges)
        np.testing.assert_array_equal(met.cosine, here.cosine)


def test_a_quarter_turn_of_map_and_vehicle_does_not_show(street: Floats) -> None:
    place = np.array([8.101, 0.303, 2.001])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    here, _ = scan_at(street, place, 0.3)
    there, _ = scan_at(street @ turn.T, turn @ place, 0.3 + np.pi / 2)
    same = np.isclose(here.ranges, there.ranges, atol=1e-6) | (here.ranges == there.ranges)
    assert same.mean() > 0.99  # a beam through a face of two voxels may take the other one
    assert here.unmapped_share == pytest.approx(there.unmapped_share, abs=0.02)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "canyon.pcd"
    write_pcd(path, PLACES["canyon"](np.random.default_rng(5), 24.0, 0.3))
    return path


def everything(store: ts.TileStore) -> Surfels:
    found = surfels_in(store, Box(-100_000, -100_000, 100_000, 100_000))
    order = np.lexsort(np.column_stack([found.normal, found.centre_mm]).T)
    return Surfels(
        found.centre_mm[order], found.normal[order], found.radius_mm[order], found.ghost[order]
    )


def test_no_tiling_shows_in_the_surfels(cloud: Path, tmp_path: Path) -> None:
    """Also where the tiles cut the voxels, as those of 7.3 m do."""
    stores = [
        ts.ingest(cloud, tmp_path / f"{size}_{leaf}.zarr", tile_size=size, map_leaf=leaf)
        for size, leaf in ((100.0, 0.2), (8.0, 0.2), (100.0, 0.0), (7.3, 0.0))
    ]
    whole, cut, all_points, odd = (everything(store) for store in stores)
    for one, other in ((whole, cut), (all_points, odd)):
        assert len(one) > 1000
        np.testing.assert_array_equal(one.centre_mm, other.centre_mm)
        np.testing.assert_array_equal(one.normal, other.normal)
        np.testing.assert_array_equal(one.radius_mm, other.radius_mm)
        np.testing.assert_array_equal(one.ghost, other.ghost)


@pytest.fixture(scope="module")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> ts.TileStore:
    """A wall whose left half was seen from near, and whose right half from afar."""
    rng, folder = np.random.default_rng(6), tmp_path_factory.mktemp("sparse")
    dense, thin_half = sheet(rng, 10.0, 8.0, 0.15), sheet(rng, 10.0, 8.0, 0.42)
    ahead = np.array([5.0, 0.0])
    wall = np.vstack([dense - ahead, thin_half + ahead])
    points = np.column_stack([wall[:, 0], rng.normal(10.0, 0.01, len(wall)), wall[:, 1]])
    path = folder / "wall.pcd"
    write_pcd(path, points)
    return ts.ingest(path, folder / "map.zarr", tile_size=7.0)


def test_where_the_map_is_sparse_larger_discs_stand_and_elsewhere_none(
    sparse: ts.TileStore,
) -> None:
    found = everything(sparse)
    coarse = found.radius_mm > EDGE
    assert coarse.sum() > 50
    assert found.flat[coarse].all()
    assert found.radius_mm.max() <= 3 * EDGE
    assert (found.centre_mm[coarse, 0] > -500).all()
    level_one = found.where(~coarse)
    discs = {tuple(v) for v in (level_one.centre_mm[level_one.flat] // (2 * EDGE)).tolist()}
    own = (found.centre_mm[coarse] // (2 * EDGE)).tolist()
    assert np.mean([tuple(voxel) in discs for voxel in own]) < 0.05  # a centre may leave its voxel


def test_no_beam_passes_a_wall_that_was_seen_from_afar(sparse: ts.TileStore) -> None:
    rng, place = np.random.default_rng(7), np.zeros(3, np.int64)
    goal = np.column_stack(
        [rng.uniform(1.0, 9.0, 400), np.full(400, 10.0), rng.uniform(-3.0, 3.0, 400)]
    )
    beams = goal / np.linalg.norm(goal, axis=1, keepdims=True)
    found, missed = everything(sparse), []
    for surfels in (found, found.where(found.radius_mm <= EDGE)):
        scene = Scene.of(surfels, place[None], EDGE)
        ranges, cosine, row = np.empty(400), np.empty(400), np.empty(400, np.int32)
        cast(scene.bricks, place, beams, 0.0, 50_000.0, ranges, cosine, row)
        missed.append(np.isinf(ranges).mean())
    assert missed[0] < 0.1 < 0.4 < missed[1]


def test_a_table_of_surfels_is_used_while_it_is_up_to_date(cloud: Path, tmp_path: Path) -> None:
    store = ts.ingest(cloud, tmp_path / "map.zarr", tile_size=8.0)
    key = store.keys()[0]
    made = tile_surfels(store, key)
    tile, table = store.tile(key), surfels_table(surfel_mm(store))
    columns = table.make(store, key)
    identity = table.identity(store.grid, key, store.identities())
    some = {name: np.ascontiguousarray(column[..., :5]) for name, column in columns.items()}
    tile.write_table(table.name, some, Mark("done", identity=identity))
    core = store.grid.core(key)
    assert len(surfels_in(store, core)) <= 5 < len(made)
    tile.write_table(table.name, some, Mark("done", identity="of another map"))
    made_now = surfels_in(store, core)
    tile.write_table(table.name, columns, Mark("done", identity=identity))
    kept = surfels_in(store, core)
    for surfels in (made_now, kept):
        inside = made.where(core.holds(made.centre_mm))
        np.testing.assert_array_equal(surfels.centre_mm, inside.centre_mm)
        np.testing.assert_array_equal(surfels.normal, inside.normal)
        np.testing.assert_array_equal(surfels.radius_mm, inside.radius_mm)
    assert len(store.points_in(core)) == len(tile.points())


# --- Surfels


def test_a_plane_gives_discs_on_it_and_single_points_balls() -> None:
    rng = np.random.default_rng(6)
    flat = sheet(rng, 6.0, 6.0)
    z = 0.3 * flat[:, 0] + 0.1 * flat[:, 1]
    lonely = np.array([[20.0, 0.0, 1.0], [25.0, 3.0, 1.0]])
    found = surfels_from(np.vstack([np.column_stack([flat, z]), lonely]))
    normal = np.array([-0.3, -0.1, 1.0]) / np.linalg.norm([-0.3, -0.1, 1.0])
    ball = ~found.normal.any(axis=1)
    assert 2 <= ball.sum() <= 6  # and corners of the sheet with fewer than five neighbours
    assert set(found.radius_mm[ball]) == {100}
    np.testing.assert_allclose(np.abs(found.normal[~ball] @ normal) / NORMAL_ONE, 1.0, atol=1e-4)
    assert np.abs(found.centre_mm[~ball] @ normal).max() < 2.0  # rounding to 1 mm
    inside = (np.abs(found.centre_mm[:, :2]) < 2500).all(axis=1) & ~ball
    assert 150 < np.median(found.radius_mm[inside]) <= 200
    assert found.radius_mm.max() <= 200


@pytest.mark.parametrize(
    ("edge", "count"),
    [
        pytest.param(EDGE, 150, marks=pytest.mark.interpreted, id="loose"),
        pytest.param(EDGE, 20_000, id="a voxel full beside the other"),
        pytest.param(4000, 150, id="sums of more than 32 bits"),
    ],
)
def test_the_points_that_decide_a_surfel_are_those_within_its_reach(edge: int, count: int) -> None:
    rng, scale = np.random.default_rng(7), edge / 200
    points = rng.integers(-5 * edge, 5 * edge, (count, 3)) + np.array([10**9, -(10**9), 0])
    index, points = thinned(points, edge)
    own = np.arange(len(points)) % 3 != 0
    centre, normal, radius = surfels_of(points, index, edge, own)
    for row, at in zip(np.flatnonzero(own), range(own.sum()), strict=True):
        near = points[((points - points[row]) ** 2).sum(axis=1) <= (450 * scale) ** 2]
        flat = False
        if len(near) >= 5:
            values, vectors = np.linalg.eigh(np.cov(near.T.astype(np.float64)))
            s3, s2 = np.sqrt(np.maximum(values[:2], 0.0))
            flat = s3 < 100.0 * scale and s3 < 0.6 * s2
        assert normal[at].any() == flat
        if flat:
            unit = vectors[:, 0]
            onto = points[row] + unit * (unit @ (near.mean(axis=0) - points[row]))
            np.testing.assert_allclose(centre[at], onto, atol=0.51)
            assert abs(normal[at] @ unit) / NORMAL_ONE > 1.0 - 1e-4
            assert abs(radius[at] - min(200.0 * scale, 50.0 * scale + 0.6 * s2)) <= 0.51
        else:
            np.testing.assert_array_equal(centre[at], points[row])


# --- The sensor


def test_the_place_and_nothing_else_decides_noise_and_drop_outs(street: Floats) -> None:
    seeing = VirtualSettings()
    place = np.array([8.101, 0.303, 2.001])
    one, beams = scan_at(street, place, 0.3, seeing)
    again, _ = scan_at(street, place, 0.3, seeing)
    np.testing.assert_array_equal(one.points, again.points)
    other, _ = scan_at(street, place, 0.3, seeing.model_copy(update={"seed": 1}))
    assert len(one.points) != len(other.points) or (one.points != other.points).any()
    measured = np.linalg.norm(one.points, axis=1)
    noise = measured - one.ranges[one.came]
    assert 0.015 < noise.std() < 0.025
    np.testing.assert_allclose(one.points / measured[:, None], beams.direction[one.came], atol=1e-9)
    assert one.return_share == one.came.mean()


def test_dice_are_uniform_and_differ_from_place_to_place_and_draw_to_draw() -> None:
    def numbers(place: list[int], seed: int = 0, draw: int = 0) -> Floats:
        dice = Dice(np.array(place), seed, draw)
        return np.array([dice.uniform(5000), dice.uniform(5000)])

    found = numbers([1, -2, 3])
    assert ((found > 0.0) & (found < 1.0)).all()
    np.testing.assert_allclose(found.mean(axis=1), 0.5, atol=0.02)
    np.testing.assert_allclose(found.std(axis=1), 12**-0.5, atol=0.01)
    assert abs(np.corrcoef(found)[0, 1]) < 0.05
    np.testing.assert_array_equal(found, numbers([1, -2, 3]))
    others = [numbers(place) for place in ([1, -2, 4], [-2, 1, 3], [0, -2, 3])]
    for other in (*others, numbers([1, -2, 3], seed=1), numbers([1, -2, 3], draw=1)):
        assert (other != found).mean() > 0.99
        assert abs(np.corrcoef(other[0], found[0])[0, 1]) < 0.05
    normal = Dice(np.array([1, -2, 3]), 0, 0).normal(2.0, 20_000)
    assert abs(normal.mean()) < 0.05
    assert normal.std() == pytest.approx(2.0, abs=0.05)


def test_returns_fade_with_range_and_grazing_incidence() -> None:
    seeing = VirtualSettings()
    ranges = np.array([5.0, 60.0, 80.0, 100.0, np.inf, 5.0, 5.0])
    cosine = np.array([1.0, 1.0, 1.0, 1.0, 0.0, np.cos(np.radians(75.0)) / 2, 0.0])
    np.testing.assert_allclose(
        probability(ranges, cosine, 100.0, seeing), [1.0, 1.0, 0.7, 0.4, 0.0, 0.5, 0.0]
    )


def test_range_and_blind_sector_limit_what_is_seen(street: Floats) -> None:
    seeing = CLEAN.model_copy(update={"range_max": 9.0, "blind_rear_deg": 120.0})
    found, beams = scan_at(street, np.array([8.101, 0.303, 2.001]), 0.3, seeing)
    azimuth = np.degrees(np.arctan2(beams.direction[:, 1], beams.direction[:, 0]))
    assert np.abs(azimuth).max() < 120.1
    assert len(azimuth) == 5 * 41
    assert found.ranges[np.isfinite(found.ranges)].max() <= 9.0
    assert found.ranges.min() >= 0.9


def test_beams_that_leave_the_mapped_area_are_counted() -> None:
    """A wall ahead and ground up to 10 m behind it: all beams behind the wall's ends leave."""
    rng = np.random.default_rng(8)
    ground = sheet(rng, 20.0, 20.0)
    points = np.column_stack([ground, np.full(len(ground), -2.0)])
    found, _ = scan_at(points, np.zeros(3))
    meets = np.isfinite(found.ranges)
    assert found.unmapped_share == pytest.approx((~meets).mean())
    short = CLEAN.model_copy(update={"range_max": 5.0})
    assert scan_at(points, np.zeros(3), 0.0, short)[0].unmapped_share == 0.0


def test_a_place_in_a_wall_is_crowded_and_one_beside_it_is_not() -> None:
    wall = sheet(np.random.default_rng(9), 12.0, 6.0)
    points = np.column_stack([np.zeros(len(wall)), wall])
    beams = Beams.of(FEW, CLEAN)
    for x, low, high in ((30, 0.4, 0.6), (2000, 0.0, 0.0)):
        place = np.array([x, 0, 0])
        scene = Scene.of(surfels_from(points), place[None], EDGE)
        assert low <= near_share(scene, place, beams, 0.9) <= high
