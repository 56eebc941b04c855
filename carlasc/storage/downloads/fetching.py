"""`download`: the published zips, fetched and, if wanted, unpacked."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc.errors import ArgumentError, ConflictError
from carlasc.storage.downloads.archives import SEQUENCES, Archive, choose_archives
from carlasc.storage.downloads.extraction import check_space, extract, unpacked_size
from carlasc.storage.downloads.http import RemoteFile
from carlasc.storage.downloads.transfer import Settings, find_file, remaining_bytes, transfer
from carlasc.storage.files import parse_json, write_json

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Downloaded:
    """What became of one zip.

    Attributes:
        name: its file name.
        path: where the zip is; None where it was unpacked and removed.
        size: its bytes; None where that was no longer needed to know.
        fetched: bytes that came in this run.
        folder: where it was unpacked to; None where it was not.
        files: number of files unpacked.
    """

    name: str
    path: str | None
    size: int | None
    fetched: int
    folder: str | None = None
    files: int = 0


@dataclass(frozen=True)
class DownloadResult:
    """What `download` did, zip by zip."""

    archives: tuple[Downloaded, ...]


def download(
    to: str | os.PathLike[str],
    *,
    split: str | Sequence[str] = (),
    what: str = SEQUENCES,
    unpack: bool = False,
    keep: bool = False,
    base_url: str | None = None,
    settings: Settings | None = None,
    progress: Progress | None = None,
) -> DownloadResult:
    """Fetch the published zips of a split, or of the other grids. Run again, it goes on where it stopped.

    A zip need not be unpacked: `carlasc.open` reads it in place.

    Args:
        to: folder that they go to.
        split: "train" (two zips), "val", "test", "all", or several of them; none for grids, whose zips hold all splits.
        what: "sequences" (scans, poses, coarse grids), or only "fine" or "cylindrical" grids.
        unpack: unpack each zip into `to` (the grids into a folder of their own there), then remove it.
        keep: keep a zip that has been unpacked.
        base_url: fetch from `<base_url>/<name>` (a mirror) instead.
        settings: connections, size of blocks, patience.
        progress: called with bytes done and their total, zip by zip: first fetched, then unpacked.

    Raises:
        ArgumentError: an unknown split or kind.
        MissingDataError: a file is not where the table says.
        ConflictError: another file is in its place.
        CarlascError: no room, no connection; what came stays, and the next run goes on with it.
    """
    settings = settings or Settings()
    if settings.connections < 1:
        raise ArgumentError("connections", expected="1 or more", found=f"{settings.connections}")
    archives = choose_archives([split] if isinstance(split, str) else split, what)
    folder = Path(to)
    folder.mkdir(parents=True, exist_ok=True)
    done = {archive: _unpacked_before(folder, archive) for archive in archives if unpack}
    pending = [archive for archive in archives if done.get(archive) is None]
    files = {archive: find_file(_url(archive, base_url), settings) for archive in pending}
    _check_room(folder, files, unpack, settings)
    results = []
    for archive in archives:
        before = done.get(archive)
        if before is not None:
            results.append(before)
            continue
        fetched = _fetch(folder / archive.name, files[archive], settings, progress)
        result = Downloaded(archive.name, str(folder / archive.name), files[archive].size, fetched)
        results.append(_unpack(result, folder, archive, keep, progress) if unpack else result)
    return DownloadResult(tuple(results))


def _fetch(path: Path, file: RemoteFile, settings: Settings, progress: Progress | None) -> int:
    """Fetch a zip unless it is there; returns the bytes that came."""
    if path.exists():
        if file.size is not None and path.stat().st_size != file.size:
            raise ConflictError(
                path,
                expected=f"nothing or the zip of {file.size} bytes",
                found=f"{path.stat().st_size}",
                advice="move it away, or choose another folder",
            )
        return 0
    count = 0

    def advance(number: int) -> None:
        nonlocal count
        count += number
        if progress is not None:
            progress(count, file.size or count)

    resumed = transfer(file, path, settings, advance)
    return path.stat().st_size - resumed


def _unpack(result: Downloaded, folder: Path, archive: Archive, keep: bool, progress: Progress | None) -> Downloaded:
    path, target = folder / archive.name, folder / archive.folder
    total, count = unpacked_size(path), 0

    def advance(number: int) -> None:
        nonlocal count
        count += number
        if progress is not None:
            progress(count, total)

    files = extract(path, target, advance)
    if not keep:  # leave a word that it was here: the next run would fetch it again
        write_json(_mark(folder, archive), {"size": path.stat().st_size, "files": files})
        path.unlink()
    kept = str(path) if keep else None
    return Downloaded(result.name, kept, result.size, result.fetched, str(target), files)


def _unpacked_before(folder: Path, archive: Archive) -> Downloaded | None:
    mark = _mark(folder, archive)
    if not mark.is_file():
        return None
    values = parse_json(mark.read_bytes(), str(mark))
    size, files = values.get("size"), values.get("files")
    return Downloaded(archive.name, None, size, 0, str(folder / archive.folder), int(files or 0))


def _mark(folder: Path, archive: Archive) -> Path:
    return folder / f"{archive.name}.unpacked.json"


def _check_room(folder: Path, files: dict[Archive, RemoteFile], unpack: bool, settings: Settings) -> None:
    """Check for room for all that is still to come; unpacked, a zip's files take about as much again."""
    needed = 0
    for archive, file in files.items():
        path = folder / archive.name
        needed += 0 if path.exists() else remaining_bytes(file, path, settings)
        needed += (file.size or 0) if unpack else 0
    check_space(folder, needed, "for the zips and what is in them" if unpack else "for the zips")


def _url(archive: Archive, base_url: str | None) -> str:
    return archive.url if base_url is None else f"{base_url.rstrip('/')}/{archive.name}"
