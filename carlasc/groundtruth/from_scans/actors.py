"""The actors of a sequence: one pass over all its scans finds what moves, and how.

The pass reads every scan once. It runs before the first grid is made, and its result is kept beside the grids, so that a run that continues,
or one with another grid, does not repeat it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import reading
from carlasc.motion import Extent, Track
from carlasc.storage.arrays import ArrayFormat, open_npz
from carlasc.storage.files import parse_json

FIRST_MOVER = 1 << 33  # actors that no field shows are numbered from here, above all instances
_FORMATS = {
    "members": ArrayFormat(("<i4",), (None,)),
    "frames": ArrayFormat(("<i8",), (None, 3)),
    "poses": ArrayFormat(("<f8",), (None, 4, 4)),
    "velocities": ArrayFormat(("<f8",), (None, 3)),
    "bounds": ArrayFormat(("<f8",), (None, 18)),
    "table": ArrayFormat(("<i8",), (None, 7)),
    "moving": ArrayFormat(("<i4",), (None,)),
    "moving_frames": ArrayFormat(("<i8",), (None, 2)),
}


@dataclass(frozen=True)
class Actors:
    """What moves in a sequence.

    Attributes:
        tracks: the actors that move, by number.
        moving: (M,) indices of the points of a scan that move and belong to no track, by frame.
        summary: what was found of every actor, standing ones too, as plain values.
    """

    tracks: Mapping[int, Track] = field(default_factory=dict)
    moving: Mapping[int, NDArray[np.integer]] = field(default_factory=dict)
    summary: tuple[Mapping[str, Any], ...] = ()

    @classmethod
    def of(cls, tracks: list[Track], moving: Mapping[int, NDArray[np.integer]] | None = None) -> Self:
        """Return the actors of tracks: those that move are kept whole, of the others only a summary."""
        return cls(
            {number: track for number, track in enumerate(tracks) if track.moves},
            moving or {},
            tuple(_summarize(track) for track in tracks),
        )

    def between(self, first: int, last: int) -> Actors:
        """Return what concerns the frames from `first` to `last`: small enough to be sent to a worker with every frame."""
        near = {number: track.between(first, last) for number, track in self.tracks.items()}
        tracks = {number: track for number, track in near.items() if track.members or len(track.world_T_actor)}
        return Actors(tracks, {frame: own for frame, own in self.moving.items() if first <= frame <= last})

    def to_bytes(self, key: str) -> bytes:
        """Return the content of a file for these actors. `key` says what they were made from."""
        table, poses, velocities, bounds, members, frames = [], [], [], [], [], []
        for number, track in self.tracks.items():
            table.append(
                (
                    number,
                    track.label,
                    track.instance,
                    track.first,
                    len(track.world_T_actor),
                    track.extent.points,
                    track.rigid,
                )
            )
            poses.append(track.world_T_actor)
            velocities.append(track.velocity)
            extent = track.extent
            bounds.append(
                np.concatenate([track.lower, track.upper, extent.lower, extent.upper, extent.faces, extent.seen_from])
            )
            for frame, own in track.members.items():
                members.append(own)
                frames.append((number, frame, len(own)))
        arrays = {
            "table": np.array(table, np.int64).reshape(-1, 7),
            "poses": np.concatenate([np.empty((0, 4, 4)), *poses]),
            "velocities": np.concatenate([np.empty((0, 3)), *velocities]),
            "bounds": np.array(bounds, np.float64).reshape(-1, 18),
            "members": np.concatenate([np.empty(0, np.int32), *members]).astype(np.int32),
            "frames": np.array(frames, np.int64).reshape(-1, 3),
            "moving": np.concatenate([np.empty(0, np.int32), *self.moving.values()]).astype(np.int32),
            "moving_frames": np.array([(f, len(own)) for f, own in self.moving.items()], np.int64).reshape(-1, 2),
        }
        about = json.dumps({"key": key, "summary": self.summary})
        buffer = io.BytesIO()
        np.savez_compressed(buffer, about=np.frombuffer(about.encode(), np.uint8), **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, where: str) -> tuple[Self, str]:
        """Return the actors of a file, and the key of what they were made from.

        Raises:
            FormatError: it is no such file; the message starts with `where`.
        """
        with open_npz(data, where) as file:
            arrays = {name: file.read(name, expected) for name, expected in _FORMATS.items()}
            about = parse_json(file.read("about", ArrayFormat(("u1",), (None,))).tobytes(), where)
        with reading(where, "tracks written by regrid", "remove it"):
            tracks = _tracks(arrays)
            ends = np.cumsum(arrays["moving_frames"][:, 1])[:-1]
            parts = np.split(arrays["moving"], ends)
            moving = {int(frame): own for (frame, _), own in zip(arrays["moving_frames"], parts, strict=False)}
            return cls(tracks, moving, tuple(about["summary"])), str(about["key"])


def _tracks(arrays: Mapping[str, NDArray[Any]]) -> dict[int, Track]:
    members: dict[int, dict[int, NDArray[np.integer]]] = {}
    offset = 0
    for number, frame, count in arrays["frames"].tolist():
        members.setdefault(number, {})[frame] = arrays["members"][offset : offset + count]
        offset += count
    tracks, row = {}, 0
    for (number, label, instance, first, length, points, rigid), bounds in zip(
        arrays["table"].tolist(), arrays["bounds"], strict=True
    ):
        rear, front, low, high = (bounds[12:16] > 0).tolist()
        tracks[number] = Track(
            label,
            instance,
            members.get(number, {}),
            first,
            arrays["poses"][row : row + length],
            arrays["velocities"][row : row + length],
            bounds[0:3],
            bounds[3:6],
            Extent(bounds[6:9], bounds[9:12], (rear, front, low, high), points, (float(bounds[16]), float(bounds[17]))),
            bool(rigid),
        )
        row += length
    return tracks


def _summarize(track: Track) -> dict[str, Any]:
    speed = np.linalg.norm(track.velocity, axis=1)
    return {
        "label": track.label,
        "instance": track.instance if track.instance < FIRST_MOVER else 0,  # a number that the data do not have
        "first": int(min(track.members, default=track.first)),
        "last": int(max(track.members, default=track.first)),
        "scans": len(track.members),
        "points": sum(len(own) for own in track.members.values()),
        "moves": track.moves,
        "speed_m_s": round(float(np.median(speed)), 3),
        "size_m": [round(float(value), 3) for value in track.size],
        "seen_m": [round(float(value), 3) for value in track.extent.size],
        "faces": sum(track.extent.faces),
    }
