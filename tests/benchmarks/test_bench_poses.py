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


def open3d_multiway(scans: list[NDArray[np.float32]], given: Poses) -> Poses:
    """Pairs of scans by point-to-plane ICP, then a pose graph, as in Open3D's tutorial."""
    o3d = pytest.importorskip("open3d").pipelines.registration
    import open3d

    clouds = []
    for points in scans:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(0.3)
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=1.0, max_nn=30))
        clouds.append(cloud)
    graph = o3d.PoseGraph()
    for pose in given:
        graph.nodes.append(o3d.PoseGraphNode(pose))
    for later in range(len(scans)):
        for earlier in (later - lag for lag in NEAR if later >= lag):
            start = invert(given[earlier]) @ given[later]
            found = o3d.registration_icp(
                clouds[later],
                clouds[earlier],
                0.5,
                start,
                o3d.TransformationEstimationPointToPlane(),
            )
            information = o3d.get_information_matrix_from_point_clouds(
                clouds[later], clouds[earlier], 0.5, found.transformation
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
        o3d.GlobalOptimizationOption(max_correspondence_distance=0.5, reference_node=0),
    )
    return np.stack([node.pose for node in graph.nodes])


@pytest.mark.parametrize("refine", [ours, open3d_multiway], ids=["carlasc", "Open3D"])
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
    benchmark.pedantic(refine, args=(scans, given), rounds=1 if refine is open3d_multiway else 3)
