"""Streets that are not as they were mapped: boxes by their literal reading, fair dice."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_virtual_scan import FEW, scene_of, sheet

import tilestream as ts
from tilestream.factors.beams import Beams
from tilestream.factors.virtual_scan import look, scan_in_world, virtual_scan
from tilestream.factors.worlds import Dice, World, kept, passed_by, stopped, world_at
from tilestream.kernels.boxes import stopped_by
from tilestream.settings import VirtualSettings

Floats = np.ndarray
PLACE_MM = np.array([100, -200, 300])
SEEING = VirtualSettings(range_max=40.0)


def directions(rng: np.random.Generator, count: int) -> Floats:
    free = rng.normal(size=(count, 3))
    return free / np.linalg.norm(free, axis=1, keepdims=True)


def literal(box: Floats, direction: Floats, near: float, far: float) -> float:
    """The first of many points along a beam that lies in the box."""
    x, y, c, s, length, width, top = box
    along = np.linspace(0.0, far, 200_001)
    points = along[:, None] * direction
    dx, dy = points[:, 0] - x, points[:, 1] - y
    inside = (np.abs(c * dx + s * dy) <= length) & (np.abs(c * dy - s * dx) <= width)
    inside &= points[:, 2] <= top
    if inside[0] or not inside.any():
        return np.inf
    first = along[np.argmax(inside)]
    return float(first) if first > near else np.inf


@pytest.mark.interpreted
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_beams_stop_where_the_literal_ones_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi)
    at = rng.uniform(-20.0, 20.0, 2)
    half = rng.uniform(0.2, 4.0, 2)
    box = np.array([*at, np.cos(turn), np.sin(turn), *half, rng.uniform(-1.5, 2.0)])
    beams = directions(rng, 40)
    beams[:20] = at[0] / 30, at[1] / 30, -0.02
    beams[:20] += rng.normal(0.0, 0.05, (20, 3))
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    found = stopped_by(box[None], beams, 0.9, 40.0)
    expected = np.array([literal(box, beam, 0.9, 40.0) for beam in beams])
    same = np.isclose(found, expected, atol=1e-3) | (found == expected)
    # A beam that touches a corner may pass between two points of the literal one.
    assert same.mean() >= 0.97


def test_the_nearest_of_several_boxes_counts_and_nothing_gets_farther() -> None:
    boxes = np.array([[10.0, 0, 1, 0, 1, 1, 5.0], [6.0, 0, 1, 0, 1, 1, 5.0]])
    ahead = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(stopped_by(boxes, ahead, 0.9, 40.0), [5.0, np.inf])
    np.testing.assert_allclose(stopped_by(boxes, ahead, 5.5, 40.0), [9.0, np.inf])
    world = World(boxes, np.zeros(1), 0.0, 1.0, 0.1)
    ranges, cosine = np.array([4.0, 30.0]), np.array([0.3, 0.4])
    met, its_cosine = stopped(world, ahead, ranges, cosine, (0.9, 40.0))
    np.testing.assert_array_equal(met, ranges)
    np.testing.assert_array_equal(its_cosine, cosine)
    met, its_cosine = stopped(world, ahead, np.array([8.0, np.inf]), cosine, (0.9, 40.0))
    np.testing.assert_allclose(met, [5.0, np.inf])
    np.testing.assert_array_equal(its_cosine, [1.0, 0.4])


def test_a_world_is_decided_by_its_dice_and_worlds_differ() -> None:
    worlds = [world_at(Dice(PLACE_MM, 0, draw), -2.0, 16, 0.1) for draw in (3, 3, 4)]
    np.testing.assert_array_equal(worlds[0].boxes, worlds[1].boxes)
    np.testing.assert_array_equal(worlds[0].bias, worlds[1].bias)
    assert (
        worlds[0].boxes.shape != worlds[2].boxes.shape or (worlds[0].boxes != worlds[2].boxes).any()
    )
    many = [world_at(Dice(PLACE_MM, 0, draw), -2.0, 16, 0.1) for draw in range(200)]
    counts = [len(world.boxes) for world in many]
    assert min(counts) < 8 < 20 < max(counts)
    tops = np.concatenate([world.boxes[:, 6] for world in many])
    assert set(np.round(tops, 6)) == {-0.5, 1.2, -0.3}
    bias = np.concatenate([world.bias for world in many])
    assert bias.std() == pytest.approx(0.01, rel=0.1)


def test_returns_are_lost_with_range_and_grazing_incidence() -> None:
    n = 4000
    world = World(np.zeros((0, 7)), np.zeros(1), 0.0, 0.5, 0.4)

    def share(ranges: float, cosine: float) -> float:
        dice = Dice(PLACE_MM, 0, 1)
        return float(kept(world, dice, np.full(n, ranges), np.full(n, cosine), 40.0).mean())

    assert share(1.0, 1.0) > 0.99
    assert share(20.0, 1.0) == pytest.approx(0.5, abs=0.03)
    assert share(1.0, 0.1) == pytest.approx(0.5, abs=0.03)
    assert share(np.inf, 0.0) == 0.0


def test_a_part_of_what_is_not_flat_is_passed_by_wherever_it_is_looked_from() -> None:
    rng = np.random.default_rng(0)
    centre, ball = rng.integers(-50_000, 50_000, (5000, 3)), rng.uniform(size=5000) < 0.6
    gone = passed_by(centre, ball, 0, 3)
    assert not gone[~ball].any()
    assert gone[ball].mean() == pytest.approx(0.4, abs=0.03)
    order = rng.permutation(5000)[:3000]
    np.testing.assert_array_equal(passed_by(centre[order], ball[order], 0, 3), gone[order])
    assert (passed_by(centre, ball, 0, 4) != gone).any()


def test_a_scan_in_a_world_is_of_the_map_and_of_those_in_the_street() -> None:
    """An empty plain with a wall: whatever is nearer than both is somebody in the street."""
    rng = np.random.default_rng(8)
    ground, wall = sheet(rng, 60.0, 60.0), sheet(rng, 60.0, 8.0)
    points = np.vstack(
        [
            np.column_stack([ground, np.full(len(ground), -2.0)]),
            np.column_stack([wall[:, 0], np.full(len(wall), 12.0), wall[:, 1]]),
        ]
    )
    beams = Beams.of(ts.VLP16, SEEING)
    place = np.zeros(3, np.int64)
    found = look(scene_of(points, place), place, 0.0, SEEING, beams)
    scans = [scan_in_world(found, place, SEEING, beams, draw) for draw in range(4)]
    np.testing.assert_array_equal(scans[0], scan_in_world(found, place, SEEING, beams, 0))
    still = virtual_scan(scene_of(points, place), found, place, SEEING, beams).points
    for scan in scans:
        assert 0.2 * len(still) < len(scan) <= len(beams)
        standing = (scan[:, 2] > -1.5) & (scan[:, 1] < 11.0) & (np.abs(scan[:, 0]) < 25.0)
        assert standing.mean() > 0.005
        assert scan[:, 2].min() > -2.2
    assert ((still[:, 2] > -1.5) & (still[:, 1] < 11.0) & (np.abs(still[:, 0]) < 25.0)).sum() == 0


def test_each_beam_has_its_ring_and_the_time_when_it_fires() -> None:
    (sensor,) = Beams.of(FEW, SEEING.model_copy(update={"blind_rear_deg": 90.0})).sensors
    elevation = np.degrees(np.arcsin(sensor.direction[:, 2]))
    np.testing.assert_allclose(elevation, np.array(FEW.elevations_deg)[sensor.ring], atol=1e-9)
    azimuth = np.arctan2(sensor.direction[:, 1], sensor.direction[:, 0])
    np.testing.assert_allclose(sensor.phase, azimuth / (2 * np.pi), atol=1e-9)
