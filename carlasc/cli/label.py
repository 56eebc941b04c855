"""`carlasc label`."""

from __future__ import annotations

from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import FramesOption, Json, echo, place_argument, place_option, print_json
from carlasc.cli.flags import RunFlags
from carlasc.errors import ArgumentError, count


def label(
    run: RunFlags,
    source: Annotated[str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")],
    out: Annotated[str, place_option("-o", "--out", text="Folder of the labelled data set.")],
    predictions: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="FILES",
            help="Folder of the predictions: a file for each frame, by sequence. motion: what carlasc finds to move, as instances and flow. images: the classes of the pixels that show the points.",
        ),
    ],
    pixels: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="With --from images, classes of pixels: SEQUENCE/CAMERA/000000.png or .npy; default: image_labels of SOURCE.",
        ),
    ] = None,
    motion: Annotated[
        carlasc.motion.MotionSource | None,
        typer.Option(help="With --from motion, what tells which points move; default: the best field, and free space."),
    ] = None,
    classes: Annotated[
        str | None, typer.Option(metavar="TABLE", help="Class table of the predictions, by name or in a JSON file.")
    ] = None,
    logits: Annotated[
        bool, typer.Option("--logits", help="Scores of classes are those from before the softmax.")
    ] = False,
    by: Annotated[str | None, typer.Option(help="What made the labels; the name of FILES if not given.")] = None,
    frames: FramesOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what this command has made.")] = False,
    json: Json = False,
) -> None:
    """Write a copy of SOURCE with the labels that a network predicted for its points or images, or with what moves in it. SOURCE is not changed.

    Files that do not change are hard links. If it is interrupted, run the same command again to finish it.
    """
    if pixels is not None and predictions != "images":
        raise ArgumentError("pixels", expected="--from images", found=f"--from {predictions}")
    others: dict[str, object] = {"--logits": logits, "--frames": frames}
    others |= {"--classes": classes, "--by": by} if predictions == "motion" else {}
    if predictions in ("motion", "images") and (given := [name for name, value in others.items() if value]):
        raise ArgumentError("predictions", expected=f"no {given[0]} with --from {predictions}", found=given[0])
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
        echo(f"note: without {', '.join(result.left_out)}, of other labels or classes")
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(
        f"{result.out}: labels of {count(result.frames, 'frame')} predicted by {result.by} ({result.classes}); {files}"
    )


def _label_motion(
    source: str, out: str, motion: carlasc.motion.MotionSource, overwrite: bool, run: RunFlags, json: bool
) -> None:
    """Write what moves, and print what was found."""
    observe = carlasc.FromScans(motion=carlasc.motion.MotionOptions(motion))
    with run.spread("Finding what moves", "scans and files") as spread:
        result = carlasc.label_motion(source, out, observe=observe, overwrite=overwrite, run=spread)
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(f"note: {note}", err=True)
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(f"{result.out}: {count(result.actors, 'moving actor')}, in instances and flow; {files}")
