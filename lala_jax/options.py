"""The door between the command line, config files and the code: `defaults` aside the only place that sees `ml_collections`.

    python -m lala_jax.train --config=configs/pallet.py:smoke --workdir=/tmp/x --config.train.steps=10

A config file has `get_config()` or `get_config(arg)`, giving a ConfigDict (or dict) of groups whose leaves are bool, int, float,
str, None or tuples of them. A field keeps its type and a tuple its length; whatever else is asked for is refused in one screen.
"""

from __future__ import annotations

import ast
import copy
import difflib
import errno
import importlib.util
import inspect
import pathlib
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import ml_collections

# Errors of the system that the user can mend.
UNWRITABLE = {errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ENOSPC, errno.ENOTDIR, errno.EPERM, errno.EROFS}


class OptionsError(ValueError):
    """A request that the configuration or the command line cannot mean; its message is for the user."""


def load(config_file_and_arg: str, overrides: Iterable[str] = ()) -> ml_collections.ConfigDict:
    """Build the locked config of `path.py` or `path.py:arg` with `group.field=value` overrides applied.

    A relative path is looked for in the current directory, then beside the package (a checkout's `configs/`). Raises
    OptionsError naming the file, field, value and the valid choices.
    """
    name, argument = _split(config_file_and_arg)
    path = _find(name)
    get_config = getattr(_execute(path), "get_config", None)
    if not callable(get_config):
        raise OptionsError(f"config file {path} has no function get_config")
    takes_argument = bool(inspect.signature(get_config).parameters)
    if argument is not None and not takes_argument:
        raise OptionsError(f"get_config of {path} takes no argument, got {argument!r}")
    try:
        config = get_config(*([argument] if argument is not None else []))
    except ValueError as error:  # the file's own way to refuse an argument
        raise OptionsError(f"config file {path} with argument {argument!r}: {error}") from error
    if not isinstance(config, (ml_collections.ConfigDict, Mapping)):
        raise OptionsError(f"get_config of {path} gave {type(config).__name__}, expected a ConfigDict or dict")
    return override(config, overrides)


def override(config: ml_collections.ConfigDict | Mapping[str, Any], overrides: Iterable[str]) -> ml_collections.ConfigDict:
    """Give a locked copy of `config` with `group.field=value` strings applied in order; `config` stays as it is.

    Raises OptionsError listing every unknown field, wrong type and changed tuple length among them.
    """
    # not to_dict first: references between fields must still follow an override
    result = ml_collections.ConfigDict(copy.deepcopy(config))
    problems = []
    for text in overrides:
        name, equals, value = text.partition("=")
        try:
            if not equals:
                raise OptionsError(f"override {text!r} must read field=value")
            _assign(result, name, value)
        except OptionsError as error:
            problems.append(str(error))
    if problems:
        raise OptionsError("\n".join(problems))
    return from_dict(result.to_dict())


def to_dict(config: ml_collections.ConfigDict) -> dict[str, Any]:
    """Give the config as nested plain dicts, tuples kept (JSON makes them lists, `from_dict` undoes that)."""
    return copy.deepcopy(config.to_dict())


def from_dict(values: Mapping[str, Any]) -> ml_collections.ConfigDict:
    """Build a locked config from nested dicts, lists becoming tuples.

    Raises OptionsError naming a field whose value is no bool, int, float, str, None, sequence of these, or group.
    """
    return ml_collections.ConfigDict(_checked(values, "")).lock()


def check_choice(name: str, value: Any, valid: Iterable[Any]) -> Any:
    """Give `value` back if it is in `valid`; raise OptionsError naming the field, the value and the valid choices otherwise."""
    valid = list(valid)
    if not any(value == choice and type(value) is type(choice) for choice in valid):
        raise OptionsError(f"{name} must be one of {', '.join(map(repr, valid))}, got {value!r}{_suggest(str(value), map(str, valid))}")
    return value


def run(
    main: Callable[..., Any],
    *,
    flags: Mapping[str, Any] | None = None,
    config_from: Callable[[dict[str, Any]], ml_collections.ConfigDict | Mapping[str, Any]] | None = None,
    workdir: str | None = None,
    owned: Callable[[dict[str, Any]], Mapping[str, str]] | None = None,
    user_errors: tuple[type[Exception], ...] = (),
    argv: Sequence[str] | None = None,
) -> Any:
    """Parse the command line and call `main(config, workdir, **flags)`; what it returns is returned.

    Args:
      flags: further flags with their defaults, whose types they keep: `{"checkpoint": ""}` makes `--checkpoint=PATH`; an underscore is
        a hyphen there.
      config_from: gives the config from the flags when `--config` is not given (say, the one stored in a checkpoint);
        `--config.x=y` then changes that one. Without it `--config` is required.
      workdir: default of `--workdir`, which is required without one.
      owned: gives from the flags the fields that the program sets itself, and the flag, or whatever else, that says to what:
        `--config.x=y` of one is refused.
      user_errors: exceptions out of `main` that, like OptionsError and files that the system refuses, end with status 2 and their
        message alone. Ctrl-C ends with status 130.
      argv: arguments without the program's name; those of the process by default.
    """
    program = _program()
    try:
        given = _parse(sys.argv[1:] if argv is None else argv, dict(flags or {}))
        if given["help"]:
            print(_usage(program, main, dict(flags or {}), given["config"], workdir))
            return None
        directory = workdir if given["workdir"] is None else given["workdir"]
        if not directory:
            raise OptionsError("--workdir=DIRECTORY is required")
        _check_owned(given["overrides"], owned(given["flags"]) if owned is not None else {})
        if given["config"] is not None:
            config = load(given["config"], given["overrides"])
        elif config_from is not None:
            config = override(config_from(given["flags"]), given["overrides"])
        else:
            raise OptionsError("--config=FILE.py[:ARGUMENT] is required, for example --config=configs/pallet.py:smoke")
        return main(config, directory, **given["flags"])
    except (OptionsError, *user_errors) as error:
        print(f"{program}: {error}\n(--help lists the flags, and with --config its fields)", file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        if error.errno not in UNWRITABLE or error.filename is None:
            raise
        print(f"{program}: cannot read or write {error.filename}: {error.strerror}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(f"\n{program}: stopped; the same command goes on from what is on disk", file=sys.stderr)
        raise SystemExit(130) from None


def _check_owned(overrides: Iterable[str], owned: Mapping[str, str]) -> None:
    """Raise OptionsError for overrides that would be overridden themselves."""
    for text in overrides:
        if by := owned.get(text.partition("=")[0]):
            raise OptionsError(f"--config.{text} would have no effect: the field is set by {by}")


def _split(text: str) -> tuple[str, str | None]:
    """Split `path.py:arg`."""
    if text.endswith(".py"):
        return text, None
    path, marker, argument = text.partition(".py:")
    if not marker:
        raise OptionsError(f"--config must be FILE.py or FILE.py:ARGUMENT, got {text!r}")
    return path + ".py", argument


def _find(name: str) -> pathlib.Path:
    """Find a config file in the current directory or beside the package."""
    beside = pathlib.Path(__file__).resolve().parent.parent
    tried = list(dict.fromkeys([pathlib.Path.cwd() / name, beside / name]))
    for path in tried:
        if path.is_file():
            return path
    known = sorted({f"{path.parent.name}/{path.name}" for looked in tried for path in looked.parent.glob("*.py")})
    message = f"no config file {name}; looked for\n" + "\n".join(f"  {path}" for path in tried)
    raise OptionsError(message + (f"\nfiles there: {', '.join(known)}{_suggest(name, known)}" if known else ""))


def _execute(path: pathlib.Path) -> Any:
    """Run a config file as a module of its own, under no importable name."""
    spec = importlib.util.spec_from_file_location(f"_config_{path.stem}", path)
    assert spec is not None and spec.loader is not None  # the suffix is .py
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise OptionsError(f"config file {path}, line {error.lineno}: {error.msg}") from error
    return module


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """List the entries of two flat mappings that are not the same."""
    changed = [name for name in sorted({**there, **here}) if there.get(name) != here.get(name)]
    return [f"{name} ({there.get(name)!r} there, {here.get(name)!r} here)" for name in changed]


def fields(config: Mapping[str, Any] | ml_collections.ConfigDict, prefix: str = "") -> dict[str, Any]:
    """List every leaf of a config or of nested dicts by its dotted name."""
    found = {}
    for key in config:
        if isinstance(config[key], (ml_collections.ConfigDict, Mapping)):
            found |= fields(config[key], f"{prefix}{key}.")
        else:
            found[prefix + key] = config[key]
    return found


def _assign(config: ml_collections.ConfigDict, name: str, text: str) -> None:
    """Set one field from text, or raise OptionsError with the valid choices."""
    group, parts = config, name.split(".")
    for depth, part in enumerate(parts):
        at = ".".join(parts[:depth]) or "the config"
        if not isinstance(group, ml_collections.ConfigDict):
            raise OptionsError(f"config field {name} does not exist: {at} is a value ({group!r}), not a group")
        if part not in group:
            prefix = "".join(f"{above}." for above in parts[:depth])
            siblings = [prefix + key for key in group]
            elsewhere = [field for field in fields(config) if field.split(".")[-1] == parts[-1]]
            hint = _suggest(prefix + part, siblings, elsewhere)
            raise OptionsError(f"unknown config field {name}{hint}\n" + _wrap(f"fields of {at}: {', '.join(siblings)}"))
        parent, group = group, group[part]
    if isinstance(group, ml_collections.ConfigDict):
        raise OptionsError(f"config field {name} is a group; set one of its fields\n" + _wrap(", ".join(f"{name}.{key}" for key in group)))
    value = _convert(f"config field {name}", text, group, parent.get_type(parts[-1]))
    with parent.unlocked():
        parent[parts[-1]] = value


def _convert(name: str, text: str, old: Any, kind: type) -> Any:
    """Read `text` as the type of the value `old`; `kind` is the declared type where `old` is None."""
    try:
        if kind is bool:
            return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
        if kind is int:
            return int(text)
        if kind is float:
            value = float(text)
            if value != value:
                raise ValueError
            return value
        if kind is str:
            return text
        if kind in (tuple, list):
            value = _literal(text, sequence=True)
            return kind(value if old is None else _like(value, tuple(old), name, text))
    except (KeyError, ValueError) as error:
        if isinstance(error, OptionsError):
            raise
        wanted = {bool: "a bool (true or false)", int: "an int", float: "a float"}[kind]
        raise OptionsError(f"{name} must be {wanted} like {old!r}, got {text!r}") from None
    return _literal(text)


def _literal(text: str, *, sequence: bool = False) -> Any:
    """Read a Python literal, else the text itself; with `sequence` a tuple, also from bare `a,b`."""
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = tuple(_literal(part.strip()) for part in text.split(",")) if sequence else text
    if sequence:
        return tuple(value) if isinstance(value, (tuple, list)) else (value,)
    return value


def _like(value: Any, old: Any, name: str, text: str) -> Any:
    """Check a tuple against the one it replaces: same length, same types inside (an int may stand for a float)."""
    if isinstance(old, tuple):
        if not isinstance(value, (tuple, list)) or len(value) != len(old):
            raise OptionsError(f"{name} must be a tuple of length {len(old)} like {old!r}, got {text!r}")
        return tuple(_like(new, was, name, text) for new, was in zip(value, old, strict=True))
    if isinstance(old, float) and type(value) is int:
        return float(value)
    if old is not None and type(value) is not type(old):
        raise OptionsError(f"{name} must hold {type(old).__name__} where it now has {old!r}, got {value!r} in {text!r}")
    return value


def _checked(value: Any, name: str) -> Any:
    """Copy a config value, tuples for lists, refusing what JSON and the command line could not carry."""
    if isinstance(value, Mapping):
        return {key: _checked(item, f"{name}.{key}" if name else str(key)) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(_checked(item, f"{name}[{index}]") for index, item in enumerate(value))
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise OptionsError(f"config field {name} is {type(value).__name__} {value!r}; valid: bool, int, float, str, None, tuples, groups")


def _suggest(wrong: str, valid: Iterable[str], also: Iterable[str] = ()) -> str:
    """Give `; did you mean a, b?` or nothing."""
    close = dict.fromkeys([*difflib.get_close_matches(wrong, list(valid), n=2), *also])
    return f"; did you mean {' or '.join(list(close)[:3])}?" if close else ""


def _wrap(text: str) -> str:
    """Fold long lists, and cut them at ten lines."""
    return "\n".join(textwrap.wrap(text, 110, initial_indent="  ", subsequent_indent="    ", max_lines=10, break_long_words=False))


def _parse(argv: Sequence[str], flags: dict[str, Any]) -> dict[str, Any]:
    """Sort arguments into `config`, `overrides`, `workdir`, `flags` and `help`; `--name value` is `--name=value`."""
    given: dict[str, Any] = {"config": None, "workdir": None, "overrides": [], "flags": dict(flags), "help": False}
    rest = list(argv)
    while rest:
        token = rest.pop(0)
        if token in ("--help", "-h"):
            given["help"] = True
            continue
        name, equals, value = token.removeprefix("--").partition("=")
        name = name.replace("-", "_") if name.replace("-", "_") in flags else name
        if not token.startswith("--") or not (name in ("config", "workdir", *flags) or name.startswith("config.")):
            valid = ["--config", "--workdir", *(f"--{flag.replace('_', '-')}" for flag in flags)]
            hint = _suggest(token.partition("=")[0], valid)
            raise OptionsError(f"unknown argument {token!r}{hint}\n" + _wrap(f"valid: {', '.join(valid)}, --config.FIELD=VALUE"))
        if not equals:
            if not rest or rest[0].startswith("--"):
                raise OptionsError(f"{token} needs a value: {token}=VALUE")
            value = rest.pop(0)
        if name.startswith("config."):
            given["overrides"].append(f"{name.removeprefix('config.')}={value}")
        elif name in ("config", "workdir"):
            given[name] = value
        else:
            given["flags"][name] = _convert(f"--{name.replace('_', '-')}", value, flags[name], type(flags[name]))
    return given


def _usage(program: str, main: Callable[..., Any], flags: dict[str, Any], config: str | None, workdir: str | None) -> str:
    """Compose the help text from what the module of `main` says of itself, with the fields of `config` where one is named."""
    lines = [
        f"usage: python -m {program} [--config=FILE.py[:ARGUMENT]] [--workdir=DIRECTORY] [--FLAG=VALUE ...] [--config.FIELD=VALUE ...]"
    ]
    lines += [f"\n{inspect.getdoc(sys.modules[main.__module__]) or ''}\n", "flags and their defaults:"]
    lines += [f"  --workdir={workdir!r}" if workdir else "  --workdir=DIRECTORY, required"]
    lines += [f"  --{name.replace('_', '-')}={default!r}" for name, default in flags.items()]
    if config is not None:
        lines += [f"  --config.{name}={value!r}" for name, value in fields(load(config)).items()]
    return "\n".join(line for line in lines if line)


def _program() -> str:
    """Name the module that runs."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    return spec.name if spec is not None else pathlib.Path(sys.argv[0]).name
