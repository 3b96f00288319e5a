"""Programs are compiled once, counted right, and kept where the user's cache is."""

import jax
import jax.numpy as jnp
import pytest

from lala_jax import compiling

FIELDS = ("jax_compilation_cache_dir", "jax_enable_compilation_cache")


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """JAX's settings as a user has them who set none, in a home of their own; restored afterwards."""
    before = {name: getattr(jax.config, name) for name in FIELDS}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_in_the_users_cache(settings, tmp_path):
    compiling.keep()
    folder = tmp_path / "lala_jax" / "xla"
    assert settings.jax_compilation_cache_dir == str(folder) and folder.stat().st_mode & 0o777 == 0o700


def test_where_the_user_says_otherwise_nothing_changes(settings, tmp_path):
    settings.update("jax_enable_compilation_cache", False)
    compiling.keep()
    assert settings.jax_compilation_cache_dir is None
    settings.update("jax_enable_compilation_cache", True)
    settings.update("jax_compilation_cache_dir", "elsewhere")
    compiling.keep()
    assert settings.jax_compilation_cache_dir == "elsewhere" and not any(tmp_path.iterdir())


def test_a_cache_that_cannot_be_written_is_told(settings, monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compiling.keep()
    assert settings.jax_compilation_cache_dir is None and "compiled programs are not kept" in capsys.readouterr().err


def test_donated_memory_is_counted_once_and_static_arguments_are_left_out():
    x = jnp.zeros(1 << 18)
    jitted = compiling.jit(lambda n, x: x + n, static_argnums=0, donate_argnums=1)
    program, facts = compiling.build(jitted, 3, x)
    assert x.nbytes <= facts["memory"] < 1.5 * x.nbytes and facts["compile_seconds"] > 0
    assert float(program(x)[0]) == 3.0 and x.is_deleted()
