"""The installed converters and exporters, which distributions declare in two entry-point groups,
and their options.

An option of a converter or an exporter is a keyword parameter of its constructor, with its type,
its default and its help text:

    def __init__(self, source: Path, *, sweeps: Annotated[bool, "Read all scans, not only key
    frames."] = True) -> None:
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from carlasc.converting.exporter import Exporter
from carlasc.converting.protocol import Converter, Recording
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import CARLA, remaps_between
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    DependencyError,
    MissingDataError,
    check_choice,
    load_plugin,
    plugin_names,
)
from carlasc.storage.opening import as_source

GROUP = "carlasc.converters"
EXPORTERS = "carlasc.exporters"
_TRUTH = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def converter_names() -> tuple[str, ...]:
    """Return the sorted names of the installed converters, without loading any."""
    return plugin_names(GROUP)


def exporter_names() -> tuple[str, ...]:
    """Return the sorted names of the installed exporters, without loading any."""
    return plugin_names(EXPORTERS)


def load_converter(name: str) -> type[Converter]:
    """Load a converter by its name.

    Raises:
        ArgumentError: no converter has that name.
        DependencyError: it cannot be loaded, or is not a converter.
    """
    kind: type[Converter] = load_plugin(GROUP, name, Converter)
    return kind


def load_exporter(name: str) -> type[Exporter]:
    """Load an exporter by its name.

    Raises:
        ArgumentError: no exporter has that name.
        DependencyError: it cannot be loaded, or is not an exporter.
    """
    kind: type[Exporter] = load_plugin(EXPORTERS, name, Exporter)
    return kind


def remaps_to_carla(table: ClassTable) -> tuple[Remap, ...] | None:
    """Return the remaps that map ids of a table to CarlaSC's, in order: from carlasc, or from an
    installed converter.

    Returns:
        The remaps; empty for CarlaSC's own table. None if no map exists.
    """
    try:
        return remaps_between(table, CARLA)
    except ArgumentError:
        pass
    for name in converter_names():
        try:
            converter = load_converter(name)
        except DependencyError:
            continue  # a broken converter of another distribution, which is not needed here
        if getattr(converter, "classes", None) == table and converter.to_carla is not None:
            return (converter.to_carla,)
    return None


def open_converter(
    name: str | type[Converter], source: Path, options: Mapping[str, Any] | None = None
) -> Converter:
    """Return a converter of a data set.

    Args:
        name: the name of an installed converter, or a class that inherits `Converter`.
        source: folder of the data set.
        options: options of the converter, by name; text is parsed as the type of the option.

    Raises:
        ArgumentError: the converter or its option does not exist, or the option cannot have that
            value.
        DependencyError: it cannot be loaded.
    """
    kind = load_converter(name) if isinstance(name, str) else name
    return kind(source, **read_options(kind, options))


def find_recordings(converter: Converter) -> list[Recording]:
    """Return the recordings of a converter.

    Raises:
        MissingDataError: no recording exists; the message names other converters that find some
            there.
        FormatError: a file does not have the format.
    """
    try:
        return converter.sequences()
    except MissingDataError as error:
        if others := readers_of(converter.source, other_than=type(converter)):
            commands = " or ".join(f"`carlasc convert {name}`" for name in others)
            error.advice = f"use {commands}, which can read this folder"
        elif _is_in_layout(converter.source):
            error.advice = (
                "make grids with `carlasc regrid`, because this folder has CarlaSC's layout already"
            )
        raise


def readers_of(source: Path, *, other_than: type[Converter] | None = None) -> list[str]:
    """Return the names of the installed converters that find recordings in a place."""
    return [name for name in converter_names() if _finds(name, other_than, source)]


def _is_in_layout(source: Path) -> bool:
    try:
        return bool(as_source(source).sequences())
    except CarlascError:
        return False


def _finds(name: str, other_than: type[Converter] | None, source: Path) -> bool:
    """Return whether an installed converter finds recordings in a place."""
    try:
        kind = load_converter(name)
        return kind is not other_than and any(
            recording.frames for recording in kind(source).sequences()
        )
    except Exception:  # noqa: BLE001 (another distribution, which may fail in any way)
        return False


@dataclass(frozen=True)
class OptionDeclaration:
    """An option of a converter or an exporter.

    Attributes:
        name: its name, that of a parameter of the constructor.
        type: str, int, float or bool.
        default: its default value.
        help: what it does; empty if it has no help.
        choices: the allowed values; empty if every value of its type is allowed.
    """

    name: str
    type: type[str] | type[int] | type[float] | type[bool]
    default: str | int | float | bool | None
    help: str = ""
    choices: tuple[str, ...] = ()

    def read(self, value: Any) -> Any:
        """Return a value of the option; text is read as the type of the option.

        Raises:
            ArgumentError: the option cannot have that value.
        """
        if self.choices and value is not self.default:
            check_choice(self.name, value, self.choices)
        if not isinstance(value, str) or self.type is str:
            return value
        kinds: dict[type, tuple[str, Callable[[str], Any]]] = {
            bool: ("true or false", lambda text: _TRUTH[text.lower()]),
            int: ("a whole number", int),
            float: ("a number", float),
        }
        expected, parse = kinds[self.type]
        try:
            return parse(value)
        except (KeyError, ValueError):
            raise ArgumentError(self.name, expected=expected, found=repr(value)) from None


def option_declarations(kind: type[Converter] | type[Exporter]) -> tuple[OptionDeclaration, ...]:
    """Return the options that a converter or an exporter declares: the parameters of its
    constructor, except the source.

    Raises:
        DependencyError: annotations cannot be read, a parameter has no default, or its type is not
            str, int, float, bool or a Literal of texts.
    """
    # fields that a dataclass inherits have the names of another module in their annotations
    declared = kind if "__dataclass_fields__" in vars(kind) else kind.__init__
    try:
        hints = get_type_hints(declared, include_extras=True)
    except Exception as error:  # annotations of another distribution may name anything
        raise DependencyError(
            f"{kind.__name__}: options", problem=f"annotations cannot be read: {error}"
        ) from error
    _, *parameters = inspect.signature(kind.__init__).parameters.values()  # without `self`
    return tuple(
        _declared(kind, parameter, hints.get(parameter.name, str))
        for parameter in parameters[issubclass(kind, Converter) :]
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    )


def read_options(
    kind: type[Converter] | type[Exporter], options: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return options as the constructor of a converter or an exporter takes them; text is read as
    the type that is declared.

    Args:
        kind: the converter or the exporter.
        options: values by the names of options; None for no options.

    Raises:
        ArgumentError: an option does not exist, or cannot have that value.
        DependencyError: a declaration is not valid.
    """
    options = options or {}
    known = {one.name: one for one in option_declarations(kind)}
    if unknown := sorted(set(options) - set(known)):
        expected = f"one of {', '.join(known)}" if known else "no options for this data set"
        raise ArgumentError("options", expected=expected, found=", ".join(unknown))
    return {name: known[name].read(value) for name, value in options.items()}


def _declared(kind: type, parameter: inspect.Parameter, hint: Any) -> OptionDeclaration:
    """Return the option that a parameter declares, whose annotation is `hint`: `Annotated[type,
    help]` or a type, which may be optional.
    """
    text = ""
    if get_origin(hint) is Annotated:
        hint, *extras = get_args(hint)
        text = next((extra for extra in extras if isinstance(extra, str)), "")
    types = [
        part
        for part in (get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,))
        if part is not NoneType
    ]
    choices = get_args(types[0]) if get_origin(types[0]) is Literal else ()
    option_type = None if len(types) > 1 else str if choices else types[0]
    if option_type not in (str, int, float, bool) or not all(
        isinstance(choice, str) for choice in choices
    ):
        expected = "an option of the type str, int, float, bool or a Literal of texts"
        raise DependencyError(f"{kind.__name__}: {parameter.name}", expected=expected, found=hint)
    if parameter.default is parameter.empty:
        raise DependencyError(
            f"{kind.__name__}: {parameter.name}", expected="a default", found="none"
        )
    return OptionDeclaration(parameter.name, option_type, parameter.default, text, choices)
