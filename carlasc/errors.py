"""The exceptions of carlasc, helpers for messages, optional packages and plugins, and postponed
Ctrl-C.

Every message is one line: where (a file, a field, an argument), what was expected, what was found,
what to do. Parts of it come from files and other libraries, so `printable` escapes control
characters, and long parts are shortened.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from itertools import groupby
from numbers import Integral, Real
from types import FrameType, ModuleType, UnionType
from typing import Any, Self, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")

_USER = re.compile(r"(?<=://)[^/\s@'\"]+@")  # user:password
# Characters that control a terminal or change the order of a line: control characters (ESC starts
# commands of a terminal), marks for the direction of writing (Bidi_Control of Unicode), ends of
# lines and paragraphs, and lone surrogates, which Python uses for bytes of file names that are not
# UTF-8.
_UNSAFE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
# maximum characters of a part of a message; messages of other libraries can contain whole headers
_LONGEST = 400
# query, which may be a signature or a token
_QUERY = re.compile(r"(\b[a-z][a-z0-9+.-]*://[^\s?'\"]*)\?[^\s'\"]+=[^\s'\"]*")


class CarlascError(Exception):
    """Base class of all exceptions of `carlasc`.

    The message is one line of all attributes that are not empty: `WHERE: PROBLEM: expected
    EXPECTED, found FOUND: ADVICE`.

    Attributes:
        where: place of the error: a file, a URL, a field, or the name of an argument; what has a
            location, such as a source, is named by it.
        problem: what went wrong, if "expected ..., found ..." is not sufficient.
        expected: the expected value or state.
        found: the actual value or state; an object is shown as `str` does.
        advice: what the user can do. It names arguments as `` `overwrite=True` ``, which the
            command line replaces by its options.
    """

    def __init__(
        self,
        where: object,
        *,
        problem: str = "",
        expected: str = "",
        found: object = "",
        advice: str = "",
    ) -> None:
        shown = without_credentials(str(getattr(where, "location", where)))
        super().__init__(
            shown
            # the only positional argument, so that errors can be pickled: other attributes are in
            # __dict__
        )
        self.where = shown
        self.problem = problem
        self.expected = expected
        self.found = str(found)
        self.advice = advice

    def __str__(self) -> str:
        where, problem, expected, found, advice = (
            _one_line(str(part))
            for part in (self.where, self.problem, self.expected, self.found, self.advice)
        )
        comparison = ", ".join(
            f"{verb} {text}" for verb, text in (("expected", expected), ("found", found)) if text
        )
        return without_credentials(
            ": ".join(part for part in (where, problem, comparison, advice) if part)
        )

    def within(self, where: object) -> Self:
        """Return a copy whose place is prefixed with the place that contains it: "b" becomes
        "a.zip: b" with `within("a.zip")`.
        """
        # not copy.copy: packages that pickle tracebacks change what it does
        error = type(self).__new__(type(self), *self.args)
        vars(error).update(vars(self))
        error.where = f"{where}: {self.where}"
        return error


def printable(text: str) -> str:
    r"""Escape control characters, and marks for the direction of writing, as in `\\x1b`, so that a
    text can be printed in a terminal.

    Names of sequences, classes and files come from untrusted data. They must not clear a screen,
    hide a line, or write to a clipboard.
    """
    return _UNSAFE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _one_line(text: str) -> str:
    """Return a part of a message as a printable line. A long part is shortened in the middle."""
    line = printable(" ".join(text.splitlines()))
    return (
        line
        if len(line) <= _LONGEST
        else f"{line[: _LONGEST * 2 // 3]} [...] {line[-_LONGEST // 3 :]}"
    )


def without_credentials(text: str) -> str:
    """Remove credentials from the URLs in a text: user, password, and queries, which may be
    signatures.
    """
    return _QUERY.sub(r"\1", _USER.sub("", text)) if "://" in text else text


class FormatError(CarlascError, ValueError):
    """The content of a file or store does not have the required format."""


@contextmanager
def reading(where: object, expected: str, advice: str = "") -> Iterator[None]:
    """Turn any error in a block that parses data from a file into a FormatError.

    For untrusted data, NumPy, zlib, zipfile, h5py, pyarrow and the JSON parser raise two dozen
    types of exceptions, few of them documented. The block should therefore contain only the call
    that parses the data.

    Args:
        where: the file.
        expected: expected content of the file.
        advice: what the user can do.

    Raises:
        FormatError: the block raised another error than a CarlascError. That error is the cause.
    """
    try:
        yield
    except CarlascError:
        raise
    except Exception as error:
        raise FormatError(
            where, expected=expected, found=f"something else ({describe(error)})", advice=advice
        ) from error


def tried_twice(read: Callable[[], T]) -> T | None:
    """Return what a call reads; None if it fails twice. A temporary error, such as one of a network
    file system, is not taken for missing data.
    """
    for _ in range(2):
        with suppress(CarlascError, OSError):
            return read()
    return None


@contextmanager
def within(where: object) -> Iterator[None]:
    """Prefix the place of a FormatError in a block with the place that contains it."""
    try:
        yield
    except FormatError as error:
        raise error.within(where) from error


def describe(error: BaseException) -> str:
    """Return the message of an error of another library, or its type if the message is not
    sufficient.
    """
    text = str(error).strip()
    if isinstance(error, LookupError):
        return f"{type(error).__name__}: {text}"  # the message of a KeyError is only the key
    return text or type(error).__name__


class MissingDataError(CarlascError):
    """Requested data do not exist: a file, a frame, a field, a sequence."""


class MissingKeyError(MissingDataError, KeyError):
    """A key of a mapping, such as a Source, does not exist."""


class DependencyError(CarlascError, ImportError):
    """An optional package is not installed, or cannot be loaded."""


class ArgumentError(CarlascError, ValueError):
    """An argument has an invalid value.

    `where` is the name of the argument. The command line exits with 2.
    """


class ConflictError(CarlascError):
    """Writing would destroy existing data, or mix with them."""


class CompleteError(ConflictError):
    """The output exists, whole, and was made with the same options from the same input.

    Commands say so and exit with 0.
    """


class StorageError(CarlascError):
    """The output cannot be written: a full disk, a folder without write permission.

    Further writes would fail too.
    """


def check_choice(name: str, value: object, choices: Any) -> None:
    """Check that an argument has one of the allowed values.

    Args:
        name: name of the argument.
        value: value of the argument.
        choices: the allowed values: a `Literal` of strings, or an iterable of strings.

    Raises:
        ArgumentError: the value is not allowed.
    """
    allowed = get_args(choices) or tuple(choices)
    if value not in allowed:
        raise ArgumentError(name, expected=f"one of {', '.join(allowed)}", found=repr(value))


_KIND_NAMES = {str: "a text", Integral: "a whole number", Real: "a number", type(None): "None"} | {
    os.PathLike: "a path",
    Callable: "a function",
    Iterable: "several values",
}
# what is taken for a type
_TAKEN: dict[Any, type] = {int: Integral, float: Real} | dict.fromkeys(
    (tuple, list, frozenset, Sequence, Collection), Iterable
)


def check_types(function: Callable[..., object], arguments: Mapping[str, object]) -> None:
    """Check the types of the arguments of a public function, as the first step of its body.

    Truth values, the values of a `Literal`, and the contents of collections and arrays are not
    checked.

    Args:
        function: the function, or the class of a dataclass.
        arguments: `locals()`, or `vars(self)`.

    Raises:
        ArgumentError: an argument has none of the types of its annotation.
    """
    for name, kinds in _kinds_of(function).items():
        value = arguments[name]
        if not _is_one_of(value, kinds):
            shown = [kind for kind in kinds if kind is not str or os.PathLike not in kinds]
            names = (_KIND_NAMES.get(kind, f"a {kind.__name__}") for kind in shown)
            raise ArgumentError(name, expected=" or ".join(dict.fromkeys(names)), found=repr(value))


def _is_one_of(value: object, kinds: list[type]) -> bool:
    if isinstance(value, str):
        return str in kinds  # a text is not meant as a sequence of its letters
    if isinstance(value, bool):
        kinds = [kind for kind in kinds if kind not in (Integral, Real)]
    return isinstance(value, tuple(kinds))


@cache
def _kinds_of(function: Callable[..., object]) -> dict[str, list[type]]:
    """Return the classes of the annotation of each argument that is checked."""
    kinds: dict[str, list[type]] = {}
    for name, hint in get_type_hints(function).items():
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        found = [get_origin(part) or part for part in parts]
        if name != "return" and all(map(_is_checked, found)):
            kinds[name] = [_TAKEN.get(kind, kind) for kind in found]
    return kinds


def _is_checked(kind: Any) -> bool:
    is_class = isinstance(kind, type) and kind not in (bool, Any)
    return is_class and not getattr(kind, "_is_protocol", False)


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional module, or raise an error that names the extra to install.

    Args:
        module: dotted name of the module.
        extra: the extra of `carlasc` that installs it.

    Returns:
        The imported module.

    Raises:
        DependencyError: the module is not installed or fails to load.
    """
    try:
        with nullcontext() if module in sys.modules else postponed_interrupts():
            return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        problem = "is not installed" if error.name == package else f"does not load ({error})"
        raise DependencyError(
            f"{package} {problem}", advice=f"install it with `{install_command(extra)}`"
        ) from error


def install_command(extra: str) -> str:
    """Return the pip command that adds an extra to this installation, from the same origin: a
    checkout, a file, or an index.
    """
    import json
    import shlex
    from importlib import metadata
    from urllib.parse import unquote, urlsplit

    found = "carlasc"
    editable = ""
    # not installed (only on the path), or not JSON
    with suppress(metadata.PackageNotFoundError, ValueError):
        # PEP 610
        origin = json.loads(metadata.distribution("carlasc").read_text("direct_url.json") or "{}")
        url = urlsplit(origin.get("url", ""))
        if url.scheme == "file":
            found = unquote(url.path)
            editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}{shlex.quote(f'{found}[{extra}]')}"


@contextmanager
def postponed_interrupts() -> Iterator[None]:
    """Postpone Ctrl-C to the end of the block.

    This is for blocks that submit work to an executor: if the start of a thread is interrupted, the
    executor does not register the running thread, and the interpreter hangs at exit. It is also for
    imports: packages such as trimesh catch all exceptions of their imports, and continue without
    the imported package. In threads other than the main thread, which Ctrl-C does not reach, this
    has no effect.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or handler is None:
        yield
        return
    caught: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: caught.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if caught and callable(handler):
            handler(*caught[0])
        elif caught:
            os.kill(os.getpid(), signal.SIGINT)


def carlasc_version() -> str:
    """Return the version of the installed package; "unknown" if it is only on the path."""
    from importlib import metadata

    try:
        return metadata.version("carlasc")
    except metadata.PackageNotFoundError:
        return "unknown"


def count(number: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: "1 frame", "2 frames". `plural` is for irregular nouns."""
    return f"{number:,} {noun if number == 1 else plural or f'{noun}s'}"


def first_names(names: Iterable[str], most: int = 8) -> str:
    """Return the first `most` names, separated by commas, and the number of further names."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def only(argument: str, found: Mapping[str, T], expected: str) -> T:
    """Return the one sequence, or recording, of those that were found, by name.

    Raises:
        ArgumentError: there are several, or none; `argument` is named.
    """
    if len(found) != 1:
        raise ArgumentError(
            argument,
            expected=expected,
            found=f"{len(found)} ({first_names(found, 3)})",
            advice="give the folder of one",
        )
    return next(iter(found.values()))


def runs_of(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Return the first and the last number of each run of successive numbers."""
    by_run = groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])
    runs = [[number for _, number in run] for _, run in by_run]
    return [(run[0], run[-1]) for run in runs]


def first_runs(numbers: Iterable[int], most: int = 8) -> str:
    """Return increasing numbers as ranges: "0 to 3, 7 and 2 more"."""
    texts = (f"{a}" if a == b else f"{a} to {b}" for a, b in runs_of(numbers))
    return first_names(texts, most)


def plugin_names(group: str) -> tuple[str, ...]:
    """Return the sorted names in an entry-point group, without loading any."""
    from importlib.metadata import entry_points  # slow, and few commands need it

    return tuple(sorted({entry.name for entry in entry_points(group=group)}))


def load_plugin(group: str, name: str, base: type | None = None, argument: str = "name") -> Any:
    """Load what an entry point names.

    Args:
        group: an entry-point group, such as "carlasc.converters".
        name: name of the entry point.
        base: the class that it must inherit; None if it may be anything.
        argument: of the caller, that has the name.

    Raises:
        ArgumentError: the group has no such name.
        DependencyError: it cannot be loaded, or does not inherit `base`.
    """
    from importlib.metadata import entry_points

    entries = {entry.name: entry for entry in entry_points(group=group)}
    if name not in entries:
        expected = f"one of {', '.join(sorted(entries)) or 'no names: none is installed'}"
        raise ArgumentError(argument, expected=expected, found=repr(name))
    where = f"{group.removeprefix('carlasc.').removesuffix('s')} {name} ({entries[name].value})"
    try:
        plugin = entries[name].load()
    except Exception as error:  # code of another distribution may fail in any way
        raise DependencyError(where, problem=f"cannot be loaded: {error}") from error
    if base is not None and not (isinstance(plugin, type) and issubclass(plugin, base)):
        public = ".".join([*base.__module__.split(".")[:2], base.__name__])
        raise DependencyError(where, expected=f"a class that inherits {public}", found=repr(plugin))
    return plugin
