"""Tracked boxes as the results that nuScenes' devkit evaluates, of tracking and of detection: see
the page `docs/commands/export.md#boxes`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from carlasc import storage
from carlasc.converting import Exported, Files
from carlasc.core.geometry import invert, rotate_vectors
from carlasc.storage.files import parse_json
from carlasc_converters.exporters.box_exporter import BoxExporter, Origin, names_of
from carlasc_converters.exporters.occ3d import frame_token
from carlasc_converters.nuscenes import NuScenes, NuScenesScene

_META = {f"use_{name}": name == "lidar" for name in ("camera", "lidar", "radar", "map", "external")}


@dataclass(eq=False)
class NuScenesExporter(BoxExporter):
    """Writes the results of each sequence, and those of each split."""

    title = "nuScenes' results of tracking and detection: SPLIT.json and SPLIT/SEQUENCE.json"

    tables: Annotated[
        str | None,
        "nuScenes, from which the sequences were converted: tokens and the global frame are those "
        "of its tables.",
    ] = field(default=None, kw_only=True)

    def file(self, sequence: storage.Sequence) -> str:
        """Return SPLIT/SEQUENCE.json."""
        return f"{_split(sequence)}/{sequence.name or 'sequence'}.json"

    def encode(self, sequence: storage.Sequence) -> tuple[bytes, list[str]]:
        """Return the results by sample; and a note on the classes that are left out."""
        frames, notes = self.read(sequence)
        table = sequence.metadata.classes
        absent = set[str]()
        tokens = {n: frame_token(sequence.name, n) for n in self.frames(sequence)}
        poses = {frame.number: frame.first_T_scan for frame in frames}
        if self.tables is not None:
            recording, numbers, vehicle_T_scan = Origin.of(sequence, NuScenes, self.tables)
            assert isinstance(recording, NuScenesScene)
            known = recording.sample_tokens()
            times = recording.times()
            tokens = {n: known[own] for n, own in numbers.items() if own in known}
            for number in poses:
                global_T_vehicle = recording.poses().at(times[numbers[number]])
                poses[number] = global_T_vehicle @ vehicle_T_scan
        results: dict[str, Any] = {token: [] for token in tokens.values()}
        for frame in frames:
            if frame.number not in tokens:
                continue
            token = tokens[frame.number]
            pose = poses[frame.number]
            velocity = rotate_vectors(pose @ invert(frame.first_T_scan), frame.values[:, :3])
            boxes = frame.boxes.transform(pose)
            for row, label in enumerate(boxes.labels.tolist()):
                (_, name), score = names_of(table, label), float(frame.values[row, 3])
                if name == "-":
                    absent.add(table.names[label])
                    continue
                results[token].append({
                    "sample_token": token,
                    "translation": boxes.centers[row].tolist(),
                    "size": boxes.sizes[row, [1, 0, 2]].tolist(),
                    "rotation": boxes.quaternions[row].tolist(),
                    "velocity": velocity[row, :2].tolist(),
                    "tracking_id": f"{sequence.name}-{boxes.tracks[row]}",
                    "tracking_name": name,
                    "tracking_score": score,
                    "detection_name": name,
                    "detection_score": score,
                    "attribute_name": "",
                })  # fmt: skip
        if absent:
            left = ", ".join(sorted(absent))
            notes.append(f"{sequence.location}: left out, as nuScenes does not track them: {left}")
        return _results(results), notes

    def index(self, root: Path, exported: Sequence[Exported]) -> Files:
        """Return the results of each split, with those of the sequences that were in it already."""
        made = {}
        for split in sorted({_split(part.sequence) for part in exported}):
            results: dict[str, Any] = {}
            for path in sorted((root / split).glob("*.json")):
                results |= parse_json(path.read_bytes(), str(path)).get("results", {})
            made[f"{split}.json"] = _results(results)
        return made


def _results(results: dict[str, Any]) -> bytes:
    return json.dumps({"meta": _META, "results": results}).encode()


def _split(sequence: storage.Sequence) -> str:
    return (sequence.split or "all").lower()
