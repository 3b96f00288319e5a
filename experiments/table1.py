"""The paper's table beside ours: `python -m experiments.table1 --task=tower --scale=cpu`.

Trains every row of `ROWS` on the same demonstrations with the same number of samples, scores it on the same episodes of the test split, and
writes `<scale>-<task>.json` (see `common`; a row has `published`, the paper's number or null, `parameters`, `samples` and `train_seconds`
besides, `pretrain_samples` and `pretrain_seconds` where its backbone was pre-trained, and `ran`, fields that were set otherwise than its
`config` says), `<scale>.md`, a table of both tasks as far as they are there and one of what the rows differ by, and `<scale>.webp`, the
scores as bars, to `--out`. The scales are
`smoke` (every part, scores that mean nothing), `cpu` (all from the default agent's pictures and maps, half the paper's in each direction,
by networks of about as many parameters as ours, pretrained features to the stem only: most rows train in a third of an hour to one) and
`paper` (the paper's own sizes and number of samples, in bfloat16; for a GPU).
Runs lie in `--workdir`, runs/table1/<task> unless told, each in <scale>-<row>. Started again, it goes on with the rows that are
missing, and within a row where its training stopped; `--rows=two-stream,ours` runs only these. The row `cliport-clip` needs CLIP's own
weights: `--clip=RN50.safetensors --clip-tokenizer=tokenizer.json`, which `clip_file` reads. With `--launcher=slurm` or `local` each row
is a worker's (see `lala_jax.cluster`), after others recorded the demonstrations and pre-trained the backbone that rows share.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from experiments import common
from lala_jax import build, cluster, compiling, options, pretrain, rollout, scoring, state, writers
from lala_jax.sim import tasks


@dataclasses.dataclass(frozen=True)
class Entry(common.Row):
    """A row: how an agent differs from the default one at every scale, whose sizes it takes, and what the paper says of it."""

    family: str = "paper"  # of FAMILIES
    agent: str = "policy"  # or one of oracle.AGENTS, which are not trained
    published: tuple[float | None, float | None] = (None, None)  # tower, pallet: score with 500 demonstrations, as published
    against: tuple[str, ...] = ()  # the rows that it is compared with, scene by scene
    few: bool = False  # learns from FEW demonstrations
    scene: bool = False  # the backbone is first pre-trained in the task's scenes
    extra: str = ""  # of the package, with a module of that name, that the row needs
    clip: bool = False  # needs CLIP's files

    def beside(self, config) -> dict[str, Any]:
        """Give how the backbone is pre-trained, where it is."""
        return build.pretrain_settings(self.configs(config)[0]) if self.scene else {}


HIDDEN = ("model.max_height=true", "model.multi_action=false", "camera.backbone=resnet50_imagenet_v1")  # the goal's inside is
VISIBLE = ("model.max_height=false", *HIDDEN[1:])
COLOR = ("model.max_height=true", "model.multi_action=false")
ROWS = (
    Entry("ours", "ours, the default agent", family="ours"),
    Entry("single", "LALA single stream", ("model.name=single", *HIDDEN), published=(13.4, 6.0), family="single"),
    Entry("two-stream", "LALA two stream", ("model.name=two_stream", *HIDDEN), published=(15.8, 6.3)),
    Entry(
        "lateral", "LALA two stream + lateral", ("model.name=two_stream_lateral", *HIDDEN), published=(0.0, 0.0), against=("two-stream",)
    ),
    Entry("single-visible", "single stream, height slices", ("model.name=single", *VISIBLE), family="single", against=("single",)),
    Entry("two-stream-visible", "two stream, height slices", ("model.name=two_stream", *VISIBLE), against=("two-stream",)),
    Entry("lateral-visible", "two stream + lateral, height slices", ("model.name=two_stream_lateral", *VISIBLE), against=("lateral",)),
    Entry("transporter", "Transporter (ignores the goal)", ("model.name=transporter", *COLOR), family="transporter"),
    Entry("image-goal", "image-goal Transporter", ("model.name=image_goal", *COLOR), family="goal"),
    Entry("goal-split", "goal-split Transporter", ("model.name=goal_split", *COLOR), family="goal"),
    Entry(
        "cliport",
        "CLIPort, one sentence for the whole tower",
        ("model.name=cliport", *COLOR, "augment.mix=0.0"),
        tasks=("tower",),
        published=(27.0, None),
        family="cliport",
        extra="language",
    ),
    Entry(
        "cliport-clip",
        "CLIPort with CLIP's own weights",
        ("model.name=cliport", *COLOR, "augment.mix=0.0"),
        tasks=("tower",),
        published=(27.0, None),
        family="clip",
        clip=True,
    ),
    Entry("graph", "graph policy on true poses", ("model.name=graph",), family="graph", against=("ours",)),
    Entry("two-stream-plain", "two stream, no pretrained features", ("model.name=two_stream", *COLOR), against=("two-stream",)),
    Entry(
        "two-stream-scene",
        "two stream, ImageNet's features trained on in the scene",
        ("model.name=two_stream", *HIDDEN),
        scene=True,
        against=("two-stream", "two-stream-plain"),
    ),
    Entry("two-stream-50", "two stream, 50 demonstrations", ("model.name=two_stream", *HIDDEN), few=True, against=("two-stream",)),
    Entry(
        "two-stream-scene-50",
        "two stream, ImageNet's features trained on in the scene, 50 demonstrations",
        ("model.name=two_stream", *HIDDEN),
        against=("two-stream-50",),
        scene=True,
        few=True,
    ),
    Entry(
        "two-stream-multi",
        "two stream, every right action",
        ("model.name=two_stream", *HIDDEN, "model.multi_action=true"),
        against=("two-stream",),
    ),
    Entry("ours-same-maps", "ours, from the pictures and maps of the paper's agents", family="same"),
    Entry("ours-one-hot", "ours, one-hot labels", ("model.multi_action=false",), family="ours", revision=2, against=("ours",)),
    Entry("ours-no-matching", "ours, no matching between the maps", ("model.matching=false",), family="ours", against=("ours",)),
    Entry("blind", "blind: places well, ignores identities", family="computed", agent="blind"),
    Entry("top_view", "sees the goal from right above only, else perfect", family="computed", agent="top_view"),
    Entry("oracle", "oracle", family="computed", agent="oracle"),
)
LINES = ("blind", "top_view")  # drawn through the bars
LAST = (*common.CHOOSES, "eval.strips")  # fields that say how a run ends
# What every row shares, and what the rows of a family do. A row of a family that lacks a scale would be another's double there.
SCALES = {
    "smoke": (
        *("data.directory={config.data.directory}-smoke", "data.demos=3", "train.steps=2", "train.batch_size=2", "eval.episodes=2"),
        *("camera.height=60", "camera.width=80", "map.cell=0.0125", "map.slices=7", "model.rotations=4", "model.crop=8"),
        *("pretrain.steps=2", "pretrain.scenes=2", "pretrain.batch_size=2", "pretrain.window=32"),
    ),
    "cpu": ("data.demos=500", "train.steps=400", "train.batch_size=8", "eval.episodes=100"),
    "paper": (
        *("data.demos=500", "train.steps=2500", "train.batch_size=8", "train.save_every=1000", "eval.episodes=100", "eval.parallel=4"),
        *("camera.height=480", "camera.width=640", "pretrain.window=128", "pretrain.patch=16"),
    ),
}
FEW = {"smoke": 2, "cpu": 50, "paper": 50}
PAPER = {
    "smoke": ("model.width=4", "model.stages=2", "camera.stage=stem"),
    "cpu": ("model.crop=32", "model.width=8", "camera.stage=stem"),  # deeper features take three times as long
    "paper": (
        *("map.cell=0.003125", "model.crop=64", "model.channels=3", "model.width=64", "model.dtype=bfloat16"),
        # As eight samples are taken at a time, eight times the paper's learning rate of 1e-4.
        *("optim.schedule=constant", "optim.learning_rate=8e-4", "optim.weight_decay=0.0"),
    ),
}
OURS = {
    "smoke": ("model.width=4", "model.trunk_width=8", "model.trunk_blocks=1", "model.tokens=40"),
    "cpu": (),
    "paper": (),
}
FAMILIES = {
    "ours": OURS,
    "single": PAPER | {"cpu": (*PAPER["cpu"], "model.width=12")},  # three hourglasses instead of six: as many parameters
    "transporter": PAPER | {"cpu": ("model.crop=32", "model.width=12")},
    "goal": PAPER | {"cpu": ("model.crop=32", "model.width=10")},  # four
    "same": {
        "smoke": (*OURS["smoke"], "model.crop=12"),
        "paper": ("map.cell=0.003125", "model.crop=48", "model.tokens=2816"),
    },
    "paper": PAPER,
    "cliport": {
        "smoke": ("model.width=4", "model.stages=3"),
        "cpu": ("model.crop=32", "model.width=8"),
        "paper": (*PAPER["paper"], "model.stages=5"),
    },
    # All four stages, to a stride of 32, as in CLIPort.
    "clip": {
        "smoke": ("model.width=4", "model.stages=5", "model.crop=32"),
        "cpu": ("model.crop=32", "model.width=8", "model.stages=5"),
        "paper": (*PAPER["paper"], "model.stages=5"),
    },
    "computed": dict.fromkeys(SCALES, ()),
    "graph": {"smoke": ("model.width=8",), "cpu": ("model.width=64",), "paper": ("model.width=64",)},
}
FLAGS = {
    **{"task": "tower", "scale": "cpu", "rows": "", "split": "test", "start": 0, "seed": 0, "out": "experiments/results/table1"},
    **{"clip": "", "clip_tokenizer": ""},
    **cluster.FLAGS,
}


def main(
    config, workdir, *, task: str, scale: str, rows: str, split: str, start: int, seed: int, out: str, clip: str, clip_tokenizer: str,
    launcher: str, launcher_options: str,
) -> list[dict[str, Any]]:  # fmt: skip
    """Train and score every row of the table at a scale, and write the table and the bars."""
    options.check_choice("--task", task, PUBLISHED)
    common.check_task(config, task)
    launch = cluster.launcher(launcher, launcher_options)
    options.check_choice("--scale", scale, SCALES)
    base = options.override(config, [*shared(config, scale), f"eval.split={split}", f"eval.start={start}", f"seed={seed}"])
    seeds, out_path = build.split_seeds(split, start, base.eval.episodes), pathlib.Path(out)
    path, place = out_path / f"{scale}-{task}.json", {"split": split, "start": start, "seed": seed}
    common.check_held(path, place)
    runs = f"{build.workdir(config, workdir)}/{scale}"
    files = tuple(f"model.{name}={path}" for name, path in (("clip", clip), ("clip_tokenizer", clip_tokenizer)) if path)
    chosen = [row for row in common.choose(plan(scale, files), rows, task, reference=False) if can_run(row, files)]
    if not chosen:
        raise options.OptionsError(f"--rows={rows}: none of these can run, for want of what is said above")
    for row in chosen:
        if row.clip:
            build.build_policy(row.configs(base)[0])  # before hours of other rows, whether the files will do

    def finish(done: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
        del done, kept
        return {"task": task, "scale": scale, **place}

    work, before = functools.partial(work_on, base=base, runs=runs, seeds=seeds, task=task), preparations(chosen, base, runs)
    try:
        return common.fill(path, chosen, work, finish, config=base, seeds=seeds, launch=launch, before=before)
    finally:  # also of what is there where a row failed or somebody stopped it
        if path.exists():
            write(out_path, scale, seeds, bases(base, scale))


def bases(base, scale: str) -> dict[str, Any]:
    """Give the config that each task's rows change: `base` for its own, for the others theirs with the scale, seed and place of `base`."""
    flags = [f"eval.split={base.eval.split}", f"eval.start={base.eval.start}", f"seed={base.seed}"]
    found = {name: common.shipped_config({"task": name}) for name in PUBLISHED if name in tasks.names() and name != base.task.name}
    return {base.task.name: base} | {name: options.override(own, [*shared(own, scale), *flags]) for name, own in found.items()}


PUBLISHED = ("tower", "pallet")  # the order in Entry.published


def owned(flags: Mapping[str, Any]) -> dict[str, str]:
    """Give the fields that the scale, its rows and the flags set, and by what; not those whose new value is made of the given one."""
    scale = options.check_choice("--scale", flags["scale"], SCALES)
    texts = [*SCALES[scale], *(text for row in plan(scale) for text in row.overrides)]
    names = [text.partition("=")[0] for text in texts if "{config." not in text]
    ours = dict.fromkeys([*names, *LAST], f"--scale={scale} and its rows")
    return ours | {"eval.split": "--split", "eval.start": "--start", "seed": "--seed"}


def shared(config, scale: str) -> list[str]:
    """Give the overrides of every row at a scale."""
    return [text.format(config=config) for text in SCALES[scale]]


def plan(scale: str, clip: tuple[str, ...] = ()) -> list[Entry]:
    """List the rows with all overrides of a scale: the family's sizes first, then what the row is, then CLIP's files if it needs them."""
    few, files = {True: (f"data.demos={FEW[scale]}",), False: ()}, {True: clip, False: ()}
    return [
        dataclasses.replace(row, overrides=(*FAMILIES[row.family][scale], *few[row.few], *row.overrides, *files[row.clip]))
        for row in ROWS
        if scale in FAMILIES[row.family]
    ]


def can_run(row: Entry, clip: tuple[str, ...] = ()) -> bool:
    """Say whether what a row needs is installed, or was given, and print it where not."""
    if row.clip and not clip:
        print(f"{row.name} is left out: it needs --clip=PATH, CLIP's weights, and --clip-tokenizer=PATH, a tokenizer.json", flush=True)
        return False
    try:
        if row.extra:
            importlib.import_module(f"lala_jax.{row.extra}")
    except ModuleNotFoundError as error:
        print(f"{row.name} is left out: {error}", flush=True)
        return False
    return True


def work_on(row: Entry, *, base, runs: str, seeds: Sequence[int], task: str) -> dict[str, Any]:
    """Train and score a row: its fields, with what was published."""
    return {**run(row, base, pathlib.Path(f"{runs}-{row.folder}"), seeds), "published": row.published[PUBLISHED.index(task)]}


def run(row: Entry, base, directory: pathlib.Path, seeds: Sequence[int]) -> dict[str, Any]:
    """Train a row and score it, or score an agent that needs no training."""
    config = row.configs(base)[0]
    if row.agent != "policy":
        summary = scoring.baseline(row.agent, build.task(config), seeds=seeds, threads=config.data.threads)
        return {**common.row_of(summary), "parameters": None, "samples": 0, "train_seconds": 0.0}
    # One validation, of a few episodes: at the paper's scale as many as the scores then take at once, by the same program.
    ran, facts = dict(zip(LAST, (config.train.steps, min(config.eval.parallel, 4), 0), strict=True)), {}
    config.update_from_flattened_dict(ran)
    if row.scene:
        before = directory.with_name(directory.name.removesuffix(row.folder) + "backbone")
        config.camera.backbone = backbone(config, before)
        ran["camera.backbone"] = str(pathlib.Path(config.camera.backbone).relative_to(directory.parent))  # in the runs' directory
        samples = config.pretrain.steps * config.pretrain.batch_size
        facts = {"pretrain_samples": samples, "pretrain_seconds": common.train_seconds(before)}
    params = jax.eval_shape(build.build_policy(config).init, jax.random.key(0))
    facts |= {"parameters": state.parameter_count(params), "samples": config.train.steps * config.train.batch_size}
    return {**common.train_and_score(config, directory), **facts, "ran": ran}


def backbone(config, directory: pathlib.Path) -> str:
    """Pre-train the backbone of all rows of a scale, once, and give the file of its weights."""
    return str(pretrain.pretrain(config, str(directory)))


def preparations(rows: Sequence[Entry], base, runs: str) -> list[common.Before]:
    """List what rows share: the demonstrations, and the backbone that is pre-trained in the scenes."""
    found = common.recordings([row for row in rows if row.agent == "policy"], base)
    if scene := [row for row in rows if row.scene]:
        call = functools.partial(backbone, scene[0].configs(base)[0], pathlib.Path(f"{runs}-backbone"))
        found.append(common.Before("the backbone", call, tuple(row.name for row in scene)))
    return found


# The table and the bars


def stored(out: pathlib.Path, scale: str, seeds: Sequence[int], bases: Mapping[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """Read the finished rows of a scale, in the table's order: `{task: {name: row}}`, without those of other settings or `seeds`.

    `bases` has the config that the rows of each task change.
    """
    found = {}
    for task in [name for name in PUBLISHED if name in bases]:
        path = out / f"{scale}-{task}.json"
        rows = common.read(path)
        fresh = {row.name: rows[row.name] for row in plan(scale) if row.name in rows and is_fresh(row, rows[row.name], bases[task], seeds)}
        if left := sorted(rows.keys() - fresh.keys()):
            print(f"left out of the table, as they are of other settings or seeds: {', '.join(left)} in {path}")
        found[task] = fresh
    return {task: rows for task, rows in found.items() if rows}


def is_fresh(row: Entry, result: Mapping[str, Any], base, seeds: Sequence[int]) -> bool:
    """Say whether a row of a file is what the table's row would give now; files of CLIP may be anywhere."""
    files = [text for text in result["overrides"][0] if row.clip and text.startswith("model.clip")]
    own = dataclasses.replace(row, overrides=(*row.overrides, *files))
    return common.is_same(result, common.identity(own, base, seeds, weights=None))


def write(out: pathlib.Path, scale: str, seeds: Sequence[int], bases: Mapping[str, Any]) -> None:
    """Write `<scale>.md` and `<scale>.webp` from the results of both tasks, whose rows change `bases`, and print the table."""
    rows = stored(out, scale, seeds, bases)
    text = "\n\n".join(part for part in (table(rows), differences(rows)) if part)
    with writers.atomic(out / f"{scale}.md") as file:
        file.write(f"{text}\n".encode())
    try:
        bars(rows, out / f"{scale}.webp")
    except ModuleNotFoundError as error:
        older = f"; those in {out / scale}.webp are older" if (out / f"{scale}.webp").exists() else ""
        print(f"the bars are left out: {error}; pip install matplotlib{older}")
    print(f"\n{text}\n\n{out / scale}.md")


def table(results: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Write the rows of each task side by side as a Markdown table; what is missing is left empty."""
    header = ["", "parameters"]
    for task in results:
        header += [task, "complete", "training, s", "published"]
    lines = []
    for entry in ROWS:
        own = [rows.get(entry.name) for rows in results.values()]
        if not any(own):
            continue
        counts = next(row["parameters"] for row in own if row)
        line = [entry.label, f"{counts:,}" if counts else ""]
        for row in own:
            line += cells(row) if row else [""] * 4
        lines.append(line)
    return common.table(header, lines)


def differences(results: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Write as a Markdown table what rows score more than those they are `against`, in the same scenes; "" where there are none."""
    lines, labels = [], {entry.name: entry.label for entry in ROWS}
    for entry, against in ((one, name) for one in ROWS for name in one.against):
        own = [(rows.get(entry.name), rows.get(against)) for rows in results.values()]
        if not any(row and other for row, other in own):
            continue
        found = [common.difference(row["scores"], other["scores"], paired=True) if row and other else None for row, other in own]
        texts = [rollout.with_interval(one["mean"], one["interval95"], signed=True) if one else "" for one in found]
        lines.append([entry.label, labels[against], *texts])
    return common.table(["", "less the score, in the same scenes, of", *results], lines) if lines else ""


def cells(row: Mapping[str, Any]) -> list[str]:
    """Write a task's part of a row; what its backbone took beforehand is added to the time, where that is known."""
    cost = " + ".join(f"{row[name]:.0f}" for name in ("train_seconds", "pretrain_seconds") if row.get(name))
    return [*common.cells(row)[1:], cost, "" if row["published"] is None else f"{row['published']:.1f}"]


def bars(results: Mapping[str, Mapping[str, Mapping[str, Any]]], path: pathlib.Path) -> None:
    """Draw the scores as bars with their intervals, a panel for each task, and lines where an agent without training gets to."""
    from matplotlib import figure  # of the extra `plots`; the runs do not need it

    shown = [entry for entry in ROWS if entry.agent == "policy" and any(entry.name in rows for rows in results.values())]
    drawing = figure.Figure(figsize=(4 + 4 * len(results), 1.5 + 0.3 * len(shown)), layout="constrained")
    axes = drawing.subplots(1, len(results), sharey=True, squeeze=False)[0]
    for axis, (task, rows) in zip(axes, results.items(), strict=True):
        own = [(place, rows[entry.name]) for place, entry in enumerate(shown) if entry.name in rows]
        places, scores = [place for place, _ in own], [row["score"] for _, row in own]
        ends = [[row["score"] if end is None else end for end in row["interval95"]] for _, row in own]
        low, high = ([abs(pair[side] - score) for pair, score in zip(ends, scores, strict=True)] for side in (0, 1))
        axis.barh(places, scores, xerr=[low, high], color="tab:blue", ecolor="black", capsize=2)
        published = [(place, row["published"]) for place, row in own if row["published"] is not None]
        if published:
            axis.plot(*zip(*[(score, place) for place, score in published], strict=True), "D", color="tab:red", label="published")
        for name, style in zip(LINES, (":", "--"), strict=True):
            if name in rows:
                axis.axvline(rows[name]["score"], color="black", linestyle=style, label=name.replace("_", " "))
        axis.set(title=task, xlim=(0, 100), xlabel="score", yticks=range(len(shown)), yticklabels=[entry.label for entry in shown])
    told = {text: handle for axis in axes for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    if told:
        drawing.legend(list(told.values()), list(told), loc="outside lower center", ncols=len(told), fontsize="small")
    axes[0].invert_yaxis()
    with writers.atomic(path) as file:
        drawing.savefig(file, format=path.suffix[1:], dpi=100)


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    return options.run(
        main, flags=FLAGS, config_from=common.shipped_config, workdir="runs/table1/<task>", owned=owned, user_errors=common.USER_ERRORS,
        argv=argv,
    )  # fmt: skip


if __name__ == "__main__":
    from experiments import table1 as module  # the name under which workers find what they are sent

    compiling.keep()
    module.command()
