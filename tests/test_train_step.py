"""The training step: a pure function of state, data and key, compiled once, resumed bit for bit, loud about what is not finite."""

import contextlib
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lala_jax import augment, build, checkpoint, loop, options, state, train, train_step, types
from lala_jax.sim import oracle, tasks

OVERRIDES = (
    "task.num_objects=2", "camera.height=45", "camera.width=60", "map.cell=0.0125", "map.slices=14",
    "model.rotations=8", "model.crop=8", "model.channels=2", "model.width=4", "model.stages=1", "model.trunk_width=8",
    "model.trunk_blocks=1", "model.tokens=64", "train.batch_size=2", "train.steps=2", "data.threads=1",
)  # fmt: skip


def tiny_config(*more):
    """The tower's smoke config at sizes that compile fast."""
    return options.load("configs/tower.py:smoke", [*OVERRIDES, *more])


@functools.cache
def recipe():
    return build.recipe(tiny_config())


def states():
    """The starts of a few tower scenes as training states."""
    task = tasks.get("tower", num_objects=2)
    scenes = [task.sample(seed) for seed in range(0, 8, 2)]
    fields = {f: np.stack([getattr(scene, f) for scene in scenes]) for f in ("size", "color", "base", "goal", "symmetry")}
    fields["poses"] = np.stack([scene.start for scene in scenes])
    for name, judge in (("placed", oracle.placed), ("ready", oracle.ready)):
        fields[name] = np.stack([judge(task, scene, scene.start) for scene in scenes])
    return jax.tree.map(jnp.asarray, types.State(**fields))


@functools.cache
def fresh():
    """What `train` starts from, on the host."""
    return jax.device_get(train.start_or_resume(tiny_config(), recipe(), checkpoint.Checkpoints("nothing-is-here")))


def start():
    """A copy to be donated, placed as `train` does."""
    return jax.device_put(fresh(), jax.devices()[0])


def advance(run, steps, *, data=None, seed=0):
    """Take steps as `train` does, giving the state and the last step's metrics; `run` is donated."""
    metrics = {}
    for _ in range(steps):
        run, metrics = train.step()(recipe(), run, states() if data is None else data, jax.random.key(seed), recipe().policy.frozen)
    return run, jax.device_get(metrics)


def bits(tree):
    return [(leaf.dtype, leaf.shape, leaf.tobytes()) for leaf in map(np.asarray, jax.tree.leaves(tree))]


def test_save_and_restore_between_steps_change_no_bit(tmp_path):
    """Law 6: 2 steps, save, restore in a new store, 2 steps = 4 steps; and all of them in one compilation."""
    train.step().clear_cache()
    whole, last = advance(start(), 4)
    assert train.step()._cache_size() == 1
    half, _ = advance(start(), 2)
    checkpoint.Checkpoints(tmp_path).save_latest(2, half, config=options.to_dict(tiny_config()), input_spec={})
    restored = train.start_or_resume(tiny_config(), recipe(), checkpoint.Checkpoints(tmp_path))
    assert bits(restored) == bits(half) and int(restored.step) == 2
    resumed, again = advance(restored, 2)
    assert bits(resumed) == bits(whole) and bits(again) == bits(last)
    assert int(whole.step) == 4 and bits(whole.params) != bits(start().params) != bits(whole.average)
    assert train.step()._cache_size() == 1


def test_randomness_is_the_key_and_the_step():
    same, other = advance(start(), 1)[1], advance(start(), 1, seed=1)[1]
    assert bits(advance(start(), 1)[1]) == bits(same) != bits(other)
    late = start()
    late = late.replace(step=late.step + 7)
    assert bits(advance(late, 1)[1]) != bits(same)


def test_a_scene_and_its_goal_are_seen_with_the_same_errors():
    """An example that is at its goal gives the same map twice, whatever the cameras' errors, another one's cameras err otherwise."""
    errors = augment.Sensors(shift=0.02, turn=2.0, missing=1.0)
    erring = dataclasses.replace(recipe(), sensors=errors)
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf[0], leaf[0]]), states())
    examples = twice.replace(poses=twice.goal)
    see = jax.jit(lambda key: train_step.observations(erring, key, examples))
    now, goal = jax.device_get(see(jax.random.key(0)))
    jax.tree.map(np.testing.assert_array_equal, now, goal)
    assert np.abs(now.height[0] - now.height[1]).max() > 1e-3
    assert np.abs(see(jax.random.key(1))[0].height - now.height).max() > 1e-3


def test_metrics_are_named_and_finite():
    metrics = advance(start(), 1)[1]
    terms = {"loss_pick", "loss_place", "loss_match", "loss_next", "loss_refine", "loss_fit"}
    shares = {"pick_right", "place_right", "place_near", "match_right", "fit_right"}
    assert set(metrics) == terms | shares | {"loss", "grad_norm", "refine_error"}
    assert np.isnan(metrics["fit_right"]) and metrics["loss_fit"] == 0, "a cube's quarter turn fits as well"
    loop.check_finite(1, metrics)
    np.testing.assert_allclose(sum(metrics[name] for name in terms), metrics["loss"], rtol=1e-5)
    assert metrics["grad_norm"] > 0


@pytest.mark.parametrize("field", ["goal", "poses", "symmetry"])
def test_a_nan_in_the_data_is_named(field):
    """Where a pose, a goal or a symmetry is no number, the step's losses say so; the message names the step and the metric."""
    data = states()
    _, metrics = advance(start(), 1, data=data.replace(**{field: jnp.full_like(getattr(data, field), jnp.nan)}))
    with pytest.raises(loop.NonFiniteError, match=r"step 3: (loss\w*|grad_norm) is nan.*learning_rate"):
        loop.check_finite(3, metrics)


def test_nan_parameters_are_named():
    run = start()
    run = run.replace(params=jax.tree.map(lambda leaf: leaf * jnp.nan, run.params))
    with pytest.raises(loop.NonFiniteError, match=r"step 12: (loss\w*|grad_norm) is nan"):
        loop.check_finite(12, advance(run, 1)[1])


def test_undefined_accuracies_do_not_stop_a_run():
    """An accuracy no example defines is NaN by design; the mean over steps leaves it out. A loss is never left out."""
    metrics = {"loss": 1.0, "grad_norm": 2.0, "pick_right": float("nan")}
    other = {"loss": 3.0, "grad_norm": 2.0, "pick_right": 0.5}
    assert loop.mean_metrics([metrics, other], last=9) == {"loss": 2.0, "grad_norm": 2.0, "pick_right": 0.5}
    assert np.isnan(loop.mean_metrics([metrics], last=9)["pick_right"])
    with pytest.raises(loop.NonFiniteError, match="step 8: loss is nan"):
        loop.mean_metrics([{**metrics, "loss": float("nan")}, other], last=9)


def test_a_run_with_other_settings_is_not_continued(tmp_path):
    """A work directory belongs to one run: the field that differs is named, one that does not matter may differ."""
    checkpoint.Checkpoints(tmp_path).save_latest(0, start(), config=options.to_dict(tiny_config()), input_spec={})
    store = checkpoint.Checkpoints(tmp_path)
    assert bits(train.start_or_resume(tiny_config("train.log_every=7", "eval.episodes=9"), recipe(), store)) == bits(start())
    with pytest.raises(checkpoint.CheckpointError, match=r"another optim.learning_rate \(0.001 there, 0.002 here\)"):
        train.start_or_resume(tiny_config("optim.learning_rate=0.002"), recipe(), store)


def test_a_run_begins_with_weights_that_are_there(tmp_path):
    """`train.start`: at step 0, with a fresh optimiser, a checkpoint's averaged parameters; once begun, a run goes on with its own."""
    trained = start()
    trained = trained.replace(average=jax.tree.map(lambda leaf: leaf + 1.0, trained.params), step=jnp.int32(7))
    config, spec = tiny_config(), build.input_spec(tiny_config())
    checkpoint.Checkpoints(tmp_path / "there").save_best(7, trained, 50.0, config=options.to_dict(config), input_spec=spec)
    config = tiny_config(f"train.start={tmp_path / 'there'}")
    weights, store = train.weights_to_start(config, recipe()), checkpoint.Checkpoints(tmp_path / "own")
    run = train.start_or_resume(config, recipe(), store, weights)
    assert int(run.step) == 0
    expected = state.create(jax.device_get(trained.average), recipe().optimizer)
    assert bits(run) == bits(expected)
    store.save_latest(3, start().replace(step=jnp.int32(3)), config=options.to_dict(config), input_spec={})
    assert bits(train.start_or_resume(config, recipe(), store, weights)) == bits(start().replace(step=jnp.int32(3)))
    with pytest.raises(checkpoint.CheckpointError, match="another train.start"):
        train.start_or_resume(tiny_config(), recipe(), store)
    assert train.weights_to_start(tiny_config(), recipe()) is None
    with pytest.raises(checkpoint.CheckpointError, match="nowhere"):
        train.weights_to_start(tiny_config("train.start=nowhere"), recipe())
    with pytest.raises(checkpoint.MismatchError, match="is of another model: "):
        other = tiny_config(f"train.start={tmp_path / 'there'}", "model.width=6")
        train.weights_to_start(other, build.recipe(other))


def test_the_average_follows_the_parameters():
    """Early on the decay is (1 + step) / (10 + step), so that the start is forgotten."""
    optimizer = optax.sgd(0.5)
    run, average, value = state.create({"w": jnp.array([1.0, -2.0])}, optimizer), np.array([1.0, -2.0]), np.array([1.0, -2.0])
    for number in range(4):
        run = state.update(run, {"w": jnp.array([1.0, 0.5])}, optimizer, average_decay=0.2)
        value = value - 0.5 * np.array([1.0, 0.5])
        decay = min(0.2, (1 + number) / (10 + number))
        average = decay * average + (1 - decay) * value
    assert int(run.step) == 4
    np.testing.assert_allclose(run.params["w"], value, rtol=1e-6)
    np.testing.assert_allclose(run.average["w"], average, rtol=1e-6)


def test_a_signal_in_the_last_step_ends_the_command(monkeypatch, tmp_path):
    """The state is saved, but what was to follow that step is not done: no score is given for a run that has not been validated."""
    monkeypatch.setattr(train, "load_states", lambda *_: states())
    monkeypatch.setattr(train, "_loop", lambda config, recipe, run, *_: run.replace(step=np.int32(config.train.steps)))
    monkeypatch.setattr(train, "final_scores", lambda *_: pytest.fail("scored"))
    monkeypatch.setattr(loop, "session", lambda out: contextlib.nullcontext((None, lambda: True)))
    with pytest.raises(SystemExit, match="stopped at step 2; the same command goes on from there"):
        train.train_and_evaluate(tiny_config(), str(tmp_path))
