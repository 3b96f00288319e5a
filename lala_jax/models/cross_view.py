"""Pre-training in the scene: tell what is hidden in one view from the rest of it and from the other views.

The paper's own suggestion (section VI-C): "a self-supervised reconstruction task to predict a patch in one view from visual observation
cues in another view". It is CroCo's cross-view completion (Weinzaepfel et al., NeurIPS 2022) with the masking and the target of MAE
(He et al., CVPR 2022): most patches of one view are covered, the encoder sees every view alone, a decoder of cross-attention alone
(CrossMAE; Fu et al., TMLR 2025) gives each covered patch's pixels. Three things differ, each for a reason:

- **The encoder is `resnet.ResNet50`**, so that what is learnt drops into `camera.backbone`. Kernels and the scale and bias of the
  normalisation are trained; its stored means and variances stay, as in all of this package, so that a picture's features never depend on
  its batch. A convolution reads a covered pixel as the mean colour, 0 after preparation.
- **The decoder knows where things are.** CroCo's has to find out from the pictures how the views lie to each other. Here cameras and depth
  are known, also to the agents, and a fixed rig would only be learnt by heart. So each feature of the other views is unprojected with its
  depth and put where the covered view sees that point. The covered view's own depth is not used. What remains for the network is what the
  agents need of it, too: to say at a point, from whatever side, what is there.
- **The target is each patch less its mean, over its deviation**, over pixels and channels together (MAE's `norm_pix_loss`), with a
  deviation of `FLOOR` added: pictures of plain faces have no texture whose noise should be blown up. Copying a point's colour through
  geometry is not enough then. Bare table gives 0 whatever its grey, the flat middle of a face its hue, and a patch with an edge asks where
  exactly, and between which two colours, it runs as seen from here: from features at a quarter of the resolution, that came from other
  sides, mixed by a decoder too shallow to find it out by itself. Pixels cannot collapse, as features of a moving average can.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from lala_jax import types
from lala_jax.models import resnet
from lala_jax.perception import camera as cameras

FLOOR = 0.05  # of colour, added to the deviation of a patch
GRID = 3  # heads are laid over a patch in rows of so many
DEPTH = 0.1  # metres: the unit in which a feature says how near it is
_STRIDES = dict(zip(resnet.STAGES, (4, 4, 8, 16, 32), strict=True))


def windows(views: types.Views, point: jax.Array, size: int) -> types.Views:
    """Cut the `size` x `size` pixels about a world point `[3]` out of each view, as far towards it as the picture goes. Unbatched."""

    def one(rgb, depth, camera):
        uv, _ = cameras.project(point, camera)
        limit = jnp.array([camera.height - size, camera.width - size])
        low = jnp.clip(jnp.round(uv[::-1] - size / 2).astype(jnp.int32), 0, limit)
        rgb = jax.lax.dynamic_slice(rgb, (*low, 0), (size, size, 3))
        moved = camera.intrinsics.at[:2, 2].add(-low[::-1].astype(jnp.float32))
        return rgb, jax.lax.dynamic_slice(depth, low, (size, size)), camera.replace(intrinsics=moved, height=size, width=size)

    return types.Views(*jax.vmap(one)(views.rgb, views.depth, views.camera))


def cover(key: jax.Array, side: int, share: float) -> jax.Array:
    """Draw which of `side` x `side` patches are covered, bool: a `share` of them, rounded."""
    order = jax.random.permutation(key, side * side)
    return (order < round(share * side * side)).reshape(side, side)


def targets(rgb: jax.Array, patch: int) -> jax.Array:
    """Give what is to be predicted of `[H, W, 3]`: `[H / patch, W / patch, patch * patch * 3]`, each of mean 0 and deviation below 1."""
    rows, cols = rgb.shape[0] // patch, rgb.shape[1] // patch
    pixels = rgb.reshape(rows, patch, cols, patch, 3).swapaxes(1, 2).reshape(rows, cols, -1)
    pixels = pixels - pixels.mean(-1, keepdims=True)
    return pixels * jax.lax.rsqrt(jnp.square(pixels).mean(-1, keepdims=True) + FLOOR**2)


def errors(predicted: jax.Array, target: jax.Array, hidden: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Give the mean squared errors, over the `hidden` patches `[rows, cols]`, of a prediction and of predicting each patch's mean."""
    share = hidden / hidden.sum()
    return ((predicted - target) ** 2).mean(-1).ravel() @ share.ravel(), (target**2).mean(-1).ravel() @ share.ravel()


class Read(nn.Module):
    """Read a memory at places: cross-attention and two dense layers, each added to its normalised input's source.

    A head looks mostly at one place beside the patch's middle, by a Gaussian whose centre and width it learns: the quadratic
    encoding with which attention is a convolution (Cordonnier et al., ICLR 2020), of points that lie on no grid. It also says how far
    from the middle lay what it read.
    """

    width: int  # channels a head

    @nn.compact
    def __call__(self, x: jax.Array, at: jax.Array, memory: jax.Array, places: jax.Array, seen: jax.Array) -> jax.Array:
        """Update `x` `[q, d]` at `at` `[q, 2]` from a memory `[k, d]` at `places` `[k, 2]`, both in patches, where `seen` `[k]`."""
        heads = GRID * GRID
        grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, GRID)] * 2), -1).reshape(heads, 2)
        centre = self.param("centre", lambda _: jnp.asarray(grid, jnp.float32))
        sharpness = jnp.exp(self.param("log_sharpness", nn.initializers.constant(np.log(4.0)), (heads,)))
        delta = places - at[:, None]
        away = jnp.square(delta).sum(-1) - 2 * jnp.einsum("qkc,hc->hqk", delta, centre)
        query = nn.DenseGeneral((heads, self.width), name="query")(nn.LayerNorm(name="norm")(x))
        key, value = (nn.DenseGeneral((heads, self.width), name=name)(memory) for name in ("key", "value"))
        value = jnp.concatenate([value, jnp.broadcast_to(places[:, None], (*value.shape[:2], 2))], -1)
        read = nn.dot_product_attention(query, key, value, bias=-sharpness[:, None, None] * away, mask=seen)
        read = read.at[..., -2:].add(-at[:, None])
        x += nn.DenseGeneral(x.shape[-1], axis=(-2, -1), name="out")(read)
        y = nn.gelu(nn.Dense(4 * x.shape[-1], name="hidden")(nn.LayerNorm(name="hidden_norm")(x)))
        return x + nn.Dense(x.shape[-1], name="output")(y)


class CrossView(nn.Module):
    """Predict the covered patches of one view of a scene from all that is not covered; unbatched.

    `encoder` in its variables is a whole `resnet.ResNet50`. Raises ValueError for another stage.
    """

    flavour: resnet.Flavour
    stage: str = "conv2"  # of the encoder
    patch: int = 8  # pixels
    width: int = 16  # the decoder's channels a head
    blocks: int = 2  # of the decoder

    @nn.compact
    def __call__(self, views: types.Views, which: jax.Array, hidden: jax.Array) -> jax.Array:
        """Map V views, of which `which` is covered where `hidden` `[rows, cols]`, to its `targets` `[rows, cols, patch * patch * 3]`.

        Raises ValueError where the views' sides are not rows and cols patches.
        """
        rows, cols = hidden.shape
        if views.rgb.shape[1:3] != (rows * self.patch, cols * self.patch):
            raise ValueError(f"{rows} x {cols} patches of {self.patch} pixels do not make views of {list(views.rgb.shape[1:3])}")
        covered = jnp.repeat(jnp.repeat(hidden, self.patch, 0), self.patch, 1)
        blank = np.array(self.flavour.mean)[np.argsort(self.flavour.order)].astype(np.float32) / self.flavour.peak
        rgb = views.rgb.at[which].set(jnp.where(covered[..., None], blank, views.rgb[which]))
        features = resnet.ResNet50(self.flavour, self.stage, name="encoder")(rgb)
        features = features.reshape(-1, features.shape[-1])
        places, near, own, seen = locate(views, which, covered, _STRIDES[self.stage])

        width = GRID * GRID * self.width
        facts = jnp.stack([near, own.astype(jnp.float32)], -1)
        memory = nn.Dense(width, name="feature")(nn.LayerNorm(name="feature_norm")(features)) + nn.Dense(width, name="fact")(facts)
        at = cameras.pixel_centers(rows, cols).reshape(-1, 2)
        x = jnp.broadcast_to(self.param("patch_token", nn.initializers.normal(0.02), (width,)), (len(at), width))
        for block in range(self.blocks):
            x = Read(self.width, name=f"read{block}")(x, at, memory, places / self.patch, seen)
        faint = nn.initializers.normal(0.01)  # most patches are bare: begin at their mean
        return nn.Dense(self.patch**2 * 3, kernel_init=faint, name="pixels")(nn.LayerNorm(name="norm")(x)).reshape(rows, cols, -1)


def locate(views: types.Views, which: jax.Array, covered: jax.Array, stride: int) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Say of every `stride`-th pixel of all views, flat: `(u, v)` in the covered view, nearness to it, whose it is, if it may be read.

    Nearness is in units of DEPTH about the mean, and 0 for the covered view's own, whose depth is not looked at.
    """
    target = jax.tree.map(lambda leaf: leaf[which], views.camera)

    def one(depth, camera):
        uv, z = cameras.project(cameras.unproject(depth, camera), target)
        return uv[::stride, ::stride], z[::stride, ::stride], (depth[::stride, ::stride] > 0) & (z[::stride, ::stride] > 0)

    uv, z, seen = jax.vmap(one)(views.depth, views.camera)
    own = jnp.broadcast_to((jnp.arange(len(z)) == which)[:, None, None], z.shape)
    visible = seen & ~own
    near = jnp.where(visible, z - jnp.where(visible, z, 0.0).sum() / jnp.maximum(visible.sum(), 1), 0.0) / -DEPTH
    uv = jnp.where(own[..., None], cameras.pixel_centers(*covered.shape)[::stride, ::stride], uv)
    seen = jnp.where(own, ~covered[::stride, ::stride], seen)
    return uv.reshape(-1, 2), near.ravel(), own.ravel(), seen.ravel()
