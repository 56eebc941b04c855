"""What `render` and `view` are told of what they show: options that both take."""

from __future__ import annotations

from typing import Annotated

import typer

GridOption = Annotated[str | None, typer.Option("--grid", help="The grid's folder; `evaluation` if not given.")]
TruthOption = Annotated[
    str | None, typer.Option("--truth", help="Ground truth to show beside PATH, a prediction; and where it errs.")
]
TruthGridOption = Annotated[
    str | None, typer.Option("--truth-grid", help="The truth's grid; `evaluation` if not given.")
]
SequenceOption = Annotated[
    str | None, typer.Option("--sequence", help="The sequence, where there are several; the first if not given.")
]
ClassesOption = Annotated[
    str | None,
    typer.Option("--classes", help="Classes to show: carlasc11 for the paper's eleven; the data's own if not given."),
]
PathClassesOption = Annotated[
    str | None, typer.Option("--path-classes", help="Class table of PATH's labels, where nothing beside them says.")
]
