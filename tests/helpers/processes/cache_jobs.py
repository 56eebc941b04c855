"""What processes do that share a cache: they are started, and killed, by the tests of
`carlasc.storage.transport.caching`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from carlasc.storage.transport import caching
from carlasc.storage.transport.caching import Cache, CachedTree
from carlasc.storage.transport.remote_tree import RemoteTree

PIECE = 1000  # bytes of a request, so that small files are fetched in several


def tree_at(url: str, folder: Path, max_bytes: int = 1 << 20) -> CachedTree:
    return CachedTree(RemoteTree(url), Cache(folder, max_bytes))


def read_files(
    tree: CachedTree, paths: list[str], digests: Any, largest_file: int | None = None
) -> None:
    """Put the digest of each file into a queue."""
    caching._PIECE = PIECE
    if largest_file is not None:  # writing beyond it fails, as on a full disk
        import resource  # POSIX alone has it

        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
    digests.put([hashlib.sha256(bytes(tree.read(path))).hexdigest() for path in paths])
