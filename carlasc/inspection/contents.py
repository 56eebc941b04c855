"""Checks of the files of a sequence, each alone and against each other: sizes, numbers of frames,
values, and the evidence of grids.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.grids import VoxelFlag
from carlasc.errors import CarlascError
from carlasc.inspection.findings import Finding, Severity
from carlasc.storage import layout
from carlasc.storage.folder import FolderSequence
from carlasc.storage.protocol import Sequence

_ADVICE = "make the grid again with `carlasc regrid --keep-{}`"


def check_evidence(
    sequence: Sequence,
    grid: str,
    frame: int,
    arrays: Mapping[str, NDArray[Any]],
    classes: ClassTable | None,
) -> Iterator[Finding]:
    """Check the values of the fields of evidence and actors of a grid.

    Args:
        sequence: the sequence.
        grid: name of the grid.
        frame: number of the frame.
        arrays: the fields of the frame that could be read, by name.
        classes: class table of the grid; None if it is not known.
    """
    for part in (*layout.EVIDENCE_FIELDS, *layout.ACTOR_FIELDS):
        name = f"{grid}/{part}"
        if name not in arrays:
            continue
        check, kept = (
            ("evidence", "evidence") if part in layout.EVIDENCE_FIELDS else (part, "actors")
        )
        where, advice = (
            f"{sequence.location}/{layout.field_named(name).file(frame)}",
            _ADVICE.format(kept),
        )
        for expected, found in _mistakes(
            part, arrays[name], sequence.grids[grid].num_voxels, classes
        ):
            yield Finding("error", check, sequence.path, where, expected, found, advice)
        labels = arrays.get(f"{grid}/labels")
        if (
            part == "instance"
            and labels is not None
            and (lost := np.count_nonzero((labels == 0) & (arrays[name] > 0)))
        ):
            yield Finding(
                "error",
                check,
                sequence.path,
                where,
                "actors in occupied voxels",
                f"{lost} others",
                advice,
            )


def _mistakes(
    part: str, array: NDArray[Any], num_voxels: int, classes: ClassTable | None
) -> Iterator[tuple[str, str]]:
    """Yield what was expected and what was found, for each kind of mistake."""
    if part == "occupied":
        wrong = array[~((array >= 0) & (array <= 1))]  # NaN is wrong too
        if wrong.size:
            yield "probabilities of 0 to 1", f"{wrong[0]:g}, and {wrong.size - 1} other such values"
    elif part == "flags":
        wrong = array[array > sum(VoxelFlag)]
        if wrong.size:
            yield (
                f"flags of 0 to {sum(VoxelFlag)}",
                f"{wrong[0]}, and {wrong.size - 1} other such values",
            )
    elif part == "classes":
        yield from _mistakes_of_classes(array, num_voxels, classes)
    elif part == "velocity":
        yield from _mistakes_of_velocity(array, num_voxels)


def _mistakes_of_velocity(table: NDArray[Any], num_voxels: int) -> Iterator[tuple[str, str]]:
    voxels, finite = table["voxel"].astype(np.int64), np.isfinite(table["velocity"]).all(axis=1)
    if len(voxels) and not (
        voxels[0] >= 0 and voxels[-1] < num_voxels and (np.diff(voxels) > 0).all()
    ):
        yield f"rising voxels from 0 to {num_voxels - 1}", "others"
    if not finite.all():
        yield "finite velocities", f"NaN or infinity in {np.count_nonzero(~finite)} voxels"


def _mistakes_of_classes(
    table: NDArray[Any], num_voxels: int, classes: ClassTable | None
) -> Iterator[tuple[str, str]]:
    inside = (table["voxel"] >= 0) & (table["voxel"] < num_voxels)
    if not inside.all():
        yield (
            f"voxels 0 to {num_voxels - 1}",
            f"{table['voxel'][~inside][0]}, and {(~inside).sum() - 1} other such rows",
        )
    if classes is not None:
        known = np.isin(table["label"], sorted(set(classes.names) - {0}))
        if not known.all():
            found = f"{table['label'][~known][0]}, and {(~known).sum() - 1} other such rows"
            yield f"class ids of {classes.name} other than 0", found
    voxels, place = np.unique(table["voxel"][inside], return_inverse=True)
    sums = np.bincount(place, table["votes"][inside], len(voxels))
    # each is rounded
    too_large = np.flatnonzero(
        sums > layout.CERTAIN + 0.5 * np.bincount(place, minlength=len(voxels))
    )
    if len(too_large):
        first = too_large[0]
        found = f"{sums[first]:.0f} in voxel {voxels[first]}, and {len(too_large) - 1} other such voxels"
        yield f"probabilities that add up to at most {layout.CERTAIN} per voxel", found


_FASTEST_M_S = 100.0
_FARTHEST_M = 500.0  # boxes farther from the sensor are in another frame


def check_documents(sequence: Sequence) -> Iterator[Finding]:
    """Check carlasc.json and the params.json of each grid, and that the sequence holds data."""
    where = sequence.location
    described = True
    try:
        _ = sequence.metadata
    except CarlascError as error:
        described = False
        yield Finding.from_error("metadata", sequence.path, f"{where}/{layout.METADATA}", error)
    try:
        grids = sequence.grids
    except CarlascError as error:
        yield Finding.from_error("params", sequence.path, where, error)
        return
    if not sequence.fields():
        advice = (
            "copy the sequence again, because it is empty or not complete, or give another folder"
        )
        yield Finding("error", "empty", sequence.path, where, "scans or grids", "none", advice)
    elif not grids:
        advice = "make grids with `carlasc regrid`, or read those of eval_*.zip with `grids_source`"
        yield Finding(
            "note", "no-grids", sequence.path, where, "a folder of grids", "scans only", advice
        )
    if isinstance(sequence, FolderSequence):
        yield from _check_grid_folders(sequence, set(grids))
    for name, spec in grids.items():
        file, params = f"{where}/{layout.params_file(name)}", sequence.params(name)
        channels = params.get("num_channels")
        classes: ClassTable | None = None
        try:
            classes = sequence.classes_of(name)
        except CarlascError as error:
            if described:  # otherwise it is the same error
                yield Finding.from_error("params", sequence.path, file, error)
        if not isinstance(channels, int | float) or (
            classes is not None and channels < max(classes.names) + 1
        ):
            expected = (
                f"num_channels of at least {max(classes.names) + 1}"
                if classes
                else "a number in num_channels"
            )
            yield Finding("warning", "params", sequence.path, file, expected, repr(channels))
        if (
            sequence.path.split("/")[-1] in layout.COORDINATES
            and spec.coordinates != sequence.coordinates
        ):
            expected = f"a {sequence.coordinates} grid, as the folder says"
            yield Finding(
                "warning", "params", sequence.path, file, expected, f"a {spec.coordinates} one"
            )
        if f"{name}/counts" not in sequence.fields() and sequence.predicted_by(name) is None:
            folder, advice = (
                f"{where}/{name}",
                "copy the counts too; without them, all voxels are taken as known",
            )
            yield Finding(
                "warning",
                "frame-counts",
                sequence.path,
                folder,
                "counts beside the labels",
                "none",
                advice,
            )


def _check_grid_folders(sequence: FolderSequence, grids: set[str]) -> Iterator[Finding]:
    """Check that each folder of grids has its params.json: a sequence does not list a folder
    without it.
    """
    for folder in sorted(Path(sequence.location).glob(f"{layout.EVALUATION}*/")):
        if folder.name not in grids and folder.is_dir():
            file, advice = (
                str(folder / layout.PARAMS),
                "copy the file: the grid is ignored without it",
            )
            yield Finding(
                "error", "params", sequence.path, file, "the grid's geometry", "no file", advice
            )


def check_frames(sequence: Sequence) -> Iterator[Finding]:
    """Check that frame numbers have no gaps, and that each field has the frames that it must have."""
    fields, frames = sequence.fields(), sequence.scan_frames()
    gaps = np.flatnonzero(np.diff(frames) > 1)
    if len(gaps):
        missing = int((np.diff(frames)[gaps] - 1).sum())
        first, then = int(frames[gaps[0]]), int(frames[gaps[0] + 1])
        found = f"{len(gaps)} gaps, {missing} frames missing; the first gap is between {first} and {then}"
        advice = "copy the frames again, unless they were left out on purpose: histories of scans do not cross a gap"
        # grids are often made for every fifth frame only, but gaps between scans are rarely
        # intended
        severity: Severity = "warning" if "points" in fields else "note"
        yield Finding(
            severity,
            "frame-gaps",
            sequence.path,
            sequence.location,
            "consecutive frame numbers",
            found,
            advice,
        )
    if "points" in fields:
        for name, field in layout.SCAN_FIELDS.items():
            if name in fields and name != "points":
                incomplete: Severity | None = {"point": "error", "box": None}.get(field.per, "note")
                yield from _compare_frames(
                    sequence, name, "points", incomplete, incomplete or "warning"
                )
    for grid in sorted({name.rpartition("/")[0] for name in fields if "/" in name}):
        parts = [part for part in layout.GRID_FIELDS if f"{grid}/{part}" in fields]
        if "labels" not in parts:
            where = f"{sequence.location}/{grid}"
            yield Finding(
                "error",
                "frame-counts",
                sequence.path,
                where,
                "labels of the grid",
                f"only {', '.join(parts)}",
            )
            continue
        for part in parts[1:]:
            yield from _compare_frames(
                sequence, f"{grid}/{part}", f"{grid}/labels", "error", "error"
            )
        if "points" in fields:
            yield from _compare_frames(sequence, f"{grid}/labels", "points", "note", "warning")


def check_shapes(sequence: Sequence, frame: int, with_grids: bool = True) -> Iterator[Finding]:
    """Check that the size of each file of a frame fits params.json and the other files.

    Values are not checked.
    """
    fields = [
        name
        for name in sequence.fields()
        if _has(sequence, name, frame) and (with_grids or "/" not in name)
    ]
    count: int | None = None
    for name in sorted(fields, key=lambda name: (name != "points", name)):
        where = _file(sequence, name, frame)
        try:
            array = sequence.read(name, frame)
        except CarlascError as error:
            yield Finding.from_error(
                "file-size", sequence.path, where, error, "copy the file again, or make it again"
            )
            continue
        if name == "points":
            count = len(array)
            if count == 0:
                yield Finding(
                    "warning", "empty-scan", sequence.path, where, "points", "an empty scan"
                )
        elif layout.field_named(name).per == "point" and count is not None and len(array) != count:
            expected = f"{count} rows, one per point of {_file(sequence, 'points', frame)}"
            yield Finding(
                "error",
                "point-counts",
                sequence.path,
                where,
                expected,
                f"{len(array)} rows",
                "copy both files again, or make them again",
            )


def check_values(sequence: Sequence, frame: int) -> Iterator[Finding]:
    """Check the values in the files of a frame.

    Files that cannot be read are skipped: `check_shapes` reports them.
    """
    arrays = _read_all(sequence, frame)
    for name in sorted(layout.SCAN_FIELDS.keys() & arrays.keys()):
        kind, where = layout.SCAN_FIELDS[name].kind, _file(sequence, name, frame)
        if arrays[name].dtype.kind == "f":
            yield from _check_numbers(sequence, name, arrays[name], where)
        elif kind == "class":
            yield from _check_classes(sequence, arrays[name], sequence.metadata.classes, where)
        elif kind == "pairs":
            yield from _check_classes(
                sequence, arrays[name][:, ::2], sequence.metadata.classes, where
            )
        elif kind == "boxes":
            yield from _check_boxes(sequence, arrays[name], where)
        elif kind == "picture" and arrays[name][:2].tobytes() != b"\xff\xd8":
            yield Finding("warning", name, sequence.path, where, "a JPEG picture", "other bytes")
    for grid in sequence.grids:
        if f"{grid}/labels" in arrays:
            yield from _check_grid(sequence, grid, frame, arrays)
        yield from check_evidence(sequence, grid, frame, arrays, _classes_of(sequence, grid))


def _check_numbers(
    sequence: Sequence, name: str, array: NDArray[Any], where: str
) -> Iterator[Finding]:
    finite = np.isfinite(array)
    if not finite.all():
        rows = finite.all(axis=tuple(range(1, array.ndim)))
        found = f"NaN or infinity in {int((~rows).sum())} rows, first in row {int(np.argmin(rows))}"
        yield Finding("error", "not-finite", sequence.path, where, "finite numbers", found)
    elif name == "flow" and len(array) and float(np.abs(array).max()) > _FASTEST_M_S:
        found = f"{float(np.abs(array).max()):.0f} m/s"
        yield Finding(
            "warning",
            "flow",
            sequence.path,
            where,
            f"velocities below {_FASTEST_M_S:.0f} m/s",
            found,
        )


def _check_boxes(sequence: Sequence, table: NDArray[Any], where: str) -> Iterator[Finding]:
    try:
        boxes = Boxes.from_table(table, where)
    except CarlascError as error:
        yield Finding.from_error("boxes", sequence.path, where, error)
        return
    yield from _check_classes(sequence, boxes.labels, sequence.metadata.classes, where)
    far = np.flatnonzero(np.linalg.norm(boxes.centers, axis=1) > _FARTHEST_M)
    if len(far):
        found = f"track {boxes.tracks[far[0]]} at {boxes.centers[far[0]].round(1).tolist()}, and {len(far) - 1} others"
        advice = "write boxes in the frame of the sensor, not of the world"
        yield Finding(
            "warning",
            "boxes",
            sequence.path,
            where,
            f"boxes within {_FARTHEST_M:.0f} m",
            found,
            advice,
        )


def _check_grid(
    sequence: Sequence, grid: str, frame: int, arrays: Mapping[str, NDArray[Any]]
) -> Iterator[Finding]:
    labels, where = arrays[f"{grid}/labels"], _file(sequence, f"{grid}/labels", frame)
    classes = _classes_of(sequence, grid)
    if classes is not None:
        yield from _check_classes(sequence, labels, classes, where)
    if f"{grid}/counts" not in arrays:
        return
    counts, file = arrays[f"{grid}/counts"], _file(sequence, f"{grid}/counts", frame)
    whole = (counts >= 0) & (counts == np.floor(counts)) & np.isfinite(counts)
    if not whole.all():
        found = f"{counts[~whole][0]:g}, and {int((~whole).sum()) - 1} other such values"
        yield Finding(
            "error", "counts", sequence.path, file, "whole numbers of votes, 0 or more", found
        )
    without_vote = int(np.count_nonzero((labels != 0) & ~(counts > 0)))
    if without_vote:
        found = f"{without_vote} voxels with a label but no vote"
        advice = "make the grid again: labels and counts are from different frames or runs"
        yield Finding(
            "error",
            "counts",
            sequence.path,
            file,
            "a vote in each voxel with a label",
            found,
            advice,
        )
    if not (counts > 0).any():
        yield Finding(
            "warning", "counts", sequence.path, file, "known voxels", "no vote in the whole grid"
        )


def _classes_of(sequence: Sequence, grid: str) -> ClassTable | None:
    """Return the class table of a grid's labels; None if params.json names an unknown one, which
    `check_documents` reports.
    """
    try:
        return sequence.classes_of(grid)
    except CarlascError:
        return None


def _check_classes(
    sequence: Sequence, labels: NDArray[np.integer], classes: ClassTable, where: str
) -> Iterator[Finding]:
    known = np.zeros(classes.num_channels, np.bool_)
    known[list(classes.names)] = True
    inside = labels < len(known)
    if inside.all() and known[labels].all():
        return
    ids, counts = np.unique(labels, return_counts=True)
    unknown = [
        (int(i), int(n)) for i, n in zip(ids, counts, strict=True) if int(i) not in classes.names
    ]
    found = ", ".join(f"{i} ({n} times)" for i, n in unknown[:5]) + (
        " and more" if len(unknown) > 5 else ""
    )
    advice = f"correct the file, or the classes in {layout.METADATA}"
    yield Finding(
        "error", "class-ids", sequence.path, where, f"class ids of {classes.name}", found, advice
    )


def _compare_frames(
    sequence: Sequence, field: str, reference: str, incomplete: Severity | None, orphans: Severity
) -> Iterator[Finding]:
    """Compare the frames of a field with those of the field that it belongs to.

    Missing frames are findings of severity `incomplete`, and no findings if it is None (a frame
    without boxes was not annotated). Frames that the other field lacks are findings of severity
    `orphans`.
    """
    have, wanted = _frame_set(sequence, field), _frame_set(sequence, reference)
    missing, extra = sorted(wanted - have), sorted(have - wanted)
    where = f"{sequence.location}/{layout.field_named(field).folder}"
    if missing and incomplete is not None:
        expected = f"{field} for each of the {len(wanted)} frames of {reference}"
        yield Finding(
            incomplete,
            "frame-counts",
            sequence.path,
            where,
            expected,
            f"none for {_first_of(missing)}",
        )
    if extra:
        found = f"{len(extra)} more: {_first_of(extra)}"
        yield Finding(
            orphans, "frame-counts", sequence.path, where, f"only the frames of {reference}", found
        )


def _first_of(frames: list[int]) -> str:
    shown = ", ".join(f"{frame:06d}" for frame in frames[:3])
    return f"{shown}{f' and {len(frames) - 3} more' if len(frames) > 3 else ''}"


def _read_all(sequence: Sequence, frame: int) -> dict[str, NDArray[Any]]:
    arrays = {}
    for name in sequence.fields():
        if _has(sequence, name, frame):
            try:
                arrays[name] = sequence.read(name, frame)
            except CarlascError:
                continue  # reported by check_shapes
    return arrays


def _frame_set(sequence: Sequence, field: str) -> frozenset[int]:
    return frozenset(sequence.frames(field).tolist())


def _has(sequence: Sequence, field: str, frame: int) -> bool:
    frames = sequence.frames(field)
    place = int(np.searchsorted(frames, frame))
    return place < len(frames) and int(frames[place]) == frame


def _file(sequence: Sequence, field: str, frame: int) -> str:
    return f"{sequence.location}/{layout.field_named(field).file(frame)}"
