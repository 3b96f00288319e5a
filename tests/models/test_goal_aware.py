"""The goal-aware network: its parts against numpy loops and hand-made maps, and the symmetries that hold by construction."""

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
NET = goal_aware.GoalAware(spec=SPEC, **SIZES)
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
    return types.TopDownMap(features=jnp.asarray(features), count=jnp.asarray(count), height=jnp.asarray(height))


def random_map(seed, spec=SPEC):
    """Voxels at random, some empty."""
    rng = np.random.default_rng(seed)
    grid = (spec.rows, spec.cols, spec.slices)
    count = np.maximum(rng.integers(-6, 5, grid), 0).astype(np.float32)
    features = (rng.random((*grid, 3)) * (count > 0)[..., None]).astype(np.float32)
    height = (spec.slices - np.argmax(count[..., ::-1] > 0, -1)) * spec.slice_height * (count > 0).any(-1)
    return types.TopDownMap(features=jnp.asarray(features), count=jnp.asarray(count), height=jnp.asarray(height, jnp.float32))


@pytest.fixture(scope="module")
def variables():
    return jax.jit(NET.init)(jax.random.key(0, impl="rbg"), random_map(0), random_map(1), PICK)


run = jax.jit(lambda variables, *inputs: NET.apply(variables, *inputs))
look = jax.jit(lambda variables, *inputs: NET.apply(variables, *inputs, method="match"))


def test_shapes(variables):
    match, place, offset = run(variables, random_map(0), random_map(1), PICK)
    assert match.pick.shape == (40, 20) and match.current.shape == (20, 10, 6)
    assert match.token.shape == (24, 3) and match.token_embedding.shape == (24, 6)
    assert match.token_valid.shape == match.token_next.shape == (24,)
    assert place.logits.shape == (8, 40, 20) and place.key_input.shape[:2] == (40, 20)
    assert place.crops.shape[:3] == (8, 8, 8) and offset.shape == (3,)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((match.pick, place, offset)))


def test_vmap_equals_a_loop(variables):
    pairs, cells = [(random_map(0), random_map(1)), (random_map(2), random_map(0))], jnp.array([[13, 6], [39, 0]])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    batch = jax.jit(jax.vmap(NET.apply, (None, 0, 0, 0)))(variables, *stacked, cells)
    for index, pair in enumerate(pairs):
        one = run(variables, *pair, cells[index])
        jax.tree.map(lambda all_, one, index=index: np.testing.assert_allclose(all_[index], one, atol=1e-4), batch, one)


def test_jit_equals_eager(variables):
    """The refinement and the target mask, which hold every kind of step but the convolutional trunk."""
    match, place, _ = run(variables, random_map(0), random_map(1), PICK)
    for method, inputs in (("refine", (place, jnp.int32(2), PICK)), ("target_mask", (random_map(1), match, PICK))):
        eager = NET.apply(variables, *inputs, method=method)
        np.testing.assert_allclose(jax.jit(lambda *x, how=method: NET.apply(variables, *x, method=how))(*inputs), eager, atol=1e-5)


def test_starts_near_zero(variables):
    """Pick and place begin near indifference and the refinement at no offset, or the first steps go to undoing the start."""
    match, place, offset = run(variables, build({(3, 4): [RED], (12, 2): [BLUE]}), build({(8, 6): [RED, BLUE]}), PICK)
    for logits in (match.pick, place.logits):
        assert np.std(logits) < 2 and np.ptp(logits) < 10
    assert np.abs(offset).max() < 0.2


def test_pick_logits_equal_a_loop_over_tokens(variables):
    """With the fine part silenced, a cell's logit is the log-sum-exp over valid goal tokens of next + <current, token>."""
    params = dict(variables["params"])
    params["pick_out"] = jax.tree.map(jnp.zeros_like, params["pick_out"])
    match = jax.device_get(look({"params": params}, build({(3, 4): [RED], (12, 2): [BLUE]}), build({(8, 6): [RED, BLUE]})))
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


def test_highest_takes_the_top_occupied_slice():
    rng = np.random.default_rng(0)
    values, seen = rng.normal(size=(5, 4, 3, 2)).astype(np.float32), rng.random((5, 4, 3)) < 0.5
    given = goal_aware._highest(jnp.asarray(values), jnp.asarray(seen))
    for i, j in np.ndindex(5, 4):
        if seen[i, j].any():
            np.testing.assert_array_equal(given[i, j], values[i, j, np.flatnonzero(seen[i, j])[-1]])


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
def test_target_mask_marks_the_matching_colour(variables, picked, other):
    """Alone on the table now and in the goal, a block looks the same in both: its mask is 1 there, less on the other, 0 elsewhere."""
    now = {(3, 4): [RED], (12, 2): [BLUE]}
    home = {(3, 4): (8, 6), (12, 2): (16, 7)}
    goal = build({home[(3, 4)]: [RED], home[(12, 2)]: [BLUE]})
    match = look(variables, build(now), goal)
    mask, height = np.moveaxis(np.asarray(NET.apply(variables, goal, match, 2 * jnp.array(picked), method="target_mask")), -1, 0)
    seen = np.zeros(mask.shape, bool)
    for row, col in home.values():
        seen[2 * row : 2 * row + 2, 2 * col : 2 * col + 2] = True
    assert ((mask > 0) <= seen).all() and ((height > 0) <= seen).all()
    right, wrong = 2 * np.array(home[picked]), 2 * np.array(home[other])
    np.testing.assert_allclose(mask[tuple(right)], 1, atol=1e-5)
    assert mask[tuple(wrong)] < 0.9
    np.testing.assert_allclose(height[tuple(right)], 1.5 * SPEC.slice_height * goal_aware.HEIGHT_SCALE, rtol=1e-5)


def test_target_mask_leaves_out_columns_where_the_goal_saw_nothing(variables):
    """A token is two cells wide; the cell of it that no point fell into stays out."""
    now, goal = build({(3, 4): [RED]}), build({(8, 6): [RED]})
    goal = goal.replace(count=goal.count.at[16, 12].set(0))
    match = look(variables, now, goal)
    mask = np.asarray(NET.apply(variables, goal, match, jnp.array([6, 8]), method="target_mask"))
    assert (mask[16, 12] == 0).all() and (mask[17, 13] > 0).all()


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turning_what_is_picked_rolls_the_place_logits(variables, quarters):
    """For a fixed key, what hangs from the pick turned by a quarter needs a quarter less: `out(b) = before(b + k / 4)`.

    The key reads the current map's height; with that one input silenced it depends on the goal alone.
    """
    net = goal_aware.GoalAware(spec=SQUARE, **SIZES)
    params = jax.tree.map(jnp.array, variables["params"])
    kernel = params["key_net"]["Conv_0"]["kernel"]
    params["key_net"]["Conv_0"]["kernel"] = kernel.at[:, :, 4].set(0)
    goal = random_map(1, SQUARE)
    match = jax.tree.map(lambda leaf: leaf[:10] if leaf.shape[0] == 20 else leaf, look(variables, random_map(0), random_map(1)))
    match = match.replace(token=match.token.at[:, 0].set(match.token[:, 0] % 10))
    pick = np.array([9, 9])
    around = slice(2, 17)  # the pick is in the middle of it
    whole = random_map(4, SQUARE)
    place = jax.jit(lambda current: net.apply({"params": params}, current, goal, match, jnp.asarray(pick), method="place").logits)

    def turned(times):
        return jax.tree.map(lambda leaf: jnp.zeros_like(leaf).at[around, around].set(_quarter_turn(leaf[around, around], times)), whole)

    np.testing.assert_allclose(place(turned(quarters)), np.roll(place(turned(0)), -2 * quarters, axis=0), atol=1e-4)
    assert np.ptp(place(turned(0))) > 1e-3


def _quarter_turn(picture, times):
    """Turn `[n, n, ...]` (rows along +y, cols along +x) about its middle by quarters about world z, one cell after another."""
    picture, n = np.asarray(picture), len(picture)
    out, middle = np.zeros_like(picture), n // 2
    for row in range(n):
        for col in range(n):
            y, x = row - middle, col - middle
            x, y = np.round(transforms.apply_se2(np.array([0, 0, times * np.pi / 2]), np.array([x, y], float))).astype(int)
            out[y + middle, x + middle] = picture[row, col]
    return jnp.asarray(out)


def test_refine_reads_the_patch_under_the_cell(variables):
    """The offset at a cell depends on the key input within half a crop and on the crop of its bin, on nothing else."""
    _, place, _ = run(variables, random_map(0), random_map(1), PICK)
    refine = jax.jit(lambda place: NET.apply(variables, place, jnp.int32(3), jnp.array([20, 10]), method="refine"))
    before = refine(place)
    far = jnp.ones((40, 20, 1), bool).at[16:24, 6:14].set(False)
    crops = jnp.where(jnp.arange(8)[:, None, None, None] == 3, place.crops, 7.0)
    other = place.replace(key_input=jnp.where(far, 7.0, place.key_input), crops=crops)
    np.testing.assert_array_equal(refine(other), before)
    assert not np.array_equal(refine(place.replace(key_input=place.key_input.at[16, 6].add(1.0))), before)
    assert not np.array_equal(refine(place.replace(crops=place.crops.at[3].add(1.0))), before)
