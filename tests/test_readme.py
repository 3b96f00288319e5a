"""The README: its examples run, its scores are those of the files, and what it names is there."""

import contextlib
import io
import json
import pathlib
import re

import jax
import numpy as np
import pytest

from experiments import benchmark_targets
from lala_jax import build, dataset, defaults, options, recording, rollout

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = ROOT / "experiments" / "results"
TEXT = (ROOT / "README.md").read_text()
FIELDS = options.fields(options.to_dict(defaults.get("", task="tower")))


def section(title):
    """The text under a heading of the second level."""
    return re.split(r"^## .*$", TEXT.partition(f"\n## {title}\n")[2], maxsplit=1, flags=re.M)[0]


def test_the_notebook_builds_a_tower():
    """The cells one after another, as a user pastes them: the last one prints the score."""
    cells, names, said = re.findall(r"```python\n(.*?)```", section("In a notebook"), re.S), {}, io.StringIO()
    assert len(cells) == 3
    with contextlib.redirect_stdout(said):
        for cell in cells:
            exec(cell, names)
    assert said.getvalue() == "100.0\n"
    assert names["seen"].features.shape == (320, 160, 14, 3) and names["views"].depth.shape == (4, 240, 320)
    assert names["heatmaps"].pick.shape == (160, 80) and names["heatmaps"].place.shape == (36, 160, 80)


def test_a_robots_demonstrations_are_written(tmp_path):
    """The functions as they stand there, given what was measured in MuJoCo: the data set is that of the recording."""
    (cell,), names = re.findall(r"```python\n(.*?)```", section("Training on a robot's demonstrations"), re.S), {}
    exec(cell, names)
    ((demo,),) = (recording.demonstrate(names["task"], [4], threads=1),)
    fields = {name: getattr(demo.scene, name) for name in ("size", "color", "base", "goal", "symmetry")}
    action = {name: getattr(demo.action, name) for name in ("pick", "place", "yaw")}
    names["write"](tmp_path / "own", [names["demonstration"](4, **fields, poses=demo.poses, **action)])
    (found,), _ = dataset.load(tmp_path / "own", **build.data_identity(names["config"]))
    jax.tree.map(np.testing.assert_array_equal, found, demo)


FILES = [f"{task}/{name}.json" for task in ("tower", "pallet") for name in ("main", "robustness-test")] + ["ablation/ablation-pallet.json"]
FILES += [f"{task}/scores-{agent}-test.json" for task in ("tower", "pallet") for agent in ("policy", "oracle", "top_view", "blind")]


@pytest.mark.parametrize("file", FILES)
def test_scores_are_those_of_the_files(file):
    found = json.loads((RESULTS / file).read_text())
    text = section("Results").replace("*", "")
    for row in found.get("rows", [found]):
        assert f"{rollout.with_interval(row['score'], row['interval95'])} |" in text


def test_the_table_of_rivals_is_the_one_that_was_written():
    assert (RESULTS / "table1" / "cpu.md").read_text().strip() in section("Results")


def test_speeds_are_those_of_the_files():
    """Every time, ratio and share in the tables, but what was wanted."""
    known = set()
    for path in (RESULTS / "benchmark").rglob("*.json"):
        found = json.loads(path.read_text())
        rows = [*found["stages"], *(row for one in found["growth"] for row in one["rows"])]
        known |= {benchmark_targets.seconds_text(row["seconds"]) for row in rows if "seconds" in row}
        known |= {benchmark_targets.UNITS[one["unit"]](one["value"]) for one in found["targets"] if "value" in one}
        rates = {row["name"]: row["flops_per_second"] for row in rows if "flops_per_second" in row}
        known |= {f"{rate / rates['matmul-bfloat16']:.1%}" for rate in rates.values() if "matmul-bfloat16" in rates}
    cells = [cell.strip() for line in section("Speed").splitlines() if line.startswith("|") for cell in line.split("|")]
    measured = [cell for cell in cells if not cell.startswith(("at most", "at least"))]
    named = [text for cell in measured for text in re.findall(r"[\d.]+(?: (?:us|ms|s|times)\b|%)", cell)]
    assert len(named) > 50 and not [text for text in named if text not in known]


def test_links_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", TEXT) if not link.startswith("http")]
    assert len(links) > 10 and not [link for link in links if not (ROOT / link).exists()]


@pytest.mark.parametrize("form", [r"--config\.([a-z_]+\.[a-z_]+)=", r"`((?:augment|camera|data|eval|map|model|optim|train)\.[a-z_]+)[`=]"])
def test_fields_of_the_config_are_there(form):
    named = set(re.findall(form, TEXT))
    assert len(named) > 10 and named <= FIELDS.keys()


def test_the_layout_names_every_module():
    there = [path for part in ("lala_jax", "experiments") for path in (ROOT / part).rglob("*.py") if path.name != "__init__.py"]
    named = set(re.findall(r"[a-z0-9_*]+\.py", section("Layout")))
    kinds = {name.replace("*", "") for name in named if "*" in name}  # such as benchmark_*.py
    assert not [path for path in there if path.name not in named and not any(path.stem.startswith(kind[:-3]) for kind in kinds)]


def test_the_layout_names_no_other_module():
    there = {path.name for path in ROOT.rglob("*.py")}
    assert {name for name in re.findall(r"[a-z0-9_*]+\.py", section("Layout")) if "*" not in name} <= there


def test_tests_that_laws_name_are_there():
    named = re.findall(r"`((?:[a-z]+/)?test_[a-z_]+\.py)`", section("Laws and where they are tested"))
    assert len(named) > 15 and not [name for name in named if not (ROOT / "tests" / name).exists()]
