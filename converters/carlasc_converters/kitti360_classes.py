"""The classes of KITTI-360: the ids, names and colours of `labels.py` in its tools
(github.com/autonomousvision/kitti360Scripts).
"""

from __future__ import annotations

from carlasc_converters.class_rows import class_rows, tables_of

# name, colour, class of CARLA; ids in order
_CLASSES = class_rows("""
    unlabeled 0 0 0 Free
    ego vehicle 0 0 0 Free
    rectification border 0 0 0 Free
    out of roi 0 0 0 Free
    static 0 0 0 Static
    dynamic 111 74 0 Dynamic
    ground 81 0 81 Ground
    road 128 64 128 Road
    sidewalk 244 35 232 Sidewalk
    parking 250 170 160 Ground
    rail track 230 150 140 RailTrack
    building 70 70 70 Building
    wall 102 102 156 Wall
    fence 190 153 153 Fence
    guard rail 180 165 180 GuardRail
    bridge 150 100 100 Bridge
    tunnel 150 120 90 Building
    pole 153 153 153 Pole
    polegroup 153 153 153 Pole
    traffic light 250 170 30 TrafficLight
    traffic sign 220 220 0 TrafficSign
    vegetation 107 142 35 Vegetation
    terrain 152 251 152 Terrain
    sky 70 130 180 Sky
    person 220 20 60 Pedestrian
    rider 255 0 0 Pedestrian
    car 0 0 142 Vehicle
    truck 0 0 70 Vehicle
    bus 0 60 100 Vehicle
    caravan 0 0 90 Vehicle
    trailer 0 0 110 Vehicle
    train 0 80 100 Vehicle
    motorcycle 0 0 230 Vehicle
    bicycle 119 11 32 Vehicle
    garage 64 128 128 Building
    gate 190 153 153 Fence
    stop 150 120 90 Static
    smallpole 153 153 153 Pole
    lamp 0 64 64 Pole
    trash bin 0 128 192 Static
    vending machine 128 64 0 Static
    box 64 64 128 Static
    unknown construction 102 0 0 Other
    unknown vehicle 51 0 51 Vehicle
    unknown object 32 32 32 Other
""")
KITTI360, KITTI360_TO_CARLA = tables_of(
    "kitti360",
    _CLASSES,
    movable=frozenset({*range(24, 34), 43}),
    deformable=frozenset({24}),
    ground=frozenset({6, 7, 8, 9, 10, 22}),
    geometry_only=44,
)
