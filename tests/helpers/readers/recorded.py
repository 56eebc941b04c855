"""Reading recordings back with the readers of their makers: Rerun's own, and MCAP's with the
schemas in the file.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

POINT = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4), ("label", "<u2")])


def read_rrd(path):
    """Return {entity: {frame: {component: values}}}, with the frame None for what is static, and
    {frame: seconds}.
    """
    chunks = pytest.importorskip("rerun.chunk")
    entities, seconds = {}, {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for row in batch.to_pylist():
            frame = None if chunk.is_static else row["frame"]
            if frame is not None:
                seconds[frame] = row["time"].total_seconds()
            seen = entities.setdefault(chunk.entity_path, {}).setdefault(frame, {})
            seen |= {
                name: values for name, values in row.items() if ":" in name and values is not None
            }
    return entities, seconds


def verify_rrd(path, home):
    """Have Rerun's command line check a recording; the test fails where it finds an error."""
    cli = pytest.importorskip("rerun_cli")
    program = Path(cli.__file__).parent / "rerun"
    run = subprocess.run(
        [program, "rrd", "verify", path],
        env=os.environ | {"HOME": str(home)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "1 file verified without error" in run.stdout + run.stderr


def read_mcap(path):
    """Return {topic: [message]}, each a protobuf message of the schema in the file with the time of
    its record, `log_time_s`.
    """
    reader = pytest.importorskip("mcap.reader")
    pytest.importorskip("google.protobuf")
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    topics = {}
    with Path(path).open("rb") as file:
        for schema, channel, record in reader.make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            pool = descriptor_pool.DescriptorPool()
            for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(proto)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            content = SimpleNamespace(
                time_s=record.log_time / 1e9,
                schema=schema.name,
                message=kind.FromString(record.data),
            )
            topics.setdefault(channel.topic, []).append(content)
    return topics


def read_metadata(path):
    """Return {name: {key: value}}, the metadata records of an MCAP file."""
    reader = pytest.importorskip("mcap.reader")
    with Path(path).open("rb") as file:
        return {
            record.name: dict(record.metadata)
            for record in reader.make_reader(file).iter_metadata()
        }


def voxels_of(grid):
    """Return a VoxelGrid's (X, Y, Z) RGBA and labels, and the (3,) positions of cell (0, 0, 0)'s
    lowest corner and of its size.
    """
    fields = {field.name: (field.offset, field.type) for field in grid.fields}
    assert {name: fields[name] for name in ("red", "green", "blue", "alpha", "label")} == {
        "red": (0, 1), "green": (1, 1), "blue": (2, 1), "alpha": (3, 1), "label": (4, 3),
    }  # fmt: skip
    dtype = np.dtype([("rgba", "u1", 4), ("label", "<u2")])
    assert (
        grid.cell_stride == dtype.itemsize and grid.row_stride == dtype.itemsize * grid.column_count
    )
    assert grid.slice_stride == grid.row_stride * grid.row_count
    cells = (
        np.frombuffer(grid.data, dtype)
        .reshape(-1, grid.row_count, grid.column_count)
        .transpose(2, 1, 0)
    )
    corner, size = grid.pose.position, grid.cell_size
    return cells, np.array([corner.x, corner.y, corner.z]), np.array([size.x, size.y, size.z])
