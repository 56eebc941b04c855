"""Raw captures from a running CARLA server."""

from carlasc.recording.run import RecordResult, record

__all__ = ["RecordResult", "record"]
