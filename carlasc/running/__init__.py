"""Calling one function with many items in parallel: in processes of our own, or in an executor of the caller."""

from carlasc.running.processes import count_workers, run_all

__all__ = ["count_workers", "run_all"]
