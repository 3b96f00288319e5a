"""CLIPort as a policy: it sees the present, and is told the goal in one sentence for the whole of it. Pure and unbatched."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from lala_jax import policy, types
from lala_jax.models import bert, clip, cliport, resnet, transporter
from lala_jax.perception import topdown

ORDERS = 47  # of all colours, whose turns give the sentences of `sentence_statistics`
FLOOR = 0.01  # added to the variance of every direction, of which the mean is one


@struct.dataclass
class Frozen:
    """What CLIPort takes as others trained it: the weights of a trunk and of a sentence encoder, and what makes sentences for it."""

    trunk: Any  # variables of a `Trunk` or a `clip.Visual`
    encoder: Any  # variables of a `bert.Bert` or a `Sentence`
    template: Any  # of the task's sentence, such as a `wording.Template`: `slots` `[N, K]`, and `fill` from `[N]` to ids and mask `[T]`
    palette: jax.Array  # [P, 3] RGB 0..1, the colours by the indices that the template takes
    centre: jax.Array  # [e] what `sentence_statistics` gives
    whiten: jax.Array  # [e, e]


class Trunk(resnet.ResNet50):
    """A ResNet-50 that gives what `clip.Visual` does: its features at strides 4, 8 and so on, fine to coarse."""

    stage: str = "conv3"  # what ships reaches no deeper

    @property
    def stride(self) -> int:
        """Give the stride of the coarsest features, cells."""
        return 2 << list(resnet.STAGES).index(self.stage)

    def __call__(self, rgb: jax.Array) -> list[jax.Array]:
        """Map RGB in 0..1, `[..., H, W, 3]`, to float32 `[..., H / s, W / s, c_s]`."""
        return [features for stage, features in self.pyramid(rgb).items() if stage != "stem"]


class Sentence(nn.Module):
    """CLIP's text tower, called as `bert.Bert` is and giving the sentence alone. It needs no mask: padding follows the end."""

    text: clip.Text

    def __call__(self, ids: jax.Array, mask: jax.Array) -> jax.Array:
        """Map ids `[..., T]` to embeddings `[..., e]`."""
        del mask
        return self.text(ids)[0]


def towers(net: clip.Clip, variables: Any, *, stages: int) -> tuple[clip.Visual, Any, Sentence, Any]:
    """Give what CLIPort takes of CLIP, a trunk of so many `stages` and a sentence encoder, each with its part of the `variables`."""
    trunk = clip.Visual(net.visual.blocks[:stages], net.visual.width)
    shapes = jax.eval_shape(trunk.init, jax.random.key(0), jnp.zeros((trunk.stride, trunk.stride, 3)))
    seen = {kind: {name: variables[kind]["visual"][name] for name in leaves} for kind, leaves in shapes.items()}
    return trunk, seen, Sentence(net.text), {"params": {"text": variables["params"]["text"]}}


def sentence_statistics(
    encoder: bert.Bert | Sentence, variables: Any, template: Any, *, colors: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Give the mean embedding `[e]` of sentences and the symmetric `[e, e]` that makes the entries of what is left uncorrelated.

    In the sentences each of P `colors` is as often at every place as any other: `ORDERS` random orders are turned by 0 to P - 1, and the
    first N of each taken. What varies less than `FLOOR` is not blown up. The symmetric root has one value, on whatever machine.
    """
    rng, count = np.random.default_rng(seed), template.slots.shape[0]
    orders = [rng.permutation(colors) for _ in range(ORDERS)]
    chosen = jnp.array([np.roll(order, turn)[:count] for order in orders for turn in range(colors)])
    embed = jax.jit(lambda variables, template: jnp.asarray(encoder.apply(variables, *template.fill(chosen))))
    embeddings = np.asarray(embed(variables, template), np.float64)
    centre = embeddings.mean(0)
    rest = embeddings - centre
    variances, directions = np.linalg.eigh(np.cov(rest.T, bias=True) / np.square(rest).mean())
    whiten = directions / np.sqrt(np.maximum(variances, 0.0) + FLOOR) @ directions.T
    return centre.astype(np.float32), whiten.astype(np.float32)


def sentence(encoder: bert.Bert | Sentence, frozen: Frozen, color: jax.Array, height: jax.Array) -> jax.Array:
    """Embed what a tower of `color` `[N, 3]` with goals at `height` `[N]` (metres) is called, bottom to top: `[e]`.

    A colour is called by the nearest one of the palette. As many objects are named as the template has slots, the highest: the
    goals of distractors are under the table.

    MiniLM's embeddings have length one, and most of it is what all towers share: those of two orders of the same colours have a cosine
    of 0.994, of any two towers 0.92. So their mean is subtracted (the cosines are then 0.92 and 0). Nearly all that is left says which
    colours there are, in ten directions; their order is in many small ones, which a network of few steps does not hear. So the entries
    are whitened, by what `sentence_statistics` says (the cosines are then 0.56 and 0), and scaled to a root mean square of one, what
    `models.cliport` asks for. CLIP's are treated likewise. CLIPort takes embeddings as they come, and trains a hundred times as long.
    """
    named = jnp.linalg.norm(color[:, None] - frozen.palette, axis=-1).argmin(-1)
    order = jnp.argsort(height)[-frozen.template.slots.shape[0] :]
    rest = jnp.asarray(encoder.apply(frozen.encoder, *frozen.template.fill(named[order]))) - frozen.centre
    embedding = jnp.matmul(rest, frozen.whiten, precision=jax.lax.Precision.HIGHEST)
    return embedding * jax.lax.rsqrt(jnp.square(embedding).mean() + 1e-12)


@dataclasses.dataclass(frozen=True)
class CliportPolicy:
    """CLIPort's agent for one sentence: `models.cliport`, one-hot labels unless `multi_action`.

    Of the true state it takes the colours and the order of the goals' heights, for the sentence, and nothing else; it does not look at the
    goal. Its trunk, ImageNet's or CLIP's, sees the colours of the max-height map and, as in CLIPort, of the turned crops; ImageNet's
    features there are about 1.4 (root mean square), and stay as they are. The spatial stream sees the max-height map; without
    `max_height`, all slices. Sides of the map that the trunk's stride does not divide are filled up, with black as CLIPort's are.

    Raises ValueError for a crop or a number of stages that the trunk's features do not fit.
    """

    model: cliport.Cliport
    spec: types.MapSpec
    trunk: Trunk | clip.Visual
    encoder: bert.Bert | Sentence
    weights: Frozen = dataclasses.field(compare=False, repr=False)  # arguments of what is compiled for a policy, no part of it
    multi_action: bool = False
    max_height: bool = True
    privileged: ClassVar[bool] = True

    def __post_init__(self):
        stride = self.trunk.stride
        fewest = stride.bit_length() - 1
        if self.model.stages < fewest:
            raise ValueError(f"cliport needs at least {fewest} stages for features at stride {stride}, got {self.model.stages}")
        step = max(stride, 2 ** (self.model.stages - 1))
        if self.model.crop % step:
            raise ValueError(f"cliport needs a crop in multiples of {step}, got {self.model.crop}")

    @property
    def frozen(self) -> dict[str, Frozen]:
        """Give the weights that are not trained, by their name among the parameters."""
        return {"frozen": self.weights}

    def init(self, key: jax.Array):
        """Make the parameters."""
        rgb, maps = self._pictures(policy.empty_map(self.spec))
        features = [jnp.zeros(one.shape) for one in jax.eval_shape(self._features, self.weights, rgb)]
        words = jnp.zeros(self.weights.centre.shape)
        return self.model.init(key, maps, features, words, jnp.zeros(2, jnp.int32))["params"]

    def _pictures(self, current: types.TopDownMap) -> tuple[jax.Array, jax.Array]:
        """Give what the trunk and the network see, with zeros up to sides that the trunk's stride divides."""
        pads = *((0, -side % self.trunk.stride) for side in (self.spec.rows, self.spec.cols)), (0, 0)
        rgb, maps = topdown.max_height(current)[..., :3], policy.picture(current, max_height=self.max_height)
        return jnp.pad(rgb, pads), jnp.pad(maps, pads)

    def _features(self, frozen: Frozen, rgb: jax.Array) -> list[jax.Array]:
        return self.trunk.apply(frozen.trunk, rgb)

    def _look(self, params, current, told: types.State, pick=None):
        """Give the logits, of places for the cell `pick` or else for the best pick, and that cell."""
        frozen, net = params["frozen"], self.model.bind({"params": {name: leaf for name, leaf in params.items() if name != "frozen"}})
        rgb, maps = self._pictures(current)
        seen, (rows, cols) = (maps, self._features(frozen, rgb)), (self.spec.rows, self.spec.cols)
        words = sentence(self.encoder, frozen, told.color, told.goal[:, 2])
        picks = net.pick(*seen, words)[:rows, :cols]
        pick = jnp.stack(policy.argmax_index(picks)) if pick is None else pick
        crops = transporter.pick_crops(rgb, pick, yaw_bins=self.model.yaw_bins, crop=self.model.crop)
        places, _ = net.place(*seen, words, pick, self._features(frozen, crops))
        return policy.Heatmaps(picks, places[:, :rows, :cols]), pick

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
