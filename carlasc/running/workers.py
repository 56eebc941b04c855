"""What a worker of a cluster does before its first task: it compares versions and limits threads."""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from carlasc.errors import CarlascError
from carlasc.running.pools import ONE_THREAD


@dataclass(frozen=True)
class Versions:
    """The versions on which results depend.

    Attributes:
        carlasc: version of the package, and a digest of its source: rules change between versions too.
        python: version of Python, without its last part.
        numpy: version of NumPy.
        numba: version of Numba.
    """

    carlasc: str
    python: str
    numpy: str
    numba: str

    @classmethod
    def here(cls) -> Self:
        """Return the versions of this process."""
        return cls(
            f"{version('carlasc')} (source {_digest_of_source()})",
            ".".join(platform.python_version_tuple()[:2]),
            version("numpy"),
            version("numba"),
        )

    def check(self, other: Versions, worker: str) -> None:
        """Check that a worker has these versions.

        Raises:
            CarlascError: it has others.
        """
        names = [field.name for field in fields(self) if getattr(self, field.name) != getattr(other, field.name)]
        if names:
            raise CarlascError(
                f"worker {worker}",
                expected=" and ".join(f"{name} {getattr(self, name)}" for name in names),
                found=" and ".join(f"{name} {getattr(other, name)}" for name in names),
                advice="install the same versions on all workers, or results would depend on who made them",
            )


@cache
def _digest_of_source() -> str:
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:8]


@dataclass(frozen=True)
class Session:
    """What all tasks of a run have in common.

    Attributes:
        name: unique name of the run.
        versions: those of the process that started it.
        folder: its current folder, which relative paths start from.
    """

    name: str
    versions: Versions
    folder: str

    @classmethod
    def of(cls, name: str) -> Self:
        """Return the session of this process with a name."""
        return cls(name, Versions.here(), str(Path.cwd()))


def run_task(session: Session, call: bytes) -> Any:
    """Call a function with an item, in a worker.

    Args:
        session: the run.
        call: the pickled function and item.

    Raises:
        CarlascError: the worker has other versions, or lacks a package.
    """
    _prepare(session)
    try:
        function, item = pickle.loads(call)
    except (ImportError, AttributeError) as error:
        raise CarlascError(
            f"worker {_name()}",
            problem=f"it cannot load the work: {error}",
            advice="install the same packages on all workers",
        ) from error
    return function(item)


@cache
def _prepare(session: Session) -> None:
    """Check the versions of this process, and set it up for a run."""
    session.versions.check(Versions.here(), _name())
    for name in ONE_THREAD:  # a worker has one thread: libraries that were not loaded yet follow
        os.environ.setdefault(name, "1")
    with suppress(OSError):  # a worker without this folder can still read absolute paths and URLs
        os.chdir(session.folder)


def _name() -> str:
    from distributed import get_worker

    return str(get_worker().address)
