"""Reading from and writing to an S3 server, which may fail."""

from __future__ import annotations

import multiprocessing
import pickle
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, write_dataset
from helpers.errors import raises
from helpers.servers.object_store import (
    BUCKET,
    KEY,
    SECRET,
    FaultyServer,
    every,
    faulty_server,
    options_for,
    s3_server,
)

import carlasc
from carlasc import Run
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    FormatError,
    MissingDataError,
    StorageError,
    without_credentials,
)
from carlasc.running.spreading import check_shared
from carlasc.storage import FolderSink
from carlasc.storage.opening import as_sink
from carlasc.storage.packing import pack
from carlasc.storage.transport.remote_tree import (
    RemoteFile,
    RemoteTarget,
    RemoteTree,
    target_of,
)
from carlasc.storage.transport.requests import RemoteSettings
from carlasc.storage.transport.trees import Target
from carlasc.testing import SinkContract

pytest.importorskip("obstore")
FAULTS = {
    "503": "",
    "drop": "",
    "cut": "GET",
    "too long": "GET",
    "too short": "GET",
    "other range": "GET",
}


@pytest.fixture(scope="module", autouse=True)
def _quick() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARLASC_REMOTE_TIMEOUT_S", "1")
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        yield


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with s3_server() as url:
        yield url


@pytest.fixture(scope="module")
def server(endpoint: str) -> Iterator[FaultyServer]:
    with faulty_server(endpoint) as found:
        yield found


@pytest.fixture
def faulty(server: FaultyServer) -> Iterator[FaultyServer]:
    yield server
    server.reset(lambda number, method, path: None)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


def files_in(target: Target) -> dict[str, bytes]:
    paths = sorted(target.paths())
    return {
        path: bytes(data) for path, data in zip(paths, target.tree.read_many(paths), strict=True)
    }


def upload(folder: Path, url: str, **options: Any) -> RemoteTarget:
    target = RemoteTarget(url, options)
    target.put_many(files_of(folder))
    return target


def copy(source: carlasc.Source, sink: carlasc.Sink) -> None:
    """Write all that a source has, as converting and packing do."""
    for path, sequence in source.sequences().items():
        with sink.sequence(path) as writer:
            for name in sequence.documents():
                writer.write_document(name, sequence.read_document(name))
            for name in sorted(sequence.fields()):
                frames = sequence.frames(name).tolist()
                writer.write_frames(
                    {
                        frame: {name: array}
                        for frame, array in zip(
                            frames, sequence.read_many(name, frames), strict=True
                        )
                    }
                )


class TestMemoryFolderSink(SinkContract):
    rising = False

    def sink(self, out: Path) -> carlasc.Sink:
        return as_sink(f"memory:/{out}")

    def read(self, out: Path) -> carlasc.Source:
        return carlasc.open(f"memory:/{out}")


@pytest.fixture(params=["s3", "memory", "local"])
def target(request: pytest.FixtureRequest, endpoint: str, tmp_path: Path) -> Target:
    if request.param == "local":
        return target_of(tmp_path / "folder")
    if request.param == "memory":
        return target_of(f"memory://{tmp_path.name}")
    return target_of(f"s3://{BUCKET}/{tmp_path.name}", **options_for(endpoint))


def test_a_target_holds_what_was_put(target: Target) -> None:
    assert not target.tree.is_file("a/b.txt") and list(target.paths()) == []
    assert target.put("a/b.txt", b"one") and target.put("a/b.txt", memoryview(b"two"))
    assert target.tree.is_file("a/b.txt") and target.tree.read("a/b.txt") == b"two"
    target.put_many({"a/c/d": b"", "e": b"four"})
    assert sorted(target.paths()) == ["a/b.txt", "a/c/d", "e"]
    assert sorted(target.paths("a")) == ["a/b.txt", "a/c/d"] and list(target.paths("none")) == []
    assert target.tree.entries() == {"a": True, "e": False}
    assert target.tree.entries("a") == {"b.txt": False, "c": True}
    below = pickle.loads(pickle.dumps(target)).below("a")
    assert sorted(below.paths()) == ["b.txt", "c/d"] and below.location.endswith("/a")


def test_a_create_only_put_keeps_what_exists(target: Target) -> None:
    assert target.put("lock", b"mine", create=True)
    assert not target.put("lock", b"mine", create=True)
    assert not target.put("lock", b"yours", create=True)
    assert target.tree.read("lock") == b"mine"


def test_files_and_folders_are_removed(target: Target) -> None:
    target.put_many({"a/b": b"1", "a/c/d": b"2", "ab": b"3", "e": b"4"})
    assert target.tree.is_file("a/b")
    target.remove("a")
    assert sorted(target.paths()) == ["ab", "e"] and not target.tree.is_file("a/b")
    target.remove("e")
    target.remove("nothing")
    target.remove_many(["ab", "never"])
    assert list(target.paths()) == []


@pytest.mark.parametrize("path", ["../x", "/x", "a/../../x", "C:x"])
def test_a_path_that_leads_out_of_a_target_is_refused(target: Target, path: str) -> None:
    for attempt in (
        lambda: target.put(path, b""),
        lambda: target.remove(path),
        lambda: target.below(path),
    ):
        with pytest.raises(FormatError, match="leads out of it"):
            attempt()


def _claim(arguments: tuple[Target, int]) -> bool:
    target, number = arguments
    return target.put("claims/one", f"claim {number}".encode(), create=True)


@pytest.mark.slow
def test_of_several_processes_that_create_one_object_one_succeeds(endpoint: str) -> None:
    target = target_of(f"s3://{BUCKET}/claims", **options_for(endpoint))
    with ProcessPoolExecutor(3, multiprocessing.get_context("forkserver")) as pool:
        assert sum(pool.map(_claim, [(target, number) for number in range(6)])) == 1


def test_a_create_only_put_whose_answer_is_lost_knows_its_own_object(faulty: FaultyServer) -> None:
    target = target_of(f"s3://{BUCKET}/lost", **options_for(faulty.url))
    faulty.reset(
        lambda number, method, path: "lose the answer" if method == "PUT" and number == 1 else None
    )
    assert target.put("lock", b"mine", create=True)
    assert faulty.requests["PUT"] == 2
    assert not target.put("lock", b"mine", create=True)


@pytest.mark.parametrize(
    "fault",
    [pytest.param(f, marks=[pytest.mark.slow] if f != "other range" else []) for f in FAULTS],
)
def test_a_whole_data_set_is_read_from_a_server_that_fails_now_and_then(
    published: Path, tmp_path: Path, endpoint: str, faulty: FaultyServer, fault: str
) -> None:
    url = f"s3://{BUCKET}/read {fault}"
    upload(published, f"{url}/data", **options_for(endpoint))
    upload(pack(published, tmp_path / "x.zarr").out, f"{url}/data.zarr", **options_for(endpoint))
    for kind in ("data", "data.zarr"):
        faulty.reset(every(10, fault, FAULTS[fault]))
        copy(carlasc.open(f"{url}/{kind}", **options_for(faulty.url)), FolderSink(tmp_path / kind))
        assert faulty.made[fault] >= 1
        assert files_of(tmp_path / kind) == files_of(published)


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=[pytest.mark.slow] if f != "503" else []) for f in FAULTS]
)
def test_a_whole_data_set_is_written_to_a_server_that_fails_now_and_then(
    published: Path, endpoint: str, faulty: FaultyServer, fault: str
) -> None:
    url = f"s3://{BUCKET}/write {fault}"
    faulty.reset(every(10, fault if FAULTS[fault] == "" else "lose the answer"))
    copy(carlasc.open(published), as_sink(url, **options_for(faulty.url)))
    assert faulty.made.total() >= 5
    assert files_in(target_of(url, **options_for(endpoint))) == files_of(published)


def failing(call: Callable[[], Any], kind: type[CarlascError]) -> str:
    """Return the one line of an error; neither it nor its traceback holds the key."""
    with pytest.raises(kind) as caught:
        call()
    shown = "".join(traceback.format_exception(caught.value)) + repr(caught.value)
    assert SECRET not in shown and "\n" not in str(caught.value)
    return str(caught.value)


def calls(target: Target) -> dict[str, Callable[[], Any]]:
    """Every kind of request; each of them with a fresh listing."""
    return {
        "read": lambda: target.tree.read("a"),
        "range": lambda: target.tree.read_range("a", 0, 10),
        "last": lambda: target.tree.read_range("a", -10, 0),
        "list": lambda: list(pickle.loads(pickle.dumps(target)).tree.entries()),
        "paths": lambda: list(target.paths()),
        "put": lambda: target.put("a", b"1"),
        "create": lambda: target.put("a", b"1", create=True),
    }


@pytest.mark.slow
def test_a_server_that_always_fails_is_one_line_after_a_bounded_time(faulty: FaultyServer) -> None:
    target = target_of(f"s3://{BUCKET}/never", **options_for(faulty.url))
    for name, call in calls(target).items():
        faulty.reset(lambda number, method, path: "503")
        began = time.perf_counter()
        message = failing(call, StorageError if name in ("put", "create") else CarlascError)
        assert (
            "s3://carlasc-tests/never" in message
            and "failed at each attempt, last with 503" in message
        )
        assert faulty.requests.total() == RemoteSettings().attempts, name
        assert time.perf_counter() - began < 5


def test_a_silent_server_is_one_line_after_a_bounded_time(
    faulty: FaultyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CARLASC_REMOTE_TIMEOUT_S", "0.2")
    monkeypatch.setenv("CARLASC_REMOTE_ATTEMPTS", "2")
    faulty.reset(lambda number, method, path: "silence")
    began = time.perf_counter()
    message = failing(
        lambda: RemoteTree(f"s3://{BUCKET}/x", options_for(faulty.url)).read("a"), CarlascError
    )
    assert "failed at each attempt" in message
    assert time.perf_counter() - began < 3


def test_access_that_is_refused_is_one_line_and_not_tried_again(faulty: FaultyServer) -> None:
    target = target_of(f"s3://{BUCKET}/private", **options_for(faulty.url))
    for name, call in calls(target).items():
        faulty.reset(lambda number, method, path: "403")
        message = failing(call, StorageError if name in ("put", "create") else CarlascError)
        assert "access was refused" in message and "check the credentials" in message, name
        assert faulty.requests.total() <= 2


def test_a_bucket_that_does_not_exist_is_one_line(endpoint: str) -> None:
    target = target_of("s3://no-such-bucket/x", **options_for(endpoint))
    for name, call in calls(target).items():
        message = failing(call, StorageError if name in ("put", "create") else MissingDataError)
        assert message.startswith("s3://no-such-bucket/x") and "found no such bucket" in message, (
            name
        )
    assert "no such bucket" in failing(
        lambda: carlasc.open("s3://no-such-bucket/x", **options_for(endpoint)), MissingDataError
    )


def test_missing_credentials_are_one_line(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    target = target_of(f"s3://{BUCKET}/x", endpoint_url=endpoint)
    for name, call in calls(target).items():
        assert "no credentials were found: set AWS_ACCESS_KEY_ID" in failing(call, CarlascError), (
            name
        )


def test_credentials_are_those_of_a_profile_in_the_home_folder(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    upload_bytes(endpoint, "profile/a", b"12345")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / ".aws").mkdir()
    (tmp_path / ".aws" / "credentials").write_text(
        f"[lab]\naws_access_key_id = {KEY}\naws_secret_access_key = {SECRET}\n"
    )
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    tree = RemoteTree(f"s3://{BUCKET}/profile", {"profile": "lab"})
    assert tree.read("a") == b"12345"


def test_an_option_that_the_store_does_not_know_is_named(endpoint: str) -> None:
    tree = RemoteTree(f"s3://{BUCKET}/x", {**options_for(endpoint), "bogus": 1})
    with pytest.raises(ArgumentError) as caught:
        tree.read("a")
    assert caught.value.where == "bogus"


def test_nothing_at_a_key_and_a_short_object_are_one_line(endpoint: str) -> None:
    tree = upload_bytes(endpoint, "short/a", b"12345").tree
    assert "short/b: expected a file, found nothing" in failing(
        lambda: tree.read("b"), MissingDataError
    )
    assert "expected 9 bytes in this range, found 4" in failing(
        lambda: tree.read_range("a", 1, 10), FormatError
    )
    assert "expected 3 bytes in this range, found 0" in failing(
        lambda: tree.read_range("a", 7, 10), FormatError
    )
    assert [bytes(part) for part in tree.read_ranges([("a", -2, 0), ("a", 1, 3), ("a", 2, 2)])] == [
        b"45",
        b"23",
        b"",
    ]


def upload_bytes(endpoint: str, path: str, data: bytes) -> RemoteTarget:
    folder, _, name = path.rpartition("/")
    target = RemoteTarget(f"s3://{BUCKET}/{folder}", options_for(endpoint))
    target.put(name, data)
    return target


def test_a_replaced_object_is_read_although_its_folder_was_listed_before(endpoint: str) -> None:
    target = upload_bytes(endpoint, "replaced/a", b"12345")
    tree = RemoteTree(f"s3://{BUCKET}/replaced", options_for(endpoint))
    assert tree.is_file("a")
    target.put("a", b"longer than before")
    assert tree.read("a") == b"longer than before"


def test_credentials_appear_neither_in_messages_nor_in_representations(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("DEBUG", "carlasc")
    signed = f"http://user:{SECRET}@127.0.0.1:9/data.zip?X-Amz-Signature={SECRET}&x=1"
    for call in (
        lambda: carlasc.open(signed),
        lambda: target_of(signed),
        lambda: carlasc.info(signed),
    ):
        message = failing(call, CarlascError)
        assert "http://127.0.0.1:9/data.zip" in message and "user" not in message
    target = target_of(f"s3://{BUCKET}/x", key="a key", secret=SECRET)
    tree = target.tree
    for thing in (
        target,
        tree,
        tree.client,
        FolderSink(target),
        FolderSink(target).sequence("a"),
        as_sink(target),
    ):
        assert SECRET not in repr(thing) and SECRET not in str(vars(thing).get("location", ""))
    assert SECRET not in caplog.text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("https://me:word@host/a?b=c: found", "https://host/a found"),
        ("s3://bucket/a.zip: found nothing?", "s3://bucket/a.zip: found nothing?"),
        ("'http://h/x?sig=a%2Fb&e=1' and http://h/y", "'http://h/x' and http://h/y"),
        ("a@b.c: no URL?x=1", "a@b.c: no URL?x=1"),
    ],
)
def test_urls_are_shown_without_credentials(text: str, shown: str) -> None:
    assert without_credentials(text) == shown


def test_a_folder_writer_knows_what_exists_and_what_it_has_written(
    published: Path, faulty: FaultyServer
) -> None:
    url = f"s3://{BUCKET}/known"
    upload(published, url, **options_for(faulty.url))
    sequence = carlasc.open(published).sequences()["Train/Town01_Light/cartesian"]
    writer = FolderSink(url, **options_for(faulty.url)).sequence("Train/Town01_Light/cartesian")
    faulty.reset(lambda number, method, path: None)
    frames = sequence.frames("points").tolist()
    assert all(writer.has("points", frame) for frame in frames) and not writer.has("points", 99)
    assert faulty.requests.total() == 1  # one listing
    writer.write("points", 99, sequence.read("points", frames[-1]))
    assert writer.has("points", 99) and faulty.requests.total() == 2
    assert np.array_equal(writer.read("points", 99), sequence.read("points", frames[-1]))
    assert writer.read_document("none.txt") is None
    writer.remove_grid("evaluation")
    left = {
        path for path in target_of(url, **options_for(faulty.url)).paths() if "/evaluation/" in path
    }
    assert not any(path.startswith("Train/Town01_Light/cartesian/") for path in left)


def test_the_last_field_of_a_frame_is_written_after_its_others(endpoint: str) -> None:
    put: list[list[str]] = []

    class Recorder(RemoteTarget):
        def put_many(self, *groups: Any) -> None:
            put.extend(map(sorted, groups))

        def below(self, folder: str) -> RemoteTarget:
            return self

    sink = FolderSink(Recorder(f"s3://{BUCKET}/order", options_for(endpoint)))
    points = np.zeros((2, 4), np.float32)
    fields = {
        "points": points,
        "labels": np.zeros(2, np.uint32),
        "flow": np.zeros((2, 3), np.float32),
    }
    sink.sequence("x").write_frames({0: fields, 1: {"points": points}})
    first, last = put
    assert [path.partition("/")[2] for path in last] == ["000000.txt", "000001.bin"] or len(
        last
    ) == 2
    assert len(first) == 2 and not set(first) & set(last)


@pytest.mark.parametrize("name", ["out.h5", "out.hdf5", "out.parquet"])
def test_a_store_of_one_file_is_not_written_to_an_object_store(name: str) -> None:
    with pytest.raises(ArgumentError, match=r"out: expected a \.zarr store, or a folder, .*upload"):
        as_sink(f"s3://bucket/{name}")


def test_sinks_are_of_the_kind_that_their_place_says(tmp_path: Path) -> None:
    sink = as_sink(tmp_path / "folder")
    assert isinstance(sink, FolderSink) and as_sink(sink) is sink
    assert type(as_sink(tmp_path / "out.zarr")).__name__ == "ZarrSink"
    remote = as_sink("memory://folder")
    assert isinstance(remote, FolderSink) and remote.location == "memory://folder"
    with raises(ArgumentError, found="a web server, which can only be read"):
        as_sink("https://host/folder")


def test_memory_is_for_one_process() -> None:
    check_shared("memory://x", Run(workers=1))
    check_shared("s3://x", Run(workers=8))
    with pytest.raises(ArgumentError, match=r"workers: expected 1 with memory://x, .* found 2"):
        check_shared("memory://x", Run(workers=2))


@pytest.mark.parametrize(
    ("name", "value"), [("REQUESTS", "many"), ("TIMEOUT_S", "0"), ("ATTEMPTS", "-1")]
)
def test_a_setting_that_is_not_a_positive_number_is_named(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(f"CARLASC_REMOTE_{name}", value)
    with pytest.raises(
        ArgumentError, match=f"CARLASC_REMOTE_{name}: expected a positive .*found '{value}'"
    ):
        RemoteTree("memory://x")


def test_a_remote_file_reads_as_a_local_one_in_few_requests() -> None:
    data = np.random.default_rng(0).integers(0, 256, 3_000_000).astype(np.uint8).tobytes()
    fetched: list[tuple[int, int]] = []

    def fetch(start: int, end: int) -> bytes:
        fetched.append((start, end))
        return data[start:end]

    file = RemoteFile(fetch, len(data))
    rng = np.random.default_rng(1)
    for start in rng.integers(0, len(data), 200).tolist():
        file.seek(start)
        assert file.read(1000) == data[start : start + 1000]
    assert len(fetched) <= 12 and file.seek(-5, 2) == len(data) - 5 and file.read() == data[-5:]
    whole = RemoteFile(fetch, len(data))
    fetched.clear()
    assert whole.read(len(data)) == data and len(fetched) == 1


def test_threads_share_one_connection(endpoint: str) -> None:
    tree = upload_bytes(endpoint, "threads/a", b"12345").tree
    with ThreadPoolExecutor(4) as pool:
        assert {
            id(found)
            for found in pool.map(lambda _: (tree.read("a"), tree.client.connection)[1], range(8))
        } == {id(tree.client.connection)}


@contextmanager
def _forked(target: Callable[[], bool]) -> Iterator[Any]:
    queue = multiprocessing.get_context("fork").SimpleQueue()
    process = multiprocessing.get_context("fork").Process(target=lambda: queue.put(target()))
    process.start()
    yield queue
    process.join(10)


@pytest.mark.posix("fork")
@pytest.mark.slow
def test_a_tree_is_read_on_both_sides_of_a_fork(endpoint: str) -> None:
    tree = upload_bytes(endpoint, "fork/a", b"12345").tree
    assert tree.read("a") == b"12345"

    def in_a_child_and_in_its_child() -> bool:
        with _forked(lambda: tree.read("a") == b"12345") as answer:
            return answer.get() and tree.read("a") == b"12345"

    for target in (lambda: tree.read("a") == b"12345", in_a_child_and_in_its_child):
        with _forked(target) as answer:
            assert answer.get()
    assert tree.read("a") == b"12345"


@pytest.mark.slow
def test_thousands_of_objects_are_listed_and_removed(endpoint: str) -> None:
    target = RemoteTarget(f"s3://{BUCKET}/many", options_for(endpoint))
    target.put_many({f"{number // 1500}/{number:05d}": b"x" for number in range(2100)})
    fresh = pickle.loads(pickle.dumps(target))
    assert len(fresh.tree.entries("0")) == 1500 and len(list(fresh.paths())) == 2100
    fresh.remove("0")
    assert len(list(fresh.paths())) == 600
