"""Recordings for Rerun and Foxglove, read back with the readers of their makers: what is where, and
in which colours.
"""

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.processes.peak import PRINT_PEAK
from helpers.readers.pixels import BLUE, RED
from helpers.readers.recorded import (
    POINT,
    read_mcap,
    read_metadata,
    read_rrd,
    verify_rrd,
    voxels_of,
)
from helpers.scenes.road_blocks import ROAD, add_actors, add_poses, write_blocks

from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel, optical_axes
from carlasc.core.geometry import rotation_z, rotations_of, translation
from carlasc.core.grids import GridSpec
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, ConflictError, DependencyError, StorageError
from carlasc.metrics import VoxelOutcome
from carlasc.storage import FolderSink, layout
from carlasc.storage.camera_files import cameras_to_json, encode_image
from carlasc.viewing import Scene, ViewResult, view
from carlasc.viewing.colors import ACTORS, ERRORS, PATH, UNLABELLED, actor_ids
from carlasc.viewing.recordings.content import class_surfaces, record_frames, thin_scan
from carlasc.viewing.rendering.meshes import grid_mesh
from carlasc.viewing.viewer import RECORDINGS

pytestmark = pytest.mark.needs("rerun", "foxglove")

JPEG = b"\xff\xd8 a picture \xff\xd9"
# the vehicle's turn to the right in each frame, and that of the box in the frame of the sensor
YAW, BOX_YAW = (
    0.1,
    0.3,
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Left-handed: a red block ahead on the right, a box around it, a vehicle that turns to the
    right, pictures.
    """
    folder = write_blocks(tmp_path_factory.mktemp("drive") / "Train" / "Town01_Light" / "cartesian")
    writer = FolderSink(folder.parent).sequence(folder.name)
    poses = np.stack([translation((2.0 * i, 1.0 * i, 0.0)) @ rotation_z(YAW * i) for i in range(3)])
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    for frame in range(3):
        box = translation((10.0 + frame, 5.0, 0.0)) @ rotation_z(BOX_YAW)
        boxes = Boxes.from_poses(
            np.array([7]), np.array([RED]), box[None], np.array([[4.0, 2.0, 1.5]])
        )
        writer.write("boxes", frame, boxes.to_table())
        writer.write("bev", frame, np.frombuffer(JPEG, np.uint8))
    return folder


def color_of(label, table=CARLA):
    red, green, blue = table.colors[int(label)]
    return red << 24 | green << 16 | blue << 8 | 255  # as Rerun keeps it


def test_a_rerun_recording_holds_every_voxel_by_class_where_it_is(drive, tmp_path):
    view(drive, tmp_path / "scene.rrd")
    verify_rrd(tmp_path / "scene.rrd", tmp_path)
    entities, seconds = read_rrd(tmp_path / "scene.rrd")
    assert seconds == pytest.approx({0: 0.0, 1: 0.1, 2: 0.2})
    reader = Scene(drive).open()
    for frame in range(3):
        counts = np.bincount(reader.read(frame).grids[0].labels.reshape(-1))
        for label in (ROAD, RED, BLUE):
            seen = entities[f"/world/ego/grid/{CARLA.names[label]}"][frame]
            cells, size = (
                np.array(seen["VoxelGridMap:voxel_indices"]),
                np.array(seen["VoxelGridMap:voxel_size"][0]),
            )
            assert len(cells) == counts[label] and len(np.unique(cells, axis=0)) == len(cells)
            assert seen["VoxelGridMap:colors"] == [color_of(label)]
            middle = (cells + 0.5).mean(0) * size + seen["VoxelGridMap:translation"][0]
            # y = +5 is on the right of left-handed data; right-handed, y points to the left
            if label == RED:
                np.testing.assert_allclose(middle, (10 + frame, -5, 0), atol=0.5)
            if label == BLUE:
                np.testing.assert_allclose(middle, (-8, 6, 0), atol=0.5)
    grids = {path for path in entities if path.startswith("/world/ego/grid/")}
    assert grids == {f"/world/ego/grid/{CARLA.names[label]}" for label in (ROAD, RED, BLUE)}


def test_a_rerun_recording_holds_points_flow_boxes_tracks_poses_and_pictures(drive, tmp_path):
    view(drive, tmp_path / "scene.rrd")
    entities, _ = read_rrd(tmp_path / "scene.rrd")
    scan = Scene(drive).open().right_handed().read(1).scan
    points = entities["/world/ego/points"][1]
    np.testing.assert_array_equal(np.array(points["Points3D:positions"], np.float32), scan.points)
    np.testing.assert_array_equal(points["Points3D:class_ids"], scan.labels)
    flow = entities["/world/ego/flow"][1]
    np.testing.assert_allclose(flow["Arrows3D:vectors"], [(10, 0, 0)], atol=1e-5)
    np.testing.assert_allclose(flow["Arrows3D:origins"][0][:2], (11, -5), atol=0.1)
    boxes = entities["/world/ego/boxes"][1]
    np.testing.assert_allclose(boxes["Boxes3D:centers"], [(11, -5, 0)], atol=1e-6)
    np.testing.assert_allclose(boxes["Boxes3D:half_sizes"], [(2, 1, 0.75)])
    x, y, z, w = boxes["Boxes3D:quaternions"][0]
    np.testing.assert_allclose(
        rotations_of(np.array([[w, x, y, z]]))[0], rotation_z(-BOX_YAW)[:3, :3], atol=1e-6
    )
    assert (boxes["Boxes3D:class_ids"], boxes["Boxes3D:labels"]) == ([RED], ["Pedestrian 7"])
    pose = entities["/world/ego"][2]
    np.testing.assert_allclose(pose["Transform3D:translation"], [(4, -2, 0)])
    x, y, z, w = pose["Transform3D:quaternion"][0]
    np.testing.assert_allclose(
        rotations_of(np.array([[w, x, y, z]]))[0], rotation_z(-2 * YAW)[:3, :3], atol=1e-6
    )
    np.testing.assert_allclose(
        entities["/world/path"][None]["LineStrips3D:strips"], [[(0, 0, 0), (2, -1, 0), (4, -2, 0)]]
    )
    (way,) = entities["/world/tracks"][2]["LineStrips3D:strips"]
    expected = [
        translation((2 * i, -i, 0)) @ rotation_z(-YAW * i) @ (10 + i, -5, 0, 1) for i in range(3)
    ]
    np.testing.assert_allclose(way, np.array(expected)[:, :3], atol=1e-5)
    assert entities["/world/tracks"][2]["LineStrips3D:class_ids"] == [RED]
    assert entities["/world/tracks"][0]["LineStrips3D:strips"] == []
    assert bytes(entities["/picture"][0]["EncodedImage:blob"][0]) == JPEG


def test_a_rerun_recording_names_and_colours_the_classes_and_has_a_blueprint(drive, tmp_path):
    view(drive, tmp_path / "scene.rrd")
    entities, _ = read_rrd(tmp_path / "scene.rrd")
    (listed,) = entities["/world"][None]["AnnotationContext:context"]
    classes = {entry["class_id"]: entry["class_description"]["info"] for entry in listed}
    assert {i: info["label"] for i, info in classes.items()} == {**CARLA.names, 0: "unlabelled"}
    assert all(classes[i]["color"] == color_of(i) for i in CARLA.names if i)
    assert classes[0]["color"] >> 8 == int.from_bytes(bytes(UNLABELLED))
    # right, forward, up: right-handed
    assert entities["/world"][None]["ViewCoordinates:xyz"] == [[3, 5, 1]]
    (blueprint,) = pytest.importorskip("rerun.chunk").RrdReader(tmp_path / "scene.rrd").blueprints()
    assert blueprint.application_id == "carlasc"


def test_a_class_that_is_gone_is_removed(tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=2)
    labels = np.fromfile(folder / "evaluation" / "000001.label", np.uint32)
    labels[labels == BLUE] = 0
    labels.tofile(folder / "evaluation" / "000001.label")
    view(folder, tmp_path / "scene.rrd")
    entities, _ = read_rrd(tmp_path / "scene.rrd")
    vehicle = entities["/world/ego/grid/Vehicle"]
    assert "VoxelGridMap:voxel_indices" in vehicle[0] and set(vehicle[1]) == {"Clear:is_recursive"}
    (grid,) = [
        m.message
        for m in read_mcap(view(folder, tmp_path / "scene.mcap").out)["/grid"]
        if m.time_s > 0
    ]
    assert BLUE not in voxels_of(grid)[0]["label"]


def test_a_foxglove_recording_holds_every_voxel_and_point_where_it_is(drive, tmp_path):
    view(drive, tmp_path / "scene.mcap")
    topics = read_mcap(tmp_path / "scene.mcap")
    assert {topic: (len(messages), messages[0].schema) for topic, messages in topics.items()} == {
        "/tf": (3, "foxglove.FrameTransforms"),
        "/grid": (3, "foxglove.VoxelGrid"),
        "/points": (3, "foxglove.PointCloud"),
        "/flow": (3, "foxglove.SceneUpdate"),
        "/boxes": (3, "foxglove.SceneUpdate"),
        "/tracks": (3, "foxglove.SceneUpdate"),
        "/path": (1, "foxglove.SceneUpdate"),
        "/picture": (3, "foxglove.CompressedImage"),
    }
    reader = Scene(drive).open().right_handed()
    for frame, (grid, cloud) in enumerate(zip(topics["/grid"], topics["/points"], strict=True)):
        content = reader.read(frame)
        assert grid.time_s == cloud.time_s == pytest.approx(0.1 * frame)
        assert (grid.message.timestamp.seconds, grid.message.timestamp.nanos) == (
            0,
            round(1e8 * frame),
        )
        assert grid.message.frame_id == cloud.message.frame_id == "ego"
        cells, corner, size = voxels_of(grid.message)
        np.testing.assert_array_equal(cells["label"], content.grids[0].labels)
        np.testing.assert_array_equal(
            cells["rgba"][..., 3], np.where(content.grids[0].labels, 255, 0)
        )
        red = np.argwhere(cells["label"] == RED)
        np.testing.assert_allclose(
            corner + (red + 0.5).mean(0) * size, (10 + frame, -5, 0), atol=0.5
        )
        assert (cells["rgba"][tuple(red.T)] == (*CARLA.colors[RED], 255)).all()
        points = np.frombuffer(cloud.message.data, POINT)
        assert cloud.message.point_stride == POINT.itemsize
        assert [(f.name, f.offset, f.type) for f in cloud.message.fields] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7),
            ("red", 12, 1), ("green", 13, 1), ("blue", 14, 1), ("alpha", 15, 1), ("label", 16, 3),
        ]  # fmt: skip
        np.testing.assert_array_equal(points["xyz"], content.scan.points)
        np.testing.assert_array_equal(points["label"], content.scan.labels)
        np.testing.assert_array_equal(points["rgba"][:, :3], CARLA.palette[content.scan.labels])


def test_a_foxglove_recording_holds_flow_boxes_tracks_poses_and_pictures(drive, tmp_path):
    view(drive, tmp_path / "scene.mcap")
    topics = read_mcap(tmp_path / "scene.mcap")
    ((transform,),) = [message.message.transforms for message in topics["/tf"][2:]]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "ego")
    assert (transform.translation.x, transform.translation.y) == pytest.approx((4, -2))
    np.testing.assert_allclose(turned(transform.rotation), rotation_z(-2 * YAW)[:3, :3], atol=1e-6)
    (entity,) = topics["/flow"][1].message.entities
    (arrow,) = entity.arrows
    assert (arrow.pose.position.x, arrow.pose.position.y) == pytest.approx((11, -5), abs=0.1)
    assert arrow.shaft_length + arrow.head_length == pytest.approx(10, abs=1e-4)
    np.testing.assert_allclose(turned(arrow.pose.orientation)[:, 0], (1, 0, 0), atol=1e-5)
    (entity,) = topics["/boxes"][1].message.entities
    (cube,) = entity.cubes
    assert (entity.id, entity.frame_id, {pair.key: pair.value for pair in entity.metadata}) == (
        "7", "ego", {"class": "Pedestrian", "track": "7"},
    )  # fmt: skip
    assert (cube.size.x, cube.size.y, cube.size.z) == (4, 2, 1.5)
    assert (cube.pose.position.x, cube.pose.position.y) == pytest.approx((11, -5))
    np.testing.assert_allclose(
        turned(cube.pose.orientation), rotation_z(-BOX_YAW)[:3, :3], atol=1e-6
    )
    np.testing.assert_allclose(
        (cube.color.r, cube.color.g, cube.color.b), np.array(CARLA.colors[RED]) / 255
    )
    (entity,) = topics["/tracks"][2].message.entities
    assert entity.frame_id == "world" and [len(line.points) for line in entity.lines] == [3]
    # the ones before go
    assert all(m.message.deletions[0].type == 1 for m in topics["/boxes"] + topics["/tracks"])
    (line,) = topics["/path"][0].message.entities[0].lines
    assert [(p.x, p.y) for p in line.points] == [(0, 0), (2, -1), (4, -2)]
    np.testing.assert_allclose((line.color.r, line.color.g, line.color.b), np.array(PATH) / 255)
    assert (
        topics["/picture"][0].message.data == JPEG
        and topics["/picture"][0].message.format == "jpeg"
    )
    metadata = read_metadata(tmp_path / "scene.mcap")
    assert metadata["classes"] == {str(i): name for i, name in CARLA.names.items() if i}


def test_another_program_reads_the_voxels_and_points_of_a_foxglove_recording_alike(drive, tmp_path):
    """Rerun reads Foxglove's schemas with code of its own."""
    chunks = pytest.importorskip("rerun.chunk")
    view(drive, tmp_path / "a.mcap")
    content, rows = Scene(drive).open().right_handed().read(0), {}
    for chunk in chunks.McapReader(tmp_path / "a.mcap").stream():
        for row in chunk.to_record_batch().to_pylist():
            rows.setdefault((chunk.entity_path, chunk.is_static), row)
    voxels, points = rows["/grid", False], rows["/points", False]
    cells = np.array(voxels["VoxelGridMap:voxel_indices"])
    colors = np.array(voxels["VoxelGridMap:colors"])
    labels = content.grids[0].labels
    shown = cells[colors & 0xFF > 0]
    assert len(shown) == np.count_nonzero(labels) and (labels[tuple(shown.T)] > 0).all()
    assert (colors[labels[tuple(cells.T)] == RED] == color_of(RED)).all()
    corner, size = voxels["VoxelGridMap:translation"][0], voxels["VoxelGridMap:voxel_size"][0]
    middle = np.array(corner) + (cells[colors == color_of(RED)] + 0.5).mean(0) * size
    np.testing.assert_allclose(middle, (10, -5, 0), atol=0.5)
    np.testing.assert_array_equal(
        np.array(points["Points3D:positions"], np.float32), content.scan.points
    )
    np.testing.assert_array_equal(
        points["Points3D:colors"], [color_of(label) for label in content.scan.labels.tolist()]
    )
    assert voxels["CoordinateFrame:frame"] == points["CoordinateFrame:frame"] == ["ego"]


def turned(quaternion):
    """Return the (3, 3) rotation of a Quaternion message."""
    return rotations_of(np.array([[quaternion.w, quaternion.x, quaternion.y, quaternion.z]]))[0]


def test_right_handed_data_are_recorded_as_they_are(tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=1, metadata={"axes": "right"})
    cells, corner, size = voxels_of(
        read_mcap(view(folder, tmp_path / "a.mcap").out)["/grid"][0].message
    )
    red = np.argwhere(cells["label"] == RED)
    np.testing.assert_allclose(corner + (red + 0.5).mean(0) * size, (10, 5, 0), atol=0.5)
    entities, _ = read_rrd(view(folder, tmp_path / "a.rrd").out)
    np.testing.assert_allclose(
        entities["/world/ego/flow"][0]["Arrows3D:origins"][0][:2], (10, 5), atol=0.1
    )


def test_a_prediction_is_beside_its_truth_and_its_errors(blocks, tmp_path):
    prediction = write_blocks(
        tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False
    )
    scene = Scene(prediction, truth=blocks)
    (content, *_), panels = (
        record_frames(scene.open().right_handed(), None),
        ("prediction", "truth", "errors"),
    )
    entities, _ = read_rrd(view(scene, tmp_path / "a.rrd").out)
    topics = read_mcap(view(scene, tmp_path / "a.mcap").out)
    for panel, grid, table in zip(panels, content.grids, (CARLA, CARLA, ERRORS), strict=True):
        for label, count in enumerate(np.bincount(grid.labels.reshape(-1))[1:], 1):
            name = re.sub(r"([ :])", r"\\\1", table.names[label])  # as Rerun writes it in a path
            entity = entities.get(f"/world/ego/{panel}/{name}", {})
            assert len(entity.get(0, {}).get("VoxelGridMap:voxel_indices", ())) == count
            if count:
                assert entity[0]["VoxelGridMap:colors"] == [color_of(label, table)]
        cells, _, _ = voxels_of(topics[f"/{panel}"][0].message)
        np.testing.assert_array_equal(cells["label"], grid.labels)
        shown = grid.labels > 0
        np.testing.assert_array_equal(
            cells["rgba"][shown][:, :3], table.palette[grid.labels[shown]]
        )
    assert {VoxelOutcome.MISSED, VoxelOutcome.INVENTED} <= set(np.unique(content.grids[2].labels))


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    """The blocks in a cylindrical grid."""
    spec = GridSpec.published("cylindrical").with_size((32, 48, 4))
    return write_blocks(
        tmp_path_factory.mktemp("ring") / "Town01_Light" / "cylindrical", frames=1, spec=spec
    )


def area(corners, indices):
    """Return the area of triangles, square metres."""
    one, two, three = (corners[indices[:, i]].astype(np.float64) for i in range(3))
    return np.linalg.norm(np.cross(two - one, three - one), axis=1).sum() / 2


def test_a_cylindrical_grid_is_a_surface_of_few_faces_that_look_outward(ring):
    (grid,) = Scene(ring).open().right_handed().read(0).grids
    ids = np.repeat(grid.labels[..., None], 3, axis=3).astype(np.uint8)
    whole = grid_mesh(grid.spec, ids, grid.labels > 0)
    low = (whole.normals[:, 2] < -0.5) & (whole.corners[..., 2].min(1) <= grid.spec.lower[2] + 1e-6)
    surfaces = dict(class_surfaces(grid))
    assert set(surfaces) == set(np.unique(grid.labels[grid.labels > 0]).tolist())
    for label, surface in surfaces.items():
        chosen = (whole.colors[:, 0] == label) & ~low
        quads = whole.corners[chosen].reshape(-1, 3), np.arange(4 * chosen.sum()).reshape(-1, 4)
        expected = area(quads[0], np.concatenate([quads[1][:, [0, 1, 2]], quads[1][:, [0, 2, 3]]]))
        assert area(surface.corners, surface.indices) == pytest.approx(expected, rel=1e-5)
        assert len(surface.indices) <= 2 * chosen.sum()
        one, two, three = (surface.corners[surface.indices[:, i]] for i in range(3))
        turn = np.cross(two - one, three - one)
        # counter-clockwise from outside
        assert ((turn * surface.normals[surface.indices[:, 0]]).sum(1) > 0).all()
    road = surfaces[ROAD]
    assert len(road.indices) < 0.5 * 2 * ((whole.colors[:, 0] == ROAD) & ~low).sum()
    red = surfaces[RED]
    middle = (red.corners.max(0) + red.corners.min(0)) / 2
    np.testing.assert_allclose(middle[:2], (10, -5), atol=1.2)
    outward = ((red.corners - middle) * red.normals).sum(1)
    assert (outward > 0).mean() > 0.95


def test_cylindrical_grids_are_meshes_in_the_colours_of_their_classes(ring, tmp_path):
    (grid,) = Scene(ring).open().right_handed().read(0).grids
    surfaces = dict(class_surfaces(grid))
    entities, _ = read_rrd(view(ring, tmp_path / "a.rrd").out)
    (message,) = read_mcap(view(ring, tmp_path / "a.mcap").out)["/grid"]
    scene = {entity.id: entity for entity in message.message.entities}
    assert set(scene) == {CARLA.names[label] for label in surfaces}
    for label, surface in surfaces.items():
        mesh = entities[f"/world/ego/grid/{CARLA.names[label]}"][0]
        np.testing.assert_array_equal(
            np.array(mesh["Mesh3D:vertex_positions"], np.float32), surface.corners
        )
        np.testing.assert_array_equal(mesh["Mesh3D:triangle_indices"], surface.indices)
        assert mesh["Mesh3D:albedo_factor"] == [color_of(label)]
        (triangles,) = scene[CARLA.names[label]].triangles
        assert (
            len(triangles.points) == len(surface.corners)
            and len(triangles.indices) == surface.indices.size
        )
        last = triangles.points[-1]
        np.testing.assert_allclose((last.x, last.y, last.z), surface.corners[-1])
        np.testing.assert_allclose(
            (triangles.color.r, triangles.color.b), np.array(CARLA.colors[label])[[0, 2]] / 255
        )


@pytest.mark.parametrize("count", [1, 29_999, 30_000, 30_001, 130_000])
def test_thinning_keeps_an_even_share_and_always_the_same_points(count):
    points = np.zeros((count, 3), np.float32)
    points[:, 0] = np.arange(count)
    kept = thin_scan(Scan(points), 30_000).points[:, 0]
    assert len(kept) == min(count, 30_000)
    np.testing.assert_array_equal(kept, thin_scan(Scan(points), 30_000).points[:, 0])
    assert (np.diff(kept) > 0).all() and np.diff(kept).max(initial=0) <= 2 * np.ceil(count / 30_000)
    # of the lasers of a sensor that fires one after the other
    shares = np.bincount((kept % 64).astype(int), minlength=64)
    if count > 10_000:
        assert shares.min() > 0.95 * shares.mean()


@pytest.mark.parametrize("ending", RECORDINGS)
def test_points_are_thinned_unless_all_are_asked_for_and_then_the_size_comes_first(
    ending, tmp_path, monkeypatch
):
    folder = write_blocks(tmp_path / "cartesian", frames=6)
    monkeypatch.setattr("carlasc.viewing.viewer.MAX_POINTS", 1000)
    said = []
    thin = view(folder, tmp_path / f"thin{ending}", report=said.append)
    assert said == []
    done = []
    full = view(
        folder,
        tmp_path / f"full{ending}",
        full_points=True,
        report=lambda text: said.append((text, len(done))),
        progress=lambda *counts: done.append(counts),
    )
    ((text, before),) = said
    assert before == 0 and done == [(i, 6) for i in range(1, 7)]
    assert re.fullmatch(
        rf"{re.escape(str(full.out))}: about \d+ MB: 6 frames with all of their points", text
    )
    if ending == ".rrd":
        lengths = [
            len(read_rrd(r.out)[0]["/world/ego/points"][5]["Points3D:positions"])
            for r in (thin, full)
        ]
    else:
        lengths = [
            len(read_mcap(r.out)["/points"][5].message.data) // POINT.itemsize for r in (thin, full)
        ]
    assert lengths == [1000, 3401]
    assert (
        isinstance(full, ViewResult)
        and full.size_bytes == full.out.stat().st_size > thin.size_bytes
    )


@pytest.mark.parametrize("ending", RECORDINGS)
def test_the_size_is_estimated_within_a_few_percent(ending, tmp_path):
    from carlasc.viewing.viewer import estimate_size

    folder = write_blocks(tmp_path / "cartesian", frames=12)
    result = view(folder, tmp_path / f"a{ending}", full_points=True)
    estimate = estimate_size(Scene(folder).open().right_handed(), ending, None)
    assert estimate == pytest.approx(result.size_bytes, rel=0.25)


@pytest.mark.parametrize("ending", RECORDINGS)
def test_a_scene_without_a_range_shows_its_first_frames_and_says_so(
    ending, blocks, tmp_path, monkeypatch
):
    monkeypatch.setattr("carlasc.viewing.viewer.MAX_FRAMES", 2)
    result = view(blocks, tmp_path / f"a{ending}")
    assert result.frames == (0, 1) and result.notes == ("3 frames found, showing the first 2",)
    assert view(Scene(blocks, frames=(0, None)), tmp_path / f"b{ending}").frames == (0, 1, 2)


@pytest.mark.parametrize("ending", RECORDINGS)
def test_what_exists_is_replaced_only_on_demand_and_a_failure_leaves_nothing(
    ending, blocks, tmp_path
):
    out = tmp_path / f"a{ending}"
    out.write_text("mine")
    with pytest.raises(ConflictError):
        view(blocks, out)

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        view(blocks, out, overwrite=True, progress=stop)
    assert out.read_text() == "mine" and list(tmp_path.iterdir()) == [out]
    view(blocks, out, overwrite=True)
    assert out.stat().st_size > 10_000 and list(tmp_path.iterdir()) == [out]


FULL_DISK = """
import resource, signal, sys
from carlasc.viewing import view
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))
view(sys.argv[1], sys.argv[2])
"""


@pytest.mark.parametrize("ending", [".rrd", ".mcap"])
@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_an_error_and_leaves_nothing(ending, blocks, tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, blocks, tmp_path / f"a{ending}"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (
        StorageError.__name__ in run.stderr.splitlines()[-1] and "cannot be written" in run.stderr
    ), run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("ending", "module"), [(".rrd", "rerun"), (".mcap", "foxglove")])
def test_without_the_sdk_the_error_names_the_extra(ending, module, blocks, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DependencyError, match=rf"\[{module}\]"):
        view(blocks, tmp_path / f"a{ending}")
    assert list(tmp_path.iterdir()) == []


def test_only_recordings_keep_all_points(blocks, tmp_path):
    for out in (tmp_path / "a.html", None):
        with pytest.raises(ArgumentError, match=r"full_points: expected a recording"):
            view(blocks, out, full_points=True)


def test_actors_without_boxes_are_followed_by_their_instances(tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=3)
    writer = FolderSink(folder.parent).sequence(folder.name)
    writer.write_document(layout.POSES, layout.encode_poses(np.stack([np.eye(4)] * 3)))
    for frame in range(3):
        labels = np.fromfile(folder / "labels" / f"{frame:06d}.label", np.uint32)
        writer.write("instances", frame, np.where(labels == RED, 9, 0).astype(np.uint32))
    frames = list(record_frames(Scene(folder).open().right_handed(), None))
    assert [len(frame.trails) for frame in frames] == [0, 1, 1]  # it has to move by a metre first
    (trail,) = frames[2].trails
    assert (trail.actor, trail.label) == (9, RED)
    np.testing.assert_allclose(trail.points, [(10 + i, -5, 0) for i in range(3)], atol=0.1)


@pytest.fixture(scope="module")
def actors(tmp_path_factory):
    """A grid whose red block is actor 70,003, drives ahead at 3 m/s, and has no points; the blue
    one is actor 6 and stands.
    """
    folder = write_blocks(tmp_path_factory.mktemp("actors") / "cartesian", points=False)
    add_actors(folder)
    add_poses(folder, [0.0] * 3, step_m=0.0)
    return folder


def test_velocities_of_voxels_are_arrows_and_tracks(actors, tmp_path):
    entities, _ = read_rrd(view(actors, tmp_path / "a.rrd").out)
    topics = read_mcap(view(actors, tmp_path / "a.mcap").out)
    for frame in range(3):
        flow = entities["/world/ego/flow"][frame]
        np.testing.assert_allclose(flow["Arrows3D:vectors"], [(3, 0, 0)], atol=1e-3)
        np.testing.assert_allclose(flow["Arrows3D:origins"][0][:2], (10 + frame, -5), atol=0.3)
        ((arrow,),) = [entity.arrows for entity in topics["/flow"][frame].message.entities]
        assert (arrow.pose.position.x, arrow.pose.position.y) == pytest.approx(
            (10 + frame, -5), abs=0.3
        )
        assert arrow.shaft_length + arrow.head_length == pytest.approx(3, abs=1e-3)
    (way,) = entities["/world/tracks"][2]["LineStrips3D:strips"]
    np.testing.assert_allclose(np.array(way)[:, :2], [(10, -5), (11, -5), (12, -5)], atol=0.3)
    assert entities["/world/tracks"][2]["LineStrips3D:class_ids"] == [RED]
    ((line,),) = [entity.lines for entity in topics["/tracks"][2].message.entities]
    assert len(line.points) == 3


def test_voxels_are_shown_by_actor_too(actors, tmp_path):
    entities, _ = read_rrd(view(actors, tmp_path / "a.rrd").out)
    (labels,) = (grid.labels for grid in Scene(actors).open().right_handed().read(1).grids)
    cells, _, _ = voxels_of(read_mcap(view(actors, tmp_path / "a.mcap").out)["/actors"][1].message)
    names = {path.rsplit("/", 1)[1] for path in entities if path.startswith("/world/ego/actors/")}
    assert len(names) == 3
    for label, actor in ((RED, 70_003), (BLUE, 6), (ROAD, 0)):
        color = ACTORS.palette[actor_ids(np.array(actor))]
        assert (cells["rgba"][labels == label][:, :3] == color).all()
        parts = [entities[path][1] for path in entities if path.startswith("/world/ego/actors/")]
        (part,) = [
            part
            for part in parts
            if part["VoxelGridMap:colors"] == [color_of(actor_ids(np.array(actor)), ACTORS)]
        ]
        assert len(part["VoxelGridMap:voxel_indices"]) == np.count_nonzero(labels == label)
    assert read_metadata(tmp_path / "a.mcap")["actors"]["1"] == "no actor"


def test_points_have_the_numbers_of_their_actors(tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=1)
    labels = np.fromfile(folder / "labels/000000.label", np.uint32)
    numbers = np.where(labels == RED, 9, 0).astype(np.uint32)
    FolderSink(folder.parent).sequence(folder.name).write("instances", 0, numbers)
    points = read_rrd(view(folder, tmp_path / "a.rrd").out)[0]["/world/ego/instances"][0]
    assert len(points["Points3D:positions"]) == np.count_nonzero(numbers)
    assert set(points["Points3D:colors"]) == {color_of(actor_ids(np.array(9)), ACTORS)}
    cloud = read_mcap(view(folder, tmp_path / "a.mcap").out)["/points"][0].message
    field = {f.name: (f.offset, f.type) for f in cloud.fields}["instance"]
    found = np.frombuffer(cloud.data, [*POINT.descr, ("instance", "<u4")])
    assert field == (18, 5) and cloud.point_stride == found.itemsize
    np.testing.assert_array_equal(found["instance"], numbers)


LONG = f"""
import sys
from carlasc.viewing import Scene, view
view(Scene(sys.argv[1], frames=(0, int(sys.argv[3]))), sys.argv[2], overwrite=True)
{PRINT_PEAK}"""


@pytest.mark.slow
@pytest.mark.parametrize("ending", RECORDINGS)
def test_memory_is_flat_over_a_thousand_frames(ending, tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=1)
    for name in (
        "velodyne/{}.bin",
        "labels/{}.label",
        "predictions/{}.bin",
        "evaluation/{}.label",
        "evaluation/{}.bin",
    ):
        first = folder / name.format("000000")
        for frame in range(1, 1000):
            (folder / name.format(f"{frame:06d}")).symlink_to(first)
    (folder / layout.TIMES).write_bytes(layout.encode_times(np.arange(1000) * 0.1))
    most = {}
    for count in (100, 1000):
        run = subprocess.run(
            [sys.executable, "-c", LONG, folder, tmp_path / f"a{ending}", str(count)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        most[count] = int(run.stdout) / 1024
    assert most[1000] < most[100] + 15, most  # MB


@pytest.mark.slow
@pytest.mark.parametrize("ending", RECORDINGS)
def test_sixty_frames_take_less_than_40_megabytes_and_20_seconds(ending, tmp_path):
    folder = write_blocks(tmp_path / "cartesian", frames=4, spec=GridSpec.published())
    rng = np.random.default_rng(0)
    for frame in range(4):
        name = f"{frame:06d}"
        cloud = np.column_stack(
            [rng.normal(0, 15, (130_000, 2)), rng.uniform(-2, 3, 130_000), np.zeros(130_000)]
        )
        cloud.astype(np.float32).tofile(folder / "velodyne" / f"{name}.bin")
        rng.integers(1, 23, 130_000, np.uint32).tofile(folder / "labels" / f"{name}.label")
        moving = rng.random(130_000) < 0.01
        (moving[:, None] * np.array([8.0, 0, 0])).astype(np.float32).tofile(
            folder / "predictions" / f"{name}.bin"
        )
        labels = np.fromfile(folder / "evaluation" / f"{name}.label", np.uint32)
        above = rng.permutation(labels.size)[:8_000]  # beside the 16,384 voxels of the road
        labels[above] = rng.integers(1, 23, 8_000)
        labels.tofile(folder / "evaluation" / f"{name}.label")
    # four different frames, so that none repeats where a compressor would notice
    for frame in range(4, 60):
        for first in folder.rglob(f"{frame % 4:06d}.*"):
            (first.parent / f"{frame:06d}{first.suffix}").symlink_to(first)
    (folder / layout.TIMES).write_bytes(layout.encode_times(np.arange(60) * 0.1))
    started = time.process_time()
    result = view(folder, tmp_path / f"a{ending}")
    assert len(result.frames) == 60 and result.size_bytes < 40e6
    assert time.process_time() - started < 20


def test_only_the_scene_reads_sequences():
    """Whatever shows data reads it through a `SceneReader`."""
    viewing = Path(sys.modules["carlasc.viewing"].__file__).parent
    allowed = {"scene.py", "finding.py"}
    reading = re.compile(
        r"\.sequence\.(read|scan|grid|boxes|frames|fields|metadata|poses|times|params)"
    )
    found = [
        path.name
        for path in viewing.rglob("*.py")
        if path.name not in allowed and reading.search(path.read_text())
    ]
    assert found == []


@pytest.fixture(scope="module")
def photographed(drive, tmp_path_factory):
    """The drive with a camera that looks to the right."""
    folder = tmp_path_factory.mktemp("photographed") / "Town01_Light" / "cartesian"
    shutil.copytree(drive, folder)
    matrix = np.array([[100.0, 0, 39.5], [0, 100, 29.5], [0, 0, 1]])
    place = optical_axes((0.0, 1.0), "left")
    place[:3, 3] = 1.0, 0.5, -0.2
    camera = CameraModel(name="right", width=80, height=60, matrix=matrix, sensor_T_camera=place)
    writer = FolderSink(folder.parent).sequence(folder.name)
    writer.write_document(layout.CAMERAS, cameras_to_json([camera]))
    image = encode_image(np.full((60, 80, 3), 90, np.uint8), "PNG")
    for frame in range(2):
        writer.write("images.right.png", frame, image)
    return folder, image.tobytes()


def test_recordings_hold_the_images_of_cameras_where_they_were_taken(photographed, tmp_path):
    folder, image = photographed
    view(folder, tmp_path / "scene.rrd")
    entities, _ = read_rrd(tmp_path / "scene.rrd")
    shown = entities["/world/ego/cameras/right"]
    assert sorted(shown) == [0, 1] and bytes(shown[1]["EncodedImage:blob"][0]) == image
    # y points to the left
    np.testing.assert_allclose(shown[1]["Transform3D:translation"], [(1, -0.5, -0.2)], atol=1e-6)
    np.testing.assert_allclose(
        np.reshape(shown[1]["Pinhole:image_from_camera"], (3, 3)).T[0], (100, 0, 39.5)
    )

    view(folder, tmp_path / "scene.mcap")
    topics = read_mcap(tmp_path / "scene.mcap")
    assert len(topics["/cameras/right/image"]) == len(topics["/cameras/right/calibration"]) == 2
    assert topics["/cameras/right/image"][0].message.data == image
    lens = topics["/cameras/right/calibration"][0].message
    assert (lens.width, lens.height, lens.frame_id) == (80, 60, "right") and lens.K[2] == 39.5
    placed = topics["/tf"][0].message.transforms[1]
    assert (placed.parent_frame_id, placed.child_frame_id) == ("ego", "right")
    turn, q = placed.rotation, np.zeros((1, 4))
    q[0] = turn.w, turn.x, turn.y, turn.z
    # it looks to the right
    np.testing.assert_allclose(rotations_of(q)[0][:, 2], (0, -1, 0), atol=1e-6)
