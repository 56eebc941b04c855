"""Arrays of .npz files. No pickle is read."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError


def read_arrays(path: str | Path, names: tuple[str, ...], advice: str) -> list[NDArray[Any]]:
    """Return some arrays of an .npz file, in the order of their names.

    Args:
        path: the file.
        names: names of arrays that it must have.
        advice: what to do if the file is missing or incomplete.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is no .npz file, is damaged, or lacks an array.
    """
    expected = f"an .npz file with {', '.join(names)}"
    try:
        with Path(path).open("rb") as file:
            if not zipfile.is_zipfile(file):  # numpy would take it for another kind of file
                raise FormatError(
                    path, expected=expected, found="a file that is incomplete or no archive", advice=advice
                )
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                if [name for name in names if name not in arrays.files]:
                    raise FormatError(path, expected=expected, found=", ".join(arrays.files) or "no arrays")
                return [np.asarray(arrays[name]) for name in names]
    except FileNotFoundError:
        raise MissingDataError(path, expected=expected, found="nothing", advice=advice) from None
    except FormatError:
        raise  # a FormatError is a ValueError
    except (OSError, ValueError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise FormatError(path, expected=expected, found=f"a damaged one ({error})", advice=advice) from error
