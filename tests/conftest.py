"""Settings that every test shares; they must be in place before JAX is first imported."""

import os
import pathlib
import runpy
import sys
import tempfile
import types
import warnings

import jaxtyping
import pytest

if "jax" in sys.modules:
    raise RuntimeError("tests/conftest.py must run before jax is imported: a plugin or -p option imported it first")

_CACHE = pathlib.Path(tempfile.gettempdir()) / f"lala_jax-compilation-cache-{os.getuid()}"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # several test processes share one GPU
# Tests compile for much longer than they run: without LLVM's optimisations they take two thirds of the time.
if "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0".strip()

# From here on, every call into perception checks the shapes and types that the signature states.
jaxtyping.install_import_hook("lala_jax.perception", "beartype.beartype")


@pytest.fixture
def call(monkeypatch, capsys):
    """Run `python -m module arguments` in this process: its `status`, and what it wrote to `out` and `err`."""

    def run(module, *arguments):
        monkeypatch.setattr(sys, "argv", [module, *map(str, arguments)])
        status = 0
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*found in sys.modules", RuntimeWarning)
            try:
                runpy.run_module(module, run_name="__main__", alter_sys=True)
            except SystemExit as error:
                status = error.code
        said = capsys.readouterr()
        return types.SimpleNamespace(status=status, out=said.out, err=said.err)

    return run


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))
