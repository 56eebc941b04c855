from __future__ import annotations

import numpy as np
import pytest
from carlasc_recorders import TownActor, TownDrive
from carlasc_recorders.town.actors import EGO_ID
from carlasc_recorders.town.plan import Rectangle
from carlasc_recorders.town.shapes import VEHICLE

from carlasc.captures.settings import TRAFFIC
from carlasc.core.geometry import invert, transform_points

pytest.importorskip("embreex", reason="the simulator needs carlasc[simulate]")
pytest.importorskip("trimesh", reason="the simulator needs carlasc[simulate]")


def footprint(actor: TownActor) -> Rectangle:
    low, high = actor.mesh.vertices[:, :2].min(axis=0), actor.mesh.vertices[:, :2].max(axis=0)
    middle = transform_points(actor.world_T_actor, np.append((low + high) / 2, 0.0))[:2]
    yaw = float(np.arctan2(actor.world_T_actor[1, 0], actor.world_T_actor[0, 0]))
    return Rectangle(middle, (float(high[0] - low[0]), float(high[1] - low[1])), yaw)


@pytest.mark.slow
@pytest.mark.parametrize("frame", range(0, 400, 25))
def test_vehicles_do_not_overlap(drive: TownDrive, frame: int) -> None:
    actors = drive.actors(frame)
    vehicles = [(actor.id, footprint(actor)) for actor in actors if actor.mesh.labels[0] == VEHICLE]
    overlapping = [
        (a, b)
        for i, (a, one) in enumerate(vehicles)
        for b, other in vehicles[i + 1 :]
        if one.overlaps(other, margin_m=-0.02)
    ]
    assert overlapping == []


def test_ids_are_unique_and_the_same_in_every_frame(drive: TownDrive) -> None:
    first, later = drive.actors(0), drive.actors(120)
    assert [actor.id for actor in first] == [actor.id for actor in later]
    assert len({actor.id for actor in first}) == len(first)
    assert first[0].id == EGO_ID


def test_heavy_traffic_has_100_vehicles_and_as_many_pedestrians(drive: TownDrive) -> None:
    moving_kinds = [actor for actor in drive.actors(0) if actor.id <= EGO_ID + 2 * TRAFFIC["heavy"]]
    vehicles = sum(int(actor.mesh.labels[0] == VEHICLE) for actor in moving_kinds)
    assert vehicles == 1 + TRAFFIC["heavy"]
    assert len(moving_kinds) - vehicles == TRAFFIC["heavy"]


def test_velocity_is_the_displacement_between_frames(drive: TownDrive) -> None:
    before, now, after = (drive.actors(frame) for frame in (199, 200, 201))
    moving = 0
    for one, actor, other in zip(before, now, after, strict=True):
        displacement = (other.world_T_actor[:3, 3] - one.world_T_actor[:3, 3]) / 0.2
        # half a frame's acceleration, and a pedestrian's corner
        assert np.linalg.norm(displacement - actor.velocity) < 0.6
        moving += int(np.linalg.norm(actor.velocity) > 0.5)
    assert moving > 100


def test_actors_face_their_direction_of_motion(drive: TownDrive) -> None:
    for actor in drive.actors(150):
        speed = float(np.linalg.norm(actor.velocity))
        if speed > 0.5:
            assert actor.velocity @ actor.world_T_actor[:3, 0] / speed > 0.9


def test_speeds_are_within_the_limits(drive: TownDrive) -> None:
    for frame in (100, 300):
        for actor in drive.actors(frame):
            limit = 12.5 if actor.mesh.labels[0] == VEHICLE else 1.8
            assert np.linalg.norm(actor.velocity) <= limit


def test_the_drive_starts_at_rest_and_covers_a_distance(drive: TownDrive) -> None:
    assert np.linalg.norm(drive.actors(0)[0].velocity) == 0.0
    path = np.array([drive.ego_pose(frame)[:2, 3] for frame in range(0, 500, 5)])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps[0] < 0.5
    assert steps.sum() > 100.0
    assert steps.max() < 0.5 * 12.0 + 0.1


def test_the_ego_vehicle_turns_smoothly(drive: TownDrive) -> None:
    yaw = np.unwrap([np.arctan2(*drive.ego_pose(frame)[[1, 0], 0]) for frame in range(500)])
    assert np.abs(np.diff(yaw)).max() < 0.15
    assert np.ptp(yaw) > 1.0


def test_a_frame_does_not_depend_on_the_frames_before_it(drive: TownDrive, twin: TownDrive) -> None:
    for frame in range(0, 60, 7):
        drive.actors(frame)
    for one, other in zip(twin.actors(60), drive.actors(60), strict=True):
        np.testing.assert_array_equal(one.world_T_actor, other.world_T_actor)


def test_the_ego_vehicle_drives_on_the_road_and_its_origin_is_on_the_ground(
    drive: TownDrive,
) -> None:
    for frame in range(0, 300, 50):
        pose = drive.ego_pose(frame)
        assert pose[2, 3] == 0.0
        nearest = min(
            np.linalg.norm(lane.path - pose[:2, 3], axis=1).min()
            for lane in drive.town.streets.lanes
        )
        assert nearest < 0.5
        np.testing.assert_allclose(invert(pose) @ pose, np.eye(4), atol=1e-12)
