"""Finishing a store that was written in parts."""

from __future__ import annotations

import os
from typing import Any

from carlasc.storage.remote import target_of
from carlasc.storage.zarr.zarr_finish import FinishedStore
from carlasc.storage.zarr.zarr_finish import finish as finish_target


def finish(out: str | os.PathLike[str], *, incomplete: bool = False, **storage_options: Any) -> FinishedStore:
    """Write the metadata of a zarr store by which it can be opened: of what several commands have written to it.

    The last part of a run does so by itself. This is for stores of which a part failed, or was never run.

    Args:
        out: the store: a path, or a URL of an object store.
        incomplete: finish it although frames are missing that a run has announced.
        **storage_options: options of fsspec for a URL.

    Returns:
        What the store holds, and what is missing.

    Raises:
        ConflictError: announced frames are missing, and `incomplete` is not given.
        FormatError: something in it is damaged.
        MissingDataError: there is no zarr store of the present version.
    """
    return finish_target(target_of(out, **storage_options), incomplete=incomplete)
