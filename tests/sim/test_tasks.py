"""Tasks: scenes are pure, free, reachable and at rest; the geometry agrees with points sampled inside the boxes."""

from __future__ import annotations

import dataclasses
import zlib

import hypothesis
import jax
import numpy as np
import pytest
from hypothesis import strategies as st
from test_augment import closest

from lala_jax.perception import transforms
from lala_jax.sim import render, robot, tasks
from lala_jax.sim import scene as scenes
from lala_jax.sim.tasks import base, geometry, pallet, tower

SEEDS = range(12)
DISTRACTED = [name for name in tasks.names() if type(tasks.get(name)).build_distractors is not base.Task.build_distractors]


def yaw_matrix(pose):
    """World from body of an upright pose, from its quaternion's half angle."""
    angle = 2 * np.arctan2(pose[6], pose[3])
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def edge_points(pose, size):
    """World xy points along the outline of an upright box: the nearest points of disjoint boxes are on outlines."""
    points = footprint_points(pose, size)
    local = np.abs((points - pose[:2]) @ yaw_matrix(pose)) / size[:2]
    return points[local.max(-1) > 0.4999]


def footprint_points(pose, size, n=25):
    """A grid of world xy points that fills the footprint of an upright box, its edges included."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, n)] * 2), -1).reshape(-1, 2) * size[:2]
    return grid @ yaw_matrix(pose).T + pose[:2]


def holds(pose, size, xy):
    return (np.abs((xy - pose[:2]) @ yaw_matrix(pose)) <= size[:2] / 2 + 1e-9).all(-1)


@pytest.mark.parametrize("name", tasks.names())
def test_sample_is_a_pure_function_of_the_seed(name):
    once, again, other = tasks.get(name).sample(7), tasks.get(name).sample(7), tasks.get(name).sample(8)
    jax.tree.map(np.testing.assert_array_equal, once, again)
    assert not np.array_equal(once.start, other.start)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(once))
    assert once.start.shape == once.goal.shape == (tasks.get(name).num_objects, 7)


@pytest.mark.parametrize("name", tasks.names())
@pytest.mark.parametrize("seed", SEEDS)
def test_start_poses_are_free_at_rest_and_reachable(name, seed):
    task = tasks.get(name)
    scene = task.sample(seed)
    boxes = [*zip(scene.start, scene.size, strict=True), (scene.base, np.array(task.base_size))]
    points = [edge_points(*box) for box in boxes]
    for i, (pose, size) in enumerate(boxes[:-1]):
        assert pose[2] == pytest.approx(size[2] / 2)
        assert (points[i] >= [0.25, -0.5]).all() and (points[i] <= [0.75, 0.5]).all()
        tip = [*pose[:2], size[2]]
        assert robot.tip_joints(tip, 0.0, robot.HOME) is not None
        assert robot.tip_joints([*pose[:2], size[2] + 0.32], 0.0, robot.HOME) is not None
        for j in range(i):
            distance = np.linalg.norm(points[i][:, None] - points[j], axis=-1).min()
            assert distance >= 0.015 - 1e-6
        assert np.linalg.norm(points[i][:, None] - points[-1], axis=-1).min() >= 0.015 - 1e-6
    for pose, size in zip(scene.goal, scene.size, strict=True):
        assert robot.reachable([*pose[:2], pose[2] + size[2] / 2 + 0.08])


@pytest.mark.parametrize("name", tasks.names())
@pytest.mark.parametrize("seed", SEEDS)
def test_supports_agree_with_points_under_each_box(name, seed):
    task = tasks.get(name)
    scene = task.sample(seed)
    for i, row in enumerate(task.supports(scene)):
        below = footprint_points(scene.goal[i], scene.size[i] - np.float32(2e-4), n=60)
        level = scene.goal[i, 2] - scene.size[i, 2] / 2
        under = [
            bool(holds(p, s, below).any()) and abs(p[2] + s[2] / 2 - level) < 1e-4 for p, s in zip(scene.goal, scene.size, strict=True)
        ]
        np.testing.assert_array_equal(row, under)


@pytest.mark.parametrize("count", [1, 3, 5, 6])
def test_a_tower_stands_on_its_stand_block_on_block(count):
    task = tasks.get("tower", num_objects=count)
    scene = task.sample(3)
    bottoms, tops = scene.goal[:, 2] - scene.size[:, 2] / 2, scene.goal[:, 2] + scene.size[:, 2] / 2
    np.testing.assert_allclose(bottoms, [0.005, *tops[:-1]], atol=1e-6)
    np.testing.assert_allclose(scene.goal[:, [0, 1, 3, 6]], np.tile(scene.base[[0, 1, 3, 6]], (count, 1)), atol=1e-6)
    assert scene.base[2] == pytest.approx(0.0025)
    assert len(np.unique(scene.color, axis=0)) == count
    np.testing.assert_allclose(scene.size, 0.04)
    np.testing.assert_allclose(task.object_mass(scene), 0.01, rtol=1e-5)
    assert task.budget == count + 1 and dataclasses.replace(task, max_actions=9).budget == 9
    assert dataclasses.replace(task, num_objects=6).budget == 7


def test_tower_edges_may_be_sampled():
    sizes = np.stack([tasks.get("tower", edge=(0.03, 0.045)).sample(seed).size for seed in range(8)])
    assert sizes.min() >= 0.03 - 1e-6 and sizes.max() <= 0.045 + 1e-6 and np.ptp(sizes) > 0.01
    assert (sizes[..., :1] == sizes).all()


def test_only_the_paper_palette_has_brown():
    def brown(colors):
        scenes = [tasks.get("tower", colors=colors).sample(seed) for seed in range(30)]
        return any(base.color_name(rgb) == "brown" for scene in scenes for rgb in scene.color)

    assert brown("paper") and not brown("code")


def test_tower_sentence_names_the_blocks_bottom_to_top():
    task = tasks.get("tower", num_objects=2, distractors=1)
    scene = task.sample(0).replace(color=np.array([[78, 121, 167], [255, 255, 255], [89, 169, 79]]) / 255)
    assert task.sentence(scene) == "make the tower with blue, white blocks"


@pytest.mark.parametrize("seed", range(40))
def test_pallet_boxes_are_two_layers_of_four_with_gaps(seed):
    task = tasks.get("pallet")
    scene = task.sample(seed)
    low, high = scene.goal[:, :3] - scene.size / 2, scene.goal[:, :3] + scene.size / 2
    assert (scene.goal[:, 3:] == [1, 0, 0, 0]).all()
    np.testing.assert_allclose(sorted(low[:, 2]), [0.0388] * 4 + [0.0888] * 4, atol=1e-6)
    np.testing.assert_allclose(scene.size[:, 2], 0.05, atol=1e-6)
    assert (scene.size[:, :2] >= 0.045 - 1e-6).all()
    for layer in (low[:, 2] < 0.06, low[:, 2] > 0.06):
        np.testing.assert_allclose([low[layer, 0].min(), high[layer, 0].max()], [0.425, 0.575], atol=1e-6)
        np.testing.assert_allclose([low[layer, 1].min(), high[layer, 1].max()], [0.175, 0.325], atol=1e-6)
        for i in np.flatnonzero(layer):
            for j in np.flatnonzero(layer)[np.flatnonzero(layer) < i]:
                apart = np.maximum(low[i, :2] - high[j, :2], low[j, :2] - high[i, :2]).max()
                assert apart >= 0.01 - 1e-6
        # Boxes and half of the gaps around them fill the layer.
        inner_low = low[layer, :2] - 0.005 * (low[layer, :2] > [0.43, 0.18])
        inner_high = high[layer, :2] + 0.005 * (high[layer, :2] < [0.57, 0.32])
        assert np.prod(inner_high - inner_low, axis=-1).sum() == pytest.approx(0.15**2, abs=1e-6)
    assert (scene.start[:, 1] < 0).all()
    assert len(np.unique(scene.color, axis=0)) == 8
    np.testing.assert_allclose(scene.base[2] + task.base_size[2] / 2, 0.0388, atol=1e-6)
    assert task.budget == 12
    square = np.abs(scene.size[:, 0] - scene.size[:, 1]) < 0.001
    np.testing.assert_allclose(scene.symmetry, np.where(square, np.pi / 2, np.pi), rtol=1e-6)


def test_pallet_colours_may_repeat():
    scenes = [tasks.get("pallet", distinct_colors=False).sample(seed) for seed in range(10)]
    assert min(len(np.unique(scene.color, axis=0)) for scene in scenes) < 8


def test_a_split_uses_the_random_numbers_it_is_given():
    splits = [np.concatenate(pallet.split(np.random.default_rng(s), np.zeros(3), np.array([0.15, 0.15, 0.1]))) for s in (0, 0, 1)]
    np.testing.assert_array_equal(splits[0], splits[1])
    assert not np.array_equal(splits[0], splits[2])


def random_box(rng):
    """A box of any orientation: the sum of its edges' endpoints fills its footprint."""
    quat = rng.normal(size=4)
    return np.concatenate([rng.uniform(-0.1, 0.1, 3), quat / np.linalg.norm(quat)]), rng.uniform(0.02, 0.1, 3)


def test_matrix_is_the_shared_one():
    poses = np.random.default_rng(0).normal(size=(5, 4, 7))
    np.testing.assert_allclose(geometry.matrix(poses), transforms.matrix_from_quat(poses[..., 3:]), atol=1e-12)


@hypothesis.settings(max_examples=30, deadline=None, derandomize=True)
@hypothesis.given(st.integers(0, 10_000))
def test_gap_agrees_with_points_on_the_boxes(seed):
    rng = np.random.default_rng(seed)
    boxes = [random_box(rng), random_box(rng)]
    clouds = []
    for pose, size in boxes:
        corners = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 7)] * 3), -1).reshape(-1, 3) * size
        clouds.append((corners @ geometry.matrix(pose).T)[:, :2] + pose[:2])
    gap = geometry.gap(boxes[0][0], boxes[0][1], boxes[1][0], boxes[1][1])
    nearest = np.linalg.norm(clouds[0][:, None] - clouds[1], axis=-1).min()
    assert gap <= nearest + 1e-9  # never claims more room than there is
    # The direction of the true separation, by brute force over 720 axes: positive for disjoint convex shapes, negative otherwise.
    angle = np.linspace(0, np.pi, 720)
    axes = np.stack([np.cos(angle), np.sin(angle)])
    a, b = clouds[0] @ axes, clouds[1] @ axes
    brute = np.maximum(a.min(0) - b.max(0), b.min(0) - a.max(0)).max()
    if abs(brute) > 1e-3:
        assert np.sign(gap) == np.sign(brute)


def test_no_free_pose_names_the_object_the_tries_and_the_area():
    area = base.Area((0.3, 0.5), (-0.1, 0.1), 0.3)
    size = np.full((9, 3), 0.08)
    with pytest.raises(base.NoFreePose, match=r"object \d of size \[0.08, 0.08, 0.08\] after 20 attempts of 128 tries in x \(0.3, 0.5\)"):
        base.free_poses(np.random.default_rng(0), size, area, order=np.arange(9), others=np.zeros((0, 7)), other_size=np.zeros((0, 3)))


def test_an_area_out_of_reach_has_no_free_pose():
    area = base.Area((0.7, 0.75), (0.4, 0.5), 0.5)
    assert base.free_pose(np.random.default_rng(0), np.full(3, 0.02), area, np.zeros((0, 7)), np.zeros((0, 3))) is None


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("towers", {}, "unknown task 'towers', choose one of .*pallet, .*tower"),
        ("tower", {"size": 3}, "no option size; its options are colors, distractors, edge, max_actions, num_objects"),
        ("tower", {"num_objects": -2}, "num_objects=-2 must be at least 1"),
        ("tower", {"num_objects": 7}, "num_objects=7 is not one of 1..6"),
        ("tower", {"edge": (0.05, 0.04)}, "edge="),
        ("tower", {"colors": "loud"}, r"colors='loud' is not one of \['code', 'paper', 'uniform'\]"),
        ("tower", {"distractors": -1}, r"distractors=-1 is not one of 0\.\.6"),
        ("pallet", {"distractors": 3, "colors": "code"}, r"distractors=3 is not one of 0\.\.2"),
        ("tower", {"max_actions": 0}, "max_actions=0 must be at least 1"),
        ("pallet", {"num_objects": 3}, "num_objects=3 is not 8"),
    ],
)
def test_mistakes_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        tasks.get(name, **options)


def checksum(scene, count):
    """A checksum of all bytes of the first `count` objects and the base."""
    leaves = {field.name: getattr(scene, field.name) for field in dataclasses.fields(scene)}
    return zlib.crc32(b"".join((leaf if name == "base" else leaf[:count]).tobytes() for name, leaf in leaves.items()))


@pytest.mark.parametrize("distractors", [0, 2])
@pytest.mark.parametrize(
    ("name", "seed", "recorded"),
    [
        *[("tower", 0, 387708376), ("tower", 7, 1236221978), ("tower", 123, 547313063)],
        *[("pallet", 0, 198046820), ("pallet", 7, 196761938), ("pallet", 123, 1432080776)],
    ],
)
def test_scenes_are_what_they_were_before_there_were_distractors(name, seed, recorded, distractors):
    task = tasks.get(name, distractors=distractors)
    assert checksum(task.sample(seed), task.num_objects) == recorded


@pytest.mark.parametrize("name", DISTRACTED)
@pytest.mark.parametrize("seed", SEEDS)
def test_distractors_lie_free_on_the_table_and_are_told_from_the_others(name, seed):
    task = tasks.get(name, distractors=2)
    scene, count = task.sample(seed), task.num_objects
    assert all(
        len(leaf) == count + 2 for leaf in (scene.size, scene.color, scene.start, scene.goal, scene.symmetry, task.object_mass(scene))
    )
    assert (scene.goal[:count, 2] > 0).all() and (scene.goal[count:, 2] + scene.size[count:, 2] < 0).all()
    assert len(np.unique(scene.color, axis=0)) == count + 2
    assert not task.supports(scene)[count:].any() and not task.supports(scene)[:, count:].any()
    clouds = [edge_points(*box) for box in [*zip(scene.start, scene.size, strict=True), (scene.base, np.array(task.base_size))]]
    for i in range(count, count + 2):
        assert scene.start[i, 2] == pytest.approx(scene.size[i, 2] / 2)
        for cloud in [*clouds[:i], *clouds[i + 1 :]]:
            assert np.linalg.norm(clouds[i][:, None] - cloud, axis=-1).min() >= 0.015 - 1e-6
    if name == "tower":
        np.testing.assert_allclose(scene.size, 0.04)
    elif name == "pallet":
        sides = scene.size[count:, :2]
        assert (sides >= 0.05).all() and (sides <= 0.09).all() and (scene.start[:, 1] < 0).all()
        np.testing.assert_allclose(scene.size[count:, 2], 0.05)
    assert task.budget == tasks.get(name).budget


@pytest.mark.parametrize("preset", sorted(scenes.PRESETS))
@pytest.mark.parametrize("name", DISTRACTED)
def test_no_camera_sees_a_distractor_in_the_goal_picture(name, preset):
    task = tasks.get(name, distractors=2)
    scene, camera = task.sample(4), scenes.cameras(preset, height=120, width=160)
    template = scenes.geom_template(task)
    geoms = np.array(scenes.object_geoms(template[0]))
    for poses, shown in ((scene.start, 2), (scene.goal, 0)):
        placed = scenes.place(*template, size=scene.size, color=scene.color, poses=poses, base=scene.base)
        seen = np.asarray(render.render(*placed, camera, segmentation=True).segmentation)
        assert seen.shape[0] == len(camera.intrinsics)
        assert len(set(geoms[-2:]) & set(np.unique(seen))) == shown
        assert set(geoms[-3:-2]) <= set(np.unique(seen))


@pytest.mark.parametrize("name", DISTRACTED)
def test_uniform_colours_are_as_far_apart_as_the_palette_and_are_not_in_it(name):
    paper = np.array(list(base.COLORS.values())) / 255
    least = closest(paper)
    task = tasks.get(name, colors="uniform", distractors=2)
    drawn = np.stack([task.sample(seed).color for seed in range(40)])
    for color in drawn:
        assert closest(color) >= least - 1e-6
    alone = dataclasses.replace(task, distractors=0)
    np.testing.assert_array_equal(alone.sample(3).color, drawn[3, : task.num_objects])
    assert drawn.min() >= 0 and drawn.max() <= 1
    assert np.abs(drawn.mean((0, 1)) - 0.5).max() < 0.08 and drawn.min((0, 1)).max() < 0.05 and drawn.max((0, 1)).min() > 0.95
    assert np.linalg.norm(drawn[:, :, None] - paper, axis=-1).min(-1).mean() > 0.15


def test_too_many_colours_too_far_apart_are_refused():
    with pytest.raises(ValueError, match="no colour 1.500 away from 1 others in 1000 draws: 1 of 3 found"):
        base.uniform_colors(np.random.default_rng(0), 3, taken=np.zeros((0, 3)), apart=1.5)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed=-1"):
        tasks.get("tower").sample(-1)


@dataclasses.dataclass(frozen=True)
class Own(tower.TowerTask):
    """A task that somebody wrote, with one leaf of its scenes wrong."""

    wrong: tuple = ()  # a leaf's name, and what becomes of it

    def build(self, rng):
        scene = super().build(rng)
        return scene.replace(**{name: change(np.asarray(getattr(scene, name))) for name, change in self.wrong})


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("symmetry", lambda leaf: leaf[0], r"a scene's symmetry must be finite and of shape \(5,\), got \(\)"),
        ("base", lambda leaf: leaf[None], r"a scene's base must be finite and of shape \(7,\), got \(1, 7\)"),
        ("goal", lambda leaf: leaf[:-1], r"a scene's goal must be finite and of shape \(5, 7\), got \(4, 7\)"),
        ("color", lambda leaf: leaf * np.nan, "a scene's color must be finite"),
        ("color", lambda leaf: leaf * 255, r"a scene's color must be RGB in 0\.\.1, got .* to 2\d\d"),
        ("symmetry", np.rad2deg, r"a scene's symmetry must be radians above 0 and at most 2 pi, got 90 to 90"),
        ("symmetry", np.zeros_like, r"a scene's symmetry must be .* got 0 to 0"),
        ("start", lambda leaf: leaf * 2, r"a scene's start must hold x, y, z and a unit quaternion .*, got one of length 2"),
        ("goal", lambda leaf: leaf[:, [0, 1, 2, 4, 5, 6, 3]], "a scene's goal must stand upright, turned about z alone"),
        ("base", lambda leaf: leaf * 0, "a scene's base must hold .*, got one of length 0"),
        ("size", lambda leaf: leaf * [1, 1, 0.45], r"objects must be at least 0.02 m high, .* got 0.0180"),
    ],
)
def test_scenes_of_an_own_task_are_looked_at(name, change, message):
    with pytest.raises(ValueError, match=f"task tower: {message}"):
        Own(wrong=((name, change),)).sample(0)
    Own(wrong=(("size", lambda leaf: leaf * [1, 1, 0.5]),)).sample(0)


def test_an_own_task_says_what_it_lacks(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Own, "base_color", (156, 117, 95))
        with pytest.raises(ValueError, match=r"task tower: base_color must be RGB in 0\.\.1, got \(156, 117, 95\)"):
            Own().sample(0)
    with monkeypatch.context() as patch:
        patch.setattr(tower.TowerTask, "build_distractors", base.Task.build_distractors)
        with pytest.raises(ValueError, match="task tower has no build_distractors: without one it needs distractors=0, got 2"):
            Own(distractors=2)
    monkeypatch.setattr(Own, "build", lambda self, rng: None)
    with pytest.raises(ValueError, match="task tower: build must return a types.Scene, got NoneType"):
        Own().sample(0)


def test_masses_of_an_own_task_are_counted(monkeypatch):
    monkeypatch.setattr(tower.TowerTask, "object_mass", lambda self, scene: np.full(self.num_objects, 0.01))
    task = tasks.get("tower", distractors=2)
    with pytest.raises(ValueError, match=r"object_mass must give one mass for each of 7 objects, got shape \(5,\)"):
        scenes.build_spec(task, task.sample(0))


def test_the_canvas_needs_no_room_in_the_first_scene(monkeypatch):
    task, sample = tasks.get("tower", num_objects=2, colors="code"), tower.TowerTask.sample

    def crowded(self, seed):
        if seed < 3:
            raise base.NoFreePose("full")
        return sample(self, seed)

    monkeypatch.setattr(tower.TowerTask, "sample", crowded)
    assert len(scenes.object_geoms(scenes.geom_template(task)[0])) == 2
    monkeypatch.setattr(scenes, "TRIES", 2)
    with pytest.raises(base.NoFreePose, match="none of the first 2 scenes has a free pose for every object"):
        scenes.geom_template(dataclasses.replace(task, max_actions=9))
