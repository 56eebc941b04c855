"""`carlasc card`."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated

import carlasc
from carlasc.cli.common import (
    Json,
    SourceArgument,
    echo,
    file_option,
    print_json,
    report_failures,
)
from carlasc.cli.flags import OneWorkerFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import FormatError, MissingDataError, count


def _details(given: Given) -> carlasc.CardDetails:
    """Return the details of the card, with the contents of the files that are given."""
    texts = {}
    for name, kind in (("citation", "a BibTeX file"), ("statements", "a TOML file")):
        file: Path | None = given.values.get(name)
        if file is None:
            continue
        if not file.is_file():
            raise MissingDataError(file, expected=kind, found="nothing", advice="check the path")
        texts[name] = file.read_text(errors="replace")
    contents: dict[str, object] = {**texts}
    try:
        if "statements" in texts:
            contents["statements"] = tomllib.loads(texts["statements"])
    except tomllib.TOMLDecodeError as error:
        raise FormatError(given.values["statements"], problem=f"no TOML: {error}") from error
    return given.make(**contents)


def card(
    *,
    details: Annotated[Given, Library("carlasc.CardDetails")],
    work: OneWorkerFlags,
    source: SourceArgument = ".",
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
    options: Annotated[Given, Library("carlasc.card")],
    as_json: Json = False,
) -> None:
    """Write the card of a data set: README.md for the Hugging Face Hub, and croissant.json with the
    fields for responsible AI.

    Converted data keep the licence of their source. The command fails if that licence forbids
    publishing what is made from the data.
    """
    about = _details(details)
    with work.spread("Counting", usual=1) as run:
        result: carlasc.inspection.CardResult = options.make(source, out, about=about, run=run)
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
