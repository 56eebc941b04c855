"""`carlasc card`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, echo, file_option, place_argument, print_json, progress_bar, report_failures
from carlasc.running.options import Run


def card(
    source: Annotated[str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")] = ".",
    out: Annotated[
        Path | None,
        file_option(
            "-o",
            "--out",
            metavar="FOLDER",
            text="Folder of the card, the root of what you publish. Default: the data, if they are a folder or a Parquet store; otherwise the"
            " folder that they are in.",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the data set; that of the source if not given.")] = None,
    description: Annotated[str | None, typer.Option(help="What it is, in a sentence or two.")] = None,
    author: Annotated[
        list[str] | None, typer.Option("--author", help="Who publishes it; give it once for each author.")
    ] = None,
    license: Annotated[
        str | None,
        typer.Option(
            help="Licence of the sequences whose carlasc.json names none, such as cc-by-4.0, or the address of its text."
        ),
    ] = None,
    citation: Annotated[
        Path | None, file_option("--citation", metavar="FILE", text="A BibTeX file that says how to cite the data.")
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(help="Page where the data are published, such as https://huggingface.co/datasets/ORG/NAME."),
    ] = None,
    contact: Annotated[str | None, typer.Option(help="Whom to ask.")] = None,
    version: Annotated[str, typer.Option("--data-version", help="Version of the data.")] = "1.0.0",
    published: Annotated[
        str | None, typer.Option(metavar="YYYY-MM-DD", help="Date of the publication; today if not given.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Draw a grid and a scan, with the extra `render`.")
    ] = True,
    every: Annotated[int, typer.Option(metavar="N", help="Count the classes of every N-th frame.")] = 1,
    workers: Annotated[
        int | None, typer.Option(help="Processes that work side by side; if not given, one.", min=1)
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing card.")] = False,
    as_json: Json = False,
) -> None:
    """Write the card of a data set: README.md for the Hugging Face Hub, and croissant.json with its responsible-AI fields.

    The licence of data that were converted holds for what was made from them; data whose licence forbids passing them on are refused.
    """
    from carlasc.errors import MissingDataError
    from carlasc.inspection.cards.card import card as write
    from carlasc.inspection.cards.facts import CardDetails

    if citation is not None and not citation.is_file():
        raise MissingDataError(citation, expected="a BibTeX file", found="nothing")
    with progress_bar("Counting") as progress:
        result = write(
            source,
            out,
            about=CardDetails(
                name=name,
                description=description,
                authors=author or (),
                license=license,
                citation=None if citation is None else citation.read_text(errors="replace"),
                url=url,
                contact=contact,
                version=version,
                published=published,
            ),
            pictures=pictures,
            every=every,
            run=Run(workers=workers or 1, progress=progress),
            overwrite=overwrite,
        )
    if as_json:
        print_json(result.to_dict())
    else:
        for note in result.notes:
            echo(note)
        sequences = "1 sequence" if result.sequences == 1 else f"{result.sequences} sequences"
        echo(f"{result.frames} frames in {sequences}, licence {', '.join(result.licenses)}")
        for file in result.files:
            echo(file)
    report_failures(list(result.failures), result.frames, "files")
