"""Classes of the boxes of NCore's recordings, whose names are those of whoever made them."""

from __future__ import annotations

from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import CARLA

# name, colour, id in CarlaSC, and words of which one is in the names that belong to it
_CLASSES: tuple[tuple[str, tuple[int, int, int], int, tuple[str, ...]], ...] = (
    ("Unlabelled", (0, 0, 0), 0, ()),
    ("Ground", (128, 64, 128), 7, ()),
    ("Other", (90, 90, 90), 3, ()),
    ("Two-wheeler", (200, 60, 200), 10, ("bicycl", "cycl", "rider", "motorbike", "scooter", "two_wheel")),
    ("Person", (220, 20, 60), 4, ("person", "pedestrian", "people", "stroller", "animal", "child", "adult")),
    (
        "Vehicle", (0, 0, 142), 10,
        ("car", "automobile", "vehicle", "truck", "bus", "trailer", "van", "tram", "train", "suv"),
    ),
    ("Other object", (170, 120, 50), 3, ()),
)  # fmt: skip
NCORE = ClassTable(
    "ncore",
    {i: name for i, (name, *_) in enumerate(_CLASSES)},
    {i: color for i, (_, color, *_) in enumerate(_CLASSES)},
    movable=frozenset({3, 4, 5, 6}),
    deformable=frozenset({3, 4}),
    ground=frozenset({1}),
    geometry_only=2,
)
NCORE_TO_CARLA = Remap("ncore_to_carla", NCORE, CARLA, {i: carla for i, (_, _, carla, _) in enumerate(_CLASSES)})


def class_of_name(name: str) -> int:
    """Return the id of the class to which the name of an object's class belongs; "Other object" for an unknown one."""
    lower = name.lower()
    return next(
        (i for i, (*_, words) in enumerate(_CLASSES) if any(word in lower for word in words)), len(_CLASSES) - 1
    )
