"""Episodes stepped by MuJoCo: a UR5e with a suction cup carries out pick-and-place actions.

Everything is bounded in simulated time and deterministic: after an action the arm is at home, nothing moves, and the
object poses are the whole state, so `reset(poses)` and the same action give the same poses bit for bit.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import os
from collections.abc import Sequence

import mujoco
import numpy as np

from lala_jax import types
from lala_jax.sim import robot, suction, trajectory
from lala_jax.sim import scene as scenes

REASONS = (
    "ok",
    "nothing under the tip",
    "tip at an edge",
    "out of reach",
    "out of the workspace",
    "lost on the way",
    "blocked",
    "unstable",
)
_DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
_FAR = 1e3  # metres or radians, where nothing gets by itself
APPROACH = 0.32  # metres above the pick and the place, where the arm can reach that far
MIN_APPROACH = 0.08  # metres: a point that cannot be approached from here is out of reach
_APPROACHES = tuple(np.arange(APPROACH, MIN_APPROACH - 1e-9, -0.02))
_TICK_STEPS = 2  # simulation steps for one set point of the arm
_CREEP_SPEED = 0.06  # metres a second: the last stretch before contact
_CREEP = 0.006  # metres: that stretch begins this far above where contact is expected
_OVERSHOOT = 0.012  # metres: the tip looks for contact down to this far below where it is expected
_LOWEST = -0.004  # metres: the tip never goes below this
_BLOCKED = 0.12  # radians of tracking error: the arm pushes against something
_STILL = (1e-3, 2e-2)  # metres a second, radians a second: slower is at rest
_MAX_SETTLE = 2.0  # seconds
_KNOTS = 0.05  # metres between the knots of a path


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one action did."""

    object: int  # index of the object that was picked, -1 where none was
    held_to_place: bool  # the object was still held when it was released at the place
    reason: str  # one of REASONS
    seconds: float  # simulated

    @property
    def ok(self) -> bool:
        return self.reason == "ok"


class World:
    """One episode: its own MuJoCo `model` and `data`, at the scene's start poses with the arm at home.

    `spec` is the workspace that actions must lie in. Not for two threads at once; use `Worlds` to step several side by side.
    """

    def __init__(self, task, scene: types.Scene, *, spec: types.MapSpec | None = None):
        self._spec = spec or types.MapSpec()
        self.model = scenes.build_model(task, scene)
        self.data = mujoco.MjData(self.model)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # a diverged step is an outcome, not a reset
        self.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)  # what rests is not simulated until something touches it
        self._index(len(np.asarray(scene.size)))
        self.reset(scene.start)

    def poses(self) -> np.ndarray:
        """Give the object poses `[N, 7]`, world, float64."""
        return self.data.qpos[self._free].copy()

    def reset(self, poses) -> None:
        """Put the objects at `poses` `[N, 7]` and the arm at home, all at rest."""
        poses = np.asarray(poses, np.float64)
        if poses.shape != self._free.shape or not np.isfinite(poses).all():
            raise ValueError(f"poses must be finite with shape {self._free.shape}, got shape {poses.shape}")
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._free] = poses
        self._arm.reset(self.data)
        self._tip_collides(True)
        mujoco.mj_forward(self.model, self.data)
        self._held = -1
        self._moving = np.arange(self.model.ngeom) == self._tip_geom
        self._q = np.array(robot.HOME, np.float64)
        self._tip = np.append(self.data.site_xpos[self._tip_site], robot.tip_yaw(robot.HOME))
        self._home = self._tip.copy()

    def step(self, action: types.PickPlace) -> Outcome:
        """Carry out `action` (unbatched) and wait until everything rests.

        What cannot be done is an `Outcome` whose reason says why. Raises ValueError where the action is not finite.
        """
        pick, place, yaw = _checked(action)
        before = self.poses()
        reason, index, held = self._pick_and_place(pick, place, yaw)
        if self.data.time == 0.0:
            return Outcome(index, held, reason, 0.0)
        if not self._broken():
            self._retreat()
        seconds = float(self.data.time)
        poses = self.poses()
        if self._broken() or any(self.data.warning[kind].number for kind in _DIVERGED):
            reason, held, poses = "unstable", False, before
        self.reset(poses)
        return Outcome(index, held, reason, seconds)

    def _pick_and_place(self, pick, place, yaw) -> tuple[str, int, bool]:
        """Give the reason, the index of the object held (or -1) and whether it was still held at the place."""
        if not (self._inside(pick) and self._inside(place)):
            return "out of the workspace", -1, False
        turn = self._tip[3] - np.arctan2(self._tip[1], self._tip[0]) + np.arctan2(pick[1], pick[0])
        above_pick = trajectory.above(pick, turn, heights=_APPROACHES)
        above_place = trajectory.above(place, turn + yaw, heights=_APPROACHES)
        if above_pick is None or above_place is None:
            return "out of reach", -1, False
        stopped = self._swing(trajectory.joints_from_home(above_pick), above_pick) or self._descend() or self._attach()
        index = self._held
        if stopped:
            return stopped, index, False
        stopped = self._move(above_pick) or self._move(above_place) or self._descend()
        if stopped:
            return stopped, index, False
        self._release()
        self._move(above_place)
        return "ok", index, True

    def _retreat(self) -> None:
        """Let go, rise, go home and wait until the objects rest."""
        self._release()
        up = self._tip.copy()
        up[2] = max(up[2], min(up[2] + APPROACH, self._home[2]))
        if robot.reachable(up[:3]):
            self._move(up)
        self._swing(np.stack([self._q, robot.HOME]), self._home)
        self._settle()

    def _inside(self, point) -> bool:
        low, high = np.array([self._spec.x, self._spec.y]).T
        return bool((point[:2] >= low).all() and (point[:2] <= high).all() and -0.02 <= point[2] <= self._spec.z[1] + 0.02)

    def _move(self, target: np.ndarray) -> str | None:
        """Bring the tip to `target` (x, y, z, yaw) as fast as the joints may; None, or why it stopped."""
        return self._swing(trajectory.joints_along(trajectory.tip_path(self._tip, target, spacing=_KNOTS), self._q), target)

    def _swing(self, knots: np.ndarray | None, target: np.ndarray) -> str | None:
        """Follow the joint positions `knots`, which bring the tip to `target`; None, or why it stopped."""
        if knots is None:
            return "out of reach"
        plan = trajectory.plan(knots, tick=self._tick, max_speed=robot.MAX_SPEED, max_acceleration=robot.MAX_ACCELERATION)
        self._tip = np.array(target, np.float64)
        return self._follow(plan)

    def _descend(self) -> str | None:
        """Lower the tip, or what hangs there, until it touches something; None, or why it stopped."""
        gap = suction.gap_below(self.model, self.data, self._moving, self._own)
        expected = max(self._tip[2] - gap, _LOWEST)
        near = np.append(self._tip[:2], (min(self._tip[2], expected + _CREEP), self._tip[3]))
        stopped = self._move(near)
        if stopped:
            return stopped
        far = near - (0.0, 0.0, _CREEP + _OVERSHOOT, 0.0)
        knots = trajectory.joints_along(trajectory.tip_path(near, far, spacing=_KNOTS), self._q)
        if knots is None:
            return "out of reach"
        duration = (_CREEP + _OVERSHOOT) / _CREEP_SPEED
        stopped = self._follow(trajectory.creep(knots, tick=self._tick, duration=duration), sense=True)
        if stopped == "touched":
            self._stop()
            return None
        return stopped or ("nothing under the tip" if self._held < 0 else None)

    def _follow(self, plan: trajectory.Trajectory, *, sense: bool = False) -> str | None:
        """Track `plan`; None at its end, or "touched", or why it stopped."""
        model, data = self.model, self.data
        for q, v, a in zip(plan.position, plan.velocity, plan.acceleration, strict=True):
            self._arm.command(data, q, v, a)
            mujoco.mj_step(model, data, _TICK_STEPS)
            if self._broken():
                return "unstable"
            if sense and suction.touches(data, self._moving, self._own):
                return "touched"
            if self._held >= 0 and suction.pull(data) > suction.HOLDING_FORCE:
                self._release()
                self._stop()
                return "lost on the way"
            off = data.qpos[self._arm.qpos] - q
            if off.dot(off) > _BLOCKED**2 and np.abs(off).max() > _BLOCKED:  # the first is faster, and seldom true
                self._stop()
                return "blocked"
        if len(plan):
            self._q = plan.position[-1]
            self._arm.command(data, self._q)
        return None

    def _stop(self) -> None:
        """Hold the arm where it is and take that as the tip's pose."""
        self._q = self.data.qpos[self._arm.qpos].copy()
        self._arm.command(self.data, self._q)
        mujoco.mj_step(self.model, self.data, 2 * _TICK_STEPS)
        turned = np.remainder(robot.tip_yaw(self._q) - self._tip[3] + np.pi, 2.0 * np.pi) - np.pi  # no whole turns
        self._tip = np.append(self.data.site_xpos[self._tip_site], self._tip[3] + turned)

    def _attach(self) -> str | None:
        """Suck on what the tip touches; None, or why that fails."""
        body = suction.body_below(self.model, self.data, self.data.site_xpos[self._tip_site])
        if body not in self._bodies:
            return "nothing under the tip"
        if not suction.seals(self.model, self.data, self.data.site_xpos[self._tip_site], body):
            return "tip at an edge"
        self._held = self._bodies.index(body)
        suction.attach(self.model, self.data, self._held)
        self._tip_collides(False)
        self._moving = self.model.geom_bodyid == body
        return None

    def _release(self) -> None:
        """Let go of what is held, if anything is; the tip passes through things until the next action."""
        if self._held >= 0:
            suction.detach(self.model, self.data, self._held)
            self._held = -1

    def _settle(self) -> None:
        """Step until the objects rest, at most `_MAX_SETTLE` seconds."""
        end = self.data.time + _MAX_SETTLE
        while self.data.time < end:
            mujoco.mj_step(self.model, self.data, _TICK_STEPS)
            speed = np.abs(self.data.qvel[self._free_speed])
            if self._broken() or speed[:, :3].max() < _STILL[0] and speed[:, 3:].max() < _STILL[1]:
                return

    def _broken(self) -> bool:
        """Say whether the simulation has diverged so far that something is nowhere."""
        return not np.abs(self.data.qpos).max() < _FAR  # True for NaN as well

    def _tip_collides(self, on: bool) -> None:
        bits = self._tip_bits if on else (0, 0)
        self.model.geom_contype[self._tip_geom], self.model.geom_conaffinity[self._tip_geom] = bits

    def _index(self, num_objects: int) -> None:
        """Look up once where everything lies in the model's arrays."""
        model = self.model
        self._arm = robot.Arm(model)
        self._bodies = [model.body(f"object{i}").id for i in range(num_objects)]
        free = model.body_jntadr[self._bodies]
        self._free = model.jnt_qposadr[free][:, None] + np.arange(7)
        self._free_speed = model.jnt_dofadr[free][:, None] + np.arange(6)
        self._tip_site, self._tip_geom = model.site(robot.TIP_SITE).id, model.geom(robot.TIP_GEOM).id
        self._tip_bits = (int(model.geom_contype[self._tip_geom]), int(model.geom_conaffinity[self._tip_geom]))
        root = model.body_rootid[model.geom_bodyid[self._tip_geom]]
        self._own = model.body_rootid[model.geom_bodyid] == root
        self._tick = _TICK_STEPS * model.opt.timestep


class Worlds:
    """Worlds stepped side by side: MuJoCo lets go of Python's lock while it steps, so `threads` run on several cores, 0 on all of them."""

    def __init__(self, worlds: Sequence[World], *, threads: int = 1):
        if threads < 0:
            raise ValueError(f"threads must be at least 0, got {threads}")
        self.worlds = tuple(worlds)
        self._threads = threads or cores()

    def step(self, actions: Sequence[types.PickPlace | None]) -> list[Outcome | None]:
        """Give each world its action; None where an action is None. Outcomes do not depend on the number of threads."""
        if len(actions) != len(self.worlds):
            raise ValueError(f"one action a world is needed: {len(self.worlds)} worlds, got {len(actions)} actions")
        with concurrent.futures.ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(_step, self.worlds, actions))


def cores() -> int:
    """Count the cores that this process may use, which a scheduler may have made fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _step(world: World, action: types.PickPlace | None) -> Outcome | None:
    return None if action is None else world.step(action)


def _checked(action: types.PickPlace) -> tuple[np.ndarray, np.ndarray, float]:
    """Give pick, place and yaw (wrapped to +-pi) as float64; raises ValueError naming the field that is wrong."""
    fields = {}
    for name, shape in (("pick", (3,)), ("place", (3,)), ("yaw", ())):
        value = np.asarray(getattr(action, name), np.float64)
        if value.shape != shape or not np.isfinite(value).all():
            raise ValueError(f"PickPlace.{name} must be finite with shape {shape}, got {value}")
        fields[name] = value
    yaw = float(np.arctan2(np.sin(fields["yaw"]), np.cos(fields["yaw"])))
    return fields["pick"], fields["place"], yaw
