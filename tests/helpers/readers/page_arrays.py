"""Reading the arrays of a page's frame, as its scripts do."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


def unpack_arrays(block: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a block that `pack_arrays` made."""
    data = zlib.decompress(block)
    (length,) = struct.unpack_from("<I", data)
    start, arrays = 4 + length, {}
    for name, dtype, size in json.loads(data[4:start]):
        item = np.dtype(dtype).newbyteorder("<")
        planes = np.frombuffer(data, np.uint8, size * item.itemsize, start).reshape(
            item.itemsize, size
        )
        arrays[name] = np.ascontiguousarray(planes.T).reshape(-1).view(item)
        start += size * item.itemsize
    return arrays
