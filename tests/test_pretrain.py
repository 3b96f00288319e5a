"""Pre-training: its scenes, a step that is resumed bit for bit and learns, and a file that the agents' backbone reads."""

import dataclasses
import functools
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import backbone, build, checkpoint, loop, options, pretrain, pretrain_step, writers
from lala_jax.models import cross_view
from lala_jax.perception import camera as cameras
from lala_jax.sim import oracle, tasks

TINY = (
    "task.num_objects=2", "camera.height=90", "camera.width=120", "camera.stage=stem", "map.cell=0.0125", "optim.schedule=constant",
    "pretrain.window=24", "pretrain.patch=4", "pretrain.mask=0.75", "pretrain.scenes=8", "pretrain.steps=2", "pretrain.batch_size=8",
    "pretrain.learning_rate=0.003", "train.log_every=1", "train.save_every=1",
)  # fmt: skip


def tiny(*more):
    return options.load("configs/tower.py:smoke", [*TINY, *more])


@functools.cache
def recipe():
    return build.pretrain_recipe(tiny())


@functools.cache
def states():
    return pretrain.draw_states(tiny())


@functools.cache
def fresh():
    """What a run starts from, on the host."""
    return jax.device_get(pretrain.start(tiny(), recipe(), states()))


def start():
    """A copy to be donated, placed as a run does."""
    return jax.device_put(fresh()[0], jax.devices()[0])


@functools.cache
def drawn():
    """What the model takes of 64 scenes; as they are, which compiles faster."""
    plain = dataclasses.replace(recipe(), batch_size=64, recolor=False, rigid=False)
    return jax.jit(functools.partial(pretrain_step.batch, plain))(jax.random.key(0), states())


def advance(run, steps):
    seen, frozen = [], fresh()[1]
    for _ in range(steps):
        run, metrics = pretrain.step()(recipe(), run, states(), frozen, jax.random.key(0))
        seen.append(metrics)
    return run, jax.device_get(seen)


def bits(tree):
    return [(leaf.dtype, leaf.shape, leaf.tobytes()) for leaf in map(np.asarray, jax.tree.leaves(tree))]


def test_scenes_are_put_up_object_by_object():
    """Of each train seed the start, then one object more at its goal, never before what it stands on, to the goal."""
    task, drawn = tasks.get("tower", num_objects=2), jax.device_get(states())
    assert drawn.poses.shape == (8 * 3, 2, 7)
    for index in range(8):
        scene = task.sample(2 * index)
        at_goal = (drawn.poses[3 * index : 3 * index + 3] == scene.goal).all(-1)
        np.testing.assert_array_equal(at_goal, [[False, False], [True, False], [True, True]])
        np.testing.assert_array_equal(drawn.poses[3 * index], scene.start)
        for state in range(3 * index, 3 * index + 3):
            np.testing.assert_array_equal(drawn.ready[state], oracle.ready(task, scene, drawn.poses[state]))
    several = jax.device_get(pretrain.draw_states(options.load("configs/pallet.py", ["pretrain.scenes=2"])))
    placed = (several.poses == several.goal).all(-1)
    np.testing.assert_array_equal(placed.sum(-1), [*range(9), *range(9)])
    assert (placed[:9].argmin(-1) != placed[9:].argmin(-1)).any(), "orders are drawn"


def test_windows_show_an_object_and_one_view_is_covered():
    views, which, hidden = drawn()
    assert views.rgb.shape == (64, 4, 24, 24, 3) and views.camera.height == 24
    assert (hidden.sum((1, 2)) == 27).all() and set(np.asarray(which)) == {0, 1, 2, 3}
    points = np.asarray(jax.vmap(jax.vmap(cameras.unproject))(views.depth, views.camera))
    shown = (points[..., 2] > 0.02).any((2, 3))
    assert shown[np.arange(64), which].mean() > 0.9, "what is covered is hardly ever bare table"


def test_save_and_restore_between_steps_change_no_bit(tmp_path):
    whole, last = advance(start(), 4)
    half, _ = advance(start(), 2)
    store = checkpoint.Checkpoints(tmp_path)
    store.save_latest(2, half, config=options.to_dict(tiny()), input_spec={})
    restored = loop.start_or_resume(start(), checkpoint.Checkpoints(tmp_path), tiny(), build.pretrain_settings)
    assert bits(restored) == bits(half) and int(restored.step) == 2
    resumed, again = advance(restored, 2)
    assert bits(resumed) == bits(whole) and bits(again[-1]) == bits(last[-1])
    assert bits(whole.params["encoder"]) != bits(start().params["encoder"]) != bits(whole.average["encoder"])


def test_it_learns_more_than_the_mean_patch():
    """A hundred tiny steps on scenes that are always new explain more than the best constant can."""
    views, which, hidden = drawn()
    targets = jax.vmap(lambda views, which: cross_view.targets(views.rgb[which], 4))(views, which)
    constant = np.asarray(targets)[np.asarray(hidden)].var(0).mean()
    metrics = advance(start(), 120)[1]
    losses = np.array([one["loss"] for one in metrics])
    assert losses[-40:].mean() < 0.93 * constant and losses[-40:].mean() < losses[:40].mean()
    assert np.mean([one["explained"] for one in metrics[-40:]]) > 0.05


def test_the_written_trunk_is_the_trained_encoder_layer_by_layer(tmp_path):
    """What CrossView's own encoder, moved away from ImageNet's, makes of a picture, and what the file's trunk does."""
    made = build.pretrain_recipe(tiny("camera.stage=conv2"))
    run, frozen = pretrain.start(tiny("camera.stage=conv2"), made, states())
    rng = np.random.default_rng(0)
    moved = jax.tree.map(lambda x: x * rng.uniform(0.9, 1.1, x.shape).astype(np.float32), run.params)
    backbone.save(tmp_path / "backbone.npz", *pretrain.trunk(made, moved, frozen))
    module, variables = backbone.load(tmp_path / "backbone.npz", stage="conv2")
    views, which, hidden = jax.tree.map(lambda leaf: leaf[0], drawn())
    uncovered = jnp.zeros_like(hidden)

    def inside(tree, prefix=""):
        found = checkpoint.named(tree["intermediates"])
        return {name.removeprefix(prefix): x for name, x in found.items() if name.startswith(prefix) and "conv" in name}

    capture = {"capture_intermediates": True}
    ours = jax.jit(functools.partial(made.model.apply, **capture))({"params": moved, "batch_stats": frozen}, views, which, uncovered)[1]
    theirs = jax.jit(functools.partial(module.apply, **capture))(variables, views.rgb)[1]
    ours, theirs = inside(ours, "encoder/"), inside(theirs)
    assert ours.keys() == theirs.keys() and len(ours) >= 11
    for name, x in theirs.items():
        np.testing.assert_allclose(ours[name], x, rtol=0, atol=1e-5 * float(jnp.abs(x).max()), err_msg=name)


def test_the_command_leaves_a_backbone_that_the_agents_take(call, tmp_path):
    arguments = [f"--workdir={tmp_path / 'run'}", "--config=configs/tower.py:smoke", *(f"--config.{text}" for text in TINY)]
    answer = call("lala_jax.pretrain", *arguments)
    file = tmp_path / "run" / "backbone.npz"
    assert answer.status == 0 and "24 states, step 0" in answer.out and f"are in {file}" in answer.out, answer
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2] and all(line["loss"] > 0 for line in lines)

    average = checkpoint.load(tmp_path / "run" / "checkpoints", which="latest")[0]["average"]["encoder"]
    _, written = backbone.load(file, stage="stem")
    _, before = backbone.load("resnet50_imagenet_v1", stage="stem")
    assert bits(written["params"]) == bits(average) != bits(before["params"])
    assert bits(written["batch_stats"]) == bits(before["batch_stats"]), "stored means and variances stay"
    assert build.surface(tiny(f"camera.backbone={file}")) == 64

    content = file.read_bytes()
    file.unlink()
    answer = call("lala_jax.pretrain", *arguments)
    assert answer.status == 0 and "24 states, step 2" in answer.out and file.read_bytes() == content
    answer = call("lala_jax.pretrain", *arguments, "--config.pretrain.mask=0.5")
    assert answer.status == 2 and re.search(r"another pretrain.mask \(0.75 there, 0.5 here\)", answer.err)


@pytest.mark.parametrize(
    "change, message",
    [
        ("pretrain.window=26", "pretrain.window must be a multiple of pretrain.patch=4 and at most 90, got 26"),
        ("pretrain.window=92", "at most 90, got 92"),
        ("pretrain.mask=0.01", "pretrain.mask must be a share up to 1 that covers a patch, got 0.01"),
        ("pretrain.mask=1.5", "pretrain.mask must be a share"),
        ("pretrain.batch_size=0", "pretrain.batch_size must be above 0"),
        ("camera.stage=conv9", "camera.stage must be one of"),
        ("pretrain.start=nowhere", "no backbone 'nowhere'"),
    ],
)
def test_a_wrong_field_is_refused(change, message):
    with pytest.raises((options.OptionsError, checkpoint.CheckpointError), match=message):
        build.pretrain_recipe(tiny(change))


def test_training_runs_do_not_ask_how_another_was_pretrained():
    """A training run's checkpoint of before there was such a group goes on, whatever the group says now."""
    config = options.to_dict(tiny())
    older = {name: group for name, group in config.items() if name != "pretrain"}
    changed = options.to_dict(tiny("pretrain.steps=9", "pretrain.start="))
    assert build.run_settings(older) == build.run_settings(config) == build.run_settings(changed)
    ours = build.pretrain_settings(writers.plain(config))
    assert options.differences(ours, build.pretrain_settings(writers.plain(changed))) and ours["camera.stage"] == "stem"
    assert not [name for name in ours if name.startswith(("model.", "train.", "data."))]


def test_random_weights_start_at_torchvisions_arithmetic():
    made = build.pretrain_recipe(tiny("pretrain.start="))
    run, frozen = pretrain.start(tiny("pretrain.start="), made, states())
    assert made.model.flavour.peak == 1.0
    stats = frozen["encoder"]["stem"]["norm"]
    assert not np.any(stats["mean"]) and np.all(stats["var"] == 1) and np.std(run.params["encoder"]["stem"]["conv"]["kernel"]) > 0.01
