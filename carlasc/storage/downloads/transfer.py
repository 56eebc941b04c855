"""Fetching one file: in blocks, over several connections, continuing where an earlier run stopped.

Bytes are written to `<name>.part`, and the list of the blocks in it to `<name>.part.json`. The file gets its name when it is whole.
"""

from __future__ import annotations

import math
import os
import threading
import zipfile
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeVar

from carlasc.errors import ArgumentError, CarlascError, FormatError
from carlasc.running.interrupts import postponed_interrupts
from carlasc.storage.downloads.http import (
    ChangedError,
    InterruptionError,
    RangeIgnoredError,
    RemoteFile,
    probe,
    read_range,
    read_whole,
)
from carlasc.storage.durability import remove_file, rename, sync_file
from carlasc.storage.files import parse_json, storage_error, write_json, writing

_T = TypeVar("_T")

_BLOCK = 16 << 20
_PIECE = 256 << 10
_TRIES = 6  # in succession without a byte of progress
_RESTARTS = 3  # after the file has changed
_WAIT_S = 0.5  # before the second try; then twice as long each time


@dataclass(frozen=True)
class TransferSettings:
    """How files are fetched; the defaults suit files of gigabytes.

    Attributes:
        connections: number of blocks that are fetched at once.
        block_bytes: bytes per block.
        wait_s: seconds before the second try of a request; they double from try to try.

    Raises:
        ArgumentError: a value below 1, or a negative time.
    """

    connections: int = 4
    block_bytes: int = _BLOCK
    wait_s: float = _WAIT_S

    def __post_init__(self) -> None:
        for name, least in (("connections", 1), ("block_bytes", 1), ("wait_s", 0)):
            if not getattr(self, name) >= least:
                raise ArgumentError(name, expected=f"{least} or more", found=str(getattr(self, name)))


@dataclass
class _State:
    """Which bytes of a file are in the .part file: for each block, how many from its start."""

    file: RemoteFile
    block: int
    got: dict[int, int] = field(default_factory=dict)

    @property
    def total(self) -> int:
        return sum(self.got.values())

    def stop(self, index: int) -> int:
        """Return the end of a block in the file."""
        return min((index + 1) * self.block, self.file.size or 0)

    @property
    def open_blocks(self) -> list[int]:
        """The blocks that are not complete."""
        count = -(-(self.file.size or 0) // self.block)
        return [i for i in range(count) if i * self.block + self.got.get(i, 0) < self.stop(i)]


def find_file(url: str, settings: TransferSettings) -> RemoteFile:
    """Ask the server for a file, several times if necessary.

    Raises:
        CarlascError: the server cannot be reached, or the file does not exist or is not a zip.
    """
    return _persistently(lambda: probe(url), url, settings, threading.Event())


def remaining_bytes(file: RemoteFile, path: Path, settings: TransferSettings) -> int:
    """Return how many bytes are left to fetch after an earlier run."""
    return (file.size or 0) - _load(file, path, settings).total


def transfer(
    file: RemoteFile,
    path: Path,
    settings: TransferSettings,
    advance: Callable[[int], None],
    most: float = math.inf,
) -> int:
    """Fetch a file to `path`, continuing what an earlier run has left.

    Args:
        file: the file, from `find_file`.
        path: where it is written; it exists only when it is whole.
        settings: connections, blocks.
        advance: called with the number of bytes that arrived, from one thread at a time; negative where bytes are discarded.
        most: bytes that the file may have, where the server does not say how many there are.

    Returns:
        The number of bytes that an earlier run had fetched.

    Raises:
        CarlascError: the server cannot be reached, or the file keeps changing. What was fetched stays for the next run.
        StorageError: the disk is full or fails.
    """
    resumed = 0
    for _ in range(_RESTARTS):
        state = _load(file, path, settings)
        resumed = state.total
        advance(resumed)
        try:
            if file.ranges and file.size:
                _fetch_blocks(state, path, settings, advance)
            else:
                _fetch_stream(state, path, settings, advance, most)
            _finish(state, path)
            return resumed
        except OSError as error:
            raise storage_error(path, error) from error
        except ChangedError:
            advance(-state.total)
            _discard(path)
            file = find_file(file.url, settings)
        except RangeIgnoredError:  # the server had announced range requests
            advance(-state.total)
            _discard(path)
            file = RemoteFile(file.url, file.size, file.validator, ranges=False)
    raise FormatError(
        file.url, expected="a file that stays the same", found=f"a changed one at each of {_RESTARTS} tries"
    )


def _fetch_blocks(state: _State, path: Path, settings: TransferSettings, advance: Callable[[int], None]) -> None:
    stop, lock = threading.Event(), threading.Lock()
    descriptor = os.open(_part(path), os.O_RDWR | os.O_CREAT, 0o666)
    executor = ThreadPoolExecutor(settings.connections, thread_name_prefix="download")
    try:
        os.ftruncate(descriptor, state.file.size or 0)

        def fetch(index: int) -> None:
            def one_try() -> None:
                start = index * state.block + state.got.get(index, 0)
                for data in read_range(state.file, start, state.stop(index), _PIECE):
                    _write_at(descriptor, data, start)
                    start += len(data)
                    with lock:
                        state.got[index] = state.got.get(index, 0) + len(data)
                        advance(len(data))
                    if stop.is_set():
                        return

            _persistently(one_try, state.file.url, settings, stop, lambda: state.got.get(index, 0))
            with lock:
                _save(state, path, descriptor)

        with postponed_interrupts():
            futures = [executor.submit(fetch, index) for index in state.open_blocks]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
    finally:
        stop.set()  # after Ctrl-C or a failed block, the others stop at their next piece; their bytes count
        executor.shutdown(wait=True, cancel_futures=True)
        try:
            _save(state, path, descriptor)
        finally:
            os.close(descriptor)


def _fetch_stream(
    state: _State, path: Path, settings: TransferSettings, advance: Callable[[int], None], most: float
) -> None:
    """Fetch from a server without range requests: each try begins again at the start."""

    def one_try() -> None:
        advance(-state.total)
        state.got.clear()
        with _part(path).open("wb") as file:
            for data in read_whole(state.file, _PIECE):
                file.write(data)
                state.got[0] = state.got.get(0, 0) + len(data)
                advance(len(data))
                if state.total > most:
                    raise FormatError(state.file.url, expected=f"at most {most:.0f} bytes", found="more")

    _persistently(one_try, state.file.url, settings, threading.Event())


def _persistently(
    work: Callable[[], _T],
    url: str,
    settings: TransferSettings,
    stop: threading.Event,
    measure: Callable[[], int] = lambda: 0,
) -> _T:
    """Call `work`, again after an interruption; give up after several tries without progress."""
    tries, before = 0, measure()
    while True:
        try:
            return work()
        except InterruptionError as error:
            tries = 1 if measure() > before else tries + 1
            before = measure()
            if tries >= _TRIES:
                raise CarlascError(
                    url,
                    expected="data",
                    found=f"none at {tries} tries ({error})",
                    advice="run the same command again to continue",
                ) from error
            if stop.wait(settings.wait_s * 2 ** (tries - 1)):
                raise CarlascError(url, problem="stopped") from error


def _load(file: RemoteFile, path: Path, settings: TransferSettings) -> _State:
    """Return what an earlier run has fetched of the same file, or nothing if the file has changed."""
    fresh = _State(file, settings.block_bytes)
    part, record = _part(path), _record(path)
    if not (part.is_file() and record.is_file() and file.ranges):
        return fresh
    try:
        values = parse_json(record.read_bytes(), str(record))
        state = _State(file, int(values["block"]), {int(k): int(v) for k, v in values["got"].items()})
        same = (values["url"], values["size"], values["validator"]) == (file.url, file.size, file.validator)
    except (FormatError, KeyError, TypeError, ValueError, AttributeError):
        return fresh
    # Without a validator, an equal size does not prove that it is the same file.
    return state if same and file.validator is not None and part.stat().st_size == file.size else fresh


def _save(state: _State, path: Path, descriptor: int) -> None:
    """Record which bytes were fetched, after they have reached the disk."""
    sync_file(descriptor)
    file = state.file
    got = {str(index): count for index, count in sorted(state.got.items())}
    write_json(
        _record(path),
        {"url": file.url, "size": file.size, "validator": file.validator, "block": state.block, "got": got},
    )


def _finish(state: _State, path: Path) -> None:
    """Give the file its name if it is whole."""
    size, expected = _part(path).stat().st_size, state.file.size
    if expected is not None and (state.total != expected or size != expected):
        raise FormatError(
            path, expected=f"{expected} bytes", found=str(min(size, state.total)), advice="run the same command again"
        )
    with _part(path).open("rb") as file:
        _check_zip(file, path)
        sync_file(file.fileno())
    rename(_part(path), path)
    discard_record(path)


def discard_record(path: Path) -> None:
    """Remove what is recorded of the transfer of a file that is whole.

    Raises:
        StorageError: it cannot be removed.
    """
    with writing(_record(path)):
        remove_file(_record(path))


def _check_zip(file: BinaryIO, path: Path) -> None:
    """Check for the central directory at a zip's end, which a truncated one lacks."""
    if not zipfile.is_zipfile(file):
        raise FormatError(
            path, expected="a whole zip", found="a truncated one", advice=f"remove {_part(path).name} and run again"
        )


def _write_at(descriptor: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _discard(path: Path) -> None:
    _part(path).unlink(missing_ok=True)
    _record(path).unlink(missing_ok=True)


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _record(path: Path) -> Path:
    return path.with_name(f"{path.name}.part.json")
