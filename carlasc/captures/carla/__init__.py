"""Raw captures from a running CARLA server."""

from carlasc.captures.carla.run import RecordResult, record

__all__ = ["RecordResult", "record"]
