"""A user's files of CLIP: weights in both formats and in half precision, tokens as OpenAI's loop makes them, and no bad file."""

import json
import sys

import clip_reference
import jax
import numpy as np
import pytest
from safetensors import numpy as safetensors

from lala_jax import checkpoint, clip_file
from lala_jax.models import clip

SIZES = {"blocks": (1, 1, 1, 1), "width": 2, "side": 32, "embed": 3, "vocab": 5, "positions": 4, "text_width": 4, "layers": 1}
NET = clip.Clip(clip.Visual((1, 1, 1, 1), 2), clip.Pool(1, 2, 3), clip.Text(5, 4, 4, 1, 2, 3))
BESIDES = {"visual.bn1.num_batches_tracked": np.array(7), "input_resolution": np.array(32), "vocab_size": np.array(5)}
START, END = "<|startoftext|>", "<|endoftext|>"
MERGES = ["r e", "re d</w>", "b l", "o c", "bl oc", "k s</w>", "bloc ks</w>", "b lu", "l u", "' s</w>"]


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
    found = clip_file.load(write(tmp_path / f"RN50{suffix}", stored | BESIDES), NET)
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
    file = write(tmp_path / "RN50.safetensors", state)
    with pytest.raises(checkpoint.CheckpointError, match=r"RN50\.safetensors cannot be used: CLIP needs a tensor visual.*, got float32 \("):
        clip_file.load(file)
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(checkpoint.CheckpointError, match=r"RN50\.safetensors is damaged or no \.safetensors file: SafetensorError"):
        clip_file.load(file, NET)


@pytest.fixture(scope="module")
def vocabulary():
    """Ids as OpenAI orders them: bytes, bytes that end a word, merges, start and end."""
    letters = list("!',abcdefghijklmnopqrstuvwxyz")
    names = [*letters, *(f"{letter}</w>" for letter in letters), *(merge.replace(" ", "") for merge in MERGES), START, END]
    return {name: index for index, name in enumerate(names)}


@pytest.fixture(scope="module")
def tokenizer(vocabulary, tmp_path_factory):
    """A small `tokenizer.json`, put together as Hugging Face's `CLIPConverter` does; with what must not be heeded."""
    tokenizers = pytest.importorskip("tokenizers")
    normalizers, pre, post = tokenizers.normalizers, tokenizers.pre_tokenizers, tokenizers.processors
    merges = [tuple(merge.split()) for merge in MERGES]
    made = tokenizers.Tokenizer(tokenizers.models.BPE(vocabulary, merges, end_of_word_suffix="</w>", unk_token=END))
    made.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Replace(tokenizers.Regex(r"\s+"), " "), normalizers.Lowercase()])
    words = tokenizers.Regex(r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+")
    made.pre_tokenizer = pre.Sequence([pre.Split(words, "removed", invert=True), pre.ByteLevel(add_prefix_space=False)])
    made.add_special_tokens([START, END])
    made.post_processor = post.RobertaProcessing((END, vocabulary[END]), (START, vocabulary[START]), add_prefix_space=False)
    made.enable_truncation(4)
    made.enable_padding(length=9, pad_id=vocabulary[END])
    file = tmp_path_factory.mktemp("tokenizer") / "tokenizer.json"
    made.save(str(file))
    return file


def pieces(word):
    """Merge as OpenAI's `SimpleTokenizer.bpe`: the pair that comes first among the merges, wherever it stands, until there is none."""
    word = [*word[:-1], f"{word[-1]}</w>"]
    while True:
        ranks = [MERGES.index(pair) if (pair := " ".join(word[i : i + 2])) in MERGES else len(MERGES) for i in range(len(word) - 1)]
        if min(ranks, default=len(MERGES)) == len(MERGES):
            return word
        first, second = MERGES[min(ranks)].split()
        merged = []
        for piece in word:
            if piece == second and merged and merged[-1] == first:
                merged[-1] = first + second
            else:
                merged.append(piece)
        word = merged


def test_tokens_are_openais(tokenizer, vocabulary):
    sentences = {"red": ["red"], "  A Red\n block's,  blue blocks!": ["a", "red", "block", "'s", ",", "blue", "blocks", "!"]}
    ids = clip_file.tokenize(tokenizer, list(sentences))
    assert ids.shape == (2, 77) and ids.dtype == np.int32
    for row, words in zip(ids, sentences.values(), strict=True):
        expected = [START, *(piece for word in words for piece in pieces(word)), END]
        assert row.tolist() == [vocabulary[piece] for piece in expected] + [0] * (77 - len(expected))
        assert row.argmax() == len(expected) - 1
    assert len(pieces("blocks")) == 1 and len(pieces("blue")) > 1


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
