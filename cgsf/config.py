"""Configuration: frozen dataclasses from TOML, checked, and back to plain tables for the record.

A preset is a TOML file with one table a consumer, named as in :data:`cgsf.pipelines.METHODS`; what it leaves out
keeps the dataclass's default::

    description = "Quick: half the iterations"

    [variational]          # variational.solver.SolverConfig
    iterations = 20
    [variational.energy]   # a nested dataclass
    smoothness_weight = 0.2

Presets that ship are in ``cgsf/presets``; a path that ends in ``.toml`` is read instead.
"""

import dataclasses
import tomllib
import types
import typing
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from cgsf.errors import InputError

T = TypeVar("T")


def preset_names() -> list[str]:
    """The presets that ship with the package."""
    folder = resources.files("cgsf").joinpath("presets")
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))


def read_preset(name: str) -> dict[str, Any]:
    """The tables of a preset.

    Parameters
    ----------
    name : str
        A preset that ships (`preset_names`), or the path of a ``.toml`` file.

    Raises
    ------
    InputError
        For an unknown name, a missing file, and broken TOML.
    """
    try:
        if name.endswith(".toml"):
            text = Path(name).read_text(encoding="utf-8")
        elif name in preset_names():
            text = resources.files("cgsf").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
        else:
            raise InputError(f"unknown preset {name!r}; there are {', '.join(preset_names())}, or give a .toml file")
        return tomllib.loads(text)
    except FileNotFoundError:
        raise InputError(f"{name}: no such preset file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{name}: cannot be read as TOML ({error})") from None


def from_table(cls: type[T], table: dict[str, Any], where: str = "") -> T:
    """An instance of the dataclass `cls` from a table of plain values, nested tables for nested dataclasses.

    Parameters
    ----------
    cls : type
        A dataclass whose fields are bool, int, float, str, Literal, tuples of these, dataclasses, or ``... | None``.
    table : dict
        Values by field name; an int stands for a float too, nothing else is converted.
    where : str
        The table's name, for messages.

    Raises
    ------
    InputError
        For an unknown key, a value of the wrong type, and what the dataclass itself refuses.
    """
    if not isinstance(table, dict):
        raise InputError(f"{where or cls.__name__} must be a table, got {table!r}")
    hints = typing.get_type_hints(cls)
    names = [field.name for field in dataclasses.fields(cls) if field.init]  # type: ignore[arg-type]
    unknown = [key for key in table if key not in names]
    if unknown:
        raise InputError(f"unknown setting {_path(where, unknown[0])}; {where or cls.__name__} has {', '.join(names)}")
    values = {key: _value(hints[key], value, _path(where, key)) for key, value in table.items()}
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where or cls.__name__}: {error}") from None


def to_table(value: Any) -> Any:
    """A configuration as plain values that JSON and TOML know: the inverse of `from_table`."""
    if dataclasses.is_dataclass(value):
        return {field.name: to_table(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, list | tuple):
        return [to_table(item) for item in value]
    if isinstance(value, dict):
        return {str(key): to_table(item) for key, item in value.items()}
    return value


def _path(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _value(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint`, or an error that names the place."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value == "none" and type(None) in arguments:  # TOML has no null
            return None
        options = [argument for argument in arguments if argument is not type(None)]
        for option in options[:-1]:
            try:
                return _value(option, value, where)
            except InputError:
                continue
        return _value(options[-1], value, where)
    if origin is Literal:
        if value not in arguments:
            raise InputError(f"{where} must be one of {', '.join(map(repr, arguments))}, got {value!r}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(f"{where} must be a list, got {value!r}")
        kinds = [arguments[0]] * len(value) if arguments[1:] == (...,) else list(arguments)
        if len(kinds) != len(value):
            raise InputError(f"{where} must have {len(kinds)} values, got {len(value)}")
        return tuple(_value(kind, item, where) for kind, item in zip(kinds, value, strict=True))
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return value if isinstance(value, hint) else from_table(hint, value, where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise InputError(f"{where} must be {_NAMES.get(hint, hint.__name__)}, got {value!r}")
    return value


_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text in quotes"}
