"""Lay paths for the tip, and time them so that no joint exceeds its speed or its acceleration.

Paths are given as a few knots; a natural cubic spline runs through them. Along it the speed rises smoothly, holds and falls; one
uniform scaling of time makes the motion as fast as the bounds allow, with the best of a few lengths of the rise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from lala_jax.sim import robot

_RAMPS = (0.15, 0.25, 0.35, 0.5)  # shares of the time
_SAMPLES = np.linspace(0.0, 1.0, 65)  # where the bounds are checked along a path


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Set points at the control ticks of one motion: the first one tick after its start, the last at its end."""

    position: np.ndarray  # [T, J] radians
    velocity: np.ndarray  # [T, J] radians a second
    acceleration: np.ndarray  # [T, J] radians a second squared

    def __len__(self) -> int:
        return len(self.position)


def plan(knots: np.ndarray, *, tick: float, max_speed: np.ndarray, max_acceleration: np.ndarray) -> Trajectory:
    """Run through `knots` `[K >= 2, J]` (radians) from rest to rest with a set point every `tick` seconds.

    Bounds are `[J]`, in radians a second and radians a second squared. Knots that all agree give an empty trajectory.
    """
    knots = np.asarray(knots, np.float64)
    if knots.ndim != 2 or len(knots) < 2 or not np.isfinite(knots).all():
        raise ValueError(f"knots must be a finite array [K >= 2, J], got shape {knots.shape}")
    if np.ptp(knots, axis=0).max() < 1e-9:
        return Trajectory(knots[:0], knots[:0], knots[:0])
    bends = _second_derivatives(knots)
    duration, ramp = min((_duration(knots, bends, ramp, max_speed, max_acceleration), ramp) for ramp in _RAMPS)
    ticks = max(1, int(np.ceil(duration / tick)))
    s, ds, dds = (x[:, None] for x in _profile(np.arange(1, ticks + 1) / ticks, ramp))
    position, first, second = _evaluate(knots, bends, s[:, 0])
    seconds = ticks * tick
    return Trajectory(position, first * ds / seconds, (second * ds**2 + first * dds) / seconds**2)


def _duration(knots, bends, ramp, max_speed, max_acceleration) -> float:
    """Give the shortest duration in seconds that keeps the bounds: speeds fall with its first power, accelerations with its second."""
    s, ds, dds = (x[:, None] for x in _profile(_SAMPLES, ramp))
    _, first, second = _evaluate(knots, bends, s[:, 0])
    speed = np.abs(first * ds) / max_speed
    acceleration = np.abs(second * ds**2 + first * dds) / max_acceleration
    return float(max(speed.max(), np.sqrt(acceleration.max())))


def _profile(t, ramp):
    """Give the way done at `t` in 0..1 and two derivatives: the speed rises for the share `ramp` <= 0.5 of the time, holds, falls."""
    top = 1.0 / (1.0 - ramp)
    x = np.minimum(np.minimum(t, 1.0 - t) / ramp, 1.0)
    ramped = top * ramp * (x**3 - 0.5 * x**4)
    early = np.where(t <= ramp, ramped, top * (t - 0.5 * ramp))
    way = np.where(t >= 1.0 - ramp, 1.0 - ramped, early)
    rise = np.where(t <= 0.5, 1.0, -1.0)
    return way, top * x**2 * (3.0 - 2.0 * x), rise * top / ramp * 6.0 * x * (1.0 - x)


def _second_derivatives(knots):
    """Solve for the second derivatives `[K, J]` of the natural cubic spline through `knots` at 0, 1, .., K - 1."""
    inner = len(knots) - 2
    result = np.zeros_like(knots)
    if inner:
        matrix = 4.0 * np.eye(inner) + np.eye(inner, k=1) + np.eye(inner, k=-1)
        result[1:-1] = np.linalg.solve(matrix, 6.0 * (knots[2:] - 2.0 * knots[1:-1] + knots[:-2]))
    return result


def _evaluate(knots, bends, s):
    """Give the spline and its first two derivatives with respect to `s` in 0..1, each `[S, J]`."""
    spans = len(knots) - 1
    x = np.clip(s, 0.0, 1.0) * spans
    i = np.minimum(x.astype(int), spans - 1)
    b = (x - i)[:, None]
    a = 1.0 - b
    left, right, bend, bend_next = knots[i], knots[i + 1], bends[i], bends[i + 1]
    value = a * left + b * right + ((a**3 - a) * bend + (b**3 - b) * bend_next) / 6.0
    first = right - left + ((1.0 - 3.0 * a**2) * bend + (3.0 * b**2 - 1.0) * bend_next) / 6.0
    return value, first * spans, (a * bend + b * bend_next) * spans**2


def creep(knots: np.ndarray, *, tick: float, duration: float) -> Trajectory:
    """Run through `knots` `[K >= 2, J]` (radians) at an even pace in `duration` seconds: slow motions that a contact will stop."""
    knots = np.asarray(knots, np.float64)
    ticks = max(1, int(np.ceil(duration / tick)))
    position, first, _ = _evaluate(knots, _second_derivatives(knots), np.arange(1, ticks + 1) / ticks)
    return Trajectory(position, first / (ticks * tick), np.zeros_like(position))


def tip_path(start: np.ndarray, end: np.ndarray, *, spacing: float) -> np.ndarray:
    """Give tip poses `(x, y, z, yaw)` `[K >= 2, 4]` from `start` to `end`, in even steps of azimuth, radius, height and yaw.

    Straight up and down where only z differs; otherwise the tip swings around the base instead of passing through it.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    polar = [np.array([np.arctan2(p[1], p[0]), np.hypot(p[0], p[1]), p[2], p[3]]) for p in (start, end)]
    length = np.linalg.norm(end[:3] - start[:3])
    count = int(np.ceil(max(length / spacing, abs(polar[1][3] - polar[0][3]) / 0.8, 2.0)))
    azimuth, radius, z, yaw = np.linspace(polar[0], polar[1], count + 1).T
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z, yaw], axis=-1)


def joints_from_home(target: np.ndarray) -> np.ndarray | None:
    """Give the joints `[2, 6]` from home to the tip pose `target`; None out of reach.

    The pan is taken near 0, so that from there on the whole workspace lies within its limits.
    """
    q = robot.tip_joints(target[:3], target[3], np.append(0.0, robot.HOME[1:]))
    return None if q is None else np.stack([robot.HOME, q])


def joints_along(path: np.ndarray, q: np.ndarray) -> np.ndarray | None:
    """Give the joints `[K, 6]` along the tip poses `path` `[K, 4]`, from `q` on by continuity; None where the arm cannot follow."""
    knots = [q]
    for pose in path[1:]:
        q = robot.tip_joints(pose[:3], pose[3], q)
        if q is None:
            return None
        knots.append(q)
    return np.array(knots)


def above(point: np.ndarray, yaw: float, *, heights: Iterable[float]) -> np.ndarray | None:
    """Give the tip pose `(x, y, z, yaw)` above `point` `[3]` at the first of `heights` (metres) within reach; None where none is."""
    for height in heights:
        xyz = np.asarray(point) + (0.0, 0.0, height)
        if robot.reachable(xyz, yaw):
            return np.append(xyz, yaw)
    return None
