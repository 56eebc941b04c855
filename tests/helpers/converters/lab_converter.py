"""A converter of a third party, with classes of its own: tests install it."""

import numpy as np

from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Trajectory
from carlasc.core import CARLA, ClassTable, Remap

CLASSES = ClassTable(
    "lab",
    {0: "unlabelled", 1: "road", 2: "car", 3: "building"},
    {0: (0, 0, 0), 1: (128, 64, 128), 2: (0, 0, 142), 3: (70, 70, 70)},
    movable=frozenset({2}),
    ground=frozenset({1}),
)


class Frame(FrameHandle):
    def __init__(self, path, number):
        self.path, self.number, self.location = path, number, str(path)

    def read(self):
        data = np.load(self.path)
        return [Cloud(data["points"], data["labels"], data["actors"])]


class Drive(Recording):
    split, has_labels, has_instances = "Train", True, True

    def __init__(self, folder):
        self.name, self.location, self.folder = f"LAB_{folder.name}", str(folder), folder
        self.frames = [
            Frame(path, number) for number, path in enumerate(sorted(folder.glob("*.npz")))
        ]

    def poses(self, *, force=False):
        return Trajectory(np.load(self.folder / "poses.npy"))


class Lab(Converter):
    title = "our laboratory's drives"
    classes = CLASSES
    to_carla = Remap("lab_to_carla", CLASSES, CARLA, {0: 0, 1: 7, 2: 10, 3: 1})
    min_range_m, max_range_m = 1.5, 80.0

    def sequences(self):
        return [Drive(folder) for folder in sorted(self.source.iterdir()) if folder.is_dir()]
