"""`convert` of a list of clips: each is fetched, converted, and deleted again, while the next is
fetched.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from carlasc.converting.plans import sequence_path
from carlasc.converting.protocol import Failure
from carlasc.converting.registry import find_recordings, open_converter
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    MissingDataError,
    StorageError,
    without_credentials,
)
from carlasc.running.processes import one_pool, run_all
from carlasc.running.spreading import Part, Run, StepCounter
from carlasc.storage import layout
from carlasc.storage.files import AnyPath, to_json, writing
from carlasc.storage.folder import FolderSink, FolderWriter
from carlasc.storage.inputs import combined, folder_states
from carlasc.storage.opening import PACKED
from carlasc.storage.shares import read_list
from carlasc.storage.transport.remote_tree import RemoteTree, tree_of
from carlasc.storage.transport.trees import is_url

_BLOCK = 16 << 20  # bytes per request
_WAIT_S = 0.1  # between two looks for room
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


@dataclass(frozen=True)
class Clips:
    """Clips to convert, one after the other.

    Attributes:
        names: their places: URLs, or paths below `source`.
        source: a folder or a URL.
        out: the folder to write to.
        convert: the function `convert`.
        arguments: its arguments, without source, output and run.
        scratch: folder for what is fetched.
        most: largest size of the scratch, bytes; all processes of a machine together.
    """

    names: tuple[str, ...]
    source: str
    out: AnyPath
    convert: Callable[..., Any]
    arguments: Mapping[str, Any]
    scratch: Path
    most: int

    def run(self, run: Run = Run(workers=1)) -> Iterator[Any]:  # noqa: B008 (frozen)
        """Yield the result of each clip that is not done yet; a `Failure` if it has none.

        Raises:
            StorageError: the output or the scratch cannot be written.
        """
        sink = FolderSink(self.out)
        states = dict[str, str]()
        for name, place in self._fetched(self._todo(sink, states)):
            if isinstance(place, CarlascError):
                yield Failure(name, -1, str(place))
                continue
            try:
                result = self._convert(name, states[name], place, sink, run)
            except StorageError:
                raise
            except (CarlascError, OSError) as error:
                yield Failure(name, -1, str(error).replace(str(place), without_credentials(name)))
                continue
            yield result

    def _todo(self, sink: FolderSink, states: dict[str, str]) -> Iterator[str]:
        """Yield the clips that are not done in their state, and note the state of each. A clip is
        looked at when its turn comes: the first one need not wait for requests about all others.
        """
        for name in self.names:
            done = sink.target.read(self._done(name))
            states[name] = self._state(name)
            if done is None or states[name].encode() not in done:
                yield name

    def _done(self, name: str) -> str:
        """Return the file that says that a clip is done with these arguments."""
        return f"{layout.DERIVED}/clips/{combined(name, repr(self.arguments))}.json"

    def _state(self, name: str) -> str:
        """Return the state of the files of a clip; empty if they are not there any more."""
        states = dict[str, str]()
        with suppress(CarlascError):
            if not is_url(url := self._place(name)):
                states = folder_states({"": Path(url)})
            elif sizes := (tree := RemoteTree(url)).sizes():  # a server may have no versions
                states = tree.states([*sizes]) | {"sizes": str(sizes)}
        return combined(sorted(states.items())) if states else ""

    def _convert(self, name: str, state: str, place: Path, sink: FolderSink, run: Run) -> Any:
        given = {**self.arguments}
        record = layout.record_file("clip")
        done = self._done(name)
        name = without_credentials(name)
        writers = list[FolderWriter]()
        changed = False
        mine = f"{name}\n{state}".encode()
        for one in find_recordings(open_converter(given["name"], place, given["options"])):
            writers.append(writer := sink.sequence(sequence_path(one)))
            if not writer.create_document(record, mine):
                before = writer.read_document(record) or b""
                if (other := before.decode().partition("\n")[0]) != name:
                    raise ConflictError(writer.location, expected=f"only {name}", found=other)
                changed |= before != mine
        if place.is_relative_to(self.scratch):  # the times of its files mean nothing
            compare = "content" if changed else "never"
            given["layout"] = replace(given["layout"], compare_inputs=compare)
        result = self.convert(source=place, out=self.out, run=run, **given)
        if not result.failures:
            for writer in writers:
                writer.write_document(record, mine)
            sink.target.put(done, to_json({"clip": name, "state": state}))
        return result

    def _place(self, name: str) -> str:
        alone = is_url(name) or Path(name).is_absolute()
        return name if alone else f"{self.source.rstrip('/')}/{name}"

    def _fetched(self, names: Iterable[str]) -> Iterator[tuple[str, Path | CarlascError]]:
        """Yield the place of each clip on this machine, or why it cannot be fetched, while the next
        one is fetched. It is deleted before the next one is yielded.
        """
        with ThreadPoolExecutor(1) as pool:
            ahead = None
            for name, later in pairwise(chain(names, [""])):
                place, held = ahead.result() if ahead else self._fetch(name)
                ahead = pool.submit(self._fetch, later) if later else None
                try:
                    yield name, place
                finally:
                    self._delete(held)

    def _fetch(self, name: str) -> tuple[Path | CarlascError, FileLock | None]:
        """Return the place of a clip, which is fetched if it is at a URL, and the lock of it."""
        if not is_url(url := self._place(name)):
            return Path(url), None
        held = None
        try:
            tree = RemoteTree(url)
            sizes = tree.sizes()
            if not sizes:
                raise MissingDataError(tree.location, expected="a clip", found="nothing")
            if (total := sum(sizes.values())) > self.most:
                expected = f"at most {self.most} bytes, the size of the scratch"
                raise CarlascError(tree.location, expected=expected, found=total)
            place = self.scratch / combined(name) / tree.location.rpartition("/")[2]
            with writing(place):
                held = self._reserve(place, sizes)
                for path, size in sizes.items():
                    with (place / path).open("rb+") as file:
                        for at in range(0, size, _BLOCK):
                            file.write(tree.read_range(path, at, min(at + _BLOCK, size)))
        except StorageError:
            raise
        except CarlascError as error:
            return error, held
        return place, held

    def _reserve(self, place: Path, sizes: Mapping[str, int]) -> FileLock:
        """Wait until this machine has room for the files of a clip, and make them; return a lock,
        without which others delete them: their process died.
        """
        held = FileLock(f"{place.parent}.lock", thread_local=False)
        while True:
            with self._room():
                self.scratch.mkdir(parents=True, exist_ok=True)
                if not held.is_locked:
                    held.acquire()
                    shutil.rmtree(place.parent, ignore_errors=True)
                taken = sum(map(_size, filter(Path.is_dir, self.scratch.iterdir())))
                if taken + sum(sizes.values()) <= self.most:
                    for path, size in sizes.items():
                        (place / path).parent.mkdir(parents=True, exist_ok=True)
                        with (place / path).open("wb") as file:
                            file.truncate(size)
                    return held
            time.sleep(_WAIT_S)

    def _delete(self, held: FileLock | None) -> None:
        if held is not None:
            with self._room():
                shutil.rmtree(held.lock_file.removesuffix(".lock"), ignore_errors=True)
                Path(held.lock_file).unlink(missing_ok=True)
                held.release()
                with suppress(OSError):  # others have clips in it
                    self.scratch.rmdir()

    def _room(self) -> FileLock:
        return FileLock(f"{self.scratch}-room.lock")


def _size(clip: Path) -> int:
    """Return the size of a clip in the scratch, which is deleted if its process died."""
    try:
        with FileLock(f"{clip}.lock", timeout=0):
            shutil.rmtree(clip)
            Path(f"{clip}.lock").unlink()
            return 0
    except Timeout:
        return sum(path.stat().st_size for path in clip.rglob("*") if path.is_file())


def convert_clips(
    convert: Callable[..., Any],
    source: AnyPath,
    out: AnyPath,
    arguments: Mapping[str, Any],
    scratch: str,
    run: Run,
) -> list[Any]:
    """Convert the clips of the list of a run, and return what `Clips.run` yields.

    On a cluster, each clip is a task.

    Raises:
        ArgumentError: the scratch is no size, the output is a store, or another run has the same
            scratch.
    """
    size = re.fullmatch(r"([0-9.]+) *([KMGT]?)B?", scratch.strip().upper())
    if size is None:
        raise ArgumentError("scratch", expected="a size, such as 20GB", found=scratch)
    if str(out).endswith(PACKED):
        raise ArgumentError("out", expected="a folder for a list of clips", found=out)
    most = int(float(size[1]) * _UNITS[size[2]])
    names, part = run.part.share(read_list(run, lambda: sorted(tree_of(source).entries())))
    folder = Path(tempfile.gettempdir()) / f"carlasc-{combined(str(out), str(run.part))}"
    clips = Clips(
        tuple(names if part.number == 1 else ()),
        os.fspath(source),
        out,
        convert,
        arguments,
        folder,
        most,
    )
    steps = StepCounter(run.progress, len(clips.names))
    run = replace(run, part=Part(), sequences_from=None, progress=None)
    results = list[Any]()
    if run.executor is not None:
        tasks = (replace(clips, names=(name,)) for name in clips.names)
        for done in run_all(_run_one, tasks, run, lost=_fail):
            results += done
            steps()
        return results
    try:
        with FileLock(f"{folder}.lock", timeout=0), one_pool(run) as pool:
            shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed
            for result in clips.run(pool):
                results.append(result)
                steps()
    except Timeout:
        advice = "wait for it, or set TMPDIR to another folder"
        raise ArgumentError(folder, expected="no other run", found="one", advice=advice) from None
    return results


def _run_one(clips: Clips) -> list[Any]:
    return list(clips.run())


def _fail(clips: Clips, message: str) -> list[Any]:
    return [Failure(clips.names[0], -1, message)]
