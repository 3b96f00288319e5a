"""The command line and configs: what is meant is done, whatever else is refused in one screen."""

import json
import pathlib
import subprocess
import sys
import textwrap

import ml_collections
import pytest
from ml_collections import config_dict

from lala_jax import options

CONFIG = """
import ml_collections

def get_config(arg=""):
    if arg not in ("", "smoke"):
        raise ValueError(f"argument must be '' or 'smoke', got {arg!r}")
    config = ml_collections.ConfigDict()
    config.seed = 0
    config.train = ml_collections.ConfigDict({"steps": 10 if arg else 20000, "rate": 1e-3, "decay": True, "name": "adam"})
    config.map = ml_collections.ConfigDict({"size": (480, 640), "x": (0.25, 0.75), "colors": ("red", "blue")})
    config.map.nested = ml_collections.ConfigDict({"steps": 3})
    return config.lock()
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "pallet.py").write_text(CONFIG)
    return "configs/pallet.py"


def refused(*arguments, **keywords):
    with pytest.raises(options.OptionsError) as caught:
        options.load(*arguments, **keywords)
    return str(caught.value)


def test_load_with_argument_and_overrides(file):
    config = options.load(f"{file}:smoke", ["seed=7", "map.size=(2, 3)", "map.x=0,1"])
    assert config.train.steps == 10 and config.seed == 7 and config.is_locked
    assert config.map.size == (2, 3) and config.map.x == (0.0, 1.0) and isinstance(config.map.x[0], float)
    assert options.load(file).train.steps == 20000
    assert options.load(str(pathlib.Path(file).absolute())).train.steps == 20000


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("train.steps=1_000", 1000),
        ("train.rate=1", 1.0),
        ("train.rate=3e-4", 3e-4),
        ("train.decay=false", False),
        ("train.decay=True", True),
        ("train.name=a=b,c", "a=b,c"),
        ("map.colors=green,white", ("green", "white")),
        ("map.colors=('green', 'white')", ("green", "white")),
        ("map.nested.steps=-4", -4),
    ],
)
def test_values_keep_their_type(file, override, value):
    config = options.load(file, [override])
    for key in override.partition("=")[0].split("."):
        config = config[key]
    assert config == value and type(config) is type(value)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("train.stepz=3", ["unknown config field train.stepz", "did you mean train.steps", "train.decay, train.name, train.rate"]),
        ("steps=3", ["unknown config field steps", "map.nested.steps", "train.steps", "map, seed, train"]),
        ("trian.steps=3", ["unknown config field trian.steps", "did you mean train"]),
        ("train=3", ["train is a group", "train.steps"]),
        ("train.steps.x=3", ["train.steps is a value (20000), not a group"]),
        ("train.steps=1.5", ["train.steps must be an int like 20000", "'1.5'"]),
        ("train.steps=many", ["train.steps must be an int like 20000", "'many'"]),
        ("train.rate=nan", ["train.rate must be a float", "'nan'"]),
        ("train.decay=maybe", ["train.decay must be a bool", "'maybe'"]),
        ("map.size=3", ["map.size must be a tuple of length 2 like (480, 640)", "'3'"]),
        ("map.size=1,2,3", ["map.size must be a tuple of length 2"]),
        ("map.size=1,2.5", ["map.size must hold int", "2.5"]),
        ("map.x=1,a", ["map.x must hold float", "'a'"]),
        ("map.colors=red,3,blue", ["map.colors must be a tuple of length 2"]),
        ("train.steps", ["'train.steps' must read field=value"]),
    ],
)
def test_wrong_fields_and_values(file, override, words):
    message = refused(file, [override])
    assert all(word in message for word in words), message
    assert len(message.splitlines()) < 24


def test_all_wrong_fields_are_told_at_once(file):
    message = refused(file, ["train.stepz=1", "seed=1", "map.size=1"])
    assert "train.stepz" in message and "map.size" in message


def test_a_missing_file_names_where_it_was_looked_for(file, tmp_path):
    message = refused("configs/palet.py:smoke")
    root = pathlib.Path(options.__file__).resolve().parent.parent
    assert f"{tmp_path}/configs/palet.py" in message and f"{root}/configs/palet.py" in message
    assert "did you mean configs/pallet.py" in message


def test_a_checkout_is_the_second_place(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    (tmp_path / "lala_jax").mkdir()
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "own.py").write_text(CONFIG)
    monkeypatch.setattr(options, "__file__", str(tmp_path / "lala_jax" / "options.py"))
    assert options.load("configs/own.py:smoke").train.steps == 10


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = 1", "has no function get_config"),
        ("def get_config():\n    return 3", "gave int, expected a ConfigDict"),
        ("def get_config(:", "line 1: "),
        ("def get_config():\n    return {'a': {'b': object}}", "config field a.b is type"),
    ],
)
def test_bad_config_files(tmp_path, source, message):
    (tmp_path / "bad.py").write_text(source)
    assert message in refused(str(tmp_path / "bad.py"))


def test_bad_arguments(file, tmp_path):
    assert "argument must be '' or 'smoke', got 'smok'" in refused(f"{file}:smok")
    assert "must be FILE.py or FILE.py:ARGUMENT, got 'configs/pallet'" in refused("configs/pallet")
    (tmp_path / "plain.py").write_text("def get_config():\n    return {'a': 1}")
    assert "takes no argument, got 'smoke'" in refused("plain.py:smoke")


def test_override_leaves_the_original_and_follows_references():
    config = ml_collections.ConfigDict({"a": 2, "list": [1, 2], "later": config_dict.placeholder(int)})
    config.b = config.get_ref("a") * 10
    changed = options.override(config.lock(), ["a=3", "list=4,5", "later=6"])
    assert (changed.a, changed.b, changed.list, changed.later) == (3, 30, (4, 5), 6)
    assert config.a == 2 and config.list == [1, 2] and config.later is None


def test_dicts_round_trip_through_json(file):
    config = options.load(file)
    again = options.from_dict(json.loads(json.dumps(options.to_dict(config))))
    assert again.to_dict() == config.to_dict() and again.is_locked and again.map.size == (480, 640)
    plain = options.to_dict(config)
    plain["map"]["nested"]["steps"] = 99
    assert config.map.nested.steps == 3


def test_check_choice():
    assert options.check_choice("train.name", "adam", ("adam", "sgd")) == "adam"
    with pytest.raises(options.OptionsError, match="train.name must be one of 'adam', 'sgd', got 'adamm'; did you mean adam?"):
        options.check_choice("train.name", "adamm", ("adam", "sgd"))
    with pytest.raises(options.OptionsError, match="got True"):
        options.check_choice("k", True, (1, 2))


def test_run_calls_main(file):
    def main(config, workdir, *, checkpoint, episodes):
        return config.train.steps, workdir, checkpoint, episodes

    flags = {"checkpoint": "", "episodes": 5}
    argv = [f"--config={file}:smoke", "--workdir", "/tmp/x", "--config.train.steps", "-3", "--checkpoint=a=b", "--episodes=7"]
    assert options.run(main, flags=flags, argv=argv) == (-3, "/tmp/x", "a=b", 7)
    stored = {"train": {"steps": 4}}
    got = options.run(main, flags=flags, config_from=lambda flags: stored, workdir="out", argv=["--config.train.steps=8"])
    assert got == (8, "out", "", 5)
    for argument in ("--of-two=4", "--of_two=4"):
        given = options.run(lambda *_, of_two: of_two, flags={"of_two": 5}, workdir="out", argv=[f"--config={file}", argument])
        assert given == 4


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--workdir=x"], "--config=FILE.py[:ARGUMENT] is required"),
        (["--config=configs/pallet.py"], "--workdir=DIRECTORY is required"),
        (["--config=configs/pallet.py", "--workdirr=x"], "unknown argument '--workdirr=x'; did you mean --workdir?"),
        (["configs/pallet.py"], "unknown argument 'configs/pallet.py'"),
        (["--config", "--workdir=x"], "--config needs a value"),
        (["--config=configs/pallet.py", "--workdir=x", "--episodes=many"], "--episodes must be an int like 5, got 'many'"),
        (["--config=configs/pallet.py", "--workdir=x", "--config.train.stepz=3"], "unknown config field train.stepz"),
    ],
)
def test_run_refuses(file, capsys, argv, words):
    with pytest.raises(SystemExit) as caught:
        options.run(lambda config, workdir, episodes: pytest.fail("called"), flags={"episodes": 5}, argv=argv)
    captured = capsys.readouterr()
    assert caught.value.code == 2 and words in captured.err and not captured.out


def test_run_shows_only_the_message_of_user_errors(file, capsys):
    def main(config, workdir):
        raise LookupError("no demonstrations at x")

    argv = [f"--config={file}", "--workdir=x"]
    with pytest.raises(SystemExit) as caught:
        options.run(main, user_errors=(LookupError,), argv=argv)
    assert caught.value.code == 2 and "no demonstrations at x" in capsys.readouterr().err
    with pytest.raises(LookupError):  # a defect keeps its traceback
        options.run(main, argv=argv)


def test_what_the_system_refuses_and_ctrl_c_have_no_traceback(file, tmp_path, capsys):
    def main(config, workdir):
        (tmp_path / "file" / "below").mkdir()

    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match="2"):
        options.run(main, argv=[f"--config={file}", "--workdir=x"])
    assert f"cannot read or write {tmp_path / 'file' / 'below'}: Not a directory" in capsys.readouterr().err

    def stopped(config, workdir):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit, match="130"):
        options.run(stopped, argv=[f"--config={file}", "--workdir=x"])
    assert "stopped; the same command goes on from what is on disk" in capsys.readouterr().err

    def defect(config, workdir):
        (tmp_path / "nothing").read_text()

    with pytest.raises(FileNotFoundError):
        options.run(defect, argv=[f"--config={file}", "--workdir=x"])


def test_help_lists_the_fields(file, capsys):
    def main(config, workdir):
        pass

    options.run(main, flags={"out_of": "there"}, workdir="runs/here", argv=["--help", f"--config={file}"])
    text = capsys.readouterr().out
    assert "--config.map.nested.steps=3" in text and "--workdir='runs/here'" in text and "--out-of='there'" in text
    assert __doc__.splitlines()[0] in text
    options.run(main, argv=["--help"])
    assert "--workdir=DIRECTORY, required" in capsys.readouterr().out


def test_a_program_ends_with_status_2(file, tmp_path):
    program = """
        from lala_jax import options

        def main(config, workdir):
            print(config.train.steps, workdir)

        if __name__ == "__main__":
            options.run(main)
    """
    (tmp_path / "program.py").write_text(textwrap.dedent(program))
    root = str(pathlib.Path(options.__file__).resolve().parent.parent)
    command = [sys.executable, "-m", "program", f"--config={file}:smoke", "--workdir=w"]
    environment = {"PYTHONPATH": f"{root}:{tmp_path}", "PATH": ""}
    good = subprocess.run([*command, "--config.train.steps=3"], env=environment, capture_output=True, text=True, check=False)
    assert (good.returncode, good.stdout, good.stderr) == (0, "3 w\n", "")
    bad = subprocess.run([*command, "--config.train.step=3"], env=environment, capture_output=True, text=True, check=False)
    assert bad.returncode == 2 and bad.stderr.startswith("program: unknown config field train.step; did you mean train.steps")
    assert "Traceback" not in bad.stderr and len(bad.stderr.splitlines()) < 24
