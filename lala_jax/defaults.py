"""Every field of a config with its default: the list that `configs/*.py` start from and `build` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import ml_collections

ARGUMENTS = ("", "smoke", "paper")
# What configs in checkpoints and results that are older than a field mean.
NEWER = {
    **{"task.distractors": 0, "data.mistakes": 0.0, "augment.mix": 0.5, "train.shard_state": False, "train.start": ""},
    **{"camera.backbone": "", "camera.stage": "conv2"},
    **{"model.clip": "", "model.clip_tokenizer": "", "model.clip_stages": 0, "model.dtype": "float32"},
}


def get(arg: str, *, task: str) -> ml_collections.ConfigDict:
    """Give the default config of a task; `arg` is one of ARGUMENTS: "" (2 CPU cores), "smoke" (every part, minutes), "paper" (GPU)."""
    if arg not in ARGUMENTS:
        raise ValueError(f"config argument must be one of {ARGUMENTS}, got {arg!r}")
    config = ml_collections.ConfigDict()
    config.seed = 0  # of the parameters and of every training step

    config.task = ml_collections.ConfigDict()
    config.task.name = task  # a name in sim.tasks
    config.task.num_objects = 0  # 0: the task's own number
    config.task.colors = "paper"  # one of sim.tasks.base.COLOR_CHOICES: a palette, or uniform
    config.task.distractors = 0  # further objects on the table that the goal does not show

    config.data = ml_collections.ConfigDict()
    config.data.directory = f"data/{task}"  # demonstrations, recorded there in simulation until there are data.demos
    config.data.demos = 500
    config.data.mistakes = 0.0  # share of the demonstrations' actions that are spoiled, so that they show how to recover
    config.data.threads = 0  # of physics, in collection and evaluation; 0: as many as this process has cores

    config.camera = ml_collections.ConfigDict()
    config.camera.preset = "ring"  # a name in sim.scene.PRESETS
    config.camera.height = 240  # pixels
    config.camera.width = 320
    config.camera.depth_noise = False  # on every picture; what training adds to some is augment.depth_noise
    config.camera.shift = 0.0  # metres: in evaluation, each episode's cameras are moved by up to so much,
    config.camera.turn = 0.0  # and turned by up to so many degrees, and nobody says so
    config.camera.calibrate = True  # in evaluation, find out where the cameras are from the first pictures of the table and the arm
    config.camera.backbone = ""  # pretrained features to fuse (the paper's agents): resnet50_imagenet_v1, or a file of weights
    config.camera.stage = "conv2"  # of the backbone: stem, conv2 or conv3, or deeper where the file goes deeper
    config.camera.missing = -1  # the camera that sees nothing; -1: none

    config.map = ml_collections.ConfigDict()
    config.map.cell = 0.00625  # metres
    config.map.slices = 14

    config.model = ml_collections.ConfigDict()
    config.model.name = "goal_aware"  # or single, two_stream, two_stream_lateral (the paper's), or a rival: see build.MODELS
    config.model.rotations = 36
    config.model.crop = 24  # cells; 64 for the paper's at full resolution
    config.model.channels = 4  # of key and query
    config.model.width = 24  # fine maps' channels (goal_aware), the first stage's (the paper's: 64), or nodes' and edges' (graph: 64)
    config.model.stages = 4  # of the paper's hourglass
    config.model.trunk_width = 48
    config.model.trunk_blocks = 3
    config.model.tokens = 704  # goal voxels that the pick is matched with
    config.model.dtype = "float32"  # of the paper's networks, their rivals and the backbone, or bfloat16; parameters stay float32
    config.model.multi_action = True  # supervise every right action, not one
    config.model.match_weight = 1.0
    config.model.matching = True  # tell pick and place which voxels of the two maps look alike
    config.model.refine = True  # regress below the cell and the bin, and tell quarter turns apart
    config.model.max_height = False  # see only what is highest in each column
    config.model.clip = ""  # for cliport: a file of CLIP's weights, .safetensors or .npz; none: ImageNet's and MiniLM's
    config.model.clip_tokenizer = ""  # the tokenizer.json that goes with them
    config.model.clip_stages = 0  # of CLIP's trunk, 2 to 4 (strides of 8 to 32); 0: as many as crop and stages allow
    config.model.average_turns = False  # act on the mean of the logits of the maps as they are and turned by 180 degrees

    config.augment = ml_collections.ConfigDict()
    config.augment.recolor = True
    config.augment.mix = 0.5  # probability that the new colours are drawn anywhere in RGB, and not from the palette
    config.augment.rigid = True
    config.augment.depth_noise = 0.25  # probability of an example with depth noise
    config.augment.shift = 0.001  # metres: each camera is at most so far from where it is thought to be
    config.augment.turn = 0.1  # degrees, likewise
    config.augment.missing = 0.1  # probability that one camera sees nothing

    config.optim = ml_collections.ConfigDict()
    config.optim.schedule = "cosine"
    config.optim.learning_rate = 1e-3
    config.optim.warmup = 100  # steps
    config.optim.weight_decay = 1e-4
    config.optim.clip = 1.0  # of the gradient's global norm
    config.optim.average_decay = 0.998  # of the parameters that are evaluated

    config.train = ml_collections.ConfigDict()
    config.train.steps = 1600
    config.train.batch_size = 8
    config.train.start = ""  # weights to begin with: pretrained/NAME, or a run's checkpoints; none: random ones
    config.train.log_every = 20  # steps
    config.train.save_every = 200
    config.train.eval_every = 800
    config.train.eval_episodes = 20  # to choose the best checkpoint, val split
    config.train.shard_state = False  # split parameters, their average and the optimiser's state over several devices

    config.pretrain = ml_collections.ConfigDict()  # of the backbone, by lala_jax.pretrain, to camera.stage; logged and saved as training is
    config.pretrain.start = "resnet50_imagenet_v1"  # weights to begin with: a name or a file, as camera.backbone; none: random ones
    config.pretrain.scenes = 512  # of the train split, which are then recoloured and moved
    config.pretrain.window = 64  # pixels, the sides of what is cut out of each view about one of the objects
    config.pretrain.patch = 8  # pixels
    config.pretrain.mask = 0.9  # share of one view's patches that is covered
    config.pretrain.steps = 1000
    config.pretrain.batch_size = 8
    config.pretrain.learning_rate = 1e-3  # the optimiser is that of optim otherwise

    config.eval = ml_collections.ConfigDict()
    config.eval.split = "val"
    config.eval.start = 0  # the first episode's place in the split
    config.eval.episodes = 100
    config.eval.parallel = 25  # episodes observed at once
    config.eval.strips = 4  # episodes drawn as strips of pictures
    if arg == "smoke":
        _shrink(config)
    if arg == "paper":
        _enlarge(config)
    return config


def _shrink(config) -> None:
    """Make every part run in a few minutes; the score means nothing."""
    config.data.directory += "-smoke"
    config.data.demos = 6
    config.train.steps = 12
    config.train.batch_size = 4
    config.train.log_every = 2
    config.train.save_every = 6
    config.train.eval_every = 6
    config.train.eval_episodes = 2
    config.optim.warmup = 2
    config.pretrain.scenes = 4
    config.pretrain.steps = 6
    config.pretrain.batch_size = 2
    config.eval.episodes = 4
    config.eval.parallel = 4
    config.eval.strips = 2


def _enlarge(config) -> None:
    """The paper's policy at the paper's size: two streams, one-hot labels, Adam 1e-4, batch 1, 20 K steps. Meant for a GPU."""
    config.camera.height, config.camera.width = 480, 640
    config.map.cell = 0.003125
    config.model.name = "two_stream"
    config.model.crop = 64
    config.model.channels = 3
    config.model.width = 64
    config.model.multi_action = False
    config.model.max_height = True
    config.camera.backbone = "resnet50_imagenet_v1"
    config.optim.schedule = "constant"
    config.optim.learning_rate = 1e-4
    config.optim.weight_decay = 0.0
    config.train.steps = 20_000
    config.train.batch_size = 1
    config.train.eval_every = 5000
    config.pretrain.window, config.pretrain.patch = 128, 16
    config.eval.parallel = 4


def complete(config: Mapping[str, Any]) -> dict[str, Any]:
    """Give a stored config with the fields that it is older than, in the groups that it has."""
    groups = {name: dict(group) if isinstance(group, Mapping) else group for name, group in config.items()}
    for field, value in NEWER.items():
        group, name = field.split(".")
        if group in groups:
            groups[group].setdefault(name, value)
    return groups
