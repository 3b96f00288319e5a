"""CLIPort as a policy: it sees the present, and is told the goal in one sentence for the whole of it. Pure and unbatched."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from lala_jax import policy, types
from lala_jax.models import bert, cliport, resnet, transporter
from lala_jax.perception import topdown

STAGES = ("conv2", "conv3")  # of the trunk, that the semantic stream takes: what ships reaches no deeper
STRIDE = 8  # of the last of them, cells
ORDERS = 3  # of all colours, whose turns give the sentences that `mean_sentence` averages


@struct.dataclass
class Frozen:
    """What CLIPort takes as others trained it: the weights of a trunk and of a sentence encoder, and what makes sentences for it."""

    trunk: Any  # variables of a `resnet.ResNet50`
    encoder: Any  # variables of a `bert.Bert`
    template: Any  # of the task's sentence, such as a `language.Template`: `slots` `[N, K]`, and `fill` from `[N]` to ids and mask `[T]`
    palette: jax.Array  # [P, 3] RGB 0..1, the colours by the indices that the template takes
    centre: jax.Array  # [e] what `mean_sentence` gives


def mean_sentence(encoder: bert.Bert, variables: Any, template: Any, *, colors: int, seed: int = 0) -> jax.Array:
    """Give the mean embedding `[e]` of sentences in which each of P `colors` is as often at every place as any other.

    `ORDERS` random orders are turned by 0 to P - 1, and the first N of each taken. MiniLM's mean of all towers of five is met
    to 0.009 by these 33 sentences, as by 256 random ones (0.013; towers are 0.28 from it on average).
    """
    rng, count = np.random.default_rng(seed), template.slots.shape[0]
    orders = [rng.permutation(colors) for _ in range(ORDERS)]
    chosen = jnp.array([np.roll(order, turn)[:count] for order in orders for turn in range(colors)])

    @jax.jit
    def embed(variables, template):
        return jnp.asarray(encoder.apply(variables, *template.fill(chosen))).mean(0)

    return embed(variables, template)


def sentence(encoder: bert.Bert, frozen: Frozen, color: jax.Array, height: jax.Array) -> jax.Array:
    """Embed what a tower of `color` `[N, 3]` with goals at `height` `[N]` (metres) is called, bottom to top: `[e]`.

    A colour is called by the nearest one of the palette. As many objects are named as the template has slots, the highest: the
    goals of distractors are under the table.

    MiniLM's embeddings have length one, and most of it is what all towers share: those of two orders of the same colours have a cosine
    of 0.994, of any two towers 0.92. So their mean is subtracted (the cosines are then 0.92 and 0) and the rest scaled to a root mean
    square of one, what `models.cliport` asks for. A linear map then reads every block's colour without an error.
    """
    named = jnp.linalg.norm(color[:, None] - frozen.palette, axis=-1).argmin(-1)
    order = jnp.argsort(height)[-frozen.template.slots.shape[0] :]
    embedding = jnp.asarray(encoder.apply(frozen.encoder, *frozen.template.fill(named[order]))) - frozen.centre
    return embedding * jax.lax.rsqrt(jnp.square(embedding).mean() + 1e-12)


@dataclasses.dataclass(frozen=True)
class CliportPolicy:
    """CLIPort's agent for one sentence: `models.cliport`, one-hot labels unless `multi_action`.

    Of the true state it takes the colours and the order of the goals' heights, for the sentence, and nothing else; it does not look at the
    goal. Its trunk, ImageNet's, sees the colours of the max-height map and, as in CLIPort, of the turned crops; its features there are
    about 1.4 (root mean square), and stay as they are. The spatial stream sees the max-height map; without `max_height`, all slices.

    Raises ValueError for a map, a crop or a number of stages that the trunk's features do not fit.
    """

    model: cliport.Cliport
    spec: types.MapSpec
    trunk: resnet.ResNet50
    encoder: bert.Bert
    weights: Frozen = dataclasses.field(compare=False, repr=False)  # arguments of what is compiled for a policy, no part of it
    multi_action: bool = False
    max_height: bool = True
    privileged: ClassVar[bool] = True

    def __post_init__(self):
        fewest = STRIDE.bit_length() - 1
        if self.model.stages < fewest:
            raise ValueError(f"cliport needs at least {fewest} stages for features at stride {STRIDE}, got {self.model.stages}")
        step = max(STRIDE, 2 ** (self.model.stages - 1))
        if self.model.crop % step or self.spec.rows % STRIDE or self.spec.cols % STRIDE:
            sizes = f"{self.spec.rows}, {self.spec.cols} and {self.model.crop}"
            raise ValueError(f"cliport needs map rows and cols in multiples of {STRIDE} and a crop in multiples of {step}, got {sizes}")

    @property
    def frozen(self) -> dict[str, Frozen]:
        """Give the weights that are not trained, by their name among the parameters."""
        return {"frozen": self.weights}

    def init(self, key: jax.Array):
        """Make the parameters."""
        blank = policy.empty_map(self.spec)
        shapes = jax.eval_shape(self._features, self.weights, topdown.max_height(blank)[..., :3])
        features = [jnp.zeros(one.shape) for one in shapes]
        maps = policy.picture(blank, max_height=self.max_height)
        return self.model.init(key, maps, features, jnp.zeros(self.encoder.width), jnp.zeros(2, jnp.int32))["params"]

    def _features(self, frozen: Frozen, rgb: jax.Array) -> list[jax.Array]:
        found = self.trunk.bind(frozen.trunk).pyramid(rgb)
        return [found[stage] for stage in STAGES]

    def _look(self, params, current, told: types.State, pick=None):
        """Give the logits, of places for the cell `pick` or else for the best pick, and that cell."""
        frozen, net = params["frozen"], self.model.bind({"params": {name: leaf for name, leaf in params.items() if name != "frozen"}})
        rgb = topdown.max_height(current)[..., :3]
        seen = policy.picture(current, max_height=self.max_height), self._features(frozen, rgb)
        words = sentence(self.encoder, frozen, told.color, told.goal[:, 2])
        picks = net.pick(*seen, words)
        pick = jnp.stack(policy.argmax_index(picks)) if pick is None else pick
        crops = transporter.pick_crops(rgb, pick, yaw_bins=self.model.yaw_bins, crop=self.model.crop)
        places, _ = net.place(*seen, words, pick, self._features(frozen, crops))
        return policy.Heatmaps(picks, places), pick

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example, as `policy.imitation` does."""
        del goal
        sample = policy.draw(
            key, state, spec=self.spec, rotations=self.model.yaw_bins, candidates=state.ready, multi_action=self.multi_action
        )
        logits, _ = self._look(params, current, state, sample.pick)
        return policy.imitation(sample, logits, spec=self.spec)

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap, truth: types.State) -> tuple[types.PickPlace, policy.Heatmaps]:
        """Choose an action: the best pick cell and its best place cell and bin."""
        del goal
        logits, pick = self._look(params, current, truth)
        return policy.best_place(current, pick, logits.place, spec=self.spec), logits
