"""Submissions to SemanticKITTI's benchmark: a folder of predictions is checked as by
`validate_submission.py`, and packed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from carlasc.errors import ArgumentError, FormatError, MissingDataError, first_names
from carlasc.storage.files import make_folder, rename, sync_tree, unfinished, writing

Task = Literal["completion", "segmentation"]
SEQUENCES = range(11, 22)
"""The sequences that the benchmark scores."""
# the input of each prediction, in the data set
_INPUTS = {
    "completion": "voxels",
    "segmentation": "velodyne",
}
# of the inputs: voxels in a byte, and the size of a point
_BITS = 8
_BYTES_PER_POINT = 16
_DESCRIPTION = "description.txt"  # may lie beside sequences/


def check_submission(root: Path, dataset: Path, task: Task, ids: Collection[int]) -> list[Path]:
    """Check the predictions of the test sequences, `root/sequences/NN/predictions/000000.label`.

    Args:
        root: folder that holds `sequences/` with the predictions.
        dataset: the benchmark's data: `sequences/NN/voxels/000000.bin` for completion,
            `sequences/NN/velodyne/000000.bin` for segmentation.
        task: "completion", uint16 per voxel, or "segmentation", uint32 per point with the class in
            the lower half.
        ids: the class ids that the benchmark's evaluator accepts.

    Returns:
        The paths of the files of the submission, relative to `root`, sorted.

    Raises:
        MissingDataError: a sequence or a file is missing, in `root` or in `dataset`.
        FormatError: the size of a file does not match its input, an id is not a class, or a file is
            not needed.
    """
    wanted: list[Path] = []
    for number in SEQUENCES:
        inputs = dataset / f"sequences/{number}/{_INPUTS[task]}"
        folder = Path(f"sequences/{number}/predictions")
        scans = {path.stem: path for path in sorted(inputs.glob("*.bin"))}
        if not scans:
            raise MissingDataError(
                inputs, expected="the inputs of a test sequence, 000000.bin and so on", found="none"
            )
        if not (root / folder).is_dir():
            raise MissingDataError(
                root / folder,
                expected=f"a prediction for each of {len(scans)} inputs",
                found="none",
            )
        names = {path.name for path in (root / folder).iterdir()}
        if missing := [f"{stem}.label" for stem in scans if f"{stem}.label" not in names]:
            there = len(scans) - len(missing)
            found = f"{there}, without {first_names(missing, 3)}"
            raise MissingDataError(
                root / folder, expected=f"{len(scans)} files of predictions", found=found
            )
        if task == "completion" and (more := sorted(names - {f"{stem}.label" for stem in scans})):
            found = f"{len(more)} more: {first_names(more, 3)}"
            raise FormatError(
                root / folder, expected=f"no more than {len(scans)} files", found=found
            )
        for stem, scan in scans.items():
            wanted.append(folder / f"{stem}.label")
            _check_file(root / wanted[-1], scan, task, ids)
    others = sorted(
        path.name for path in (root / "sequences").iterdir() if path.name not in map(str, SEQUENCES)
    )
    if task == "completion" and others:
        found = f"also {first_names(others, 3)}"
        raise FormatError(root / "sequences", expected="the sequences 11 to 21", found=found)
    return wanted


def _check_file(path: Path, scan: Path, task: Task, ids: Collection[int]) -> None:
    """Check the size of a file of predictions against its input, and its ids."""
    size = scan.stat().st_size
    actual = path.stat().st_size
    number, width = (size * _BITS, 2) if task == "completion" else (size // _BYTES_PER_POINT, 4)
    what = "voxels" if task == "completion" else "points"
    if actual != number * width:
        expected = f"{number * width} bytes: {number} {what}, {width} bytes each"
        raise FormatError(path, expected=expected, found=f"{actual} bytes")
    labels = np.fromfile(path, f"<u{width}") & 0xFFFF
    counts = np.bincount(labels, minlength=max(ids) + 1)
    bad = [label for label in np.flatnonzero(counts).tolist() if label not in ids]
    if bad:
        raise FormatError(
            path,
            expected=f"class ids that the evaluator takes, {', '.join(map(str, sorted(ids)))}",
            found=f"{bad[0]} ({counts[bad[0]]} times)",
            advice="`carlasc export kitti --predictions` writes only these",
        )


def pack_submission(root: Path, files: Iterable[Path], archive: Path) -> None:
    """Write files of `root` to a zip with entries for their folders, as the benchmark requires.

    The zip is complete or does not exist.

    Raises:
        ArgumentError: its name does not end in .zip.
        StorageError: it cannot be written.
    """
    check_archive(archive)
    files = [*files, *(Path(_DESCRIPTION) for _ in range((root / _DESCRIPTION).is_file()))]
    part = unfinished(archive)
    folders: Mapping[str, None] = dict.fromkeys(
        f"{parent.as_posix()}/"
        for file in files
        for parent in reversed(file.parents)
        if parent != Path()
    )
    with writing(archive):
        make_folder(archive.parent)
        try:
            with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as packed:
                for folder in folders:
                    packed.writestr(folder, b"")
                for file in files:
                    packed.write(root / file, file.as_posix())
            sync_tree(part)
            rename(part, archive)
        finally:
            part.unlink(missing_ok=True)


def check_archive(archive: Path) -> None:
    """Check the name of an archive.

    Raises:
        ArgumentError: it does not end in .zip, which the benchmark requires.
    """
    if archive.suffix != ".zip":
        raise ArgumentError("zip", expected="a name that ends in .zip", found=repr(str(archive)))
