"""Small valid files of everything that carlasc reads, made by its own writers or by those of the
tests of its converters.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import carlasc
from carlasc import Run
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import CARLA
from carlasc.storage import FolderSink, field_files, layout
from carlasc.testing.data import GRIDS, SCANS, SIZE, WHOLE, evidence, grid, lines, params, scan

EXAMPLES = Path(__file__).parents[3] / "examples"
REGRID_SPEC = carlasc.GridSpec("cartesian", (8, 8, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))


def write_folder(root: Path) -> Path:
    """Write three sequences: one of two frames with every field, one of two scans, one with a grid
    of evidence.
    """
    rng = np.random.default_rng(0)
    sink = FolderSink(root)
    whole = sink.sequence(WHOLE)
    for name, data in zip((layout.POSES, layout.TIMES), lines(2), strict=True):
        whole.write_document(name, data)
    table = {"name": "own"} | {
        key: value for key, value in CARLA.to_dict().items() if key != "name"
    }
    about = {
        "format": 2,
        "axes": "right",
        "classes": table,
        "sensor": "a",
        "min_range_m": 0.5,
        "max_range_m": 70.0,
    }
    whole.write_document(
        layout.METADATA,
        json.dumps(about | {"source": "b", "rays": True, "sensors": ["x", "y"]}).encode(),
    )
    whole.write_document("evaluation/params.json", params(SIZE))
    for frame, count in enumerate((3, 7)):
        for name, array in scan(rng, count).items():
            whole.write(name, frame, array)
        whole.write("seconds", frame, rng.normal(scale=0.05, size=count).astype(np.float32))
        whole.write("sensor", frame, rng.integers(0, 2, count).astype(np.uint8))
        whole.write("origins", frame, np.zeros((count, 3), np.float32))
        whole.write("boxes", frame, _boxes(frame).to_table())
        whole.write("bev", frame, rng.integers(0, 256, 30).astype(np.uint8))
        for part, array in grid(rng, SIZE).items():
            whole.write(f"evaluation/{part}", frame, array)
    scans = sink.sequence(SCANS)
    for frame in range(2):
        for name, array in scan(rng, 5).items():
            scans.write(name, frame, array)
    grids = sink.sequence(GRIDS)
    record = json.loads(params(SIZE, "cylindrical")) | {
        "carlasc": {"format": 2, "classes": "carla", "network": "n", "vote": "x"}
    }
    grids.write_document("evaluation/params.json", json.dumps(record).encode())
    for part, array in (grid(rng, SIZE) | evidence(rng, SIZE)).items():
        grids.write(f"evaluation/{part}", 3, array)
    votes = np.zeros(3, field_files.VOTES_DTYPE)
    votes["voxel"], votes["label"], votes["votes"] = [0, 1, 47], [1, 22, 3], [1, 300, 65535]
    grids.write("evaluation/votes", 3, votes)
    return root


def _boxes(frame: int) -> Boxes:
    poses = np.stack(
        [translation((5.0 + frame, 1, 0)) @ rotation_z(0.3), translation((2.0, -3, 1))]
    )
    return Boxes.from_poses(
        np.array([1, 2], np.uint32),
        np.array([10, 4], np.uint32),
        poses,
        np.full((2, 3), 1.5),
        np.ones(2, bool),
    )


def write_zip(root: Path) -> None:
    """Write the folder's files as a zip, some stored and some deflated."""
    import zipfile

    files = write_folder(root.with_name("unzipped"))
    root.mkdir(parents=True)
    with zipfile.ZipFile(root / "data.zip", "w") as archive:
        for number, file in enumerate(sorted(files.rglob("*"))):
            if file.is_file():
                archive.write(
                    file,
                    file.relative_to(files),
                    (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)[number % 2],
                )
    shutil.rmtree(files)


def write_few(root: Path) -> Path:
    """Write one sequence of one frame, with a field of each kind: a packed store reads hundreds of
    them a second.
    """
    rng = np.random.default_rng(0)
    writer = FolderSink(root).sequence(WHOLE)
    for name, data in zip((layout.POSES, layout.TIMES), lines(1), strict=True):
        writer.write_document(name, data)
    writer.write_document(layout.METADATA, b'{"format": 2, "axes": "right"}')
    writer.write_document("evaluation/params.json", params(SIZE))
    found = scan(rng, 7)
    for name in ("points", "labels", "flow"):
        writer.write(name, 0, found[name])
    writer.write("boxes", 0, _boxes(0).to_table())
    writer.write("bev", 0, rng.integers(0, 256, 30).astype(np.uint8))
    for part, array in (grid(rng, SIZE) | {"classes": evidence(rng, SIZE)["classes"]}).items():
        writer.write(f"evaluation/{part}", 0, array)
    return root


def write_packed(ending: str) -> Callable[[Path], None]:
    """Return a function that packs a few files into `data<ending>`."""

    def write(root: Path) -> None:
        files = write_few(root.with_name("unpacked"))
        root.mkdir(parents=True)
        carlasc.pack(files, root / f"data{ending}")
        shutil.rmtree(files)

    return write


def write_capture_files(root: Path) -> None:
    """Write a capture of two sensors and two frames."""
    from helpers.datasets.captures import write_capture

    write_capture(root, frames=2, sensors=2, points=20)


def write_predictions(root: Path) -> None:
    """Write true grids, predictions in the layout, and predictions as a folder of SemanticKITTI."""
    from helpers.datasets.completion import write_split

    write_split(root / "truth", "Val", ["Town01_Light"], 2)
    write_split(root / "predicted", "Val", ["Town01_Light"], 2, seed=1)


def write_occ3d(root: Path) -> None:
    """Write a frame of Occ3D as truth and as prediction."""
    rng = np.random.default_rng(0)
    for part, name in (("truth/gts", "semantics"), ("predicted", "pred")):
        folder = root / part / "scene-0001/aa"
        folder.mkdir(parents=True)
        labels = np.full((200, 200, 16), 17, np.uint8)
        labels[:10] = rng.choice([0, 4, 11], (10, 200, 16))
        masks = {f"mask_{by}": np.ones(labels.shape, np.uint8) for by in ("lidar", "camera")}
        np.savez_compressed(folder / "labels.npz", **{name: labels}, **masks)


def write_openoccupancy(root: Path) -> None:
    """Write a frame of OpenOccupancy as truth and as prediction."""
    for part in ("truth", "predicted"):
        folder = root / part / "scene_x/occupancy"
        folder.mkdir(parents=True)
        np.save(
            folder / "aa.npy", np.array([[1, 2, 3, 4], [39, 511, 511, 16], [0, 0, 0, 0]], np.int64)
        )


def write_kitti_predictions(root: Path) -> None:
    """Write a frame of SemanticKITTI's voxels, and a prediction of it."""
    from helpers.datasets.tiny_kitti import write_tiny_kitti

    folder = write_tiny_kitti(root / "truth", "08", 1, voxels=True)
    predicted = root / "predicted/sequences/08/predictions"
    predicted.mkdir(parents=True)
    shutil.copy(folder / "voxels/000000.label", predicted)


def write_results(root: Path) -> None:
    """Write two results of `carlasc evaluate --json`."""
    write_predictions(root)
    for name in ("a", "b"):
        result = carlasc.metrics.evaluate(root / "predicted", root / "truth", name=name)
        (root / f"{name}.json").write_text(json.dumps(result.to_dict()))
    shutil.rmtree(root / "truth")
    shutil.rmtree(root / "predicted")


def write_runs(root: Path) -> None:
    """Write what the training of a network leaves: settings, a checkpoint, weights in both formats."""
    completion()
    import torch
    from completion.config import Config
    from completion.networks import build_network
    from completion.weights import write_checkpoint, write_weights
    from helpers.datasets.completion import SPEC

    torch.manual_seed(0)
    torch.set_num_threads(1)
    network = build_network("lmscnet_ss", 11, SPEC, 1)
    Config("lmscnet_ss").write(root / "config.yaml")
    write_weights(root / "best.safetensors", network)
    write_weights(root / "best.pt", network)
    write_checkpoint(
        root / "last.pt", {"network": network.state_dict(), "epoch": 3, "settings": {"a": [1, "x"]}}
    )


def write_regridded(root: Path) -> None:
    """Write scans with boxes, and a grid that was made from them with its report, held-out scores
    and tracks of actors.
    """
    from helpers.datasets.completion import write_split

    write_split(root, "Val", ["Town01_Light"], 3)
    for frame in range(3):
        FolderSink(root).sequence("Val/Town01_Light/cartesian").write(
            "boxes", frame, _boxes(frame).to_table()
        )
    carlasc.regrid(
        root,
        REGRID_SPEC,
        observe=carlasc.FromScans(window=(-1, 1)),
        name="made",
        run=Run(workers=1),
    )
    carlasc.report(root, grid="made", holdout=True, save=True, run=Run(workers=1))


def write_archive(root: Path) -> None:
    """Write what a download leaves: a zip to unpack, and the record of one that was unpacked."""
    write_zip(root)
    (root / "data.zip").rename(root / "val_cartesian.zip")
    (root / "test_cartesian.zip.unpacked.json").write_text(json.dumps({"size": 123, "files": 45}))


def completion() -> None:
    """Make the examples importable."""
    if str(EXAMPLES) not in sys.path:
        sys.path.insert(0, str(EXAMPLES))
