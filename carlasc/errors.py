"""The few kinds of error that a user can meet, numbers and names in messages, the check for optional packages, and Ctrl-C that waits.

Every message is one line: what it is about (a file, a field, an argument), what was expected, what was found, what to do. Parts of it come
from files and from other libraries: `printable` shows what a terminal would obey, and no part is longer than a few lines.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from types import FrameType, ModuleType
from typing import Any, Self, get_args

_USER = re.compile(r"(?<=://)[^/\s@'\"]+@")  # user:password
# What a terminal obeys, or what changes the order in which a line is read: control characters (ESC starts the terminal's commands), the marks
# that turn the direction of writing (Unicode's Bidi_Control), ends of lines and of paragraphs, and halves of characters, which no
# terminal can show: Python uses them for bytes of file names that are not UTF-8.
_UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_LONGEST = 400  # characters of a part of a message; other libraries put whole headers into theirs
_QUERY = re.compile(r"(\b[a-z][a-z0-9+.-]*://[^\s?'\"]*)\?[^\s'\"]+=[^\s'\"]*")  # a signature or a token


class CarlascError(Exception):
    """Base of every error that `carlasc` raises on purpose.

    The message is one line, made of the attributes that are not empty: `WHERE: PROBLEM: expected EXPECTED, found FOUND: ADVICE`.

    Attributes:
        where: what it is about: a file, a URL, a field, or the name of an argument.
        problem: what went wrong, where "expected ..., found ..." does not say it.
        expected: what should have been found.
        found: what was found instead.
        advice: what to do about it. It names arguments as `` `overwrite=True` ``, which the command line replaces by its options.
    """

    def __init__(
        self, where: object, *, problem: str = "", expected: str = "", found: str = "", advice: str = ""
    ) -> None:
        shown = without_credentials(str(where))
        super().__init__(shown)  # the only positional argument, so that errors pickle: the rest travels in __dict__
        self.where, self.problem = shown, problem
        self.expected, self.found, self.advice = expected, found, advice

    def __str__(self) -> str:
        where, problem, expected, found, advice = (
            _one_line(str(part)) for part in (self.where, self.problem, self.expected, self.found, self.advice)
        )
        comparison = ", ".join(f"{verb} {text}" for verb, text in (("expected", expected), ("found", found)) if text)
        return without_credentials(": ".join(part for part in (where, problem, comparison, advice) if part))

    def within(self, where: object) -> Self:
        """Return a copy that also names what contains the place: `within("a.zip")` of an error at "b" is at "a.zip: b"."""
        error = type(self).__new__(
            type(self), *self.args
        )  # not copy.copy: packages that pickle tracebacks change what it does
        vars(error).update(vars(self))
        error.where = f"{where}: {self.where}"
        return error


def printable(text: str) -> str:
    r"""Return a text as a terminal may show it: control characters, and marks that turn the direction of writing, as `\\x1b`.

    Names of sequences, classes and files come from data that anybody may have made: they must not clear a screen, hide a line, or write
    to a clipboard. Everything else is shown as it is.
    """
    return _UNSAFE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _one_line(text: str) -> str:
    """Return a part of a message as a printable line of bounded length, without its middle where it is too long."""
    line = printable(" ".join(text.splitlines()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST * 2 // 3]} [...] {line[-_LONGEST // 3 :]}"


def without_credentials(text: str) -> str:
    """Return a text without what its URLs say of credentials: user and password, and queries, which may be signatures."""
    return _QUERY.sub(r"\1", _USER.sub("", text)) if "://" in text else text


class FormatError(CarlascError, ValueError):
    """A file or store does not hold what the format says it must."""


@contextmanager
def reading(where: object, expected: str, advice: str = "") -> Iterator[None]:
    """Turn whatever goes wrong in a block that interprets data from a file into a FormatError.

    Data that anybody may have made can fail in any way: NumPy, zlib, zipfile, h5py, pyarrow and the JSON parser raise two dozen types between
    them, of which few are documented. The block should therefore hold the call that interprets the data, and nothing else.

    Args:
        where: the file.
        expected: what it should hold.
        advice: what to do about it.

    Raises:
        FormatError: anything but a CarlascError was raised; that is the cause.
    """
    try:
        yield
    except CarlascError:
        raise
    except Exception as error:
        raise FormatError(
            where, expected=expected, found=f"something else ({describe(error)})", advice=advice
        ) from error


def describe(error: BaseException) -> str:
    """Return the message of another library's error; its type where the message alone says nothing."""
    text = str(error).strip()
    if isinstance(error, LookupError):
        return f"{type(error).__name__}: {text}"  # the message of a KeyError is the key
    return text or type(error).__name__


class MissingDataError(CarlascError):
    """Something that was asked for does not exist: a file, a frame, a field, a sequence."""


class MissingKeyError(MissingDataError, KeyError):
    """A mapping, such as a Source, has no value of a key."""


class DependencyError(CarlascError, ImportError):
    """An optional package is not installed, or cannot be loaded."""


class ArgumentError(CarlascError, ValueError):
    """A value given by the caller makes no sense (the command line exits with 2 for these). `where` is the argument's name."""


class ConflictError(CarlascError):
    """Writing would destroy, or mix with, something that already exists."""


class StorageError(CarlascError):
    """The output cannot be written: a full disk, a folder without write permission. Every further write would fail alike."""


def check_choice(name: str, value: object, choices: Any) -> None:
    """Check that an argument has one of the values that it may have.

    Args:
        name: the argument's name.
        value: what was given.
        choices: a `Literal` of words, or the words.

    Raises:
        ArgumentError: it has another value.
    """
    allowed = get_args(choices) or tuple(choices)
    if value not in allowed:
        raise ArgumentError(name, expected=f"one of {', '.join(allowed)}", found=repr(value))


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional module, or say in one line which extra to install.

    Args:
        module: dotted name of the module.
        extra: the extra of `carlasc` that brings it.

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
        raise DependencyError(f"{package} {problem}", advice=f"install it with `{install_command(extra)}`") from error


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation, from where it came: a checkout, a file, or an index."""
    import json
    import shlex
    from importlib import metadata
    from urllib.parse import unquote, urlsplit

    found, editable = "carlasc", ""
    with suppress(metadata.PackageNotFoundError, ValueError):  # not installed, only on the path; not JSON
        origin = json.loads(metadata.distribution("carlasc").read_text("direct_url.json") or "{}")  # PEP 610
        url = urlsplit(origin.get("url", ""))
        if url.scheme == "file":
            found = unquote(url.path)
            editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}{shlex.quote(f'{found}[{extra}]')}"


@contextmanager
def postponed_interrupts() -> Iterator[None]:
    """Within the block, Ctrl-C waits for its end.

    For blocks that give work to an executor: a thread whose start is interrupted runs, but its executor does not know it, and the interpreter waits
    for it for ever when it ends. And for imports: packages such as trimesh catch every exception of what they import, and go on without it.
    In other threads than the main one, which Ctrl-C does not reach, nothing changes.
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
    """Return the version of the installed package; "unknown" if it is only found on the path."""
    from importlib import metadata

    try:
        return metadata.version("carlasc")
    except metadata.PackageNotFoundError:
        return "unknown"


def count(number: int, noun: str, plural: str = "") -> str:
    """Return "1 frame", "2 frames"."""
    return f"{number:,} {noun if number == 1 else plural or f'{noun}s'}"


def first_names(names: Iterable[str], most: int = 8) -> str:
    """Return names separated by commas, without those after the first few."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
