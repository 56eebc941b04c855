import shutil

import numpy as np
import pytest
from helpers.readers.pictures import Image
from helpers.readers.pixels import RED
from hypothesis import given, settings
from hypothesis import strategies as st

import carlasc
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z
from carlasc.core.scans import Scan
from carlasc.storage.folder import FolderSink
from carlasc.viewing import CameraOptions, Scene, StyleOptions, render
from carlasc.viewing.rendering.actor_boxes import box_edges, tight_boxes

pytest.importorskip("embreex")

LENGTHS = np.array([4.4, 1.8, 1.5])


def body(yaw, center, flow=None, actor=3, lengths=LENGTHS):
    """The surface of a body: points of its corners and faces, moved and turned."""
    share = (
        np.array(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5], [-0.5, 0.5], indexing="ij"))
        .reshape(3, -1)
        .T
    )
    points = share * lengths @ rotation_z(yaw)[:3, :3].T + center
    count = len(points)
    velocity = None if flow is None else np.tile(np.asarray(flow, np.float32), (count, 1))
    return Scan(
        points.astype(np.float32),
        labels=np.full(count, 10, np.uint32),
        instances=np.full(count, actor, np.uint32),
        flow=velocity,
    )


@settings(deadline=None, max_examples=60)
@given(st.floats(-np.pi, np.pi), st.floats(-20, 20), st.booleans())
def test_a_tight_box_has_the_place_and_the_size_of_the_body(yaw, x, moves):
    flow = [5 * np.cos(yaw), 5 * np.sin(yaw), 0] if moves else None
    boxes = tight_boxes(body(yaw, (x, 3.0, -1.0), flow))
    assert (boxes.tracks.tolist(), boxes.labels.tolist(), boxes.annotated.tolist()) == (
        [3],
        [10],
        [False],
    )
    np.testing.assert_allclose(boxes.centers[0], (x, 3.0, -1.0), atol=0.05)
    np.testing.assert_allclose(boxes.sizes[0], LENGTHS, atol=0.1)
    forward = boxes.sensor_T_box[0, :3, 0]
    along = forward @ (np.cos(yaw), np.sin(yaw), 0)
    assert (along if moves else abs(along)) > 0.999


def test_actors_with_few_points_and_points_without_an_actor_have_no_box():
    scan = body(0.3, (5, 0, 0))
    scan = scan.select(np.arange(4))
    assert len(tight_boxes(scan)) == 0
    assert len(tight_boxes(Scan(scan.points))) == 0
    assert (
        len(
            box_edges(
                Boxes.from_poses(
                    np.array([1], np.uint32),
                    np.array([10], np.uint32),
                    np.eye(4)[None],
                    LENGTHS[None],
                )
            )
        )
        == 6 * 13
    )


def test_the_edges_of_a_box_lie_on_its_surface_and_the_bar_leaves_it_at_the_front():
    pose = rotation_z(0.7)
    pose[:3, 3] = (4, -2, 1)
    boxes = Boxes.from_poses(
        np.array([1], np.uint32), np.array([10], np.uint32), pose[None], LENGTHS[None]
    )
    corners = box_edges(boxes).corners.reshape(-1, 3)
    local = (corners - pose[:3, 3]) @ pose[:3, :3]
    outside = np.abs(local) - LENGTHS / 2
    frame, bar = outside[: 12 * 24], local[12 * 24 :]
    assert frame.max() == pytest.approx(0.04, abs=1e-5)
    assert (np.sort(frame, axis=1)[:, 1] > -0.041).all()  # on two sides of the box at least
    assert bar[:, 0].max() == pytest.approx(LENGTHS[0] / 2 + 0.8 + 0.04, abs=1e-5)


def with_instances(blocks, root):
    """A copy of the sequence whose moving points are an actor."""
    folder = root / "Train" / "Town01_Light" / "cartesian"
    shutil.copytree(blocks, folder)
    (sequence,) = carlasc.open(folder).sequences().values()
    actors = (sequence.read("labels", 0) == RED).astype(np.uint32)
    FolderSink(folder.parent).sequence(folder.name).write("instances", 0, actors)
    return folder


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.slow
def test_annotated_boxes_are_drawn_where_they_are_and_only_in_the_picture(blocks, tmp_path):
    folder = tmp_path / "Train" / "Town01_Light" / "cartesian"
    shutil.copytree(blocks, folder)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [(10, -12, 0), (200, 0, 0)]
    boxes = Boxes.from_poses(
        np.array([1, 2], np.uint32),
        np.array([10, 10], np.uint32),
        poses,
        np.array([[6.0, 3.0, 2.0]] * 2),
    )
    FolderSink(folder.parent).sequence(folder.name).write("boxes", 0, boxes.to_table())
    options = {
        "camera": CameraOptions(view="bev"),
        "style": StyleOptions(size=(1536, 1536), ego=False, legend=False),
    }
    plain = pixels(render(Scene(folder, frames=(0, 1)), tmp_path / "b.png", **options).out)
    boxed = pixels(
        render(Scene(folder, frames=(0, 1)), tmp_path / "a.png", boxes=True, **options).out
    )
    ink = (boxed.max(-1) < 40) & (plain.max(-1) > 100)
    rows, columns = np.flatnonzero(ink.any(1)), np.flatnonzero(ink.any(0))
    scale, middle = 1536 * 0.98 / 51.2, 768  # ahead is up, right is right
    assert columns[[0, -1]] == pytest.approx(middle + scale * np.array([-13.5, -10.5]), abs=3)
    assert rows[[0, -1]] == pytest.approx(middle - scale * np.array([13.8, 7.0]), abs=3)


@pytest.mark.parametrize("what", ["scan", "flow", "grid"])
def test_boxes_are_drawn_over_any_content_and_named_in_the_legend(
    blocks, tmp_path, monkeypatch, what
):
    from carlasc.viewing.rendering import pictures

    legends = []
    original = pictures.plan_page
    monkeypatch.setattr(
        pictures, "plan_page", lambda *a, **k: legends.append(k["legend"]) or original(*a, **k)
    )
    options = {"what": what, "overwrite": True, "style": StyleOptions(size=(320, 180))}
    plain = pixels(render(Scene(blocks, frames=(0, 1)), tmp_path / "a.png", **options).out)
    folder = with_instances(blocks, tmp_path)
    boxed = pixels(
        render(Scene(folder, frames=(0, 1)), tmp_path / "a.png", boxes=True, **options).out
    )
    assert "box, with a bar to its front" not in [entry.name for entry in legends[0]]
    assert legends[1][-1].name == "box, with a bar to its front"
    assert (np.abs(plain - boxed).max(-1) > 60).sum() > 30
