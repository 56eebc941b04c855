"""Completing every frame of a data set, or a folder of raw scans, into `.label` grids of the layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from carlasc import ClassTable, Dataset, GridSpec
from carlasc.core.tables import CARLASC11, SEMANTICKITTI19
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.storage.folders.folder import FolderWriter
from completion.config import Config
from completion.inference import Mode, prepare
from completion.networks import build_network
from completion.weights import identify, load_weights, read_weights

Complete = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
Progress = Callable[[int, int], None]

_TABLES = {len(table.names): table for table in (CARLASC11, SEMANTICKITTI19)}


@dataclass(frozen=True)
class Model:
    """Weights together with what they are of.

    Attributes:
        network: name of the network.
        history: T, scans it wants.
        classes: table of the ids it predicts.
        state: its state dict.
        where: the file.
    """

    network: str
    history: int
    classes: ClassTable
    state: dict[str, torch.Tensor]
    where: str

    @classmethod
    def read(cls, path: Path, history: int | None = None) -> Model:
        """Read weights, and find out which network they are of; a run's config.yaml beside them says how many scans it wants.

        Raises:
            FormatError: they are of no network of ours, or of an unknown set of classes.
        """
        state = read_weights(path)
        name, num_classes = identify(state, str(path))
        if num_classes not in _TABLES:
            raise FormatError(
                path, expected="weights for 11 classes (CarlaSC) or 20 (SemanticKITTI)", found=f"{num_classes}"
            )
        if history is None:
            settings = path.parent / "config.yaml"
            history = Config.read(settings).history if settings.is_file() else 1
        return cls(name, history, _TABLES[num_classes], state, str(path))

    def complete_on(self, spec: GridSpec, device: torch.device, mode: Mode) -> Complete:
        """Return a function from a (T, X, Y, Z) stack to (X, Y, Z) labels.

        Raises:
            FormatError: the weights are of another grid, number of classes or history; names the layer and both shapes.
        """
        network = build_network(self.network, len(self.classes.names), spec, self.history)
        load_weights(network, self.state, self.where)
        run = prepare(network, device, mode)

        def complete(occupancy: NDArray[np.uint8]) -> NDArray[np.uint8]:
            labels = run(torch.from_numpy(occupancy)[None].to(device))
            return labels[0].cpu().numpy().astype(np.uint8)

        return complete


def predict_dataset(
    model: Model,
    root: str,
    out: Path | None,
    device: torch.device,
    mode: Mode,
    *,
    split: str | list[str] | None = None,
    grid: str | GridSpec = layout.EVALUATION,
    frames: tuple[int | None, int | None] | None = None,
    name: str = "completion",
    progress: Progress | None = None,
) -> int:
    """Complete frames of a data set; those that are there already are left as they are.

    Args:
        model: the weights.
        root: the data; it needs scans, and for `grid` a params.json or a geometry.
        out: where grids go, as the grid `evaluation` of sequences with the model's classes. None: beside the data, as the grid `name`.
        device: what to compute on.
        mode: "eager" or "compile".
        split: a split, names of sequences, or all.
        grid: whose geometry is predicted.
        frames: (first, last + 1), None at an open end.
        name: the grid's folder beside the data.
        progress: called with (done, total).

    Returns:
        How many frames were completed.

    Raises:
        ArgumentError: the data are no folder that could take grids.
        ConflictError: the grid is there, and of something else.
    """
    data = Dataset(root, split, history=model.history, grid=grid, fields=("occupancy",), remap=None)
    if out is None and not Path(root).is_dir():
        raise ArgumentError(
            root, expected="a folder to write beside the data", found="none", advice="say where to write"
        )
    first, stop = frames or (None, None)
    jobs = [
        (sequence, frame)
        for sequence in data.sequences
        for frame in sequence.frames("points").tolist()
        if (first is None or frame >= first) and (stop is None or frame < stop)
    ]
    complete = model.complete_on(data.spec, device, mode)
    folder = layout.EVALUATION if out else name
    writers = {}
    made = 0
    for done, (sequence, frame) in enumerate(jobs, 1):
        if sequence.path not in writers:
            writers[sequence.path] = _begin(
                out or Path(root), sequence.path, folder, data.spec, model, beside=out is None
            )
        writer = writers[sequence.path]
        if not writer.has(f"{folder}/labels", frame):
            occupancy = data[data.index_of(sequence.name, frame)]["occupancy"]
            writer.write(f"{folder}/labels", frame, complete(occupancy))
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
        model: the weights, of single scans.
        folder: the scans; numbered in the order of their names, unless these are frame numbers.
        out: takes the grids, as the grid `evaluation` of one sequence.
        device: what to compute on.
        mode: "eager" or "compile".
        spec: the grid to predict, in the sensor's frame.
        right_handed: y is left (KITTI, nuScenes): scans are mirrored into CarlaSC's frame, and grids are in that frame.
        progress: called with (done, total).

    Returns:
        How many scans were completed.

    Raises:
        ArgumentError: the weights want more than one scan.
        MissingDataError: there are no scans.
    """
    if model.history > 1:
        raise ArgumentError(
            "history",
            expected="1 for scans without poses",
            found=f"{model.history}",
            advice="give a data set of the layout",
        )
    files = sorted(folder.glob("*.bin"))
    if not files:
        raise MissingDataError(folder, expected=".bin scans", found="none")
    numbers = [layout.frame_of(file.name, ".bin") for file in files]
    complete = model.complete_on(spec, device, mode)
    writer = _begin(out, "cartesian", layout.EVALUATION, spec, model, beside=False)
    for done, (file, number) in enumerate(zip(files, numbers, strict=True), 1):
        points = layout.field_named("points").decode(file.read_bytes(), str(file))[:, :3]
        if right_handed:
            points = points * np.array([1, -1, 1], np.float32)
        occupancy = np.zeros(spec.size, np.uint8)
        voxels = spec.flat_index(points)
        occupancy.reshape(-1)[voxels[voxels >= 0]] = 1
        frame = done - 1 if None in numbers or number is None else number
        writer.write(f"{layout.EVALUATION}/labels", frame, complete(occupancy[None]))
        if progress:
            progress(done, len(files))
    return len(files)


def _begin(out: Path, path: str, grid: str, spec: GridSpec, model: Model, *, beside: bool) -> FolderWriter:
    """Start a sequence's predictions: their geometry, and which classes they are of."""
    writer = FolderSink(out).sequence(path)
    record = {"classes": model.classes.name, "network": model.network, "history": model.history}
    params = spec.to_params(len(model.classes.names)) | {"carlasc": record}
    there = writer.read_document(layout.params_file(grid))
    if there is not None and json.loads(there) != params:
        raise ConflictError(
            f"{writer.location}/{layout.params_file(grid)}",
            expected=f"predictions of {model.network} on this grid",
            found="another grid",
            advice="choose another folder or name",
        )
    writer.write_document(layout.params_file(grid), json.dumps(params).encode())
    if not beside:
        writer.write_document(layout.METADATA, Metadata(classes=model.classes, source=model.where).to_json())
    return writer
