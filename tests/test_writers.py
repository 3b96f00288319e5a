"""Metrics, JSON and images on disk."""

import json
import math
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from lala_jax import writers


def test_scalars_reach_both_files(tmp_path):
    with writers.Writer(tmp_path) as writer:
        writer.scalars(1, {"loss": jnp.float32(0.5), "count": np.int64(3)})
        writer.scalars(2, {"loss": 0.25, "half": jnp.bfloat16(1.5), "bad": math.nan})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [
        {"step": 1, "loss": 0.5, "count": 3},
        {"step": 2, "loss": 0.25, "half": 1.5, "bad": None},
    ]
    assert writers.read_metrics(tmp_path / "metrics.jsonl") == [json.loads(line) for line in lines]
    events = b"".join(path.read_bytes() for path in tmp_path.glob("events.out.tfevents.*"))
    assert b"loss" in events and b"half" in events and b"bad" not in events
    writer.close()  # twice is fine


def test_a_resumed_run_appends(tmp_path):
    for step in (1, 2):
        with writers.Writer(tmp_path, tensorboard=False) as writer:
            writer.scalars(step, {"loss": step})
        with open(writer.path, "ab") as file:
            file.write(b'{"step": 99, "lo')  # what a kill leaves
        assert [record["step"] for record in writers.read_metrics(writer.path)] == list(range(1, step + 1))


def test_a_line_is_on_disk_before_close(tmp_path):
    with writers.Writer(tmp_path, tensorboard=False) as writer:
        writer.scalars(7, {"loss": 1})
        assert writers.read_metrics(writer.path) == [{"step": 7, "loss": 1}]


def test_bad_scalars_and_records(tmp_path):
    with writers.Writer(tmp_path, tensorboard=False) as writer:
        with pytest.raises(ValueError, match=r"metric 'loss' must be one number, got shape \(2,\)"):
            writer.scalars(0, {"loss": np.zeros(2)})
        with pytest.raises(ValueError, match="metric 'name' must be one number"):
            writer.scalars(0, {"name": "text"})
        with pytest.raises(ValueError, match="'step' is taken"):
            writer.scalars(0, {"step": 1})
        writer.scalars(1, {"loss": 1.0})
    assert [record["step"] for record in writers.read_metrics(writer.path)] == [1]
    writer.path.write_bytes(b'{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(ValueError, match="line 2 is not JSON"):
        writers.read_metrics(writer.path)


def test_json(tmp_path):
    path = tmp_path / "deep" / "result.json"
    writers.write_json(path, {"a": np.arange(3), "b": (1.5, math.inf), "c": {"path": tmp_path}, "d": np.float32(0.5), 3: True})
    assert json.loads(path.read_text()) == {"a": [0, 1, 2], "b": [1.5, None], "c": {"path": str(tmp_path)}, "d": 0.5, "3": True}
    with pytest.raises(TypeError, match="cannot write set"):
        writers.write_json(path, {1, 2})
    assert json.loads(path.read_text())["d"] == 0.5
    assert [file.name for file in path.parent.iterdir()] == ["result.json"]


def test_a_directory_that_cannot_be_written_to(tmp_path, monkeypatch):
    assert writers.make_directory(tmp_path / "a" / "b").is_dir() and writers.make_directory(tmp_path / "a") == tmp_path / "a"
    monkeypatch.setattr(writers.os, "access", lambda *_: False)
    with pytest.raises(PermissionError, match="Permission denied"):
        writers.make_directory(tmp_path / "a")


def test_an_error_while_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), writers.atomic(path) as file:
        file.write(b"new")
        raise RuntimeError
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_processes_that_write_one_path_at_once_leave_a_whole_file(tmp_path):
    path, other = tmp_path / "x", f"from lala_jax import writers; writers.write_json({str(tmp_path / 'x')!r}, 'other')"
    with writers.atomic(path) as file:
        file.write(b"ours")
        subprocess.run([sys.executable, "-c", other], check=True)
        assert json.loads(path.read_text()) == "other"
    assert path.read_bytes() == b"ours" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1), (4, 6, 3), (4, 6, 4)])
def test_images(tmp_path, shape):
    image = np.random.default_rng(0).random(shape)
    writers.write_image(tmp_path / "x.png", image)
    with Image.open(tmp_path / "x.png") as picture:
        read = np.asarray(picture).reshape(shape)
    np.testing.assert_allclose(read / 255.0, image, atol=0.5 / 255 + 1e-9)
    writers.write_image(tmp_path / "y.png", read)
    assert (tmp_path / "x.png").read_bytes() == (tmp_path / "y.png").read_bytes()


def test_images_are_clipped(tmp_path):
    writers.write_image(tmp_path / "x.png", np.array([[-1.0, 2.0]]))
    with Image.open(tmp_path / "x.png") as picture:
        assert np.asarray(picture).tolist() == [[0, 255]]


@pytest.mark.parametrize(
    ("image", "name", "message"),
    [
        (np.zeros((2, 2, 2)), "x.png", r"got shape \(2, 2, 2\)"),
        (np.zeros((0, 2)), "x.png", r"got shape \(0, 2\)"),
        (np.full((2, 2), np.nan), "x.png", "not finite"),
        (np.zeros((2, 2), int), "x.png", "got int64"),
        (np.zeros((2, 2)), "x.pgn", "suffix '.pgn'"),
    ],
)
def test_bad_images(tmp_path, image, name, message):
    with pytest.raises(ValueError, match=message):
        writers.write_image(tmp_path / name, image)
    assert not list(tmp_path.iterdir())
