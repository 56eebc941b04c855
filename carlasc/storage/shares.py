"""The share of a part of a run: some sequences of a source, chosen by the names of their folders
before any of them is opened.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

from carlasc.errors import ArgumentError, MissingDataError
from carlasc.running.spreading import Run
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import identity_of
from carlasc.storage.protocol import Sequence, Source
from carlasc.storage.transport.remote_tree import target_of
from carlasc.storage.views import ChosenSequences


class Share(Source):
    """The sequences of a part of a run.

    Attributes:
        whole: the source.
        own: the folders of the part: see `Source.places`.
        others: the folders of other parts.
        first: the first folder of all.
        run: how the work on the part is spread. Its own part is one of those that share a sequence.
    """

    def __init__(self, whole: Source, run: Run) -> None:
        """Deal the folders of a source, without opening sequences.

        Args:
            whole: the source.
            run: how the work on the source is spread.
        """
        self.whole = whole
        self.location = whole.location
        listed = read_list(run, whole.places) if run.is_share else [""]
        self.own, part = run.part.share(listed)
        own = {*self.own}
        self.first = listed[0]
        self.others = [place for place in listed if place not in own]
        self.run = replace(run, part=part, sequences_from=None)

    def sequences(self) -> Mapping[str, Sequence]:
        """Return the sequences of the part; there may be none."""
        return source_in(self.whole, self.own).sequences()


def source_in(source: Source, places: Collection[str]) -> Source:
    """Return the part of a source in some of its `places()`."""
    if [*places] == [""]:
        return source
    return ChosenSequences(source.location, source.sequences_in(places))


def sample_of(
    source: Source,
    sample: int | None,
    sequences_from: AnyPath | None = None,
    name: str = "sample",
) -> tuple[list[str], dict[str, int]]:
    """Return evenly spaced folders of a source, and the number of all by split if there are more.

    Args:
        source: the source.
        sample: about how many folders are returned. None: all.
        sequences_from: see `read_list`.
        name: name of the argument `sample`, for errors.

    Raises:
        ArgumentError: `sample` is less than 1.
    """
    if sample is not None and sample < 1:
        raise ArgumentError(name, expected="1 or more", found=sample)
    if sample is None and sequences_from is None:
        return [""], {}
    places = read_list(Run(sequences_from=sequences_from), source.places)
    chosen = places[:: -(-len(places) // (sample or len(places)))]
    splits = Counter(identity_of(f"{place}/cartesian")[0] or "none" for place in places)
    return chosen, splits if len(chosen) < len(places) else {}


def read_list(run: Run, places: Callable[[], list[str]]) -> list[str]:
    """Return the places that a run works on: those of its list, which is written if it does not
    exist, or all.

    Args:
        run: the run.
        places: finds all places.

    Raises:
        MissingDataError: the list is empty.
    """
    if run.sequences_from is None:
        return places()
    folder, name = os.path.split(os.fspath(run.sequences_from))
    target = target_of(folder or ".")
    if (data := target.read(name)) is None:
        lines = "".join(f"{place or '.'}\n" for place in places())
        if lines:  # `finish` finds none: it would leave an empty list for the parts
            target.put(name, lines.encode(errors="surrogateescape"), create=True)
        data = target.read(name) or b""
    named = data.decode(errors="surrogateescape").splitlines()
    found = [line.strip().rstrip("/") for line in named if line.strip()]
    if not found:
        where = target.tree.where(name)
        raise MissingDataError(where, expected="folders, one per line", found="none")
    return ["" if place == "." else place for place in dict.fromkeys(found)]
