"""Score agents in closed loop: policies over the batch renderer, the oracle, the blind agent; pictures of what happened."""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import build, checkpoint, observe, options, pictures, policy, rollout, types, writers

AGENTS = ("policy", "oracle", "blind")


@functools.partial(jax.jit, static_argnums=0)
def observe_batch(
    observer: observe.Observer, scenes: types.Scene, poses: jax.Array, key: jax.Array, rig: observe.Rig | None
) -> types.TopDownMap:
    """Render and fuse B scenes (leaves `[B, ...]`) with their objects at `poses` `[B, N, 7]`."""
    return observer.maps(scenes.size, scenes.color, scenes.base, poses, key=key, rig=rig)


@functools.partial(jax.jit, static_argnums=0)
def mount_batch(observer: observe.Observer, key: jax.Array, scenes: types.Scene) -> observe.Rig:
    """Put up the cameras of B episodes at their start."""
    return observer.mount(key, scenes.size, scenes.color, scenes.base, scenes.start)


@functools.partial(jax.jit, static_argnums=0)
def act_batch(agent: policy.Policy, params: Any, current: types.TopDownMap, goal: types.TopDownMap):
    """Act in B scenes, one after another: `(PickPlace, best pick and place logits)` with leaves `[B, ...]`."""
    return jax.lax.map(lambda maps: agent.act(params, *maps), (current, goal))


class PolicyAgent:
    """A policy as a `rollout.Agent` over up to `parallel` episodes: pads to one shape, so that there is one compilation."""

    def __init__(
        self,
        agent: policy.Policy,
        params: Any,
        observer: observe.Observer,
        scenes: Sequence[types.Scene],
        *,
        parallel: int,
        key,
        keep: int = 0,
    ):
        self._agent, self._params, self._observer, self._key = agent, params, observer, key
        self.keep = keep  # the heat maps of so many episodes, the first ones, are kept
        padded = [*scenes, *[scenes[0]] * (parallel - len(scenes))]
        self._scenes = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *padded)
        self._key, key = jax.random.split(self._key)
        self.rig = mount_batch(observer, key, self._scenes) if observer.moves else None
        self._goal = self._look(self._scenes.goal)
        self.seen: list[policy.Heatmaps] = []  # per step, leaves [keep, ...]

    def _look(self, poses):
        self._key, key = jax.random.split(self._key)
        return observe_batch(self._observer, self._scenes, poses, key, self.rig)

    def __call__(self, indices: Sequence[int], poses: np.ndarray) -> list[types.PickPlace]:
        every = np.array(self._scenes.start)
        every[list(indices)] = poses
        action, heat = act_batch(self._agent, self._params, self._look(jnp.asarray(every, jnp.float32)), self._goal)
        if self.keep:
            self.seen.append(jax.device_get(jax.tree.map(lambda leaf: leaf[: self.keep], heat)))
        action = jax.device_get(action)
        return [jax.tree.map(lambda leaf: leaf[i], action) for i in indices]  # noqa: B023


def evaluate(
    agent: policy.Policy, params: Any, observer: observe.Observer, *, seeds: Sequence[int], parallel: int, threads: int, strips: int = 0,
    seed: int = 0, progress=None,
) -> tuple[dict[str, Any], list[np.ndarray]]:  # fmt: skip
    """Run the closed loop on `seeds` with the real primitive: `(rollout.summary, pictures of the first episodes)`."""
    task, episodes, drawn = observer.task, [], []
    for start in range(0, len(seeds), parallel):
        chunk = list(seeds[start : start + parallel])
        scenes = [task.sample(s) for s in chunk]
        key = jax.random.fold_in(jax.random.key(seed), start)
        actor = PolicyAgent(agent, params, observer, scenes, parallel=parallel, key=key, keep=min(strips - len(drawn), len(chunk)))
        done = rollout.run(task, scenes, chunk, actor, threads=threads)
        for i in range(actor.keep):
            drawn.append(episode_picture(observer, done[i], [jax.tree.map(lambda leaf: leaf[i], heat) for heat in actor.seen]))  # noqa: B023
        episodes += done
        if progress is not None:
            progress(len(episodes), len(seeds))
    return rollout.summary(episodes), drawn


def baseline(name: str, observer_task, *, seeds: Sequence[int], threads: int) -> dict[str, Any]:
    """Score the oracle or the blind agent on `seeds`, through the real primitive."""
    options.check_choice("agent", name, AGENTS[1:])
    scenes = [observer_task.sample(seed) for seed in seeds]
    agent = rollout.oracle_agent(observer_task, scenes, seeds, blind=name == "blind")
    return rollout.summary(rollout.run(observer_task, scenes, seeds, agent, threads=threads))


def episode_picture(observer: observe.Observer, episode: rollout.Episode, heats: Sequence[policy.Heatmaps]) -> np.ndarray:
    """Draw an episode as a strip: views, maps, heat and action of every step, the end beside the goal.

    `heats` may be longer than the episode: other episodes of the batch went on.
    """
    scene = episode.scene

    def see(poses):
        return _look(observer, scene.size, scene.color, scene.base, jnp.asarray(poses, jnp.float32))

    goal_views, goal_map = see(scene.goal)
    panels = []
    for number, (heat, action) in enumerate(zip(heats, episode.actions, strict=False)):
        views, current = see(episode.poses[number])
        caption = f"step {number + 1}: {episode.causes[number]} ({episode.outcomes[number].reason})"
        panels.append(pictures.step_panel(views, goal_views, current, goal_map, heat.pick, heat.place, action, observer.spec, caption))
    final, _ = see(episode.poses[-1])
    return pictures.episode_strip(panels, final, goal_views, f"{observer.task.name}, seed {episode.seed}: score {episode.score:.0f} of 100")


@functools.partial(jax.jit, static_argnums=0)
def _look(observer, size, color, base, poses):
    maps = observer.maps(size[None], color[None], base[None], poses[None], key=jax.random.key(0))
    return observer.views(size, color, base, poses), jax.tree.map(lambda leaf: leaf[0], maps)


def check_checkpoint(path: str, config: Mapping[str, Any], agent: policy.Policy) -> Any:
    """Load the averaged parameters of a checkpoint, checked against the policy that the config describes."""
    template = jax.eval_shape(agent.init, jax.random.key(0))
    stored, _, spec = checkpoint.load(path)
    expected = build.input_spec(config)
    if writers.plain(spec) != writers.plain(expected):
        raise checkpoint.MismatchError(f"{path} expects the input {spec}, the config makes {expected}")
    _check_shapes(path, stored["average"], template)
    return jax.tree.map(jnp.asarray, stored["average"])


def _check_shapes(path, params, template) -> None:
    named = {jax.tree_util.keystr(k, simple=True, separator="/"): v.shape for k, v in jax.tree_util.tree_leaves_with_path(params)}
    wanted = {jax.tree_util.keystr(k, simple=True, separator="/"): v.shape for k, v in jax.tree_util.tree_leaves_with_path(template)}
    for name in sorted(wanted | named):
        if named.get(name) != wanted.get(name):
            there, here = named.get(name), wanted.get(name)
            raise checkpoint.MismatchError(f"{path} is of another model: {name} is {there} there, {here} in the config")


def write_scores(config, result, strips, out: pathlib.Path, *, agent: str, split: str, seeds: Sequence[int], source: str | None) -> None:
    """Write `scores-<agent>-<split>.json` and the pictures to `out`, and print the line that matters."""
    for number, picture in enumerate(strips):
        writers.write_image(out / f"episode-{split}-{number}.webp", picture)
    path = out / f"scores-{agent}-{split}.json"
    facts = {"agent": agent, "task": config.task.name, "split": split, "seeds": [seeds[0], seeds[-1]], "checkpoint": source}
    writers.write_json(path, {**facts, **result, "device": jax.devices()[0].device_kind, "config": options.to_dict(config)})
    low, high = result["interval95"]
    print(
        f"{config.task.name} {agent}, {split} split, {result['episodes']} episodes: score {result['score']:.1f} [{low:.1f}, {high:.1f}], "
        f"complete {result['complete_percent']:.0f}%; {path}",
        flush=True,
    )
