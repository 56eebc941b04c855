"""The cache of a remote store: real processes that share it, are killed in it, and fill the disk;
eviction; files that change.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import threading
import time
from contextlib import suppress
from pathlib import Path

import fsspec
import numpy as np
import pytest
from filelock import FileLock
from helpers.datasets.sequences import files_of, write_dataset
from helpers.errors import raises
from helpers.processes.cache_jobs import PIECE, read_files, tree_at
from helpers.servers.range_server import Served, serve_folder

import carlasc
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError, StorageError
from carlasc.storage import Cache, Source
from carlasc.storage.packing import pack
from carlasc.storage.transport import caching
from carlasc.storage.transport.caching import CachedTree
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.testing import SourceContract
from carlasc.testing.data import WHOLE

pytestmark = pytest.mark.posix("fork, and limits of the size of files")

pytest.importorskip("urllib3")

SIZE = 10 * PIECE
SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def served(tmp_path):
    folder = tmp_path / "served"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(6):
        (folder / f"{k}.bin").write_bytes(rng.bytes(SIZE))
    with serve_folder(folder) as at:
        yield at


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch):
    monkeypatch.setenv("CARLASC_REMOTE_BACKOFF_S", "0.001")
    monkeypatch.setattr(caching, "_PIECE", PIECE)


def start(tree, paths, **options):
    """Start a process that reads files; return it, and the queue with its digests."""
    digests = SPAWN.Queue()
    process = SPAWN.Process(target=read_files, args=(tree, paths, digests), kwargs=options)
    process.start()
    return process, digests


def digests_of(served, paths):
    return [hashlib.sha256((served.folder / path).read_bytes()).hexdigest() for path in paths]


def kept(folder):
    """Return the sizes of the files in a cache, whole or not, by name."""
    found = {}
    for path in Path(folder).glob("??/*"):
        with suppress(FileNotFoundError):  # renamed meanwhile
            found[path.name] = path.stat().st_size
    return found


def test_several_processes_fetch_each_file_once(served, tmp_path):
    paths = [f"{k}.bin" for k in range(6)]
    served.before = lambda path: time.sleep(0.002)  # so that they are all at it together
    started = [start(tree_at(served.url, tmp_path / "cache"), paths) for _ in range(3)]
    for process, digests in started:
        assert digests.get(timeout=60) == digests_of(served, paths)
        process.join()
    assert served.sent == dict.fromkeys(paths, SIZE)
    assert sorted(kept(tmp_path / "cache").values()) == [SIZE] * 6


def test_a_fork_reads_what_was_fetched_before_and_after_it(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache")
    tree.read("0.bin")
    context = multiprocessing.get_context("fork")
    digests = context.Queue()
    process = context.Process(target=read_files, args=(tree, ["0.bin", "1.bin"], digests))
    process.start()
    assert digests.get(timeout=60) == digests_of(served, ["0.bin", "1.bin"])
    process.join()
    assert bytes(tree.read("1.bin")) == (served.folder / "1.bin").read_bytes()
    assert served.sent == {"0.bin": SIZE, "1.bin": SIZE}


@pytest.mark.parametrize(
    "kill_at", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3, 5, 6, 7, 8, 9, 10))]
)
def test_a_process_that_is_killed_while_it_fetches_leaves_nothing_that_is_read(
    served, tmp_path, kill_at
):
    requests, reached, go_on = [], threading.Event(), threading.Event()

    def before(_):
        requests.append(None)
        if len(requests) >= kill_at and not go_on.is_set():
            reached.set()
            go_on.wait(60)

    served.before = before
    victim, _ = start(tree_at(served.url, tmp_path / "cache"), ["0.bin"])
    assert reached.wait(60)
    # it waits for the first, then takes over
    waiting, digests = start(tree_at(served.url, tmp_path / "cache"), ["0.bin"])
    time.sleep(0.5 if kill_at % 2 else 0)
    victim.kill()
    victim.join()
    go_on.set()
    assert digests.get(timeout=60) == digests_of(served, ["0.bin"])
    waiting.join()
    assert list(kept(tmp_path / "cache").values()) == [SIZE]


def test_what_a_killed_process_left_gives_way_when_room_is_needed(served, tmp_path):
    left = tmp_path / "cache" / "ab" / f"ab-0-{SIZE}.part"
    left.parent.mkdir(parents=True)
    left.write_bytes(bytes(4 * SIZE))
    tree = tree_at(served.url, tmp_path / "cache", max_bytes=5 * SIZE)
    for k in range(2):
        tree.read(f"{k}.bin")
    assert sorted(kept(tmp_path / "cache").values()) == [SIZE] * 2


def test_a_full_disk_is_read_past(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache")
    process, digests = start(tree, ["0.bin", "1.bin"], largest_file=SIZE // 2)
    assert digests.get(timeout=60) == digests_of(served, ["0.bin", "1.bin"])
    process.join()
    assert not any(kept(tmp_path / "cache").values())
    process, digests = start(tree, ["0.bin"])  # there is space again
    assert digests.get(timeout=60) == digests_of(served, ["0.bin"])
    process.join()
    assert list(kept(tmp_path / "cache").values()) == [SIZE]


def test_the_cache_never_grows_beyond_its_size_and_keeps_what_was_used_last(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache", max_bytes=4 * SIZE)
    first = tree.read("0.bin")
    for k in range(1, 6):
        tree.fetch("0.bin")
        tree.read(f"{k}.bin")
        assert sum(kept(tmp_path / "cache").values()) <= 4 * SIZE
    assert served.sent["0.bin"] == SIZE
    tree.read("1.bin")
    assert served.sent["1.bin"] == 2 * SIZE, "it had given way"
    for k in range(2, 6):
        tree.read(f"{k}.bin")
    assert bytes(first) == (served.folder / "0.bin").read_bytes(), (
        "what is in use outlives its file"
    )


def test_processes_together_keep_to_the_size(served, tmp_path):
    largest = 0
    started = [start(tree_at(served.url, tmp_path / "cache", max_bytes=4 * SIZE), [f"{k}.bin" for k in order])
               for order in ((0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0))]  # fmt: skip
    while any(process.is_alive() and digests.empty() for process, digests in started):
        with FileLock(tmp_path / "cache" / ".locks" / ".lock"):  # files come and go under this lock
            largest = max(largest, sum(kept(tmp_path / "cache").values()))
    for (process, digests), order in zip(
        started, ((0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0)), strict=True
    ):
        assert digests.get(timeout=60) == digests_of(served, [f"{k}.bin" for k in order])
        process.join()
    assert SIZE <= largest <= 4 * SIZE


def test_ranges_of_a_file_that_is_too_large_are_read_from_the_server(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache", max_bytes=3 * SIZE)
    content = (served.folder / "0.bin").read_bytes()
    assert bytes(tree.read_range("0.bin", 100, 300)) == content[100:300]
    assert bytes(tree.read_range("0.bin", -300, -100)) == content[-300:-100]
    assert not tree.fetch("0.bin")
    assert served.sent["0.bin"] == 400 and not kept(tmp_path / "cache")


def test_a_file_that_changes_is_fetched_again_when_the_store_is_opened_again(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache")
    old = bytes(tree.read("0.bin"))
    tree_at(served.url, tmp_path / "cache").read("0.bin")
    assert served.sent["0.bin"] == SIZE, "the same version"
    new = bytes(reversed(old))
    (served.folder / "0.bin").write_bytes(new)
    assert bytes(tree.read("0.bin")) == old, "an open store stays as it is"
    assert bytes(tree_at(served.url, tmp_path / "cache").read("0.bin")) == new


def test_the_server_is_asked_once_for_all_processes_whether_a_file_has_changed(served, tmp_path):
    tree_at(served.url, tmp_path / "cache").read("0.bin")  # by an earlier run
    served.asked.clear()
    tree = tree_at(served.url, tmp_path / "cache")
    for _ in range(3):
        process, digests = start(tree, ["0.bin"])
        digests.get(timeout=60)
        process.join()
    assert served.asked == {"0.bin": 1} and served.sent == {"0.bin": SIZE}


def test_a_copy_that_was_cut_short_is_fetched_again(served, tmp_path):
    tree_at(served.url, tmp_path / "cache").read("0.bin")
    (copy,) = (tmp_path / "cache").glob("??/*")
    os.truncate(copy, 10)
    assert (
        bytes(tree_at(served.url, tmp_path / "cache").read("0.bin"))
        == (served.folder / "0.bin").read_bytes()
    )


def test_a_fetch_ahead_does_not_wait_for_another_process(served, tmp_path):
    tree, other = (tree_at(served.url, tmp_path / "cache") for _ in range(2))
    reached, go_on = threading.Event(), threading.Event()
    served.before = lambda _: (reached.set(), go_on.wait(60))
    thread = threading.Thread(target=tree.fetch, args=("0.bin",))
    thread.start()
    assert reached.wait(60)
    assert not other.fetch("0.bin", wait=False)
    go_on.set()
    thread.join()
    assert other.fetch("0.bin", wait=False)


def test_stores_of_one_name_behind_two_endpoints_are_kept_apart(tmp_path):
    options = ({"endpoint_url": "http://a"}, {"client_kwargs": {"endpoint_url": "http://b"}}, {})
    pytest.importorskip("obstore")
    keys = {
        CachedTree(RemoteTree("s3://bucket/x", o), Cache(tmp_path))._key("zarr.json")
        for o in options
    }
    assert len(keys) == 3


def test_a_large_file_is_fetched_in_parts_of_which_few_are_in_memory(served, tmp_path, monkeypatch):
    asked, read_ranges = [], RemoteTree.read_ranges

    def counted(tree, ranges):
        asked.append([end - start for _, start, end in ranges])
        return read_ranges(tree, ranges)

    monkeypatch.setattr(RemoteTree, "read_ranges", counted)
    (served.folder / "0.bin").write_bytes(os.urandom(SIZE + 1))
    tree = tree_at(served.url, tmp_path / "cache")
    assert bytes(tree.read("0.bin")) == (served.folder / "0.bin").read_bytes()
    assert asked == [[PIECE] * 4, [PIECE] * 4, [PIECE, PIECE, 1]]


def test_a_file_that_is_being_fetched_is_not_removed_to_make_room(served, tmp_path):
    tree, other = (tree_at(served.url, tmp_path / "cache", max_bytes=4 * SIZE) for _ in range(2))
    begun, go_on = threading.Event(), threading.Event()
    served.before = lambda path: path == "0.bin" and (begun.set(), go_on.wait(60))
    thread = threading.Thread(target=tree.fetch, args=("0.bin",))
    thread.start()
    assert begun.wait(60)
    for k in range(1, 6):
        assert other.fetch(f"{k}.bin")
    assert [name for name in kept(tmp_path / "cache") if name.endswith(".part")]
    go_on.set()
    thread.join()
    assert served.sent["0.bin"] == SIZE and tree.fetch("0.bin")
    assert sum(kept(tmp_path / "cache").values()) <= 4 * SIZE


def test_an_empty_file_is_cached(served, tmp_path):
    (served.folder / "empty").touch()
    tree = tree_at(served.url, tmp_path / "cache")
    assert bytes(tree.read("empty")) == b""


def test_errors_name_the_remote_file(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache")
    with pytest.raises(
        MissingDataError, match=rf"{served.url}/none\.bin: expected a file, found nothing"
    ):
        tree.read("none.bin")
    with pytest.raises(
        FormatError, match=rf"{served.url}/0\.bin.*expected 20 bytes in this range, found 10"
    ):
        tree.read_range("0.bin", SIZE - 10, SIZE + 10)
    served.broken = True
    with pytest.raises(CarlascError, match=rf"{served.url}/1\.bin: cannot be read"):
        tree.read("1.bin")
    assert list(kept(tmp_path / "cache").values()) == [SIZE], "nothing of it is left"


def test_bad_caches_are_refused(served, tmp_path):
    with raises(ArgumentError, where="max_bytes", expected="a number of bytes above 0", found="0"):
        Cache(tmp_path, 0)
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot be used as a cache: .*choose another folder"):
        tree_at(served.url, tmp_path / "file")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


@pytest.mark.parametrize("kind", ["h5", "parquet"])
def test_a_store_that_cannot_be_cached_says_so(published, tmp_path, kind):
    fs = fsspec.filesystem("memory")
    store = pack(published, tmp_path / f"x.{kind}").out
    for path, data in (files_of(store) if store.is_dir() else {"": store.read_bytes()}).items():
        fs.pipe(f"/{tmp_path.name}.{kind}/{path}".rstrip("/"), data)
    with pytest.raises(
        ArgumentError, match=r"cache: expected a packed zarr store, or a folder.*pack the data into"
    ):
        carlasc.open(f"memory://{tmp_path.name}.{kind}", cache=tmp_path / "cache")


def test_a_store_on_this_machine_is_not_cached(published, tmp_path):
    sequence = carlasc.open(published, cache=tmp_path / "cache").sequences()[WHOLE]
    assert len(sequence.frames("points")) and not (tmp_path / "cache").exists()


class TestCachedZarr(SourceContract):
    processes = ("fork", "spawn")

    at: Served

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def _server(cls, tmp_path_factory):
        with serve_folder(tmp_path_factory.mktemp("contract")) as cls.at:
            yield

    def build(self, published: Path, folder: Path) -> Source:
        pack(published, self.at.folder / "x.zarr")
        return carlasc.open(f"{self.at.url}/x.zarr", cache=folder / "cache")


class TestCachedFolder(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        for path, data in files_of(published).items():
            fsspec.filesystem("memory").pipe(f"/{folder.name}/{path}", data)
        return carlasc.open(f"memory://{folder.name}", cache=folder / "cache")


def test_a_cached_tree_is_pickled_without_what_it_knows_of_this_process(served, tmp_path):
    tree = tree_at(served.url, tmp_path / "cache")
    tree.read("0.bin")
    copy = pickle.loads(pickle.dumps(tree))
    assert bytes(copy.read("0.bin")) == (served.folder / "0.bin").read_bytes()
    assert served.asked == {"0.bin": 1}
