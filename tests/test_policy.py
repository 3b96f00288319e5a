"""Policies on scenes fused from the boxes' own surfaces: what is asked is drawn right, actions are sane, one batch is learnt by heart."""

import collections.abc
import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_scoring import drawn_params
from test_train_step import tiny_config

from lala_jax import build, options, policy, types
from lala_jax.models import goal_aware, graph, transporter
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


def test_maps_of_another_spec_are_refused():
    agent, (_, current, goal) = POLICIES["goal_aware"], example(0)
    coarse = policy.empty_map(types.MapSpec(cell=0.025, slices=SPEC.slices))
    for maps, name in (((coarse, goal), "current"), ((current, coarse), "goal")):
        with pytest.raises(ValueError, match=rf"{name} must be one map of rows, cols and slices \(80, 40, .*got \(40, 20, "):
            agent.act({}, *maps)


def test_goal_aware_acts_on_the_surface_inside_the_map():
    params, act = compiled("goal_aware")
    _, current, goal = example(0)
    check_action(POLICIES["goal_aware"], *jax.device_get(act(params, current, goal)), current)


@dataclasses.dataclass(frozen=True)
class Canned:
    """A network that answers what it is told: logits as given, and a refinement that a function decides."""

    place: tuple  # ((turn, row, col), logit), ...
    refine: collections.abc.Callable  # of pick, cell and turn: offset [3] and fit
    spec: types.MapSpec = SPEC
    rotations: int = ROTATIONS
    pick: tuple = (30, 12)

    def apply(self, variables, *inputs, method):
        del variables
        if method == "match":
            height = jnp.zeros((SPEC.rows, SPEC.cols))
            return canned_match(pick=height.at[self.pick].set(1.0))
        if method == "place":
            logits = jnp.zeros((self.rotations, SPEC.rows, SPEC.cols))
            for at, value in self.place:
                logits = logits.at[at].set(value)
            return logits
        return self.refine(*inputs[2:]) if method == "refine" else None


def canned_match(pick):
    nothing = jnp.zeros((0, 3))
    return goal_aware.Match(pick=pick, current=nothing, token=nothing, token_valid=nothing, token_embedding=nothing, token_next=nothing)


def still(pick, cell, turn):
    """A refinement that is content with every guess, and likes none better."""
    del pick, cell, turn
    return jnp.zeros(3), jnp.float32(0)


@pytest.mark.parametrize("rotations", [12, 36, 10])
def test_guesses_equal_a_loop(rotations):
    """The best place, and per quarter turn the best within 3 cm of it, a bin more or less."""
    agent = policy.GoalAwarePolicy(model=Canned((), still))
    guesses = jax.jit(agent._guesses)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        logits = rng.normal(size=(rotations, 30, 20)).astype(np.float32)
        best = tuple(rng.integers(0, (rotations, 30, 20)))
        logits[best] = 9.0
        cells, turns = map(np.asarray, guesses(jnp.asarray(logits)))
        assert (turns[0], *cells[0]) == best and cells.shape == (4, 2) and turns.dtype == np.int32
        for quarter in (1, 2, 3):
            near = []
            for turn in ((best[0] + round(quarter * rotations / 4) + more) % rotations for more in (-1, 0, 1)):
                for row in range(max(0, best[1] - 2), min(30, best[1] + 3)):  # two cells of 12.5 mm are within 3 cm
                    for col in range(max(0, best[2] - 2), min(20, best[2] + 3)):
                        near.append((logits[turn, row, col], turn, row, col))
            assert (turns[quarter], *cells[quarter]) == max(near)[1:]


def act_canned(**answers):
    agent = policy.GoalAwarePolicy(model=Canned(**answers))
    blank = policy.empty_map(SPEC)
    return jax.device_get(jax.jit(agent.act)({}, blank, blank))


PLACES = (((1, 50, 20), 3.0), ((4, 51, 20), 2.0), ((7, 50, 21), 1.0), ((10, 49, 20), 2.5), ((6, 10, 10), 2.9))


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_act_takes_the_quarter_turn_that_fits(quarter):
    """The best place near the best one whose fit is best, however good another place elsewhere; the pick and the heat stay."""
    (turn, row, col), _ = PLACES[quarter]

    def fits(pick, cell, turns):
        del pick, cell
        return jnp.zeros(3), -jnp.abs(turns - turn)

    action, heat = act_canned(place=PLACES, refine=fits)
    np.testing.assert_allclose(action.place[:2], types.world_from_index(SPEC, np.array([row, col])), atol=1e-6)
    assert abs(transforms.wrap_angle(action.yaw - turn * math.pi / 6)) < 1e-5
    np.testing.assert_allclose(action.pick[:2], types.world_from_index(SPEC, np.array([30, 12])), atol=1e-6)
    assert np.unravel_index(heat.place.argmax(), heat.place.shape) == (1, 50, 20)


def test_act_keeps_the_best_place_where_none_fits_better():
    action, _ = act_canned(place=PLACES, refine=still)
    np.testing.assert_allclose(action.place[:2], types.world_from_index(SPEC, np.array([50, 20])), atol=1e-6)
    assert abs(transforms.wrap_angle(action.yaw - math.pi / 6)) < 1e-5
    unrefined = policy.GoalAwarePolicy(model=Canned(PLACES, lambda *_: 1 / 0), refine=False)
    blank = policy.empty_map(SPEC)
    again, _ = jax.jit(unrefined.act)({}, blank, blank)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), again, action)


@pytest.mark.parametrize(("better", "chosen"), [(0.9, 0), (1.1, 3)])
def test_act_weighs_the_fit_against_the_place(better, chosen):
    """Of two quarter turns that one takes whose fit and place together say more: here the place's lead is worth `worth` of a fit."""
    worth = policy.PLACE_SHARE * (PLACES[0][1] - PLACES[3][1]) / policy.FIT_SCALE

    def fits(pick, cell, turns):
        del pick, cell
        return jnp.zeros(3), jnp.where(turns == 10, better * worth, jnp.where(turns == 1, 0.0, -9.0))

    action, _ = act_canned(place=PLACES, refine=fits)
    np.testing.assert_allclose(action.place[:2], types.world_from_index(SPEC, np.array(PLACES[chosen][0][1:])), atol=1e-6)


def test_act_refines_by_what_the_chosen_guess_says():
    """By any fraction of a cell and a bin, but no more than two, nor off the map."""

    def by(*off):
        return lambda pick, cell, turns: (jnp.where(turns == 1, jnp.array(off), 1.0), jnp.where(turns == 1, 0.0, -9.0))

    for place, off, cell, turn in (
        (PLACES, (0.3, -1.7, 0.4), (50.8, 18.8), 1.4),
        (PLACES, (9.0, -9.0, -9.0), (52.5, 18.5), -1),
        ((((1, 0, 39), 3.0),), (-2.0, 2.0, 0.0), (0, 40), 1),
    ):
        action, _ = act_canned(place=place, refine=by(*off))
        np.testing.assert_allclose(types.cell_from_world(SPEC, action.place[:2]), cell, atol=1e-3)
        assert abs(transforms.wrap_angle(action.yaw - turn * math.pi / 6)) < 1e-5


@dataclasses.dataclass(frozen=True)
class Looking(Canned):
    """A network whose logits are shifted sums of what it is shown, different each way round."""

    place: tuple = ()
    refine: collections.abc.Callable = still

    def apply(self, variables, *inputs, method):
        if method == "match":
            now, goal = (one.features.sum((2, 3)) for one in inputs)
            return canned_match(pick=jnp.roll(now, (1, 2), (0, 1)) + 2 * jnp.roll(goal, 3, 0))
        if method == "layout":
            return inputs
        if method == "target":
            return jnp.roll(inputs[0].pick, inputs[1], (0, 1))
        if method == "place":
            (now, goal), shown, pick = inputs
            seen = shown + jnp.roll(now.height, 2 * pick, (0, 1))
            return jnp.stack([jnp.roll(goal.height, k, 0) + jnp.roll(seen, k, 1) for k in range(self.rotations)])
        return super().apply(variables, *inputs, method=method)


def random_map(seed):
    rng = np.random.default_rng(seed)
    blank = policy.empty_map(SPEC)
    leaves = jax.tree.map(lambda leaf: jnp.asarray(rng.random(leaf.shape), jnp.float32), blank)
    return leaves.replace(count=jnp.asarray(rng.integers(0, 3, blank.count.shape), jnp.float32))


def test_the_mean_over_half_turns_turns_with_the_maps():
    """Both logits are the means of two looks, so what is turned is thought turned; without the switch it is not."""
    now, goal = random_map(0), random_map(1)
    half = [topdown.half_turn(one) for one in (now, goal)]
    plain, mean = (jax.jit(policy.GoalAwarePolicy(model=Looking(), average_turns=average).act) for average in (False, True))
    action, heat = jax.device_get(mean({}, now, goal))
    turned_action, turned_heat = jax.device_get(mean({}, *half))
    np.testing.assert_allclose(turned_heat.pick[::-1, ::-1], heat.pick, atol=1e-5)
    np.testing.assert_allclose(turned_heat.place[:, ::-1, ::-1], heat.place, atol=1e-5)
    middle = np.array([0.5, 0.0])
    for one, other in ((action.pick, turned_action.pick), (action.place, turned_action.place)):
        np.testing.assert_allclose(one[:2] - middle, middle - other[:2], atol=1e-5)
    assert abs(transforms.wrap_angle(action.yaw - turned_action.yaw)) < 1e-5
    sides = [plain({}, now, goal)[1].pick, plain({}, *half)[1].pick[::-1, ::-1]]
    assert np.abs(sides[0] - sides[1]).max() > 0.1
    np.testing.assert_allclose(heat.pick, (sides[0] + sides[1]) / 2, atol=1e-5)


def test_max_height_sees_what_is_highest_only():
    now, goal = random_map(2), random_map(3)
    plain, blunt = (jax.jit(policy.GoalAwarePolicy(model=Looking(), max_height=high).act) for high in (False, True))
    given = blunt({}, now, goal)
    jax.tree.map(np.testing.assert_array_equal, given, plain({}, topdown.keep_highest(now), topdown.keep_highest(goal)))
    assert np.abs(given[1].pick - plain({}, now, goal)[1].pick).max() > 0.1


def test_switches_take_their_losses_along():
    """No program is compiled: the names of the metrics are enough."""
    named = {"loss", "loss_pick", "loss_place", "pick_right", "place_right", "place_near"}
    matching, refining = {"loss_match", "loss_next", "match_right"}, {"loss_refine", "loss_fit", "refine_error", "fit_right"}
    blunt, blank = GOAL_AWARE.clone(matching=False), policy.empty_map(SPEC)
    params = jax.eval_shape(POLICIES["goal_aware"].init, jax.random.key(0))
    for agent, names in (
        (policy.GoalAwarePolicy(model=GOAL_AWARE), named | matching | refining),
        (policy.GoalAwarePolicy(model=GOAL_AWARE, match_weight=0.0), named | refining),
        (policy.GoalAwarePolicy(model=blunt), named | refining),
        (policy.GoalAwarePolicy(model=GOAL_AWARE, refine=False), named | matching),
    ):
        loss, metrics = jax.eval_shape(agent.loss, params, jax.random.key(0), state_of(0), blank, blank)
        assert set(metrics) == names and loss.shape == ()


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
    kind = {"goal_aware": policy.GoalAwarePolicy, "graph": policy.GraphPolicy}.get(name, policy.TransporterPolicy)
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


def means(metrics):
    """The mean of every metric over some steps."""
    return {name: float(np.mean([one[name] for one in metrics])) for name in metrics[0]}


def test_goal_aware_learns_a_batch_by_heart():
    """Law 7: pick, place, match and fit of one batch are learnt; the gradient reaches every parameter; then the actions are right.

    The second example's object is oblong: its quarter turn, which covers much of the same place, is wrong. Four draws of picks and of
    starts of the refinement take turns.
    """
    agent = POLICIES["goal_aware"]
    examples = [example(0), example(4, done=1, sides=(0.07, 0.04))]
    _, *batch = batch_of(*examples)
    keys = [jax.random.split(jax.random.key(seed), len(examples)) for seed in range(4)]
    optimizer = optax.adam(3e-3)
    params, act = compiled("goal_aware")
    opt_state = optimizer.init(params)

    @jax.jit
    def step(params, opt_state, keys, *batch):
        (_, metrics), grads = jax.value_and_grad(batched_loss(agent), has_aux=True)(params, keys, *batch)
        updates, opt_state = optimizer.update(grads, opt_state)
        return optax.apply_updates(params, updates), opt_state, metrics, jax.tree.map(lambda g: jnp.abs(g).max(), grads)

    seen = []
    for number in range(201):
        params, opt_state, metrics, size = step(params, opt_state, keys[number % 4], *batch)
        seen.append(metrics)
        if number == 20:
            dead = [jax.tree_util.keystr(path) for path, leaf in jax.tree.leaves_with_path(size) if not leaf > 0]
            assert not dead, f"no gradient reaches {dead}"
        if number % 20 == 19:
            recent = means(seen[-4:])
            if max(recent["loss_pick"], recent["loss_place"], recent["loss_refine"]) < 0.1:
                break
    metrics, first = means(seen[-4:]), means(seen[:4])
    assert metrics["loss_pick"] < 0.3 and metrics["loss_place"] < 0.3, metrics
    assert all(metrics[name] < 0.7 * first[name] for name in ("loss_match", "loss_next", "loss_refine", "loss_fit")), metrics
    assert metrics["pick_right"] == metrics["place_right"] == metrics["fit_right"] == 1
    for state, current, goal in examples:
        action, _ = act(params, current, goal)
        ready = int(np.argmax(state.ready))
        assert np.linalg.norm(action.pick[:2] - state.poses[ready, :2]) < 0.02
        held = np.asarray(state.poses[ready, :2] - action.pick[:2])
        cos, sin = np.cos(action.yaw), np.sin(action.yaw)
        landed = np.asarray(action.place[:2]) + np.array([[cos, -sin], [sin, cos]]) @ held
        assert np.linalg.norm(landed - np.asarray(state.goal[ready, :2])) < 0.01
        off = transforms.yaw_from_quat(state.poses[ready, 3:]) + action.yaw - transforms.yaw_from_quat(state.goal[ready, 3:])
        assert abs(float(transforms.wrap_angle(off, state.symmetry[ready]))) < math.radians(15)


# The graph policy


GRAPH = policy.GraphPolicy(model=graph.Graph(width=16, rounds=2), spec=SPEC)


@pytest.mark.parametrize("index", range(3))
def test_what_the_graph_policy_is_told_it_does(index, monkeypatch):
    """The chosen object comes to the chosen goal pose, turned no further than its symmetry asks."""
    state = state_of(5, objects=3)
    logits = jnp.zeros((3, 3)).at[index, index].set(1.0)
    monkeypatch.setattr(graph.Graph, "apply", lambda *_: logits)
    action, heat = GRAPH.act({}, None, None, state)
    motion = transforms.se2_about(action.pick[:2], action.yaw, action.place[:2] - action.pick[:2])
    moved = transforms.apply_se2(motion, state.poses[index, :2])
    np.testing.assert_allclose(moved, state.goal[index, :2], atol=1e-6)
    off = transforms.yaw_from_quat(state.poses[index, 3:]) + action.yaw - transforms.yaw_from_quat(state.goal[index, 3:])
    assert abs(transforms.wrap_angle(off, state.symmetry[index])) < 1e-5 and abs(action.yaw) <= math.pi / 4 + 1e-6
    np.testing.assert_allclose(action.pick[2], state.poses[index, 2] + 0.02, atol=1e-6)
    cell = np.unravel_index(heat.pick.argmax(), heat.pick.shape)
    np.testing.assert_array_equal(cell, types.index_from_world(SPEC, state.poses[index, :2]))


def test_the_graph_policy_learns_towers_by_heart():
    moments = [state_of(seed, objects=3, done=done) for seed in range(4) for done in range(3)]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *moments)
    optimizer = optax.adam(3e-3)
    params = jax.jit(GRAPH.init)(jax.random.key(0, impl="rbg"))

    def loss(params):
        each, metrics = jax.vmap(lambda state: GRAPH.loss(params, jax.random.key(0), state, None, None))(states)
        return each.mean(), metrics

    @jax.jit
    def train(params, opt):
        def step(carry, _):
            (_, metrics), grads = jax.value_and_grad(loss, has_aux=True)(carry[0])
            updates, opt = optimizer.update(grads, carry[1])
            return (optax.apply_updates(carry[0], updates), opt), jax.tree.map(jnp.mean, metrics)

        return jax.lax.scan(step, (params, opt), length=400)

    (params, _), metrics = train(params, optimizer.init(params))
    assert abs(metrics["loss"][0] - math.log(9)) < 0.3  # of nine pairs one is right
    assert metrics["loss"][-1] < 0.05 and metrics["pick_right"][-1] == metrics["place_right"][-1] == 1.0


def test_one_label_of_the_graph_policy_is_one_of_all():
    """Where two objects may go next, one drawn counts, and the loss of both right ones together is less than of either."""
    state = state_of(5, objects=3).replace(ready=jnp.array([True, True, False]))
    params = drawn_params(GRAPH)
    single = dataclasses.replace(GRAPH, multi_action=False)
    both = GRAPH.loss(params, jax.random.key(0), state, None, None)[0]
    drawn = {round(float(single.loss(params, jax.random.key(seed), state, None, None)[0]), 5) for seed in range(12)}
    assert len(drawn) == 2 and np.exp(-both) == pytest.approx(sum(np.exp(-one) for one in drawn), rel=1e-3)


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
