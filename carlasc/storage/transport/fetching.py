"""Fetching one large file from a web server, in blocks over several connections.

An interrupted run can be continued.

Bytes are written to `<name>.part`, and the list of its blocks to `<name>.part.json`. The file gets
its final name when it is complete.
"""

from __future__ import annotations

import os
import re
import threading
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from carlasc.errors import (
    CarlascError,
    FormatError,
    MissingDataError,
    postponed_interrupts,
    without_credentials,
)
from carlasc.storage.files import (
    parse_json,
    remove_file,
    rename,
    storage_error,
    sync_file,
    write_at,
    write_json,
    writing,
)
from carlasc.storage.transport.failures import (
    WrongAnswerError,
    describe_failure,
    fail,
    is_temporary,
)
from carlasc.storage.transport.requests import persist
from carlasc.storage.transport.web import HttpAnswer, WebClient

_ZIP = b"PK"
_GONE = (401, 403, 404, 410)
_PARTIAL = 206
_BLOCK = 16 << 20  # bytes per request
_RESTARTS = 3  # after the file has changed

_Result = TypeVar("_Result")


class _ChangedError(Exception):
    """The file on the server has changed since the transfer began."""


class _RangeIgnoredError(Exception):
    """The server sent the whole file instead of the requested range."""


@dataclass(frozen=True)
class ServedFile:
    """Properties of a file on a server.

    Attributes:
        size: size in bytes; None if the server does not report it.
        validator: its ETag, otherwise its date, to detect changes; None if the server sends
            neither.
        ranges: whether the server supports range requests.
    """

    size: int | None
    validator: str | None
    ranges: bool


@dataclass
class _Arrived:
    """The number of fetched bytes of each block in the .part file, counted from the start of the
    block.
    """

    block: int
    got: dict[int, int] = field(default_factory=dict)

    @property
    def total(self) -> int:
        return sum(self.got.values())


class FileFetch:
    """The transfer of a zip to this machine.

    Attributes:
        file: properties of the file on the server.
    """

    def __init__(self, url: str, path: Path, connections: int) -> None:
        """Request the first bytes of the zip, several times if necessary.

        Args:
            url: URL of the zip.
            path: output path. The file exists only when it is complete.
            connections: number of blocks that are fetched at the same time.

        Raises:
            CarlascError: the server cannot be reached, or the file does not exist or is not a zip.
        """
        self._url, self._where, self._path, self._connections = (
            url,
            without_credentials(url),
            path,
            connections,
        )
        self._part, self._record = (
            path.with_name(f"{path.name}{end}") for end in (".part", ".part.json")
        )
        if not url.startswith(("http://", "https://")):
            raise CarlascError(
                self._where,
                expected="a URL that begins with http:// or https://",
                found="another URL",
            )
        self._client = WebClient(url, {})
        self.file = self._persist(self._probe)

    def remaining(self) -> int:
        """Return how many bytes are left to fetch after an earlier run."""
        return (self.file.size or 0) - self._load().total

    def run(self, advance: Callable[[int], None], most: float) -> int:
        """Fetch the file, continuing an earlier run.

        Args:
            advance: called with the number of new bytes, from one thread at a time; negative if
                bytes are discarded.
            most: maximum size in bytes, if the server does not report the size.

        Returns:
            The number of bytes that an earlier run had fetched.

        Raises:
            CarlascError: the server cannot be reached, or the file keeps changing. The next run
                continues with the fetched bytes.
            StorageError: the disk is full or fails.
        """
        for _ in range(_RESTARTS):
            arrived = self._load()
            resumed = arrived.total
            advance(resumed)
            try:
                if self.file.ranges and self.file.size:
                    self._fetch_blocks(arrived, self.file.size, advance)
                else:
                    self._fetch_stream(arrived, advance, most)
                self._finish(arrived)
                return resumed
            except OSError as error:
                raise storage_error(self._path, error) from error
            except (_ChangedError, _RangeIgnoredError) as error:
                advance(-arrived.total)
                self._part.unlink(missing_ok=True)
                self._record.unlink(missing_ok=True)
                # otherwise the server wrongly announced range requests
                changed = isinstance(error, _ChangedError)
                self.file = (
                    self._persist(self._probe) if changed else replace(self.file, ranges=False)
                )
        raise FormatError(
            self._where,
            expected="a file that does not change",
            found=f"a changed file in each of {_RESTARTS} attempts",
            advice="try again later",
        )

    def discard_record(self) -> None:
        """Remove the record of the transfer of a complete file.

        Raises:
            StorageError: the record cannot be removed.
        """
        with writing(self._record):
            remove_file(self._record)

    def _fetch_blocks(self, arrived: _Arrived, size: int, advance: Callable[[int], None]) -> None:
        stop, lock = threading.Event(), threading.Lock()
        descriptor = os.open(self._part, os.O_RDWR | os.O_CREAT, 0o666)
        executor = ThreadPoolExecutor(self._connections, thread_name_prefix="download")

        def fetch(index: int, end: int) -> None:
            def one_try() -> None:
                start = index * arrived.block + arrived.got.get(index, 0)
                for data in self._range(start, end):
                    write_at(descriptor, data, start)
                    start += len(data)
                    with lock:
                        arrived.got[index] = arrived.got.get(index, 0) + len(data)
                        advance(len(data))
                    if stop.is_set():
                        return

            self._persist(one_try, lambda: arrived.got.get(index, 0), stop)
            with lock:
                self._save(arrived, descriptor)

        try:
            os.ftruncate(descriptor, size)
            ends = [min(start + arrived.block, size) for start in range(0, size, arrived.block)]
            with postponed_interrupts():
                futures = [
                    executor.submit(fetch, index, end)
                    for index, end in enumerate(ends)
                    if index * arrived.block + arrived.got.get(index, 0) < end
                ]
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
        finally:
            # after Ctrl-C or a failed block, the other blocks stop at their next piece and keep
            # their bytes
            stop.set()
            executor.shutdown(wait=True, cancel_futures=True)
            try:
                self._save(arrived, descriptor)
            finally:
                os.close(descriptor)

    def _fetch_stream(self, arrived: _Arrived, advance: Callable[[int], None], most: float) -> None:
        """Fetch from a server without range requests. Each attempt starts at the first byte."""

        def one_try() -> None:
            advance(-arrived.total)
            arrived.got.clear()
            with self._answer({}) as answer, self._part.open("wb") as file:
                if (self.file.validator, self.file.size) != (_validator(answer), _length(answer)):
                    raise _ChangedError
                for data in _exactly(answer, self.file.size):
                    file.write(data)
                    arrived.got[0] = arrived.got.get(0, 0) + len(data)
                    advance(len(data))
                    if arrived.total > most:
                        raise FormatError(
                            self._where, expected=f"at most {most:.0f} bytes", found="more"
                        )

        self._persist(one_try)

    def _probe(self) -> ServedFile:
        """Request the first bytes, to find the size, whether ranges are supported, and whether it
        is a zip.
        """
        with self._answer({"Range": f"bytes=0-{len(_ZIP) - 1}"}) as answer:
            ranges, start = answer.status == _PARTIAL, answer.first[: len(_ZIP)]
            if start != _ZIP:
                content = answer.headers.get("Content-Type", "data of unknown type")
                raise FormatError(
                    self._where,
                    expected="a zip",
                    found=f"{content} that begins with {start!r}",
                    advice="check the URL: the file may have moved",
                )
            return ServedFile(
                _total(answer) if ranges else _length(answer), _validator(answer), ranges
            )

    def _range(self, start: int, end: int) -> Iterator[bytes]:
        """Yield the bytes [start, end) in pieces.

        Checks that all headers of the answer fit the request.
        """
        file, headers = self.file, {"Range": f"bytes={start}-{end - 1}"}
        if file.validator is not None and not file.validator.startswith("W/"):
            headers["If-Range"] = file.validator
        with self._answer(headers) as answer:
            if file.validator is not None and _validator(answer) not in (file.validator, None):
                raise _ChangedError
            if answer.status != _PARTIAL:
                raise _RangeIgnoredError
            if _total(answer) != file.size:
                raise _ChangedError
            expected, found = (
                f"bytes {start}-{end - 1}/{file.size}",
                answer.headers.get("Content-Range", ""),
            )
            if found != expected:
                raise WrongAnswerError(f"expected {expected}, found {found}")
            if _length(answer) not in (None, end - start):
                raise WrongAnswerError(
                    f"expected {end - start} bytes, found a Content-Length of {_length(answer)}"
                )
            yield from _exactly(answer, end - start)

    @contextmanager
    def _answer(self, headers: dict[str, str]) -> Iterator[HttpAnswer]:
        with self._client.answer(headers) as answer:
            if answer.status in _GONE:
                raise MissingDataError(
                    self._where,
                    expected="a file",
                    found=f"status {answer.status} ({answer.reason})",
                )
            if answer.error is not None:
                raise answer.error
            yield answer

    def _persist(
        self,
        work: Callable[[], _Result],
        count: Callable[[], int] = lambda: 0,
        stop: threading.Event | None = None,
    ) -> _Result:
        """Call `work`, again after temporary failures.

        If all attempts fail, raise a one-line error about the last failure.
        """
        try:
            return persist(work, self._client.settings, count, stop)
        except (CarlascError, _ChangedError, _RangeIgnoredError):
            raise
        except Exception as error:
            if is_temporary(error):
                raise CarlascError(
                    self._where,
                    expected="data",
                    found=f"none in {self._client.settings.attempts} attempts "
                    f"({describe_failure(error)})",
                    advice="run the same command again to continue",
                ) from None
            if isinstance(error, OSError):
                raise  # of the disk
            fail(self._where, error)

    def _load(self) -> _Arrived:
        """Return the blocks that an earlier run fetched of the same file; empty if the file has
        changed.
        """
        fresh, file = _Arrived(_BLOCK), self.file
        if not (self._part.is_file() and self._record.is_file() and file.ranges):
            return fresh
        try:
            values = parse_json(self._record.read_bytes(), str(self._record))
            arrived = _Arrived(
                int(values["block"]), {int(k): int(v) for k, v in values["got"].items()}
            )
            same = (values["url"], values["size"], values["validator"]) == (
                self._where,
                file.size,
                file.validator,
            )
        except (FormatError, KeyError, TypeError, ValueError, AttributeError):
            return fresh
        same = same and arrived.block > 0
        # Without a validator, an equal size does not prove that it is the same file.
        return (
            arrived
            if same and file.validator is not None and self._part.stat().st_size == file.size
            else fresh
        )

    def _save(self, arrived: _Arrived, descriptor: int) -> None:
        """Record the fetched bytes, after syncing them to the disk."""
        sync_file(descriptor)
        got = {str(index): count for index, count in sorted(arrived.got.items())}
        about = {"url": self._where, "size": self.file.size, "validator": self.file.validator}
        write_json(self._record, {**about, "block": arrived.block, "got": got})

    def _finish(self, arrived: _Arrived) -> None:
        """Rename the file if it is complete: it has all bytes, and the central directory at the end
        of a zip.
        """
        size, expected = self._part.stat().st_size, self.file.size
        if expected is not None and (arrived.total != expected or size != expected):
            found = str(min(size, arrived.total))
            raise FormatError(
                self._path,
                expected=f"{expected} bytes",
                found=found,
                advice="run the same command again",
            )
        with self._part.open("rb") as file:
            if not zipfile.is_zipfile(file):
                advice = f"remove {self._part.name} and run again"
                raise FormatError(
                    self._path, expected="a whole zip", found="a truncated one", advice=advice
                )
            sync_file(file.fileno())
        rename(self._part, self._path)
        self.discard_record()


def _exactly(answer: HttpAnswer, count: int | None) -> Iterator[bytes]:
    """Yield the body of an answer, and check that it has `count` bytes, if given.

    Further bytes are not read.
    """
    left = count
    for data in answer.pieces():
        yield data if left is None else data[:left]
        if left is not None and (left := max(0, left - len(data))) == 0:
            return
    if left:
        raise WrongAnswerError(f"the connection ended {left} bytes early")


def _validator(answer: HttpAnswer) -> str | None:
    return answer.headers.get("ETag") or answer.headers.get("Last-Modified")


def _length(answer: HttpAnswer) -> int | None:
    text = answer.headers.get("Content-Length", "")
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None


def _total(answer: HttpAnswer) -> int:
    """Return the size of the whole file, from Content-Range."""
    text = answer.headers.get("Content-Range", "")
    match = re.fullmatch(r"bytes [0-9]+-[0-9]+/([0-9]{1,18})", text)
    if match is None:
        raise WrongAnswerError(f"expected a Content-Range, found {text!r}")
    return int(match[1])
