"""The default agent: it acts on what its network says, its switches do what they say, one batch is learnt by heart."""

import collections.abc
import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_policy import GOAL_AWARE, POLICIES, ROTATIONS, SPEC, batch_of, batched_loss, check_action, example, map_of, state_of
from test_policy_graph import GRAPH

from lala_jax import policy, policy_goal_aware, types
from lala_jax.models import goal_aware
from lala_jax.perception import topdown, transforms


@functools.cache
def compiled(name):
    """A policy's fresh parameters, and its `act` compiled."""
    agent = POLICIES[name]
    return jax.jit(agent.init)(jax.random.key(0, impl="rbg")), jax.jit(agent.act)


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
    agent = policy_goal_aware.GoalAwarePolicy(model=Canned((), still))
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
    agent = policy_goal_aware.GoalAwarePolicy(model=Canned(**answers))
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
    unrefined = policy_goal_aware.GoalAwarePolicy(model=Canned(PLACES, lambda *_: 1 / 0), refine=False)
    blank = policy.empty_map(SPEC)
    again, _ = jax.jit(unrefined.act)({}, blank, blank)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), again, action)


@pytest.mark.parametrize(("better", "chosen"), [(0.9, 0), (1.1, 3)])
def test_act_weighs_the_fit_against_the_place(better, chosen):
    """Of two quarter turns that one takes whose fit and place together say more: here the place's lead is worth `worth` of a fit."""
    worth = policy_goal_aware.PLACE_SHARE * (PLACES[0][1] - PLACES[3][1]) / policy_goal_aware.FIT_SCALE

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
    plain, mean = (jax.jit(policy_goal_aware.GoalAwarePolicy(model=Looking(), average_turns=average).act) for average in (False, True))
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
    plain, blunt = (jax.jit(policy_goal_aware.GoalAwarePolicy(model=Looking(), max_height=high).act) for high in (False, True))
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
        (policy_goal_aware.GoalAwarePolicy(model=GOAL_AWARE), named | matching | refining),
        (policy_goal_aware.GoalAwarePolicy(model=GOAL_AWARE, match_weight=0.0), named | refining),
        (policy_goal_aware.GoalAwarePolicy(model=blunt), named | refining),
        (policy_goal_aware.GoalAwarePolicy(model=GOAL_AWARE, refine=False), named | matching),
    ):
        loss, metrics = jax.eval_shape(agent.loss, params, jax.random.key(0), state_of(0), blank, blank)
        assert set(metrics) == names and loss.shape == ()


@pytest.mark.parametrize("agent", [*POLICIES.values(), GRAPH], ids=[*POLICIES, "graph"])
def test_a_state_as_a_data_set_has_it_will_do(agent):
    """NumPy's arrays, which cannot be indexed by what JAX traces."""
    blank = policy.empty_map(SPEC)
    state = jax.tree.map(np.asarray, state_of(0))
    params = jax.eval_shape(agent.init, jax.random.key(0))
    shape, _ = jax.eval_shape(lambda params: agent.loss(params, jax.random.key(0), state, blank, blank), params)
    assert shape.shape == ()
    if agent.privileged:
        action, _ = jax.eval_shape(lambda params: agent.act(params, blank, blank, state), params)
        assert action.pick.shape == (3,)


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_tokens_are_told_whose_they_are_where_they_lie(yaw):
    """The slopes of the loss at equal scores point at the tokens whose middles are in the goal of what may go next, turned or not."""
    state, pool = state_of(0), goal_aware.POOL
    goal = transforms.pose_from_yaw(np.array([[0.52, 0.11, 0.05], [0.41, -0.23, 0.03]]), np.array([yaw, -yaw])).astype(np.float32)
    size = np.array([[0.09, 0.05, 0.04], [0.05, 0.05, 0.05]], np.float32)
    state = state.replace(goal=jnp.asarray(goal), size=jnp.asarray(size), placed=jnp.zeros(2, bool), ready=jnp.array([True, False]))
    grid = np.stack(np.meshgrid(*map(np.arange, (SPEC.rows // pool, SPEC.cols // pool, SPEC.slices)), indexing="ij"), -1).reshape(-1, 3)
    match = goal_aware.Match(
        pick=jnp.zeros((SPEC.rows, SPEC.cols)), current=jnp.zeros((SPEC.rows // pool, SPEC.cols // pool, 2)), token=jnp.asarray(grid),
        token_valid=jnp.ones(len(grid), bool), token_embedding=jnp.zeros((len(grid), 2)), token_next=jnp.zeros(len(grid)),
    )  # fmt: skip

    def loss(scores):
        return POLICIES["goal_aware"]._match_losses(jax.random.key(0), state, match.replace(token_next=scores), ~state.placed)[1]

    told = np.asarray(jax.grad(loss)(match.token_next)) < 0
    x = SPEC.x[0] + (grid[:, 1] + 0.5) * pool * SPEC.cell - goal[0, 0]
    y = SPEC.y[0] + (grid[:, 0] + 0.5) * pool * SPEC.cell - goal[0, 1]
    z = SPEC.z[0] + (grid[:, 2] + 0.5) * (SPEC.z[1] - SPEC.z[0]) / SPEC.slices - goal[0, 2]
    along, across = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
    beyond = np.max(np.abs([along, across, z]) - size[0][:, None] / 2, axis=0) - policy_goal_aware.TOKEN_TOLERANCE
    clear = np.abs(beyond) > 1e-5
    assert (told == (beyond < 0))[clear].all() and told.sum() > 4


def means(metrics):
    """The mean of every metric over some steps."""
    return {name: float(np.mean([one[name] for one in metrics])) for name in metrics[0]}


def test_one_hot_labels_tell_of_the_drawn_object_only():
    """Two objects may go next: where the other one belongs matters to every loss with labels of every right action, else to none."""
    state = state_of(0)
    beside = state.goal[0].at[1].add(-0.15 * jnp.sign(state.goal[0, 1]))
    state = state.replace(goal=state.goal.at[1].set(beside), ready=jnp.ones(2, bool))
    now, goal = map_of(state, state.poses), map_of(state, state.goal)
    elsewhere = state.replace(goal=state.goal.at[1, 0].add(0.02))
    keys = jax.random.split(jax.random.key(5), 6)
    names = ("loss_pick", "loss_place", "loss_match", "loss_next", "loss_refine", "loss_fit")
    for multi_action in (False, True):
        agent = policy_goal_aware.GoalAwarePolicy(model=GOAL_AWARE, multi_action=multi_action)
        params, loss = compiled("goal_aware")[0], jax.jit(agent.loss)
        drawn = []
        for key in keys:
            sample = policy.draw(
                jax.random.split(key, 3)[0], state, spec=SPEC, rotations=ROTATIONS, candidates=state.ready, multi_action=multi_action
            )
            drawn.append(int(sample.index))
            metrics, other = (loss(params, key, each, now, goal)[1] for each in (state, elsewhere))
            same = {name: bool(metrics[name] == other[name]) for name in names}
            if drawn[-1] == 0 and not multi_action:
                assert all(same.values()), same
            elif drawn[-1] == 0:
                assert not any(same[name] for name in ("loss_match", "loss_next", "loss_refine")), same
            else:
                assert not any(same[name] for name in ("loss_place", "loss_match", "loss_next", "loss_refine")), same
        assert set(drawn) == {0, 1}


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
