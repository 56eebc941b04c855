"""Hostile files: folders of the layout, captures, zips, and names in them."""

from __future__ import annotations

import io
import json
import os
import shutil
import stat
import struct
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from helpers.datasets.captures import write_capture

from carlasc.testing import write_dataset
from faults.hostile import Case

GRIDS = "Test/Town10_Medium/cylindrical"
SCANS = "Train/Town01_Light/cartesian"
VOTES = f"{GRIDS}/evaluation/000004.votes.npz"
DEEP = b"[" * 100_000 + b"]" * 100_000
DEEP_OBJECT = b'{"a":' * 100_000 + b"1" + b"}" * 100_000
ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202e"
HTML = "<script>alert(1)</script><img src=x onerror=alert(1)>"
LEADING_OUT = (
    "../victim.txt",
    "Val/../../victim.txt",
    "/{place}/victim.txt",
    "..\\victim.txt",
    "C:victim.txt",
    "C:\\x",
    "a/..",
)


def cases(base: Path) -> Iterator[Case]:
    """Yield the cases; what they are made from is written to `base`."""
    write_dataset(base / "data")
    write_capture(base / "drive" / "Town01" / "cartesian", frames=2, points=50)
    yield from _arrays(base)
    yield from _documents(base)
    yield from _captures(base)
    yield from _zips(base)
    yield from names(base)


Content = bytes | Callable[[], bytes]
"""The bytes of a file, or what makes them, where that takes long."""


def made(content: Content) -> bytes:
    """Return the bytes."""
    return content if isinstance(content, bytes) else content()


def put(path: Path, content: Content) -> None:
    """Write a file."""
    path.write_bytes(made(content))


def edit(
    base: Path, name: str, change: Callable[[Path], object], copy: str = "data"
) -> Callable[[Path], None]:
    """Return a function that puts a copy of `base/<copy>` into a folder, and changes the file
    `name` in it.
    """

    def make(work: Path) -> None:
        shutil.copytree(base / copy, work / copy)
        (work / copy / name).parent.mkdir(parents=True, exist_ok=True)
        change(work / copy / name)

    return make


def npz(members: dict[str, bytes], *, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip of .npy files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return buffer.getvalue()


def npy(array: Any = None, *, header: str = "", values: bytes = b"") -> bytes:
    """Return a .npy file of an array, or one with a header of the caller's choice."""
    if header:
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + values
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def header(dtype: str, shape: object) -> str:
    """Return the text of the header of a .npy file."""
    return f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape}, }}\n"


class Runs:
    """An object whose pickle creates a file when it is read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("../pickle-was-run",)


def zeros(name: str, shape: int, size: int) -> bytes:
    """Return an .npz of 8 MB or less that unpacks to `size` zeros, whose header claims `shape` of
    them.
    """
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as made,
        made.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        member.write(npy(header=header("|u1", (shape,))))
        for _ in range(size >> 24):
            member.write(bytes(1 << 24))
    return buffer.getvalue()


def _arrays(base: Path) -> Iterator[Case]:
    good = {
        "voxel": npy(np.zeros(3, "<i4")),
        "label": npy(np.ones(3, "u1")),
        "votes": npy(np.ones(3, "<u2")),
    }
    pickled = npy(np.array([Runs()], object))
    table = {
        "claims more than it unpacks to": npz(
            good | {"label": npy(header=header("|u1", (10**15,)))}
        ),
        "claims as much as it unpacks to, 1 GB": partial(zeros, "label", 1 << 30, 1 << 30),
        "unpacks to 1 GB and claims little": partial(zeros, "label", 10, 1 << 30),
        "has a pickle": npz(good | {"label": pickled}),
        "has a pickle in a structure": npz(
            good | {"label": npy(header=header("O", (3,)), values=b"cos\nmkdir\n(V../x\ntR.")}
        ),
        "has a broken header": npz(good | {"label": npy(header="{'descr': '|u1', 'shape': (3")}),
        "has a deep header": npz(good | {"label": npy(header="(" * 9000)}),
        "has a header that is code": npz(
            good | {"label": npy(header="__import__('os').mkdir('../header-was-run')")}
        ),
        "has a negative shape": npz(good | {"label": npy(header=header("|u1", (-3,)))}),
        "is packed by LZMA": npz(good, method=zipfile.ZIP_LZMA),
        "is a bomb packed by bzip2": npz({"label": bytes(1 << 26)}, method=zipfile.ZIP_BZIP2),
        "is cut short": npz(good)[:-30],
        "is no zip": b"PK nonsense",
        "has columns of other lengths": npz(good | {"voxel": npy(np.zeros(4, "<i4"))}),
    }
    for name, content in table.items():
        yield Case(
            f"votes.npz {name}",
            edit(base, VOTES, partial(put, content=content)),
            "pack data out.zarr",
            "000004.votes.npz",
        )

    def huge(path):
        return path.write_bytes(np.full(path.stat().st_size // 4, 2**32 - 1, "<u4").tobytes())

    for command in (
        "stats data",
        "report data",
        "render data -o out.png --size 64x64",
        "export kitti data out",
        "view data -o out.html",
    ):
        for file in (f"{SCANS}/labels/000002.label", f"{SCANS}/evaluation/000002.label"):
            yield Case(
                f"{Path(file).parent.name} of 2^32 - 1 in {command.split()[0]}",
                edit(base, file, huge),
                command,
                harmless=True,
            )
    yield from _numbers(base)
    linked = lambda path: (path.unlink(), path.symlink_to("/dev/zero"))  # noqa: E731
    yield Case(
        "a scan is a link to an endless device",
        edit(base, f"{SCANS}/velodyne/000002.bin", linked),
        "pack data out.zarr",
        "000002.bin",
    )
    fifo = lambda path: (path.unlink(), os.mkfifo(path))  # noqa: E731
    yield Case(
        "a scan is a pipe that nobody writes",
        edit(base, f"{SCANS}/velodyne/000002.bin", fifo),
        "pack data out.zarr",
        "000002.bin",
    )


def _numbers(base: Path) -> Iterator[Case]:
    """Numbers that compiled code and drawings would take for places and times."""
    huge = {"NaN": float("nan"), "infinity": float("inf"), "1e38": 1e38, "-1e38": -1e38}
    commands = (
        "regrid data --observe scans --name merged --size 8,8,4 --frames 0:3",
        "render data -o out.png --size 64x64", "view data -o out.html", "export kitti data out", "validate data",
    )  # fmt: skip
    line = "1 0 0 {0} 0 1 0 {0} 0 0 1 0\n"
    for command in commands:
        for name, value in huge.items():

            def fill(path, value=value):
                return path.write_bytes(np.full(path.stat().st_size // 4, value, "<f4").tobytes())

            verb = command.split()[0]
            yield Case(
                f"points of {name} in {verb}",
                edit(base, f"{SCANS}/velodyne/000002.bin", fill),
                command,
                harmless=True,
            )
            poses = partial(
                put,
                content=(
                    line.format(0) + line.format(value * 1e260 if name[-1] == "8" else value) * 9
                ).encode(),
            )
            yield Case(
                f"poses of {name} in {verb}",
                edit(base, f"{SCANS}/poses.txt", poses),
                command,
                harmless=True,
            )
        ones = lambda path: path.write_bytes(b"\xff" * path.stat().st_size)  # noqa: E731
        yield Case(
            f"boxes of ones in {verb}",
            edit(base, f"{SCANS}/boxes/000005.bin", ones),
            command,
            harmless=True,
        )


def _documents(base: Path) -> Iterator[Case]:
    spec = json.loads((base / "data" / GRIDS / "evaluation" / "params.json").read_text())
    many = json.dumps(spec | {"grid_size": [2000, 2000, 500]}).encode()
    for command in (
        "validate data", "stats data", "report data", "info data", "pack data out.zarr", "render data -o out.png", "view data -o out.html",
        "evaluate data data",
    ):  # fmt: skip
        place = f"{GRIDS}/evaluation/params.json"
        yield Case(
            f"params.json of 2 * 10^9 voxels in {command}",
            edit(base, place, partial(put, content=many)),
            command,
            harmless=True,
        )
    table = {
        "carlasc.json": [("nested arrays", DEEP), ("nested objects", DEEP_OBJECT), ("a number of "
                                                                                    "5,000 digits", b'{"format": ' + b"9" * 5000 + b"}"), ("an infinite range", b'{"min_range_m": -Infinity}'), ("bytes", bytes(range(256))), ("deep classes", b'{"classes": ' + DEEP_OBJECT + b"}"), ("classes of other types", b'{"classes": {"name": [1], "names": {"x": {}}, "colors": 7}}'), ("nothing", b"")],
        "evaluation/params.json": [
            (what, json.dumps(spec | change).encode())
            for what, change in {
                "a huge grid": {"grid_size": [1e300, 1e300, 1e300]}, "an infinite grid": {"grid_size": [float("inf")] * 3}, "a NaN": {"grid_size": [float("nan")] * 3}, "a number of 400 digits": {"min_bound": [10**400, 0, 0]}, "text": {"max_bound": "abc"}, "objects": {"grid_size": [{}, {}, {}]}, "no numbers": {"grid_size": None}, "a record of another type": {"carlasc": {"format": [], "classes": [[]]}},
            }.items()
        ],
        "poses.txt": [("a billion digits", b"1e" + b"9" * 5000 + b" 0" * 11), ("bytes", bytes(range(256)))],
    }  # fmt: skip
    for file, entries in table.items():
        for what, content in entries:
            change = lambda path, content=content: path.write_bytes(content)  # noqa: E731
            place = f"{GRIDS}/{file}" if "/" in file else f"{SCANS}/{file}"
            command = "pack data out.h5" if file == "evaluation/params.json" else "validate data"
            yield Case(
                f"{file} with {what}",
                edit(base, place, change),
                command,
                harmless=command == "validate data" or "record" in what,
            )


def _captures(base: Path) -> Iterator[Case]:
    points = "Town01/cartesian/raw/velodyne0/100.npy"
    table = {
        "has a pickle": npy(np.array([Runs()], object)),
        "has a broken header": npy(header="{'descr': '<f4', 'shape': (3"),
        "has a deep header": npy(header="-" * 9000 + "1"),
        "claims 10^15 points": npy(header=header("<f4", (10**15, 3)), values=bytes(120)),
        "has negative numbers of points": npy(header=header("<f4", (-10, 3)), values=bytes(120)),
        "has a dictionary of types": npy(header="{'descr': {'names': ['a'], 'formats': ['O']}, "
                                                "'fortran_order': False, 'shape': (1, 3), }"),
    }  # fmt: skip
    for name, content in table.items():
        change = lambda path, content=content: path.write_bytes(content)  # noqa: E731
        yield Case(
            f"an array of a capture {name}",
            edit(base, points, change, "drive"),
            "regrid drive -o out --size 8,8,4 --workers 1",
            "100.npy",
        )

    def times(path):
        return path.write_text("9" * 6000 + ", Timestamp(frame=1, elapsed_seconds=1e1e1)\n")

    yield Case(
        "times of a capture with 6,000 digits",
        edit(base, "Town01/cartesian/raw/times0.txt", times, "drive"),
        "info drive",
        harmless=True,
    )


def archive(members: dict[str, bytes], base: Path | None = None) -> bytes:
    """Return a zip with members of any name: `zipfile` writes them as they are."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in members.items():
            member = zipfile.ZipInfo("x")
            member.filename = name
            made.writestr(member, content)
    return buffer.getvalue()


def link_zip(target: str) -> bytes:
    """Return a zip of a symbolic link."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as made:
        member = zipfile.ZipInfo("Val/link")
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        made.writestr(member, target)
    return buffer.getvalue()


def scans_zip(extra: dict[str, bytes]) -> bytes:
    """Return a zip of a sequence of two scans, and other members."""
    return archive(
        {f"Val/Town07_Light/cartesian/velodyne/{k:06d}.bin": bytes(160) for k in range(2)} | extra
    )


def overwritten(data: bytes, offset: int, value: bytes) -> bytes:
    """Return a zip with other bytes in the last record of its central directory."""
    changed = bytearray(data)
    place = data.rindex(b"PK\x01\x02") + offset
    changed[place : place + len(value)] = value
    return bytes(changed)


def bomb_zip(size: int) -> bytes:
    """Return a zip whose second scan unpacks to zeros, 1,000 times as large as the zip."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as made:
        made.writestr("Val/Town07_Light/cartesian/velodyne/000000.bin", bytes(160))
        with made.open(
            "Val/Town07_Light/cartesian/velodyne/000001.bin", "w", force_zip64=True
        ) as member:
            for _ in range(size >> 24):
                member.write(bytes(1 << 24))
    return buffer.getvalue()


def hostile_zips() -> dict[str, Content]:
    """Return zips that are refused, whether they are extracted or read in place."""
    found = {f"a member {name!r}": scans_zip({name: b"theirs"}) for name in LEADING_OUT}
    last = scans_zip({"Val/Town07_Light/cartesian/velodyne/000002.bin": bytes(160)})
    return found | {
        "a bomb": partial(bomb_zip, 1 << 30),
        "an encrypted member": overwritten(last, 8, b"\x01\x00"),
        "a member packed by an unknown method": overwritten(last, 10, b"\x63\x00"),
        "a member with another checksum": overwritten(last, 16, b"oops"),
        "a member that claims 4 GB": overwritten(last, 24, b"\xfe\xff\xff\xff"),
        "a member beyond the end": overwritten(last, 42, b"\xf0\xff\xff\x7f"),
    }


def _zips(base: Path) -> Iterator[Case]:
    def put_zip(work: Path, content: Content) -> None:
        (work / "x.zip").write_bytes(made(content).replace(b"/{place}", str(work).encode()))

    for name, content in hostile_zips().items():
        make = partial(put_zip, content=content)
        yield Case(f"a zip read in place with {name}", make, "pack x.zip out.zarr", "x.zip")
    tail = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 65535, 65535, 0xFFFFFFFE, 0, 0)
    beyond = partial(put_zip, content=b"PK\x03\x04" + bytes(60) + tail)
    yield Case("a zip with a directory of 4 GB", beyond, "info x.zip", "x.zip")
    number = scans_zip({f"Val/Town07_Light/cartesian/velodyne/{'9' * 5000}.bin": bytes(160)})
    long = partial(put_zip, content=number)
    yield Case("a zip with a frame number of 5,000 digits", long, "info x.zip", harmless=True)


def names(base: Path) -> Iterator[Case]:
    """Yield the cases of names; they need a data set in `base`."""

    def name_it(name: str) -> Callable[[Path], None]:
        def make(work: Path) -> None:
            folder = work / "data" / "Train" / name / "cartesian"
            shutil.copytree(base / "data" / SCANS, folder)
            about = {"format": 2, "sensor": name, "source": name}
            classes = {
                "name": name,
                "names": {"0": "free", **{str(k): f"{name}{HTML}{k}" for k in range(1, 30)}},
                "colors": {str(k): [255, 8 * k, 0] for k in range(30)},
            }
            (folder / "carlasc.json").write_text(json.dumps(about | {"classes": classes}))

        return make

    for kind, name in {
        "terminal codes": ESCAPE,
        "HTML": HTML.replace("/", ""),
        "markup": "[/bold][red]",
    }.items():
        for command in (
            "info data",
            "validate data",
            "stats data",
            "unpack data out",
            "pack data out.h5",
        ):
            yield Case(
                f"names with {kind} in {command.split()[0]}", name_it(name), command, harmless=True
            )
    for command in (
        "view data -o out.html --frames 2:6",
        "stats data --plot out.svg",
        "report data --html out.html",
    ):
        yield Case(
            f"names with HTML in {command}",
            name_it(HTML.replace("/", "")),
            command,
            harmless=True,
            forbidden=(b"<script>alert", b"<img src=x"),
        )
    undecodable = os.fsdecode(b"Town\xff\xfe01")
    yield Case("a folder whose name is not UTF-8", name_it(undecodable), "info data", harmless=True)
