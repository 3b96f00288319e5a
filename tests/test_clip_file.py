"""A user's files of CLIP: weights in both formats and in half precision, tokens as OpenAI's loop makes them, and no bad file."""

import json
import sys

import clip_reference
import clip_tokens
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import numpy as safetensors

from lala_jax import checkpoint, clip_file, wording
from lala_jax.models import clip
from lala_jax.sim.tasks import base

SIZES = {"blocks": (1, 1, 1, 1), "width": 2, "side": 32, "embed": 3, "vocab": 5, "positions": 4, "text_width": 4, "layers": 1}
NET = clip.Clip(clip.Visual((1, 1, 1, 1), 2), clip.Pool(1, 1, 3), clip.Text(5, 4, 4, 1, 1, 3))
BESIDES = {"visual.bn1.num_batches_tracked": np.array(7), "input_resolution": np.array(32), "vocab_size": np.array(5)}


@pytest.fixture(scope="module")
def state():
    return clip_reference.state(np.random.default_rng(0), **SIZES)


def write(path, tensors):
    if path.suffix == ".npz":
        np.savez(path, **tensors)
    else:
        safetensors.save_file(tensors, path)
    return path


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("suffix", [".safetensors", ".npz"])
def test_a_file_gives_its_values_in_float32(state, tmp_path, suffix, dtype):
    stored = {name: tensor.astype(dtype) for name, tensor in state.items()}
    net, found = clip_file.load(write(tmp_path / f"RN50{suffix}", stored | BESIDES))
    assert net == NET
    exact = {name: tensor.astype(np.float32) for name, tensor in stored.items()}
    jax.tree.map(np.testing.assert_array_equal, found, clip.from_published(exact, NET))
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype(np.float32)}
    kernel, query = found["params"]["visual"]["layer2_0"]["middle"]["conv"]["kernel"], found["params"]["pool"]["q_proj"]["kernel"]
    np.testing.assert_array_equal(kernel[0, 2, 1, 3], exact["visual.layer2.0.conv2.weight"][3, 1, 0, 2])
    np.testing.assert_array_equal(query[5, 7], exact["visual.attnpool.q_proj.weight"][7, 5])


def test_what_is_no_file_of_rn50(state, tmp_path):
    for name in ("RN50.pt", "ViT-B-32.bin"):
        with pytest.raises(checkpoint.CheckpointError, match=rf"{name} is no file of weights: known are \.npz, \.safetensors$"):
            clip_file.load(tmp_path / name)
    with pytest.raises(checkpoint.CheckpointError, match=r"RN50\.npz cannot be read"):
        clip_file.load(tmp_path / "RN50.npz")
    file = write(tmp_path / "RN50.safetensors", state | {"ln_final.bias": np.zeros(7, np.float32)})
    with pytest.raises(checkpoint.CheckpointError, match=r"safetensors cannot be used: CLIP needs .* ln_final\.bias .* got float32 \(7"):
        clip_file.load(file)
    vit = write(tmp_path / "ViT.npz", {"visual.conv1.weight": np.ones((4, 3, 8, 8), np.float32)})
    with pytest.raises(checkpoint.CheckpointError, match=r"ViT\.npz cannot be used: CLIP with a ResNet has .* visual\.layer1.* got none"):
        clip_file.load(vit)
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(checkpoint.CheckpointError, match=r"RN50\.safetensors is damaged or no \.safetensors file: SafetensorError"):
        clip_file.load(file)


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory):
    pytest.importorskip("tokenizers")
    return clip_tokens.write(tmp_path_factory.mktemp("tokenizer") / "tokenizer.json")


def test_tokens_are_openais(tokenizer):
    sentences = {"red": ["red"], "  A Red\n block's,  blue blocks!": ["a", "red", "block", "'s", ",", "blue", "blocks", "!"]}
    ids = clip_file.tokenize(tokenizer, list(sentences))
    assert ids.shape == (2, 77) and ids.dtype == np.int32
    for row, words in zip(ids, sentences.values(), strict=True):
        expected = clip_tokens.ids(words)
        assert row.tolist() == expected + [0] * (77 - len(expected))
        assert row.argmax() == len(expected) - 1
    assert len(clip_tokens.pieces("blocks")) == 1 and len(clip_tokens.pieces("blue")) > 1
    assert clip_file.tokenize(tokenizer, ["red", "red red"], None).shape == (2, 4)


@pytest.mark.parametrize("count", [1, 3, 6])
def test_a_filled_template_is_the_tokenized_sentence(tokenizer, count):
    """Colours of one to six pieces, each as if the sentence had been tokenized with it; the end is the highest id and last."""
    names, rng = list(base.COLORS), np.random.default_rng(count)
    assert {len(clip_tokens.pieces(name)) for name in names} >= {1, 3, 6}
    made = clip_file.template(tokenizer, "tower", count, clip.Text(len(clip_tokens.vocabulary())))
    colors = np.stack([rng.permutation(len(names))[:count] for _ in range(20)] + [np.full(count, names.index("yellow"))])
    ids, mask = jax.jit(made.fill)(jnp.asarray(colors))
    for row, shown, chosen in zip(ids, mask, colors, strict=True):
        words = wording.sentence("tower", [names[index] for index in chosen]).replace(",", " ,").split()
        expected = clip_tokens.ids(words)
        assert row.tolist() == expected + [0] * (len(row) - len(expected))
        assert shown.tolist() == [True] * len(expected) + [False] * (len(row) - len(expected))
    assert mask.all(-1).any()  # no longer than it must be


def test_a_tokenizer_of_other_weights(tokenizer):
    with pytest.raises(checkpoint.CheckpointError, match=r"tokenizer\.json has 70 tokens, the weights are of 49408"):
        clip_file.template(tokenizer, "tower", 2, clip.Text())
    with pytest.raises(checkpoint.CheckpointError, match=r"makes 32 tokens of a sentence, the weights take 20"):
        clip_file.template(tokenizer, "tower", 2, clip.Text(70, 20))


def test_too_long_and_none_at_all(tokenizer):
    assert clip_file.tokenize(tokenizer, ["red red"], 4).all()
    with pytest.raises(ValueError, match="'red red red' has 5 tokens, more than the 4 that are asked for"):
        clip_file.tokenize(tokenizer, ["red", "red red red"], 4)
    with pytest.raises(ValueError, match="no sentences to tokenize"):
        clip_file.tokenize(tokenizer, [])


def test_what_is_no_tokenizer_of_clip(tokenizer, tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match=r"missing\.json cannot be read as a tokenizer"):
        clip_file.tokenize(tmp_path / "missing.json", ["red"])
    made = json.loads(tokenizer.read_text())
    made["added_tokens"].append(made["added_tokens"][-1] | {"id": made["added_tokens"][-1]["id"] + 1, "content": "<mask>"})
    (tmp_path / "other.json").write_text(json.dumps(made))
    with pytest.raises(checkpoint.CheckpointError, match=r"other\.json is no tokenizer of CLIP: it does not end in <\|startoftext\|> and"):
        clip_file.tokenize(tmp_path / "other.json", ["red"])


def test_weights_need_no_tokenizers_and_tokens_say_so(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    with pytest.raises(ModuleNotFoundError, match="CLIP's tokens need the package tokenizers: pip install tokenizers"):
        clip_file.tokenize(tmp_path / "tokenizer.json", ["red"])
