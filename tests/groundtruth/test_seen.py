import math
import time

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture

import carlasc
from carlasc import GridSpec
from carlasc.core import CameraModel
from carlasc.core.cameras import optical_axes
from carlasc.errors import ArgumentError, FormatError
from carlasc.groundtruth.seen import see_voxels
from carlasc.groundtruth.voting.ballot import Observation, count_votes
from carlasc.storage import cameras_of, scan_T_camera

SPEC = GridSpec("cartesian", (14, 12, 6), (-3.0, -3.0, -1.0), (4.0, 3.0, 2.0))


def camera(yaw_deg=0.0, at=(0.3137, 0.1271, 0.6113), width=400, height=240, focal=200.0, **changes):
    yaw = math.radians(yaw_deg)
    place = optical_axes((math.cos(yaw), math.sin(yaw)), "left")
    place[:3, 3] = at
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    values = {
        "name": f"at{int(yaw_deg)}",
        "width": width,
        "height": height,
        "matrix": matrix,
        "sensor_T_camera": place,
    }
    return CameraModel(**values | changes)


def plain_seen(occupied, spec, one, boxes=None):
    """The rule in plain NumPy: the boxes of occupied voxels may stop a ray, but those that the
    camera and the ray's end are in.
    """
    edge, lower, seen = spec.voxel_size, np.array(spec.lower), np.zeros(spec.size, bool)
    eye = one.sensor_T_camera[:3, 3]
    home = tuple(np.floor((eye - lower) / edge).astype(int))
    first, last = np.zeros((*spec.size, 3)), np.ones((*spec.size, 3))
    if boxes is not None:
        first, last = np.split(
            (boxes.reshape(*spec.size, 6) + [0, 0, 0, 1, 1, 1]) / 256, 2, axis=-1
        )
    for voxel in np.ndindex(*spec.size):
        center = lower + (np.array(voxel) + 0.5) * edge
        u, v = one.project((center - eye)[None] @ one.sensor_T_camera[:3, :3])[0]
        if not (-0.5 <= u < one.width - 0.5 and -0.5 <= v < one.height - 0.5):
            continue
        middle = lower + (np.array(voxel) + (first[voxel] + last[voxel]) / 2) * edge
        others = np.array(
            [cell for cell in np.argwhere(occupied) if tuple(cell) not in (voxel, home)]
        )
        for start in (center, middle) if occupied[voxel] else (center,):
            whole = np.stack([np.zeros(others.shape), np.ones(others.shape)])
            filled = np.stack([first[tuple(others.T)], last[tuple(others.T)]])
            filled += 0.02 / edge * np.array([-1, 1])[:, None, None] if boxes is not None else 0
            stops = np.ones(len(others), bool)
            for low, high in (whole, filled):
                near, far = (
                    (lower + (others + part) * edge - start) / (eye - start) for part in (low, high)
                )
                enters, leaves = (
                    np.minimum(near, far).max(axis=1),
                    np.maximum(near, far).min(axis=1),
                )
                stops &= (enters < leaves) & (leaves > 0) & (enters < 1)
            if not stops.any():
                seen[voxel] = True
                break
    return seen


@pytest.mark.parametrize(("yaw_deg", "has_boxes"), [(0, False), (120, True)])
def test_seen_is_what_plain_rays_say(yaw_deg, has_boxes):
    rng = np.random.default_rng(yaw_deg)
    occupied = rng.random(SPEC.size) < 0.06
    occupied[:, :, 0] = True  # a ground, which flat rays reach
    one = camera(yaw_deg)
    boxes = np.sort(rng.integers(0, 256, (SPEC.num_voxels, 2, 3), np.uint8), axis=1).reshape(-1, 6)
    boxes = boxes if has_boxes else None
    found = see_voxels(occupied, SPEC, [(one, one.sensor_T_camera)], boxes)
    expected = plain_seen(occupied, SPEC, one, boxes)
    assert (found == expected).mean() > 0.9995  # rays through an edge may fall on either side
    assert 0.05 < expected.mean() < 0.6 and set(np.unique(found)) == {0, 1}


def test_a_pole_hides_what_is_behind_it_and_not_what_is_beside():
    occupied = np.zeros(SPEC.size, bool)
    occupied[9] = True
    at_one_side = np.array([0, 0, 0, 255, 20, 255], np.uint8)
    boxes = np.tile(at_one_side, (SPEC.num_voxels, 1))
    one = camera(0)
    view = [(one, one.sensor_T_camera)]
    behind = see_voxels(occupied, SPEC, view, boxes)[10:]
    assert (
        not see_voxels(occupied, SPEC, view)[10:].any()
        and 0.1 < behind[behind.any(axis=(1, 2))].mean() < 0.9
    )


def test_boxes_are_those_around_the_points_of_a_voxel():
    spec = GridSpec("cartesian", (2, 1, 1), (0.0, 0.0, 0.0), (2.0, 1.0, 1.0))
    points = np.array(
        [[0.25, 0.5, 0.75], [0.5, 0.125, 0.25], [1.5, 0.5, 0.5], [1.9, 0.9, 0.9], [5, 5, 5]],
        np.float32,
    )
    observation = Observation(points, np.array([1, 1, 1, 0, 1], np.uint8), np.eye(4))
    first, second = count_votes([observation], spec, keep_boxes=True).boxes.tolist()
    # the point of class 0 says nothing
    assert first == [64, 32, 64, 128, 128, 192] and second == [128] * 6


def test_each_camera_has_its_bit_and_one_without_an_image_sees_nothing():
    front, back = camera(0), camera(180)
    empty = np.zeros(SPEC.size, bool)
    views = [(front, front.sensor_T_camera), (front, None), (back, back.sensor_T_camera)]
    assert set(np.unique(see_voxels(empty, SPEC, views))) == {0, 1, 4}


def test_what_is_behind_a_wall_is_hidden_and_the_wall_is_seen():
    occupied = np.zeros(SPEC.size, bool)
    occupied[11] = True
    one = camera(0)
    found = see_voxels(occupied, SPEC, [(one, one.sensor_T_camera)])
    assert found[11].any() and found[9].any() and not found[12:].any()


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    pytest.importorskip("embreex")
    out = tmp_path_factory.mktemp("town")
    with pytest.MonkeyPatch.context() as patch:  # a quarter of the pixels says the same
        patch.setattr("carlasc_recorders.town.photographs.IMAGE_SIZE", (400, 225))
        carlasc.simulate(
            out, count=1, sensors=2, bev=False, cameras=("front", "back"), run=carlasc.Run(workers=1),
            lidar=carlasc.captures.Lidar(16, 16_000),
        )  # fmt: skip
    voting = carlasc.Voting(keep_seen=True)
    carlasc.regrid(out, GridSpec.published(), voting=voting, run=carlasc.Run(workers=1))
    return out


@pytest.mark.needs("embreex")
def test_a_town_with_cameras_is_seen_by_them(town):
    (sequence,) = carlasc.open(town).values()
    cameras = cameras_of(sequence)
    seen, grid = sequence.read("evaluation/seen", 0), sequence.grid("evaluation", 0)
    views = [(one, scan_T_camera(sequence, one, 0)) for one in cameras.values()]
    assert list(cameras) == ["front", "back"]
    # the boxes around the points hide less
    boxed, whole = (
        seen > 0,
        see_voxels(grid.labels > 0, grid.spec, views) > 0,
    )
    assert (boxed | ~whole)[grid.known].mean() > 0.999 and boxed[grid.known].mean() > 1.05 * whole[
        grid.known
    ].mean()
    assert not (seen == 3).any() and (seen == 1).any() and (seen == 2).any()


@pytest.mark.needs("embreex")
def test_points_lie_on_the_pixels_of_their_actor_and_class(town):
    (sequence,) = carlasc.open(town).values()
    one, scan = cameras_of(sequence)["front"], sequence.scan(0)
    points = (scan.points - one.sensor_T_camera[:3, 3]) @ one.sensor_T_camera[:3, :3]
    pixels = one.project(points)
    inside = one.contains(pixels)
    columns, rows = np.rint(pixels[inside]).astype(int).T
    depths, labels = (
        carlasc.storage.read_image(sequence, one, 0, folder)[rows, columns]
        for folder in ("image_depths", "image_labels")
    )
    visible = np.abs(depths / 256 - points[inside, 2]) < 0.2
    assert inside.sum() > 1000 and visible.mean() > 0.8
    assert (labels == scan.labels[inside])[visible].mean() > 0.98


@pytest.mark.needs("embreex")
def test_seen_is_added_to_a_grid_that_exists(town, tmp_path):
    run, spec = carlasc.Run(workers=1), GridSpec.published().with_resolution([0.8])
    carlasc.regrid(town, spec, tmp_path, run=run)
    first = {
        path: path.read_bytes()
        for path in tmp_path.rglob("*")
        if path.is_file() and "report" not in path.name
    }
    result = carlasc.regrid(town, spec, tmp_path, voting=carlasc.Voting(keep_seen=True), run=run)
    assert result.made == 1 and len(list(tmp_path.rglob("*.seen"))) == 1
    assert all(path.read_bytes() == data for path, data in first.items())


@pytest.mark.needs("embreex")
def test_seen_needs_cameras_and_a_cartesian_grid(town, tmp_path):
    keep, run = carlasc.Voting(keep_seen=True), carlasc.Run(workers=1)
    with pytest.raises(ArgumentError) as error:
        carlasc.regrid(town, GridSpec.published("cylindrical"), tmp_path, voting=keep, run=run)
    assert error.value.where == "keep_seen"
    bare = SimulatedCapture(count=1, sensors=1)
    with pytest.raises(ArgumentError) as error:
        carlasc.regrid(bare, GridSpec.published(), tmp_path, voting=keep, run=run)
    assert error.value.where == "keep_seen" and error.value.found.startswith("0 in ")
    with pytest.raises(ArgumentError, match="expected any of front"):
        carlasc.simulate(tmp_path, cameras=("top",), run=run)


def test_images_that_do_not_fit_are_refused_in_one_line(town):
    from carlasc.storage.camera_files import decode_image, encode_image

    (sequence,) = carlasc.open(town).values()
    one = cameras_of(sequence)["front"]
    data = sequence.read("images.front.jpg", 0).tobytes()
    assert decode_image(data, "a.jpg", one, color=True).shape == (225, 400, 3)
    other = encode_image(np.zeros((10, 20), np.uint8), "PNG").tobytes()
    for bad, expected in (
        (data[: len(data) // 2], "a whole JPEG or PNG"),
        (other, "400 x 225 pixels.*, found 20 x 10"),
    ):
        with pytest.raises(FormatError, match=expected) as error:
            decode_image(bad, "a.jpg", one, color=True)
        assert "\n" not in str(error.value)
    with pytest.raises(FormatError, match="a PNG with one integer per pixel"):
        decode_image(data, "a.jpg", one, color=False)
    late = one.replaced(times=sequence.times + 0.25)
    with pytest.raises(
        FormatError, match=r"an image within a frame \(0.100 s\) of the scan, found \+0.250 s"
    ):
        scan_T_camera(sequence, late, 0)


@pytest.mark.slow
def test_six_cameras_take_little_time():
    rng = np.random.default_rng(0)
    spec = GridSpec.published()
    occupied = np.zeros(spec.size, bool)
    occupied[:, :, 0] = True
    occupied[rng.random(spec.size) < 0.02] = True
    ones = [
        camera(yaw, width=1600, height=900, focal=1100.0) for yaw in (0, 60, 120, 180, 240, 300)
    ]
    views = [(one, one.sensor_T_camera) for one in ones]
    boxes = np.sort(rng.integers(0, 256, (spec.num_voxels, 2, 3), np.uint8), axis=1).reshape(-1, 6)
    see_voxels(occupied, spec, views, boxes)
    taken = []
    for _ in range(5):
        began = time.process_time()
        see_voxels(occupied, spec, views, boxes)
        taken.append(time.process_time() - began)
    assert min(taken) < 0.15
