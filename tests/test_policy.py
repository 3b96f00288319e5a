"""Policies on scenes fused from the boxes' own surfaces: what is asked is drawn right, actions are sane, one batch is learnt by heart."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lala_jax import policy, types
from lala_jax.models import goal_aware, transporter
from lala_jax.perception import topdown, transforms
from lala_jax.sim import oracle, tasks

SPEC = types.MapSpec(cell=0.0125)  # 80 x 40 cells
TABLE = 0.2
ROTATIONS = 12
GOAL_AWARE = goal_aware.GoalAware(
    spec=SPEC, rotations=ROTATIONS, crop=8, tokens=96, embed=8, trunk_width=8, trunk_blocks=1, fine_width=8, channels=3
)
POLICIES = {"goal_aware": policy.GoalAwarePolicy(model=GOAL_AWARE)} | {
    variant: policy.TransporterPolicy(
        model=transporter.Transporter(variant=variant, yaw_bins=ROTATIONS, crop=8, channels=2, width=4, stages=2), spec=SPEC
    )
    for variant in ("single", "two_stream", "two_stream_lateral")
}


def state_of(seed, *, objects=2, done=0):
    """A tower scene with its first `done` cubes placed."""
    task = tasks.get("tower", num_objects=objects)
    scene = task.sample(seed)
    poses = np.where(np.arange(objects)[:, None] < done, scene.goal, scene.start)
    fields = {field: getattr(scene, field) for field in ("size", "color", "base", "goal", "symmetry")}
    placed, ready = oracle.placed(task, scene, poses), oracle.ready(task, scene, poses)
    assert placed.sum() == done and ready.sum() == (done < objects)
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


def test_draw_of_nothing_is_said():
    state = state_of(0, objects=3, done=1)
    for sample in draws(state, [False, False, False], multi_action=True, count=3):
        assert not sample.drawn and not sample.valid.any()


def test_one_hot_marks_one_pick_and_the_place_of_least_turn():
    state = state_of(0, objects=3, done=1)
    for sample in draws(state, state.ready, multi_action=False):
        assert np.argwhere(sample.pick_valid).tolist() == [sample.pick.tolist()]
        assert sample.valid.sum() == 1
        off = np.abs(transforms.wrap_angle(sample.place.yaw))
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


@functools.cache
def compiled(name):
    """A policy's fresh parameters, and its `act` compiled."""
    agent = POLICIES[name]
    return jax.jit(agent.init)(jax.random.key(0, impl="rbg")), jax.jit(agent.act)


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


def test_goal_aware_acts_on_the_surface_inside_the_map():
    params, act = compiled("goal_aware")
    _, current, goal = example(0)
    check_action(POLICIES["goal_aware"], *jax.device_get(act(params, current, goal)), current)


def batched_loss(agent):
    """The mean loss of a batch, as training takes it."""

    def loss(params, keys, states, current, goal):
        losses, metrics = jax.vmap(lambda *one: agent.loss(params, *one))(keys, states, current, goal)
        return losses.mean(), jax.tree.map(jnp.nanmean, metrics)

    return loss


def batch_of(*examples):
    keys = jax.random.split(jax.random.key(2), len(examples))
    return keys, *jax.tree.map(lambda *leaves: jnp.stack(leaves), *examples)


def drawn_params(agent):
    """Parameters of the size that `init` gives, drawn by numpy: `init` alone takes longer to compile than all the rest."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    return jax.tree.map(lambda s: jnp.asarray(rng.normal(0, math.prod(s.shape[:-1]) ** -0.5, s.shape), jnp.float32), shapes)


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


def test_goal_aware_learns_a_batch_by_heart():
    """Law 7: pick, place and match of one batch are learnt; the gradient reaches every parameter; then the actions are right."""
    agent = POLICIES["goal_aware"]
    examples = [example(0), example(4, done=1)]
    keys, *batch = batch_of(*examples)
    optimizer = optax.adam(3e-3)
    params, act = compiled("goal_aware")
    opt_state = optimizer.init(params)

    @jax.jit
    def step(params, opt_state, keys, *batch):
        (_, metrics), grads = jax.value_and_grad(batched_loss(agent), has_aux=True)(params, keys, *batch)
        updates, opt_state = optimizer.update(grads, opt_state)
        return optax.apply_updates(params, updates), opt_state, metrics, jax.tree.map(lambda g: jnp.abs(g).max(), grads)

    first = None
    for number in range(201):
        params, opt_state, metrics, size = step(params, opt_state, keys, *batch)
        first = first or metrics
        if number == 20:
            dead = [jax.tree_util.keystr(path) for path, leaf in jax.tree.leaves_with_path(size) if not leaf > 0]
            assert not dead, f"no gradient reaches {dead}"
        if number % 20 == 0 and max(metrics["loss_pick"], metrics["loss_place"]) < 0.05:
            break
    metrics = {name: float(value) for name, value in metrics.items()}
    assert metrics["loss_pick"] < 0.3 and metrics["loss_place"] < 0.3, metrics
    assert all(metrics[name] < 0.7 * first[name] for name in ("loss_match", "loss_next", "loss_refine")), metrics
    assert metrics["pick_right"] == metrics["place_right"] == 1
    for state, current, goal in examples:
        action, _ = act(params, current, goal)
        ready = int(np.argmax(state.ready))
        assert np.linalg.norm(action.pick[:2] - state.poses[ready, :2]) < 0.02
        held = np.asarray(state.poses[ready, :2] - action.pick[:2])
        cos, sin = np.cos(action.yaw), np.sin(action.yaw)
        landed = np.asarray(action.place[:2]) + np.array([[cos, -sin], [sin, cos]]) @ held
        assert np.linalg.norm(landed - np.asarray(state.goal[ready, :2])) < 0.012
