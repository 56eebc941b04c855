"""All calls that read a kind of input, as users make them.

`attempt` calls a reader and takes the errors that carlasc raises on purpose.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import carlasc
from carlasc import Run
from carlasc.captures import find_captures
from carlasc.converting import convert, load_converter
from carlasc.converting.registry import exporter_names
from carlasc.storage import Sequence
from faults.writing import REGRID_SPEC

Attempt = Callable[..., Any]
"""`attempt(function, *arguments)` returns what a reader returns, or None where it refuses with an
error of ours.
"""


def the_only(root: Path) -> Path:
    """Return the store in a folder that holds nothing else; the folder itself where it is gone."""
    return next(
        (path for path in sorted(root.iterdir()) if path.name.startswith(("data", "store"))), root
    )


def read_stored(root: Path, attempt: Attempt) -> None:
    """Read the store in a folder."""
    read_source(the_only(root), attempt)


def read_source(path: Path, attempt: Attempt) -> None:
    """Open a data set, and read all of it through every call of a Sequence."""
    source = attempt(carlasc.open, path)
    sequences = None if source is None else attempt(source.sequences)
    for sequence in (sequences or {}).values():
        _read_sequence(sequence, attempt)


def _read_sequence(sequence: Sequence, attempt: Attempt) -> None:
    documents = attempt(sequence.documents) or ()
    for document in documents:
        attempt(sequence.read_document, document)
    for name in ("metadata", "poses", "times"):
        if name == "metadata" or f"{name}.txt" in documents:
            attempt(getattr, sequence, name)
    grids = attempt(getattr, sequence, "grids") or {}
    for name in grids:
        attempt(sequence.classes_of, name)
        attempt(sequence.predicted_by, name)
    frames = {}
    for field in sorted(attempt(sequence.fields) or ()):
        found = attempt(sequence.frames, field)
        frames[field] = [] if found is None else found.tolist()
        for frame in frames[field]:
            attempt(sequence.read, field, frame)
    scans = attempt(sequence.scan_frames)
    for frame in [] if scans is None else scans.tolist():
        if frame in frames.get("points", ()):
            attempt(sequence.scan, frame)
            attempt(sequence.read_xyz, [frame])
        for name, read in (("poses", sequence.read_pose), ("times", sequence.read_time)):
            if f"{name}.txt" in documents:
                attempt(read, frame)
        for name in grids:
            if frame in frames.get(f"{name}/labels", ()):
                attempt(sequence.grid, name, frame)


def check_source(root: Path, attempt: Attempt) -> None:
    """List, check and count a data set, as `carlasc info`, `validate` and `stats` do."""
    attempt(carlasc.info, root)
    found = attempt(lambda: carlasc.validate(root, every=1))
    for finding in found.findings if found is not None else ():
        attempt(str, finding)
    for split in ("Train", "Test"):  # all sequences of one have the same class table
        attempt(carlasc.stats, root / split)


def train_on(root: Path, attempt: Attempt) -> None:
    """Read every sample of a data set for training: scans and grids, and grids with their evidence."""
    scans = (
        "occupancy",
        "visibility",
        "labels",
        "known",
        "counts",
        "points",
        "point_labels",
        "flow",
        "poses",
    )
    evidence = ("labels", "known", "posterior", "occupied", "flags", "views")
    for split, coordinates, fields in (
        ("Train", "cartesian", scans),
        ("Test", "cylindrical", evidence),
    ):
        options = {"history": 2, "coordinates": coordinates, "fields": fields, "remap": None}
        dataset = attempt(
            lambda split=split, options=options: carlasc.Dataset(root / split, **options)
        )
        for index in range(0 if dataset is None else len(dataset)):
            attempt(dataset.__getitem__, index)


def show(root: Path, attempt: Attempt) -> None:
    """Write the page of a scene."""
    with tempfile.TemporaryDirectory() as out:
        attempt(lambda: carlasc.view(root, Path(out) / "page.html"))


def draw(root: Path, attempt: Attempt) -> None:
    """Draw a picture of the first frame."""
    with tempfile.TemporaryDirectory(dir=root.parent) as out:
        camera, style = carlasc.CameraOptions(still=True), carlasc.StyleOptions(size=(96, 64))
        attempt(lambda: carlasc.render(root, Path(out) / "a.png", camera=camera, style=style))


def pack_again(root: Path, attempt: Attempt) -> None:
    """Pack a data set into a store of each kind."""
    with tempfile.TemporaryDirectory(dir=root.parent) as out:
        for ending in (".zarr", ".h5", ".parquet"):
            attempt(
                lambda ending=ending: carlasc.pack(
                    root, Path(out) / f"a{ending}", run=Run(workers=1)
                )
            )


def unpack_again(root: Path, attempt: Attempt) -> None:
    """Unpack the store in a folder."""
    with tempfile.TemporaryDirectory(dir=root.parent) as out:
        attempt(lambda: carlasc.unpack(the_only(root), Path(out) / "a", run=Run(workers=1)))


def export_again(root: Path, attempt: Attempt) -> None:
    """Export a data set to each of the formats, but for one that is written beside a recording."""
    for name in set(exporter_names()) - {"ncore"}:
        with tempfile.TemporaryDirectory(dir=root.parent) as out:
            attempt(lambda name=name, out=out: carlasc.export(name, root, out, run=Run(workers=1)))


def regrid_captures(root: Path, attempt: Attempt) -> None:
    """Make the grids of a capture."""
    with tempfile.TemporaryDirectory(dir=root.parent) as out:
        attempt(lambda: carlasc.regrid(root, REGRID_SPEC, out, run=Run(workers=1)))


def read_captures(root: Path, attempt: Attempt) -> None:
    """Read all recordings, poses, times and pictures of the captures in a folder."""
    for capture in (attempt(find_captures, root) or {}).values():
        frames = attempt(getattr, capture, "frames")
        for sensor in attempt(getattr, capture, "sensors") or ():
            attempt(capture.read_times, sensor)
            for frame in [] if frames is None else frames.tolist():
                recording = attempt(capture.read, sensor, frame)
                if recording is not None:
                    attempt(recording.flow)
                attempt(capture.read_pose, sensor, frame)
                attempt(capture.read_time, frame, sensor)


def reader_of(converter: str) -> Callable[[Path, Attempt], None]:
    """Return a function that reads the recordings of another data set through its converter."""

    def read(root: Path, attempt: Attempt) -> None:
        found = attempt(lambda: load_converter(converter)(root).sequences())
        for recording in found or ():
            for call in (
                recording.poses,
                recording.times,
                recording.boxes,
                recording.problems,
                recording.notes,
            ):
                attempt(call)
            for name in ("sensors", "voxels", "vehicle_T_scan"):
                attempt(getattr, recording, name)
            for handle in attempt(getattr, recording, "frames") or ():
                attempt(handle.read)
                attempt(handle.read_voxels)

    return read


def conversion_of(converter: str) -> Callable[[Path, Attempt], None]:
    """Return a function that converts another data set: its recordings go through all that follows
    the reading.
    """

    def read(root: Path, attempt: Attempt) -> None:
        with tempfile.TemporaryDirectory(dir=root.parent) as out:
            attempt(lambda: convert(converter, root, out, grids=None, run=Run(workers=1)))

    return read


def score(root: Path, attempt: Attempt) -> None:
    """Score the predictions in a folder against the truth in it."""
    result = attempt(lambda: carlasc.evaluate(root / "predicted", root / "truth"))
    if result is not None:
        attempt(result.to_dict)


def compare_results(root: Path, attempt: Attempt) -> None:
    """Put results into one table, in all its forms."""
    table = attempt(lambda: carlasc.scores([root / "a.json", root / "b.json"], mixed=True))
    if table is not None:
        figures = table.table()
        for form in (figures.to_markdown, figures.to_latex, table.to_html):
            attempt(form)


def load_runs(root: Path, attempt: Attempt) -> None:
    """Read the settings, weights and checkpoints of a training."""
    from completion.config import Config
    from completion.predicting import Model
    from completion.weights import read_checkpoint

    attempt(Config.read, root / "config.yaml")
    attempt(read_checkpoint, root / "last.pt")
    for name in ("best.safetensors", "best.pt", "last.pt"):
        attempt(Model.read, root / name)


def unpack_download(root: Path, attempt: Attempt) -> None:
    """Unpack a downloaded zip, and read what was unpacked before."""
    from carlasc.storage.downloading import Archive, _extracted_before
    from carlasc.storage.extraction import extract_zip, extracted_size

    archive = root / "val_cartesian.zip"
    with tempfile.TemporaryDirectory(dir=root.parent) as out:
        attempt(extracted_size, archive)
        attempt(lambda: extract_zip(archive, Path(out), lambda _: None))
    attempt(_extracted_before, root, Archive("test_cartesian.zip", "sequences", "test", "", 0.0))


def read_reports(root: Path, attempt: Attempt) -> None:
    """Read the reports of grids, write the page of them, and compare them with the files."""
    from carlasc.inspection.report_page import describe, write_report_page

    result = attempt(lambda: carlasc.report(root, grid="made", run=Run(workers=1)))
    if result is not None:
        for report in result.reports.values():
            attempt(report.to_json)
            attempt(describe, report)
        with tempfile.TemporaryDirectory(dir=root.parent) as out:
            attempt(write_report_page, result, Path(out) / "page.html")
    attempt(lambda: carlasc.validate(root, every=1))


def regrid_again(root: Path, attempt: Attempt) -> None:
    """Continue a run in a copy of what it left: it reads scans, settings, tracks and the report."""
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:
        copy = shutil.copytree(root, Path(folder) / "copy")
        observe = carlasc.FromScans(window=(-1, 1))
        attempt(
            lambda: carlasc.regrid(
                copy, REGRID_SPEC, observe=observe, name="made", run=Run(workers=1)
            )
        )
        attempt(
            lambda: carlasc.regrid(
                copy, REGRID_SPEC, observe=observe, name="made", overwrite=True, run=Run(workers=1)
            )
        )


def tracks_in(root: Path, attempt: Attempt) -> None:
    """Read the actors and the poses that regrid keeps, which a run that goes on takes for damaged
    rather than stop.
    """
    from carlasc.motion.refinement import RefinedPoses
    from carlasc.motion.tracks import MovingActors

    for file in sorted(root.rglob("*.npz")):
        read = RefinedPoses.from_bytes if file.name.startswith("poses") else MovingActors.from_bytes
        attempt(read, file.read_bytes() if file.is_file() else b"", str(file))
