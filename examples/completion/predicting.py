"""Completion of every frame of a data set, or of a folder of raw scans.

The results are `.label` grids of the CarlaSC layout.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from carlasc import ClassTable, Dataset, GridSpec, collate
from carlasc.core import CARLASC11, SEMANTICKITTI19, FrameRange, Frames
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.storage.folder import FolderWriter
from completion.config import Config
from completion.inference import Mode, prepare
from completion.networks import KINDS, build_network
from completion.tasks import Batch, Task
from completion.weights import identify, load_weights, read_weights

Complete = Callable[[Batch], NDArray[np.uint8]]
Progress = Callable[[int, int], None]

_TABLES = {len(table.names): table for table in (CARLASC11, SEMANTICKITTI19)}


@dataclass(frozen=True)
class Model:
    """Weights, with their network and their classes.

    Attributes:
        network: name of the network.
        history: T, number of scans that it takes.
        classes: table of the ids it predicts.
        state: the state dict.
        where: the file, for error messages.
    """

    network: str
    history: int
    classes: ClassTable
    state: dict[str, torch.Tensor]
    where: str

    @property
    def task(self) -> Task:
        """The inputs and the predictions of the network."""
        return KINDS[self.network].task

    @classmethod
    def read(cls, path: Path, history: int | None = None) -> Model:
        """Read weights, and find their network.

        If `history` is None, it is read from a config.yaml beside the weights. The file also
        decides between networks with the same weights.

        Raises:
            FormatError: the network or the number of classes is unknown.
        """
        state = read_weights(path)
        settings = path.parent / "config.yaml"
        config = Config.read(settings) if settings.is_file() else None
        name, num_classes = identify(state, str(path), config.network if config else None)
        if num_classes not in _TABLES:
            raise FormatError(
                path,
                expected="weights for 11 classes (CarlaSC) or 20 (SemanticKITTI)",
                found=str(num_classes),
            )
        if history is None:
            history = config.history if config else 1
        return cls(name, history, _TABLES[num_classes], state, str(path))

    def complete_on(self, spec: GridSpec, device: torch.device, mode: Mode) -> Complete:
        """Return a function from the input fields of a sample to (X, Y, Z) labels.

        Raises:
            FormatError: the weights are for another grid, number of classes or history; the message
                names the layer and both shapes.
        """
        network = build_network(self.network, len(self.classes.names), spec, self.history)
        load_weights(network, self.state, self.where)
        run = prepare(network, device, mode)

        def complete(sample: Batch) -> NDArray[np.uint8]:
            labels = run(
                *self.task.arguments(self.task.prepare(collate([sample]), device), torch.uint8)
            )
            return labels[0].cpu().numpy().astype(np.uint8)

        return complete


def predict_dataset(
    model: Model,
    source: str,
    out: Path | None,
    device: torch.device,
    mode: Mode,
    *,
    split: str | list[str] | None = None,
    grid: str | GridSpec = layout.EVALUATION,
    frames: Frames = None,
    name: str = "completion",
    progress: Progress | None = None,
) -> int:
    """Complete frames of a data set. Frames whose grid exists already are skipped.

    Args:
        model: the weights.
        source: the data. They need scans, and the grid `grid` unless this is a GridSpec.
        out: where grids are written, as the grid `evaluation` of sequences with the model's
            classes. None: into the data, as the grid `name`.
        device: the device that computes.
        mode: "eager" or "compile".
        split: a split, or names of sequences; None takes all.
        grid: the grid whose geometry is predicted.
        frames: range of frame numbers.
        name: folder of the grid in the data.
        progress: called with (done, total).

    Returns:
        The number of frames that were completed.

    Raises:
        ArgumentError: `out` is None and the data are not a folder.
        ConflictError: the grid exists, and was made by another network or on another grid.
    """
    # occupancy has the geometry of the predicted grid
    fields = dict.fromkeys(("occupancy", *model.task.fields))
    data = Dataset(source, split, history=model.history, grid=grid, fields=fields, remap=None)
    if out is None and not Path(source).is_dir():
        raise ArgumentError(
            "out", expected=f"a folder to write to, because {source} is not one", found="none"
        )
    chosen = FrameRange.of(frames)
    jobs = [
        (sequence, frame)
        for sequence in data.sequences
        for frame in chosen.select(sequence.frames("points")).tolist()
    ]
    complete = model.complete_on(data.spec, device, mode)
    folder = layout.EVALUATION if out else name
    writers = {}
    made = 0
    for done, (sequence, frame) in enumerate(jobs, 1):
        if sequence.path not in writers:
            writers[sequence.path] = _open_writer(
                out or Path(source), sequence.path, folder, data.spec, model, beside=out is None
            )
        writer = writers[sequence.path]
        if not writer.has(f"{folder}/labels", frame):
            sample = data[data.index_of(sequence.name, frame)]
            writer.write(f"{folder}/labels", frame, complete(sample))
            made += 1
        if progress:
            progress(done, len(jobs))
    return made


def predict_scans(
    model: Model,
    folder: Path,
    out: Path,
    device: torch.device,
    mode: Mode,
    *,
    spec: GridSpec,
    right_handed: bool = False,
    progress: Progress | None = None,
) -> int:
    """Complete a folder of raw `.bin` scans (float32 x, y, z and a 4th value), one by one.

    Args:
        model: the weights, for single scans.
        folder: the scans. Their names are frame numbers; if not, they are numbered in the order of
            their names.
        out: where grids are written, as the grid `evaluation` of one sequence.
        device: the device that computes.
        mode: "eager" or "compile".
        spec: the grid to predict, in the sensor's frame.
        right_handed: y is to the left (KITTI, nuScenes): scans are mirrored into CarlaSC's axes,
            and grids are in these axes.
        progress: called with (done, total).

    Returns:
        The number of scans that were completed.

    Raises:
        ArgumentError: the network takes more than one scan.
        MissingDataError: the folder has no scans.
    """
    if model.history > 1:
        raise ArgumentError(
            "history",
            expected="1 for scans without poses",
            found=str(model.history),
            advice="give a data set in the CarlaSC layout",
        )
    files = sorted(folder.glob("*.bin"))
    if not files:
        raise MissingDataError(folder, expected=".bin scans", found="none")
    numbers = [layout.frame_of(file.name, ".bin") for file in files]
    complete = model.complete_on(spec, device, mode)
    writer = _open_writer(out, "cartesian", layout.EVALUATION, spec, model, beside=False)
    for done, (file, number) in enumerate(zip(files, numbers, strict=True), 1):
        points = layout.field_named("points").decode(file.read_bytes(), str(file))
        if right_handed:
            points = points * np.array([1, -1, 1, 1], np.float32)
        frame = done - 1 if None in numbers or number is None else number
        writer.write(
            f"{layout.EVALUATION}/labels", frame, complete(model.task.from_scan(points, spec))
        )
        if progress:
            progress(done, len(files))
    return len(files)


def _open_writer(
    out: Path, path: str, grid: str, spec: GridSpec, model: Model, *, beside: bool
) -> FolderWriter:
    """Write the geometry and the classes of a sequence's predictions, and return its writer."""
    writer = FolderSink(out).sequence(path)
    record = {"classes": model.classes.name, "network": model.network, "history": model.history}
    params = spec.to_params(len(model.classes.names)) | {"carlasc": record}
    existing = writer.read_document(layout.params_file(grid))
    if existing is not None and json.loads(existing) != params:
        raise ConflictError(
            f"{writer.location}/{layout.params_file(grid)}",
            expected=f"predictions of {model.network} on this grid",
            found="another grid",
            advice="choose another folder or name",
        )
    writer.write_document(layout.params_file(grid), json.dumps(params).encode())
    if not beside:
        writer.write_document(
            layout.METADATA, Metadata(classes=model.classes, source=model.where).to_json()
        )
    return writer
