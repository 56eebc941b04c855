"""The contract tests of a converter.

Subclass them, and pytest runs them on a simulated drive in the format of your data set.
"""

# ruff: noqa: D102 (the name of a test says what it tests)

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carlasc import storage
from carlasc.converting import Converter, LayoutOptions, convert, load_converter
from carlasc.converting.registry import open_converter
from carlasc.core.arrays import AnyArray, FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import invert, relative_to, transform_points
from carlasc.motion import PoseOptions
from carlasc.running import Run
from carlasc.storage import Sequence
from carlasc.testing.drives import KINDS, MOVABLE, SimulatedDrive, world_T_sensor


class ConverterContract:
    """Contract of a converter: the conversion keeps points, labels, actors, boxes, poses and times
    of a drive.

    A subclass defines `converter`, `ids` and `write`.

    Attributes:
        converter: name or class of the converter.
        ids: class id in the data set for each of `carlasc.testing.KINDS` that occurs.
        drive: the drive that is written.
        keeps: content of the format, from "labels", "instances", "boxes", "poses", "times",
            "seconds" and "origins".
        options: options of the converter.
        points_m: tolerance of points, metres; 0 for bit-exact.
        poses_m: tolerance of poses: metres, and entries of a rotation.
    """

    converter: str | type[Converter]
    ids: Mapping[str, int]
    drive: SimulatedDrive = SimulatedDrive()
    keeps: frozenset[str] = frozenset({"labels", "instances", "boxes", "poses", "times"})
    options: Mapping[str, Any] = {}
    points_m: float = 1e-4
    poses_m: float = 1e-6

    def write(self, folder: Path) -> None:
        """Write the drive into an empty folder, in the format of the data set."""
        raise NotImplementedError

    def arrange(self, frame: int, values: list[AnyArray]) -> AnyArray:
        """Return values of the points of all sensors in the order of the converted scan.

        The default is sensor by sensor.
        """
        return np.concatenate(values)

    def run(self, source: Path, out: Path, axes: str = "right") -> Sequence:
        """Convert `source` to a new data set `out` with `axes` and the classes of the data set, and
        return the only sequence.
        """
        classes = self._class().classes.name
        result = convert(
            self.converter,
            source,
            out,
            layout=LayoutOptions(axes="left" if axes == "left" else "right", classes=classes),
            poses=PoseOptions(force="poses" not in self.keeps),
            grids=None,
            options=self.options,
            run=Run(workers=1),
        )
        assert result.failures == ()
        (sequence,) = storage.open(out).sequences().values()
        return sequence

    @pytest.fixture(scope="class")
    @classmethod
    def source(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("source")
        cls().write(folder)
        return folder

    @pytest.fixture(scope="class")
    @classmethod
    def out(cls, source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
        out = tmp_path_factory.mktemp("converted")
        cls().run(source, out)
        return out

    @pytest.fixture
    def sequence(self, out: Path) -> Sequence:
        (sequence,) = storage.open(out).sequences().values()
        return sequence

    def test_every_point_is_kept_in_its_place(self, sequence: Sequence) -> None:
        assert sequence.frames("points").tolist() == list(range(self.drive.frames))
        for frame in range(self.drive.frames):
            expected = self.arrange(frame, list(self._points(frame)))
            points = sequence.read("points", frame)[:, :3]
            assert points.shape == expected.shape
            np.testing.assert_allclose(points, expected, rtol=0, atol=self.points_m)

    def test_poses_are_those_of_the_drive(self, sequence: Sequence) -> None:
        self._need("poses")
        world = np.stack([world_T_sensor(self.drive, frame) for frame in range(self.drive.frames)])
        world = world @ invert(self._scan_T_first)
        np.testing.assert_allclose(sequence.poses, relative_to(world[0], world), atol=self.poses_m)

    def test_times_are_those_of_the_drive(self, sequence: Sequence) -> None:
        self._need("times")
        np.testing.assert_allclose(
            sequence.times, self.drive.times - self.drive.times[0], atol=1e-6
        )

    def test_labels_are_those_of_the_drive(self, sequence: Sequence) -> None:
        self._need("labels")
        lookup = np.array([self.ids.get(kind, 0) for kind in KINDS])
        for frame in self.labelled(sequence):
            kinds = self.arrange(frame, [scan.kinds for scan in self._scans(frame)])
            np.testing.assert_array_equal(sequence.read("labels", frame), lookup[kinds])

    def test_an_actor_has_one_number_of_its_own(self, sequence: Sequence) -> None:
        self._need("instances")
        numbers: dict[int, int] = {}
        for frame in self.labelled(sequence):
            truth = self.arrange(frame, [scan.instances for scan in self._scans(frame)])
            instances = sequence.read("instances", frame)
            np.testing.assert_array_equal(instances > 0, truth > 0)
            for track, number in np.unique(
                np.stack([truth, instances])[:, truth > 0], axis=1
            ).T.tolist():
                assert numbers.setdefault(track, number) == number
        assert len(numbers) == len(set(numbers.values())) > 0

    def test_boxes_are_those_of_the_drive(self, sequence: Sequence) -> None:
        self._need("boxes")
        numbers: dict[int, int] = {}
        frames = 0
        for frame in sequence.frames("boxes").tolist():
            boxes = sequence.boxes(frame)
            assert boxes is not None
            annotated = boxes.select(boxes.annotated)
            if not len(annotated):
                continue
            frames += 1
            expected = self.boxes_of(frame)
            distances = np.linalg.norm(annotated.centers[:, None] - expected.centers[None], axis=2)
            nearest = distances.argmin(axis=1)
            assert sorted(nearest.tolist()) == list(range(len(expected)))
            assert distances.min(axis=1).max() < max(10 * self.poses_m, 1e-4)
            np.testing.assert_allclose(annotated.sizes, expected.sizes[nearest], atol=1e-3)
            headings = [
                np.arctan2(b.sensor_T_box[:, 1, 0], b.sensor_T_box[:, 0, 0])
                for b in (annotated, expected)
            ]
            np.testing.assert_allclose(np.cos(headings[0] - headings[1][nearest]), 1, atol=1e-4)
            assert annotated.labels.tolist() == expected.labels[nearest].tolist()
            for track, number in zip(
                expected.tracks[nearest].tolist(), annotated.tracks.tolist(), strict=True
            ):
                assert numbers.setdefault(track, number) == number
        assert frames and len(numbers) == len(set(numbers.values()))

    def test_what_moves_has_flow_and_what_stands_has_none(self, sequence: Sequence) -> None:
        if not {"instances", "boxes"} & self.keeps or "poses" not in self.keeps:
            pytest.skip("the format does not say what moves")
        frame = self.drive.frames // 2
        truth = self.arrange(frame, [scan.instances for scan in self._scans(frame)])
        flow = sequence.read("flow", frame)
        instances = sequence.read("instances", frame)
        speed = np.linalg.norm(flow, axis=1)
        things = [thing for thing in self.drive.things if thing.kind in MOVABLE]
        compared = 0
        for track, thing in enumerate(things, 1):
            own = (truth == track) & (instances > 0)
            if own.sum() >= 20:
                compared += 1
                assert abs(speed[own].mean() - thing.speed) < max(0.4, 0.15 * thing.speed), thing
        assert compared >= 2
        assert not speed[truth == 0][instances[truth == 0] == 0].any()

    def test_frames_are_read_in_other_processes(self, source: Path) -> None:
        (recording,) = open_converter(self.converter, source, self.options).sequences()
        handle = recording.frames[1]
        again = pickle.loads(pickle.dumps(handle))
        for one, other in zip(handle.read(), again.read(), strict=True):
            assert np.array_equal(one.points, other.points)

    def test_left_handed_axes_mirror_everything(
        self, source: Path, sequence: Sequence, tmp_path: Path
    ) -> None:
        left = self.run(source, tmp_path / "left", "left")
        frame = self.drive.frames - 1
        signs = np.array([1, -1, 1, 1], np.float32)
        np.testing.assert_array_equal(
            left.read("points", frame), sequence.read("points", frame) * signs
        )
        if "poses" in self.keeps:
            mirror = np.diag(signs.astype(np.float64))
            np.testing.assert_allclose(left.poses, mirror @ sequence.poses @ mirror, atol=1e-9)
        for name in {"flow", "origins"} & left.fields():
            np.testing.assert_array_equal(
                left.read(name, frame), sequence.read(name, frame) * signs[:3]
            )
        if "boxes" in left.fields():
            assert np.allclose(_centers(left, frame), _centers(sequence, frame) * signs[:3])

    def test_a_run_that_was_interrupted_goes_on_to_the_same_bytes(
        self, source: Path, out: Path, tmp_path: Path
    ) -> None:
        self.run(source, tmp_path / "out")
        for path in (path for path in (tmp_path / "out").rglob("0*") if path.is_file()):
            # points are the last field that is read, and flow is the last field that is derived
            number = int(path.name[:6])
            folder = path.parent.name
            if (
                number % 4 == 1
                or (number % 4 == 2 and folder in ("velodyne", "predictions", "boxes"))
                or (number % 4 == 3 and folder == "predictions")
            ):
                path.unlink()
        self.run(source, tmp_path / "out")
        if "poses" not in self.keeps:
            return  # a second estimate may differ in its last digits
        for path in (path for path in out.rglob("*") if path.is_file()):
            assert (tmp_path / "out" / path.relative_to(out)).read_bytes() == path.read_bytes(), (
                path.name
            )

    def _need(self, content: str) -> None:
        if content not in self.keeps:
            pytest.skip(f"the format has no {content}")

    def _class(self) -> type[Converter]:
        return load_converter(self.converter) if isinstance(self.converter, str) else self.converter

    @property
    def _scan_T_first(self) -> FloatArray:
        """(4, 4) from the frame of the first sensor to the frame of the scan, which has the axes of
        the vehicle.
        """
        turned = self.drive.sensors[0].vehicle_T_sensor.copy()
        turned[:3, 3] = 0
        return turned

    def _scans(self, frame: int):  # type: ignore[no-untyped-def]
        return [self.drive.scan(frame, sensor) for sensor in range(len(self.drive.sensors))]

    def _points(self, frame: int) -> Iterator[FloatArray]:
        """Yield the points of each sensor in the frame of the scan at the time of the frame."""
        first = self.drive.sensors[0].vehicle_T_sensor[:3, 3]
        for sensor, scan in zip(self.drive.sensors, self._scans(frame), strict=True):
            yield transform_points(sensor.vehicle_T_sensor, scan.deskewed[:, :3]) - first

    def boxes_of(self, frame: int) -> Boxes:
        """Return the expected boxes of a frame, in the frame of the scan.

        Override this if the format keeps fewer boxes.
        """
        to_scan = np.eye(4)
        to_scan[:3, 3] = -self.drive.sensors[0].vehicle_T_sensor[:3, 3]
        return self.drive.boxes(frame, {kind: self.ids.get(kind, 0) for kind in KINDS}).transform(
            to_scan
        )

    def labelled(self, sequence: Sequence) -> list[int]:
        """Return the frames whose labels are compared.

        Override this if only some frames have their own labels.
        """
        return sequence.frames("labels").tolist()


def _centers(sequence: Sequence, frame: int) -> FloatArray:
    boxes = sequence.boxes(frame)
    assert boxes is not None
    return boxes.centers
