from typing import ClassVar

import numpy as np
from helpers.converters.drive_converter import DriveConverter

import carlasc
from carlasc.converting import convert
from carlasc.motion import PoseOptions
from carlasc.running import Run
from carlasc.testing import SimulatedDrive
from carlasc.testing.drives import Thing

ON_ITS_TRAILER = (
    Thing("car", (10.0, 2.0, 0.7), (6.0, 2.4, 1.4), 0.0, 4.0),
    Thing("car", (10.0, 2.0, 1.0), (5.8, 2.38, 1.2), 0.0, 5.0),
)


class Overlapping(DriveConverter):
    drive: ClassVar[SimulatedDrive] = SimulatedDrive(
        things=(*SimulatedDrive().things, *ON_ITS_TRAILER)
    )
    gives = frozenset({"boxes", "poses", "times"})


def test_what_an_interrupted_run_made_from_boxes_does_not_change_what_is_added_later(tmp_path):
    def run():
        convert(
            Overlapping,
            tmp_path / "drive",
            tmp_path / "out",
            poses=PoseOptions(force=True),
            grids=None,
            run=Run(workers=1),
        )
        return next(iter(carlasc.open(tmp_path / "out").sequences().values()))

    (tmp_path / "drive").mkdir()
    sequence = run()
    whole = {
        name: [sequence.read(name, frame) for frame in range(8)]
        for name in ("labels", "instances", "flow")
    }
    for path in (tmp_path / "out").rglob("predictions/*"):
        path.unlink()  # flow is written last
    again = run()
    for name, arrays in whole.items():
        for frame, array in enumerate(arrays):
            np.testing.assert_array_equal(
                again.read(name, frame), array, err_msg=f"{name} of frame {frame}"
            )
