"""The classes of nuScenes: the 32 general classes of nuScenes-lidarseg, of which 1 to 23 are also
those of its boxes.
"""

from __future__ import annotations

from carlasc_converters.class_rows import class_rows, tables_of

# name in category.json, colour, class of CARLA; ids in order. Noise is unlabelled: returns from
# dust, rain and reflections. The recording vehicle (`vehicle.ego`) does not belong to the scene.
_CLASSES = class_rows("""
    noise 0 0 0 Free
    animal 70 130 180 Dynamic
    human.pedestrian.adult 0 0 230 Pedestrian
    human.pedestrian.child 135 206 235 Pedestrian
    human.pedestrian.construction_worker 100 149 237 Pedestrian
    human.pedestrian.personal_mobility 219 112 147 Pedestrian
    human.pedestrian.police_officer 0 0 128 Pedestrian
    human.pedestrian.stroller 240 128 128 Pedestrian
    human.pedestrian.wheelchair 138 43 226 Pedestrian
    movable_object.barrier 112 128 144 GuardRail
    movable_object.debris 210 105 30 Dynamic
    movable_object.pushable_pullable 105 105 105 Dynamic
    movable_object.trafficcone 47 79 79 Static
    static_object.bicycle_rack 188 143 143 Static
    vehicle.bicycle 220 20 60 Vehicle
    vehicle.bus.bendy 255 127 80 Vehicle
    vehicle.bus.rigid 255 69 0 Vehicle
    vehicle.car 255 158 0 Vehicle
    vehicle.construction 233 150 70 Vehicle
    vehicle.emergency.ambulance 255 83 0 Vehicle
    vehicle.emergency.police 255 215 0 Vehicle
    vehicle.motorcycle 255 61 99 Vehicle
    vehicle.trailer 255 140 0 Vehicle
    vehicle.truck 255 99 71 Vehicle
    flat.driveable_surface 0 207 191 Road
    flat.other 175 0 75 Ground
    flat.sidewalk 75 0 75 Sidewalk
    flat.terrain 112 180 60 Terrain
    static.manmade 222 184 135 Building
    static.other 255 228 196 Other
    static.vegetation 0 175 0 Vegetation
    vehicle.ego 255 240 245 Free
""")
CLASS_IDS = {name: index for index, (name, _, _) in enumerate(_CLASSES)}
"""Class id of each category."""

NUSCENES, TO_CARLA = tables_of(
    "nuscenes",
    _CLASSES,
    movable=frozenset(
        {*range(1, 9), CLASS_IDS["movable_object.pushable_pullable"], *range(14, 24)}
    ),
    deformable=frozenset({1, 2, 3, 4, 6}),
    ground=frozenset(range(24, 28)),
    geometry_only=CLASS_IDS["static.other"],
    ground_only=CLASS_IDS["flat.other"],
)

VALIDATION = frozenset(
    f"scene-{number:04d}"
    for part in (
        "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 "
        "632-638 770-771 775 777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 "
        "1059-1073"
    ).split()
    for number in range(int(part.partition("-")[0]), int(part.rpartition("-")[2]) + 1)
)
"""Names of the 150 scenes of v1.0-trainval that are for validation, as the data set's devkit lists
them.
"""
MINI_VALIDATION = frozenset({"scene-0103", "scene-0916"})
"""Those of v1.0-mini, which has splits of its own."""
