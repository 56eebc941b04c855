"""Arguments and options that `render` and `view` share: the choice of a scene."""

from __future__ import annotations

from typing import Annotated

import typer

from carlasc.cli.common import place_argument, place_option

SourceArgument = Annotated[
    str,
    place_argument(
        "A sequence or data set (folder, zip, packed store, URL), the folder of a grid, or the file of one frame."
    ),
]
SequenceOption = Annotated[
    str | None, typer.Option("--sequence", help="Name of the sequence if there are several. Default: the first.")
]
EveryOption = Annotated[int, typer.Option("--every", help="Take every N-th frame.", min=1)]
GridOption = Annotated[
    str | None, typer.Option("--grid", help="Name of the grid. Default: `evaluation`, or the first grid.")
]
TruthOption = Annotated[
    str | None,
    place_option("--truth", text="Ground truth: SOURCE is then a prediction, shown with it and with its errors."),
]
TruthGridOption = Annotated[
    str | None, typer.Option("--truth-grid", help="Name of the ground truth's grid. Default: as for --grid.")
]
ClassesOption = Annotated[
    str | None,
    typer.Option(
        "--classes", help="Class table to show, such as carlasc11 (the paper's eleven). Default: that of the data."
    ),
]
SourceClassesOption = Annotated[
    str | None,
    typer.Option("--source-classes", help="Class table of the labels in SOURCE, if its metadata do not say it."),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]


def describe_frames(frames: tuple[int, ...]) -> str:
    """Return "frame 3" or "12 frames"."""
    return f"frame {frames[0]}" if len(frames) == 1 else f"{len(frames)} frames"
