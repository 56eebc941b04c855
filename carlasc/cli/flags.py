"""Groups of options that commands share.

Each group is a class: its fields are options, and its methods make the library's objects.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args, get_type_hints

import typer

from carlasc.cli.common import progress_bar
from carlasc.cli.library import SEPARATOR, Given, Library, ValueKind, make_option

if TYPE_CHECKING:
    from carlasc.converting import OptionDeclaration
    from carlasc.running import Engine, Run

_DECLARED = f"declared{SEPARATOR}"  # prefix of the parameters of declared options


@dataclass(frozen=True)
class Flags:
    """A group of options: each field is an option, or another group.

    Annotations are read when the command is used.

    Attributes:
        heading: heading of the options in `--help`; empty for none.
    """

    heading: ClassVar[str] = ""

    @property
    def is_given(self) -> bool:
        """Whether an option of the group has another value than its default."""
        values = ((field, getattr(self, field.name)) for field in dataclasses.fields(self))
        return any(
            value.is_given if isinstance(value, Flags | Given) else value != field.default
            for field, value in values
        )

    @classmethod
    def parameters(cls) -> Iterator[inspect.Parameter]:
        """Yield the options of the group, each under its heading."""
        hints = get_type_hints(cls, include_extras=True)
        for field in dataclasses.fields(cls):
            hint = hints[field.name]
            if (inner := _group(hint)) is not None:
                yield from inner.parameters()
                continue
            kind: Any
            kind, info = get_args(hint)
            info = copy.copy(info)
            info.rich_help_panel = cls.heading or None
            default = inspect.Parameter.empty if field.default is MISSING else field.default
            annotation = Annotated[kind, info]
            yield inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
            )

    @classmethod
    def take(cls, given: dict[str, Any]) -> Self:
        """Take the values of these options out of those that a command was given."""
        hints = get_type_hints(cls, include_extras=True)
        inner = {field.name: _group(hints[field.name]) for field in dataclasses.fields(cls)}
        return cls(
            **{name: one.take(given) if one else given.pop(name) for name, one in inner.items()}
        )


@dataclass(frozen=True)
class DeclaredOptions(Flags):
    """The options that a converter or an exporter declares: the given values by name."""

    values: Mapping[str, Any]

    @classmethod
    def take(cls, given: dict[str, Any]) -> Self:
        """Take the values of these options out of those that a command was given."""
        names = [name for name in given if name.startswith(_DECLARED)]
        values = {name.removeprefix(_DECLARED): given.pop(name) for name in names}
        return cls({name: value for name, value in values.items() if value is not None})


def flatten(
    function: Callable[..., None], declared: Sequence[OptionDeclaration] = ()
) -> Callable[..., None]:
    """Return a function for typer, in which each option of a group is a parameter of the function
    itself.

    Args:
        function: the function of a command, whose parameters are annotated with options or groups
            of options.
        declared: options that replace the parameter of type `DeclaredOptions`.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type[Flags] | Library] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if (group := _group(hints[name])) is None:
            annotated = parameter.replace(annotation=hints[name], kind=parameter.KEYWORD_ONLY)
            parameters.append(annotated)
            continue
        groups[name] = group
        parameters += map(_declared, declared) if group is DeclaredOptions else group.parameters()

    def command(**given: Any) -> None:
        function(**{name: group.take(given) for name, group in groups.items()}, **given)

    command.__name__ = function.__name__
    command.__doc__ = function.__doc__
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def declared_by(
    kind: Literal["converter", "exporter"], arguments: Sequence[str]
) -> tuple[OptionDeclaration, ...]:
    """Return the options of the converter or exporter that the arguments of a command name, if they
    name one.
    """
    named = [argument for argument in arguments if not argument.startswith("-")]
    if not named:  # the library need not be loaded
        return ()
    from carlasc import converting

    known, load = (
        (converting.converter_names(), converting.load_converter)
        if kind == "converter"
        else (converting.exporter_names(), converting.load_exporter)
    )
    name = next((argument for argument in named if argument in known), None)
    return () if name is None else converting.option_declarations(load(name))


def _group(hint: Any) -> type[Flags] | Library | None:
    """Return the group of options that an annotation stands for; None for a single option."""
    if isinstance(hint, type):
        return hint if issubclass(hint, Flags) else None
    mark = get_args(hint)[-1]
    return mark if isinstance(mark, Library) else None


def _declared(option: OptionDeclaration) -> inspect.Parameter:
    """Return the parameter of a declared option."""
    return make_option(
        _DECLARED + option.name,
        ValueKind(Literal[option.choices] if option.choices else option.type),
        f"--{option.name.replace('_', '-')}",
        option.help,
        default=option.default,
        heading="Options of this data set",
    )


@dataclass(frozen=True)
class WorkFlags(Flags):
    """How work is spread."""

    heading: ClassVar[str] = "Parallel work"

    workers: Annotated[
        int | None, typer.Option(help="Number of parallel processes. Default: one per core.", min=1)
    ] = None
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="Run on a cluster of Dask or Ray: local or local:N (N processes on this machine), "
            "tcp://HOST:PORT or ray://HOST:PORT (one that runs), slurm (starts --workers jobs), or "
            "the dotted path of a cluster class. Default: no cluster.",
        ),
    ] = None

    @contextmanager
    def spread(
        self, title: str, unit: str = "frames", *, usual: int | None = None, shown: bool = True
    ) -> Iterator[Run]:
        """Yield how a run is spread, while a progress bar is shown.

        Args:
            title: what is being done.
            unit: what is counted.
            usual: number of processes without --workers; None for one per core.
            shown: whether there is a progress bar.
        """
        from carlasc.running.spreading import Part, Run

        own = vars(self)  # of `PartFlags` and `RunFlags`
        part = Part.parse(own.get("part") or "1/1")
        listed = own.get("sequences_from")
        bar = progress_bar(title, unit) if shown else nullcontext()
        with bar as progress, self._engine() as executor:
            yield Run(self.workers or usual, executor, part, listed, progress)

    @contextmanager
    def _engine(self) -> Iterator[Engine | None]:
        if self.cluster is None:
            yield None
        else:
            from carlasc.running import open_cluster

            with open_cluster(self.cluster, workers=self.workers) as opened:
                yield opened


@dataclass(frozen=True)
class PartFlags(WorkFlags):
    """How work is spread, also over several commands."""

    part: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Do only part I of N, such as 2/4. Run the other parts as commands of their own, "
            "on any machine that can write to the output.",
        ),
    ] = None


@dataclass(frozen=True)
class RunFlags(PartFlags):
    """How work is spread, also over several commands, of which each may do some sequences."""

    sequences_from: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Work on the sequences whose folders below SOURCE this file lists, one per line. "
            "If it does not exist, it is written, so that other parts need not list SOURCE.",
        ),
    ] = None


@dataclass(frozen=True)
class OneWorkerFlags(WorkFlags):
    """How work is spread; by default, one process does it."""

    workers: Annotated[
        int | None, typer.Option(help="Number of parallel processes. Default: one.", min=1)
    ] = None


@dataclass(frozen=True)
class OneWorkerRunFlags(OneWorkerFlags, RunFlags):
    """As `OneWorkerFlags`, also over several commands."""
