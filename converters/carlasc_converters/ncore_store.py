"""Stores of NCore, version 4: zarr hierarchies of version 2, in a folder or in a tar archive with
an index (.zarr.itar).

The format: https://nvidia.github.io/ncore/data/formats.html. An archive ends with a block with the
position of its index: names, positions and sizes of its members, as CBOR compressed by LZMA. The
metadata of a store are collected in one member, in the same form.
"""

from __future__ import annotations

import itertools
import lzma
import math
import struct
from collections.abc import Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc.storage.arrays import check_ratio, check_size
from carlasc_converters.files import COPY, Version, opening, read_bytes, version_of

SUFFIXES = (".zarr.itar", ".zarr")
_METADATA = ".zmetadata.cbor.xz"
_BLOCK = 512
_HEADER = struct.Struct("<4sIQI")  # magic, kind of index, its place, its size
_CBOR_LZMA = 1
_SIZES = {"blosc": 4, "lz4": 0}  # codecs, and where their chunks have their size: others have no
# bound, and that of pickles runs code
_MOST_CHUNKS = 1 << 20  # of an array
_STEP = 1 << 24  # bytes that are unpacked at once


class NcoreStore:
    """One store. It opens its file for each read, and keeps the index."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    @cached_property
    def _members(self) -> dict[str, tuple[int, int]]:
        """Place and size of each member of an archive by its name."""
        with opening(self.path, "an indexed tar archive of NCore"), self.path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - _BLOCK))
            block = file.read(_BLOCK)
            magic, kind, place, length = _HEADER.unpack(block[: _HEADER.size])
            if magic != b"itar" or place + length > size:
                raise FormatError(
                    self.path,
                    expected="an index at the end of the archive",
                    found="none",
                    advice=f"{COPY}, or write it again",
                )
            if kind != _CBOR_LZMA:
                raise FormatError(
                    self.path,
                    expected="an index of kind 1",
                    found=f"kind {kind}",
                    advice="upgrade carlasc",
                )
            file.seek(place)
            table = _unpacked(file.read(length), self.path)
            return dict(
                zip(
                    table["items"],
                    zip(table["offset_datas"], table["sizes"], strict=True),
                    strict=True,
                )
            )

    def _read(self, name: str) -> bytes | None:
        """Return the bytes of a member; None if it does not exist."""
        if self.path.is_dir():
            member = self.path / name
            return read_bytes(member) if member.is_file() else None
        if name not in self._members:
            return None
        place, size = self._members[name]
        with opening(self.path, f"{size} bytes of {name}"), self.path.open("rb") as file:
            end = file.seek(0, 2)
            file.seek(place)
            data = file.read(min(size, end))
        if len(data) < size:
            raise FormatError(
                self.path, expected=f"{size} bytes of {name}", found=len(data), advice=COPY
            )
        return data

    @cached_property
    def _metadata(self) -> dict[str, Any]:
        data = self._read(_METADATA)
        if data is None:
            raise MissingDataError(
                self.path,
                expected=f"metadata in {_METADATA}",
                found="none",
                advice="finish the store with NCore's writer",
            )
        with opening(self.path, "metadata of NCore"):
            metadata: dict[str, Any] = _unpacked(data, self.path)["metadata"]
        return metadata

    def attributes(self, group: str = "") -> dict[str, Any]:
        """Return the attributes of a group or an array; none if there are none."""
        attributes: dict[str, Any] = self._metadata.get(
            f"{group}/.zattrs" if group else ".zattrs", {}
        )
        return attributes

    def groups(self, parent: str) -> list[str]:
        """Return the sorted names of the groups in a group."""
        before = f"{parent}/"
        after = "/.zgroup"
        within = (key for key in self._metadata if key.startswith(before) and key.endswith(after))
        names = (key[len(before) : -len(after)] for key in within)
        return sorted(name for name in names if name and "/" not in name)

    def array(self, name: str) -> AnyArray:
        """Return a whole array.

        Raises:
            MissingDataError: the array does not exist.
            FormatError: a chunk is damaged, has another size, or its codec is unknown.
            DependencyError: numcodecs is not installed.
        """
        about = self._metadata.get(f"{name}/.zarray")
        if about is None:
            raise MissingDataError(
                f"{self.path}: {name}", expected="an array", found="none", advice=COPY
            )
        where = f"{self.path}: {name}"
        with opening(where, "an array of zarr version 2"):
            shape = tuple(about["shape"])
            chunks = tuple(about["chunks"])
            for size in (shape, chunks):
                check_size(size, np.dtype(about["dtype"]), where)
            values = np.full(shape, about["fill_value"] or 0, np.dtype(about["dtype"]))
            if about["order"] != "C" or about["filters"]:
                raise FormatError(
                    where,
                    expected="rows in order C without filters",
                    found=f"{about['order']}, {about['filters']}",
                )
            config = about["compressor"]
            codec = None
            if config is not None:
                if config["id"] not in _SIZES:
                    raise FormatError(where, expected="chunks of blosc", found=config["id"])
                codec = import_extra("numcodecs", "ncore").get_codec(config)
            counts = [-(-size // step) for size, step in zip(shape, chunks, strict=True)]
            if math.prod(counts) > _MOST_CHUNKS:
                expected = f"at most {_MOST_CHUNKS} chunks"
                raise FormatError(where, expected=expected, found=math.prod(counts))
            length = math.prod(chunks) * values.itemsize
            for index in itertools.product(*map(range, counts)):
                key = about.get("dimension_separator", ".").join(map(str, index)) or "0"
                data = self._read(f"{name}/{key}")
                if data is None:
                    continue  # an absent chunk holds the fill value only
                if codec is not None:
                    start = _SIZES[config["id"]]
                    found = int.from_bytes(data[start : start + 4], "little")
                    if found != length:
                        expected = f"a chunk of {length} bytes"
                        raise FormatError(where, expected=expected, found=f"one of {found}")
                raw = data if codec is None else codec.decode(data)
                part = np.frombuffer(raw, values.dtype).reshape(chunks)
                place = tuple(
                    slice(i * step, min((i + 1) * step, size))
                    for i, step, size in zip(index, chunks, shape, strict=True)
                )
                values[place] = part[tuple(slice(0, p.stop - p.start) for p in place)]
        return values


def open_store(path: str) -> NcoreStore:
    """Return a store; a process reads its index and metadata once, and again after the store
    changed.
    """
    file = Path(path)
    changed = file / _METADATA if file.is_dir() and (file / _METADATA).exists() else file
    return _open(path, version_of(changed, "a store of NCore"))


@lru_cache(maxsize=8)
def _open(path: str, version: Version) -> NcoreStore:
    return NcoreStore(path)


def _unpacked(data: bytes, where: Path) -> Any:
    decoder = lzma.LZMADecompressor()
    text = bytearray()
    packed = len(data)
    while not decoder.eof:
        part = decoder.decompress(data, _STEP)
        if not part and decoder.needs_input:
            raise ValueError("compressed data that end too early")
        text += part
        check_ratio(len(text), packed, str(where))
        data = b""
    return import_extra("cbor2", "ncore").loads(text)


def encode_store(groups: Mapping[str, Any]) -> bytes:
    """Return the metadata of a store without arrays, from the attributes of each group by its name,
    which ends in a slash, but for the root.
    """
    about = {f"{name}.zgroup": {"zarr_format": 2} for name in groups}
    about |= {f"{name}.zattrs": attributes for name, attributes in groups.items()}
    content = {"zarr_consolidated_format": 1, "metadata": about}
    return lzma.compress(import_extra("cbor2", "ncore").dumps(content))
