"""Conversion of JSON values to types and dataclasses, with checks."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from typing import Any


def from_plain(value: Any, kind: Any, name: str = "the value") -> Any:
    """Convert a JSON value to a type.

    Lists become tuples, and objects become mappings or dataclasses.

    Args:
        value: the value.
        kind: int, float, str, bool, None, Any, a union of types, `tuple[...]`, `Mapping[str, ...]`,
            a dataclass or a TypedDict. Keys that a dataclass lacks are ignored.
        name: name of the value in errors.

    Raises:
        ValueError: the value has another type, lacks a key, or is a number that is not finite or
            has more than 64 bits.
    """
    origin = typing.get_origin(kind) or kind
    parts = typing.get_args(kind)
    if kind is Any:
        return value
    if origin in (types.UnionType, typing.Union):
        return _as_one_of(value, parts, name)
    if dataclasses.is_dataclass(kind) or typing.is_typeddict(kind):
        return _as_record(value, kind, name)
    if origin is tuple and isinstance(value, list):
        kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        if len(kinds) != len(value):
            raise ValueError(f"{len(value)} values in {name}, not {len(kinds)}")
        return tuple(from_plain(each, part, name) for each, part in zip(value, kinds, strict=True))
    if origin in (Mapping, dict) and isinstance(value, dict):
        return {key: from_plain(each, parts[1], f"{name}.{key}") for key, each in value.items()}
    if type(value) is int and abs(value) >= 1 << 63:
        raise ValueError(f"a number of more than 64 bits in {name}")
    if kind is float and type(value) in (int, float) and math.isfinite(value):
        return float(value)
    if value is None and kind in (None, types.NoneType):
        return None
    if kind in (int, str, bool) and type(value) is kind:
        return value
    raise ValueError(f"{type(value).__name__} in {name}")


def _as_one_of(value: Any, kinds: tuple[Any, ...], name: str) -> Any:
    """Convert a value to the first type that fits.

    If none fits, raise the error of the first type that is not None.
    """
    first: ValueError | None = None
    for kind in kinds:
        try:
            return from_plain(value, kind, name)
        except ValueError as error:
            first = error if first is None and kind is not types.NoneType else first
    raise first or ValueError(f"{type(value).__name__} in {name}")


_hints = functools.cache(typing.get_type_hints)


def _as_record(value: Any, kind: Any, name: str) -> Any:
    """Convert an object to a dataclass, or to a mapping with the keys of a TypedDict."""
    if not isinstance(value, dict):
        raise ValueError(f"{type(value).__name__} in {name}")
    hints = _hints(kind)
    if missing := [key for key in hints if key not in value]:
        raise ValueError(f"no {missing[0]} in {name}")
    checked = {key: from_plain(value[key], hint, f"{name}.{key}") for key, hint in hints.items()}
    return {**value, **checked} if typing.is_typeddict(kind) else kind(**checked)
