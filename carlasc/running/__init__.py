"""One function over many things, side by side: in processes of its own, or in an executor of the caller's."""

from carlasc.running.processes import count_workers, run_all

__all__ = ["count_workers", "run_all"]
