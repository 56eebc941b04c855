"""Fetching one large file from a web server, in blocks over several connections.

An interrupted run can be continued.

Bytes are written to `<name>.part`, and the list of its blocks to `<name>.part.json`. The file gets
its final name when it is complete.
"""

from __future__ import annotations

import math
import os
import re
import threading
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

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
    StatusError,
    WrongAnswerError,
    fail,
    is_temporary,
)
from carlasc.storage.transport.requests import persist
from carlasc.storage.transport.web import PARTIAL, WebClient

_ZIP = b"PK"
_GONE = (401, 403, 404, 410)
_BLOCK = 16 << 20  # bytes per request
_RESTARTS = 3  # after the file has changed

_Result = TypeVar("_Result")


class _ChangedError(FormatError):
    """The file on the server is not the one of which the transfer began, or it came whole where a
    range was requested.
    """


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
        self._where = without_credentials(url)
        self._path = path
        self._connections = connections
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
        return (self.file.size or 0) - sum(self._load().values())

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
        for restart in range(_RESTARTS):
            if restart:
                self._part.unlink(missing_ok=True)
                self._record.unlink(missing_ok=True)
                self.file = self._persist(self._probe)
            got = self._load()
            resumed = sum(got.values())
            advance(resumed)
            try:
                self._fetch(got, advance, most)
                self._finish()
                return resumed
            except OSError as error:
                raise storage_error(self._path, error) from error
            except _ChangedError:
                advance(-sum(got.values()))
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

    def _fetch(self, got: dict[int, int], advance: Callable[[int], None], most: float) -> None:
        """Fetch the missing bytes of all blocks.

        Args:
            got: the number of fetched bytes of each block, counted from its start; updated.
            advance: called with the number of new bytes.
            most: maximum size in bytes, if the server does not report the size.
        """
        stop = threading.Event()
        lock = threading.Lock()
        size = self.file.size
        blocks = range(math.ceil((size or 0) / _BLOCK)) if self.file.ranges else range(1)
        descriptor = os.open(self._part, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        executor = ThreadPoolExecutor(self._connections, thread_name_prefix="download")

        def one_try(block: int) -> None:
            if not self.file.ranges:  # each attempt starts at the first byte
                advance(-got.pop(block, 0))
                os.ftruncate(descriptor, 0)
            place = block * _BLOCK + got.get(block, 0)
            for data in self._body(place, min((block + 1) * _BLOCK, size or 0)):
                write_at(descriptor, data, place)
                place += len(data)
                with lock:
                    got[block] = got.get(block, 0) + len(data)
                    advance(len(data))
                if stop.is_set():
                    return
                if size is None and place > most:
                    raise FormatError(
                        self._where, expected=f"at most {most:.0f} bytes", found="more"
                    )

        def fetch(block: int) -> None:
            # a stream begins again at each attempt: what arrived of it is no progress
            self._persist(
                partial(one_try, block),
                lambda: got.get(block, 0) if self.file.ranges else 0,
                stop,
            )
            with lock:
                self._save(got, descriptor)

        try:
            os.ftruncate(descriptor, size or 0)
            with postponed_interrupts():
                futures = [
                    executor.submit(fetch, block)
                    for block in blocks
                    if size is None or got.get(block, 0) < min(_BLOCK, size - block * _BLOCK)
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
                self._save(got, descriptor)
            finally:
                os.close(descriptor)

    def _probe(self) -> ServedFile:
        """Request the first bytes, to find the size, whether ranges are supported, and whether it
        is a zip.
        """
        with self._answer({"Range": f"bytes=0-{len(_ZIP) - 1}"}) as answer:
            ranges = answer.status == PARTIAL
            start = answer.read(len(_ZIP))
            if start != _ZIP:
                content = answer.headers.get("Content-Type", "data of unknown type")
                raise FormatError(
                    self._where,
                    expected="a zip",
                    found=f"{content} that begins with {start!r}",
                    advice="check the URL: the file may have moved",
                )
            total = answer.headers.get("Content-Range", "").partition("/")[2]
            size = _number(total) if ranges else _length(answer)
            if ranges and size is None:
                raise WrongAnswerError("no size in Content-Range")
            return ServedFile(size, _validator(answer), ranges)

    def _body(self, start: int, end: int) -> Iterator[bytes]:
        """Yield the bytes [start, end) in pieces; the whole file if the server has no ranges.

        Checks that all headers of the answer fit the request.
        """
        file = self.file
        left = end - start if file.ranges else file.size
        with self._answer({"Range": f"bytes={start}-{end - 1}"} if file.ranges else {}) as answer:
            found = answer.headers.get("Content-Range", "")
            if (
                _validator(answer) not in (file.validator, None)
                or (file.ranges and not found.endswith(f"/{file.size}"))
                or (not file.ranges and _length(answer) not in (None, left))
            ):
                raise _ChangedError(self._where)
            if file.ranges and found != f"bytes {start}-{end - 1}/{file.size}":
                raise WrongAnswerError(f"expected bytes {start}-{end - 1}, found {found}")
            if _length(answer) not in (None, left):
                raise WrongAnswerError(
                    f"expected {left} bytes, found a Content-Length of {_length(answer)}"
                )
            for data in self._client.pieces(answer):  # what follows the expected bytes is not read
                yield data if left is None else data[:left]
                if left is not None and (left := max(0, left - len(data))) == 0:
                    return
            if left:
                raise WrongAnswerError(f"the connection ended {left} bytes early")

    @contextmanager
    def _answer(self, headers: dict[str, str]) -> Iterator[Any]:
        with self._client.answer(self._client.url, headers) as answer:
            if answer.status in _GONE:
                raise MissingDataError(
                    self._where,
                    expected="a file",
                    found=f"status {answer.status} ({answer.reason})",
                )
            if answer.status >= 300:
                raise StatusError(answer.status)
            yield answer

    def _persist(
        self,
        work: Callable[[], _Result],
        count: Callable[[], int] = lambda: 0,
        stop: threading.Event | None = None,
    ) -> _Result:
        """Call `work`, again after temporary failures (see `persist` and `fail`)."""
        try:
            return persist(work, self._client.settings, count, stop)
        except Exception as error:
            if isinstance(error, OSError) and not is_temporary(error):
                raise  # of the disk
            fail(self._where, error)

    @property
    def _about(self) -> dict[str, object]:
        """What must be equal for a transfer to be continued."""
        about = {"url": self._where, "size": self.file.size, "validator": self.file.validator}
        return {**about, "block": _BLOCK}

    def _load(self) -> dict[int, int]:
        """Return the number of bytes of each block that an earlier run fetched of the same file;
        empty if the file has changed, or may have.
        """
        # Without a validator, an equal size does not prove that it is the same file.
        if not self.file.ranges or self.file.validator is None:
            return {}
        try:
            values = parse_json(self._record.read_bytes(), str(self._record))
            got = {int(block): int(count) for block, count in values.pop("got").items()}
            same = values == self._about and self._part.stat().st_size == self.file.size
        except (FormatError, FileNotFoundError, KeyError, TypeError, ValueError, AttributeError):
            return {}
        return got if same else {}

    def _save(self, got: dict[int, int], descriptor: int) -> None:
        """Record the fetched bytes, after syncing them to the disk."""
        sync_file(descriptor)
        counts = {str(block): count for block, count in sorted(got.items())}
        write_json(self._record, {**self._about, "got": counts})

    def _finish(self) -> None:
        """Rename the file if it is a whole zip: it has the central directory at its end."""
        with self._part.open("rb") as file:
            if not zipfile.is_zipfile(file):
                advice = f"remove {self._part.name} and run again"
                raise FormatError(
                    self._path, expected="a whole zip", found="a truncated one", advice=advice
                )
            sync_file(file.fileno())
        rename(self._part, self._path)
        self.discard_record()


def _validator(answer: Any) -> str | None:
    return answer.headers.get("ETag") or answer.headers.get("Last-Modified")


def _length(answer: Any) -> int | None:
    return _number(answer.headers.get("Content-Length", ""))


def _number(text: str) -> int | None:
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None
