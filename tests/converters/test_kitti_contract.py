"""Whole conversions of the data sets of the KITTI family: what the contract of converters asks for."""

import numpy as np
from carlasc_converters.kitti_boxes import KITTI
from converters.formats.kitti360 import CLASSES, write_kitti360
from converters.formats.kitti_drive import PERIOD_S, KittiDrive
from converters.formats.kitti_raw import write_raw
from converters.formats.kitti_tracking import write_tracking
from converters.formats.semantickitti import CLASSES as SEMANTICKITTI_CLASSES
from converters.formats.semantickitti import write_semantickitti

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.running import Run
from carlasc.testing import ConverterContract, SimulatedDrive

DRIVE = SimulatedDrive(8, PERIOD_S, rolling=True, clockwise=True)
BOXES = {
    kind: KITTI.id_of(name)
    for kind, name in (
        ("car", "Car"),
        ("van", "Van"),
        ("pedestrian", "Pedestrian"),
        ("cyclist", "Cyclist"),
    )
}


class OnlyInView(ConverterContract):
    ids = BOXES
    drive = DRIVE
    points_m = 5e-3  # corrected for motion by poses that are interpolated
    keeps = frozenset({"boxes", "poses", "times", "seconds"})

    def boxes_of(self, frame):
        return KittiDrive(self.drive).boxes(frame, BOXES)


class TestKittiRaw(OnlyInView):
    converter = "kitti-raw"

    def write(self, folder):
        write_raw(folder, KittiDrive(self.drive), BOXES)

    def test_a_missing_scan_is_no_failure_and_the_other_frames_keep_numbers_poses_and_times(
        self, sequence, tmp_path
    ):
        folder = write_raw(tmp_path / "raw", KittiDrive(self.drive), BOXES)
        (folder / "velodyne_points/data/0000000003.bin").unlink()
        result = convert(
            "kitti-raw",
            folder,
            tmp_path / "out",
            layout=LayoutOptions(axes="right", classes="kitti"),
            grids=None,
            run=Run(workers=1),
        )
        assert (result.made, result.failures) == (7, ())
        assert any(
            note.endswith("1 of the 8 frames from 0 to 7 have no scan") for note in result.notes
        )
        (found,) = carlasc.open(tmp_path / "out").sequences().values()
        assert found.frames("points").tolist() == [0, 1, 2, 4, 5, 6, 7]
        np.testing.assert_array_equal(found.poses, sequence.poses)
        np.testing.assert_array_equal(found.times, sequence.times)
        for name in ("points", "boxes", "labels"):
            np.testing.assert_array_equal(found.read(name, 5), sequence.read(name, 5))


class TestKittiTracking(OnlyInView):
    converter = "kitti-tracking"

    def write(self, folder):
        write_tracking(folder, KittiDrive(self.drive), BOXES)


class TestKitti360(ConverterContract):
    converter = "kitti360"
    ids = CLASSES
    drive = DRIVE
    points_m = 5e-3
    keeps = frozenset({"labels", "instances", "poses", "times", "seconds"})

    def write(self, folder):
        write_kitti360(folder, KittiDrive(self.drive), windows=((0, 8),))

    def labelled(self, sequence):
        # beyond the first and the last pose, the motion is a guess
        return list(range(1, self.drive.frames - 1))


class TestSemanticKitti(ConverterContract):
    converter = "kitti"
    ids = SEMANTICKITTI_CLASSES
    drive = SimulatedDrive(8, PERIOD_S)
    points_m = 1e-12
    keeps = frozenset({"labels", "instances", "poses", "times"})

    def write(self, folder):
        write_semantickitti(folder, KittiDrive(self.drive))
