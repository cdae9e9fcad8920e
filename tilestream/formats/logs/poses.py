"""Poses over time: from quaternions to matrices, between recorded poses, along a tree of frames."""

from collections import deque
from collections.abc import Iterable
from enum import IntEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tilestream.formats.motion import FASTEST, jumped
from tilestream.kernels.fixed_order import moved, norms
from tilestream.records import Float64, Int64, Trajectory


class PoseStatus(IntEnum):
    """Why a time has a pose, or has none."""

    POSED = 0
    BEFORE = 1
    """Before the first pose."""
    AFTER = 2
    """After the last pose."""
    GAP = 3
    """Between two poses that are too far apart in time."""
    JUMP = 4
    """Between two poses farther apart than a vehicle drives in the time between them."""


def matrices(numbers: Float64) -> Float64:
    """(k, 4, 4) rigid motions from (k, 7) x, y, z [m], qx, qy, qz, qw (any length but 0)."""
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    if len(numbers):
        T[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
        T[:, :3, 3] = numbers[:, :3]
    return T


def inverse(T: Float64) -> Float64:
    """(..., 4, 4) inverse of rigid motions."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    inverted = np.zeros_like(T)
    inverted[..., :3, :3] = R_t
    inverted[..., :3, 3:] = -R_t @ T[..., :3, 3:]
    inverted[..., 3, 3] = 1.0
    return inverted


def transform(T: Float64, points: Float64) -> Float64:
    """(n, 3) points moved by one (4, 4) rigid motion; a point comes out the same in any block."""
    return moved(np.ascontiguousarray(T), np.ascontiguousarray(points, np.float64))


def trajectory(stamps_ns: Int64, numbers: Float64, frame: str) -> tuple[Trajectory, int]:
    """Poses put in order of time.

    Args:
        stamps_ns: (k,) times [ns], in any order.
        numbers: (k, 7) x, y, z [m], qx, qy, qz, qw.
        frame: name of the frame that moves.

    Returns:
        The trajectory, and how many poses it leaves out: those with numbers that are not finite,
        with a quaternion of length 0, or with the time of an earlier one.
    """
    usable = np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, 3:]).sum(axis=1) > 1e-6)
    stamps, first = np.unique(stamps_ns[usable], return_index=True)
    poses = Trajectory(stamps, matrices(numbers[usable][first]), frame)
    return poses, len(stamps_ns) - len(stamps)


def interpolate(
    poses: Trajectory, stamps_ns: Int64, max_gap_s: float, max_speed_mps: float = FASTEST
) -> tuple[Float64, NDArray[np.int8]]:
    """The pose at some times: position linear, rotation at constant rate between two poses (slerp),
    the recorded pose itself where the times agree, never beyond the first or last pose, and never
    over a jump (`motion.jumped`).

    Args:
        poses: k >= 0 poses.
        stamps_ns: (m,) times [ns].
        max_gap_s: longest time between two poses to interpolate over [s].
        max_speed_mps: fastest that the vehicle drives [m/s].

    Returns:
        (m, 4, 4) poses, NaN where there is none; (m,) `PoseStatus`.
    """
    T = np.full((len(stamps_ns), 4, 4), np.nan)
    status = np.full(len(stamps_ns), PoseStatus.BEFORE, dtype=np.int8)
    times = poses.stamps_ns
    if not len(times):
        return T, status
    after = np.searchsorted(times, stamps_ns)
    at_pose = times[np.minimum(after, len(times) - 1)] == stamps_ns
    T[at_pose] = poses.T_map_lidar[after[at_pose]]
    status[stamps_ns > times[-1]] = PoseStatus.AFTER
    between = (after > 0) & (after < len(times)) & ~at_pose
    b = after[between]
    span = times[b] - times[b - 1]
    share = (stamps_ns[between] - times[b - 1]) / span
    T[between] = _blend(poses.T_map_lidar[b - 1], poses.T_map_lidar[b], share)
    status[at_pose | between] = PoseStatus.POSED
    gaps = np.flatnonzero(between)[span > max_gap_s * 1e9]
    T[gaps], status[gaps] = np.nan, PoseStatus.GAP
    steps = norms(poses.T_map_lidar[b, :3, 3] - poses.T_map_lidar[b - 1, :3, 3])
    over = np.flatnonzero(between)[jumped(steps, span / 1e9, max_speed_mps)]
    T[over], status[over] = np.nan, PoseStatus.JUMP
    return T, status


def jumps(poses: Trajectory, max_speed_mps: float = FASTEST) -> NDArray[np.bool_]:
    """(k - 1,) whether no vehicle drives from each pose to the next in the time between them."""
    steps = norms(np.diff(poses.T_map_lidar[:, :3, 3], axis=0))
    return jumped(steps, np.diff(poses.stamps_ns) / 1e9, max_speed_mps)


def _blend(T_a: Float64, T_b: Float64, share: Float64) -> Float64:
    """Poses at a share (0 to 1) of the way from a to b."""
    T = np.tile(np.eye(4), (len(share), 1, 1))
    if len(share):
        R_a = Rotation.from_matrix(T_a[:, :3, :3])
        turn = (R_a.inv() * Rotation.from_matrix(T_b[:, :3, :3])).as_rotvec()
        T[:, :3, :3] = (R_a * Rotation.from_rotvec(share[:, None] * turn)).as_matrix()
        T[:, :3, 3] = T_a[:, :3, 3] + share[:, None] * (T_b[:, :3, 3] - T_a[:, :3, 3])
    return T


Edge = tuple[str, str]
"""Parent and child frame."""


def path_between(edges: Iterable[Edge], source: str, target: str) -> list[Edge] | None:
    """The shortest chain of edges from one frame to another, in either direction of each edge: an
    edge against its direction is given as (child, parent). None where they are not connected.
    """
    neighbours: dict[str, list[str]] = {}
    for parent, child in edges:
        neighbours.setdefault(parent, []).append(child)
        neighbours.setdefault(child, []).append(parent)
    came_from: dict[str, str] = {source: source}
    queue = deque([source])
    while queue and target not in came_from:
        frame = queue.popleft()
        for neighbour in sorted(neighbours.get(frame, [])):
            if neighbour not in came_from:
                came_from[neighbour] = frame
                queue.append(neighbour)
    if target not in came_from:
        return None
    chain = [target]
    while chain[-1] != source:
        chain.append(came_from[chain[-1]])
    chain.reverse()
    return list(pairwise(chain))
