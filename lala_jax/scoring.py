"""Score agents in closed loop: policies over the batch renderer, the oracle and its blind kin; pictures of what happened."""

from __future__ import annotations

import concurrent.futures
import functools
import math
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import build, checkpoint, cluster, compiling, observe, options, pictures, policy, pretrained, rollout, types, writers
from lala_jax.perception import batches
from lala_jax.sim import oracle, physics
from lala_jax.sim.tasks import base

AGENTS = ("policy", *oracle.AGENTS)
FAILURES = 3  # failed episodes that are drawn
SIDE_BY_SIDE = 4  # episodes in which a policy acts at the same time, at most: each takes its memory


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


@functools.partial(compiling.jit, static_argnums=(0, 1))
def act_batch(
    agent: policy.Policy, most: int, params: Any, scenes: types.Scene, poses: jax.Array, current: types.TopDownMap, goal: types.TopDownMap,
    start: int, count: int,
):  # fmt: skip
    """Act in `count` of B scenes from `start` on, one after another: `(PickPlace, logits)`, leaves `[most, ...]`, zeros after them.

    Only a privileged policy is told the scene and the `poses` `[B, N, 7]`, and not what is placed or may go next.
    """
    seen: tuple[Any, ...] = (current, goal)
    if agent.privileged:
        untold = jnp.zeros(poses.shape[:2], bool)
        fields = {name: getattr(scenes, name) for name in ("size", "color", "base", "goal", "symmetry")}
        seen = (*seen, types.State(**fields, poses=poses, placed=untold, ready=untold))
    return batches.stretch(lambda one: agent.act(params, *one), seen, start, count, most=most)


@jax.jit
def _take(tree: Any, index: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


class PolicyAgent:
    """A policy as a `rollout.Agent` over up to `parallel` episodes: pads to one shape, so that there is one compilation.

    On a CPU up to SIDE_BY_SIDE of `threads` act at the same time, which changes no action: a network for one episode does not fill the
    cores. `threads` 0 are as many as there are cores.
    """

    def __init__(
        self, agent: policy.Policy, params: Any, observer: observe.Observer, scenes: Sequence[types.Scene], *, parallel: int, key,
        threads: int = 1,
    ):  # fmt: skip
        self.observer, self._agent, self._params, self._parallel = observer, agent, params | agent.frozen, parallel
        self._parts = min(threads or physics.cores(), parallel, SIDE_BY_SIDE) if jax.default_backend() == "cpu" else 1
        self._most = math.ceil(parallel / self._parts)
        padded = [*scenes, *[scenes[0]] * (parallel - len(scenes))]
        self._scenes = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *padded)
        self._key, key = jax.random.split(key)
        self.rig = mount_batch(observer, key, self._scenes) if observer.moves else None
        self.goal = self._look(self._scenes, self._scenes.goal, self.rig)  # leaves [parallel, ...]

    def _look(self, scenes, poses, rig):
        self._key, key = jax.random.split(self._key)
        return observe_batch(self.observer, scenes, poses, key, rig)

    def _think(self, indices, poses):
        """Look at up to `parallel` moments of these episodes and act in them.

        Gives maps `[parallel, ...]`, padding last, and of each part of the moments their number and `(action, logits)` `[most, ...]`.
        """
        index = np.resize(indices, self._parallel)
        poses = np.resize(poses, (self._parallel, *np.shape(poses)[1:]))
        scenes, rig, goal = _take((self._scenes, self.rig, self.goal), index)
        poses = jnp.asarray(poses, jnp.float32)
        current = self._look(scenes, poses, rig)

        def act(part):
            thought = act_batch(self._agent, self._most, self._params, scenes, poses, current, goal, part.start, len(part))
            return len(part), jax.block_until_ready(thought)

        with concurrent.futures.ThreadPoolExecutor(self._parts) as pool:
            return current, list(pool.map(act, spans(len(indices), 1, self._parts)))

    def __call__(self, indices: Sequence[int], poses: np.ndarray) -> list[types.PickPlace]:
        _, thoughts = self._think(indices, poses)
        return [action for count, (actions, _) in thoughts for action in _rows(actions, count)]

    def think_again(self, moments: Sequence[tuple[int, np.ndarray]]) -> Iterator[tuple[types.TopDownMap, policy.Heatmaps]]:
        """Give what is seen and thought at each of `moments`, an episode's index and the object poses `[N, 7]`; noise is drawn afresh."""
        for start in range(0, len(moments), self._parallel):
            batch = moments[start : start + self._parallel]
            current, thoughts = self._think([index for index, _ in batch], np.stack([poses for _, poses in batch]))
            heat = (one for count, (_, heats) in thoughts for one in _rows(heats, count))
            yield from zip(_rows(current, len(batch)), heat, strict=True)


def _rows(tree: Any, count: int) -> Iterator[Any]:
    """Fetch a pytree with leaves `[B, ...]` and give its first `count` items one by one."""
    fetched = jax.device_get(tree)
    for i in range(count):
        yield jax.tree.map(lambda leaf: leaf[i], fetched)  # noqa: B023


def evaluate(
    agent: policy.Policy, params: Any, observer: observe.Observer, *, seeds: Sequence[int], parallel: int, threads: int, strips: int = 0,
    seed: int = 0, progress=None,
) -> tuple[dict[str, Any], dict[tuple[str, int], np.ndarray]]:  # fmt: skip
    """Run the closed loop on `seeds` with the real primitive: `(rollout.summary, pictures)`.

    The first `strips` episodes are drawn, as `("episode", 0)` and so on, and, where any are, the first `FAILURES` that score below 100,
    as `("failure", 0)` and so on. Scenes without room for all objects are passed over; raises `NoFreePose` where no other is left.
    """
    episodes, drawn = _closed_loop(
        agent, params, observer, seeds=seeds, places=range(len(seeds)), parallel=parallel, threads=threads, strips=strips, seed=seed,
        progress=progress,
    )  # fmt: skip
    _check_some(episodes, seeds)
    return rollout.summary(episodes), drawn


def _closed_loop(
    agent: policy.Policy, params: Any, observer: observe.Observer, *, seeds: Sequence[int], places: range, parallel: int, threads: int,
    strips: int, seed: int, progress,
) -> tuple[list[rollout.Episode], dict[tuple[str, int], np.ndarray]]:  # fmt: skip
    """Run the seeds at `places`, one of `spans`, bit for bit as among all: episodes, and pictures, with failures numbered within."""
    task, parallel, episodes, drawn, failed = observer.task, min(parallel, len(seeds)), [], {}, 0
    for start in range(places.start, places.stop, parallel):
        chunk, scenes = task.roomy_lists(seeds[start : start + parallel])
        if not chunk:
            continue
        key = jax.random.fold_in(jax.random.key(seed), start)
        actor = PolicyAgent(agent, params, observer, scenes, parallel=parallel, key=key, threads=threads)
        done = rollout.run(task, scenes, chunk, actor, threads=threads)
        names = {("episode", start + i): i for i in range(min(strips - start, len(done)))}
        if strips:
            lost = [i for i, episode in enumerate(done) if episode.score < 100.0][: FAILURES - failed]
            names |= {("failure", failed + n): i for n, i in enumerate(lost)}
            failed += len(lost)
        strip = episode_pictures(actor, {i: done[i] for i in names.values()})
        drawn |= {name: strip[i] for name, i in names.items()}
        episodes += done
        if progress is not None:
            progress(min(start + parallel, places.stop) - places.start, len(places))
    return episodes, drawn


def _check_some(episodes: Sequence[Any], seeds: Sequence[int]) -> None:
    if not episodes:
        raise base.NoFreePose(f"none of the scenes of seeds {seeds[0]} to {seeds[-1]} has a free pose for every object")


def spans(count: int, parallel: int, most: int) -> list[range]:
    """Split the places of `count` episodes into at most `most` ranges of whole chunks, of which each is observed at once."""
    starts = range(0, count, min(parallel, count))
    groups = np.array_split(starts, min(most, len(starts)))
    return [range(int(own[0]), min(int(own[-1]) + starts.step, count)) for own in groups]


def baseline(name: str, observer_task, *, seeds: Sequence[int], threads: int) -> dict[str, Any]:
    """Score one of `oracle.AGENTS`, which need no training, on `seeds`, through the real primitive.

    Scenes are passed over as in `evaluate`.
    """
    options.check_choice("agent", name, oracle.AGENTS)
    episodes = _baseline_episodes(name, observer_task, seeds=seeds, threads=threads)
    _check_some(episodes, seeds)
    return rollout.summary(episodes)


def _baseline_episodes(name: str, task: base.Task, *, seeds: Sequence[int], threads: int) -> list[rollout.Episode]:
    usable, scenes = task.roomy_lists(seeds)
    return rollout.run(task, scenes, usable, rollout.oracle_agent(task, scenes, usable, name), threads=threads) if usable else []


def score_span(
    config, places: range, pictures_file: pathlib.Path, *, agent: str, path: str, weights: Mapping[str, Any] | None, seeds: Sequence[int]
) -> dict[str, Any]:
    """Count up how an agent does at some places of `seeds`, one of `spans`, on this process's `device`; leave the pictures in an `.npz`.

    There may be nothing to count: scenes without room are passed over. Raises CheckpointError where the checkpoint at `path` no longer
    holds the `weights`.
    """
    if agent != "policy":
        task, own = build.task(config), [seeds[place] for place in places]
        episodes = _baseline_episodes(agent, task, seeds=own, threads=config.data.threads)
        return {**rollout.counts(episodes), "device": jax.devices()[0].device_kind}
    built, observer = build.build_policy(config), build.observer(config)
    params = check_checkpoint(path, config, built)
    if (now := pretrained.fingerprint(path, params)) != weights:
        raise checkpoint.CheckpointError(f"{path} changed meanwhile: it holds {now}, the others scored {weights}")
    episodes, drawn = _closed_loop(
        built, params, observer, seeds=seeds, places=places, parallel=config.eval.parallel, threads=config.data.threads,
        strips=config.eval.strips, seed=config.seed, progress=lambda done, total: print(f"{done} of {total} episodes", flush=True),
    )  # fmt: skip
    with writers.atomic(pictures_file) as file:
        np.savez(file, **{f"{kind}-{number}": picture for (kind, number), picture in drawn.items()})
    return {**rollout.counts(episodes), "device": jax.devices()[0].device_kind}


def evaluate_in_parts(launch: cluster.Launcher, config, folder: pathlib.Path, **what) -> tuple[dict[str, Any], dict[tuple[str, int], Any]]:
    """Give what `evaluate`, or `baseline`, gives, scored by workers, and their `device`; raises as they do.

    The parts stay in `folder` until the caller is done with them. `what` says what is scored: `agent`, `path`, `weights` and `seeds` of
    `score_span`.
    """
    count, tasks = len(what["seeds"]), []
    for places in spans(count, config.eval.parallel, launch.workers):
        name = f"{places.start}-{places.stop - 1}"
        call = functools.partial(score_span, config, places, folder / f"{name}.npz", **what)
        key = {**what, "config": options.to_dict(config), "places": [places.start, places.stop]}
        tasks.append(cluster.Task(f"episodes {name}", call, folder / f"{name}.json", key))
    found = dict(cluster.run(launch, tasks, folder))
    drawn = _gathered([task.part.with_suffix(".npz") for task in tasks]) if what["agent"] == "policy" else {}
    scored = [found[task.name] for task in tasks]
    _check_some([line for one in scored for line in one["per_episode"]], what["seeds"])
    return {**rollout.merged(scored), "device": ", ".join(sorted({one["device"] for one in scored}))}, drawn


def _gathered(files: Sequence[pathlib.Path]) -> dict[tuple[str, int], np.ndarray]:
    """Read the pictures of parts in order, numbering failures anew."""
    drawn, failed = {}, 0
    for file in files:
        with np.load(file) as archive:
            for name in archive.files:
                kind, _, number = name.partition("-")
                if kind == "episode":
                    drawn[kind, int(number)] = archive[name]
                elif failed < FAILURES:
                    drawn[kind, failed] = archive[name]
                    failed += 1
    return drawn


def episode_pictures(actor: PolicyAgent, episodes: Mapping[int, rollout.Episode]) -> dict[int, np.ndarray]:
    """Draw episodes of `actor`, by their indices, as strips: views, maps, heat and action of every step, the end beside the goal.

    The policy thinks again from the recorded poses; the actions are the recorded ones.
    """
    moments = [(index, poses) for index, episode in episodes.items() for poses in episode.poses[: len(episode.actions)]]
    thoughts = actor.think_again(moments)
    return {index: _strip(actor, index, episode, thoughts) for index, episode in episodes.items()}


def _strip(actor, index, episode, thoughts) -> np.ndarray:
    observer, scene = actor.observer, episode.scene
    layer = None if actor.rig is None else _take(actor.rig.background, index)

    def see(poses):
        return _views(observer, scene.size, scene.color, scene.base, jnp.asarray(poses, jnp.float32), layer)

    goal_views, goal_map = see(scene.goal), _take(actor.goal, index)
    panels = []
    for number, (action, cause, outcome) in enumerate(zip(episode.actions, episode.causes, episode.outcomes, strict=True)):
        current, heat = next(thoughts)
        views, caption = see(episode.poses[number]), f"step {number + 1}: {cause} ({outcome.reason})"
        panels.append(pictures.step_panel(views, goal_views, current, goal_map, heat.pick, heat.place, action, observer.spec, caption))
    caption = f"{observer.task.name}, seed {episode.seed}: score {episode.score:.0f} of 100"
    return pictures.episode_strip(panels, see(episode.poses[-1]), goal_views, caption)


@functools.partial(jax.jit, static_argnums=0)
def _views(observer, size, color, base, poses, layer):
    views = observer.views(size, color, base, poses, layer)
    return views if observer.missing < 0 else views.replace(rgb=views.rgb.at[observer.missing].set(0.0))


def check_checkpoint(path: str, config: Mapping[str, Any], agent: policy.Policy) -> Any:
    """Load the averaged parameters of a checkpoint or of published weights, checked against the policy that the config describes.

    Says so where they were trained on another task.
    """
    template = jax.eval_shape(agent.init, jax.random.key(0))
    params, trained, spec = pretrained.load(path)
    expected = build.input_spec(config)
    if writers.plain(spec) != writers.plain(expected):
        raise checkpoint.MismatchError(f"{path} expects the input {spec}, the config makes {expected}")
    _check_shapes(path, params, template)
    if (there := trained["task"]["name"]) != (here := config["task"]["name"]):
        print(f"{path} was trained on {there}, this is {here}", flush=True)
    return jax.tree.map(jnp.asarray, params)


def _check_shapes(path, params, template) -> None:
    there, here = ({name: leaf.shape for name, leaf in checkpoint.named(tree).items()} for tree in (params, template))
    for name in sorted(there | here):
        if there.get(name) != here.get(name):
            shapes = f"{there.get(name)} there, {here.get(name)} in the config"
            raise checkpoint.MismatchError(f"{path} is of another model: {name} is {shapes}")


def write_scores(
    config, result, strips, out: pathlib.Path, *, agent: str, split: str, seeds: Sequence[int], source: str | None,
    weights: Mapping[str, Any] | None,
) -> None:  # fmt: skip
    """Write `scores-<agent>-<split>.json` and the pictures to `out`, and print the line that matters.

    `source` and `weights` say of which checkpoint: where it is, and its `pretrained.fingerprint`.
    """
    if agent == "policy":  # the only one that is drawn
        for left in (*out.glob(f"episode-{split}-*.webp"), *out.glob(f"failure-{split}-*.webp")):
            left.unlink()  # they do not belong to these scores
    for (kind, number), picture in strips.items():
        writers.write_image(out / f"{kind}-{split}-{number}.webp", picture)
    path = out / f"scores-{agent}-{split}.json"
    facts = {"agent": agent, "task": config.task.name, "split": split, "seeds": [seeds[0], seeds[-1]]}
    facts |= {"checkpoint": source, "weights": weights}
    writers.write_json(path, {**facts, "device": jax.devices()[0].device_kind, **result, "config": options.to_dict(config)})
    if without := len(seeds) - result["episodes"]:
        print(f"{without} of the {len(seeds)} scenes have no free pose for every object: passed over", flush=True)
    score = rollout.with_interval(result["score"], result["interval95"])
    wrong = rollout.counted({cause: count for cause, count in result["first_failures"].items() if cause != "none"})
    print(
        f"{config.task.name} {agent}, {split} split, {result['episodes']} episodes: score {score}, "
        f"complete {result['complete_percent']:.0f}%{f', first to go wrong: {wrong}' if wrong else ''}; {path}",
        flush=True,
    )
