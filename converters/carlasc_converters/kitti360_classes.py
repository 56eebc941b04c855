"""The classes of KITTI-360: the ids, names and colours of `labels.py` in its tools
(github.com/autonomousvision/kitti360Scripts).
"""

from __future__ import annotations

from carlasc.core.classes import ClassTable, Color, Remap
from carlasc.core.tables import CARLA

_CLASSES: tuple[tuple[str, Color, int], ...] = (  # name, colour, id of CARLA; ids in order
    ("unlabeled", (0, 0, 0), 0),
    ("ego vehicle", (0, 0, 0), 0),
    ("rectification border", (0, 0, 0), 0),
    ("out of roi", (0, 0, 0), 0),
    ("static", (0, 0, 0), 19),
    ("dynamic", (111, 74, 0), 20),
    ("ground", (81, 0, 81), 14),
    ("road", (128, 64, 128), 7),
    ("sidewalk", (244, 35, 232), 8),
    ("parking", (250, 170, 160), 14),
    ("rail track", (230, 150, 140), 16),
    ("building", (70, 70, 70), 1),
    ("wall", (102, 102, 156), 11),
    ("fence", (190, 153, 153), 2),
    ("guard rail", (180, 165, 180), 17),
    ("bridge", (150, 100, 100), 15),
    ("tunnel", (150, 120, 90), 1),
    ("pole", (153, 153, 153), 5),
    ("polegroup", (153, 153, 153), 5),
    ("traffic light", (250, 170, 30), 18),
    ("traffic sign", (220, 220, 0), 12),
    ("vegetation", (107, 142, 35), 9),
    ("terrain", (152, 251, 152), 22),
    ("sky", (70, 130, 180), 13),
    ("person", (220, 20, 60), 4),
    ("rider", (255, 0, 0), 4),
    ("car", (0, 0, 142), 10),
    ("truck", (0, 0, 70), 10),
    ("bus", (0, 60, 100), 10),
    ("caravan", (0, 0, 90), 10),
    ("trailer", (0, 0, 110), 10),
    ("train", (0, 80, 100), 10),
    ("motorcycle", (0, 0, 230), 10),
    ("bicycle", (119, 11, 32), 10),
    ("garage", (64, 128, 128), 1),
    ("gate", (190, 153, 153), 2),
    ("stop", (150, 120, 90), 19),
    ("smallpole", (153, 153, 153), 5),
    ("lamp", (0, 64, 64), 5),
    ("trash bin", (0, 128, 192), 19),
    ("vending machine", (128, 64, 0), 19),
    ("box", (64, 64, 128), 19),
    ("unknown construction", (102, 0, 0), 3),
    ("unknown vehicle", (51, 0, 51), 10),
    ("unknown object", (32, 32, 32), 3),
)
KITTI360 = ClassTable(
    "kitti360",
    {i: name for i, (name, _, _) in enumerate(_CLASSES)},
    {i: color for i, (_, color, _) in enumerate(_CLASSES)},
    movable=frozenset({*range(24, 34), 43}),
    deformable=frozenset({24}),
    ground=frozenset({6, 7, 8, 9, 10, 22}),
    geometry_only=44,
)
KITTI360_TO_CARLA = Remap(
    "kitti360_to_carla", KITTI360, CARLA, {i: carla for i, (_, _, carla) in enumerate(_CLASSES)}
)
