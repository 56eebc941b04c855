"""How long refining the poses of 60 scans takes, and what is left of their errors, beside Open3D's
multiway registration. Small where benchmarks are off.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from carlasc.core.geometry import invert
from carlasc.motion.refinement import ThinnedScan, refine_poses
from carlasc.testing import SimulatedDrive, wrong_poses

# of one thread, whatever else runs
pytestmark = [
    pytest.mark.slow,
    pytest.mark.benchmark(timer=time.process_time),
]

NEAR = (1, 2, 5)  # scans that Open3D registers to each other
Poses = NDArray[np.float64]


@pytest.fixture(scope="module")
def drive(request: pytest.FixtureRequest) -> tuple[list[NDArray[np.float32]], Poses]:
    """60 scans of 28,800 rays with errors of 2 cm, or 8 small ones, and their exact poses."""
    full = request.config.getoption("--benchmark-enable")
    drive = (
        SimulatedDrive(frames=60, channels=32, columns=900) if full else SimulatedDrive(frames=8)
    )
    rng, scans = np.random.default_rng(0), []
    for frame in range(drive.frames):
        points = drive.scan(frame).points[:, :3]
        away = np.linalg.norm(points, axis=1, keepdims=True)
        scans.append((points * (1 + rng.normal(0, 0.02, away.shape) / away)).astype(np.float32))
    return scans, drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor


def ours(scans: list[NDArray[np.float32]], given: Poses) -> Poses:
    return refine_poses(
        (ThinnedScan.of(p, g) for p, g in zip(scans, given, strict=True)), given, always=True
    ).poses


def open3d_tutorial(scans: list[NDArray[np.float32]], given: Poses) -> Poses:
    """Open3D with the settings of its tutorial."""
    return open3d_multiway(open3d_clouds(scans, 0.3), given, 0.5)


def open3d_best(scans: list[NDArray[np.float32]], given: Poses) -> Poses:
    """Open3D with the best settings that were found: small voxels, a robust kernel, and a second
    pass with a smaller distance.
    """
    clouds = open3d_clouds(scans, 0.1)
    return open3d_multiway(clouds, open3d_multiway(clouds, given, 0.5, 0.1), 0.1, 0.05)


def open3d_clouds(scans: list[NDArray[np.float32]], voxel_m: float) -> list[Any]:
    """Return thinned clouds with normals."""
    open3d = pytest.importorskip("open3d")
    clouds = []
    for points in scans:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(voxel_m)
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=1.0, max_nn=30))
        clouds.append(cloud)
    return clouds


def open3d_multiway(
    clouds: list[Any], given: Poses, distance_m: float, tukey_m: float | None = None
) -> Poses:
    """Pairs of scans by point-to-plane ICP, then a pose graph, as in Open3D's tutorial."""
    o3d = pytest.importorskip("open3d").pipelines.registration
    kernel = [] if tukey_m is None else [o3d.TukeyLoss(k=tukey_m)]
    graph = o3d.PoseGraph()
    for pose in given:
        graph.nodes.append(o3d.PoseGraphNode(pose))
    for later in range(len(clouds)):
        for earlier in (later - lag for lag in NEAR if later >= lag):
            start = invert(given[earlier]) @ given[later]
            found = o3d.registration_icp(
                clouds[later],
                clouds[earlier],
                distance_m,
                start,
                o3d.TransformationEstimationPointToPlane(*kernel),
            )
            information = o3d.get_information_matrix_from_point_clouds(
                clouds[later], clouds[earlier], distance_m, found.transformation
            )
            graph.edges.append(
                o3d.PoseGraphEdge(
                    later, earlier, found.transformation, information, uncertain=False
                )
            )
    o3d.global_optimization(
        graph,
        o3d.GlobalOptimizationLevenbergMarquardt(),
        o3d.GlobalOptimizationConvergenceCriteria(),
        o3d.GlobalOptimizationOption(max_correspondence_distance=distance_m, reference_node=0),
    )
    return np.stack([node.pose for node in graph.nodes])


WAYS = {"carlasc": ours, "Open3D": open3d_tutorial, "Open3D_best": open3d_best}


@pytest.mark.parametrize("refine", WAYS.values(), ids=list(WAYS))
def test_poses_of_a_drive(
    benchmark: Any, drive: tuple[list[NDArray[np.float32]], Poses], refine: Any
) -> None:
    scans, true = drive
    given = wrong_poses(true, jitter_m=0.05, jitter_rad=0.003)
    found = refine(scans, given)  # compiled
    lag = min(30, len(true) // 2)
    off = invert(invert(true[:-lag]) @ true[lag:]) @ invert(found[:-lag]) @ found[lag:]
    benchmark.extra_info["error_cm"] = round(
        100 * float(np.sqrt(np.square(off[:, :3, 3]).sum(axis=1).mean())), 2
    )
    benchmark.pedantic(refine, args=(scans, given), rounds=3 if refine is ours else 1)
