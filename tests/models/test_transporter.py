"""The paper's policy: sizes at full scale, and the geometry of crop, correlation and padding on small maps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from lala_jax.models import streams, transporter

SMALL = {"yaw_bins": 4, "crop": 8, "width": 8, "stages": 2}


def _maps(rows=12, cols=8, channels=4):
    return jax.random.normal(jax.random.key(0), (2, rows, cols, channels))


def _drawn(net, *maps):
    """Parameters that keep a picture's size through ReLUs, biases too, drawn by numpy."""
    rng, shapes = np.random.default_rng(0), jax.eval_shape(net.init, jax.random.key(0), *maps)
    return jax.tree.map(lambda s: rng.normal(0, (2 / max(np.prod(s.shape[:-1]), 8)) ** 0.5, s.shape).astype(np.float32), shapes)


def _built(rows=12, cols=8, **options):
    net = transporter.Transporter(**(SMALL | options))
    current, goal = _maps(rows, cols)
    return net, jax.jit(net.init)(jax.random.key(1, impl="rbg"), current, goal), current, goal


@pytest.mark.parametrize("variant, parameters", [("single", 29_466_832), ("two_stream", 58_933_706), ("two_stream_lateral", 59_451_146)])
def test_paper_size(variant, parameters):
    """Three networks of one, two, and two hourglasses of 9.82 M parameters."""
    net = transporter.Transporter(variant)
    image = jax.ShapeDtypeStruct((320, 160, 4), jnp.float32)
    params = jax.eval_shape(net.init, jax.random.key(0), image, image)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == parameters
    assert abs(parameters / (3 if variant == "single" else 6) / 9.82e6 - 1) < 0.01
    logits, intermediates = jax.eval_shape(net.apply, params, image, image, jax.ShapeDtypeStruct((2,), jnp.int32))
    assert logits["pick"].shape == (320, 160) and logits["place"].shape == (36, 320, 160)
    assert intermediates["key"].shape == (384, 224, 3) and intermediates["query"].shape == (36, 64, 64, 3)


def _public_hourglass(channels, out, *, biases):
    """Add up `ResNet43_8s`, with biases as in Ravens or only the first layer's as in CLIPort."""
    total, before = 9 * channels * 64 + 64, 64
    for width, last in ((64, 64), (128, 128), (256, 256), (512, 512), (256, 256), (128, 128), (64, 64), (16, out)):
        for shortcut, entering in ((True, before), (False, last)):
            total += entering * width + 9 * width * width + width * last + shortcut * entering * last
            total += biases * (2 * width + last + shortcut * last)
        before = last
    return total


@pytest.mark.parametrize(
    "variant, goal_nets, public, biases",
    [
        ("transporter", 0, 29_470_288, 0),  # CLIPort's OriginalTransporterAgent: attn_stream, key_resnet, query_resnet
        ("image_goal", 1, 39_293_792, 0),  # CLIPort's ImageGoalTransporterAgent: the same and goal_resnet
        ("goal_split", 1, 39_333_502, 39_710),  # Ravens' GoalTransporterAgent: Attention, s0_, s1_, s2_ of TransportGoal
    ],
)
def test_rivals_have_the_public_parameters(variant, goal_nets, public, biases):
    """Six channels, as colour and three times the height; what ours lack are Ravens' biases."""
    counts = [_public_hourglass(6, out, biases=biases > 0) for out in (1, *[3] * (2 + goal_nets))]
    assert sum(counts) == public
    net = transporter.Transporter(variant)
    image = jax.ShapeDtypeStruct((320, 160, 6), jnp.float32)
    cell = jax.ShapeDtypeStruct((2,), jnp.int32)
    params = jax.eval_shape(net.init, jax.random.key(0), image, image, cell, image)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == public - biases
    logits, intermediates = jax.eval_shape(net.apply, params, image, image, cell, image)
    assert logits["pick"].shape == (320, 160) and logits["place"].shape == (36, 320, 160)
    assert intermediates["key"].shape == (384, 224, 3) and intermediates["query"].shape == (36, 64, 64, 3)


def _padded_and_cropped(*images, cell):
    """What the pick, the key and the query network see of each image, 12 x 8, with a crop of 8 around `cell`."""
    square = [np.pad(one, ((0, 0), (2, 2), (0, 0))) for one in images]
    wide = [np.pad(one, ((4, 4), (4, 4), (0, 0))) for one in images]
    return square, wide, [reference.quarter_crops(one, cell, 8) for one in images]


def _assert_equal(logits, intermediates, pick, key, query):
    """Compare both logits with those of the three networks' features in NumPy, and key and query with theirs."""
    for found, wanted in ((logits["pick"], pick[:, 2:-2, 0]), (intermediates["key"], key), (intermediates["query"], query)):
        np.testing.assert_allclose(found, wanted, atol=1e-4)
    place = reference.places(key, query) / 8 / 3**0.5
    np.testing.assert_allclose(logits["place"], place, atol=1e-3 * place.std())


@pytest.mark.parametrize("variant", streams.VARIANTS)
def test_the_papers_agents_equal_their_formulas_in_numpy(variant):
    """From the maps to both logits on the same random weights: the query's goal is cropped at the pick, as the paper has it."""
    net = transporter.Transporter(variant, **(SMALL | {"width": 4}))
    maps, cell = np.asarray(_maps()), (8, 2)
    params = _drawn(net, *maps, np.array(cell))
    seen = zip(("pick", "key", "query"), _padded_and_cropped(*maps, cell=cell), strict=True)
    features = [reference.streams(params["params"][f"{name}_net"], variant, *both, 2) for name, both in seen]
    _assert_equal(*jax.jit(net.apply)(params, *maps, jnp.array(cell)), *features)


@pytest.mark.parametrize("variant", ["transporter", "image_goal", "goal_split"])
def test_rivals_equal_their_formulas_in_numpy(variant):
    """From the maps to both logits on the same random weights, and a goal matters unless it is ignored."""
    net = transporter.Transporter(variant, **(SMALL | {"width": 4}))
    current, goal = np.asarray(_maps())
    both, cell = current * goal + 1, (8, 2)
    params = _drawn(net, current, goal, np.array(cell), both)
    apply = jax.jit(net.apply)
    logits, intermediates = apply(params, current, goal, jnp.array(cell), both)

    def features(name, *maps):
        return [reference.hourglass(params["params"][f"{name}_net"], one, 2) for one in maps]

    square, wide, crops = _padded_and_cropped(current, goal, both, cell=cell)
    if variant == "transporter":
        (pick,), (key,), (query,) = features("pick", square[0]), features("key", wide[0]), features("query", crops[0])
    if variant == "image_goal":
        (pick,), (key,), (query,) = features("pick", square[2]), features("key", wide[0]), features("query", crops[0])
        more_key, more_query = features("goal", wide[1], crops[1])
        key, query = key + more_key, query + more_query
    if variant == "goal_split":
        (pick,), (key,), (query,), (times,) = (
            features(name, one) for name, one in (("pick", square[0]), ("key", wide[0]), ("query", wide[0]), ("goal", wide[1]))
        )
        key, query = key * times, reference.quarter_crops(query * times, (12, 6), 8)
    _assert_equal(logits, intermediates, pick, key, query)
    again, _ = apply(params, current, goal[::-1], jnp.array(cell), both[::-1])
    assert np.array_equal(again["place"], logits["place"]) == (variant == "transporter")
    assert np.array_equal(again["pick"], logits["pick"]) == (variant != "image_goal")


@pytest.mark.parametrize("variant", ["transporter", "image_goal", "goal_split"])
def test_turning_both_maps_by_a_bin_turns_picks_and_places(variant):
    """With networks that look at single cells the law is exact: all turns about z, and what a held thing is turned by stays."""
    net = transporter.Transporter(variant, **(SMALL | {"crop": 9, "width": 4, "stages": 1}))
    maps = np.asarray(_maps(15, 15))
    both = maps[0] * maps[1]
    params = _drawn(net, *maps, np.array([6, 9]), both)
    centre = np.zeros((3, 3, 1, 1), np.float32)
    centre[1, 1] = 3.0
    params = jax.tree.map(lambda leaf: leaf * centre if leaf.shape[:2] == (3, 3) else leaf, params)
    apply = jax.jit(net.apply)
    logits, _ = apply(params, *maps, jnp.array([6, 9]), both)
    # (row, col) goes to (col, -row)
    turned, _ = apply(params, *np.swapaxes(maps[:, ::-1], 1, 2), jnp.array([9, 14 - 6]), np.swapaxes(both[::-1], 0, 1))
    np.testing.assert_allclose(turned["pick"], logits["pick"][::-1].T, atol=1e-4)
    expected = np.swapaxes(logits["place"][:, ::-1], 1, 2)
    np.testing.assert_allclose(turned["place"], expected, atol=1e-3 * expected.std())
    assert not np.allclose(turned["place"], np.roll(expected, 1, axis=0), atol=expected.std())


def test_key_and_query_alone_are_those_of_place():
    """What "goal_split" cuts its kernels of is the query of the padded maps."""
    net = transporter.Transporter("goal_split", **(SMALL | {"width": 4, "stages": 1}))
    maps = np.asarray(_maps())
    params, cell = _drawn(net, *maps), jnp.array([3, 5])

    @jax.jit
    def both(params, current, goal):
        bound, wide = net.bind(params), [jnp.pad(one, ((4, 4), (4, 4), (0, 0))) for one in (current, goal)]
        cut = transporter.pick_crops(bound.query(*wide), cell + 4, yaw_bins=4, crop=8)
        return bound.place(current, goal, cell)[1], bound.key(current, goal), cut

    intermediates, key, query = both(params, *maps)
    np.testing.assert_allclose(intermediates["key"], key, atol=1e-5)
    np.testing.assert_allclose(intermediates["query"], query, atol=1e-5)


@pytest.mark.parametrize("variant", ["single", "two_stream_lateral", "goal_split"])  # the second holds every part of two_stream
def test_learns_everywhere_and_starts_near_zero(variant):
    net, params, current, goal = _built(variant=variant, stages=2 if variant == "two_stream_lateral" else 1)

    def loss(params, current, goal):
        logits, _ = net.apply(params, current, goal, jnp.array([3, 5]))
        chosen = logits["pick"][3, 5] + logits["place"][1, 7, 2]
        return sum(jax.nn.logsumexp(x) for x in logits.values()) - chosen, logits

    grads, logits = jax.jit(jax.grad(loss, has_aux=True))(params, current, goal)
    for name, cells in (("pick", 12 * 8), ("place", 4 * 12 * 8)):
        assert logits[name].size == cells and logits[name].dtype == jnp.float32
        assert jax.nn.logsumexp(logits[name]) - logits[name].max() > 0.3 * math.log(cells)
    for path, leaf in jax.tree.leaves_with_path(grads):
        assert np.isfinite(leaf).all() and np.any(leaf), f"no gradient reaches {jax.tree_util.keystr(path)}"


def test_the_best_pick_is_taken_where_none_is_given():
    net, params, current, goal = _built(variant="single", stages=1)
    apply = jax.jit(net.apply)
    logits, intermediates = apply(params, current, goal)
    best = np.unravel_index(np.argmax(logits["pick"]), (12, 8))
    np.testing.assert_array_equal(intermediates["pick_cell"], best)
    given, _ = apply(params, current, goal, jnp.array(best))
    np.testing.assert_allclose(given["place"], logits["place"], atol=1e-6)


def test_jit_equals_eager_and_vmap_equals_a_loop():
    net, params, current, goal = _built(variant="single", stages=1)
    cells = jnp.array([[2, 3], [11, 0]])
    batch = jax.jit(jax.vmap(net.apply, (None, 0, 0, 0)))(params, jnp.stack([current, goal]), jnp.stack([goal, current]), cells)
    for index, pair in enumerate([(current, goal), (goal, current)]):
        one = net.apply(params, *pair, cells[index])
        jax.tree.map(lambda all_, one, index=index: np.testing.assert_allclose(all_[index], one, atol=2e-5), batch, one)


def test_maps_are_padded_before_they_are_converted():
    """Crops are cut from converted ones. XLA folds the padding of a converted map into the convolution: see the module."""
    net, *inputs = _built(dtype=jnp.bfloat16)
    text = jax.jit(net.apply).lower(*inputs).as_text()
    padded = [line.rpartition("(")[2] for line in text.splitlines() if "stablehlo.pad" in line and "(tensor<12x8x4x" in line]
    assert len(padded) == 2 and all(line.startswith("tensor<12x8x4xf32>") for line in padded)
    assert "tensor<12x8x8xbf16>" in text


@pytest.mark.parametrize("variant", ["transporter", "two_stream"])
def test_picks_are_told_apart_in_float32(variant):
    """Whatever the rest computes in: rounded to bfloat16, many neighbours would be equal and the first of them chosen."""
    net, params, current, goal = _built(variant=variant, dtype=jnp.bfloat16)
    pick = np.asarray(jax.jit(net.apply)(params, current, goal, jnp.array([4, 4]))[0]["pick"])
    rounded = pick.astype(jnp.bfloat16).astype(np.float32)
    assert (pick != rounded).mean() > 0.9 and len(np.unique(rounded)) < len(np.unique(pick)) == pick.size
    single = jax.jit(net.clone(dtype=jnp.float32).apply)(params, current, goal, jnp.array([4, 4]))[0]["pick"]
    np.testing.assert_allclose(pick, single, atol=0.05 * np.std(single))


def test_maps_of_any_size_keep_their_cells():
    """Sides that the strides do not divide are padded and cut: a map with a border of zeros spelled out scores the same."""
    net, params, current, goal = _built(rows=11, cols=7, variant="single")
    logits, intermediates = jax.jit(net.apply)(params, current, goal, jnp.array([4, 4]))
    assert logits["pick"].shape == (11, 7) and logits["place"].shape == (4, 11, 7)
    assert intermediates["key"].shape == (19, 15, 3)

    def pad(x, top, bottom, left, right):
        return jnp.pad(x, ((top, bottom), (left, right), (0, 0)))

    pick = jax.jit(lambda params, *maps: net.bind(params).pick_net(*maps))(params, *(pad(x, 0, 1, 2, 3) for x in (current, goal)))
    np.testing.assert_allclose(logits["pick"], pick[:11, 2:9, 0], atol=1e-5)
    key = jax.jit(lambda params, *maps: net.bind(params).key_net(*maps))(params, *(pad(x, 4, 5, 4, 5) for x in (current, goal)))
    np.testing.assert_allclose(intermediates["key"], key[:19, :15], atol=1e-5)


@pytest.mark.parametrize("crop", (8, 9))
@pytest.mark.parametrize("turn, row, col", [(0, 9, 8), (3, 12, 7), (5, 5, 11)])
def test_a_held_pattern_scores_best_where_it_was_pasted(crop, turn, row, col):
    """Whatever is under the pick, turned and pasted about a cell, is found at that cell and turn: no half cell is lost."""
    rng = np.random.default_rng(turn)
    scene, pick = jnp.asarray(rng.normal(size=(20, 16, 3)), jnp.float32), jnp.array([7, 6])
    crops = transporter.pick_crops(scene, pick, yaw_bins=6, crop=crop)
    margin = crop // 2
    key = np.zeros((20 + 2 * margin, 16 + 2 * margin, 3), np.float32)
    key[row : row + crop, col : col + crop] = crops[turn]  # index crop // 2 of the crop falls on cell (row, col)
    norms = jnp.linalg.norm(crops.reshape(6, -1), axis=-1)[:, None, None, None]
    scores = transporter.place_logits(jnp.asarray(key), crops / norms, scale=0.5)
    assert scores.shape == (6, 20, 16)
    assert np.unravel_index(np.argmax(scores), scores.shape) == (turn, row, col)
    np.testing.assert_allclose(scores[turn, row, col], 0.5 * norms[turn].squeeze(), rtol=1e-4)


def test_turning_the_scene_by_one_bin_turns_the_place_map_by_one_bin():
    """A quarter turn moves cells onto cells, so crop b of the turned map is crop b + 1 of the map, and places shift by a bin."""
    maps = jax.random.normal(jax.random.key(0), (15, 15, 2))
    turned = jnp.swapaxes(maps[::-1], 0, 1)  # (row, col) goes to (col, -row): +x to +y
    crops = transporter.pick_crops(maps, jnp.array([7, 7]), yaw_bins=4, crop=9)
    np.testing.assert_allclose(transporter.pick_crops(turned, jnp.array([7, 7]), yaw_bins=4, crop=9), np.roll(crops, -1, axis=0), atol=1e-5)

    def scores(goal):
        return np.asarray(transporter.place_logits(jnp.pad(goal, ((4, 4), (4, 4), (0, 0))), crops, scale=1.0))

    before, after = scores(maps), scores(turned)
    np.testing.assert_allclose(after, np.roll(np.swapaxes(before[:, ::-1], 1, 2), 1, axis=0), atol=1e-3)


def test_normalising_undoes_the_statistics_and_passes_features():
    rng = np.random.default_rng(0)
    plain = rng.normal(size=(3, 2, 6)).astype(np.float32)
    seen = plain * np.array([transporter.COLOR_STD] * 3 + [1, 1, transporter.HEIGHT_STD], np.float32)
    seen += np.array([transporter.COLOR_MEAN] * 3 + [0, 0, transporter.HEIGHT_MEAN], np.float32)
    np.testing.assert_allclose(transporter.normalise(jnp.asarray(seen)), plain, atol=1e-5)


def test_slices_lie_side_by_side():
    rng = np.random.default_rng(0)
    color, height = rng.uniform(size=(3, 2, 4, 3)).astype(np.float32), rng.uniform(size=(3, 2)).astype(np.float32)
    seen = rng.random((3, 2, 4)) < 0.5
    found = transporter.normalise_slices(jnp.asarray(color), jnp.asarray(seen), jnp.asarray(height))
    assert found.shape == (3, 2, 17)
    for index in np.ndindex(3, 2, 4):
        own = found[index[:2]][4 * index[2] : 4 * index[2] + 4]
        wanted = [*(color[index] - transporter.COLOR_MEAN) / transporter.COLOR_STD, 1.0] if seen[index] else np.zeros(4)
        np.testing.assert_allclose(own, wanted, rtol=1e-5)
    np.testing.assert_allclose(found[..., -1], (height - transporter.HEIGHT_MEAN) / transporter.HEIGHT_STD, rtol=1e-5)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"variant": "both"}, "variant must be one of .*got 'both'"),
        ({"method": "direct"}, "method must be one of .*got 'direct'"),
        ({"crop": 60}, "crop must be a positive multiple of 8 for 4 stages, got 60"),
        ({"yaw_bins": 0}, "yaw_bins must be at least 1, got 0"),
    ],
)
def test_refuses_bad_options_when_built(options, message):
    with pytest.raises(ValueError, match=message):
        transporter.Transporter(**options)


def test_image_goal_asks_for_the_product():
    net, *_ = _built(variant="transporter")
    net = net.clone(variant="image_goal")
    with pytest.raises(ValueError, match='"image_goal" picks from the product of both images: give both'):
        jax.eval_shape(net.init, jax.random.key(0), *_maps())
