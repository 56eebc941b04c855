"""`carlasc card`."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import typer

import carlasc
from carlasc.cli.common import Json, echo, file_option, place_argument, print_json, report_failures
from carlasc.cli.flags import Flags, OneWorkerFlags
from carlasc.errors import FormatError, MissingDataError, count


@dataclass(frozen=True)
class DetailFlags(Flags):
    """Details that the data do not contain."""

    heading: ClassVar[str] = "Details of the publication"

    name: Annotated[
        str | None, typer.Option(help="Name of the data set. Default: the name of SOURCE.")
    ] = None
    description: Annotated[
        str | None,
        typer.Option(help="Description in a sentence or two. Default: one made from the data."),
    ] = None
    authors: Annotated[
        list[str] | None,
        typer.Option("--author", help="Author or group that publishes it. Repeat it for several."),
    ] = None
    license: Annotated[
        str | None,
        typer.Option(
            help="Licence of the sequences whose carlasc.json names none: a name such as "
            "cc-by-4.0, or the URL of its text."
        ),
    ] = None
    citation: Annotated[
        Path | None,
        file_option(
            "--citation", metavar="FILE", text="A BibTeX file that says how to cite the data."
        ),
    ] = None
    statements: Annotated[
        Path | None,
        file_option(
            "--statements",
            metavar="FILE",
            text="A TOML file with what only the author knows, such as "
            "personalSensitiveInformation: names and texts of Croissant's RAI fields.",
        ),
    ] = None
    url: Annotated[
        str | None,
        typer.Option(
            help="URL where the data are published, such as "
            "https://huggingface.co/datasets/ORG/NAME."
        ),
    ] = None
    contact: Annotated[
        str | None, typer.Option(help="Contact for questions, such as an e-mail address.")
    ] = None
    version: Annotated[str, typer.Option("--data-version", help="Version of the data.")] = "1.0.0"
    published: Annotated[
        str | None,
        typer.Option(metavar="YYYY-MM-DD", help="Date of the publication. Default: today."),
    ] = None

    def details(self) -> carlasc.CardDetails:
        """Return the details of the card."""
        texts = {}
        for name, kind in (("citation", "a BibTeX file"), ("statements", "a TOML file")):
            file: Path | None = getattr(self, name)
            if file is not None and not file.is_file():
                raise MissingDataError(
                    file, expected=kind, found="nothing", advice="check the path"
                )
            texts[name] = None if file is None else file.read_text(errors="replace")
        try:
            statements = tomllib.loads(texts["statements"] or "")
        except tomllib.TOMLDecodeError as error:
            raise FormatError(self.statements, problem=f"no TOML: {error}") from error
        return carlasc.CardDetails(
            **{
                **vars(self),
                "authors": self.authors or (),
                "citation": texts["citation"],
                "statements": statements,
            }
        )


def card(
    details: DetailFlags,
    work: OneWorkerFlags,
    source: Annotated[
        str, place_argument("A data set, a split, a sequence, a zip, a packed store, or a URL.")
    ] = ".",
    out: Annotated[
        Path | None,
        file_option(
            "-o",
            "--out",
            metavar="FOLDER",
            text="Folder of the card: the root folder of the publication. Default: SOURCE, if it "
            "is a folder or a Parquet store; otherwise the folder that contains SOURCE.",
        ),
    ] = None,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures/--no-pictures", help="Draw a grid and a scan (needs the extra `render`)."
        ),
    ] = True,
    every: Annotated[
        int, typer.Option(metavar="N", help="Count the classes of every N-th frame.")
    ] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing card.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write the card of a data set: README.md for the Hugging Face Hub, and croissant.json with the
    fields for responsible AI.

    Converted data keep the licence of their source. The command fails if that licence forbids
    publishing what is made from the data.
    """
    about = details.details()
    with work.spread("Counting", usual=1) as run:
        result = carlasc.card(
            source, out, about=about, pictures=pictures, every=every, overwrite=overwrite, run=run
        )
    if as_json:
        print_json(result.to_dict())
    else:
        for note in result.notes:
            echo(note)
        size = f"{count(result.frames, 'frame')} in {count(result.sequences, 'sequence')}"
        echo(f"{size}, licence {', '.join(result.licenses)}")
        for file in result.files:
            echo(file)
    report_failures(list(result.failures), result.frames, "files")
