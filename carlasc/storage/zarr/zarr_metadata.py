"""The metadata of zarr v3: what describes the nodes of a store to carlasc and to other programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from carlasc.storage.packed.chunks import BITSHUFFLE, BLOCK, NO_SHUFFLE, SHUFFLE, Encoding

METADATA = "zarr.json"
_SHUFFLES = {"noshuffle": NO_SHUFFLE, "shuffle": SHUFFLE, "bitshuffle": BITSHUFFLE}
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}


def group_metadata(attributes: Mapping[str, Any], nodes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the metadata of a group.

    Args:
        attributes: the group's attributes.
        nodes: the metadata of all nodes below it, by path, which are then consolidated in it.
    """
    metadata: dict[str, Any] = {"attributes": dict(attributes), "zarr_format": 3, "node_type": "group"}
    if nodes is not None:
        metadata["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": dict(nodes)}
    return metadata


def array_metadata(
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    encoding: Encoding,
    attributes: Mapping[str, Any],
    shard: tuple[int, ...] | None = None,
) -> dict[str, Any]:
    """Return the metadata of an array.

    Args:
        dtype: type of its elements.
        shape: its shape.
        chunk: shape of a chunk.
        encoding: how a chunk becomes bytes; its crc32c follows.
        attributes: the array's attributes.
        shard: shape of a shard; None for an array without shards.
    """
    codecs = codecs_of(encoding, dtype)
    if shard is not None:
        sharding = {
            "chunk_shape": list(chunk),
            "codecs": codecs,
            "index_codecs": [_LITTLE, _CRC],
            "index_location": "start",
        }
        codecs = [{"name": "sharding_indexed", "configuration": sharding}]
    return {
        "attributes": dict(attributes),
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(shard or chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0.0 if dtype.kind == "f" else 0,
        "codecs": codecs,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def codecs_of(encoding: Encoding, dtype: np.dtype[Any]) -> list[dict[str, Any]]:
    """Return the codecs of a chunk: those of its encoding, and crc32c."""
    if encoding.codec == "pcodec":
        return [{"name": "numcodecs.pcodec", "configuration": {"level": encoding.level}}, _CRC]
    shuffle = next(name for name, number in _SHUFFLES.items() if number == encoding.shuffle)
    blosc = {
        "typesize": dtype.itemsize,
        "cname": "zstd",
        "clevel": encoding.level,
        "shuffle": shuffle,
        "blocksize": BLOCK,
    }
    return [_LITTLE if dtype.itemsize > 1 else {"name": "bytes"}, {"name": "blosc", "configuration": blosc}, _CRC]


def encoding_of(codecs: list[dict[str, Any]]) -> Encoding:
    """Return the encoding that the (inner) codecs in an array's metadata describe.

    Raises:
        ValueError: they are not those of an `Encoding`.
    """
    names = [codec["name"] for codec in codecs]
    if names == ["numcodecs.pcodec", "crc32c"]:
        return Encoding("pcodec", codecs[0]["configuration"]["level"])
    if names == ["bytes", "blosc", "crc32c"] and codecs[0].get("configuration", {}).get("endian", "little") == "little":
        settings = codecs[1]["configuration"]
        return Encoding("blosc", settings["clevel"], _SHUFFLES[settings["shuffle"]])
    raise ValueError(f"codecs {', '.join(names)}")
