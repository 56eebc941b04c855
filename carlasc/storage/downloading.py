"""`download`: fetches the published zips and optionally extracts them.

`ARCHIVES` is the table of the published zips (see the format page, `docs/format.md#layout`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc.errors import ArgumentError, ConflictError, FormatError, check_choice, check_types
from carlasc.running.spreading import Progress, StepCounter
from carlasc.storage.extraction import check_space, extract_zip, extracted_size
from carlasc.storage.files import (
    AnyPath,
    make_folder,
    parse_json,
    remove_file,
    remove_stale,
    write_json,
    writing,
)
from carlasc.storage.transport.fetching import FileFetch

_S3 = "https://curly-dataset-public.s3.us-east-2.amazonaws.com/CARLA"
SEQUENCES = "sequences"


@dataclass(frozen=True)
class Archive:
    """One published zip.

    Attributes:
        name: file name.
        what: "sequences" (scans, poses, coarse Cartesian grids), or grids alone: "fine",
            "cylindrical".
        split: "train", "val", "test"; None if it holds all splits.
        url: its URL.
        gigabytes: approximate size, GB.
    """

    name: str
    what: str
    split: str | None
    url: str
    gigabytes: float

    @property
    def folder(self) -> str:
        """Folder that it is extracted to, relative to the folder that the user chose.

        Zips of grids are extracted to separate folders, because their grids have the same names as
        the coarse grids of the sequences.
        """
        return "." if self.what == SEQUENCES else self.name.removesuffix(".zip")


ARCHIVES = (
    Archive("train_cartesian_13.zip", SEQUENCES, "train", f"{_S3}/train_cartesian_13.zip", 40.3),
    Archive("train_cartesian_46.zip", SEQUENCES, "train", f"{_S3}/train_cartesian_46.zip", 39.7),
    Archive("val_cartesian.zip", SEQUENCES, "val", f"{_S3}/val_cartesian.zip", 14.9),
    Archive("test_cartesian.zip", SEQUENCES, "test", f"{_S3}/test_cartesian.zip", 14.6),
    Archive("eval_fine.zip", "fine", None, f"{_S3}/eval_fine.zip", 4.3),
    Archive(
        "eval_cylindrical.zip",
        "cylindrical",
        None,
        "https://www.dropbox.com/s/eb074zjfilri1ka/eval_cylindrical.zip?dl=1",
        3.8,
    ),
)


def choose_archives(splits: Iterable[str], what: str) -> tuple[Archive, ...]:
    """Return the zips of some splits, or the zip of some grids.

    Args:
        splits: "train", "val", "test" or "all", upper or lower case. Empty for grids, because their
            zips hold all splits.
        what: "sequences", "fine" or "cylindrical".

    Raises:
        ArgumentError: `splits` or `what` is unknown, or a split is given for grids.
    """
    kinds = tuple(dict.fromkeys(archive.what for archive in ARCHIVES))
    check_choice("what", what, kinds)
    known = tuple(dict.fromkeys(archive.split for archive in ARCHIVES if archive.split))
    wanted = {split.lower() for split in splits}
    unknown = wanted - {*known, "all"}
    if unknown or (what == SEQUENCES and not wanted):
        found = ", ".join(sorted(unknown)) or "none"
        raise ArgumentError("split", expected=f"one of {', '.join(known)}, all", found=found)
    if what != SEQUENCES and wanted - {"all"}:
        raise ArgumentError(
            "split",
            expected=f"no split for {what} grids",
            found=", ".join(sorted(wanted)),
            advice="leave `split` out: one zip holds the grids of all splits",
        )
    chosen = {None, *known} if "all" in wanted else {None, *wanted}
    return tuple(a for a in ARCHIVES if a.what == what and a.split in chosen)


@dataclass(frozen=True)
class Downloaded:
    """Result of `download` for one zip.

    Attributes:
        name: file name.
        path: path of the zip; None if it was extracted and removed.
        size: size in bytes; None if the server does not report it.
        fetched: bytes that were fetched in this run.
        folder: folder that it was extracted to; None if it was not extracted.
        files: number of extracted files.
    """

    name: str
    path: str | None
    size: int | None
    fetched: int
    folder: str | None = None
    files: int = 0


@dataclass(frozen=True)
class DownloadResult:
    """Result of `download`.

    Attributes:
        archives: result for each zip.
        elapsed_s: duration, seconds.
    """

    archives: tuple[Downloaded, ...]
    elapsed_s: float


def download(
    out: AnyPath,
    *,
    split: str | Sequence[str] = (),
    what: str = SEQUENCES,
    extract: bool = False,
    keep: bool = False,
    base_url: str | None = None,
    connections: int = 4,
    progress: Progress | None = None,
) -> DownloadResult:
    """Fetch the published zips of one or more splits, or of the other grids.

    The same call continues after an interruption.

    A zip need not be extracted: `carlasc.open` reads it in place.

    Args:
        out: folder that the zips are written to.
        split: "train" (two zips), "val", "test" or "all"; several may be given. Grids need none,
            because their zips hold all splits.
        what: what to download. "sequences": scans, poses and coarse grids. "fine", "cylindrical":
            only these grids, of all splits.
        extract: extract each zip into the folder (grids into a separate folder there), then remove
            it.
        keep: with `extract`: keep the zips too.
        base_url: URL of a mirror: zips are read from BASE_URL/NAME. None: the published URLs.
        connections: number of parallel connections, each of which fetches a block of a zip.
        progress: called with (bytes done, total bytes), for each zip first while fetching, then
            while extracting.

    Returns:
        Size and place of each zip.

    Raises:
        ArgumentError: `split`, `what`, `keep` or `connections` is not valid.
        MissingDataError: the server does not have the file.
        ConflictError: another file with the name of a zip exists.
        FormatError: the file on the server is not a zip, or keeps changing.
        StorageError: the disk has too little free space.
        CarlascError: the server cannot be reached. The next call continues with the bytes fetched
            so far.
    """
    check_types(download, locals())
    began = time.perf_counter()
    if connections < 1:
        raise ArgumentError("connections", expected="1 or more", found=connections)
    if keep and not extract:
        raise ArgumentError(
            "keep",
            expected="`extract=True` too",
            found="`keep=True` alone",
            advice="without extracting, zips are always kept",
        )
    archives = choose_archives([split] if isinstance(split, str) else split, what)
    folder = Path(out)
    with writing(folder):
        make_folder(folder)
        remove_stale(folder)
    done = {archive: _extracted_before(folder, archive) for archive in archives if extract}
    fetches = {}
    needed = 0
    for archive in archives:
        path = folder / archive.name
        before = done.get(archive)
        if before is None:
            url = archive.url if base_url is None else f"{base_url.rstrip('/')}/{archive.name}"
            fetch = fetches[archive] = FileFetch(url, path, connections)
            needed += 0 if path.exists() else fetch.remaining()
            # extracted files take about the same space
            needed += (fetch.file.size or 0) if extract else 0
        # a killed run can extract a zip and not remove it
        elif not keep and path.is_file() and path.stat().st_size == before.size:
            with writing(path):
                remove_file(path)
    check_space(folder, needed, "for the zips and the files in them" if extract else "for the zips")
    results = []
    for archive in archives:
        result = done.get(archive)
        if result is None:
            path = folder / archive.name
            fetch = fetches[archive]
            fetched = _fetch(path, fetch, progress, 2e9 * archive.gigabytes)
            result = Downloaded(archive.name, str(path), fetch.file.size, fetched)
            if extract:
                result = _extract(result, folder, archive, keep, progress)
        results.append(result)
    return DownloadResult(tuple(results), time.perf_counter() - began)


def _fetch(path: Path, fetch: FileFetch, progress: Progress | None, most: float) -> int:
    """Fetch a zip of at most `most` bytes unless it exists; return the number of new bytes."""
    size = fetch.file.size
    if path.exists():
        if size is not None and path.stat().st_size != size:
            raise ConflictError(
                path,
                expected=f"no file, or the zip of {size} bytes",
                found=f"a file of {path.stat().st_size} bytes",
                advice="move it away, or choose another folder",
            )
        fetch.discard_record()  # a killed run can leave it
        return 0
    count = 0

    def advance(number: int) -> None:
        nonlocal count
        count += number
        if progress is not None:
            progress(count, fetch.file.size or count)

    resumed = fetch.run(advance, most)
    return path.stat().st_size - resumed


def _extract(
    result: Downloaded, folder: Path, archive: Archive, keep: bool, progress: Progress | None
) -> Downloaded:
    path = folder / archive.name
    target = folder / archive.folder
    files = extract_zip(path, target, StepCounter(progress, extracted_size(path)))
    if not keep:  # record the extraction, otherwise the next run would fetch the zip again
        write_json(_record(folder, archive), {"size": path.stat().st_size, "files": files})
        with writing(path):
            remove_file(path)
    kept = str(path) if keep else None
    return Downloaded(result.name, kept, result.size, result.fetched, str(target), files)


def _extracted_before(folder: Path, archive: Archive) -> Downloaded | None:
    record = _record(folder, archive)
    if not record.is_file():
        return None
    try:
        values = parse_json(record.read_bytes(), str(record))
    except FormatError:
        return None  # a power failure can leave an empty file: the zip is fetched again
    size = values.get("size", -1)
    files = values.get("files", -1)
    if not all(type(count) is int and count >= 0 for count in (size, files)):
        found = f"{size!r} and {files!r}"
        raise FormatError(
            record, expected="integers as size and files", found=found, advice="remove it"
        )
    return Downloaded(archive.name, None, size, 0, str(folder / archive.folder), files)


def _record(folder: Path, archive: Archive) -> Path:
    return folder / f"{archive.name}.unpacked.json"
