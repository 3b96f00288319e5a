"""From a config to the objects it names: the door between config fields and keyword arguments."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from lala_jax import (
    backbone,
    checkpoint,
    dataset,
    defaults,
    encoders,
    observe,
    optim,
    options,
    parallel,
    policy,
    policy_cliport,
    policy_goal_aware,
    policy_graph,
    policy_transporter,
    pretrain_step,
    train_step,
    types,
)
from lala_jax.models import cliport, cross_view, goal_aware, graph, resnet, transporter
from lala_jax.sim import scene, tasks
from lala_jax.sim.tasks import base

MODELS = ("goal_aware", *transporter.VARIANTS, "cliport", "graph")
DTYPES = ("float32", "bfloat16")  # of model.dtype
CLIP_STAGES = (2, 3, 4)  # of CLIP's trunk, that cliport may take
SPLITS = ("train", "val", "test")
TEST_START = 10_001
WORKDIR = "runs/<task>"  # the default of --workdir
SELECTION_START = 4000  # the place in the val split from which episodes choose the best checkpoint: far from those reported
FILES = {"surface": ("camera.backbone",), "clip": ("model.clip", "model.clip_tokenizer")}  # by the input spec's entry that knows them
USER_ERRORS = (dataset.DatasetError, checkpoint.CheckpointError, base.NoFreePose, parallel.PeerError)  # their messages say all


def workdir(config: Mapping[str, Any], given: str) -> str:
    """Put the task's name into the default work directory."""
    return given.replace("<task>", config["task"]["name"])


def task(config: Mapping[str, Any]) -> base.Task:
    """Build the task from the config's `task` group."""
    fields = config["task"]
    options.check_choice("task.name", fields["name"], tasks.names())
    options.check_choice("task.colors", fields["colors"], base.COLOR_CHOICES)
    number = {"num_objects": fields["num_objects"]} if fields["num_objects"] else {}
    try:
        return tasks.get(fields["name"], colors=fields["colors"], distractors=newer(config, "task.distractors"), **number)
    except (ValueError, TypeError) as error:
        raise options.OptionsError(str(error)) from error


def task_options(config: Mapping[str, Any]) -> dict[str, Any]:
    """Give what identifies recorded demonstrations beside the task's name; what is 0 is left out, as in older recordings."""
    built = task(config)
    more = {"distractors": built.distractors, "mistakes": mistakes(config)}
    return {"num_objects": built.num_objects, "colors": built.colors, **{name: value for name, value in more.items() if value}}


def data_identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """Give what tells the demonstrations of one config from those of another, as `dataset` stores it."""
    return {"task": task(config).name, "task_options": task_options(config)}


def mistakes(config: Mapping[str, Any]) -> float:
    """Give the share of the demonstrations' actions that are spoiled."""
    share = newer(config, "data.mistakes")
    if not 0.0 <= share < 1.0:
        raise options.OptionsError(f"config field data.mistakes must be at least 0 and below 1, got {share!r}")
    return share


def map_spec(config: Mapping[str, Any]) -> types.MapSpec:
    """Build the map's facts from the config's `map` group."""
    try:
        return types.MapSpec(**config["map"])
    except ValueError as error:
        raise options.OptionsError(str(error)) from error


def observer(config: Mapping[str, Any]) -> observe.Observer:
    """Build the observer from the groups `task`, `map` and `camera`; raises where a camera sees nothing."""
    fields = config["camera"]
    options.check_choice("camera.preset", fields["preset"], scene.PRESETS)
    for name in ("height", "width"):
        _positive(f"camera.{name}", fields[name])
    for name in ("shift", "turn"):
        _not_negative(f"camera.{name}", fields.get(name, 0.0))
    surface(config)
    built = observe.Observer(task=task(config), spec=map_spec(config), dtype=network_dtype(config), **fields)
    try:
        built.check()
    except ValueError as error:
        raise options.OptionsError(f"camera.preset {built.preset!r}: {error}") from error
    options.check_choice("camera.missing", built.missing, range(-1, len(built.camera.intrinsics)))
    return built


def surface(config: Mapping[str, Any]) -> int:
    """Give the number of pretrained features that the map's surface has; 0 without a backbone."""
    name, stage = (newer(config, field) for field in ("camera.backbone", "camera.stage"))
    if not name:
        return 0
    options.check_choice("camera.stage", stage, resnet.STAGES)
    return 64 if stage == "stem" else resnet.layers(stage)[f"{stage}_1/expand"][-1]


def backbone_identity(config: Mapping[str, Any]) -> dict[str, str]:
    """Give the input spec's entry of the surface's features, which tells them from others, whatever file they lie in; {} without any."""
    if not surface(config):
        return {}
    name, stage = config["camera"]["backbone"], config["camera"]["stage"]
    packaged = name in backbone.PACKAGED
    return {"surface": f"{name if packaged else f'{checkpoint.crc32(backbone.load(name, stage=stage)[1]):08x}'} {stage}"}


def network_dtype(config: Mapping[str, Any]) -> str:
    """Give the type that networks compute in, the backbone among them."""
    return options.check_choice("model.dtype", newer(config, "model.dtype"), DTYPES)


def build_policy(config: Mapping[str, Any]) -> policy.Policy:
    """Build the policy from the groups `model` and `map`."""
    fields, spec = config["model"], map_spec(config)
    options.check_choice("model.name", fields["name"], MODELS)
    files = clip_files(config)
    for name in ("rotations", "crop", "channels", "width", "stages", "trunk_width", "trunk_blocks", "tokens"):
        _positive(f"model.{name}", fields[name])
    _not_negative("model.match_weight", fields["match_weight"])
    shared = {"crop": fields["crop"], "channels": fields["channels"]}
    if surface(config) and fields["name"] not in transporter.VARIANTS:
        known = ", ".join(transporter.VARIANTS)
        raise options.OptionsError(f"model.name {fields['name']!r} takes no camera.backbone; those that do are {known}")
    dtype = network_dtype(config)
    if dtype != "float32" and fields["name"] in ("goal_aware", "graph"):
        raise options.OptionsError(f"model.name {fields['name']!r} computes in float32 only, got model.dtype={dtype!r}")
    if fields["name"] == "goal_aware":
        if spec.rows % 4 or spec.cols % 4 or fields["crop"] % 4:
            sizes = f"{spec.rows}, {spec.cols} and {fields['crop']}"
            raise options.OptionsError(f"goal_aware needs map rows, map cols and model.crop in multiples of 4, got {sizes}")
        model = goal_aware.GoalAware(
            spec=spec, rotations=fields["rotations"], tokens=fields["tokens"], trunk_width=fields["trunk_width"],
            trunk_blocks=fields["trunk_blocks"], fine_width=fields["width"], matching=fields["matching"], **shared,
        )  # fmt: skip
        choices = {name: fields[name] for name in ("multi_action", "match_weight", "refine", "max_height", "average_turns")}
        return policy_goal_aware.GoalAwarePolicy(model=model, **choices)
    if fields["name"] == "graph":
        return policy_graph.GraphPolicy(model=graph.Graph(width=fields["width"]), spec=spec, multi_action=fields["multi_action"])
    shared |= {"yaw_bins": fields["rotations"], "width": fields["width"], "stages": fields["stages"], "dtype": jnp.dtype(dtype)}
    choices = {name: fields[name] for name in ("multi_action", "max_height")}
    try:
        if fields["name"] == "cliport":
            built = task(config)
            told = encoders.load(built.name, built.num_objects, **files)
            return policy_cliport.CliportPolicy(model=cliport.Cliport(**shared, text_layer=not files), spec=spec, **told, **choices)
        net = transporter.Transporter(variant=fields["name"], **shared)
        return policy_transporter.TransporterPolicy(model=net, spec=spec, surface=surface(config), **choices)
    except ValueError as error:
        raise options.OptionsError(str(error)) from error


def clip_files(config: Mapping[str, Any]) -> dict[str, Any]:
    """Give CLIP's `weights`, its `tokenizer` and how many `stages` of its trunk cliport takes, where the config names its files."""
    fields = config["model"]
    weights, tokenizer, stages = (newer(config, f"model.{name}") for name in ("clip", "clip_tokenizer", "clip_stages"))
    if not (weights or tokenizer or stages):
        return {}
    if fields["name"] != "cliport":
        raise options.OptionsError(f"model.name {fields['name']!r} takes no model.clip: 'cliport' does")
    if not (weights and tokenizer):
        given = f"{weights!r} and {tokenizer!r}"
        raise options.OptionsError(f"model.clip, the weights, and model.clip_tokenizer, a tokenizer.json, go together, got {given}")
    options.check_choice("model.clip_stages", stages, (0, *CLIP_STAGES))
    fitting = min(fields["stages"] - 1, (fields["crop"] & -fields["crop"]).bit_length() - 2)  # the power of two in the crop
    return {"weights": weights, "tokenizer": tokenizer, "stages": stages or min(max(fitting, CLIP_STAGES[0]), CLIP_STAGES[-1])}


def clip_identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """Give the input spec's entry of CLIP's towers, which tells them from others, whatever files they lie in; {} without any."""
    files, built = clip_files(config), task(config)
    return {"clip": encoders.identity(built.name, built.num_objects, **files)} if files else {}


def _mix(config: Mapping[str, Any]) -> float:
    return _share("augment.mix", newer(config, "augment.mix"))


def _check_names(config: Mapping[str, Any]) -> None:
    """Raise where the colours that training shows are not those that sentences name."""
    recolor, mix, colors = config["augment"]["recolor"], _mix(config), config["task"]["colors"]
    if recolor and mix:
        raise options.OptionsError(f"model.name 'cliport' calls colours by their names: it needs augment.mix=0, got {mix!r}")
    if not recolor and colors not in base.PALETTES:
        known = " or ".join(base.PALETTES)
        raise options.OptionsError(f"model.name 'cliport' calls colours by their names: it needs task.colors {known}, got {colors!r}")


def _check_numbers(config: Mapping[str, Any]) -> None:
    """Raise where what is a probability is none, or what is a bound is below 0."""
    for group, name in (("augment", "depth_noise"), ("augment", "missing"), ("optim", "average_decay")):
        _share(f"{group}.{name}", config[group][name])
    for name in ("shift", "turn"):
        _not_negative(f"augment.{name}", config["augment"][name])
    for name in ("warmup", "weight_decay"):
        _not_negative(f"optim.{name}", config["optim"][name])
    _positive("optim.learning_rate", config["optim"]["learning_rate"])
    if not (clip := config["optim"]["clip"]) > 0.0:  # with 0 nothing is learnt
        raise options.OptionsError(f"config field optim.clip must be above 0 (inf for no clipping), got {clip!r}")


def _check_palette(config: Mapping[str, Any]) -> None:
    """Raise where objects would be given more colours than there are."""
    built = task(config)
    count, colors = built.num_objects + built.distractors, len(train_step.palette(built))
    if config["augment"]["recolor"] and count > colors:
        raise options.OptionsError(f"augment.recolor has {colors} colours for the {count} objects of task {built.name}: give false")


def check_data(config: Mapping[str, Any]) -> None:
    """Raise OptionsError where the group `data` asks for demonstrations that cannot be, before any is recorded."""
    _positive("data.demos", config["data"]["demos"])
    _not_negative("data.threads", config["data"]["threads"])
    mistakes(config)
    split_seeds("train", 0, config["data"]["demos"])


def check_evaluation(config: Mapping[str, Any]) -> None:
    """Raise OptionsError where the groups `eval` and `data` say of how many episodes what cannot be, before hours of training."""
    fields = config["eval"]
    _positive("eval.parallel", fields["parallel"])
    for name, value in (("eval.strips", fields["strips"]), ("data.threads", config["data"]["threads"])):
        _not_negative(name, value)
    options.check_choice("eval.split", fields["split"], SPLITS)
    split_seeds(fields["split"], fields["start"], fields["episodes"])


def recipe(config: Mapping[str, Any]) -> train_step.Recipe:
    """Build the training step's facts from the whole config."""
    train, augment = config["train"], config["augment"]
    for name in ("steps", "batch_size", "log_every", "save_every", "eval_every", "eval_episodes"):
        _positive(f"train.{name}", train[name])
    if config["model"]["name"] == "cliport":
        _check_names(config)
    _check_numbers(config)
    check_data(config)
    check_evaluation(config)
    backbone_identity(config)  # finds its file
    _check_palette(config)
    split_seeds("val", SELECTION_START, train["eval_episodes"])
    sensors = train_step.augment.Sensors(**{name: augment[name] for name in ("depth_noise", "shift", "turn", "missing")})
    options.check_choice("optim.schedule", config["optim"]["schedule"], optim.SCHEDULES)
    return train_step.Recipe(
        policy=build_policy(config),
        observer=observer(config),
        optimizer=optim.create(config["optim"], steps=train["steps"]),
        batch_size=train["batch_size"],
        recolor=augment["recolor"],
        mix=_mix(config),
        rigid=augment["rigid"],
        sensors=sensors,
        average_decay=config["optim"]["average_decay"],
    )


Recipe = TypeVar("Recipe", train_step.Recipe, pretrain_step.Recipe)


def on_devices(recipe: Recipe, config: Mapping[str, Any], *, group: str) -> Recipe:
    """Let all devices share the recipe's batches, whose size is a field of `group`; as it is where there is one device."""
    mesh = parallel.mesh(f"{group}.batch_size", recipe.batch_size)
    if mesh is None:
        return recipe
    return dataclasses.replace(recipe, mesh=mesh, shard_state=newer(config, "train.shard_state"))


def pretrain_recipe(config: Mapping[str, Any]) -> pretrain_step.Recipe:
    """Build the facts of a step of pre-training from the groups `pretrain`, `task`, `camera`, `optim` and `augment`."""
    fields, camera, augment, optimiser = config["pretrain"], config["camera"], config["augment"], dict(config["optim"])
    for name in ("steps", "batch_size", "learning_rate", "window", "patch", "scenes"):
        _positive(f"pretrain.{name}", fields[name])
    for name in ("log_every", "save_every"):
        _positive(f"train.{name}", config["train"][name])
    window, patch, side = fields["window"], fields["patch"], min(camera["height"], camera["width"])
    if window % patch or window > side:
        raise options.OptionsError(f"pretrain.window must be a multiple of pretrain.patch={patch} and at most {side}, got {window!r}")
    if not 0 < fields["mask"] <= 1 or not round(fields["mask"] * (window // patch) ** 2):
        raise options.OptionsError(f"config field pretrain.mask must be a share up to 1 that covers a patch, got {fields['mask']!r}")
    _check_palette(config)
    options.check_choice("camera.stage", camera["stage"], resnet.STAGES)
    options.check_choice("optim.schedule", optimiser["schedule"], optim.SCHEDULES)
    # Stored means and variances that are 0 and 1 ask for inputs of about one, torchvision's.
    flavour = backbone.load(fields["start"], stage=camera["stage"])[0].flavour if fields["start"] else resnet.TORCHVISION
    return pretrain_step.Recipe(
        model=cross_view.CrossView(flavour, camera["stage"], patch),
        observer=observer(config),
        optimizer=optim.create(optimiser | {"learning_rate": fields["learning_rate"]}, steps=fields["steps"]),
        batch_size=fields["batch_size"],
        window=window,
        mask=fields["mask"],
        recolor=augment["recolor"],
        mix=_mix(config),
        rigid=augment["rigid"],
        average_decay=optimiser["average_decay"],
    )


def pretrain_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """List the fields that make a run of pre-training what it is, by dotted name."""
    ours = ("seed", "task.", "camera.", "map.", "augment.recolor", "augment.mix", "augment.rigid", "optim.", "pretrain.")
    unused = ("camera.backbone", "optim.learning_rate")
    return {name: value for name, value in options.fields(config).items() if name.startswith(ours) and name not in unused}


def run_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """List the fields that make a run what it is, by dotted name: all but those that say how often to report and where data lie.

    Nor does pre-training, a run of its own, belong to it, nor where the state lies.
    """
    free = ("pretrain.", "eval.", "data.directory", "data.threads")
    free += ("train.log_every", "train.save_every", "train.eval_every", "train.eval_episodes", "train.shard_state")
    return {name: value for name, value in options.fields(defaults.complete(config)).items() if not name.startswith(free)}


def input_spec(config: Mapping[str, Any]) -> dict[str, Any]:
    """Say what the policy expects to see, to be stored beside its parameters."""
    spec = map_spec(config)
    return {
        **backbone_identity(config),
        **clip_identity(config),
        "map": {"rows": spec.rows, "cols": spec.cols, "slices": spec.slices, "features": 3},
        "x": list(spec.x), "y": list(spec.y), "z": list(spec.z), "cell": spec.cell,
        "features": "RGB in 0..1, mean per voxel",
    }  # fmt: skip


def split_seeds(split: str, start: int, count: int) -> list[int]:
    """Give `count` seeds of a split from its `start`-th on: train even, val odd, both below 10 000; test from 10001 on."""
    options.check_choice("split", split, SPLITS)
    if start < 0 or count < 1:
        raise options.OptionsError(f"a seed range needs start >= 0 and at least one seed, got start={start}, count={count}")
    if split == "test":
        return [TEST_START + i for i in range(start, start + count)]
    seeds = [2 * i + (split == "val") for i in range(start, start + count)]
    if seeds[-1] >= TEST_START - 1:
        most = math.ceil((TEST_START - 1) / 2)
        raise options.OptionsError(f"the {split} split has {most} seeds, asked for {start}..{start + count - 1}")
    return seeds


def newer(config: Mapping[str, Any], name: str) -> Any:
    """Read a field that configs in checkpoints may be older than."""
    group, field = name.split(".")
    return config[group].get(field, defaults.NEWER[name])


def _positive(name: str, value: float) -> None:
    if not np.isfinite(value) or value <= 0:
        raise options.OptionsError(f"config field {name} must be above 0, got {value!r}")


def _not_negative(name: str, value: float) -> None:
    if not np.isfinite(value) or value < 0:
        raise options.OptionsError(f"config field {name} must be at least 0, got {value!r}")


def _share(name: str, value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise options.OptionsError(f"config field {name} must be at least 0 and at most 1, got {value!r}")
    return value
