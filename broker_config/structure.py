"""Strict conversion between frozen dataclasses and plain values (what msgpack and TOML can hold).

The field annotations of the dataclass are the rule: a missing, unknown or wrongly typed field is an
error that names its path. Nothing is coerced, except an integer where a float is declared.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar, cast

import numpy as np

from broker_config.errors import MessageError

T = TypeVar("T")

_ARRAY_DTYPES = {"|u1": "uint8", "<i4": "int32", "<f4": "float32"}
"""What an array on the bus may hold, by numpy's type string (little endian, always)."""


_ADDED = "added"


def added(default: Any) -> Any:
    """A field that older versions do not have: at its default it is left out of what is written.

    So what is written by this version reads there as long as nothing of it is used, and names and
    digests that follow from what is written stay what they were.
    """
    return dataclasses.field(default=default, metadata={_ADDED: True})


def to_plain(value: object) -> object:
    """Turns a dataclass (or anything it may contain) into dicts, lists, scalars and bytes."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        usual = _added_defaults(type(value))
        return {
            name: to_plain(getattr(value, name))
            for name in _field_types(type(value))
            if name not in usual or getattr(value, name) != usual[name]
        }
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    return value


def from_plain(plain: object, expected: type[T], path: str) -> T:
    """Builds an `expected` dataclass from plain values.

    Args:
        plain: What `to_plain` gave, or a parsed TOML table.
        expected: The dataclass.
        path: The name under which errors speak of the value.

    Raises:
        MessageError: A field is missing, unknown or of another type, or the dataclass's own
            validation refuses the values.
    """
    return cast(T, _convert(plain, expected, path))


def _convert(plain: object, expected: Any, path: str) -> object:
    if dataclasses.is_dataclass(expected):
        return _convert_dataclass(plain, cast(type, expected), path)
    origin = typing.get_origin(expected)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(plain, typing.get_args(expected), path)
    if origin is tuple:
        return _convert_tuple(plain, typing.get_args(expected), path)
    if origin is typing.Literal:
        return _convert_choice(plain, typing.get_args(expected), path)
    if origin is np.ndarray:
        return _convert_array(plain, path)
    if origin is not None and issubclass(origin, Mapping):
        return _convert_mapping(plain, typing.get_args(expected)[1], path)
    if isinstance(expected, type) and issubclass(expected, enum.Enum):
        choice = _convert_choice(plain, tuple(member.value for member in expected), path)
        return expected(choice)
    return _convert_scalar(plain, expected, path)


def _convert_scalar(plain: object, expected: type, path: str) -> object:
    if expected is float and type(plain) is int:
        return float(plain)
    if type(plain) is not expected:
        raise _mismatch(path, expected.__name__, plain)
    return plain


def _convert_choice(plain: object, choices: tuple[object, ...], path: str) -> object:
    # 1 == True and 1 == 1.0 in Python: the type must agree as well.
    if not any(plain == choice and type(plain) is type(choice) for choice in choices):
        raise _mismatch(path, "one of " + ", ".join(repr(choice) for choice in choices), plain)
    return plain


def _convert_union(plain: object, choices: tuple[Any, ...], path: str) -> object:
    if plain is None and type(None) in choices:
        return None
    candidates = [choice for choice in choices if choice is not type(None)]
    if len(candidates) == 1:
        return _convert(plain, candidates[0], path)
    if type(plain) not in candidates:
        names = " or ".join(getattr(choice, "__name__", str(choice)) for choice in candidates)
        raise _mismatch(path, names, plain)
    return plain


def _convert_tuple(plain: object, items: tuple[Any, ...], path: str) -> object:
    if not isinstance(plain, list | tuple):
        raise _mismatch(path, "a list", plain)
    if items[-1] is Ellipsis:
        kinds = [items[0]] * len(plain)
    elif len(items) == len(plain):
        kinds = list(items)
    else:
        raise _mismatch(path, f"a list of {len(items)} items", plain)
    return tuple(
        _convert(item, kind, f"{path}[{index}]")
        for index, (item, kind) in enumerate(zip(plain, kinds, strict=True))
    )


def _convert_mapping(plain: object, item: Any, path: str) -> object:
    if not isinstance(plain, dict) or not all(isinstance(key, str) for key in plain):
        raise _mismatch(path, "a table with text keys", plain)
    return {key: _convert(value, item, f"{path}.{key}") for key, value in plain.items()}


def _convert_array(plain: object, path: str) -> object:
    if not isinstance(plain, dict) or plain.keys() != {"dtype", "shape", "data"}:
        raise _mismatch(path, "an array (dtype, shape, data)", plain)
    dtype, shape, data = plain["dtype"], plain["shape"], plain["data"]
    if not isinstance(dtype, str) or dtype not in _ARRAY_DTYPES:
        raise _mismatch(f"{path}.dtype", "one of " + ", ".join(_ARRAY_DTYPES.values()), dtype)
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise _mismatch(f"{path}.shape", "a list of sizes", shape)
    size = int(np.dtype(dtype).itemsize) * functools.reduce(lambda a, b: a * b, shape, 1)
    if not isinstance(data, bytes) or len(data) != size:
        raise _mismatch(f"{path}.data", f"{size} bytes for {_ARRAY_DTYPES[dtype]} {shape}", data)
    # A view of the received bytes: read-only, so nobody can change what was received.
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def _convert_dataclass(plain: object, expected: type, path: str) -> object:
    if not isinstance(plain, dict):
        raise _mismatch(path, f"a table for {expected.__name__}", plain)
    field_types = _field_types(expected)
    if unknown := sorted(str(key) for key in plain.keys() - field_types.keys()):
        raise MessageError(
            f"{path}: expected the fields {', '.join(field_types)}; got also {', '.join(unknown)}; "
            "remove or rename them"
        )
    missing = sorted(_required(expected) - plain.keys())
    if missing:
        raise MessageError(f"{path}: {', '.join(missing)} missing; add every required field")
    values = {
        name: _convert(plain[name], kind, f"{path}.{name}")
        for name, kind in field_types.items()
        if name in plain
    }
    return expected(**values)


@functools.cache
def _field_types(expected: type) -> dict[str, Any]:
    hints = typing.get_type_hints(expected)
    return {field.name: hints[field.name] for field in dataclasses.fields(expected)}


@functools.cache
def _added_defaults(expected: type) -> dict[str, Any]:
    return {
        field.name: field.default
        for field in dataclasses.fields(expected)
        if _ADDED in field.metadata
    }


@functools.cache
def _required(expected: type) -> frozenset[str]:
    return frozenset(
        field.name
        for field in dataclasses.fields(expected)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    )


def _mismatch(path: str, rule: str, got: object) -> MessageError:
    text = f"{len(got)} bytes" if isinstance(got, bytes) else repr(got)
    shown = text if len(text) <= 80 else text[:77] + "..."
    return MessageError(f"{path}: expected {rule}; got {type(got).__name__} {shown}")
