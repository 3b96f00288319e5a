"""Files of pretrained features: the packaged one whole and unchanged, a user's in every layout, and no bad one in silence."""

import hashlib
import io
import json
import pathlib
import re
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import resnet_reference

from lala_jax import backbone, checkpoint
from lala_jax.models import resnet

NAME = "resnet50_imagenet_v1"
CODES = {"float32": "F32", "float16": "F16", "bfloat16": "BF16", "int64": "I64"}


def npz(**tensors):
    buffer = io.BytesIO()
    np.savez(buffer, **tensors)
    return buffer.getvalue()


def header(tensors):
    end, entries = 0, {"__metadata__": {"format": "pt"}}
    for name, tensor in tensors.items():
        begin, end = end, end + tensor.nbytes
        entries[name] = {"dtype": CODES[tensor.dtype.name], "shape": list(tensor.shape), "data_offsets": [begin, end]}
    return entries


def safetensors(tensors, entries=None):
    """What safetensors.torch.save_file writes: an 8-byte length, JSON, the data."""
    text = json.dumps(header(tensors) if entries is None else entries).encode()
    return len(text).to_bytes(8, "little") + text + b"".join(tensor.tobytes() for tensor in tensors.values())


def written(path, content):
    path.write_bytes(content)
    return path


def packaged():
    with np.load(backbone.FOLDER / f"{NAME}.npz", allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def bits(variables):
    return {name: (leaf.dtype.name, leaf.shape, leaf.tobytes()) for name, leaf in checkpoint.named(variables).items()}


def layer(variables, path):
    """Kernel, scale, bias, mean and variance of a layer."""
    found = checkpoint.named(variables)
    names = "params/{}/conv/kernel", "params/{}/norm/scale", "params/{}/norm/bias", "batch_stats/{}/norm/mean", "batch_stats/{}/norm/var"
    return [found[name.format(path)] for name in names]


def same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == np.float32 and np.array_equal(one, other)


@pytest.fixture(scope="module")
def state():
    return resnet_reference.torchvision_state(np.random.default_rng(0), layers=1)


def stem(state):
    """The least that is a whole file, for `stage="stem"`."""
    return {name: state[name] for name in ("conv1.weight", "bn1.weight", "bn1.bias", "bn1.running_mean", "bn1.running_var")}


@pytest.mark.parametrize("stage, layers", [("stem", 1), ("conv2", 11), ("conv3", 24)])
def test_packaged_weights_are_the_files(stage, layers):
    module, variables = backbone.load(NAME, stage=stage, dtype=jnp.bfloat16)
    assert module == resnet.ResNet50(resnet.KERAS, stage, jnp.bfloat16)
    assert len(checkpoint.named(variables)) == 5 * layers
    tensors = packaged()

    def stored(conv, norm):
        leaves = (tensors[f"{norm}/{leaf}"] for leaf in ("gamma", "beta", "moving_mean", "moving_variance"))
        gamma, beta, mean, variance = leaves
        return [tensors[f"{conv}/kernel"].astype(np.float32), gamma, beta, mean - tensors[f"{conv}/bias"], variance]

    same(layer(variables, "stem"), stored("conv1", "bn_conv1"))
    if stage != "stem":
        same(layer(variables, "conv2_1/shortcut"), stored("res2a_branch1", "bn2a_branch1"))
        same(layer(variables, "conv2_3/middle"), stored("res2c_branch2b", "bn2c_branch2b"))
    if stage == "conv3":
        same(layer(variables, "conv3_4/expand"), stored("res3d_branch2c", "bn3d_branch2c"))
        assert sum(leaf.size for leaf in checkpoint.named(variables).values()) == 1_455_040


def test_the_package_says_what_it_ships():
    files = [path.name for path in backbone.FOLDER.iterdir()]
    assert sorted(files) == ["README.md", *(f"{name}.npz" for name in sorted(backbone.PACKAGED))]
    text = (backbone.FOLDER / "README.md").read_text()
    for name, sha256 in backbone.PACKAGED.items():
        assert hashlib.sha256((backbone.FOLDER / f"{name}.npz").read_bytes()).hexdigest() == sha256
        assert name in text and sha256 in text
    assert "MIT License" in text and "Copyright (c) 2016 Shaoqing Ren" in text


def test_a_changed_package_is_refused(monkeypatch, tmp_path):
    content = bytearray((backbone.FOLDER / f"{NAME}.npz").read_bytes())
    content[len(content) // 2] ^= 1
    written(tmp_path / f"{NAME}.npz", content)
    monkeypatch.setattr(backbone, "FOLDER", tmp_path)
    with pytest.raises(checkpoint.CheckpointError, match=r"resnet50_imagenet_v1\.npz is damaged: its SHA-256"):
        backbone.load(NAME)


@pytest.mark.parametrize("suffix", [".safetensors", ".npz"])
def test_a_torchvision_file_gives_torchvisions_features(state, tmp_path, suffix):
    content = safetensors(state) if suffix == ".safetensors" else npz(**state)
    module, variables = backbone.load(written(tmp_path / f"mine{suffix}", content))
    assert module == resnet.ResNet50(resnet.TORCHVISION, "conv2")
    trunk = [tensor for name, tensor in state.items() if not name.startswith("fc.") and tensor.dtype == np.float32]
    stored = [(x.transpose(2, 3, 1, 0) if x.ndim == 4 else x).tobytes() for x in trunk]
    assert sorted(leaf.tobytes() for leaf in checkpoint.named(variables).values()) == sorted(stored)
    same(layer(variables, "conv2_1/shortcut")[1:2], [state["layer1.0.downsample.1.weight"]])
    if suffix == ".npz":
        return
    rgb = np.random.default_rng(1).uniform(size=(24, 36, 3)).astype(np.float32)
    with jax.default_matmul_precision("highest"):
        features = jax.jit(module.apply)(variables, rgb)
    expected = resnet_reference.torchvision(state, rgb)["conv2_3"]
    np.testing.assert_allclose(features, expected, rtol=0, atol=1e-4 * expected.max())


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16])
def test_half_precision_is_read_exactly(state, tmp_path, dtype):
    small = {name: tensor.astype(dtype) for name, tensor in stem(state).items()}
    _, variables = backbone.load(written(tmp_path / "half.safetensors", safetensors(small)), stage="stem")
    kernel, *vectors = (tensor.astype(np.float32) for tensor in small.values())
    same(layer(variables, "stem"), [kernel.transpose(2, 3, 1, 0), *vectors])


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_kerass_names_of_today(tmp_path, suffix):
    def today(name):
        path, leaf = name.split("/")
        if "conv1" in path:
            return f"conv1_{'bn' if path == 'bn_conv1' else 'conv'}/{leaf}"
        kind, stage, block, branch = re.fullmatch(r"(res|bn)(\d)(\w)_branch(\w+)", path).groups()
        number = {"1": 0, "2a": 1, "2b": 2, "2c": 3}[branch]
        return f"conv{stage}_block{'abcd'.index(block) + 1}_{number}_{'conv' if kind == 'res' else 'bn'}/{leaf}"

    tensors = {today(name): tensor for name, tensor in packaged().items()} | {"predictions/bias": np.zeros(1000, np.float32)}
    content = safetensors(tensors) if suffix == ".safetensors" else npz(**tensors)
    module, variables = backbone.load(written(tmp_path / f"mine{suffix}", content), stage="conv3")
    assert module.flavour == resnet.KERAS and bits(variables) == bits(backbone.load(NAME, stage="conv3")[1])


def test_biases_move_means_and_come_all_or_not_at_all(tmp_path):
    tensors = packaged()
    tensors["conv1/bias"] = np.linspace(-2, 2, 64, dtype=np.float32)
    plain = {name: tensor for name, tensor in tensors.items() if "bias" not in name}

    def mean(tensors):
        return layer(backbone.load(written(tmp_path / "k.npz", npz(**tensors)), stage="stem")[1], "stem")[3]

    np.testing.assert_array_equal(mean(tensors), tensors["bn_conv1/moving_mean"] - tensors["conv1/bias"])
    np.testing.assert_array_equal(mean(plain), tensors["bn_conv1/moving_mean"])
    del tensors["conv1/bias"]
    with pytest.raises(checkpoint.MismatchError, match="lacks conv1/bias$"):
        mean(tensors)


@pytest.mark.parametrize("stage", ["stem", "conv2", "conv3"])
def test_what_is_written_reads_back_bit_for_bit(tmp_path, stage):
    """In Keras' names of today from the packaged weights, and in torchvision's from random ones."""
    module, variables = backbone.load(NAME, stage=stage)
    backbone.save(tmp_path / "keras.npz", module, variables)
    whole = resnet_reference.torchvision_state(np.random.default_rng(2))
    for file in (tmp_path / "keras.npz", written(tmp_path / "whole.npz", npz(**whole))):
        module, variables = backbone.load(file, stage=stage)
        backbone.save(tmp_path / "again.npz", module, variables)
        found = backbone.load(tmp_path / "again.npz", stage=stage)
        assert found[0] == module and bits(found[1]) == bits(variables)
    names = set(np.load(tmp_path / "again.npz").files)
    assert "conv1.weight" in names and names < whole.keys() and len(names) == 5 * len(resnet.layers(stage))
    assert bits(backbone.load(tmp_path / "keras.npz", stage=stage)[1]) == bits(backbone.load(NAME, stage=stage)[1])
    with pytest.raises(checkpoint.MismatchError, match="up to conv4: it lacks"):
        backbone.load(tmp_path / "again.npz", stage="conv4")


def test_refuses_to_write_what_no_layout_stands_for(tmp_path):
    module, variables = backbone.load(NAME, stage="stem")
    for file, net in (
        (tmp_path / "x.npz", module.clone(flavour=resnet.Flavour("middle", (0, 1, 2), 1.0, (0, 0, 0), (1, 1, 1), 1e-5))),
        (tmp_path / "x.safetensors", module),
    ):
        with pytest.raises(ValueError, match="backbone.save writes .npz files of resnet.KERAS or resnet.TORCHVISION, not .*x"):
            backbone.save(file, net, variables)
    assert not list(tmp_path.iterdir())


def without(state, *names):
    return {name: tensor for name, tensor in state.items() if name not in names}


MISMATCHES = {
    "lacks bn1.running_var$": lambda s: without(s, "bn1.running_var"),
    r"lacks layer1\.\S+, layer1\.\S+, layer1\.\S+ and 47 more$": stem,
    r"has unexpected layer3\.6\.conv1\.weight$": lambda s: s | {"layer3.6.conv1.weight": np.zeros((256, 1024, 1, 1), np.float32)},
    "has unexpected extra and lacks bn1.bias$": lambda s: without(s, "bn1.bias") | {"extra": np.zeros(3, np.float32)},
    r"tensor layer1.1.conv2.weight is float32 \[128, 128, 3, 3\], not float32 or .* \[64, 64, 3, 3\]$": lambda s: (
        s | {"layer1.1.conv2.weight": np.zeros((128, 128, 3, 3), np.float32)}
    ),
    r"tensor bn1.bias is float64 \[64\], not float32": lambda s: s | {"bn1.bias": np.zeros(64)},
    "has none of conv1.weight, conv1_conv/kernel, conv1/kernel, but a.conv1.weight$": lambda s: {"a.conv1.weight": s["conv1.weight"]},
    "has none of .* but nothing$": lambda s: {},
}


@pytest.mark.parametrize("message", MISMATCHES)
def test_another_model_is_named(state, tmp_path, message):
    file = written(tmp_path / "mine.npz", npz(**MISMATCHES[message](state)))
    with pytest.raises(checkpoint.MismatchError, match=r"mine\.npz is no ResNet-50.*" + message):
        backbone.load(file)


def test_packaged_weights_end_somewhere():
    with pytest.raises(checkpoint.MismatchError, match="up to conv4: it lacks res4a_branch2a/kernel, .* more"):
        backbone.load(NAME, stage="conv4")
    with pytest.raises(ValueError, match="stage must be one of stem, conv2, .*got 'layer1'"):
        backbone.load(NAME, stage="layer1")


@pytest.mark.parametrize("name, value", [("bn1.running_mean", np.nan), ("conv1.weight", np.inf), ("bn1.running_var", -1.0)])
def test_values_that_no_training_gives(state, tmp_path, name, value):
    tensors = stem(state)
    tensors[name] = np.full_like(tensors[name], value)
    with pytest.raises(checkpoint.CheckpointError, match=f"is damaged: tensor {name} has .*non-finite values"):
        backbone.load(written(tmp_path / "mine.safetensors", safetensors(tensors)), stage="stem")


def test_what_is_no_file_of_weights(state, tmp_path):
    for name in ("resnet50_imagenet_v2", tmp_path / "resnet50.pth", tmp_path):
        with pytest.raises(checkpoint.CheckpointError, match=r"no backbone .*packaged: resnet50_imagenet_v1; files: \.npz, \.safetensors"):
            backbone.load(name)
    (tmp_path / "folder.npz").mkdir()
    for name in ("missing.safetensors", "folder.npz"):
        with pytest.raises(checkpoint.CheckpointError, match=f"{name} cannot be read: "):
            backbone.load(tmp_path / name)
    npy = io.BytesIO()
    np.save(npy, state["bn1.bias"])
    whole = {".npz": npz(**stem(state)), ".safetensors": safetensors(stem(state))}
    for suffix, content in [
        *((suffix, content) for suffix in whole for content in (b"", b"PK", b"\x80\x04 pickle", npy.getvalue())),
        *((suffix, content[:-9]) for suffix, content in whole.items()),
        (".npz", npz(**{"conv1.weight": np.array([{}], object)})),
        (".npz", whole[".safetensors"]),
        (".safetensors", whole[".npz"]),
    ]:
        with pytest.raises(checkpoint.CheckpointError, match=rf"x\{suffix} is damaged or no \{suffix} file: "):
            backbone.load(written(tmp_path / f"x{suffix}", content), stage="stem")
    with zipfile.ZipFile(written(tmp_path / "x.npz", npz(**without(stem(state), "conv1.weight"))), "a") as archive:
        archive.writestr("conv1.weight", b"text")
    with pytest.raises(checkpoint.MismatchError, match=r"tensor conv1.weight is bytes32 \[\], not float32"):
        backbone.load(tmp_path / "x.npz", stage="stem")


@pytest.mark.parametrize(
    "message, change",
    [
        ("tensor bn1.bias is F8_E4M3, which is not one of F64", {"dtype": "F8_E4M3", "shape": [256]}),
        ("SafetensorError", {"shape": [63]}),
        ("SafetensorError", {"dtype": "F16"}),
        ("SafetensorError", {"shape": [-1]}),
        ("SafetensorError", {"data_offsets": [0, 256]}),
        ("SafetensorError", {"data_offsets": [10**9, 10**9 + 256]}),
        ("SafetensorError", {"data_offsets": "0"}),
        ("SafetensorError", {"shape": ["64"]}),
        ("SafetensorError", {"shape": None}),
        ("SafetensorError", None),
    ],
)
def test_a_header_that_lies(state, tmp_path, message, change):
    tensors = stem(state)
    entries = header(tensors)
    entries["bn1.bias"] = {} if change is None else entries["bn1.bias"] | change
    file = written(tmp_path / "x.safetensors", safetensors(tensors, entries))
    with pytest.raises(checkpoint.CheckpointError, match=f"is damaged or no .safetensors file: .*({message})"):
        backbone.load(file, stage="stem")
    whole = safetensors(tensors)
    for content in (whole + b"123", (10**15).to_bytes(8, "little") + whole[8:], b"\x02" + bytes(7) + b"[]"):
        with pytest.raises(checkpoint.CheckpointError, match="SafetensorError"):
            backbone.load(written(file, content), stage="stem")


def test_a_flipped_byte_never_escapes(state, tmp_path):
    """An archive's checksums catch what matters; safetensors has none, but nothing worse than other numbers comes out."""
    rng, refused = np.random.default_rng(0), {".npz": 0, ".safetensors": 0}
    whole = {".npz": npz(**stem(state)), ".safetensors": safetensors(stem(state))}
    for suffix, content in whole.items():
        expected = bits(backbone.load(written(tmp_path / f"x{suffix}", content), stage="stem")[1])
        ends = [*range(300), *range(len(content) - 600, len(content)), *rng.integers(len(content), size=100)]
        for place in rng.choice(ends, size=150, replace=False):
            damaged = bytearray(content)
            damaged[place] ^= 1 << rng.integers(8)
            try:
                found = bits(backbone.load(written(pathlib.Path(tmp_path / f"x{suffix}"), damaged), stage="stem")[1])
                assert found.keys() == expected.keys() and (suffix != ".npz" or found == expected)
            except checkpoint.CheckpointError:
                refused[suffix] += 1
    assert min(refused.values()) > 30
