"""Draw what the robot saw, what the policy thought and what it did.

Every function is pure: arrays in, one uint8 RGB picture `[height, width, 3]` out. Maps are
drawn as seen from behind the robot: world x up, world y to the left (`from_behind`, `px_from_cell`). An action
is drawn as a circle with a cross at the pick and an arrow to a second cross, turned by its yaw, at the place.
"""

from __future__ import annotations

import math
import textwrap

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lala_jax import types

GAP = 4  # pixels between tiles
MARGIN = 6  # pixels around text
PAPER = (250, 250, 250)
INK = (25, 25, 25)
EMPTY = (20, 20, 32)  # map cells where nothing was seen
PICK = (0, 230, 255)
PLACE = (255, 0, 200)
# Black - purple - orange - pale yellow, after matplotlib's inferno.
_HEAT = np.array([(0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164)], np.float32)


def to_uint8(image) -> np.ndarray:
    """Give `image`, floats in 0..1 (clipped) or already uint8, as uint8.

    Raises:
        ValueError: it holds NaN, or is of another type.
    """
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind != "f" and image.dtype.name != "bfloat16":
        raise ValueError(f"a picture must be uint8 or floating in 0..1, got {image.dtype} {image.shape}")
    image = image.astype(np.float32)
    if np.isnan(image).any():
        raise ValueError(f"the picture {image.shape} holds {int(np.isnan(image).sum())} NaN")
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def resize(image: np.ndarray, width: int, *, smooth: bool = True) -> np.ndarray:
    """Scale a uint8 picture to `width` pixels, keeping its shape; with `smooth=False` its pixels stay sharp squares."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    method = Image.Resampling.LANCZOS if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(image).resize((width, height), method))


def grid(images, columns: int, *, gap: int = GAP) -> np.ndarray:
    """Put uint8 pictures in rows of `columns`, each at the top left of a tile as large as the largest."""
    if not images or columns < 1:
        raise ValueError(f"a grid needs a picture and a column, got {len(images)} pictures and {columns} columns")
    height, width = max(image.shape[0] for image in images), max(image.shape[1] for image in images)
    columns = min(columns, len(images))
    rows = math.ceil(len(images) / columns)
    out = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), PAPER, np.uint8)
    for i, image in enumerate(images):
        top, left = (i // columns) * (height + gap), (i % columns) * (width + gap)
        out[top : top + image.shape[0], left : left + image.shape[1]] = image
    return out


def captioned(image: np.ndarray, text: str, *, size: int = 16) -> np.ndarray:
    """Write `text` above a uint8 picture, wrapped to its width; `size` is the font's, in pixels."""
    font = ImageFont.load_default(size)
    per_line = max(8, int((image.shape[1] - 2 * MARGIN) / (0.52 * size)))
    lines = [line for part in text.split("\n") for line in textwrap.wrap(part, per_line) or [""]]
    step = round(1.35 * size)
    head = Image.new("RGB", (image.shape[1], len(lines) * step + MARGIN), PAPER)
    draw = ImageDraw.Draw(head)
    for i, line in enumerate(lines):
        draw.text((MARGIN, MARGIN // 2 + i * step), line, fill=INK, font=font)
    return np.concatenate([np.asarray(head), image])


def views_grid(views: types.Views, *, columns: int | None = None, width: int | None = None) -> np.ndarray:
    """Tile the colours of V views, four of them two by two, optionally scaled to `width` pixels in all."""
    rgb = np.asarray(views.rgb)
    if rgb.ndim != 4 or rgb.shape[-1] != 3 or not len(rgb):
        raise ValueError(f"views.rgb must be [V, H, W, 3] of one scene with V > 0, got {rgb.shape}")
    tiled = grid([to_uint8(view) for view in rgb], columns or math.ceil(math.sqrt(len(rgb))), gap=2)
    return tiled if width is None else resize(tiled, width)


# Maps


def from_behind(array: np.ndarray) -> np.ndarray:
    """Turn a map `[rows, cols, ...]` into a picture `[cols, rows, ...]` with x up and y to the left."""
    return np.swapaxes(array, 0, 1)[::-1, ::-1]


def px_from_cell(spec: types.MapSpec, cell: np.ndarray, *, scale: float = 1.0) -> np.ndarray:
    """Map continuous `(row, col)` `[..., 2]` to the pixel `(u, v)` of `from_behind`'s picture enlarged by `scale`."""
    cell = np.asarray(cell, np.float64)
    return np.stack([spec.rows - cell[..., 0], spec.cols - cell[..., 1]], axis=-1) * scale


def map_image(map: types.TopDownMap) -> np.ndarray:
    """Draw the colour of the highest seen voxel of every cell, `[cols, rows, 3]` from behind the robot.

    The first three features are the colour; cells where nothing was seen take the colour `EMPTY`.
    """
    features, seen = np.asarray(map.features), np.asarray(map.count) > 0  # [rows, cols, slices, C], [rows, cols, slices]
    if features.ndim != 4 or features.shape[-1] < 3 or seen.shape != features.shape[:3]:
        raise ValueError(f"an unbatched map with colours is needed, got features {features.shape}, count {seen.shape}")
    highest = seen.shape[2] - 1 - np.argmax(seen[..., ::-1], axis=2)
    top = np.take_along_axis(features[..., :3], highest[:, :, None, None], axis=2)[:, :, 0]
    return from_behind(np.where(np.any(seen, axis=2, keepdims=True), to_uint8(top), np.array(EMPTY, np.uint8)))


def heatmap_overlay(image: np.ndarray, logits, *, strength: float = 0.85) -> np.ndarray:
    """Lay the softmax of a map's `logits` `[rows, cols]` over its picture, which may be enlarged.

    Heat is the root of the probability relative to the most likely cell's, so weak second choices show too; -inf is
    no heat.

    Raises:
        ValueError: NaN, +inf or no finite logit, or the shapes do not fit.
    """
    logits = np.asarray(logits, np.float32)
    if logits.ndim != 2 or abs(image.shape[0] - image.shape[1] * logits.shape[1] / logits.shape[0]) > 0.5:  # of a pixel, as `resize` rounds
        raise ValueError(f"logits [rows, cols] {logits.shape} do not fit the picture [cols, rows, 3] {image.shape}")
    if np.isnan(logits).any() or not np.isfinite(logits.max()):
        raise ValueError(f"logits {logits.shape} hold NaN, +inf or nothing finite")
    heat = np.ascontiguousarray(from_behind(np.exp(0.5 * (logits - logits.max()))))
    heat = np.asarray(Image.fromarray(heat).resize((image.shape[1], image.shape[0]), Image.Resampling.NEAREST))
    stops = np.linspace(0.0, 1.0, len(_HEAT))
    color = np.stack([np.interp(heat, stops, _HEAT[:, c]) for c in range(3)], axis=-1)
    alpha = strength * heat[..., None]
    return np.round((1.0 - alpha) * image + alpha * color).astype(np.uint8)


def _px_from_world(spec: types.MapSpec, xyz, scale: float) -> np.ndarray:
    return px_from_cell(spec, np.asarray(types.cell_from_world(spec, np.asarray(xyz, np.float32)[..., :2])), scale=scale)


def _cross(draw: ImageDraw.ImageDraw, centre: np.ndarray, yaw: float, arm: float, color, width: int) -> None:
    """Draw the world's x axis (long, to +x only) and y axis (both ways) turned by `yaw`."""
    forward = arm * np.array([-math.sin(yaw), -math.cos(yaw)])  # +x is up, +y is left
    left = 0.6 * arm * np.array([-math.cos(yaw), math.sin(yaw)])
    draw.line([*centre, *(centre + forward)], fill=color, width=width)
    draw.line([*(centre - left), *(centre + left)], fill=color, width=width)


def draw_action(image: np.ndarray, spec: types.MapSpec, action: types.PickPlace) -> np.ndarray:
    """Draw one action on a map's picture, which may be enlarged: circle at the pick, arrow to the place, crosses for the turn.

    The cross at the pick has its long arm along world x; the one at the place is that cross turned by `yaw`. What
    lies outside the map is cut off.

    Raises:
        ValueError: the action is batched or not finite, or the picture is no enlarged `spec.cols` x `spec.rows`.
    """
    scale = image.shape[1] / spec.rows
    if abs(image.shape[0] - scale * spec.cols) > 0.5:
        raise ValueError(f"picture {image.shape} is not a map of {spec.cols} x {spec.rows} pixels enlarged")
    pick, place, yaw = (np.asarray(leaf, np.float64) for leaf in (action.pick, action.place, action.yaw))
    if pick.shape != (3,) or place.shape != (3,) or yaw.shape != ():
        raise ValueError(f"one action is needed, got pick {pick.shape}, place {place.shape}, yaw {yaw.shape}")
    if not np.isfinite([*pick, *place, yaw]).all():
        raise ValueError(f"the action is not finite: pick {pick}, place {place}, yaw {yaw}")
    canvas = Image.fromarray(image)
    draw = ImageDraw.Draw(canvas)
    start, end = _px_from_world(spec, pick, scale), _px_from_world(spec, place, scale)
    arm, line = max(4.0, 0.035 * image.shape[1]), max(1, round(image.shape[1] / 240))
    way = end - start
    if (length := float(np.hypot(*way))) > arm:
        along = way / length
        across = np.array([-along[1], along[0]])
        draw.line([*(start + 0.5 * arm * along), *end], fill=PLACE, width=line)
        back = end - 0.4 * arm * along
        draw.polygon([tuple(end), tuple(back + 0.2 * arm * across), tuple(back - 0.2 * arm * across)], fill=PLACE)
    draw.ellipse([*(start - 0.5 * arm), *(start + 0.5 * arm)], outline=PICK, width=line)
    _cross(draw, start, 0.0, arm, PICK, line)
    _cross(draw, end, float(yaw), arm, PLACE, line)
    return np.asarray(canvas)


# Pages


def step_panel(
    current_views: types.Views,
    goal_views: types.Views,
    current_map: types.TopDownMap,
    goal_map: types.TopDownMap,
    pick_logits,
    place_logits,
    action: types.PickPlace,
    spec: types.MapSpec,
    caption: str,
    *,
    width: int = 1280,
) -> np.ndarray:
    """Draw one decision: views now and in the goal, below them the pick heat now and the place heat on the goal map.

    Args:
        pick_logits: `[rows, cols]`.
        place_logits: `[k, rows, cols]`, bin b turning the object by `2 pi b / k`; drawn as the best over k.
        caption: the first line above the picture.
        width: of the picture, pixels.
    """
    half = (width - GAP) // 2
    place_logits = np.asarray(place_logits, np.float32)
    if place_logits.ndim != 3:
        raise ValueError(f"place_logits must be [k, rows, cols], got {place_logits.shape}")
    bins = place_logits.max((1, 2))
    now, goal = (resize(map_image(map), half, smooth=False) for map in (current_map, goal_map))
    now = draw_action(heatmap_overlay(now, pick_logits), spec, action)
    goal = draw_action(heatmap_overlay(goal, place_logits.max(0)), spec, action)
    turn, best = math.degrees(float(action.yaw)), int(bins.argmax())
    tiles = [
        captioned(views_grid(current_views, width=half), "now"),
        captioned(views_grid(goal_views, width=half), "goal"),
        captioned(now, "pick, on the map of now"),
        captioned(goal, f"place, on the map of the goal; turn {turn:+.0f} deg, most likely bin {best} of {len(bins)}"),
    ]
    return captioned(np.concatenate([grid(tiles[:2], 2), grid(tiles[2:], 2)]), caption, size=20)


def episode_strip(
    panels, final_views: types.Views, goal_views: types.Views, caption: str, *, columns: int = 3, width: int = 640
) -> np.ndarray:
    """Put an episode's step panels, then its last and its goal views, on one page of tiles `width` pixels wide."""
    half = (width - GAP) // 2
    ends = [captioned(views_grid(views, width=half), text) for views, text in ((final_views, "at the end"), (goal_views, "goal"))]
    tiles = [resize(np.asarray(panel), width) for panel in panels] + [grid(ends, 2)]
    return captioned(grid(tiles, columns), caption, size=24)


def task_picture(
    start: types.Views, goal: types.Views, start_map: types.TopDownMap, goal_map: types.TopDownMap, caption: str
) -> np.ndarray:
    """Draw an episode's start and goal side by side: views as seen by the cameras above, maps below."""
    tiles = []
    for views, map, text in ((start, start_map, "start"), (goal, goal_map, "goal")):
        tiled = views_grid(views, width=640)
        top_down = resize(map_image(map), 640, smooth=False)
        tiles.append(captioned(np.concatenate([tiled, np.full((GAP, 640, 3), PAPER, np.uint8), top_down]), text))
    return captioned(grid(tiles, 2), caption, size=20)
