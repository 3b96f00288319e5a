"""Demonstrations on disk: bit-identical, and every kind of bad input refused by name."""

import hashlib
import json

import numpy as np
import pytest

from lala_jax import dataset, types

OPTIONS = {"num_objects": 3, "colors": ("red", "green")}


def make_demo(seed, *, objects=3, actions=2):
    """A demonstration of random numbers with awkward bits in it."""
    rng = np.random.default_rng(seed)
    normal = rng.normal
    poses = normal(size=(actions + 1, objects, 7))
    poses.flat[0], poses.flat[1] = -0.0, np.nextafter(0, 1)
    base, start, goal = normal(size=7), normal(size=(objects, 7)), normal(size=(objects, 7))
    for pose in (poses, base, start, goal):
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    return types.Demo(
        scene=types.Scene(
            size=rng.random((objects, 3)).astype(np.float32),
            color=rng.random((objects, 3)),
            base=base,
            start=start,
            goal=goal,
            symmetry=1 + rng.random(objects),
        ),
        poses=poses,
        action=types.PickPlace(pick=normal(size=(actions, 3)), place=normal(size=(actions, 3)), yaw=normal(size=actions)),
        placed=rng.random((actions + 1, objects)) > 0.5,
        ready=np.ones((actions + 1, objects), bool),
        seed=np.int64(2**40 + seed),
        score=np.float32(100),
    )


def bits(demo):
    """Every leaf's name, type, shape and bytes, gathered without the module under test."""
    groups = {"scene": demo.scene, "action": demo.action, "": demo}
    found = {}
    for group, holder in groups.items():
        for name, leaf in vars(holder).items():
            if not hasattr(leaf, "__dataclass_fields__"):
                found[group, name] = (np.asarray(leaf).dtype, np.shape(leaf), np.asarray(leaf).tobytes())
    return found


@pytest.fixture
def path(tmp_path):
    dataset.save(tmp_path / "train", [make_demo(0), make_demo(1, actions=5)], task="tower", task_options=OPTIONS)
    return tmp_path / "train"


def test_round_trip_is_bit_identical(path):
    dataset.append(path, [make_demo(2, actions=0)], task="tower", task_options=OPTIONS)
    demos, meta = dataset.load(path)
    expected = [make_demo(0), make_demo(1, actions=5), make_demo(2, actions=0)]
    assert [bits(demo) for demo in demos] == [bits(demo) for demo in expected]
    assert meta == {"version": 1, "task": "tower", "task_options": {"num_objects": 3, "colors": ["red", "green"]}, "demos": 3}


def test_the_same_demos_make_the_same_file(path, tmp_path):
    dataset.save(tmp_path / "again", [make_demo(0), make_demo(1, actions=5)], task="tower", task_options=OPTIONS)
    assert (path / "shard-000000.demo").read_bytes() == (tmp_path / "again" / "shard-000000.demo").read_bytes()


def test_loaded_as_asked(path):
    assert len(dataset.load(path, count=1, task="tower", task_options=OPTIONS)[0]) == 1
    with pytest.raises(dataset.DatasetError, match="task 'tower', not 'pallet'"):
        dataset.load(path, task="pallet")
    with pytest.raises(dataset.DatasetError, match="'num_objects': 3.*not.*'num_objects': 4"):
        dataset.load(path, task_options={**OPTIONS, "num_objects": 4})
    with pytest.raises(dataset.DatasetError, match="holds 2 demonstrations, 3 .*lala_jax.collect --config=configs/tower.py"):
        dataset.load(path, count=3)
    with pytest.raises(dataset.DatasetError, match="at least 1, got 0"):
        dataset.load(path, count=0)


def test_seeds_let_collection_resume(path, tmp_path):
    assert dataset.seeds(path).tolist() == [2**40, 2**40 + 1]
    assert dataset.seeds(tmp_path / "none").shape == (0,)


def test_missing(path, tmp_path):
    with pytest.raises(dataset.DatasetError, match="no dataset at .*to make one: python -m"):
        dataset.load(tmp_path / "none")
    dataset.append(path, [make_demo(2)], task="tower", task_options=OPTIONS)
    (path / "shard-000000.demo").unlink()
    with pytest.raises(dataset.DatasetError, match=r"shard-000000.demo is missing.*shard-000001"):
        dataset.load(path)
    (path / "meta.json").unlink()
    with pytest.raises(dataset.DatasetError, match="meta.json is missing"):
        dataset.append(path, [make_demo(3)], task="tower", task_options=OPTIONS)


@pytest.mark.parametrize("name", ["shard-000000.demo", "meta.json"])
def test_every_truncation_and_flip_is_refused(path, name):
    whole = (path / name).read_bytes()
    rng = np.random.default_rng(0)
    ends = {0, 1, 20, 52, len(whole) - 1, *rng.integers(0, len(whole), 20).tolist()}
    for end in ends - ({len(whole) - 1} if name == "meta.json" else set()):  # its last byte is a newline
        (path / name).write_bytes(whole[:end])
        with pytest.raises(dataset.DatasetError, match=name):
            dataset.load(path)
    positions = range(len(whole)) if name == "meta.json" else [*range(60), *rng.integers(0, len(whole), 200).tolist()]
    harmless = 0
    for position in positions:
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(rng.integers(8))
        (path / name).write_bytes(damaged)
        try:
            meta = dataset.load(path)[1]
        except dataset.DatasetError as error:
            assert name in str(error)
        else:  # white space in the JSON turned into other white space
            assert name == "meta.json" and meta == {
                "version": 1,
                "task": "tower",
                "task_options": {**OPTIONS, "colors": ["red", "green"]},
                "demos": 2,
            }
            harmless += 1
    assert harmless <= len(positions) // 10


def test_too_long_and_foreign_files(path):
    file = path / "shard-000000.demo"
    whole = file.read_bytes()
    file.write_bytes(whole + b"x")
    with pytest.raises(dataset.DatasetError, match="too long"):
        dataset.load(path)
    file.write_bytes(b"PK\x03\x04" * 100)
    with pytest.raises(dataset.DatasetError, match="not a shard"):
        dataset.load(path)


def test_another_version(path):
    file = path / "shard-000000.demo"
    whole = bytearray(file.read_bytes())
    whole[8] = 9
    whole[20:52] = hashlib.sha256(bytes(whole[:20] + whole[52:])).digest()
    file.write_bytes(whole)
    with pytest.raises(dataset.DatasetError, match="format version 9, this code reads version 1"):
        dataset.load(path)
    fields = {"version": 9, "task": "tower", "task_options": {}}
    digest = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
    (path / "meta.json").write_text(json.dumps({**fields, "sha256": digest}))
    with pytest.raises(dataset.DatasetError, match="format version 9, this code reads version 1"):
        dataset.load(path)


def test_nothing_is_overwritten_or_mixed(path):
    with pytest.raises(dataset.DatasetError, match="already"):
        dataset.save(path, [make_demo(0)], task="tower", task_options=OPTIONS)
    with pytest.raises(dataset.DatasetError, match="task 'tower', not 'pallet'"):
        dataset.append(path, [make_demo(0)], task="pallet", task_options=OPTIONS)
    with pytest.raises(dataset.DatasetError, match="no demonstrations"):
        dataset.append(path, [], task="tower", task_options=OPTIONS)
    assert len(dataset.load(path)[0]) == 2


def test_a_kill_while_writing_leaves_whole_shards(path, monkeypatch):
    def die(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset.writers.os, "fsync", die)
    with pytest.raises(KeyboardInterrupt):
        dataset.append(path, [make_demo(2)], task="tower", task_options=OPTIONS)
    monkeypatch.undo()
    (path / "shard-000001.demo.1.tmp").write_bytes(b"half")  # what SIGKILL leaves
    assert len(dataset.load(path)[0]) == 2
    dataset.append(path, [make_demo(2)], task="tower", task_options=OPTIONS)
    assert len(dataset.load(path)[0]) == 3


SCENE = make_demo(1).scene


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.zeros((2, 3, 7))}, r"demonstration 1: poses has shape \(2, 3, 7\), expected \(3, 3, 7\)"),
        ({"placed": np.zeros((3, 3))}, "placed is float64"),
        ({"score": np.float32(np.nan)}, "score has values that are not finite"),
        ({"seed": np.float32(0)}, "seed is float32"),
        ({"scene": SCENE.replace(color=255 * SCENE.color)}, r"demonstration 1: color must be RGB in 0..1, got .* to 1\d\d"),
        ({"scene": SCENE.replace(symmetry=0 * SCENE.symmetry)}, "symmetry must be radians above 0 and at most 2 pi, got 0 to 0"),
        ({"scene": SCENE.replace(size=-SCENE.size)}, "size must be metres above 0"),
        ({"scene": SCENE.replace(goal=2 * SCENE.goal)}, "goal must hold x, y, z and a unit quaternion .*, got one of length 2"),
        ({"poses": np.full((3, 3, 7), 0.1)}, "poses must hold x, y, z and a unit quaternion .*, got one of length 0.2"),
    ],
)
def test_broken_demos_are_not_written(tmp_path, change, message):
    with pytest.raises(dataset.DatasetError, match=message):
        dataset.save(tmp_path / "x", [make_demo(0), make_demo(1).replace(**change)], task="tower", task_options={})
    with pytest.raises(dataset.DatasetError, match="demonstration 1 has 4 objects, not 3: all of a dataset need as many"):
        dataset.save(tmp_path / "x", [make_demo(0), make_demo(1, objects=4)], task="tower", task_options={})
    with pytest.raises(dataset.DatasetError, match="demonstration 0 has 3 objects, not 6"):
        dataset.save(tmp_path / "x", [make_demo(0)], task="tower", task_options={"num_objects": 4, "distractors": 2})
    assert not (tmp_path / "x").exists()


def test_a_file_that_nobody_wrote_is_named(path):
    (path / "shard-000000 (1).demo").write_bytes((path / "shard-000000.demo").read_bytes())
    with pytest.raises(dataset.DatasetError, match=r"shard-000000 \(1\).demo is no shard that this code wrote"):
        dataset.load(path)


def test_stack_equals_a_loop():
    demos = [make_demo(0), make_demo(1, actions=4)]
    ready = np.array(demos[1].ready)
    ready[2] = False  # a state in which a blocker was moved away
    demos[1] = demos[1].replace(ready=ready)
    stacked = dataset.stack(demos)
    rows = [(demo, t) for demo in demos for t in range(len(demo.action.yaw)) if any(demo.ready[t])]
    assert [t for _, t in rows] == [0, 1, 0, 1, 3]
    shapes = {"size": (3, 3), "color": (3, 3), "base": (7,), "goal": (3, 7), "symmetry": (3,)}
    shapes |= {"poses": (3, 7), "placed": (3,), "ready": (3,)}
    assert {name: array.shape for name, array in stacked.items()} == {name: (5, *shape) for name, shape in shapes.items()}
    for index, (demo, t) in enumerate(rows):
        for name in ("poses", "placed", "ready"):
            np.testing.assert_array_equal(stacked[name][index], getattr(demo, name)[t].astype(stacked[name].dtype))
        for name in ("size", "color", "base", "goal", "symmetry"):
            np.testing.assert_array_equal(stacked[name][index], getattr(demo.scene, name).astype(np.float32))
    assert {str(array.dtype) for array in stacked.values()} == {"float32", "bool"}


def test_stack_refuses():
    with pytest.raises(dataset.DatasetError, match=r"same number of objects, got \[3, 4\]"):
        dataset.stack([make_demo(0), make_demo(1, objects=4)])
    with pytest.raises(dataset.DatasetError, match="no state with an action"):
        dataset.stack([make_demo(0, actions=0)])
    with pytest.raises(dataset.DatasetError, match="the 0 demonstrations"):
        dataset.stack([])
