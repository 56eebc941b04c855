"""The options of the library's functions and option objects, as options of commands.

Type, default and help are read from the source of the library, found through the stubs of its
rooms. Importing it instead would load NumPy, which is slow, and `python -OO` has no docstrings.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import typer

import carlasc
from carlasc.cli.common import FRAMES_HELP, read_file, read_frames, read_place, read_window
from carlasc.core import choices

SEPARATOR = "__"  # in names of parameters, between a function or an object and its argument


class Shown(NamedTuple):
    """How the options of a function or of an option object are shown.

    Attributes:
        heading: their heading in `--help`; empty for none.
        hidden: those that are no options of a command, separated by spaces.
        files: those that are paths on this machine, separated by spaces.
        renamed: what a user types for options that have other names than in the library.
    """

    heading: str = ""
    hidden: str = ""
    files: str = ""
    renamed: Mapping[str, str] = {}


TABLE = {
    "carlasc.CameraOptions": Shown("Camera"),
    "carlasc.CardDetails": Shown(
        "Details of the publication",
        files="citation statements",
        renamed={"authors": "--author", "version": "--data-version"},
    ),
    "carlasc.FromScans": Shown("Scans merged over time"),
    "carlasc.Scene": Shown(hidden="source"),
    "carlasc.Scoring": Shown("What is scored"),
    "carlasc.StyleOptions": Shown("Style", renamed={"name": "--style", "captions": "--caption"}),
    "carlasc.Voting": Shown("Votes", renamed={"rule": "--voting", "keep": "--keep-votes"}),
    "carlasc.audit": Shown(files="keep"),
    "carlasc.captures.Lidar": Shown("Traffic and sensors", renamed={"range_m": "--range"}),
    "carlasc.captures.LidarEffects": Shown("Effects on scans that come with ground truth"),
    "carlasc.convert": Shown(hidden="sequences"),
    "carlasc.evaluate": Shown(hidden="convention name"),
    "carlasc.export": Shown(hidden="sequences"),
    "carlasc.label_motion": Shown("With --from motion", files="boxes_out"),
    "carlasc.map": Shown(renamed={"cell_m": "--cell"}),
    "carlasc.LayoutOptions": Shown(files="boxes"),
    "carlasc.MapExtras": Shown(files="mesh distance trajectory boxes_out"),
    "carlasc.RecordingOptions": Shown("Recordings", hidden="options", files="keep"),
    "carlasc.motion.MotionOptions": Shown(
        "Scans merged over time", hidden="min_speed_m_s", renamed={"source": "--motion"}
    ),
    "carlasc.motion.PoseOptions": Shown("Poses", renamed={"source": "--poses"}),
    "carlasc.regrid": Shown(files="boxes_out"),
    "carlasc.simulate": Shown("Traffic and sensors"),
    "carlasc.stats": Shown(hidden="remap"),
    "carlasc.view": Shown(renamed={"thin_m": "--thin"}),
}
"""What commands rename and hide of the library's functions and option objects."""


class ValueKind(NamedTuple):
    """How a value of an annotation is given on the command line."""

    type: Any
    reader: Any = None
    metavar: str | None = None


def _read_viewpoint(text: str | None) -> Any:
    return None if text is None else carlasc.viewing.Viewpoint.parse(text)


# an argument that may be several things is what comes first here
_KINDS = {
    **dict.fromkeys(("Collection[str]", "Sequence[str]"), ValueKind(list[str])),
    **{name: ValueKind(value) for name, value in vars(choices).items() if get_args(value)},
    **{kind.__name__: ValueKind(kind) for kind in (bool, float, int, str)},
    "AnyPath": ValueKind(str),
    "Frames": ValueKind(str, read_frames, "A:B"),
    "SceneSource": ValueKind(str, read_place),
    "Viewpoint": ValueKind(str, _read_viewpoint),
    "tuple[int, int]": ValueKind(str, read_window, "A:B"),
}
# of a section of a docstring: a name, and a text that may continue in indented lines
_ENTRY = re.compile(r"^    (\w+): (.*(?:\n {5,}.*)*)", re.MULTILINE)
# the end of a text that says what None stands for
_NONE = re.compile(r"[;.,]? None(?: takes| for|:) (.*)$")


@dataclass(frozen=True)
class Given:
    """The values that a command was given for a function or an option object of the library.

    Attributes:
        name: the public name of the function or the class.
        values: the given values; the library knows the others.
    """

    name: str
    values: Mapping[str, Any]

    @property
    def is_given(self) -> bool:
        """Whether any value was given."""
        return bool(self.values)

    def make(self, *arguments: Any, **others: Any) -> Any:
        """Call the function, or make the object, with the given and with other arguments."""
        called = attrgetter(self.name.partition(".")[2])(carlasc)
        return called(*arguments, **{**self.values, **others})


class Declaration(NamedTuple):
    """An argument of a function, or a field of an option object, as its source declares it."""

    annotations: list[str]
    default: Any
    text: str


@dataclass(frozen=True)
class Library:
    """The annotation of a parameter of type `Given`: the options of a function or an object.

    Attributes:
        name: the public name of the function or the class.
        only: names of the options that the command has, separated by spaces; empty for all.
    """

    name: str
    only: str = ""

    def parameters(self) -> Iterator[inspect.Parameter]:
        """Yield the options as parameters of a command; without a value, each is None."""
        shown = TABLE.get(self.name, Shown())
        options = dict(self._options())
        typed = {name: f"--{name.replace('_', '-')}" for name in options}
        typed |= shown.renamed
        for name, (declaration, kind) in options.items():
            text = FRAMES_HELP if kind.metavar and kind.reader is read_frames else ""
            yield make_option(
                self._parameter(name),
                kind,
                typed[name],
                text or _help(declaration.text, typed),
                default=declaration.default,
                heading=shown.heading,
            )

    def take(self, given: dict[str, Any]) -> Given:
        """Take the values of these options out of those that a command was given."""
        values = {name: given.pop(self._parameter(name)) for name, _ in self._options()}
        return Given(self.name, {k: v for k, v in values.items() if v is not None and v != []})

    def _parameter(self, name: str) -> str:
        return f"{self.name.rpartition('.')[2]}{SEPARATOR}{name}"

    def _options(self) -> Iterator[tuple[str, tuple[Declaration, ValueKind]]]:
        shown = TABLE.get(self.name, Shown())
        for name, declaration in declarations(self.name).items():
            known = (
                ValueKind(Path, read_file, "FILE")
                if name in shown.files.split()
                else next(
                    (kind for one, kind in _KINDS.items() if one in declaration.annotations), None
                )
            )
            if known and name not in shown.hidden.split() and name in (self.only.split() or [name]):
                yield name, (declaration, known)


def make_option(
    name: str, kind: ValueKind, typed: str, text: str, *, default: Any = None, heading: str = ""
) -> inspect.Parameter:
    """Return an option whose value is None if it is not given, so that the library decides.

    Args:
        name: name of the parameter.
        kind: kind of its values.
        typed: what a user types, such as `--window-m`.
        text: its help.
        default: the default of the library, which the help names.
        heading: heading of the option in `--help`.
    """
    if isinstance(default, tuple):
        default = ":".join(map(str, default))
    if kind.type is bool and default is not False:
        typed = f"{typed}/--no-{typed[2:]}"
        default = {True: "yes"}.get(default)
    info = typer.Option(
        typed,
        help=text
        if default in (None, "", ()) or default is False
        else f"{text}  [default: {default}]".strip(),
        metavar=kind.metavar,
        callback=kind.reader,
        rich_help_panel=heading or None,
        show_default=False,
    )
    annotation: Any = Annotated[kind.type | None, info]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )


@cache
def declarations(name: str) -> dict[str, Declaration]:
    """Return the keyword arguments of a public function, or the fields of a public class."""
    node = _definition(name)
    section = re.split(r"^(?:Args|Attributes):\n", ast.get_docstring(node) or "", flags=re.M)[-1]
    texts = dict(_ENTRY.findall(section))
    if isinstance(node, ast.ClassDef):
        declared: list[tuple[str, ast.expr | None, ast.expr | None]] = [
            (field.target.id, field.annotation, field.value)
            for field in node.body
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        ]
    else:
        arguments = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
        declared = [(one.arg, one.annotation, default) for one, default in arguments]
    return {
        name: Declaration(ast.unparse(annotation).split(" | "), _value(default), texts[name])
        for name, annotation, default in declared
        if annotation is not None and name in texts
    }


def _value(default: ast.expr | None) -> Any:
    """Return the value of a default; None for an object, which the docstring describes."""
    with suppress(TypeError, ValueError):
        return ast.literal_eval(default)  # type: ignore[arg-type]
    return None


def _definition(name: str) -> ast.ClassDef | ast.FunctionDef:
    """Return the source of a public function or class, which the stubs of the rooms lead to."""
    *rooms, own = name.split(".")
    place = Path(carlasc.__path__[0]).joinpath(*rooms[1:])
    while place.is_dir():
        for node in ast.parse((place / "__init__.pyi").read_text()).body:
            if isinstance(node, ast.ImportFrom) and own in [alias.name for alias in node.names]:
                place = place.joinpath(*(node.module or "").split("."))
                break
        else:
            raise LookupError(name)
    definitions = ast.parse(place.with_suffix(".py").read_text(encoding="utf-8")).body
    for node in reversed(definitions):  # overloads come first
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == own:
            return node
    raise LookupError(name)


def _help(text: str, typed: Mapping[str, str]) -> str:
    """Return a text of a docstring as the help of an option: a sentence, with options for
    arguments, and the meaning of None as the default.
    """
    text = _NONE.sub(r". Default: \1", " ".join(text.split()).rstrip("."))
    text = re.sub(r"`(\w+)`", lambda match: typed.get(match[1], match[1]), text)
    return f"{text[0].upper()}{text[1:]}.".replace('"', "").replace("`", "")
