"""What a sample point sees: membership, integer sums, depth images, against plain NumPy twins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from literal import depth_image as literal_image
from literal import row_edges_deg, thinned_mm, view_from, world_of
from numpy.typing import NDArray
from scenes import UTM, scene

from tilestream.errors import UsageError
from tilestream.factors import layout
from tilestream.factors.vicinity import (
    FRACTION,
    HISTOGRAMS,
    STANDING,
    Terms,
    TileTerms,
    fixed,
    ratio,
    row_edges,
    vicinity_sums,
)
from tilestream.kernels import azimuth
from tilestream.kernels.thinning import thinned
from tilestream.sensor import HDL64, OS1_128, VLP16, Sensor

Floats = NDArray[np.float64]
NARROW = Sensor(
    name="narrow",
    range_max=15.0,
    elevations_deg=(-30.0, -21.0, -4.0, 0.0, 1.0, 33.0),
    fov_deg=(-33.0, 40.0),
    azimuth_step_deg=1.0,
    rate_hz=10.0,
)
UPWARDS = NARROW.model_copy(update={"fov_deg": (5.0, 60.0), "elevations_deg": (5.0, 30.0, 60.0)})
DOWNWARDS = NARROW.model_copy(update={"fov_deg": (-80.0, -2.0), "elevations_deg": (-80.0, -2.0)})
SENSORS = (VLP16, HDL64, OS1_128, NARROW, UPWARDS, DOWNWARDS)


def random_terms(mean: Floats, rng: np.random.Generator) -> Terms:
    n = len(mean)
    return {
        **{name: rng.integers(-1, bins, n) for name, bins in HISTOGRAMS.items()},
        STANDING: rng.random(n) < 0.5,
        "whole": rng.integers(-5, 10**6, n),
        "real": rng.normal(0, 100, n),
        "score": rng.uniform(0, 10.0 ** rng.uniform(0, 5, (n, 1)), (n, 441)),
    }


def random_map(seed: int, n: int = 700) -> tuple[Floats, Terms, NDArray[np.int64], Floats]:
    """Means, terms, points of the depth image and loose voxels, all over 60 x 40 x 20 m at UTM."""
    rng = np.random.default_rng(seed)
    size = np.array([60.0, 40.0, 20.0])
    mean = np.round(rng.uniform(0, 1, (n, 3)) * size, 3) + UTM
    depth = np.rint((rng.uniform(0, 1, (4 * n, 3)) * size + UTM) * 1000).astype(np.int64)
    loose = np.round(rng.uniform(0, 1, (n // 4, 3)) * size, 3) + UTM
    return mean, random_terms(mean, rng), depth, loose


def tile_of(mean: Floats, terms: Terms, depth: NDArray[np.int64], loose: Floats) -> TileTerms:
    count = np.arange(len(loose)) % 5 + 1
    return TileTerms.of(mean, terms, "score", depth, loose, count)


def split(seed: int, parts: int) -> list[TileTerms]:
    """The map of a seed as some tiles."""
    mean, terms, depth, loose = random_map(seed)
    count = np.arange(len(loose)) % 5 + 1
    rng = np.random.default_rng(seed + 1)
    c, d, s = (rng.integers(0, parts, len(a)) for a in (mean, depth, loose))
    return [
        TileTerms.of(
            mean[c == t],
            {name: term[c == t] for name, term in terms.items()},
            "score",
            depth[d == t],
            loose[s == t],
            count[s == t],
        )
        for t in range(parts)
    ]


def drive(k: int = 12) -> Floats:
    """Places along a line through the map, then some far off it and at a mean."""
    along = np.column_stack([np.linspace(-5, 62, k), np.full(k, 17.0), np.full(k, 4.0)])
    return np.vstack([along, [[30.0, 20.0, 60.0], [400.0, 0.0, 2.0]]]) + UTM


def members(place: Floats, mean: Floats, sensor: Sensor) -> NDArray[np.bool_]:
    d = mean - place
    r = np.linalg.norm(d, axis=1)
    low, high = np.radians(sensor.fov_deg)
    with np.errstate(invalid="ignore", divide="ignore"):
        up = np.arcsin(d[:, 2] / r)
    return (r > 0) & (r <= sensor.range_max) & (low <= up) & (up <= high)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{s.name}{s.fov_deg}")
def test_sums_are_those_of_the_members(sensor: Sensor) -> None:
    check_sums(sensor, 700, drive())


@pytest.mark.interpreted
def test_sums_of_few_cells_are_those_of_the_members() -> None:
    check_sums(NARROW, 40, drive(3)[:3])


def check_sums(sensor: Sensor, n: int, places: Floats) -> None:
    mean, terms, depth, loose = random_map(1, n)
    places = np.vstack([places, mean[:1]])
    sums = vicinity_sums(places, sensor, [tile_of(mean, terms, depth, loose)])
    count = np.arange(len(loose)) % 5 + 1
    for p, place in enumerate(places):
        inside = members(place, mean, sensor)
        d = mean[inside] - place
        r = np.linalg.norm(d, axis=1)
        u = d / r[:, None]
        assert sums["cells"][p] == inside.sum()
        assert sums["whole"][p] == terms["whole"][inside].sum()
        assert sums["real"][p] == pytest.approx(terms["real"][inside].sum(), abs=1e-3)
        assert sums["range"][p] == pytest.approx(r.sum(), rel=1e-9)
        assert sums["range_squared"][p] == pytest.approx((r**2).sum(), rel=1e-9)
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            name = f"sight_{'xyz'[a]}{'xyz'[b]}"
            assert sums[name][p] == pytest.approx((u[:, a] * u[:, b]).sum(), abs=1e-8)
        field = terms["score"][inside].sum(axis=0)
        steps = terms["score"][inside].max(axis=1, initial=0.0) / 2**31 + 1 / 2**20
        assert np.abs(sums["score"][p] - field).max() <= steps.sum()
        for name, bins in HISTOGRAMS.items():
            given = terms[name][inside]
            assert np.array_equal(sums[name][p], np.bincount(given[given >= 0], minlength=bins))
        sector = np.floor((np.arctan2(d[:, 1], d[:, 0]) % (2 * np.pi)) / np.radians(4) + 1e-9)
        for name, chosen in (("azimuth", r > 0), ("azimuth_standing", terms[STANDING][inside])):
            expected = np.bincount(sector[chosen].astype(int) % 90, minlength=90)
            assert np.array_equal(sums[name][p], expected)
        assert sums["loose_points"][p] == count[members(place, loose, sensor)].sum()
    assert sums["cells"].max() > n / 20


def test_nothing_depends_on_tiles_or_on_the_order_of_tiles_and_places() -> None:
    places = drive()
    whole = vicinity_sums(places, NARROW, split(2, 1))
    tiles = split(2, 5)
    turned = vicinity_sums(places[::-1], NARROW, tiles[::-1])
    alone = [vicinity_sums(place[None], NARROW, tiles) for place in places]
    assert whole["cells"].max() > 50
    for name, sums in whole.items():
        assert np.array_equal(sums, turned[name][::-1]), name
        assert np.array_equal(sums, np.concatenate([one[name] for one in alone])), name


def test_the_map_far_from_the_origin_is_the_map_at_the_origin() -> None:
    mean, terms, depth, loose = random_map(3)
    shift = np.rint(np.array(UTM) * 1000).astype(np.int64)
    here = tile_of(mean - UTM, terms, depth - shift, loose - UTM)
    sums = vicinity_sums(drive() - UTM, VLP16, [here])
    far = vicinity_sums(drive(), VLP16, [tile_of(mean, terms, depth, loose)])
    for name, near in sums.items():
        assert near == pytest.approx(far[name], rel=1e-8, abs=1e-6), name


def test_a_map_without_cells_or_without_tiles_sums_to_nothing() -> None:
    empty = np.zeros((0, 3))
    no_terms = {k: v[:0] for k, v in random_map(4)[1].items()}
    for tiles in ([], [tile_of(empty, no_terms, empty.astype(np.int64), empty)]):
        sums = vicinity_sums(drive(), VLP16, tiles)
        assert (sums["cells"] == 0).all()
        assert (sums["occupied"] == 0).all()
        assert (sums["pixels"] == 16 * 360).all()
    assert vicinity_sums(np.zeros((0, 3)), VLP16, split(4, 1))["score"].shape == (0, 441)


def test_terms_survive_the_store() -> None:
    tile = split(5, 1)[0]
    again = TileTerms.from_arrays({k: v.copy() for k, v in tile.arrays().items()})
    assert again.names == tile.names == ("whole", "real")
    ours, theirs = (vicinity_sums(drive(), VLP16, [t]) for t in (tile, again))
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_terms_that_cannot_be_summed_are_refused() -> None:
    assert fixed(np.array([1.5, -2.0]), "x").tolist() == [1.5 * FRACTION, -2 * FRACTION]
    assert fixed(np.array([True, False]), "x").tolist() == [1, 0]
    for bad in (np.nan, np.inf, 1e13):
        with pytest.raises(UsageError, match="term x"):
            fixed(np.array([0.0, bad]), "x")
    one = split(6, 1)[0]
    other = TileTerms.from_arrays({**one.arrays(), "names": np.frombuffer(b"a\nb", np.uint8)})
    with pytest.raises(UsageError, match="two kinds"):
        vicinity_sums(drive(), VLP16, [one, other])


def test_a_mean_over_nothing_is_nan() -> None:
    assert np.array_equal(ratio(np.array([1.0, 0.0]), np.array([4, 0])), [0.25, np.nan], True)


# --- Azimuths


@given(st.floats(-np.pi, np.pi), st.sampled_from([1e-10, 1e-3, 1.0, 80.0, 1e5]))
@settings(max_examples=300, deadline=None)
def test_the_guess_of_an_azimuth_is_as_near_as_it_claims(angle: float, length: float) -> None:
    x, y = length * np.cos(angle), length * np.sin(angle)
    error = azimuth.turns_guess(x, y) - np.arctan2(y, x) % (2 * np.pi) / (2 * np.pi)
    assert abs(error - np.rint(error)) < azimuth.UNSURE / 2000


@pytest.mark.interpreted
def test_azimuths_on_edges_fall_in_the_bin_that_begins_there() -> None:
    for bins in (90, 360):
        for b in range(bins):
            a = 2 * np.pi * b / bins
            x, y = 7.0 * np.cos(a), 7.0 * np.sin(a)
            assert azimuth.is_unsure(azimuth.turns_guess(x, y), bins)
            assert azimuth.azimuth_bin_exactly(x, y, bins) == b
    assert azimuth.azimuth_bin_exactly(-1e-10, -1e-10, 360) == 0
    assert azimuth.azimuth_bin_exactly(1.0, -1e-12, 360) == 0
    assert azimuth.turns_guess(0.0, 0.0) == 0.0


# --- The depth image


@pytest.mark.interpreted
def test_points_are_thinned_to_whole_millimetres_half_to_even() -> None:
    points = np.random.default_rng(7).integers(-3000, 3000, (4000, 3))
    voxels, ours = thinned(points, 500)
    assert np.array_equal(ours, thinned_mm(points, 500))
    assert np.array_equal(voxels, np.unique(points // 500, axis=0))
    two = np.array([[1, 3, -2], [2, 4, -1]])
    assert thinned(two, 500)[1].tolist() == [[2, 4, -2]]


def test_rows_of_the_depth_image_lie_halfway_between_beams() -> None:
    assert np.degrees(row_edges(VLP16)) == pytest.approx(np.arange(-16, 17, 2))
    for sensor in SENSORS:
        assert np.degrees(row_edges(sensor)) == pytest.approx(row_edges_deg(sensor))


@pytest.mark.parametrize("place", ["canyon", "park", "tunnel"])
@pytest.mark.parametrize("sensor", [VLP16, HDL64, OS1_128, NARROW], ids=lambda s: s.name)
def test_the_depth_image_is_that_of_every_point(place: str, sensor: Sensor) -> None:
    check_image(scene(place, seed=8, size=40.0, offset=UTM), sensor, eyes=14)


@pytest.mark.interpreted
def test_the_depth_image_of_few_points_is_that_of_every_point() -> None:
    check_image(scene("canyon", seed=8, size=12.0, spacing=0.8, offset=UTM), VLP16, eyes=3)


def check_image(points: Floats, sensor: Sensor, eyes: int) -> None:
    world = world_of(points, 2.0)
    depth = np.rint((world.depth_points + world.origin) * 1000).astype(np.int64)
    no_cells = np.zeros((0, 3))
    no_terms = {k: v[:0] for k, v in random_map(9)[1].items()}
    tiles = [tile_of(no_cells, no_terms, part, no_cells) for part in np.array_split(depth, 3)]
    along = np.linspace(-6, points[:, 0].max() - UTM[0] + 4, eyes)
    places = np.column_stack([along, np.full(eyes, 1.3004), np.full(eyes, 1.9)]) + UTM
    sums = vicinity_sums(places, sensor, tiles)
    expected = [literal_image(view_from(world, place, sensor)).sum() for place in places]
    assert sums["occupied"].tolist() == expected
    assert max(expected) > 60


# --- Layout


def test_an_entropy_of_walls_does_not_care_for_signs_or_for_bin_edges() -> None:
    def entropy(angles_deg: list[float]) -> float:
        bins = [int(np.floor((a % 180) / 5 + 1e-9)) for a in angles_deg]
        counts = np.bincount(bins, minlength=36)[None].astype(np.int32)
        return float(layout._smooth_entropy(counts)[0])

    one = entropy([2.0] * 100)
    on_edge = entropy([-0.1, 0.1] * 50)
    crossing = entropy([2.0, 92.0] * 50)
    everywhere = entropy(list(np.arange(0, 180, 5.0)))
    assert one == pytest.approx(entropy([182.0] * 50 + [2.0] * 50))
    assert abs(on_edge - one) < 0.3
    assert crossing == pytest.approx(one + 1.0)
    assert everywhere == pytest.approx(np.log2(36))


def test_the_largest_empty_sector_runs_round_the_circle() -> None:
    empty = np.zeros((4, 90), bool)
    empty[0] = True
    empty[1, :7] = empty[1, -5:] = True
    empty[2, 40] = True
    assert layout._longest_run(empty).tolist() == [90, 12, 1, 0]


def test_dilution_of_precision_is_that_of_the_inverse() -> None:
    rng = np.random.default_rng(10)
    u = rng.normal(size=(5, 40, 3)) * [1.0, 1.0, 0.3]
    u /= np.linalg.norm(u, axis=2)[..., None]
    products = np.einsum("kna,knb->kab", u, u)
    products[4] = np.diag([20.0, 20.0, 0.0])  # nothing vertical
    sums = {f"sight_{'xyz'[a]}{'xyz'[b]}": products[:, a, b] for a in range(3) for b in range(a, 3)}
    found = layout._dilution({**sums, "cells": np.full(5, 40.0)}, "sight")
    inverse = np.linalg.inv(products[:4] / 40.0)
    expected = np.sqrt(inverse[:, 0, 0] + inverse[:, 1, 1])
    assert found["sight_HDOP"][:4] == pytest.approx(expected, rel=1e-9)
    assert found["sight_VDOP"][:4] == pytest.approx(np.sqrt(inverse[:, 2, 2]), rel=1e-9)
    assert np.isnan(found["sight_HDOP"][4])
    assert np.isnan(found["sight_VDOP"][4])


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 7, endpoint=False))
def test_the_weak_axis_of_a_tunnel_is_its_own(angle: float) -> None:
    normal = np.array([-np.sin(angle), np.cos(angle)])
    product = 30.0 * np.outer(normal, normal)
    sums = {"normal_xx": product[:1, 0], "normal_xy": product[:1, 1], "normal_yy": product[1:, 1]}
    major, minor, weak = layout._walls(sums)
    assert major[0] == pytest.approx(30.0)
    assert minor[0] == pytest.approx(0.0, abs=1e-12)
    assert np.sin(weak[0] - angle) == pytest.approx(0.0, abs=1e-9)
    assert 0.0 <= weak[0] < np.pi
