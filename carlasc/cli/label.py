"""`carlasc label`."""

from __future__ import annotations

from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import FramesOption, Json, echo, place_argument, place_option, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.grid_flags import MOTION_HELP
from carlasc.errors import ArgumentError, count


def label(
    run: RunFlags,
    source: Annotated[
        str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")
    ],
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
    motion: Annotated[
        carlasc.motion.MotionSource | None,
        typer.Option(help=f"With --from motion. {MOTION_HELP} (default)."),
    ] = None,
    classes: Annotated[
        str | None,
        typer.Option(
            metavar="TABLE", help="Class table of the predictions: its name, or a JSON file."
        ),
    ] = None,
    logits: Annotated[
        bool,
        typer.Option(
            "--logits", help="The predicted class scores are logits (before the softmax)."
        ),
    ] = False,
    by: Annotated[
        str | None,
        typer.Option(help="Name of the network, for the metadata. Default: the name of FILES."),
    ] = None,
    frames: FramesOption = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier output of this command.")
    ] = False,
    json: Json = False,
) -> None:
    """Write a copy of SOURCE with labels that a network predicted for its points or images, or with
    estimated motion. SOURCE is not changed.

    Unchanged files are hard links. If it is interrupted, run the same command again to finish it.
    """
    if pixels is not None and predictions != "images":
        raise ArgumentError("pixels", expected="--from images", found=f"--from {predictions}")
    others: dict[str, object] = {"--logits": logits, "--frames": frames}
    others |= {"--classes": classes, "--by": by} if predictions == "motion" else {}
    if predictions in ("motion", "images") and (
        given := [name for name, value in others.items() if value]
    ):
        raise ArgumentError(
            "predictions", expected=f"no {given[0]} with --from {predictions}", found=given[0]
        )
    if predictions == "motion":
        _label_motion(source, out, motion or "auto", overwrite, run, json)
        return
    if motion is not None:
        raise ArgumentError("motion", expected="--from motion", found=f"--from {predictions}")
    with run.spread("Labelling", "files") as spread:
        if predictions == "images":
            result = carlasc.label_images(
                source, out, pixels=pixels, classes=classes, by=by, overwrite=overwrite, run=spread
            )
        else:
            result = carlasc.label(
                source,
                out,
                predictions,
                classes=classes,
                logits=logits,
                by=by,
                frames=frames,
                overwrite=overwrite,
                run=spread,
            )
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
    motion: carlasc.motion.MotionSource,
    overwrite: bool,
    run: RunFlags,
    json: bool,
) -> None:
    """Write the moving actors as instances and flow, and print their number."""
    observe = carlasc.FromScans(motion=carlasc.motion.MotionOptions(motion))
    with run.spread("Finding moving actors", "scans and files") as spread:
        result = carlasc.label_motion(source, out, observe=observe, overwrite=overwrite, run=spread)
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(f"note: {note}", err=True)
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(f"{result.out}: {count(result.actors, 'moving actor')}, in instances and flow; {files}")
