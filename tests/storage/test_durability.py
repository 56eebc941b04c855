from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.cli import app
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, StorageError
from carlasc.storage import field_files, files, layout
from carlasc.storage.files import to_json, write_atomic, write_many
from carlasc.storage.folder import FolderWriter

pytestmark = pytest.mark.posix("calls of the system are traced")

SPEC = GridSpec.published("cartesian")


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of what is synced, in order; of a file, with whether it has its final name yet."""
    found: list[str] = []
    sync = files._sync

    def note(descriptor: int) -> None:
        found.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        sync(descriptor)

    monkeypatch.setattr(files, "_sync", note)
    return found


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="needs Linux to name open files"
)


@needs_proc
def test_a_file_is_synced_before_it_gets_its_name_and_its_folder_after_that(
    tmp_path: Path, synced: list[str]
) -> None:
    write_atomic(tmp_path / "new" / "a.bin", b"abc")
    assert synced[0] == tmp_path.name  # the new folder's own name
    assert synced[1].startswith(".a.bin.")
    assert synced[2:] == ["new"]


@needs_proc
def test_several_files_are_synced_before_any_gets_its_name(
    tmp_path: Path, synced: list[str]
) -> None:
    (tmp_path / "x").mkdir()
    write_many({tmp_path / "a": b"1", tmp_path / "x" / "b": b"2"}, {tmp_path / "c": b"3"})
    assert [name.split(".")[1] for name in sorted(synced[:3])] == ["a", "b", "c"]
    assert sorted(synced[3:5]) == sorted([tmp_path.name, "x"])
    assert synced[5:] == [tmp_path.name]
    assert [(tmp_path / name).read_bytes() for name in ("a", "x/b", "c")] == [b"1", b"2", b"3"]


def test_the_temporary_name_of_a_new_file_is_gone_before_its_folder_is_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    monkeypatch.setattr(
        files, "_sync", lambda _: names.append(",".join(path.name for path in tmp_path.iterdir()))
    )
    assert write_atomic(tmp_path / "a", b"1", create=True)
    assert names[-1] == "a"


@needs_proc
def test_a_file_that_is_removed_stays_removed(tmp_path: Path, synced: list[str]) -> None:
    (tmp_path / "mark.json").write_bytes(b"{}")
    files.remove_file(tmp_path / "mark.json")
    files.remove_file(tmp_path / "never.json")
    assert not list(tmp_path.iterdir())
    assert synced == [tmp_path.name]


def test_nothing_is_synced_where_it_is_turned_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, synced: list[str]
) -> None:
    monkeypatch.setenv(files.DURABLE, "no")
    write_atomic(tmp_path / "a", b"1")
    write_many({tmp_path / "b": b"1", tmp_path / "c": b"1"})
    assert synced == []


def test_another_value_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(files.DURABLE, "perhaps")
    with raises(ArgumentError, where="CARLASC_DURABLE", expected="yes or no", found="'perhaps'"):
        files.is_durable()


def test_the_option_reaches_worker_processes_through_the_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(files.DURABLE, "yes")
    with pytest.raises(SystemExit):
        app(["--no-durable", "stats", "nowhere"])
    assert os.environ[files.DURABLE] == "no"


def test_a_disk_that_fails_while_files_are_synced_is_an_error_that_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files, "_sync", fail)
    with pytest.raises(StorageError, match=r"[ab]\.bin: cannot be written: Input/output error"):
        write_many({tmp_path / "a.bin": b"1", tmp_path / "b.bin": b"2"})
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_that_cannot_sync_folders_is_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync = files._sync

    def refuse_folders(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):  # noqa: PTH112
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(descriptor)

    monkeypatch.setattr(files, "_sync", refuse_folders)
    write_atomic(tmp_path / "a", b"1")
    assert (tmp_path / "a").read_bytes() == b"1"


def _write_frame(folder: Path) -> FolderWriter:
    writer, rng = FolderWriter(folder), np.random.default_rng(0)
    writer.write_document(layout.params_file("grid"), to_json(SPEC.to_params(11)))
    for name, array in {
        "points": rng.random((5, 4), np.float32),
        "labels": np.ones(5, np.uint32),
        "flow": rng.random((5, 3), np.float32),
        "grid/labels": np.zeros(SPEC.size, np.uint32),
        "grid/counts": np.zeros(SPEC.size, np.float32),
        "grid/occupied": np.zeros(SPEC.size, np.float16),
        "grid/flags": np.zeros(SPEC.size, np.uint8),
        "grid/views": np.zeros(SPEC.size, np.uint16),
        "grid/votes": np.ones(3, field_files.VOTES_DTYPE),
        "bev": np.ones(9, np.uint8),
    }.items():
        writer.write(name, 0, array)
    return writer


FIELDS = (
    "points",
    "labels",
    "flow",
    "bev",
    *(f"grid/{part}" for part in ("labels", "counts", "occupied", "flags", "views", "votes")),
)


@pytest.mark.parametrize("name", FIELDS)
def test_a_file_that_is_empty_or_short_is_missing(tmp_path: Path, name: str) -> None:
    writer = _write_frame(tmp_path)
    assert writer.has(name, 0)
    path = tmp_path / layout.field_named(name).file(0)
    whole = path.read_bytes()
    for cut in {0} if name == "bev" else {0, 1, len(whole) // 2, len(whole) - 1}:
        path.write_bytes(whole[:cut])
        assert not writer.has(name, 0), cut
    path.write_bytes(whole)
    assert writer.has(name, 0)


def test_a_scan_and_its_labels_must_have_as_many_rows(tmp_path: Path) -> None:
    writer = _write_frame(tmp_path)
    path = tmp_path / layout.field_named("points").file(0)
    path.write_bytes(path.read_bytes()[:-16])  # four points instead of five
    assert not any(writer.has(name, 0) for name in ("points", "labels", "flow"))
    assert writer.has("grid/labels", 0)


def test_an_empty_text_file_is_no_text_file(tmp_path: Path) -> None:
    writer = FolderWriter(tmp_path)
    (tmp_path / layout.POSES).write_bytes(b"")
    assert writer.read_document(layout.POSES) is None
    assert writer.create_document(layout.POSES, b"1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert not writer.create_document(layout.POSES, b"other")
    assert writer.read_document(layout.POSES) == b"1 0 0 0 0 1 0 0 0 0 1 0\n"
