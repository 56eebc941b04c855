"""`carlasc label`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import Json, SourceArgument, echo, place_option, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.grid_flags import MotionGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import ArgumentError, count

_REFUSED = {"motion": "logits frames classes by", "images": "logits frames"}  # by --from


def label(
    *,
    run: RunFlags,
    source: SourceArgument,
    out: Annotated[str, place_option("-o", "--out", text="Folder of the labelled data set.")],
    predictions: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="FILES",
            help="Folder of predictions, with a folder per sequence and a file per frame. motion: "
            "instances and flow of the actors that carlasc finds to move. images: the class of "
            "each point is that of the camera pixel that shows it.",
        ),
    ],
    pixels: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="With --from images: folder of the classes of pixels, as "
            "SEQUENCE/CAMERA/000000.png or .npy. Default: image_labels of SOURCE.",
        ),
    ] = None,
    options: Annotated[Given, Library("carlasc.label")],
    boxes: Annotated[Given, Library("carlasc.label_motion", "boxes_out")],
    motion: MotionGiven,
    json: Json = False,
) -> None:
    """Write a copy of SOURCE with labels that a network predicted for its points or images, or with
    estimated motion. SOURCE is not changed.

    Unchanged files are hard links. If it is interrupted, run the same command again to finish it.
    """
    if pixels is not None and predictions != "images":
        raise ArgumentError("pixels", expected="--from images", found=f"--from {predictions}")
    for name in _REFUSED.get(predictions, "").split():
        if name in options.values:
            raise ArgumentError(
                "predictions",
                expected=f"no --{name} with --from {predictions}",
                found=f"--{name}",
            )
    if predictions == "motion":
        options = replace(options, name=boxes.name, values={**options.values, **boxes.values})
        _label_motion(source, out, motion, options, run, json)
        return
    for name, given in (("motion", motion), ("boxes_out", boxes)):
        if given.is_given:
            raise ArgumentError(name, expected="--from motion", found=f"--from {predictions}")
    with run.spread("Labelling", "files") as spread:
        if predictions == "images":
            result = carlasc.label_images(source, out, pixels=pixels, **options.values, run=spread)
        else:
            result = options.make(source, out, predictions, run=spread)
    if json:
        print_json(result)
        return
    if result.left_out:
        echo(f"note: {', '.join(result.left_out)} left out, because of other labels or classes")
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(
        f"{result.out}: labels of {count(result.frames, 'frame')} predicted by {result.by} "
        f"({result.classes}); {files}"
    )


def _label_motion(
    source: str,
    out: str,
    motion: Given,
    options: Given,
    run: RunFlags,
    json: bool,
) -> None:
    """Write the moving actors as instances and flow, and print their number."""
    observe = carlasc.FromScans(motion=motion.make())
    with run.spread("Finding moving actors", "scans and files") as spread:
        result = options.make(source, out, observe=observe, run=spread)
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(f"note: {note}", err=True)
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(f"{result.out}: {count(result.actors, 'moving actor')}, in instances and flow; {files}")
