"""Turn a checkpoint and its scores into weights that ship with the package.

    python -m lala_jax.publish --checkpoint=runs/tower-500-0/checkpoints --scores=experiments/results/tower/scores-policy-test.json \\
        --out=lala_jax/weights/tower

Several score files are separated by commas; `lala_jax.evaluate --checkpoint=pretrained/tower` repeats the first. `--dtype=bfloat16` halves
the size. `--robustness=experiments/results/tower/robustness-test.json` adds a table of scores in other worlds. What is not known of
demonstrations that the oracle did not record must be said: `--data="400 of our UR5e, by hand, and 100 of the oracle in simulation"`.
"""

from __future__ import annotations

import hashlib
import json
import os
import pathlib
import shlex
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lala_jax import build, checkpoint, encoders, options, pretrained, rollout, state, writers

LARGEST = 12_000_000  # bytes of weights.npz
LICENCE = "Apache-2.0"
README = "README.md"
SCORE = ("episodes", "score", "interval95", "complete_percent")


def main(config, workdir, *, checkpoint: str, scores: str, out: str, dtype: str, robustness: str, data: str) -> None:
    """Write weights.npz, card.json and README.md to the directory `--out`."""
    del workdir
    if options.to_dict(config) != options.to_dict(stored_config({"checkpoint": checkpoint, "scores": scores, "out": out})):
        raise options.OptionsError("the config of published weights is that of their checkpoint: leave --config out")
    card = publish(checkpoint, scores.split(","), out, dtype=dtype, robustness=robustness or None, data=data)
    size = (pathlib.Path(out) / pretrained.ARRAYS).stat().st_size
    print(f"{out}: {card['parameters']:,} parameters, {dtype}, {size / 1e6:.1f} MB; check with\n{card['commands']['evaluate']}")


def stored_config(flags: Mapping[str, Any]):
    """Give the checkpoint's config, once all flags that are needed are there."""
    missing = [f"--{name}=PATH" for name in ("checkpoint", "scores", "out") if not flags[name]]
    if missing:
        raise options.OptionsError(f"give {' and '.join(missing)}")
    return options.from_dict(pretrained.describe(flags["checkpoint"])["config"])


def publish(
    source: str, score_files: Sequence[str], out: str | os.PathLike[str], *, dtype: str = "float32", robustness: str | None = None,
    data: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Write the three files of a checkpoint to `out`, all or none, and give the card.

    `data` says where the demonstrations are from, unless the oracle recorded them all. Raises OptionsError on scores of another
    checkpoint, model or world and where `out` holds something else, CheckpointError on a checkpoint that cannot be read or published.
    """
    options.check_choice("--dtype", dtype, pretrained.STORED)
    out = pathlib.Path(out)
    if out.exists() and not _replaceable(out):
        raise options.OptionsError(f"{out} holds something else than published weights: choose another --out")
    facts, (params, config, input_spec) = pretrained.describe(source), pretrained.load(source)
    arrays = pretrained.pack(params, dtype)
    if len(arrays) > LARGEST:
        hint = "; try --dtype=bfloat16" if dtype == "float32" else ""
        raise checkpoint.CheckpointError(f"{source} makes {len(arrays):,} bytes, published weights have at most {LARGEST:,}{hint}")
    rows, settings = _score_rows(score_files, source, params, config)
    card = {
        "version": pretrained.FORMAT_VERSION,
        "name": out.name,
        "licence": LICENCE,
        "sha256": hashlib.sha256(arrays).hexdigest(),
        "dtype": dtype,
        "parameters": state.parameter_count(params),
        "step": facts["step"],
        "data": _data(config) | ({"source": data} if data else {}),
        "training": {"seed": config["seed"], "steps": config["train"]["steps"], "selection": _selection(config)},
        "commands": {"train": training_command(config), "evaluate": _evaluation_command(out)},
        "scores": rows,
        "robustness": _robustness(robustness, config["task"]["name"], source, params) if robustness else None,
        "input_spec": input_spec,
        "config": {**config, "eval": settings},
    }
    card = writers.plain(card)
    _write(out, arrays, card)
    return card


def _replaceable(out: pathlib.Path) -> bool:
    """Say whether a directory holds nothing, or published weights and nothing else."""
    there = {path.name for path in out.iterdir()} if out.is_dir() else {""}
    return not there or (pretrained.is_published(out) and there <= {pretrained.ARRAYS, pretrained.CARD, README})


def _read_json(path: str) -> Any:
    try:
        return json.loads(pathlib.Path(path).read_bytes())
    except (OSError, ValueError) as error:
        raise options.OptionsError(f"cannot read {path}: {error}") from error


def _score_rows(files: Sequence[str], source: str, params: Any, config: Mapping[str, Any]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Read score files of `source`, which holds `params`: the card's rows, and the config's `eval` group that repeats the first."""
    rows, settings = [], []
    for file in files:
        found = _read_json(file)
        try:
            if found["agent"] != "policy" or not _same_weights(found, source, params):
                raise options.OptionsError(f"{file} holds scores of {_scored(found)}, not of {source}")
            changed = pretrained.differences(found["config"], config)
            if changed:
                raise options.OptionsError(f"{file} holds scores of another {', '.join(changed)}, here: {source}")
            rows.append({**_row(found, ("split", "seeds", "device"), file), "file": file})
            place = _place(found)
            settings.append({**found["config"]["eval"], **place})
        except (KeyError, TypeError) as error:
            raise options.OptionsError(f"{file} is no file of scores: {type(error).__name__} {error}") from error
    return rows, settings[0]


def _scored(found: Mapping[str, Any]) -> str:
    """Name what a file of scores is of: the checkpoint, and what it held then; an agent without one."""
    held = f", when it held {found['weights']}" if found.get("weights") else ""
    return f"{found['checkpoint']}{held}" if found["checkpoint"] is not None else found["agent"]


def _same_weights(found: Mapping[str, Any], source: str, params: Any) -> bool:
    """Say whether a file of scores is of the parameters `params` at `source`.

    By the fingerprint it holds; an older file by the checkpoint it names: the same place, or equal in every leaf.
    """
    if found.get("weights") is not None:
        return found["weights"] == pretrained.fingerprint(source, params)
    one = found["checkpoint"]
    if one is None:
        return False
    if os.path.abspath(pretrained.find(one)) == os.path.abspath(pretrained.find(source)):
        return True
    try:
        there, here = checkpoint.named(pretrained.load(one)[0]), checkpoint.named(params)
    except checkpoint.CheckpointError:  # no longer there: nothing says that it was the same
        return False
    return there.keys() == here.keys() and all(np.array_equal(there[name], here[name]) for name in there)


def _place(found: Mapping[str, Any]) -> dict[str, Any]:
    """Give split, start and number of the seeds that a score file is of: the inverse of `build.split_seeds`."""
    (first, last), split, scored = found["seeds"], found["split"], found["episodes"]
    start, count = (first - build.TEST_START, last - first + 1) if split == "test" else (first // 2, (last - first) // 2 + 1)
    seeds = build.split_seeds(split, start, count) if count > 0 else [0]
    if [seeds[0], seeds[-1]] != [first, last] or scored > count:  # fewer, where scenes without room were passed over
        raise options.OptionsError(f"{scored} episodes of the {split} split are not seeds {first} to {last}")
    return {"split": split, "start": start, "episodes": count}


def _data(config: Mapping[str, Any]) -> dict[str, Any]:
    task, mistakes = build.task(config), build.mistakes(config)
    return {
        "task": task.name,
        "objects": task.num_objects,
        "colors": task.colors,
        "distractors": task.distractors,
        "demonstrations": config["data"]["demos"],
        "mistakes": mistakes,
        "seeds": "the first even numbers (0, 2, 4, ...) whose scene the oracle solves; val is odd, both below 10 000, test from 10 001 on",
    }


def _selection(config: Mapping[str, Any]) -> str:
    seeds = build.split_seeds("val", build.SELECTION_START, config["train"]["eval_episodes"])
    return f"best score on val seeds {seeds[0]} to {seeds[-1]}, every {config['train']['eval_every']} steps"


def training_command(config: Mapping[str, Any]) -> str:
    """Compose the command that trains what `config` (as JSON holds it) describes: its task's config file and what differs from it."""
    file = f"configs/{config['task']['name']}.py"
    free = ("eval.", "data.threads", "train.log_every", "train.save_every")
    given, usual = (options.fields(one) for one in (config, writers.plain(options.to_dict(options.load(file)))))
    changed = {n: value for n, value in given.items() if not n.startswith(free) and (n not in usual or usual[n] != value)}
    if os.path.isabs(changed.get("data.directory", "")):  # where demonstrations lie on this machine
        del changed["data.directory"]
    flags = [shlex.quote(f"--config.{name}={tuple(value) if isinstance(value, list) else value}") for name, value in changed.items()]
    return " ".join(["python -m lala_jax.train", f"--config={file}", *flags, f"--workdir=runs/{config['task']['name']}"])


def _evaluation_command(out: pathlib.Path) -> str:
    place = f"{pretrained.PREFIX}/{out.name}" if out.resolve().parent == pretrained.WEIGHTS else out.as_posix()
    return f"python -m lala_jax.evaluate --checkpoint={shlex.quote(place)}"


def _robustness(file: str, task: str, source: str, params: Any) -> dict[str, Any]:
    """Read the scores in other worlds that `experiments.robustness` writes."""
    found = _read_json(file)
    try:
        if found["task"] != task or not _same_weights(found, source, params):
            raise options.OptionsError(f"{file} holds scores of {found['task']}, {_scored(found)}, not of {task}, {source}")
        rows = [{"condition": name, **_row(row, (), file)} for name, row in found["conditions"].items()]
        return {"file": file, "split": found["split"], "conditions": rows}
    except (KeyError, TypeError, AttributeError) as error:
        raise options.OptionsError(f"{file} is no table of conditions: {type(error).__name__} {error}") from error


def _row(found: Mapping[str, Any], more: Sequence[str], file: str) -> dict[str, Any]:
    """Pick the fields of a score that a card keeps."""
    if None in found["interval95"]:
        raise options.OptionsError(f"{file} has a score without an interval: evaluate more episodes")
    return {name: found[name] for name in (*more, *SCORE)}


def _write(out: pathlib.Path, arrays: bytes, card: Mapping[str, Any]) -> None:
    """Write the files beside `out`, in a folder of a name of its own, and rename them into place as one directory."""
    out.parent.mkdir(parents=True, exist_ok=True)
    beside = pathlib.Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    temporary, old = beside / "new", beside / "old"
    try:
        for name, content in ((pretrained.ARRAYS, arrays), (README, model_card(card).encode())):
            with writers.atomic(temporary / name) as file:
                file.write(content)
        writers.write_json(temporary / pretrained.CARD, card)
        if out.exists():
            os.replace(out, old)
        os.replace(temporary, out)
    except BaseException:
        if old.exists() and not out.exists():
            os.replace(old, out)
        raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _pretrained(config: Mapping[str, Any]) -> str:
    """Say what others trained of what the policy sees with and is told by."""
    camera, model, parts = config["camera"], config["model"], []
    if camera.get("backbone"):
        parts = [f"features of {camera['backbone']} ({camera['stage']})"]
    if model["name"] == "cliport":
        parts = [f"CLIP's towers ({model['clip']})"] if model.get("clip") else [f"features of {encoders.TRUNK}", "MiniLM's sentences"]
    begun = f"; begun from the weights {start}" if (start := config["train"].get("start")) else ""
    return (f"but frozen pretrained parts: {', '.join(parts)}" if parts else "no pretrained parts") + begun


def model_card(card: Mapping[str, Any]) -> str:
    """Write a card for people: what this is, from what, how good, and what it cannot do."""
    data, training, spec = card["data"], card["training"], card["input_spec"]["map"]
    camera, model = card["config"]["camera"], card["config"]["model"]
    more = f", and {data['distractors']} objects that the goal does not show" if data["distractors"] else ""
    spoiled = f" {data['mistakes']:.0%} of their actions are spoiled, so that they show how to recover." if data["mistakes"] else ""
    frozen = _pretrained(card["config"])
    if "source" not in data:
        demonstrations = f"{data['demonstrations']} demonstrations of the scripted oracle in simulation; no other data, {frozen}.{spoiled}"
        demonstrations += f" Their seeds: {data['seeds']}."
        seen = "Simulation only: never run on a robot or on pictures of real cameras."
        lacks = f" For a misplaced object, the demonstrations {'show few ways' if data['mistakes'] else 'never show how'} to recover."
    else:
        demonstrations = f"{data['demonstrations']} demonstrations: {data['source']}; {frozen}."
        seen, lacks = "The scores are of simulation only.", ""
    scores = [
        f"| {row['split']} | {row['seeds'][0]} to {row['seeds'][1]} | {row['episodes']} | {_score(row)} | `{row['file']}` |"
        for row in card["scores"]
    ]
    rounding = (
        " The parameters are rounded to bfloat16 and computed with in float32; a score may be from before the rounding."
        if card["dtype"] == "bfloat16"
        else ""
    )
    parts = [
        f"# {card['name']}: a policy of lala_jax",
        "Made from `card.json` by `lala_jax.publish`; change neither by hand.",
        "## Model",
        f"Goal-conditioned pick and place (`model.name={model['name']}`): two top-down maps of {spec['rows']} x {spec['cols']} cells with "
        f"{spec['slices']} height slices, the table now and the finished assembly, to one pick and one place. {card['parameters']:,} "
        f"parameters, the moving average after {card['step']} of {training['steps']} steps.{rounding}",
        "## Intended use",
        f"The simulated task `{data['task']}` of lala_jax with {data['objects']} objects{more}, colours `{data['colors']}`, cameras "
        f"`{camera['preset']}` at {camera['height']} x {camera['width']} pixels: research, comparison, a start for further training "
        "(`--config.train.start`).",
        "```bash\n" + card["commands"]["evaluate"] + "\n```",
        "repeats the first score below and says whether it is the same.",
        "## Data and training",
        f"{demonstrations} Training seed {training['seed']}. The checkpoint was chosen by {training['selection']}.",
        "```bash\n" + card["commands"]["train"] + "\n```",
        "## Scores",
        "Share of objects at their goal when the episode ends, 0 to 100, with the 95% interval over episodes.",
        "\n".join(["| split | seeds | episodes | score | complete | file |", "|---|---|---|---|---|---|", *scores]),
        *_other_worlds(card["robustness"]),
        "## Limits",
        f"{seen} Objects are upright boxes, actions are vertical. One training seed: the intervals do not say how much another training "
        f"would differ.{lacks}",
        "## Licence",
        f"{card['licence']}, as the code.",
    ]
    return "\n\n".join(parts) + "\n"


def _other_worlds(table: Mapping[str, Any] | None) -> list[str]:
    """Write the paragraphs on robustness."""
    if table is None:
        return []
    rows = [f"| {row['condition']} | {row['episodes']} | {_score(row)} |" for row in table["conditions"]]
    return [
        "## Other worlds",
        f"The same weights where something is not as in training (`{table['file']}`, {table['split']} split).",
        "\n".join(["| world | episodes | score | complete |", "|---|---|---|---|", *rows]),
    ]


def _score(row: Mapping[str, Any]) -> str:
    return f"{rollout.with_interval(row['score'], row['interval95'])} | {row['complete_percent']:.0f}%"


if __name__ == "__main__":
    options.run(
        main,
        flags={"checkpoint": "", "scores": "", "out": "", "dtype": "float32", "robustness": "", "data": ""},
        config_from=stored_config,
        workdir=build.WORKDIR,
        user_errors=build.USER_ERRORS,
    )
