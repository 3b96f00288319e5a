"""The pictures: orientation against single coloured cells, composition by size, bad input by message."""

import math
import types as python_types

import jax
import numpy as np
import pytest

from lala_jax import pictures, policy, report, types

SPEC = types.MapSpec(cell=0.0125, slices=7)  # 80 x 40 cells of 4 cm slices
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def views(count=4, height=24, width=32, color=RED):
    rgb = np.ones((count, height, width, 3), np.float32) * np.asarray(color, np.float32)
    return python_types.SimpleNamespace(rgb=rgb, depth=np.ones((count, height, width), np.float32), camera=None, segmentation=None)


def empty_map(channels=3):
    """A map in which nothing was seen, to be written to."""
    return jax.tree.map(np.array, policy.empty_map(SPEC, features=channels))


def action(pick=(0.4, -0.2, 0.04), place=(0.6, 0.3, 0.1), yaw=0.5):
    return types.PickPlace(pick=np.array(pick, np.float32), place=np.array(place, np.float32), yaw=np.float32(yaw))


def differs(before, after):
    """Rows and columns (v, u) of the pixels that changed."""
    return np.argwhere((before != after).any(-1))


def test_to_uint8():
    image = np.array([[[-0.5, 0.0, 0.5], [0.999, 1.0, 7.0]]], np.float32)
    assert pictures.to_uint8(image).tolist() == [[[0, 0, 128], [255, 255, 255]]]
    whole = np.array([[[1, 2, 3]]], np.uint8)
    assert pictures.to_uint8(whole) is whole
    with pytest.raises(ValueError, match="1 NaN"):
        pictures.to_uint8(np.array([[[0.0, np.nan, 0.0]]]))
    with pytest.raises(ValueError, match="int32"):
        pictures.to_uint8(np.zeros((2, 2, 3), np.int32))


@pytest.mark.parametrize("count, tiles", [(1, (1, 1)), (2, (1, 2)), (3, (2, 2)), (4, (2, 2)), (7, (3, 3))])
def test_views_grid_shows_every_view_once(count, tiles):
    seen = views(count)
    seen.rgb[:] = (np.arange(count, dtype=np.float32) / 10)[:, None, None, None]
    picture = pictures.views_grid(seen)
    assert picture.shape == (tiles[0] * 26 - 2, tiles[1] * 34 - 2, 3) and picture.dtype == np.uint8
    for i in range(count):
        assert (picture == round(i / 10 * 255)).all(-1).sum() == 24 * 32


def test_views_grid_refuses_batches():
    batched = views()
    batched.rgb = batched.rgb[None]
    with pytest.raises(ValueError, match=r"\(1, 4, 24, 32, 3\)"):
        pictures.views_grid(batched)


@pytest.mark.parametrize(
    "xy, corner",
    [((0.75, 0.5), (0, 0)), ((0.75, -0.5), (0, -1)), ((0.25, 0.5), (-1, 0)), ((0.25, -0.5), (-1, -1))],
    ids=["far left", "far right", "near left", "near right"],
)
def test_map_is_seen_from_behind_the_robot(xy, corner):
    row, col = (0 if xy[1] < 0 else SPEC.rows - 1), (0 if xy[0] < 0.5 else SPEC.cols - 1)
    map = empty_map()
    map.features[row, col, 2], map.count[row, col, 2] = RED, 1.0
    picture = pictures.map_image(map)
    assert picture.shape == (SPEC.cols, SPEC.rows, 3)
    assert picture[corner].tolist() == [255, 0, 0]
    assert (picture == pictures.EMPTY).all(-1).sum() == SPEC.rows * SPEC.cols - 1


def test_map_image_shows_the_highest_voxel_only():
    map = empty_map(channels=5)
    map.features[10, 20, 1, :3], map.features[10, 20, 5, :3] = RED, BLUE
    map.count[10, 20, [1, 5]] = 3.0
    map.features[10, 20, 6, :3] = 1.0  # no count: never seen
    assert pictures.map_image(map)[SPEC.cols - 1 - 20, SPEC.rows - 1 - 10].tolist() == [0, 0, 255]


@pytest.mark.parametrize("scale", [1, 3])
def test_px_from_cell_agrees_with_from_behind(scale):
    rng = np.random.default_rng(0)
    for row, col in rng.integers((SPEC.rows, SPEC.cols), size=(20, 2)):
        marked = np.zeros((SPEC.rows, SPEC.cols))
        marked[row, col] = 1.0
        picture = np.kron(pictures.from_behind(marked), np.ones((scale, scale)))
        u, v = pictures.px_from_cell(SPEC, np.array([row + 0.5, col + 0.5]), scale=scale)
        v_all, u_all = np.nonzero(picture)
        assert (u_all + 0.5).mean() == pytest.approx(u) and (v_all + 0.5).mean() == pytest.approx(v)


@pytest.mark.parametrize("scale", [1, 4])
def test_heat_lies_where_the_logit_is(scale):
    logits = np.full((SPEC.rows, SPEC.cols), -np.inf, np.float32)
    logits[10, 30] = 3.0
    image = np.full((SPEC.cols * scale, SPEC.rows * scale, 3), 100, np.uint8)
    changed = differs(image, pictures.heatmap_overlay(image, logits))
    assert len(changed) == scale**2
    u, v = pictures.px_from_cell(SPEC, np.array([10.5, 30.5]), scale=scale)
    np.testing.assert_allclose(changed.mean(0) + 0.5, (v, u))


def test_heat_refuses_bad_logits():
    image = np.zeros((SPEC.cols, SPEC.rows, 3), np.uint8)
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="NaN, "):
            pictures.heatmap_overlay(image, np.full((SPEC.rows, SPEC.cols), bad, np.float32))
    with pytest.raises(ValueError, match=r"\(40, 80\)"):
        pictures.heatmap_overlay(image, np.zeros((SPEC.cols, SPEC.rows), np.float32))


def test_action_is_drawn_at_its_cells():
    image = np.zeros((SPEC.cols * 8, SPEC.rows * 8, 3), np.uint8)
    drawn = pictures.draw_action(image, SPEC, action(yaw=0.0))
    assert not image.any(), "the input picture must stay as it was"
    for color, (x, y) in ((pictures.PICK, (0.4, -0.2)), (pictures.PLACE, (0.6, 0.3))):
        centre = np.array([(0.75 - x) / 0.5 * image.shape[0], (0.5 - y) / 1.0 * image.shape[1]])  # v, u
        found = np.argwhere((drawn == color).all(-1))
        assert np.linalg.norm(found - centre, axis=1).min() < 3.0
    circle = np.argwhere((drawn == pictures.PICK).all(-1))
    assert abs((circle[:, 1].min() + circle[:, 1].max()) / 2 - 0.7 * image.shape[1]) < 2.0


@pytest.mark.parametrize("yaw, tip", [(0.0, (-1, 0)), (math.pi / 2, (0, -1)), (math.pi, (1, 0)), (-math.pi / 2, (0, 1))])
def test_turned_cross_points_along_the_turned_x_axis(yaw, tip):
    image = np.zeros((SPEC.cols * 8, SPEC.rows * 8, 3), np.uint8)
    still = action(pick=(0.5, 0.0, 0.0), place=(0.5, 0.0, 0.0), yaw=yaw)
    changed = np.argwhere((pictures.draw_action(image, SPEC, still) == pictures.PLACE).all(-1)) - np.array([160, 320])
    farthest = changed[np.linalg.norm(changed, axis=1).argmax()]
    assert farthest @ np.array(tip) > 0.9 * np.linalg.norm(farthest) > 10


def test_action_outside_the_map_is_cut_off():
    image = np.zeros((SPEC.cols * 2, SPEC.rows * 2, 3), np.uint8)
    pictures.draw_action(image, SPEC, action(place=(2.0, -3.0, 0.0)))


@pytest.mark.parametrize(
    "bad, message",
    [(action(pick=(np.nan, 0, 0)), "not finite"), (action(yaw=np.inf), "not finite"), (action(place=np.zeros((2, 3))), r"\(2, 3\)")],
)
def test_draw_action_refuses(bad, message):
    with pytest.raises(ValueError, match=message):
        pictures.draw_action(np.zeros((SPEC.cols, SPEC.rows, 3), np.uint8), SPEC, bad)


def test_draw_action_refuses_another_maps_picture():
    with pytest.raises(ValueError, match="40 x 80"):
        pictures.draw_action(np.zeros((SPEC.rows, SPEC.cols, 3), np.uint8), SPEC, action())


def test_panel_and_strip_show_all_parts():
    rng = np.random.default_rng(0)
    pick, place = rng.normal(size=(SPEC.rows, SPEC.cols)), rng.normal(size=(6, SPEC.rows, SPEC.cols))
    now, goal = views(color=RED), views(color=BLUE)
    panel = pictures.step_panel(now, goal, empty_map(), empty_map(), pick, place, action(), SPEC, "step 1", width=640)
    assert panel.dtype == np.uint8 and panel.shape[1] == 640
    odd = pictures.step_panel(now, goal, empty_map(), empty_map(), pick, place, action(), SPEC, "step 1", width=650)
    assert odd.shape[1] == 650  # a half of 323 pixels, whose map is 161.5 high
    left, right = panel[:, :318], panel[:, 322:]
    assert (left == (255, 0, 0)).all(-1).sum() == (right == (0, 0, 255)).all(-1).sum() > 60_000
    assert not (left == (0, 0, 255)).all(-1).any()
    assert (left == pictures.PICK).all(-1).any() and (right == pictures.PLACE).all(-1).any()
    for panels in ([], [panel], [panel] * 5):
        strip = pictures.episode_strip(panels, now, goal, "episode 1", width=320)
        assert strip.shape[1] == min(3, len(panels) + 1) * 324 - 4
    with pytest.raises(ValueError, match="place_logits"):
        pictures.step_panel(now, goal, empty_map(), empty_map(), pick, pick, action(), SPEC, "step 1")


def test_caption_is_wrapped_not_cut():
    image = np.zeros((10, 200, 3), np.uint8)
    short, long = pictures.captioned(image, "one"), pictures.captioned(image, "many words " * 12)
    assert short.shape[1] == long.shape[1] == 200
    assert long.shape[0] > short.shape[0] > 10
    assert (long[-10:] == 0).all()


@pytest.mark.slow
def test_draws_the_tasks(tmp_path):
    report.main([f"--out={tmp_path}"])
    assert (tmp_path / "tasks.webp").stat().st_size > 5_000
