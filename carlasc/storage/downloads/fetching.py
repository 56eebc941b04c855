"""`download`: fetches the published zips and, if asked to, extracts them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

from carlasc.errors import ArgumentError, ConflictError, FormatError
from carlasc.storage.downloads.archives import SEQUENCES, Archive, choose_archives
from carlasc.storage.downloads.extraction import check_space, extract_zip, extracted_size
from carlasc.storage.downloads.http import RemoteFile
from carlasc.storage.downloads.transfer import TransferSettings, discard_record, find_file, remaining_bytes, transfer
from carlasc.storage.durability import make_folder, remove_file
from carlasc.storage.files import parse_json, remove_stale, write_json, writing

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Downloaded:
    """What `download` did with one zip.

    Attributes:
        name: its file name.
        path: where the zip is; None if it was extracted and removed.
        size: its bytes; None if the server does not say.
        fetched: bytes that were fetched in this run.
        folder: where it was extracted to; None if it was not.
        files: number of files that it was extracted to.
    """

    name: str
    path: str | None
    size: int | None
    fetched: int
    folder: str | None = None
    files: int = 0


@dataclass(frozen=True)
class DownloadResult:
    """What `download` did.

    Attributes:
        archives: the zips.
        elapsed_s: seconds that it took.
    """

    archives: tuple[Downloaded, ...]
    elapsed_s: float


def download(
    out: str | os.PathLike[str],
    *,
    split: str | Sequence[str] = (),
    what: str = SEQUENCES,
    extract: bool = False,
    keep: bool = False,
    base_url: str | None = None,
    settings: TransferSettings | None = None,
    progress: Progress | None = None,
) -> DownloadResult:
    """Fetch the published zips of one or more splits, or of the other grids. Called again, it continues where it stopped.

    A zip need not be extracted: `carlasc.open` reads it in place.

    Args:
        out: folder that the zips are written to.
        split: "train" (two zips), "val", "test", "all", or several of them; none for grids, whose zips hold all splits.
        what: "sequences" (scans, poses, coarse grids), or only "fine" or "cylindrical" grids.
        extract: extract each zip into `out` (grids into a folder of their own there), then remove it.
        keep: with `extract`, keep the zip too.
        base_url: fetch from `<base_url>/<name>`, a mirror.
        settings: number of connections, size of blocks, waiting times.
        progress: called with the bytes done and their total, zip by zip: first those fetched, then those extracted.

    Returns:
        What was fetched, and where it is.

    Raises:
        ArgumentError: `split`, `what` or `keep` make no sense.
        MissingDataError: the server does not have the file.
        ConflictError: another file has the name of a zip.
        FormatError: what the server sends is not a zip, or keeps changing.
        StorageError: there is not enough free space.
        CarlascError: the server cannot be reached; what was fetched stays, and the next call continues with it.
    """
    began = time.perf_counter()
    settings = settings or TransferSettings()
    if keep and not extract:
        raise ArgumentError("keep", expected="`extract=True` with it", found="it alone", advice="zips are kept anyway")
    archives = choose_archives([split] if isinstance(split, str) else split, what)
    folder = Path(out)
    with writing(folder):
        make_folder(folder)
        remove_stale(folder)
    done = {archive: _extracted_before(folder, archive) for archive in archives if extract}
    pending = [archive for archive in archives if done.get(archive) is None]
    files = {archive: find_file(_url(archive, base_url), settings) for archive in pending}
    _check_space(folder, files, extract, settings)
    results = []
    for archive in archives:
        before = done.get(archive)
        if before is not None:
            if not keep:
                _remove_left(folder / archive.name, before.size)
            results.append(before)
            continue
        fetched = _fetch(folder / archive.name, files[archive], settings, progress, 2e9 * archive.gigabytes)
        result = Downloaded(archive.name, str(folder / archive.name), files[archive].size, fetched)
        results.append(_extract(result, folder, archive, keep, progress) if extract else result)
    return DownloadResult(tuple(results), time.perf_counter() - began)


def _fetch(path: Path, file: RemoteFile, settings: TransferSettings, progress: Progress | None, most: float) -> int:
    """Fetch a zip of at most `most` bytes unless it exists; returns the number of bytes fetched."""
    if path.exists():
        if file.size is not None and path.stat().st_size != file.size:
            raise ConflictError(
                path,
                expected=f"nothing, or the zip of {file.size} bytes",
                found=f"{path.stat().st_size} bytes",
                advice="move it away, or choose another folder",
            )
        discard_record(path)  # of a run that was ended before it could
        return 0
    count = 0

    def advance(number: int) -> None:
        nonlocal count
        count += number
        if progress is not None:
            progress(count, file.size or count)

    resumed = transfer(file, path, settings, advance, most)
    return path.stat().st_size - resumed


def _extract(result: Downloaded, folder: Path, archive: Archive, keep: bool, progress: Progress | None) -> Downloaded:
    path, target = folder / archive.name, folder / archive.folder
    total, count = extracted_size(path), 0

    def advance(number: int) -> None:
        nonlocal count
        count += number
        if progress is not None:
            progress(count, total)

    files = extract_zip(path, target, advance)
    if not keep:  # record that it was extracted: the next run would fetch it again
        write_json(_record(folder, archive), {"size": path.stat().st_size, "files": files})
        with writing(path):
            remove_file(path)
    kept = str(path) if keep else None
    return Downloaded(result.name, kept, result.size, result.fetched, str(target), files)


def _remove_left(path: Path, size: int | None) -> None:
    """Remove a zip that was extracted, if the run that did so was ended before it could."""
    if path.is_file() and path.stat().st_size == size:
        with writing(path):
            remove_file(path)


def _extracted_before(folder: Path, archive: Archive) -> Downloaded | None:
    record = _record(folder, archive)
    if not record.is_file():
        return None
    try:
        values = parse_json(record.read_bytes(), str(record))
    except FormatError:
        return None  # what a power failure can leave: the zip is fetched again
    size, files = values.get("size"), values.get("files")
    if not (_is_count(size) and _is_count(files)):
        found = f"{size!r} and {files!r}"
        raise FormatError(record, expected="whole numbers as size and files", found=found, advice="remove it")
    return Downloaded(archive.name, None, size, 0, str(folder / archive.folder), files)


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _record(folder: Path, archive: Archive) -> Path:
    return folder / f"{archive.name}.unpacked.json"


def _check_space(folder: Path, files: dict[Archive, RemoteFile], extract: bool, settings: TransferSettings) -> None:
    """Check the free space for all bytes to fetch; the extracted files of a zip take about as much again."""
    needed = 0
    for archive, file in files.items():
        path = folder / archive.name
        needed += 0 if path.exists() else remaining_bytes(file, path, settings)
        needed += (file.size or 0) if extract else 0
    check_space(folder, needed, "for the zips and the files in them" if extract else "for the zips")


def _url(archive: Archive, base_url: str | None) -> str:
    return archive.url if base_url is None else f"{base_url.rstrip('/')}/{archive.name}"
