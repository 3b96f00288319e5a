"""Programs are compiled once, counted right, and kept where the user's cache is."""

import gc
import os
import resource
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from experiments import timing
from lala_jax import compiling
from lala_jax.models import convolution

FIELDS = ("jax_compilation_cache_dir", "jax_enable_compilation_cache", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """JAX's settings as a user has them who set none, in a home of their own; restored afterwards."""
    before = {name: getattr(jax.config, name) for name in FIELDS}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 5.0)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_in_the_users_cache(settings, tmp_path):
    compiling.keep_programs()
    folder = tmp_path / "lala_jax" / "xla"
    assert settings.jax_compilation_cache_dir == str(folder) and folder.stat().st_mode & 0o777 == 0o700
    assert settings.jax_persistent_cache_min_compile_time_secs == 0.0


def test_what_is_too_quick_to_keep_is_the_users_to_say(settings, monkeypatch):
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "5")
    compiling.keep_programs()
    assert settings.jax_compilation_cache_dir and settings.jax_persistent_cache_min_compile_time_secs == 5.0


def test_where_programs_are_kept_is_the_users_to_say(settings, tmp_path):
    settings.update("jax_enable_compilation_cache", False)
    compiling.keep_programs()
    assert settings.jax_compilation_cache_dir is None and settings.jax_persistent_cache_min_compile_time_secs == 5.0
    settings.update("jax_enable_compilation_cache", True)
    settings.update("jax_compilation_cache_dir", "elsewhere")
    compiling.keep_programs()
    assert settings.jax_compilation_cache_dir == "elsewhere" and not any(tmp_path.iterdir())
    assert settings.jax_persistent_cache_min_compile_time_secs == 0.0


def test_a_cache_that_cannot_be_written_is_told(settings, monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compiling.keep_programs()
    assert settings.jax_compilation_cache_dir is None and "compiled programs are not kept" in capsys.readouterr().err


FAULTS = """
import resource, sys
import jax, jax.numpy as jnp
from lala_jax import compiling
if sys.argv[1] == "keep":
    compiling.keep_memory()
program = jax.jit(lambda x: ((x @ x.T) * ((x + 1) @ x.T)).sum())
x = jnp.ones((3000, 100))
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    program(x).block_until_ready()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(sum([faults() for _ in range(8)][3:]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of Linux with glibc")
def test_memory_is_not_asked_for_again():
    """Of the pages that a program with pieces of 36 MB asks for, which is more than glibc learns to keep; who says what malloc is to do
    is left alone.
    """

    def pages(*arguments, **environment):
        command = [sys.executable, "-c", FAULTS, *arguments]
        return int(subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **environment}).stdout)

    asked = pages("ask")
    assert asked > 36_000_000 / resource.getpagesize() and 3 * pages("keep") < asked
    assert 3 * pages("keep", MALLOC_MMAP_THRESHOLD_="65536") > asked


@pytest.mark.parametrize("platform", ["cpu", "gpu", "tpu"])
def test_a_step_takes_its_states_memory_but_on_a_gpu(platform, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    jitted = compiling.jit_step(lambda n, state, x: (state + n * x, x), state=1, static_argnums=0)
    donated = [leaf.donated for leaf in jax.tree.leaves(jitted.lower(2, jnp.ones(3), jnp.ones(3)).args_info)]
    assert donated == [platform != "gpu", False]


def test_donated_memory_is_counted_once_and_static_arguments_are_left_out():
    x = jnp.zeros(1 << 18)
    jitted = compiling.jit(lambda n, x: x + n, static_argnums=0, donate_argnums=1)
    program, facts = compiling.build(jitted, 3, x)
    assert x.nbytes <= facts["memory"] < 1.5 * x.nbytes and facts["compile_seconds"] > 0
    assert float(program(x)[0]) == 3.0 and x.is_deleted()


@pytest.mark.parametrize("foreseen", [True, False])
def test_a_large_program_takes_less_memory_on_a_cpu(foreseen, monkeypatch):
    """Here eight branches that could run at once; by what is stored, before it is compiled, or by what it would need."""

    def loss(weights, x):
        hidden = [jnp.tanh(x @ w) for w in weights]
        return sum((y @ w.T).sum() for y, w in zip(hidden, weights, strict=True))

    weights, x = jnp.ones((8, 64, 512)), jnp.ones((512, 64))
    found, given_back, stored = [], [], compiling.stored
    monkeypatch.setattr(compiling, "stored", lambda jaxpr: stored(jaxpr) if foreseen else 0.0)
    monkeypatch.setattr(compiling, "_glibc", lambda *call: given_back.append(call))
    for platform, limit in (("cpu", 1 << 30), ("cpu", 1 << 20), ("tpu", 1 << 20)):
        monkeypatch.setattr(compiling, "LARGE", limit)
        monkeypatch.setattr(jax, "default_backend", lambda platform=platform: platform)
        program, facts = compiling.build(compiling.jit(loss), weights, x)
        found.append((facts["memory"], float(program(weights, x))))
    (plain, value), (lean, same), other = found
    assert lean < 0.5 * plain and same == pytest.approx(value, rel=1e-5) and other == (plain, value)
    assert given_back == [("malloc_trim", 0)]


def _conv(strides, padding, rhs_dilation=(1, 1)):
    def run(image, kernel):
        how = {"rhs_dilation": rhs_dilation, "dimension_numbers": ("NHWC", "HWIO", "NHWC")}
        return jax.lax.conv_general_dilated(image, kernel, strides, padding, **how)

    return run


IMAGE, KERNEL = (2, 12, 10, 3), (3, 4, 3, 5)


@pytest.mark.parametrize(
    "function, shapes",
    [
        (lambda x, y: x @ y, [(6, 5), (5, 7)]),
        (lambda x, y: jnp.einsum("bij,bjk->bik", x, y), [(3, 6, 5), (3, 5, 7)]),
        (_conv((1, 1), "SAME"), [IMAGE, KERNEL]),
        (_conv((2, 3), "VALID"), [IMAGE, KERNEL]),
        (_conv((1, 1), "SAME", (2, 1)), [IMAGE, KERNEL]),
        (jax.vjp(_conv((2, 2), "SAME"), jnp.ones(IMAGE), jnp.ones(KERNEL))[1], [(2, 6, 5, 5)]),
    ],
)
def test_operations_are_those_that_xla_counts(function, shapes):
    traced = jax.jit(function).trace(*[jnp.ones(shape) for shape in shapes])
    cost = traced.lower().cost_analysis()
    assert cost is not None and compiling.flops(traced.jaxpr) == pytest.approx(cost["flops"], rel=0.02)


def test_what_is_stored_is_what_products_convolutions_and_transforms_give():
    """Of a loop one round's, of branches the larger, and nothing that no result needs or that is no such operation."""

    def run(x):
        def round_(total, _):
            return total + jnp.fft.rfft(x @ x).real.sum(), None

        looped = jax.lax.scan(round_, 0.0, None, length=7)[0]
        branch = jax.lax.cond(looped > 0, lambda: (x[:2] @ x).sum(), lambda: (x @ x[:, :3] @ x[:3]).sum())
        return jnp.sin(x).sum() + branch, (x @ x @ x)[:0]

    whole = 4 * (10 * 10 + 10 * 6 * 2 + (10 * 3 + 10 * 10) + 2 * 10 * 10)
    assert compiling.stored(jax.jit(run).trace(jnp.ones((10, 10))).jaxpr) == whole
    assert compiling.stored(jax.jit(lambda x: run(x)[0]).trace(jnp.ones((10, 10))).jaxpr) == whole - 4 * 200


def test_what_no_result_needs_is_not_counted():
    """Neither in a loop, nor the input's gradient of a convolution whose derivative is written by hand."""
    x, kernel = jnp.ones((1, 8, 8, 40)), jnp.ones((3, 3, 40, 4))

    def count(function):
        return compiling.flops(jax.jit(function).trace(kernel).jaxpr)

    def convolve(kernel):
        return convolution.product_gradient(x, kernel, (1, 1), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC"))

    product = 2 * 64 * 9 * 40 * 4  # all cells with all entries
    assert count(jax.grad(lambda kernel: convolve(kernel).sum())) == product
    assert count(jax.value_and_grad(lambda kernel: convolve(kernel).sum())) == product + count(convolve)
    assert 0 == count(lambda kernel: jax.lax.scan(lambda c, _: (c, convolve(c)), kernel, length=3)[0]) < count(convolve)


def test_what_a_loop_does_is_counted_as_often_as_it_runs():
    x, once = jnp.ones((8, 8)), 2 * 8**3

    def count(function):
        return compiling.flops(jax.jit(function).trace(x).jaxpr)

    assert count(lambda x: jax.lax.scan(lambda c, _: (c @ c, None), x, length=7)[0]) == 7 * once
    assert count(lambda x: jax.lax.map(lambda row: (x @ x) @ row, x)) == 8 * (once + 2 * 64)
    assert count(lambda x: jax.lax.cond(x[0, 0] > 0, lambda: x @ x @ x, lambda: x @ x)) == 2 * once
    assert count(lambda x: jax.lax.while_loop(lambda c: c[0, 0] < 9, lambda c: c @ c, x)) == once
    assert count(lambda x: jnp.fft.fft(x.astype(jnp.complex64))) == 2 * count(jnp.fft.rfft) == 8 * 5 * 8 * 3


class Tower(nn.Module):
    """Equal layers, whose `init` draws an equal kernel for each."""

    layers: int

    @nn.compact
    def __call__(self, x):
        for _ in range(self.layers):
            x = nn.Dense(7)(x)
        return x


def test_draw_gives_what_init_draws_and_compiles_no_draw_twice():
    drawn = [compiling.draw(Tower(layers).init, 0, jnp.ones((1, 7))) for layers in (2, 9)]
    before = len(timing.compilations())
    again = compiling.draw(Tower(9).init, 0, jnp.ones((1, 7)))
    more = compiling.draw(Tower(12).init, 0, jnp.ones((1, 7)))
    assert len(timing.compilations()) == before
    whole = jax.jit(Tower(9).init)(jax.random.key(0, impl="rbg"), jnp.ones((1, 7)))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7), drawn[1], whole)
    jax.tree.map(np.testing.assert_array_equal, drawn[1], again)
    jax.tree.map(np.testing.assert_array_equal, drawn[0], {"params": {name: more["params"][name] for name in drawn[0]["params"]}})


class Mixed(nn.Module):
    """Parameters of many shapes and kinds, of which NumPy makes some."""

    @nn.compact
    def __call__(self, x):
        for width in (3, 70, 5):
            x = nn.Conv(width, (3, 2))(nn.LayerNorm()(x))
        start = nn.initializers
        scale = self.param("scale", start.constant(8.0), ())
        half = self.param("half", lambda key: start.normal(0.1)(key, (2, 3), jnp.bfloat16))
        tall = self.param("tall", start.orthogonal(), (4, 4))
        wide = self.param("wide", start.uniform(), (300, 7))
        return x * scale, half, tall, wide, self.param("rows", lambda key: start.normal(1e-2)(key, (3, 1)) * jnp.arange(4.0))


def test_draw_is_bit_for_bit_what_init_draws_alone():
    """Though of random numbers only some sizes are drawn, and NumPy multiplies, repeats and copies."""
    key, image = jax.random.key(3, impl="rbg"), jnp.ones((1, 9, 9, 2))
    before = len(timing.compilations())
    drawn = compiling.draw(Mixed().init, 3, image)
    programs = len(timing.compilations()) - before
    apart = Mixed().init(key, image)  # one operation after the other, as Flax does
    assert len(timing.compilations()) - before > 2 * programs
    for mine, theirs in zip(jax.tree.leaves(drawn), jax.tree.leaves(apart), strict=True):
        assert isinstance(mine, jax.Array) and (mine.dtype, mine.weak_type) == (theirs.dtype, False)
        np.testing.assert_array_equal(np.asarray(mine), np.asarray(theirs))
    assert jax.tree.structure(drawn) == jax.tree.structure(apart)


def test_step_by_step_copies_what_is_to_be_copied():
    """One buffer for each result, so that each may be donated; an argument that is a result stays itself."""
    x = jnp.arange(6.0)
    same, copied, twice = compiling.step_by_step(lambda x: (x, jnp.array(x), jnp.broadcast_to(x * 2, (3, 6))), x)
    assert same is x and copied.unsafe_buffer_pointer() != x.unsafe_buffer_pointer()
    np.testing.assert_array_equal(copied, x)
    np.testing.assert_array_equal(twice, np.tile(2 * np.arange(6.0), (3, 1)))


@pytest.mark.parametrize("wanted", [True, False])
def test_garbage_is_looked_for_again_after_compiling(wanted):
    """If it was before; also after an error."""
    was = gc.isenabled()
    try:
        gc.enable() if wanted else gc.disable()
        seen = []
        compiling.build(jax.jit(lambda x: [seen.append(gc.isenabled()), x + 1][1]), jnp.ones(2))
        with pytest.raises(ZeroDivisionError):
            compiling.step_by_step(lambda x: 1 // 0, jnp.ones(2))
        assert seen == [False] and gc.isenabled() == wanted
    finally:
        gc.enable() if was else gc.disable()


def test_step_by_step_leaves_out_what_no_result_needs():
    def function(tree):
        jnp.linalg.cholesky(tree["x"])
        return {"y": [tree["x"] + 1.0]}

    timing.compilations()
    found = compiling.step_by_step(function, {"x": jnp.eye(11)})
    np.testing.assert_array_equal(found["y"][0], np.eye(11) + 1.0)
    assert not any("cholesky" in name for name in timing.compilations())
    function({"x": jnp.eye(11)})
    assert any("cholesky" in name for name in timing.compilations())
