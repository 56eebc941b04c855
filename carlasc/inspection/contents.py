"""Checks of the files of a sequence, each alone and against each other: sizes, numbers of frames,
values, and the evidence of grids.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from carlasc.core.arrays import AnyArray, AnyIntArray
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.grids import VoxelFlag
from carlasc.errors import CarlascError, first_names
from carlasc.inspection.findings import Finding, Severity
from carlasc.storage import layout
from carlasc.storage.folder import FolderSequence
from carlasc.storage.protocol import Sequence

_FASTEST_M_S = 100.0
_FARTHEST_M = 500.0  # boxes farther from the sensor are in another frame
_JPEG = b"\xff\xd8"

Arrays = Mapping[str, AnyArray]
"""The fields of a frame that could be read, by name."""


def check_documents(sequence: Sequence) -> Iterator[Finding]:
    """Check carlasc.json and the params.json of each grid, and that the sequence holds data."""
    where = sequence.location
    described = True
    try:
        _ = sequence.metadata
    except CarlascError as error:
        described = False
        yield Finding.from_error("metadata", f"{where}/{layout.METADATA}", error)
    try:
        grids = sequence.grids
    except CarlascError as error:
        yield Finding.from_error("params", where, error)
        return
    if not sequence.fields():
        yield Finding(
            "error",
            "empty",
            where,
            "scans or grids",
            "none",
            "copy the sequence again, because it is empty or not complete, or give another folder",
        )
    elif not grids:
        yield Finding(
            "note",
            "no-grids",
            where,
            "a folder of grids",
            "scans only",
            "make grids with `carlasc regrid`, or read those of eval_*.zip with `grids_source`",
        )
    if isinstance(sequence, FolderSequence):
        # A sequence does not list a folder of grids without params.json.
        for folder in sorted(Path(where).glob(f"{layout.EVALUATION}*/")):
            if folder.name not in grids and folder.is_dir():
                yield Finding(
                    "error",
                    "params",
                    str(folder / layout.PARAMS),
                    "the grid's geometry",
                    "no file",
                    "copy the file: the grid is ignored without it",
                )
    for name, spec in grids.items():
        file = f"{where}/{layout.params_file(name)}"
        channels = sequence.params(name).get("num_channels")
        classes: ClassTable | None = None
        try:
            classes = sequence.classes_of(name)
        except CarlascError as error:
            if described:  # otherwise it is the same error
                yield Finding.from_error("params", file, error)
        least = 0 if classes is None else max(classes.names) + 1
        if not isinstance(channels, int | float) or channels < least:
            expected = f"num_channels of at least {least}" if least else "a number in num_channels"
            yield Finding("warning", "params", file, expected, repr(channels))
        folder_says = sequence.path.split("/")[-1] in layout.COORDINATES
        if folder_says and spec.coordinates != sequence.coordinates:
            expected = f"a {sequence.coordinates} grid, as the folder says"
            yield Finding("warning", "params", file, expected, f"a {spec.coordinates} one")
        if f"{name}/counts" not in sequence.fields() and sequence.predicted_by(name) is None:
            yield Finding(
                "warning",
                "frame-counts",
                f"{where}/{name}",
                "counts beside the labels",
                "none",
                "copy the counts too; without them, all voxels are taken as known",
            )


def check_frames(sequence: Sequence) -> Iterator[Finding]:
    """Check that frame numbers have no gaps, and that no field lacks frames or has more."""
    fields = sequence.fields()
    frames = sequence.scan_frames()
    gaps = np.flatnonzero(np.diff(frames) > 1)
    if len(gaps):
        missing = int((np.diff(frames)[gaps] - 1).sum())
        first = frames[gaps[0]]
        then = frames[gaps[0] + 1]
        yield Finding(
            # Grids are often made for every fifth frame only; gaps between scans are rarely meant.
            "warning" if "points" in fields else "note",
            "frame-gaps",
            sequence.location,
            "consecutive frame numbers",
            f"{len(gaps)} gaps, {missing} frames missing; the first gap is between {first} and "
            f"{then}",
            "copy the frames again, unless they were left out on purpose: histories of scans do "
            "not cross a gap",
        )
    # Each field, the field whose frames it must have, and the severity of missing and of other
    # frames. A frame without boxes was not annotated.
    compared: list[tuple[str, str, Severity | None, Severity]] = []
    for name, field in layout.SCAN_FIELDS.items():
        if name in fields and name != "points" and "points" in fields:
            missing_is: Severity | None = {"point": "error", "box": None}.get(field.per, "note")
            compared.append((name, "points", missing_is, missing_is or "warning"))
    for grid in sorted({name.rpartition("/")[0] for name in fields if "/" in name}):
        parts = [part for part in layout.GRID_FIELDS if f"{grid}/{part}" in fields]
        if "labels" not in parts:
            found = f"only {', '.join(parts)}"
            where = f"{sequence.location}/{grid}"
            yield Finding("error", "frame-counts", where, "labels of the grid", found)
            continue
        labels = f"{grid}/labels"
        compared += [(f"{grid}/{part}", labels, "error", "error") for part in parts[1:]]
        if "points" in fields:
            compared.append((labels, "points", "note", "warning"))
    for name, reference, missing_is, extra_is in compared:
        have, wanted = (set(sequence.frames(field).tolist()) for field in (name, reference))
        where = f"{sequence.location}/{layout.field_named(name).folder}"
        if wanted - have and missing_is is not None:
            expected = f"{name} for each of the {len(wanted)} frames of {reference}"
            found = f"none for {_first_of(wanted - have)}"
            yield Finding(missing_is, "frame-counts", where, expected, found)
        if extra := have - wanted:
            found = f"{len(extra)} more: {_first_of(extra)}"
            yield Finding(extra_is, "frame-counts", where, f"only the frames of {reference}", found)


def check_shapes(sequence: Sequence, frame: int, with_grids: bool = True) -> Iterator[Finding]:
    """Check that the size of each file of a frame fits params.json and the other files.

    Values are not checked.
    """
    count: int | None = None
    for name in sorted(_fields(sequence, frame), key=lambda name: (name != "points", name)):
        if "/" in name and not with_grids:
            continue
        where = _file(sequence, name, frame)
        try:
            array = sequence.read(name, frame)
        except CarlascError as error:
            advice = "copy the file again, or make it again"
            yield Finding.from_error("file-size", where, error, advice)
            continue
        if name == "points":
            count = len(array)
            if count == 0:
                yield Finding("warning", "empty-scan", where, "points", "an empty scan")
        elif layout.field_named(name).per == "point" and count is not None and len(array) != count:
            yield Finding(
                "error",
                "point-counts",
                where,
                f"{count} rows, one per point of {_file(sequence, 'points', frame)}",
                f"{len(array)} rows",
                "copy both files again, or make them again",
            )


def check_values(sequence: Sequence, frame: int) -> Iterator[Finding]:
    """Check the values in the files of a frame.

    Files that cannot be read are skipped: `check_shapes` reports them.
    """
    arrays: dict[str, AnyArray] = {}
    for name in _fields(sequence, frame):
        with suppress(CarlascError):
            arrays[name] = sequence.read(name, frame)
    table = sequence.metadata.classes
    for name in sorted(layout.SCAN_FIELDS.keys() & arrays.keys()):
        kind = layout.SCAN_FIELDS[name].kind
        array = arrays[name]
        where = _file(sequence, name, frame)
        if array.dtype.kind == "f":
            yield from _check_numbers(name, array, where)
        elif kind == "class":
            yield from _check_classes(array, table, where)
        elif kind == "pairs":
            yield from _check_classes(array[:, ::2], table, where)
        elif kind == "boxes":
            yield from _check_boxes(array, table, where)
        elif kind == "picture" and array[:2].tobytes() != _JPEG:
            yield Finding("warning", name, where, "a JPEG picture", "other bytes")
    for grid in sequence.grids:
        classes: ClassTable | None = None
        with suppress(CarlascError):  # an unknown table, which `check_documents` reports
            classes = sequence.classes_of(grid)
        if f"{grid}/labels" in arrays:
            yield from _check_grid(sequence, grid, frame, arrays, classes)
        yield from check_evidence(sequence, grid, frame, arrays, classes)


def _check_numbers(name: str, array: AnyArray, where: str) -> Iterator[Finding]:
    finite = np.isfinite(array)
    fastest = float(np.abs(array).max()) if array.size else 0.0
    if not finite.all():
        rows = finite.all(axis=tuple(range(1, array.ndim)))
        found = f"NaN or infinity in {int((~rows).sum())} rows, first in row {int(np.argmin(rows))}"
        yield Finding("error", "not-finite", where, "finite numbers", found)
    elif name == "flow" and fastest > _FASTEST_M_S:
        expected = f"velocities below {_FASTEST_M_S:.0f} m/s"
        yield Finding("warning", "flow", where, expected, f"{fastest:.0f} m/s")


def _check_boxes(array: AnyArray, classes: ClassTable, where: str) -> Iterator[Finding]:
    try:
        boxes = Boxes.from_table(array, where)
    except CarlascError as error:
        yield Finding.from_error("boxes", where, error)
        return
    yield from _check_classes(boxes.labels, classes, where)
    far = np.flatnonzero(np.linalg.norm(boxes.centers, axis=1) > _FARTHEST_M)
    if len(far):
        center = boxes.centers[far[0]].round(1).tolist()
        yield Finding(
            "warning",
            "boxes",
            where,
            f"boxes within {_FARTHEST_M:.0f} m",
            f"track {boxes.tracks[far[0]]} at {center}, and {len(far) - 1} others",
            "write boxes in the frame of the sensor, not of the world",
        )


def _check_grid(
    sequence: Sequence, grid: str, frame: int, arrays: Arrays, classes: ClassTable | None
) -> Iterator[Finding]:
    labels = arrays[f"{grid}/labels"]
    if classes is not None:
        yield from _check_classes(labels, classes, _file(sequence, f"{grid}/labels", frame))
    if f"{grid}/counts" not in arrays:
        return
    counts = arrays[f"{grid}/counts"]
    file = _file(sequence, f"{grid}/counts", frame)
    right = (counts >= 0) & (counts == np.floor(counts)) & np.isfinite(counts)
    for expected, found in _others(counts, right, "whole numbers of votes, 0 or more"):
        yield Finding("error", "counts", file, expected, found)
    if without_vote := int(np.count_nonzero((labels != 0) & ~(counts > 0))):
        yield Finding(
            "error",
            "counts",
            file,
            "a vote in each voxel with a label",
            f"{without_vote} voxels with a label but no vote",
            "make the grid again: labels and counts are from different frames or runs",
        )
    if not (counts > 0).any():
        yield Finding("warning", "counts", file, "known voxels", "no vote in the whole grid")


def check_evidence(
    sequence: Sequence, grid: str, frame: int, arrays: Arrays, classes: ClassTable | None
) -> Iterator[Finding]:
    """Check the values of the fields of evidence and actors of a grid.

    Args:
        sequence: the sequence.
        grid: name of the grid.
        frame: number of the frame.
        arrays: the fields of the frame that could be read, by name.
        classes: class table of the grid; None if it is not known.
    """
    labels = arrays.get(f"{grid}/labels")
    for part in (*layout.EVIDENCE_FIELDS, *layout.ACTOR_FIELDS):
        if (array := arrays.get(f"{grid}/{part}")) is None:
            continue
        is_evidence = part in layout.EVIDENCE_FIELDS
        check, kept = ("evidence", "evidence") if is_evidence else (part, "actors")
        mistakes = list(_mistakes(part, array, sequence.grids[grid].num_voxels, classes))
        lost = part == "instance" and labels is not None and ((labels == 0) & (array > 0)).sum()
        if lost:
            mistakes.append(("actors in occupied voxels", f"{lost} others"))
        for expected, found in mistakes:
            where = _file(sequence, f"{grid}/{part}", frame)
            advice = f"make the grid again with `carlasc regrid --keep-{kept}`"
            yield Finding("error", check, where, expected, found, advice)


def _mistakes(
    part: str, array: AnyArray, num_voxels: int, classes: ClassTable | None
) -> Iterator[tuple[str, str]]:
    """Yield what was expected and what was found, for each kind of mistake."""
    if part == "occupied":
        yield from _others(array, (array >= 0) & (array <= 1), "probabilities of 0 to 1")
    elif part == "flags":
        most = sum(VoxelFlag)
        yield from _others(array, array <= most, f"flags of 0 to {most}")
    elif part == "velocity":
        voxels = array["voxel"].astype(np.int64)
        finite = np.isfinite(array["velocity"]).all(axis=1)
        inside = (voxels >= 0) & (voxels < num_voxels)
        if not (inside.all() and (np.diff(voxels) > 0).all()):
            yield f"rising voxels from 0 to {num_voxels - 1}", "others"
        if not finite.all():
            yield "finite velocities", f"NaN or infinity in {np.count_nonzero(~finite)} voxels"
    elif part == "classes":
        inside = (array["voxel"] >= 0) & (array["voxel"] < num_voxels)
        yield from _others(array["voxel"], inside, f"voxels 0 to {num_voxels - 1}", "rows")
        if classes is not None:
            named = np.isin(array["label"], sorted(set(classes.names) - {0}))
            expected = f"class ids of {classes.name} other than 0"
            yield from _others(array["label"], named, expected, "rows")
        voxels, place = np.unique(array["voxel"][inside], return_inverse=True)
        sums = np.bincount(place, array["votes"][inside], len(voxels))
        rows = np.bincount(place)
        # Each probability is rounded.
        if len(large := np.flatnonzero(sums > layout.CERTAIN + 0.5 * rows)):
            found = f"{sums[large[0]]:.0f} in voxel {voxels[large[0]]}"
            others = f"{found}, and {len(large) - 1} other such voxels"
            yield f"probabilities that add up to at most {layout.CERTAIN} per voxel", others


def _others(
    values: AnyArray, right: AnyArray, expected: str, kind: str = "values"
) -> Iterator[tuple[str, str]]:
    """Yield what was expected, and the values that are not right if there are any; NaN is never
    right.
    """
    wrong = values[~right]
    if wrong.size:
        first = format(wrong[0], "g" if wrong.dtype.kind == "f" else "d")
        yield expected, f"{first}, and {wrong.size - 1} other such {kind}"


def _check_classes(labels: AnyIntArray, classes: ClassTable, where: str) -> Iterator[Finding]:
    if unknown := [f"{i} ({n} times)" for i, n in classes.unknown(labels).items()]:
        found = ", ".join(unknown[:5]) + (" and more" if len(unknown) > 5 else "")
        advice = f"correct the file, or the classes in {layout.METADATA}"
        yield Finding("error", "class-ids", where, f"class ids of {classes.name}", found, advice)


def _first_of(frames: set[int]) -> str:
    return first_names([f"{frame:06d}" for frame in sorted(frames)], 3)


def _fields(sequence: Sequence, frame: int) -> list[str]:
    """Return the fields that a frame has."""
    return [name for name in sequence.fields() if frame in sequence.frames(name)]


def _file(sequence: Sequence, field: str, frame: int) -> str:
    return f"{sequence.location}/{layout.field_named(field).file(frame)}"
