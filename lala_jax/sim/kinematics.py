"""Closed-form kinematics of the UR5e, in numpy.

Standard Denavit-Hartenberg: `i-1_from_i = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`, nominal constants of the maker (Universal Robots,
"DH parameters for calculations of kinematics and dynamics"). The maker's frame points backwards at q = 0 (a2, a3 < 0); the robot is
bolted down turned by half a turn about world z, so that q = 0 stretches the arm along +x, and a shoulder pan of -pi along -x.

A flange pose with the wrist off its singularity has up to eight joint solutions: the shoulder left or right of the arm plane, the wrist
turned one way or the other, the elbow up or down. Their order is fixed, so an index names a branch: `4 * shoulder + 2 * wrist + elbow`.
"""

from __future__ import annotations

import math

import numpy as np

D1, D4, D5, D6 = 0.1625, 0.1333, 0.0997, 0.0996  # metres along a joint axis
A2, A3 = -0.425, -0.3922  # metres between parallel joint axes
DH = np.array(  # [6, 3] d, a, alpha of each joint
    [
        [D1, 0, math.pi / 2],
        [0, A2, 0],
        [0, A3, 0],
        [D4, 0, math.pi / 2],
        [D5, 0, -math.pi / 2],
        [D6, 0, 0],
    ]
)
LIMITS = np.array([2, 2, 1, 2, 2, 2]) * math.pi  # radians, both ways
WORLD_FROM_BASE = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about z
BRANCHES = 8
_SINGULAR = 1e-9  # |sin q5| below which wrist 1 and wrist 3 turn about parallel axes


def _joint_from_previous(q: float, d: float, a: float, alpha: float) -> np.ndarray:
    c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])


def forward(q: np.ndarray) -> np.ndarray:
    """Give `world_from_flange` `[4, 4]` of the joint angles `q` `[6]` in radians; the flange's z points out of it."""
    pose = WORLD_FROM_BASE
    for angle, (d, a, alpha) in zip(q, DH, strict=True):
        pose = pose @ _joint_from_previous(float(angle), d, a, alpha)
    return pose


def _shoulder(wrist: np.ndarray, side: int) -> float:
    """Solve the pan from frame 5's origin, which lies d4 beside the arm plane; NaN where it is closer to the axis than that."""
    reach = math.hypot(wrist[0], wrist[1])
    if reach < D4:
        return math.nan
    return math.atan2(wrist[1], wrist[0]) + math.pi / 2 + (1 - 2 * side) * math.acos(D4 / reach)


def _wrist(rotation: np.ndarray, side_axis: np.ndarray, side: int, free: float) -> tuple[float, float]:
    """Solve wrist 2 and wrist 3 from the arm plane's normal seen by the flange: `(c6 s5, -s6 s5, c5)`."""
    x, y, z = side_axis @ rotation
    q5 = (1 - 2 * side) * math.acos(min(1.0, max(-1.0, z)))
    s5 = math.sin(q5)
    return q5, free if abs(s5) < _SINGULAR else math.atan2(-y / s5, x / s5)


def _elbow(u: float, w: float, side: int) -> tuple[float, float]:
    """Solve shoulder lift and elbow of the two-link arm that ends at `(u, w)`: outwards, upwards; NaN out of reach."""
    cosine = (u * u + w * w - A2 * A2 - A3 * A3) / (2 * A2 * A3)
    if abs(cosine) > 1 + 1e-9:
        return math.nan, math.nan
    q3 = (1 - 2 * side) * math.acos(min(1.0, max(-1.0, cosine)))
    return math.atan2(w, u) - math.atan2(A3 * math.sin(q3), A2 + A3 * math.cos(q3)), q3


def _solve(base_from_flange: np.ndarray, index: int, free: float) -> np.ndarray:
    rotation, position = base_from_flange[:3, :3], base_from_flange[:3, 3]
    origin5 = position - D6 * rotation[:, 2]
    q1 = _shoulder(origin5, index // 4)
    if math.isnan(q1):
        return np.full(6, np.nan)
    outwards = np.array([math.cos(q1), math.sin(q1), 0.0])
    normal = np.array([math.sin(q1), -math.cos(q1), 0.0])
    q5, q6 = _wrist(rotation, normal, index // 2 % 2, free)
    axis5 = rotation @ (-math.sin(q6), -math.cos(q6), 0.0)
    origin3 = origin5 - D5 * axis5 - D4 * normal
    q2, q3 = _elbow(float(origin3 @ outwards), float(origin3[2]) - D1, index % 2)
    q4 = math.atan2(float(axis5 @ outwards), -float(axis5[2])) - q2 - q3
    q = np.array([q1, q2, q3, q4, q5, q6])
    return q if not math.isnan(q2) else np.full(6, np.nan)


def _unwrap(q: np.ndarray, q_near: np.ndarray) -> np.ndarray:
    """Turn each angle by whole turns to the one nearest to `q_near` within the limits."""
    turns = 2 * math.pi
    q = q + turns * np.round((q_near - q) / turns)
    slack = LIMITS + 1e-9  # a limit itself is allowed, however it was rounded
    q = q - turns * np.ceil(np.maximum(q - slack, 0) / turns)
    return q + turns * np.ceil(np.maximum(-slack - q, 0) / turns)


def _base_from_flange(world_from_flange: np.ndarray, q_near: np.ndarray) -> np.ndarray:
    pose = np.asarray(world_from_flange, float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"world_from_flange must be a finite [4, 4] matrix, got shape {pose.shape}:\n{pose}")
    if np.shape(q_near) != (6,) or not np.isfinite(q_near).all():
        raise ValueError(f"q_near must be six finite joint angles, got {q_near}")
    return WORLD_FROM_BASE.T @ pose


def inverse(world_from_flange: np.ndarray, q_near: np.ndarray) -> np.ndarray:
    """Give all eight branches `[8, 6]` in radians, each angle turned to be nearest to `q_near` `[6]` within the joint limits.

    Branches out of reach are rows of NaN. At the wrist singularity (sin q5 = 0) wrist 3 keeps the angle of `q_near`.
    Raises ValueError on anything not finite.
    """
    pose = _base_from_flange(world_from_flange, q_near)
    free = float(q_near[5])
    return np.stack([_unwrap(_solve(pose, index, free), np.asarray(q_near)) for index in range(BRANCHES)])


def nearest(world_from_flange: np.ndarray, q_near: np.ndarray, *, branch: int | None = None) -> np.ndarray | None:
    """Give the solution `[6]` with the smallest largest joint motion from `q_near`, None out of reach.

    `branch` (0..7) restricts the choice to one branch, so that a path never flips elbow, wrist or shoulder.
    """
    if branch is None:
        solutions = inverse(world_from_flange, q_near)
        travel = np.abs(solutions - q_near).max(-1)
        return None if np.isnan(travel).all() else solutions[np.nanargmin(travel)]
    if branch not in range(BRANCHES):
        raise ValueError(f"branch must be 0..{BRANCHES - 1}, got {branch}")
    q = _unwrap(_solve(_base_from_flange(world_from_flange, q_near), branch, float(q_near[5])), np.asarray(q_near))
    return None if np.isnan(q).any() else q


def branch_of(q: np.ndarray) -> int:
    """Name the branch (0..7) of the joint angles `q` `[6]`, by solving their own flange pose."""
    solutions = inverse(forward(q), q)
    distance = np.abs(np.exp(1j * solutions) - np.exp(1j * np.asarray(q))).max(-1)
    return int(np.nanargmin(distance))
