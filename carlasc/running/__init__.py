"""Calling one function with many items in parallel: in processes of our own, in an executor of the caller, or on a cluster."""

from carlasc.running.clusters import open_cluster
from carlasc.running.parts import Part
from carlasc.running.processes import Engine, count_workers, run_all

__all__ = ["Engine", "Part", "count_workers", "open_cluster", "run_all"]
