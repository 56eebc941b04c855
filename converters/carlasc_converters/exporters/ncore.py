"""Tracked boxes as a store of NCore, version 4, with the component `cuboids`, beside the stores of
a recording: see the page `docs/commands/export.md#boxes`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from carlasc import storage
from carlasc.errors import ArgumentError
from carlasc_converters.exporters.box_exporter import BoxExporter, Origin
from carlasc_converters.ncore import Ncore, NcoreRecording
from carlasc_converters.ncore_store import encode_store

_COMPONENT = "cuboids/carlasc"  # beside the recording's own, cuboids/default


@dataclass(eq=False)
class NcoreExporter(BoxExporter):
    """Writes the observations of tracks as one more store of a recording."""

    title = "NCore: cuboid tracks, a store SEQUENCE.ncore4-carlasc.zarr"

    recording: Annotated[
        str, "Needed: store or folder of NCore from which the sequences were converted."
    ] = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        if not self.recording:
            raise ArgumentError("recording", expected="stores of NCore", found="none")

    def file(self, sequence: storage.Sequence) -> str:
        """Return the metadata of the store, which has no other files."""
        return f"{sequence.name}.ncore4-carlasc.zarr/.zmetadata.cbor.xz"

    def encode(self, sequence: storage.Sequence) -> tuple[bytes, list[str]]:
        """Return the metadata: cuboids are attributes of a group."""
        frames, notes = self.read(sequence)
        recording, numbers, rig_T_scan = Origin.of(sequence, Ncore, self.recording)
        assert isinstance(recording, NcoreRecording)
        names = sequence.metadata.classes.names
        observations = []
        for frame in frames:
            boxes = frame.boxes.transform(rig_T_scan)
            stamp = int(recording.ends_us[numbers[frame.number]])
            for row, pose in enumerate(boxes.sensor_T_box):
                x, z = np.arctan2(pose[[2, 1], [1, 0]], pose[[2, 0], [2, 0]]).tolist()
                observations.append({
                    "track_id": str(boxes.tracks[row]),
                    "class_id": names[int(boxes.labels[row])],
                    "timestamp_us": stamp,
                    "reference_frame_id": recording.vehicle,
                    "reference_frame_timestamp_us": stamp,
                    "bbox3": {
                        "centroid": boxes.centers[row].tolist(),
                        "dim": boxes.sizes[row].tolist(),
                        "rot": [x, -float(np.arcsin(pose[2, 0])), z],
                    },
                    "source": "EXTERNAL" if self.boxes is None else "AUTOLABEL",
                    "source_version": None,
                })  # fmt: skip
        component = {
            "component_name": "cuboids",
            "component_instance_name": "carlasc",
            "component_version": "v1",
            "generic_meta_data": {},
        }
        groups = {
            "": recording.about | {"component_group_name": "carlasc"},
            "cuboids/": {},
            f"{_COMPONENT}/": component,
            f"{_COMPONENT}/cuboids/": {"cuboid_track_observations": observations},
        }
        return encode_store(groups), notes
