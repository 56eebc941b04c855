"""Calling one function with many items in parallel: in processes of our own, in an executor of the caller, or on a cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.running.engines import Engine
from carlasc.running.options import Run, count_cores
from carlasc.running.parts import Part
from carlasc.running.processes import run_all

if TYPE_CHECKING:
    from carlasc.running.clusters import open_cluster as open_cluster
else:

    def __getattr__(name: str) -> object:
        if name == "open_cluster":  # loaded on first use: nothing else needs what it imports
            from carlasc.running.clusters import open_cluster

            return open_cluster
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["Engine", "Part", "Run", "count_cores", "open_cluster", "run_all"]
