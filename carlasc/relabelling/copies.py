"""What all copies with other labels or poses share: how predicted labels are marked, digests of
inputs, and writing in two stages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

from carlasc.core.arrays import IntArray
from carlasc.core.classes import ClassTable
from carlasc.errors import ArgumentError
from carlasc.running.processes import one_pool
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.derived_copies import CopyResult, DerivedCopy, DerivedSequence
from carlasc.storage.files import AnyPath
from carlasc.storage.inputs import digest_of_bytes
from carlasc.storage.layout import PREDICTED
from carlasc.storage.protocol import Sequence, SequenceWriter, Source

PREDICTED_FIELDS = ("labels", "probabilities")
"""The fields of predicted labels."""

Derived = TypeVar("Derived", bound=DerivedSequence)


class PredictedSequence(DerivedSequence):
    """A sequence with predicted labels instead of its own; a subclass makes them."""

    def __init__(
        self,
        whole: Sequence,
        target: ClassTable,
        by: str,
        made: Mapping[str, IntArray],
    ) -> None:
        """Wrap a sequence.

        Args:
            whole: the sequence.
            target: class table of the predicted labels.
            by: name of the network that predicted them.
            made: frames of the predicted fields.
        """
        labels = {"labels": f"{PREDICTED}{by}"}
        metadata = replace(whole.metadata, classes=target, extra={**whole.metadata.extra, **labels})
        # boxes have classes of the other table
        boxes = {"boxes"} if target != whole.metadata.classes else set()
        stale = boxes | {*PREDICTED_FIELDS} - made.keys()
        super().__init__(whole, {layout.METADATA: metadata.to_json()}, made=made, stale=stale)


@dataclass
class LabelResult(CopyResult):
    """Result of `label`. Boxes are left out if the labels have another class table.

    Attributes:
        by: name of the network that predicted the labels.
        classes: name of the class table of the labels.
        frames: number of frames with labels.
    """

    by: str = ""
    classes: str = ""
    frames: int = 0

    @classmethod
    def of(
        cls, copied: CopyResult, began: float, by: str, sequences: Iterable[PredictedSequence]
    ) -> Self:
        """Return the result of a copy with predicted labels that `began` at this time."""
        labelled = list(sequences)
        return cls(
            **timed(copied, began),
            by=by,
            classes=", ".join(sorted({one.metadata.classes.name for one in labelled})),
            frames=sum(len(one.frames("labels")) for one in labelled),
        )


def timed(copied: CopyResult, began: float) -> dict[str, Any]:
    """Return the attributes of a copy, whose duration is the time since `began`."""
    return vars(copied) | {"elapsed_s": time.perf_counter() - began}


def begin_predicted(
    source: Source,
    out: AnyPath,
    settings: Mapping[str, Any],
    classes: ClassTable | None,
    overwrite: bool,
    run: Run,
) -> DerivedCopy:
    """Begin a copy with predicted labels; see `DerivedCopy`.

    Raises:
        ArgumentError: the name of the network, `by` of the settings, is empty or has several lines.
    """
    by = str(settings["by"])
    if not by.strip() or not by.isprintable():
        raise ArgumentError("by", expected="a name in one line", found=repr(by))
    return DerivedCopy(
        source,
        out,
        {**settings, "classes": None if classes is None else classes.to_dict()},
        kind="predicted labels",
        is_kind=lambda metadata: metadata.predicted is not None,
        overwrite=overwrite,
        run=run,
    )


def digest_of_files(paths: Iterable[Path]) -> str:
    """Return a digest of names, sizes and times of files."""
    stamps = [(str(path), (at := path.stat()).st_size, at.st_mtime_ns) for path in paths]
    return digest_of_bytes(repr(stamps).encode()).hex()


def write_in_stages(
    copy: DerivedCopy,
    given: Mapping[str, Sequence],
    derive: Callable[[str, SequenceWriter | None, Run, StepCounter], Derived],
    run: Run,
    *,
    scans: int,
    made: Iterable[str] = (),
) -> tuple[dict[str, Derived], CopyResult]:
    """Derive each sequence of a copy, then write them; progress counts scans, then files.

    Args:
        copy: the copy.
        given: the sequences by path.
        derive: makes the sequence of a path, from the writer that keeps its results.
        run: how the work is spread.
        scans: number of steps of `derive` for all sequences.
        made: new fields, one file per scan.

    Raises:
        StorageError: the files cannot be written.
    """
    files = sum(
        len(one.frames("points" if name in made else name))
        for one in given.values()
        for name in {name for name in one.fields() if "/" not in name}.union(made)
    )
    step = StepCounter(run.progress, scans + files)
    with one_pool(run) as pool:
        derived = {path: derive(path, copy.writer(path), pool, step) for path in given}
        return derived, copy.write(derived, replace(pool, progress=step.stage(files)))
