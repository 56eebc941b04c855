from __future__ import annotations

import gc
import re
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from helpers.datasets.sequences import files_of, write_dataset
from helpers.errors import raises
from helpers.servers.object_store import BUCKET, faulty_server, options_for, s3_server
from storage.transport.test_zipped import write_zip

import carlasc
from carlasc.errors import CarlascError, DependencyError, FormatError, MissingDataError
from carlasc.storage import Source, layout
from carlasc.storage.packing import pack
from carlasc.storage.transport.remote_tree import RemoteTarget
from carlasc.storage.transport.web import WebClient
from carlasc.testing import SourceContract
from carlasc.testing.data import WHOLE

for package in ("urllib3", "zarr", "h5py", "hdf5plugin", "pyarrow"):
    pytest.importorskip(package)


class RangeHandler(SimpleHTTPRequestHandler):
    """Python's file server with support for ranges; it counts the bytes that it sends."""

    sent = 0
    ranges = True

    def log_message(self, format: str, *args: object) -> None:
        pass

    def end_headers(self) -> None:
        if self.ranges:
            self.send_header("Accept-Ranges", "bytes")
        super().end_headers()

    def do_GET(self) -> None:
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        file = Path(self.translate_path(self.path))
        if not (wanted and self.ranges and file.is_file()):
            super().do_GET()
            return
        first, last = int(wanted[1]), int(wanted[2])
        whole = file.read_bytes()
        part = whole[first : last + 1]
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{first + len(part) - 1}/{len(whole)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        type(self).sent += len(part)
        self.wfile.write(part)


@pytest.fixture(scope="module")
def site(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[Path, str, type[RangeHandler]]]:
    """A folder, the URL it is served at, and the handler with its counter."""
    folder = tmp_path_factory.mktemp("site")
    handler = type("Handler", (RangeHandler,), {"sent": 0, "ranges": True})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder)))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield folder, f"http://127.0.0.1:{server.server_port}", handler
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def bucket() -> Iterator[tuple[str, dict[str, Any]]]:
    """An S3 bucket on this machine, and the options that reach it."""
    with s3_server() as endpoint:
        yield f"s3://{BUCKET}", options_for(endpoint)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


def put_in_memory(folder: Path, name: str) -> str:
    fs = fsspec.filesystem("memory")
    for path, data in files_of(folder).items():
        fs.pipe(f"/{name}/{path}", data)
    return f"memory://{name}"


class TestMemoryFolder(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(put_in_memory(published, folder.name))


class TestMemoryZip(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        data = write_zip(files_of(published), folder / "x.zip").read_bytes()
        fsspec.filesystem("memory").pipe(f"/{folder.name}.zip", data)
        return carlasc.open(f"memory://{folder.name}.zip")


class TestMemoryZarr(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(put_in_memory(pack(published, folder / "x.zarr").out, folder.name))


class TestMemoryHDF5(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        fsspec.filesystem("memory").pipe(
            f"/{folder.name}.h5", pack(published, folder / "x.h5").out.read_bytes()
        )
        return carlasc.open(f"memory://{folder.name}.h5")


class TestMemoryParquet(SourceContract):
    processes = ()

    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(put_in_memory(pack(published, folder / "x.parquet").out, folder.name))


class TestFileURL(SourceContract):
    processes = ("fork",)

    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(published.as_uri())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folder", "zip", "zarr", "h5", "parquet"])
def test_every_kind_is_read_over_http(
    published: Path, site: tuple[Path, str, type[RangeHandler]], kind: str
) -> None:
    folder, url, _ = site
    if kind == "folder":
        write_dataset(folder / "data")
    elif kind == "zip":
        write_zip(files_of(published), folder / "data.zip")
    else:
        pack(published, folder / f"data.{kind}")
    source = carlasc.open(f"{url}/data" if kind == "folder" else f"{url}/data.{kind}")
    here = carlasc.open(published).sequences()[WHOLE]
    sequence = source.sequences()[WHOLE]
    assert sequence.fields() == here.fields()
    for name in sorted(here.fields()):
        frames = here.frames(name).tolist()
        for found, wanted in zip(
            sequence.read_many(name, frames), here.read_many(name, frames), strict=True
        ):
            assert np.array_equal(found, wanted)
    assert sequence.read_document("carlasc.json") == here.read_document("carlasc.json")


class _Cell:
    """Something that only a collection frees."""

    def __init__(self, held: object) -> None:
        self.held, self.itself = held, self


@pytest.mark.timeout(60)
def test_garbage_that_h5py_must_free_does_not_stop_the_thread_that_h5py_waits_for(
    published: Path, site: tuple[Path, str, type[RangeHandler]], monkeypatch: pytest.MonkeyPatch
) -> None:
    h5py = pytest.importorskip("h5py")
    folder, url, _ = site
    pack(published, folder / "garbage.h5")
    ready, made = [h5py.h5t.NATIVE_DOUBLE.copy() for _ in range(200)], []

    get = WebClient.get

    def get_and_leave_garbage(*arguments: Any, **options: Any) -> bytes:
        _Cell(ready.pop())
        made[:] = [[] for _ in range(10_000)]  # so many new objects start a collection, if any may
        return get(*arguments, **options)

    monkeypatch.setattr(WebClient, "get", get_and_leave_garbage)
    source = carlasc.open(f"{url}/garbage.h5")
    assert source.sequences()[WHOLE].fields() == carlasc.open(published).sequences()[WHOLE].fields()
    assert made and gc.isenabled()


def test_a_member_of_a_zip_over_http_costs_its_own_bytes(
    tmp_path: Path, site: tuple[Path, str, type[RangeHandler]]
) -> None:
    folder, url, handler = site
    files = {f"velodyne/{frame:06d}.bin": bytes(160_000) for frame in range(60)}
    write_zip(files, folder / "big.zip")
    start = handler.sent
    (sequence,) = carlasc.open(f"{url}/big.zip").sequences().values()
    sequence.frames("points")
    before = handler.sent
    assert len(sequence.read("points", 30)) == 10_000
    assert 160_000 < handler.sent - before < 161_000
    assert before - start < 200_000  # the directory, and the end of the zip where it is looked for


def test_a_server_without_ranges_is_an_error_before_anything_is_fetched(
    published: Path, site: tuple[Path, str, type[RangeHandler]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, url, handler = site
    write_zip(files_of(published), folder / "other.zip")
    monkeypatch.setattr(handler, "ranges", False)
    with raises(
        CarlascError,
        where=r"other\.zip",
        expected="a server that supports range requests",
        advice="download",
    ):
        carlasc.open(f"{url}/other.zip")


def read_all(source: Source) -> dict[str, Any]:
    return {
        f"{path}/{name}/{frame}": bytes(layout.field_named(name).encode(array, name))
        for path, sequence in source.sequences().items()
        for name in sorted(sequence.fields())
        for frame, array in zip(
            sequence.frames(name).tolist(),
            sequence.read_many(name, sequence.frames(name).tolist()),
            strict=True,
        )
    }


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["503", "drop", "cut", "too long", "too short", "other range"])
def test_a_zip_is_read_from_a_web_server_that_fails_now_and_then(
    published: Path, site: tuple[Path, str, type[RangeHandler]], fault: str
) -> None:
    folder, url, _ = site
    write_zip(files_of(published), folder / "faulty.zip")
    with faulty_server(url) as server:
        # not the first one, by which a server without ranges is recognised
        server.reset(
            lambda number, method, path: (
                fault if number > 3 and number % 5 == 0 and method == "GET" else None
            )
        )
        assert read_all(carlasc.open(f"{server.url}/faulty.zip")) == read_all(
            carlasc.open(published)
        )
        assert server.made[fault] >= 3


@pytest.mark.parametrize("kind", ["zip", "zarr"])
def test_the_signature_of_a_url_is_sent_with_each_request_and_never_shown(
    published: Path,
    site: tuple[Path, str, type[RangeHandler]],
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
) -> None:
    folder, url, handler = site
    place = folder / f"signed.{kind}"
    if not place.exists():
        write_zip(files_of(published), place) if kind == "zip" else pack(published, place)
    answer = handler.do_GET

    def refuse_unsigned(self: RangeHandler) -> None:
        answer(self) if self.path.endswith("?sig=secret") else self.send_error(403)

    monkeypatch.setattr(handler, "do_GET", refuse_unsigned)
    source = carlasc.open(f"{url}/signed.{kind}?sig=secret")
    assert read_all(source) == read_all(carlasc.open(published))
    assert source.location == f"{url}/signed.{kind}" and "secret" not in repr(source)
    with pytest.raises(CarlascError, match=r"signed\.(zip|zarr).*: access was refused \(403\)"):
        carlasc.open(f"{url}/signed.{kind}?sig=wrong").sequences()


def test_nothing_at_a_url_is_missing_data(site: tuple[Path, str, type[RangeHandler]]) -> None:
    with raises(MissingDataError, where=r"absent\.zip", found="nothing"):
        carlasc.open(f"{site[1]}/absent.zip")


def test_a_server_that_does_not_answer_is_one_clear_error() -> None:
    with pytest.raises(CarlascError, match=r"127\.0\.0\.1:9/x\.zip: cannot be read"):
        carlasc.open("http://127.0.0.1:9/x.zip")


def test_an_unknown_scheme_is_one_clear_error() -> None:
    with pytest.raises(CarlascError, match="cannot be opened"):
        carlasc.open("gopher://x/y")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folder", "zip", "zarr"])
def test_every_kind_is_read_from_s3(
    published: Path, tmp_path: Path, bucket: tuple[str, dict[str, Any]], kind: str
) -> None:
    url, options = bucket
    target = RemoteTarget(url, options)
    if kind == "zip":
        target.put("data.zip", write_zip(files_of(published), tmp_path / "x.zip").read_bytes())
    else:
        root = published if kind == "folder" else pack(published, tmp_path / "x.zarr").out
        target.below(f"data.{kind}").put_many(files_of(root))
    sequence = carlasc.open(f"{url}/data.{kind}", **options).sequences()[WHOLE]
    here = carlasc.open(published).sequences()[WHOLE]
    assert sequence.fields() == here.fields()
    for name in sorted(here.fields()):
        frames = here.frames(name).tolist()
        for found, wanted in zip(
            sequence.read_many(name, frames), here.read_many(name, frames), strict=True
        ):
            assert np.array_equal(found, wanted)
    assert np.array_equal(sequence.poses, here.poses)


def test_a_corrupted_remote_chunk_names_field_and_frame(published: Path, tmp_path: Path) -> None:
    data = bytearray(pack(published, tmp_path / "x.h5").out.read_bytes())
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.h5") as file:
        info = file[WHOLE]["scans/points/xyz"].id.get_chunk_info(2)
    data[info.byte_offset + info.size // 2] ^= 1
    fsspec.filesystem("memory").pipe("/corrupted.h5", bytes(data))
    with pytest.raises(FormatError, match="field points, frame 5"):
        carlasc.open("memory://corrupted.h5").sequences()[WHOLE].read("points", 5)


@pytest.mark.parametrize(
    ("module", "make", "extra"),
    [
        ("urllib3", lambda _: "http://127.0.0.1:9/x.zip", "remote"),
        ("obstore", lambda _: "s3://bucket/x.zip", "remote"),
        ("numcodecs", lambda folder: folder / "x.zarr", "zarr"),
        ("google_crc32c", lambda folder: folder / "x.zarr", "zarr"),
        ("google_crc32c", lambda folder: folder / "x.h5", "hdf5"),
        ("h5py", lambda folder: folder / "x.h5", "hdf5"),
        ("pyarrow", lambda folder: folder / "x.parquet", "parquet"),
    ],
)
def test_a_missing_package_says_which_extra_brings_it(
    published: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    make: Any,
    extra: str,
) -> None:
    target = make(tmp_path)
    if isinstance(target, Path):
        pack(published / "Val", target)
    for name in [name for name in sys.modules if name == module or name.startswith(f"{module}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DependencyError, match=rf"\[{extra}\]"):
        carlasc.open(target)
