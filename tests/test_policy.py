"""What policies share, and the paper's, on scenes fused from the boxes' own surfaces: what is asked is drawn right, actions are sane."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_scoring import drawn_params
from test_train_step import tiny_config

from lala_jax import build, options, policy, policy_goal_aware, policy_graph, policy_transporter, types
from lala_jax.models import goal_aware, transporter
from lala_jax.perception import topdown, transforms
from lala_jax.sim import oracle, tasks

SPEC = types.MapSpec(cell=0.0125)  # 80 x 40 cells
TABLE = 0.2
ROTATIONS = 12
GOAL_AWARE = goal_aware.GoalAware(
    spec=SPEC, rotations=ROTATIONS, crop=8, tokens=96, embed=8, trunk_width=8, trunk_blocks=1, fine_width=8, channels=3
)
POLICIES = {"goal_aware": policy_goal_aware.GoalAwarePolicy(model=GOAL_AWARE)} | {
    variant: policy_transporter.TransporterPolicy(
        model=transporter.Transporter(variant=variant, yaw_bins=ROTATIONS, crop=8, channels=2, width=4, stages=2), spec=SPEC
    )
    for variant in transporter.VARIANTS
}


def state_of(seed, *, objects=2, done=0, sides=None):
    """A tower scene with its first `done` cubes placed; the others have `sides` (metres) in x and y if given, and fit one way."""
    task = tasks.get("tower", num_objects=objects)
    scene = task.sample(seed)
    poses = np.where(np.arange(objects)[:, None] < done, scene.goal, scene.start)
    fields = {field: getattr(scene, field) for field in ("size", "color", "base", "goal", "symmetry")}
    placed, ready = oracle.placed(task, scene, poses), oracle.ready(task, scene, poses)
    assert placed.sum() == done and ready.sum() == (done < objects)
    if sides is not None:
        fields["size"] = np.where(np.arange(objects)[:, None] < done, scene.size, [*sides, scene.size[0, 2]])
        fields["symmetry"] = np.where(np.arange(objects) < done, scene.symmetry, math.pi)
    return jax.tree.map(jnp.asarray, types.State(**fields, poses=poses, placed=placed, ready=ready))


fuse = jax.jit(functools.partial(topdown.fuse, spec=SPEC))


def map_of(state, poses):
    """Fuse points on the tops and sides of the cubes, and on the table, into a map: no renderer, nothing hides anything."""
    face = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 15), np.linspace(-0.5, 0.5, 15), indexing="ij"), -1).reshape(-1, 2)
    local = [np.insert(face, axis, side, axis=1) for axis, side in ((2, 0.5), (0, 0.5), (0, -0.5), (1, 0.5), (1, -0.5))]
    local = np.concatenate(local)
    points = [
        transforms.apply_pose(np.asarray(pose, float), local * np.asarray(size)) for pose, size in zip(poses, state.size, strict=True)
    ]
    colors = [np.broadcast_to(color, local.shape) for color in np.asarray(state.color)]
    cells = np.stack(np.meshgrid(np.arange(SPEC.rows), np.arange(SPEC.cols), indexing="ij"), -1).reshape(-1, 2)
    points.append(np.column_stack([np.asarray(types.world_from_index(SPEC, cells)), np.zeros(len(cells))]))
    colors.append(np.full((len(cells), 3), TABLE))
    points, colors = np.concatenate(points).astype(np.float32), np.concatenate(colors).astype(np.float32)
    return fuse(jnp.asarray(points), jnp.asarray(colors), jnp.ones(len(points), bool))


def example(seed, **options):
    state = state_of(seed, **options)
    return state, map_of(state, state.poses), map_of(state, state.goal)


draw = jax.jit(policy.draw, static_argnames=("spec", "rotations", "multi_action"))


def draws(state, candidates, *, multi_action, count=20):
    """A stack of samples."""
    keys = jax.random.split(jax.random.key(1), count)
    options = {"spec": SPEC, "rotations": ROTATIONS, "candidates": jnp.asarray(candidates), "multi_action": multi_action}
    return jax.device_get([draw(key, state, **options) for key in keys])


def test_draw_takes_only_candidates():
    """Every unplaced object gets its turn, a placed one never; the cell is on its top face, away from the edge."""
    state = state_of(0, objects=3, done=1)
    seen = set()
    for sample in draws(state, ~np.asarray(state.placed), multi_action=True):
        seen.add(int(sample.index))
        assert sample.drawn
        local = transforms.apply_pose(
            transforms.pose_inverse(np.asarray(state.poses[sample.index], float)),
            np.array([*types.world_from_index(SPEC, sample.pick), state.poses[sample.index, 2]]),
        )
        assert np.abs(local[:2]).max() < 0.02 - 0.009 + 1e-5
    assert seen == {1, 2}
    assert {int(sample.index) for sample in draws(state, state.ready, multi_action=True)} == {1}


def test_draw_marks_the_picks_of_what_is_ready():
    """Whatever object is drawn, right picks are those of the ready one only."""
    state = state_of(0, objects=3, done=1)
    for sample in draws(state, ~np.asarray(state.placed), multi_action=True, count=4):
        cells = np.argwhere(sample.pick_valid)
        assert len(cells)
        xy = np.asarray(types.world_from_index(SPEC, cells))
        assert (np.linalg.norm(xy - np.asarray(state.poses[1, :2]), axis=-1) < 0.02).all()
        assert sample.valid.sum() == 4 and len(set(sample.bins[sample.valid].tolist())) == 4


def test_draw_teaches_picks_about_the_middle_of_a_face():
    """What is taught is some of what is right, near the ready object's middle; the drawn pick may be anywhere that is right."""
    state = state_of(0, objects=3, done=1, sides=(0.07, 0.06))
    far = 0.0
    for sample in draws(state, ~np.asarray(state.placed), multi_action=True):
        assert sample.pick_best.any() and not (sample.pick_best & ~sample.pick_valid).any()
        assert sample.pick_best.sum() < 0.6 * sample.pick_valid.sum()
        cells = np.argwhere(sample.pick_best)
        points = np.column_stack([np.asarray(types.world_from_index(SPEC, cells)), np.full(len(cells), state.poses[1, 2])])
        local = transforms.apply_pose(transforms.pose_inverse(np.asarray(state.poses[1], float)), points)
        assert (np.abs(local[:, :2]) < np.maximum((np.array([0.035, 0.03]) - 0.009) * policy.MIDDLE, 0.71 * SPEC.cell) + 1e-5).all()
        middle = np.asarray(state.poses[sample.index, :2])
        far = max(far, float(np.linalg.norm(np.asarray(types.world_from_index(SPEC, sample.pick)) - middle)))
    assert far > 0.013


def test_draw_of_nothing_is_said():
    state = state_of(0, objects=3, done=1)
    for sample in draws(state, [False, False, False], multi_action=True, count=3):
        assert not sample.drawn and not sample.valid.any()


def test_one_hot_marks_no_pick_where_there_is_nothing_to_draw():
    (sample,) = draws(state_of(0, objects=3, done=1), [False, False, False], multi_action=False, count=1)
    assert not sample.drawn and not sample.pick_best.any() and not sample.pick_valid.any()


def test_one_hot_marks_one_pick_and_the_place_of_least_turn():
    state = state_of(0, objects=3, done=1)
    for sample in draws(state, state.ready, multi_action=False):
        assert np.argwhere(sample.pick_valid).tolist() == np.argwhere(sample.pick_best).tolist() == [sample.pick.tolist()]
        assert sample.valid.sum() == 1
        off = np.abs(transforms.wrap_angle(sample.place.yaw))
        middle = np.asarray(types.world_from_index(SPEC, sample.pick)) - np.asarray(state.poses[1, :2])
        assert np.linalg.norm(middle) < max(math.hypot(*2 * [policy.MIDDLE * (0.02 - 0.009)]), SPEC.cell)  # as the oracle picks
        assert off[sample.valid][0] == off.min() <= math.pi / 4 + 1e-5


def test_hits_judge_the_arg_max():
    """A map that peaks at a right pick and place is right; a centimetre and a half aside is not, nor is a turn by 60 degrees."""
    state = state_of(2)
    sample = draws(state, state.ready, multi_action=True, count=1)[0]
    grid, (bin_, (row, col)) = (ROTATIONS, SPEC.rows, SPEC.cols), (sample.bins[0], sample.cells[0])

    def judged(pick, place):
        picks, places = jnp.zeros(grid[1:]).at[tuple(pick)].set(1.0), jnp.zeros(grid).at[place].set(1.0)
        return {name: float(value) for name, value in policy.hits(sample, picks, places, spec=SPEC, rotations=ROTATIONS).items()}

    assert judged(sample.pick, (bin_, row, col)) == {"pick_right": 1, "place_right": 1, "place_near": 1}
    assert judged(sample.pick + 8, (bin_, row, col))["pick_right"] == 0
    assert judged(sample.pick, ((bin_ + 2) % ROTATIONS, row, col)) == {"pick_right": 1, "place_right": 0, "place_near": 1}
    assert judged(sample.pick, (bin_, row + 2, col))["place_near"] == 0


def check_action(agent, action, heat, current):
    """The action is finite, on the map, at the arg maxima (the refinement starts at none), at the height of what was seen there."""
    assert heat.pick.shape == (80, 40) and heat.place.shape == (ROTATIONS, 80, 40)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((action, heat)))
    row, col = np.unravel_index(np.argmax(heat.pick), heat.pick.shape)
    np.testing.assert_allclose(action.pick[:2], types.world_from_index(SPEC, np.array([row, col])), atol=1e-6)
    for point in (action.pick, action.place):
        index = np.asarray(types.index_from_world(SPEC, point[:2]))
        assert types.in_map(SPEC, index)
        near = [slice(max(0, i - 2), i + 3) for i in index]
        np.testing.assert_allclose(point[2], SPEC.z[0] + np.asarray(current.height)[tuple(near)].max(), atol=1e-6)
    assert -math.pi <= action.yaw <= math.pi
    best = np.unravel_index(np.argmax(heat.place), heat.place.shape)
    np.testing.assert_allclose(action.place[:2], types.world_from_index(SPEC, np.array(best[1:])), atol=0.3 * SPEC.cell)
    assert abs(transforms.wrap_angle(action.yaw - best[0] * 2 * math.pi / ROTATIONS)) < 0.3 * 2 * math.pi / ROTATIONS


def batched_loss(agent):
    """The mean loss of a batch, as training takes it."""

    def loss(params, keys, states, current, goal):
        losses, metrics = jax.vmap(lambda *one: agent.loss(params, *one))(keys, states, current, goal)
        return losses.mean(), jax.tree.map(jnp.nanmean, metrics)

    return loss


def batch_of(*examples):
    keys = jax.random.split(jax.random.key(2), len(examples))
    return keys, *jax.tree.map(lambda *leaves: jnp.stack(leaves), *examples)


@pytest.mark.parametrize("name", [name for name in build.MODELS if name != "cliport"])  # which test_policy_cliport builds
def test_every_model_is_built_by_its_name(name):
    agent = build.build_policy(tiny_config(f"model.name={name}"))
    kinds = {"goal_aware": policy_goal_aware.GoalAwarePolicy, "graph": policy_graph.GraphPolicy}
    kind = kinds.get(name, policy_transporter.TransporterPolicy)
    assert isinstance(agent, kind) and getattr(agent.model, "variant", name) == name
    assert set(build.MODELS) == {*POLICIES, "cliport", "graph"}


@pytest.mark.parametrize("name", list(POLICIES)[1:])
def test_transporters_lose_finitely_and_act_on_the_map(name):
    """In one program, for its compilation is what this costs."""
    agent = POLICIES[name]
    batch = batch_of(example(0), example(4, done=1))

    @jax.jit
    def everything(params, *batch):
        return batched_loss(agent)(params, *batch), jax.vmap(agent.act, (None, 0, 0))(params, *batch[2:])

    (loss, metrics), (actions, heats) = jax.device_get(everything(drawn_params(agent), *batch))
    assert np.isfinite(loss) and set(metrics) == {"loss", "loss_pick", "loss_place", "pick_right", "place_right", "place_near"}
    # about what indifference costs, no more: logits start near zero
    assert 0.3 < float(metrics["loss_pick"]) / math.log(80 * 40) < 1.5
    assert 0.3 < float(metrics["loss_place"]) / math.log(ROTATIONS * 80 * 40) < 1.5
    for index in range(2):
        check_action(agent, *jax.tree.map(lambda leaf, index=index: leaf[index], (actions, heats, batch[2])))


def test_only_slices_show_what_is_under_the_top():
    """Two goals that differ in a hidden block's colour are one max-height map, and two maps of slices."""
    state = state_of(0)
    swapped = state.replace(color=state.color.at[0].set(1 - state.color[0]))
    blunt = POLICIES["single"]
    goals = [map_of(one, one.goal) for one in (state, swapped)]
    for agent, same in ((blunt, True), (dataclasses.replace(blunt, max_height=False), False)):
        inner = [policy.picture(goal, max_height=agent.max_height)[..., :-1] for goal in goals]
        inside = np.abs(np.asarray(inner[0] - inner[1])).max(-1)
        top = types.index_from_world(SPEC, state.goal[-1, :2])
        assert (inside[tuple(top)] == 0) == same
    params = agent.init(jax.random.key(0, impl="rbg"))
    assert params["pick_net"]["difference"]["stem"]["kernel"].shape[2] == 4 * SPEC.slices + 1


def test_two_maps_are_seen_as_their_geometric_mean():
    """In their own units, cell by cell; so what lies now where the goal is bare table still shows, as it would not in a product of
    normalised maps, in which the table is about zero."""
    state, current, goal = example(0)
    pair = [np.asarray(topdown.max_height(one)) for one in (current, goal)]
    seen = np.asarray(policy.picture(current, goal, max_height=True))
    for row, col in np.ndindex(SPEC.rows, SPEC.cols):
        root = [math.sqrt(max(a * b, 0.0)) for a, b in zip(pair[0][row, col], pair[1][row, col], strict=True)]
        wanted = [(value - transporter.COLOR_MEAN) / transporter.COLOR_STD for value in root[:3]]
        wanted.append((root[3] - transporter.HEIGHT_MEAN) / transporter.HEIGHT_STD)
        np.testing.assert_allclose(seen[row, col], wanted, rtol=1e-4, atol=1e-4)
    own, bare = tuple(types.index_from_world(SPEC, state.poses[0, :2])), (0, 0)
    assert pair[1][own][3] == pair[0][bare][3] == pytest.approx(0, abs=1e-3)  # the table's height: nothing of either is there
    np.testing.assert_allclose(pair[1][own][:3], TABLE, atol=1e-3)
    assert np.abs(seen[own] - seen[bare])[:3].max() > 1
    np.testing.assert_allclose(policy.picture(current, current, max_height=True), policy.picture(current, max_height=True), atol=1e-4)
    slices = np.asarray(policy.picture(current, goal, max_height=False))
    both = np.asarray((current.count > 0) & (goal.count > 0))
    assert 0 < both.sum() < np.asarray(goal.count > 0).sum()
    np.testing.assert_array_equal(slices[..., 3:-1:4], both)
    times = np.asarray(current.features[..., :3] * goal.features[..., :3])[both]
    shown = slices[..., :-1].reshape(*both.shape, 4)[both][:, :3]
    np.testing.assert_allclose((shown * transporter.COLOR_STD + transporter.COLOR_MEAN) ** 2, times, atol=1e-5)


def test_networks_compute_in_bfloat16_where_the_config_says_so():
    config = tiny_config("model.name=two_stream", "model.max_height=true")
    half = build.build_policy(options.override(config, ["model.dtype=bfloat16"]))
    whole, spec = build.build_policy(config), build.map_spec(config)
    params = jax.jit(half.init)(jax.random.key(0, impl="rbg"))
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    color = jax.random.uniform(jax.random.key(1), (spec.rows, spec.cols, spec.slices, 3))
    shown = policy.empty_map(spec).replace(features=color, count=jnp.ones(color.shape[:3]))
    found, want = (jax.jit(agent.act)(params, shown, policy.empty_map(spec))[1] for agent in (half, whole))
    for mine, exact in ((found.pick, want.pick), (found.place, want.place)):
        assert mine.dtype == jnp.float32
        assert 0 < jnp.abs(mine - exact).max() < 0.05 * exact.std() + 0.02 * jnp.abs(exact).max()


@pytest.mark.parametrize("low", [-4, np.nan, -np.inf])
def test_the_largest_entry_is_the_first_of_equals(low):
    rng = np.random.default_rng(0)
    for shape in ((7,), (4, 5, 6)):
        logits = rng.integers(-3, 3, shape).astype(np.float32)
        logits[rng.uniform(size=shape) < 0.2] = low
        for some in (logits, np.full(shape, low, np.float32)):
            found = jax.jit(policy.argmax_index)(jnp.asarray(some))
            assert tuple(map(int, found)) == np.unravel_index(np.argmax(some), shape) and found[0].dtype == jnp.int32


@pytest.mark.parametrize(
    "overrides, message",
    [
        (("model.name=two_stream", "model.dtype=float16"), "model.dtype must be one of 'float32', 'bfloat16', got 'float16'"),
        (("model.dtype=bfloat16",), "model.name 'goal_aware' computes in float32 only, got model.dtype='bfloat16'"),
    ],
)
def test_a_dtype_that_a_network_does_not_have_is_refused(overrides, message):
    with pytest.raises(options.OptionsError, match=message):
        build.build_policy(tiny_config(*overrides))
