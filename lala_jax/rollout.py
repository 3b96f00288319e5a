"""Closed loop: scenes, an agent, the real primitive and the oracle's judgement. Many episodes step in parallel threads."""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim import mistakes, oracle, physics
from lala_jax.sim.tasks import base

# Given the indices of the running episodes and their object poses [E, N, 7], an action for each; None gives the episode up.
Agent = Callable[[Sequence[int], np.ndarray], Sequence[types.PickPlace | None]]

CAUSES = ("right", "missed pick", "lost on the way", "wrong object", "knocked over", "wrong yaw", "wrong height", "wrong place")
COUNTS = ("actions_by_cause", "first_failures", "lost_objects", "failures_by_reason")  # of a summary


@dataclasses.dataclass
class Episode:
    """What happened in one episode of T actions; states are settled, leaves have T + 1 entries."""

    seed: int
    scene: types.Scene
    poses: list[np.ndarray]  # [N, 7] each
    placed: list[np.ndarray]  # [N] bool each
    ready: list[np.ndarray]  # [N] bool each
    actions: list[types.PickPlace]  # T
    outcomes: list[physics.Outcome]  # T
    causes: list[str]  # T, each in CAUSES

    @property
    def score(self) -> float:
        """Give the share of wanted objects that are placed at the end, 0..100."""
        return oracle.share(self.scene, self.placed[-1])

    @property
    def complete(self) -> bool:
        return bool(self.placed[-1].all())

    def demo(self) -> types.Demo:
        """Give the record of this episode."""
        actions = [np.concatenate([a.pick, a.place, [a.yaw]]) for a in self.actions]
        flat = np.asarray(actions, np.float32).reshape(-1, 7)
        return types.Demo(
            scene=self.scene,
            poses=np.asarray(self.poses, np.float32),
            action=types.PickPlace(pick=flat[:, :3], place=flat[:, 3:6], yaw=flat[:, 6]),
            placed=np.asarray(self.placed),
            ready=np.asarray(self.ready),
            seed=np.int64(self.seed),
            score=np.float32(self.score),
        )


def run(
    task: base.Task, scenes: Sequence[types.Scene], seeds: Sequence[int], agent: Agent, *, threads: int, max_actions: int | None = None
) -> list[Episode]:
    """Let `agent` act in every scene until the oracle says complete, the budget is spent or the agent gives up."""
    worlds = [physics.World(task, scene) for scene in scenes]
    episodes = [Episode(int(seed), scene, [], [], [], [], [], []) for seed, scene in zip(seeds, scenes, strict=True)]
    for episode, world in zip(episodes, worlds, strict=True):
        _record(task, episode, world.poses())
    running = [i for i, episode in enumerate(episodes) if not episode.complete]
    stepper = physics.Worlds(worlds, threads=threads)
    for _ in range(task.budget if max_actions is None else max_actions):
        if not running:
            break
        chosen = agent(running, np.stack([episodes[i].poses[-1] for i in running]))
        actions: list[types.PickPlace | None] = [None] * len(worlds)
        for i, action in zip(running, chosen, strict=True):
            actions[i] = action
        outcomes = stepper.step(actions)
        running = [i for i in running if _advance(task, episodes[i], worlds[i], actions[i], outcomes[i])]
    return episodes


def _advance(task, episode, world, action, outcome) -> bool:
    """Record one action; say whether the episode goes on."""
    if action is None:
        return False
    ready = episode.ready[-1]
    _record(task, episode, world.poses())
    episode.actions.append(action)
    episode.outcomes.append(outcome)
    episode.causes.append(cause(episode.scene, ready, episode.placed[-2], episode.placed[-1], episode.poses[-1], outcome))
    return not episode.complete


def _record(task, episode, poses) -> None:
    episode.poses.append(poses)
    episode.placed.append(oracle.placed(task, episode.scene, poses))
    episode.ready.append(oracle.ready(task, episode.scene, poses))


def cause(scene: types.Scene, ready: np.ndarray, before: np.ndarray, after: np.ndarray, poses: np.ndarray, outcome: physics.Outcome) -> str:
    """Say how one action went, one of CAUSES; `ready`, `before` (placed), `after` are `[N]` bool."""
    index = outcome.object
    if index < 0:
        return "missed pick"
    if not outcome.held_to_place:
        return "lost on the way"
    if before[index]:
        return "wrong object"
    if (before & ~after).any():
        return "knocked over"
    if after[index]:
        return "right"
    if not ready[index]:
        return "wrong object"
    goal, pose = np.asarray(scene.goal[index], float), poses[index]
    if np.linalg.norm(goal[:2] - pose[:2]) >= oracle.PLANAR:
        return "wrong place"
    off = transforms.wrap_angle(transforms.yaw_from_quat(goal[3:]) - transforms.yaw_from_quat(pose[3:]), float(scene.symmetry[index]))
    return "wrong yaw" if abs(off) >= oracle.TURN else "wrong height"


def oracle_agent(task: base.Task, scenes: Sequence[types.Scene], seeds: Sequence[int], name: str = "oracle") -> Agent:
    """Make one of `oracle.AGENTS` an agent: the oracle, or one that knows the places but not, or not always, what belongs there."""
    choose = oracle.AGENTS[name]
    rngs = [np.random.default_rng([seed, 1]) for seed in seeds]

    def agent(indices, poses):
        return [choose(task, scenes[i], pose, rngs[i]) for i, pose in zip(indices, poses, strict=True)]

    return agent


def erring_agent(task: base.Task, scenes: Sequence[types.Scene], seeds: Sequence[int], *, share: float) -> Agent:
    """Make the oracle an agent that spoils a `share` of its actions."""
    rngs = [(np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])) for seed in seeds]

    def agent(indices, poses):
        return [mistakes.act(task, scenes[i], pose, *rngs[i], share=share) for i, pose in zip(indices, poses, strict=True)]

    return agent


def reach(values: Sequence[float] | np.ndarray, *, lowest: float = 0.0) -> tuple[float, float]:
    """Say how far the 95% interval of the mean of values from `lowest` to 100 reaches down and up: the normal one, NaNs for fewer than two.

    Where all `n` values are the same `c`, whose normal interval has no width, those means are left out under which that has a chance of
    less than 2.5%. With `lowest` 0, values of mean `m` are `c` with a probability of at most `m / c`, and `(100 - m) / (100 - c)` (Markov's
    inequality), so the ends are `c a` and `100 - (100 - c) a`, with `a = 0.025 ** (1 / n)`: Clopper and Pearson's (1934) for 0 or 100.
    """
    if len(values) < 2:
        return math.nan, math.nan
    if np.ptp(values) == 0.0:
        far = 1.0 - 0.025 ** (1 / len(values))
        return (values[0] - lowest) * far, (100.0 - values[0]) * far
    half = 1.96 * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return half, half


def interval(scores: Sequence[float] | np.ndarray) -> list[float]:
    """Give the 95% interval of the mean of scores between 0 and 100: what `reach` says, cut at both."""
    mean, (down, up) = float(np.mean(scores)), reach(scores)
    return [max(mean - down, 0.0), min(mean + up, 100.0)]


def with_interval(value: float, interval: Sequence[float | None], *, signed: bool = False) -> str:
    """Write `81.2 [75.0, 87.4]`; an interval of too few episodes is left out."""
    form = "{:+.1f}" if signed else "{:.1f}"
    low, high = (math.nan if end is None else end for end in interval)
    return form.format(value) + ("" if math.isnan(low) else f" [{form.format(low)}, {form.format(high)}]")


def counted(counts: Mapping[str, int]) -> str:
    """Write the counts that are not 0, the largest first: `3 wrong yaw, 1 missed pick`."""
    return ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda item: -item[1]) if n)


def head(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up the lines of episodes (a summary's `per_episode`): mean score with a 95% interval, complete rate, number of actions."""
    scores = np.array([line["score"] for line in lines])
    return {
        "episodes": len(lines),
        "score": float(scores.mean()),
        "interval95": interval(scores),
        "complete_percent": 100.0 * sum(line["complete"] for line in lines) / len(lines),
        "actions": sum(line["actions"] for line in lines),
    }


def first_failure(causes: Sequence[str]) -> str:
    """Give the first of an episode's `causes` that is not "right", "none" where there is none."""
    return next((cause for cause in causes if cause != "right"), "none")


def lost_objects(episode: Episode) -> list[str]:
    """Say of every wanted object that is not placed at the end the cause of the last action that picked, moved or unplaced it.

    "never moved" where there is none. What ends more than `oracle.PLANAR` from where it was has been moved.
    """
    found = []
    for index in np.flatnonzero(oracle.wanted(episode.scene) & ~episode.placed[-1]):
        last = "never moved"
        for number, (cause, outcome) in enumerate(zip(episode.causes, episode.outcomes, strict=True)):
            (before, was), (after, still) = ((episode.poses[t][index], episode.placed[t][index]) for t in (number, number + 1))
            moved = np.linalg.norm(np.subtract(after[:3], before[:3])) > oracle.PLANAR
            if outcome.object == index or moved or (was and not still):
                last = cause
        found.append(last)
    return found


def summary(episodes: Sequence[Episode]) -> dict:
    """Sum up scores: mean with a 95% interval, complete rate, what happened, and each episode's line.

    `first_failures` counts the incomplete episodes by what first went wrong (`first_failure`), `lost_objects` the objects that are not
    where they belong by what last happened to each (`lost_objects`), `failures_by_reason` the actions that could not be carried out.
    """
    found = counts(episodes)
    return {**head(found["per_episode"]), **found}


def counts(episodes: Sequence[Episode]) -> dict:
    """Give what of a summary needs no episode: the counts, COUNTS, and `per_episode`. For `merged`."""
    lines = [{"seed": e.seed, "score": e.score, "complete": e.complete, "actions": len(e.actions), "causes": e.causes} for e in episodes]
    causes = collections.Counter(cause for episode in episodes for cause in episode.causes)
    first = collections.Counter(first_failure(episode.causes) for episode in episodes if not episode.complete)
    lost = collections.Counter(cause for episode in episodes for cause in lost_objects(episode))
    reasons = collections.Counter(outcome.reason for episode in episodes for outcome in episode.outcomes if not outcome.ok)
    return {
        "actions_by_cause": {cause: causes[cause] for cause in CAUSES},
        "first_failures": {cause: first[cause] for cause in (*CAUSES[1:], "none")},
        "lost_objects": {cause: lost[cause] for cause in (*CAUSES, "never moved")},
        "failures_by_reason": dict(reasons),
        "per_episode": lines,
    }


def merged(summaries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Give the summary of all episodes from the `counts`, or summaries, of parts."""
    lines = [line for one in summaries for line in one["per_episode"]]
    counts = {name: collections.Counter() for name in COUNTS}
    for name, counter in counts.items():
        for one in summaries:
            counter.update(one[name])
    return {**head(lines), **{name: dict(counter) for name, counter in counts.items()}, "per_episode": lines}
