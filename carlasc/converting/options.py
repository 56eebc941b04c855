"""The options of an exporter: the arguments of its constructor, which the command line gives as text."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

from carlasc.converting.exporter import Exporter
from carlasc.errors import ArgumentError


def make_exporter(kind: type[Exporter], options: Mapping[str, Any]) -> Exporter:
    """Return an exporter with some options. Text becomes a number or a truth value where the option is one.

    Raises:
        ArgumentError: the exporter has no such option, or a value is not of its type.
    """
    known = inspect.signature(kind).parameters
    if unknown := sorted(set(options) - set(known)):
        expected = f"one of {', '.join(known)}" if known else f"no options for {kind.title}"
        raise ArgumentError("option", expected=expected, found=", ".join(unknown))
    hints = get_type_hints(kind.__init__)
    return kind(**{name: _read(name, value, hints.get(name, str)) for name, value in options.items()})


def option_names(kind: type[Exporter]) -> tuple[str, ...]:
    """Return the names of an exporter's options."""
    return tuple(inspect.signature(kind).parameters)


def _read(name: str, value: Any, hint: Any) -> Any:
    """Return the value of an option: text is read as the type that the option's annotation says."""
    kinds = get_args(hint) or (hint,)
    if not isinstance(value, str) or str in kinds:
        return value
    if bool in kinds:
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if value.lower() not in words:
            raise ArgumentError(name, expected="true or false", found=repr(value))
        return words[value.lower()]
    kind = float if float in kinds else int
    try:
        return kind(value)
    except ValueError:
        wanted = "a number" if kind is float else "a whole number"
        raise ArgumentError(name, expected=wanted, found=repr(value)) from None
