"""How the programs with a network in them are compiled, what they need, and what is kept: programs for the next process, memory here."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import math
import os
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval

# On a CPU, XLA hands convolutions and what is around them to a library, YNN. The kernel gradient of a 3x3 convolution of 24 channels
# over 8 x 160 x 80 cells takes it 157 ms, and XLA's own convolution 13 (jaxlib 0.10.2, two cores). "" hands it nothing; other platforms
# do not care.
OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}

# In the order that takes the least memory a paper-size training step needs half of it; smaller programs would become slower.
LEAN = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
LARGE = 2 << 30  # bytes

DRAWN_SIZES = tuple(4**i for i in range(4, 16))  # how many random numbers `step_by_step` draws at once
_DRAWS = {"_truncated_normal": jax.random.truncated_normal, "_normal": jax.random.normal}
_MIN_SECONDS = "jax_persistent_cache_min_compile_time_secs"  # JAX's setting: what took less to compile is not kept
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of glibc's malloc.h

jit = functools.partial(jax.jit, compiler_options=OPTIONS)
"""`jax.jit` with OPTIONS; as with any compiler options, what it wraps cannot be called in another jitted function."""


def jit_step(function: Callable[..., Any], *, state: int = 0, **how: Any):
    """Jit a step, whose argument number `state` becomes the first of its results: in the same memory (donated), unless on a GPU.

    There cuDNN gives gradients in an order of their own. The update turns them and cannot write in place, so that XLA would write the new
    state elsewhere and then copy it, entry for entry of the tree. This looks which platform there is, for which JAX starts.
    """
    return jit(function, donate_argnums=() if jax.default_backend() == "gpu" else state, **how)


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Let Python look for no garbage meanwhile: tracing makes a million small objects that stay, a quarter of its time is looking."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@uncollected()
def build(jitted, *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Compile a jitted function for its arguments, static ones among them, without running it.

    Gives the program, which takes those that are not static, and facts: `compile_seconds`, the `flops` of a run (see `flops`), the
    `bytes` that it moves as XLA counts them (of a program with a loop, whose body XLA counts once, the least that it moves: arguments and
    results), and the `memory` in bytes that it needs: arguments, results (those in donated memory once) and what is between. On a CPU a
    program that needs more than LARGE is compiled LEAN, and the memory that compiling has left is given back.
    """
    begin = time.perf_counter()
    traced = jitted.trace(*arguments)
    lowered, on_cpu = traced.lower(), jax.default_backend() == "cpu"
    large = on_cpu and stored(traced.jaxpr) > LARGE
    program = lowered.compile(LEAN if large else None)
    if on_cpu and not large and memory_of(program) > LARGE:
        program, large = lowered.compile(LEAN), True
    if large:
        _glibc("malloc_trim", 0)
    facts = {"compile_seconds": time.perf_counter() - begin}
    plan = program.memory_analysis() if _loops(traced.jaxpr) else None
    moved = plan.argument_size_in_bytes + plan.output_size_in_bytes if plan else (program.cost_analysis() or {}).get("bytes accessed", 0)
    counts = {"flops": flops(traced.jaxpr), "bytes": moved, "memory": memory_of(program)}
    return program, facts | {name: float(count) for name, count in counts.items() if count > 0}


@uncollected()
def step_by_step(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of arrays operation by operation, only those that its results need, each kind of each shape compiled once.

    For what runs once and does one thing over and over, such as drawing parameters: a jitted `init` compiles every draw anew. What is
    jitted within `function` stays one operation. Of those that `init` is made of, some are not even compiled for each shape: NumPy
    multiplies, repeats and copies, and of random numbers only DRAWN_SIZES are drawn.
    """
    traced, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    needed, _ = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars), instantiate=True)
    known = dict(zip((*needed.constvars, *needed.invars), (*traced.consts, *jax.tree.leaves(arguments)), strict=True))
    last = {variable: i for i, one in enumerate(needed.eqns) for variable in _variables(one.invars)}
    last |= dict.fromkeys(_variables(needed.outvars), len(needed.eqns))

    def read(one):
        return one.val if isinstance(one, core.Literal) else known[one]

    for i, equation in enumerate(needed.eqns):
        known |= zip(equation.outvars, _result(equation, [read(one) for one in equation.invars], needed.debug_info), strict=True)
        for variable in _variables(equation.invars):
            if last[variable] == i:
                known.pop(variable, None)  # twice where an operation has it twice
    results = [(read(one), one.aval.dtype) for one in needed.outvars]
    arrays = [one if isinstance(one, jax.Array) else jax.device_put(np.array(one, dtype)) for one, dtype in results]
    return jax.tree.unflatten(jax.tree.structure(shapes), arrays)


def draw(init: Callable[..., Any], seed: int, *arguments: Any) -> Any:
    """Draw a network's parameters, `init(key, *arguments)`, by `step_by_step` and with a key that compiles in a quarter of the time."""
    return step_by_step(init, jax.random.key(seed, impl="rbg"), *arguments)


def _variables(some):
    return [one for one in some if not isinstance(one, core.Literal)]


def _result(equation, given, debug_info) -> list[Any]:
    """Give the results of one operation of a jaxpr."""
    name, params, dtypes = equation.primitive.name, equation.params, [one.aval.dtype for one in equation.outvars]
    shape, dtype = (equation.outvars[0].aval.shape, dtypes[0]) if len(dtypes) == 1 and isinstance(dtypes[0], np.dtype) else ((), None)
    if name == "jit" and params["name"] in _DRAWS and dtype == np.float32 and jax.random.key_impl(given[0]) == "rbg":
        count = math.prod(shape)  # of more numbers the first are the same ones
        size = next((size for size in DRAWN_SIZES if size >= count), count)
        return [np.asarray(_DRAWS[params["name"]](*given, shape=(size,), dtype=dtype))[:count].reshape(shape)]
    if name == "mul" and dtype == np.float32:
        return [np.multiply(*map(np.asarray, given))]
    if name == "copy" and dtype is not None:
        return [np.asarray(given[0])]
    if name == "broadcast_in_dim" and dtype is not None and len(given) == 1:
        axes = params["broadcast_dimensions"]
        sides = [np.shape(given[0])[axes.index(axis)] if axis in axes else 1 for axis in range(len(shape))]
        return [np.broadcast_to(np.asarray(given[0], dtype).reshape(sides), shape)]
    alone = {one: value for one, value in zip(equation.invars, given, strict=True) if not isinstance(one, core.Literal)}
    jaxpr = core.Jaxpr((), list(alone), equation.outvars, [equation], debug_info=debug_info.with_unknown_names())
    return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, ()))(*alone.values())


def memory_of(program) -> float:
    """Give the bytes that a compiled program needs for a run, as XLA plans it; 0 where it does not tell."""
    plan = program.memory_analysis()
    if plan is None:
        return 0.0
    return float(plan.argument_size_in_bytes + plan.output_size_in_bytes - plan.alias_size_in_bytes + plan.temp_size_in_bytes)


def flops(jaxpr) -> float:
    """Count the operations of a jaxpr's matrix products, convolutions and Fourier transforms; the rest is left out.

    XLA counts a loop's body once, and on a GPU not what libraries do. Here a scan's is taken as often as it runs, that of a loop of
    unknown length once, and of branches the dearest. What no result needs is not counted: a derivative written by hand may give more than
    is asked for, and XLA leaves that out.
    """
    return _counted(_needed(jaxpr), _flops_of, loops=True)


def stored(jaxpr) -> float:
    """Count the bytes that a jaxpr's matrix products, convolutions and Fourier transforms give, of a loop one round's.

    XLA fuses none of them, so that each has memory. In its usual order on a CPU, a training step of our networks needs that much and up
    to a third more.
    """
    return _counted(_needed(jaxpr), lambda equation: float(sum(one.aval.size * one.aval.dtype.itemsize for one in equation.outvars)))


def _needed(jaxpr):
    """Give the jaxpr without what no result needs."""
    whole = getattr(jaxpr, "jaxpr", jaxpr)
    return partial_eval.dce_jaxpr(whole, [True] * len(whole.outvars))[0]


def _loops(jaxpr) -> bool:
    """Say whether there is a loop in a jaxpr."""
    equations = getattr(jaxpr, "jaxpr", jaxpr).eqns
    within = [one for equation in equations for value in equation.params.values() for one in _jaxprs(value)]
    return any(equation.primitive.name in ("scan", "while") for equation in equations) or any(map(_loops, within))


def _counted(jaxpr, count: Callable[[Any], float], *, loops: bool = False) -> float:
    """Sum `count` over the equations of _COUNTS, of branches the dearest, of a scan as often as it runs if `loops`, else once."""
    total = 0.0
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        name, params = equation.primitive.name, equation.params
        if name in _COUNTS:
            total += count(equation)
        within = [_counted(one, count, loops=loops) for value in params.values() for one in _jaxprs(value)]
        if within:
            total += max(within) if name == "cond" else sum(within) * (params["length"] if loops and name == "scan" else 1)
    return total


def _flops_of(equation) -> float:
    shapes = (variable.aval.shape for variable in (*equation.invars, *equation.outvars))
    return _COUNTS[equation.primitive.name](equation.params, *shapes)


def _jaxprs(value: Any) -> list[Any]:
    values = value if isinstance(value, tuple | list) else [value]
    return [one for one in values if hasattr(getattr(one, "jaxpr", one), "eqns")]


def _dot_flops(params, left, _, out) -> float:
    (contracted, _), _ = params["dimension_numbers"]
    return 2.0 * math.prod(out) * math.prod(left[axis] for axis in contracted)


def _conv_flops(params, image, kernel, out) -> float:
    """Count a product for each output and each entry of the kernel that lies over an input, not over padding."""
    layout, pairs = params["dimension_numbers"], 1.0
    for axis, step in enumerate(params["window_strides"]):
        here, there = layout.lhs_spec[2 + axis], layout.rhs_spec[2 + axis]
        at = np.arange(out[layout.out_spec[2 + axis]])[:, None] * step - params["padding"][axis][0]
        at = at + np.arange(kernel[there]) * params["rhs_dilation"][axis]
        apart = params["lhs_dilation"][axis]
        pairs *= ((at >= 0) & (at <= (image[here] - 1) * apart) & (at % apart == 0)).sum()
    return 2.0 * pairs * out[layout.out_spec[0]] * out[layout.out_spec[1]] * kernel[layout.rhs_spec[1]] / params["batch_group_count"]


def _fft_flops(params, before, _) -> float:
    """Count 5 n log2 n a complex transform of n entries, half of that a real one."""
    lengths = params["fft_lengths"]
    real = params["fft_type"].name not in ("FFT", "IFFT")
    size = math.prod(lengths)
    return math.prod(before[: -len(lengths)]) * 5.0 * size * math.log2(size) / (2 if real else 1)


_COUNTS = {"dot_general": _dot_flops, "conv_general_dilated": _conv_flops, "fft": _fft_flops}


def keep() -> None:
    """Keep what is dear for later, as every command does: `keep_memory` and `keep_programs`."""
    keep_memory()
    keep_programs()


def keep_memory() -> None:
    """Let this process keep the memory that its programs give back after each run, of pieces up to 1 GiB; on Linux with glibc.

    Otherwise the system hands it out again at the next run, filled with zeros, page by page: on two cores half the time of rendering four
    views. What lies between pieces in use is kept, too, so that a process may hold up to twice what a program needs. Does nothing where
    MALLOC_... or GLIBC_TUNABLES in the environment say what to do, or where there is no glibc.
    """
    if any(name == "GLIBC_TUNABLES" or name.startswith("MALLOC_") for name in os.environ):
        return
    for parameter, value in ((_ARENA_MAX, 1), (_MMAP_THRESHOLD, 1 << 30), (_TRIM_THRESHOLD, -1)):
        _glibc("mallopt", parameter, value)


def _glibc(name: str, *arguments: int) -> None:
    """Call a function of glibc's malloc; does nothing where there is another."""
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*arguments)


def keep_programs() -> None:
    """Keep compiled programs in the user's cache folder, for processes to come: their first training step is there in a third of the time.

    Small ones, too, of which a start compiles dozens. JAX_COMPILATION_CACHE_DIR names another folder,
    JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS what is too quick to be kept, JAX_ENABLE_COMPILATION_CACHE=false keeps nothing. The
    folder may be deleted.
    """
    if not jax.config.jax_enable_compilation_cache:
        return
    if jax.config.jax_compilation_cache_dir is None:
        folder = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "lala_jax" / "xla"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # what lies there is run
        except OSError as error:
            print(f"compiled programs are not kept: {error}", file=sys.stderr)
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if _MIN_SECONDS.upper() not in os.environ:
        jax.config.update(_MIN_SECONDS, 0.0)
