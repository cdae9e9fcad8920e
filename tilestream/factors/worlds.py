"""Streets that are not as they were mapped: what some of the virtual scans are cast in
(definitions, section 4.3).

Cars are parked and driving, people walk, the vehicle moves during a turn, each beam has a bias, and
returns are lost. None of it is fitted to anything, least of all to the simulation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tilestream.kernels.boxes import stopped_by
from tilestream.preprocessing import GOLDEN, mixed
from tilestream.records import Float64, Int64

REACH = 45.0
"""How far ahead and behind there is anybody [m]."""
SLOT = 6.5
"""From one place to park to the next [m]."""
CAR, TRUCK = (4.6, 1.8, 1.5), (9.0, 2.5, 3.2)
"""Length, width and height [m]."""
TRUCKS = 0.15
"""Share of the cars that are as large as a truck."""
PERSON = (0.5, 0.5, 1.7)
"""Length, width and height [m]."""
LANE = 3.3
"""From lane to lane [m]."""
APART = 8.0
"""Room ahead of the vehicle and behind it in its own lane [m]."""
WIDE = 0.3
"""Share of the streets with a second lane in the direction of travel."""
PASSED_BY = 0.4
"""Share of the balls that no beam meets: foliage, fences and the like are half transparent."""
BIAS = 0.01
"""Standard deviation of the bias of a beam [m]."""
SLIP = 0.5
"""Standard deviation of the error of the speed by which a turn is straightened [m/s]."""


@dataclass(frozen=True, eq=False)
class World:
    """One such street around a place."""

    boxes: Float64
    """(k, 7) what stands and drives there (`kernels.boxes`); from the lidar, ahead and left."""
    bias: Float64
    """(rings,) of the beams [m]."""
    slip: float
    """By how much the end of a turn is ahead of where its beginning says [m]."""
    half_range: float
    """Range at which half of the returns are lost [share of the usable range]."""
    grazing: float
    """Cosine of incidence below which returns are lost."""


class Dice:
    """Random numbers from a place, a seed and the number of a draw alone."""

    def __init__(self, place_mm: Int64, seed: int, draw: int) -> None:
        state = np.array([seed], np.uint64)
        for number in (*place_mm.astype(np.int64).view(np.uint64), np.uint64(draw)):
            state = mixed(state + GOLDEN) ^ number
        self._state = mixed(state + GOLDEN)
        self._count = np.uint64(1)

    def uniform(self, n: int) -> Float64:
        """(n,) in (0, 1)."""
        count = self._count + np.arange(n, dtype=np.uint64)
        self._count += np.uint64(n)
        bits = mixed(self._state + count * GOLDEN) >> np.uint64(11)
        numbers: Float64 = (bits.astype(np.float64) + 0.5) * 2.0**-53
        return numbers

    def between(self, low: float, high: float, n: int = 1) -> Float64:
        """(n,) between two numbers."""
        return low + (high - low) * self.uniform(n)

    def normal(self, deviation: float, n: int) -> Float64:
        """(n,) of mean 0 (Box and Muller 1958)."""
        radius, turn = self.uniform(n), self.uniform(n)
        return deviation * np.sqrt(-2.0 * np.log(radius)) * np.cos(2.0 * np.pi * turn)


def world_at(dice: Dice, ground: float, rings: int, turn_s: float) -> World:
    """A street around a place.

    Args:
        dice: what it is drawn from.
        ground: height of the road above the lidar [m], negative.
        rings: beams of the sensors.
        turn_s: duration of a turn [s].
    """
    near, far = dice.between(2.4, 4.0)[0], dice.between(4.5, 8.5)[0]  # the two kerbs
    side = 1.0 if dice.uniform(1)[0] < 0.5 else -1.0  # on which side one drives
    cars = np.vstack(
        [
            _parked(dice, side * near),
            _parked(dice, -side * far),
            _driving(dice, 0.0, APART),
            _driving(dice, -side * LANE),
            _driving(dice, side * LANE, share=WIDE),
        ]
    )
    large = dice.uniform(len(cars)) < TRUCKS
    size = np.where(large[:, None], TRUCK, CAR)
    people = int(dice.between(0.0, 13.0)[0])
    beside = np.where(dice.uniform(people) < 0.5, side * near, -side * far)
    walking = np.column_stack(
        [dice.between(-REACH, REACH, people), beside * dice.between(1.1, 1.8, people)]
    )
    at = np.vstack([cars, walking])
    size = np.vstack([size, np.tile(PERSON, (people, 1))])
    skew = dice.normal(0.05, len(at))
    boxes = np.column_stack(
        [at, np.cos(skew), np.sin(skew), 0.5 * size[:, 0], 0.5 * size[:, 1], ground + size[:, 2]]
    )
    return World(
        boxes,
        dice.normal(BIAS, rings),
        float(dice.normal(SLIP, 1)[0] * turn_s),
        float(dice.between(0.5, 1.5)[0]),
        float(dice.between(0.05, 0.4)[0]),
    )


def _parked(dice: Dice, beside: float) -> Float64:
    """(k, 2) cars along a kerb, of which a part is free."""
    slots = np.arange(-REACH, REACH, SLOT) + dice.between(0.0, SLOT)[0]
    taken = dice.uniform(len(slots)) < 0.7 * dice.uniform(1)[0]
    across = beside + np.sign(beside) * dice.between(0.0, 0.4, len(slots))
    found: Float64 = np.column_stack([slots + dice.normal(0.3, len(slots)), across])[taken]
    return found


def _driving(dice: Dice, beside: float, gap: float = 0.0, share: float = 1.0) -> Float64:
    """(k, 2) cars in a lane that a share of the streets has, none nearer than a gap [m]."""
    count = int(dice.between(0.0, 5.0)[0])
    along = dice.between(-REACH, REACH, count)
    found = np.column_stack([along, beside + dice.normal(0.3, count)])
    there = share == 1.0 or bool(dice.uniform(1)[0] < share)
    apart: Float64 = found[(np.abs(along) >= gap + 0.5 * TRUCK[0]) & there]
    return apart


def passed_by(centre_mm: Int64, ball: NDArray[np.bool_], seed: int, draw: int) -> NDArray[np.bool_]:
    """(n,) which surfels the beams of a draw pass by: a share of those that are not flat, each
    decided by where it is.

    Args:
        centre_mm: (n, 3) centres [mm, map frame].
        ball: (n,) whether a surfel is not flat.
        seed: of the job.
        draw: number of the draw.
    """
    passed = np.zeros(len(ball), np.bool_)
    state = np.full(int(ball.sum()), seed, np.uint64)
    draws = np.full(len(state), draw, np.uint64)
    for numbers in (draws, *centre_mm[ball].T.astype(np.int64).view(np.uint64)):
        state = mixed(state + GOLDEN) ^ numbers
    share = (mixed(state + GOLDEN) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    passed[ball] = share < PASSED_BY
    return passed


def stopped(
    world: World, directions: Float64, ranges: Float64, cosine: Float64, reach: tuple[float, float]
) -> tuple[Float64, Float64]:
    """Ranges and cosines of beams, those that meet somebody first with the range to them [m].

    Args:
        world: the street.
        directions: (n, 3) of the beams, x ahead, y left.
        ranges: (n,) of the first return in the map [m], inf: none.
        cosine: (n,) of its incidence.
        reach: least and largest range [m].
    """
    met = stopped_by(world.boxes, directions, *reach)
    first = met < ranges
    return np.where(first, met, ranges), np.where(first, 1.0, cosine)


def kept(
    world: World, dice: Dice, ranges: Float64, cosine: Float64, far: float
) -> NDArray[np.bool_]:
    """(n,) which returns come back: with the range half of them are lost at `half_range`, all in
    the end, and with grazing incidence.
    """
    share = np.where(np.isfinite(ranges), ranges, np.inf) / (world.half_range * far)
    chance = np.sqrt(np.minimum(cosine / world.grazing, 1.0)) / (1.0 + share**4)
    came: NDArray[np.bool_] = dice.uniform(len(ranges)) < chance
    return came
