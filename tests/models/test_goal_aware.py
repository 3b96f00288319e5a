"""The goal-aware network: its parts against numpy loops and hand-made maps, and the symmetries that hold by construction."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import types
from lala_jax.models import goal_aware
from lala_jax.perception import transforms

SPEC = types.MapSpec(cell=0.025, slices=7)  # 40 x 20 cells of 7 slices
SQUARE = types.MapSpec(y=(-0.25, 0.25), cell=0.025, slices=7)
SIZES = {"rotations": 8, "crop": 8, "tokens": 24, "embed": 6, "trunk_width": 8, "trunk_blocks": 1, "fine_width": 4, "channels": 2}
NET, SQUARE_NET = (goal_aware.GoalAware(spec=spec, **SIZES) for spec in (SPEC, SQUARE))
PICK = jnp.array([13, 6])
RED, BLUE, TABLE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9), (0.2, 0.2, 0.2)


def build(columns, spec=SPEC):
    """A table with columns of coloured slices on it: `{(row, col): [colour, ...]}` from slice 1 up, each one token wide."""
    features = np.zeros((spec.rows, spec.cols, spec.slices, 3), np.float32)
    count = np.zeros(features.shape[:3], np.float32)
    features[:, :, 0], count[:, :, 0] = TABLE, 3
    height = np.zeros(features.shape[:2], np.float32)
    for (row, col), colours in columns.items():
        here = slice(row * goal_aware.POOL, (row + 1) * goal_aware.POOL), slice(col * goal_aware.POOL, (col + 1) * goal_aware.POOL)
        for level, colour in enumerate(colours, start=1):
            features[(*here, level)], count[(*here, level)] = colour, 5
            height[here] = (level + 1) * spec.slice_height
    middle = {"offset": jnp.zeros((*count.shape, 2)), "skin": jnp.zeros((*height.shape, 2))}
    return types.TopDownMap(features=jnp.asarray(features), count=jnp.asarray(count), height=jnp.asarray(height), **middle)


def random_map(seed, spec=SPEC):
    """Voxels at random, some empty."""
    rng = np.random.default_rng(seed)
    grid = (spec.rows, spec.cols, spec.slices)
    count = np.maximum(rng.integers(-6, 5, grid), 0).astype(np.float32)
    features = (rng.random((*grid, 3)) * (count > 0)[..., None]).astype(np.float32)
    height = (spec.slices - np.argmax(count[..., ::-1] > 0, -1)) * spec.slice_height * (count > 0).any(-1)
    offset = rng.uniform(-0.5, 0.5, (*grid, 2)) * (count > 0)[..., None]
    skin = rng.uniform(-0.5, 0.5, (*grid[:2], 2)) * (count > 0).any(-1)[..., None]
    return types.TopDownMap(*(jnp.asarray(leaf, jnp.float32) for leaf in (features, count, offset, height, skin)))


def random_target(seed, spec=SPEC):
    """Some of the goal's tokens, at random, are what was picked."""
    rng = np.random.default_rng(seed)
    weight = rng.random((spec.rows // 2, spec.cols // 2, spec.slices)) * (rng.random((spec.rows // 2, spec.cols // 2, spec.slices)) < 0.3)
    level = rng.random(spec.slices)
    return goal_aware.Target(weight=jnp.asarray(weight, jnp.float32), level=jnp.asarray(level / level.sum(), jnp.float32))


@pytest.fixture(scope="module")
def variables():
    return jax.jit(NET.init)(jax.random.key(0, impl="rbg"), random_map(0), random_map(1), PICK)


@pytest.fixture(scope="module")
def lively(variables):
    """Parameters whose refinement says something: `init` starts it at nearly nothing."""
    rng = np.random.default_rng(5)
    params = dict(variables["params"])
    net = dict(params["refine_net"])
    for name in ("Dense_1", "Dense_2"):  # the offset, the fit
        net[name] = {leaf: jnp.asarray(rng.normal(0, 0.3, value.shape), jnp.float32) for leaf, value in net[name].items()}
    return {"params": params | {"refine_net": net}}


def method(name, net=NET):
    return jax.jit(lambda variables, *inputs: net.apply(variables, *inputs, method=name))


run, look, refine = method("__call__"), method("match"), method("refine")
layout, target, picture = method("layout"), method("target"), method("_picture")
refine_square = method("refine", SQUARE_NET)


def test_shapes(variables):
    match, place, (offset, fit) = run(variables, random_map(0), random_map(1), PICK)
    assert match.pick.shape == (40, 20) and match.current.shape == (20, 10, 6)
    assert match.token.shape == (24, 3) and match.token_embedding.shape == (24, 6)
    assert match.token_valid.shape == match.token_next.shape == (24,)
    assert place.shape == (8, 40, 20) and offset.shape == (3,) and fit.shape == ()
    scene = layout(variables, random_map(0), random_map(1))
    assert scene.now.shape == scene.goal.shape == (40, 20, 8) and scene.levels.shape == (40, 20, 7, 7)
    found = target(variables, match, PICK)
    assert found.weight.shape == (20, 10, 7) and found.level.shape == (7,)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((match.pick, place, offset, fit, scene, found)))


def test_vmap_equals_a_loop(variables):
    pairs, cells = [(random_map(0), random_map(1)), (random_map(2), random_map(0))], jnp.array([[13, 6], [39, 0]])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    batch = jax.jit(jax.vmap(NET.apply, (None, 0, 0, 0)))(variables, *stacked, cells)
    for index, pair in enumerate(pairs):
        one = run(variables, *pair, cells[index])
        jax.tree.map(lambda all_, one, index=index: np.testing.assert_allclose(all_[index], one, atol=1e-4), batch, one)


def test_jit_equals_eager(lively):
    """The refinement and the target, which hold every kind of step but the convolutional trunk."""
    match = look(lively, random_map(0), random_map(1))
    scene, found = layout(lively, random_map(0), random_map(1)), target(lively, match, PICK)
    for name, inputs in (
        ("refine", (scene, found, PICK, jnp.array([30, 4]), jnp.float32(2.3))),
        ("target", (match, PICK)),
    ):
        eager = NET.apply(lively, *inputs, method=name)
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), method(name)(lively, *inputs), eager)


def test_starts_near_zero(variables):
    """Pick and place begin near indifference and the refinement at no offset and any fit, or the first steps go to undoing the start."""
    now, goal = build({(3, 4): [RED], (12, 2): [BLUE]}), build({(8, 6): [RED, BLUE]})
    match, place, (offset, fit) = run(variables, now, goal, PICK)
    for logits in (match.pick, place):
        assert np.std(logits) < 2 and np.ptp(logits) < 10
    assert np.abs(offset).max() < 0.2 and fit == 0


def silenced(variables):
    """Parameters with which the fine part of the pick says nothing."""
    params = variables["params"]
    return {"params": params | {"pick_out": jax.tree.map(jnp.zeros_like, params["pick_out"])}}


def test_pick_logits_equal_a_loop_over_tokens(variables):
    """With the fine part silenced, a cell's logit is the log-sum-exp over valid goal tokens of next + <current, token>."""
    match = jax.device_get(look(silenced(variables), build({(3, 4): [RED], (12, 2): [BLUE]}), build({(8, 6): [RED, BLUE]})))
    assert 0 < match.token_valid.sum() < 24
    for row in range(0, SPEC.rows, 3):
        for col in range(SPEC.cols):
            here = match.current[row // 2, col // 2].astype(float)
            scores = [
                match.token_next[t] + here @ match.token_embedding[t].astype(float) for t in range(len(match.token)) if match.token_valid[t]
            ]
            np.testing.assert_allclose(match.pick[row, col], np.log(np.sum(np.exp(scores))), atol=1e-4)


def test_embeddings_have_unit_length(variables):
    match = look(variables, random_map(0), random_map(1))
    np.testing.assert_allclose(np.linalg.norm(match.token_embedding, axis=-1), 1, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(match.current, axis=-1), variables["params"]["temperature"], rtol=1e-3)


def test_pool_equals_a_loop():
    voxels = random_map(3)
    color, count = map(np.asarray, goal_aware._pool(voxels))
    features, counts = np.asarray(voxels.features, float), np.asarray(voxels.count, float)
    for row in range(SPEC.rows // 2):
        for col in range(SPEC.cols // 2):
            for level in range(SPEC.slices):
                cells = [(2 * row + a, 2 * col + b, level) for a in (0, 1) for b in (0, 1)]
                total = sum(counts[cell] for cell in cells)
                assert count[row, col, level] == total
                mean = sum(counts[cell] * features[cell] for cell in cells) / max(total, 1)
                np.testing.assert_allclose(color[row, col, level], mean, atol=1e-5)


def test_voxel_input_equals_a_loop():
    """Own, above, below and around: colour less the mean, 0 where nothing was seen, and whether something was."""
    rng = np.random.default_rng(0)
    count = np.maximum(rng.integers(-2, 4, (5, 4, 3)), 0).astype(np.float32)
    color = rng.random((5, 4, 3, 3)).astype(np.float32) * (count > 0)[..., None]
    given = np.asarray(goal_aware._voxel_input(jnp.asarray(color), jnp.asarray(count)))

    def at(cells):
        cells = [c for c in cells if all(0 <= i < n for i, n in zip(c, count.shape, strict=True)) and count[c] > 0]
        total = sum(float(count[c]) for c in cells)
        return [0, 0, 0, 0] if not cells else [*(sum(color[c].astype(float) * count[c] for c in cells) / total - 0.5), 1]

    for i, j, k in np.ndindex(count.shape):
        around = [(i + a, j + b, k) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        expected = [*at([(i, j, k)]), *at([(i, j, k + 1)]), *at([(i, j, k - 1)]), *at(around)]
        np.testing.assert_allclose(given[i, j, k], expected, atol=1e-5)


def test_tokens_are_the_goal_voxels_that_differ(variables):
    """What the goal has elsewhere, in another colour, or that is not there yet; never what is the same or only there now."""
    now = build({(3, 4): [RED], (12, 2): [BLUE], (15, 5): [RED, BLUE]})
    goal = build({(8, 6): [RED, BLUE], (12, 2): [RED], (15, 5): [RED, BLUE]})
    match = look(variables, now, goal)
    found = {tuple(token) for token, valid in zip(np.asarray(match.token).tolist(), match.token_valid, strict=True) if valid}
    assert found == {(8, 6, 1), (8, 6, 2), (12, 2, 1)}
    assert not look(variables, goal, goal).token_valid.any()


def test_more_differences_than_tokens_keep_the_largest(variables):
    match = look(variables, random_map(0), random_map(1))
    assert match.token_valid.all() and len({tuple(token) for token in np.asarray(match.token).tolist()}) == 24


@pytest.mark.parametrize(("picked", "other"), [((3, 4), (12, 2)), ((12, 2), (3, 4))])
def test_target_marks_the_matching_colour(variables, picked, other):
    """Alone on the table now and in the goal, a block looks the same in both: its weight is 1 there, less on the other, 0 elsewhere."""
    now = {(3, 4): [RED], (12, 2): [BLUE]}
    home = {(3, 4): (8, 6), (12, 2): (16, 7)}
    goal = build({home[(3, 4)]: [RED], home[(12, 2)]: [BLUE]})
    match = look(variables, build(now), goal)
    found = target(variables, match, 2 * jnp.array(picked))
    weight, level = np.asarray(found.weight), np.asarray(found.level)
    assert set(map(tuple, np.argwhere(weight > 0).tolist())) <= {(*place, 1) for place in home.values()}
    np.testing.assert_allclose(weight[(*home[picked], 1)], 1, atol=1e-5)
    assert weight[(*home[other], 1)] < 0.9
    np.testing.assert_allclose(level, np.arange(7) == 1, atol=1e-6)
    mask, height = shown(variables, goal, found)
    right = 2 * np.array(home[picked])
    np.testing.assert_allclose(mask[tuple(right)], 1, atol=1e-5)
    np.testing.assert_allclose(height[tuple(right)], 1.5 * SPEC.slice_height * goal_aware.HEIGHT_SCALE, rtol=1e-5)
    assert (mask > 0).sum() <= 8 and ((height > 0) == (mask > 0)).all()


def shown(variables, goal, found):
    """How much of the picked object the place step sees in each column `[rows, cols]`, and how high."""
    scene = layout(variables, goal, goal)
    weight = goal_aware._upsample(found.weight, goal_aware.POOL)
    return np.moveaxis(np.asarray(picture(variables, scene.goal, scene.levels, weight, found)), -1, 0)[8:10]


def test_without_matching_nothing_says_what_looks_alike(variables):
    """The coarse part of the pick is gone, with the fine part silenced all of it; nothing in the goal is the target."""
    blunt, quiet = NET.clone(matching=False), silenced(variables)
    match = method("match", blunt)(quiet, random_map(0), random_map(1))
    assert not match.pick.any() and look(quiet, random_map(0), random_map(1)).pick.any()
    found = method("target", blunt)(quiet, match, PICK)
    assert not found.weight.any() and not found.level.any()


def test_target_is_seen_only_where_the_goal_saw_something(variables):
    """A token is two cells wide; the cell of it that no point fell into stays out."""
    now, goal = build({(3, 4): [RED]}), build({(8, 6): [RED]})
    goal = goal.replace(count=goal.count.at[16, 12].set(0))
    found = target(variables, look(variables, now, goal), jnp.array([6, 8]))
    mask, height = shown(variables, goal, found)
    assert mask[16, 12] == height[16, 12] == 0 and mask[17, 13] > 0 and height[17, 13] > 0


def test_target_shares_its_levels(variables):
    """The levels' shares are those of the best voxel in each, and sum to one; where nothing matches they are zero."""
    match = look(variables, random_map(0), random_map(1))
    found = target(variables, match, PICK)
    score = np.asarray(match.token_embedding) @ np.asarray(match.current)[PICK[0] // 2, PICK[1] // 2]
    best = np.zeros(7)
    for at, value in zip(np.asarray(match.token), np.exp(score - score.max()), strict=True):
        best[at[2]] = max(best[at[2]], value)
        np.testing.assert_allclose(found.weight[tuple(at)], value, atol=1e-5)
    np.testing.assert_allclose(found.level, best / best.sum(), atol=1e-5)
    nothing = target(variables, look(variables, random_map(1), random_map(1)), PICK)
    assert not nothing.weight.any() and not nothing.level.any()


def top_of(maps, row, col):
    """What is seen from above in one cell: centred colour, skin, scaled height, share covered; slow and obvious."""
    maps = jax.tree.map(np.asarray, maps)
    layers = np.flatnonzero(maps.count[row, col])
    color = maps.features[row, col, layers[-1]] if len(layers) else np.zeros(3)
    down, right = maps.skin[row, col]
    return [*(color - 0.5), down, right, maps.height[row, col] * goal_aware.HEIGHT_SCALE, (1 - 2 * abs(down)) * (1 - 2 * abs(right))]


def test_layout_and_picture_equal_a_loop(variables):
    now, goal, found = random_map(0), random_map(1), random_target(2)
    scene = layout(variables, now, goal)
    weight = np.repeat(np.repeat(np.asarray(found.weight), 2, 0), 2, 1)
    seen = picture(variables, scene.goal, scene.levels, jnp.asarray(weight), found)
    assert seen.shape == (40, 20, 17)
    count, features, offset = (np.asarray(leaf, float) for leaf in (goal.count, goal.features, goal.offset))
    for row in range(1, SPEC.rows, 3):
        for col in range(SPEC.cols):
            surface = [*top_of(goal, row, col), float(now.height[row, col]) * goal_aware.HEIGHT_SCALE]
            np.testing.assert_allclose(scene.now[row, col], [*top_of(now, row, col), 1], atol=1e-5)
            np.testing.assert_allclose(scene.goal[row, col], surface, atol=1e-5)
            layers = np.flatnonzero(count[row, col])
            here, heights, total, share = [0.0], [0.0], np.zeros(6), 0.0
            for layer in layers:
                here.append(weight[row, col, layer])
                heights.append(weight[row, col, layer] * (layer + 0.5) * SPEC.slice_height * goal_aware.HEIGHT_SCALE)
                points = count[row, col, layer] * float(found.level[layer])
                total += points * np.array([*(features[row, col, layer] - 0.5), *offset[row, col, layer], 1])
                share += float(found.level[layer])
            mean = total[:5] / max(total[5], 1e-6)
            face = (weight[row, col, layers[-1]] if len(layers) else 0) * surface[6]
            np.testing.assert_allclose(seen[row, col], [*surface, max(here), max(heights), *mean, share, face], atol=1e-4)


def test_window_equals_a_padded_slice():
    rng = np.random.default_rng(0)
    for shape in ((9, 7), (9, 7, 3), (9, 7, 2, 4)):
        values = rng.normal(size=shape).astype(np.float32)
        padded = np.pad(values, [(40, 40), (40, 40)] + [(0, 0)] * (len(shape) - 2))
        for row, col in ((2, 1), (-3, 4), (6, -2), (-6, 5), (30, 3), (-15, -15)):
            given = goal_aware._window(jnp.asarray(values), row + jnp.arange(5), col + jnp.arange(4))
            np.testing.assert_array_equal(given, padded[40 + row : 45 + row, 40 + col : 44 + col])
        every_other = goal_aware._window(jnp.asarray(values), jnp.arange(-2, 6) // 2, jnp.arange(4))
        np.testing.assert_array_equal(every_other, np.repeat(padded[39:43, 40:44], 2, 0))


def test_turned_offsets_turn_as_vectors_do():
    """Rows run along +y and columns along +x; what is no offset stays."""
    rng = np.random.default_rng(0)
    crops, yaws = rng.normal(size=(6, 5, 5, 8)).astype(np.float32), np.linspace(-4, 4, 6).astype(np.float32)
    given = np.asarray(goal_aware._turn_offsets(jnp.asarray(crops), jnp.asarray(yaws)[:, None, None]))
    for crop, after, yaw in zip(crops, given, yaws, strict=True):
        turned = transforms.apply_se2(np.array([0, 0, yaw], float), crop[..., [4, 3]].astype(float))
        np.testing.assert_allclose(after[..., [4, 3]], turned, atol=1e-5)
        np.testing.assert_array_equal(np.delete(after, [3, 4], -1), np.delete(crop, [3, 4], -1))
    one = goal_aware._turn_offsets(jnp.asarray(crops[2]), jnp.asarray(yaws[2]))
    np.testing.assert_allclose(one, given[2], atol=1e-6)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turning_what_is_picked_rolls_the_place_logits(variables, quarters):
    """For a fixed key, what hangs from the pick turned by a quarter needs a quarter less: `out(b) = before(b + k / 4)`.

    The key reads the current map's height; with that one input silenced it depends on the goal alone.
    """
    params = jax.tree.map(jnp.array, variables["params"])
    kernel = params["key_net"]["Conv_0"]["kernel"]
    params["key_net"]["Conv_0"]["kernel"] = kernel.at[:, :, 7].set(0)
    before, after = (placed({"params": params}, turned(random_map(4, SQUARE), times)) for times in (0, quarters))
    np.testing.assert_allclose(after, np.roll(before, -2 * quarters, axis=0), atol=1e-4)
    assert np.ptp(before) > 1e-3
    still = turned(random_map(4, SQUARE), quarters, vectors=False)
    assert np.abs(placed({"params": params}, still) - np.roll(before, -2 * quarters, axis=0)).max() > 1e-3, "the skin says something"


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_refining_what_was_turned_equals_turning_more(lively, quarters):
    """What is turned by a quarter before it is picked and held at a bin looks as what is held a quarter further."""
    pick, cell, found, goal = jnp.array([9, 9]), jnp.array([12, 7]), random_target(3, SQUARE), random_map(1, SQUARE)
    hidden = SQUARE_NET.apply(lively, goal, goal, method="layout").goal  # the height now, which the turn changes, is in it
    scenes = [SQUARE_NET.apply(lively, turned(random_map(4, SQUARE), times), goal, method="layout") for times in (0, quarters)]
    still, after = (scene.replace(goal=hidden) for scene in scenes)
    for turn in (0.0, 1.3):
        direct = refine_square(lively, still, found, pick, cell, jnp.float32(turn + 2 * quarters))
        given = refine_square(lively, after, found, pick, cell, jnp.float32(turn))
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=2e-4, rtol=1e-4), given, direct)
        other = refine_square(lively, still, found, pick, cell, jnp.float32(turn))
        assert np.abs(other[0] - direct[0]).max() > 1e-2 and abs(other[1] - direct[1]) > 1e-2


@jax.jit
def placed(variables, current):
    """The place logits of what is picked in the middle of the square map."""
    scene = SQUARE_NET.apply(variables, current, random_map(1, SQUARE), method="layout")
    return SQUARE_NET.apply(variables, scene, random_target(2, SQUARE), jnp.array([9, 9]), method="place")


def turned(whole, times, vectors=True):
    """Turn what a pick in the middle sees by quarters, the places within the cells as well; nothing is left around it.

    In map axes (row +y, col +x) a turn about +z takes +x (col) to +y (row), against the sense of `rot90`.
    """
    around = slice(2, 17)  # the pick is in the middle of it

    def one(leaf):
        return jnp.zeros_like(leaf).at[around, around].set(np.rot90(leaf[around, around], -times))

    out = jax.tree.map(one, whole)
    return out.replace(skin=_turn_vectors(out.skin, times), offset=_turn_vectors(out.offset, times)) if vectors else out


def _turn_vectors(vectors, times):
    xy = transforms.apply_se2(np.array([0, 0, times * np.pi / 2]), np.asarray(vectors, float)[..., ::-1])
    return jnp.asarray(np.asarray(xy)[..., ::-1], jnp.float32)


def test_refine_reads_the_window_under_the_cell_and_around_the_pick(lively):
    """Nothing that is farther than half a crop from the cell in the goal, or than a turned crop reaches from the pick, matters."""
    scene, found = layout(lively, random_map(0), random_map(1)), random_target(2)
    pick, cell = jnp.array([13, 6]), jnp.array([20, 10])

    def ask(scene, found=found):
        return refine(lively, scene, found, pick, cell, jnp.float32(3.4))

    def apart(a, b):
        return abs(a[0] - b[0]).max() > 1e-4 and abs(a[1] - b[1]) > 1e-4

    before = ask(scene)
    under = jnp.zeros((40, 20, 1), bool).at[16:24, 6:14].set(True)
    near = jnp.zeros((40, 20, 1), bool).at[6:21, 0:14].set(True)  # 7 cells about the pick: a crop of 8, turned
    elsewhere = scene.replace(
        now=jnp.where(near, scene.now, 7.0), goal=jnp.where(under, scene.goal, 7.0), levels=jnp.where(under[..., None], scene.levels, 7.0)
    )
    weight = jnp.where(under[::2, ::2], found.weight, 7.0)
    jax.tree.map(np.testing.assert_array_equal, ask(elsewhere, found.replace(weight=weight)), before)
    assert apart(ask(scene.replace(goal=scene.goal.at[16, 6].add(1.0))), before)
    assert apart(ask(scene.replace(levels=scene.levels.at[23, 13].add(1.0))), before)
    assert apart(ask(scene.replace(now=scene.now.at[13, 6].add(1.0))), before)
    assert apart(ask(scene, found.replace(weight=found.weight.at[8, 3].add(1.0))), before)
    assert apart(ask(scene, found.replace(level=jnp.roll(found.level, 1))), before)


def test_refine_goes_with_the_cell_and_the_pick(lively):
    """Shifted together by whole tokens, goal and cell, or present and pick, give the same: the refinement knows no places."""
    scene, found = layout(lively, random_map(0), random_map(1)), random_target(2)
    pick, cell, shift = jnp.array([13, 9]), jnp.array([20, 9]), jnp.array([4, 2])

    def moved(leaf, factor=1):
        return jnp.roll(leaf, (int(shift[0]) // factor, int(shift[1]) // factor), (0, 1))

    before = refine(lively, scene, found, pick, cell, jnp.float32(1.7))
    there = scene.replace(goal=moved(scene.goal), levels=moved(scene.levels))
    after = refine(lively, there, found.replace(weight=moved(found.weight, 2)), pick, cell + shift, jnp.float32(1.7))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), after, before)
    after = refine(lively, scene.replace(now=moved(scene.now)), found, pick + shift, cell, jnp.float32(1.7))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), after, before)
