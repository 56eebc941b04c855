"""A file that a library writes through a pipe, because the library cannot go on when a write fails."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

_BLOCK = 1 << 16  # bytes


class PipedFile:
    """Takes what is written to a pipe and writes it to a file.

    Rerun's own thread ends on a full disk, and whoever waits for it then waits for ever. The pipe is always read, so the library sees no error;
    the first one is kept for `check`.
    """

    def __init__(self, path: Path, begin: Callable[[str], object]) -> None:
        """Create the file and begin to write it.

        Args:
            path: the file.
            begin: opens a path for writing, that of the pipe.

        Raises:
            OSError: the file or the pipe cannot be created.
        """
        self._error: OSError | None = None
        self._file = path.open("wb", buffering=0)
        with TemporaryDirectory(prefix="carlasc-") as folder:
            pipe = str(Path(folder) / path.name)
            os.mkfifo(pipe)
            descriptor = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # the other end can be opened from now on
            try:
                begin(pipe)
            except BaseException:
                os.close(descriptor)
                raise
        os.set_blocking(descriptor, True)
        self._thread = threading.Thread(target=self._drain, args=(descriptor,), daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise the first error of writing.

        Raises:
            OSError: there was one.
        """
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Wait for the end of the pipe, which its writer must have closed, and close the file.

        Raises:
            OSError: the file could not be written.
        """
        self._thread.join()
        self._file.close()
        self.check()

    def _drain(self, descriptor: int) -> None:
        with open(descriptor, "rb", buffering=0) as pipe:
            while block := pipe.read(_BLOCK):
                if self._error is None:
                    try:
                        self._write(block)
                    except OSError as error:
                        self._error = error
                        with suppress(OSError):  # it is removed anyway
                            self._file.truncate(0)

    def _write(self, block: bytes) -> None:
        view = memoryview(block)
        while view:
            view = view[self._file.write(view) :]
