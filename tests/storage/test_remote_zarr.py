"""Zarr stores in an object store: written by several sinks, finished, read with few requests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.sequences import files_of
from helpers.errors import raises
from helpers.servers.object_store import (
    BUCKET,
    FaultyServer,
    environment_for,
    every,
    faulty_server,
    options_for,
    s3_server,
)
from storage.test_block_tables import FRAMES, PATH, arrays_of, start_sink, write_block

import carlasc
from carlasc import Run
from carlasc.errors import ConflictError
from carlasc.storage.copying import unpack
from carlasc.storage.packing import pack
from carlasc.storage.transport.remote_tree import RemoteTarget, target_of
from carlasc.storage.transport.trees import LocalTarget, Target
from carlasc.storage.zarr.zarr_finish import finish
from carlasc.storage.zarr.zarr_sink import ZarrSink

for package in ("obstore", "numcodecs", "google_crc32c"):
    pytest.importorskip(package)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with s3_server() as url:
        yield url


@pytest.fixture(scope="module")
def server(endpoint: str) -> Iterator[FaultyServer]:
    with pytest.MonkeyPatch.context() as patch, faulty_server(endpoint) as found:
        for name, value in environment_for(found.url).items():
            patch.setenv(name, value)
        yield found


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store on this machine."""
    out = tmp_path_factory.mktemp("reference") / "x.zarr"
    write(LocalTarget(out))
    return out


def write(target: Target) -> None:
    """Write a store by two sinks that know nothing of each other."""
    writers = [start_sink(ZarrSink(target)) for _ in range(2)]
    for number, block in enumerate((2, 0, 1, 1)):
        write_block((writers[number % 2], block))
    finish(target)


def files_in(target: Target) -> dict[str, bytes]:
    paths = sorted(target.paths())
    return {
        path: bytes(data) for path, data in zip(paths, target.tree.read_many(paths), strict=True)
    }


@pytest.mark.parametrize("fault", [None, "503", "drop"])
@pytest.mark.slow
def test_a_store_in_a_bucket_has_the_files_of_one_on_disk(
    server: FaultyServer, reference: Path, tmp_path: Path, fault: str | None
) -> None:
    target = RemoteTarget(f"s3://{BUCKET}/{tmp_path.name}.zarr")
    if fault is not None:
        server.reset(every(10, fault))
    try:
        write(target)
    finally:
        made = server.made[fault or ""]
        server.reset(lambda number, method, path: None)
    assert bool(made) == (fault is not None)
    assert files_in(target) == files_of(reference)


def test_a_bucket_store_is_read_with_few_requests(
    server: FaultyServer, reference: Path, tmp_path: Path
) -> None:
    target = RemoteTarget(f"s3://{BUCKET}/{tmp_path.name}.zarr")
    target.put_many(files_of(reference))
    server.reset(lambda number, method, path: None)
    sequence = carlasc.open(target.location).sequences()[PATH]
    assert all(len(sequence.frames(name)) for name in sequence.fields())
    assert server.requests.total() <= 8, server.requests
    server.reset(lambda number, method, path: None)
    found = sequence.read_many("points", range(32))
    assert all(
        np.array_equal(array, arrays_of(frame)["points"]) for frame, array in enumerate(found)
    )
    columns, shards, chunks = 2, 2, 32 + 7
    assert server.requests.total() <= columns * shards + chunks, server.requests
    server.reset(lambda number, method, path: None)
    sequence.read("points", 0)
    assert server.requests.total() == 1, server.requests  # the indices of the shards are kept


@pytest.mark.slow
def test_packing_to_a_bucket_and_back(
    server: FaultyServer, reference: Path, tmp_path: Path
) -> None:
    out = f"s3://{BUCKET}/{tmp_path.name}.zarr"
    there, here = (
        pack(reference, out, run=Run(workers=1)),
        pack(reference, tmp_path / "x.zarr", run=Run(workers=1)),
    )
    assert there.out == out
    assert (there.stored_bytes, there.published_bytes) == (here.stored_bytes, here.published_bytes)
    assert files_in(RemoteTarget(out)) == files_of(tmp_path / "x.zarr")
    with raises(ConflictError, where=r"\.zarr", expected="a new path", found="a finished store"):
        pack(reference, out)
    assert len(pack(reference, out, overwrite=True, run=Run(workers=1)).sequences) == 1
    assert files_in(RemoteTarget(out)) == files_of(tmp_path / "x.zarr")
    with raises(ConflictError, expected="a path outside"):
        pack(out, f"{out}/inside.zarr")
    unpack(out, tmp_path / "files", run=Run(workers=1))
    sequence = carlasc.open(tmp_path / "files").sequences()[PATH]
    assert np.array_equal(sequence.read("points", FRAMES - 1), arrays_of(FRAMES - 1)["points"])


def test_nothing_but_a_store_is_written_to(server: FaultyServer, tmp_path: Path) -> None:
    target = RemoteTarget(f"s3://{BUCKET}/{tmp_path.name}.zarr")
    target.put("photo.jpg", b"1")
    for overwrite in (False, True):
        with pytest.raises(
            ConflictError, match=r"expected a new path, or a packed store, found photo\.jpg"
        ):
            ZarrSink(target, overwrite=overwrite)
    assert files_in(target) == {"photo.jpg": b"1"}


def test_options_of_a_url_are_used(endpoint: str, tmp_path: Path) -> None:
    options: dict[str, Any] = options_for(endpoint)
    target = target_of(f"s3://{BUCKET}/{tmp_path.name}.zarr", **options)
    writer = ZarrSink(target).sequence(PATH)
    writer.write("points", 3, arrays_of(1)["points"])
    writer.close()
    finish(target)
    sequence = carlasc.open(target.location, **options).sequences()[PATH]
    assert np.array_equal(sequence.read("points", 3), arrays_of(1)["points"])
