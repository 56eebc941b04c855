import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.readers.pictures import Image, count_gif, read_mp4
from helpers.readers.pixels import BLUE, RED, blue_pixels, grid_with, middle_of, red_pixels

from carlasc import Run
from carlasc.core.geometry import translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLASC11
from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
)
from carlasc.storage import FolderSink, FolderSource, layout
from carlasc.storage.files import to_json
from carlasc.viewing import (
    CameraOptions,
    Scene,
    StyleOptions,
    Viewpoint,
    colorblind_palette,
    render,
)

pytest.importorskip("embreex")

FIXED_ORBIT = CameraOptions(viewpoint=Viewpoint(position=(1, 1, 1)), orbit=True)
SIZE = (320, 180)
COARSE = GridSpec.published("cartesian")


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"))


def write_sequence(
    root, path="Train/Town01_Light/cartesian", frames=4, spec=COARSE, metadata=None, block=RED
):
    """A vehicle that drives 2 m a frame towards a block, another standing beside; points, flow,
    poses, grid.
    """
    writer = FolderSink(root).sequence(path)
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(spec.to_params()))
    for frame in range(frames):
        grid = grid_with({(10 - 2 * frame, 5, -0.5): block}, spec, size_m=2.4)
        writer.write("evaluation/labels", frame, grid.labels)
        writer.write("evaluation/counts", frame, grid.counts)
        points = np.random.default_rng(frame).normal((10 - 2 * frame, 5, -0.5), 0.4, (400, 3))
        writer.write("points", frame, np.column_stack([points, np.zeros(400)]).astype(np.float32))
        writer.write("labels", frame, np.full(400, block, np.uint32))
        writer.write("flow", frame, np.tile(np.array([0, 3, 0], np.float32), (400, 1)))
    poses = np.stack([translation((2.0 * frame, 0, 0)) for frame in range(frames)])
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    if metadata:
        writer.write_document(layout.METADATA, to_json(metadata))
    return root / path


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return write_sequence(tmp_path_factory.mktemp("drive"))


def test_a_frame_becomes_a_png(drive, tmp_path):
    result = render(Scene(drive, frames=(2, 3)), tmp_path / "a.png", style=StyleOptions(size=SIZE))
    assert (result.out, result.frames, result.what, result.pictures) == (
        tmp_path / "a.png",
        (2,),
        ("grid",),
        1,
    )
    shown = picture(result.out)
    assert shown.shape == (180, 320, 3)
    assert red_pixels(shown).any()
    assert list(tmp_path.iterdir()) == [result.out]


def test_a_range_of_frames_becomes_a_film_that_follows_the_vehicle(drive, tmp_path):
    done = []
    result = render(
        Scene(drive, frames=(1, 4)),
        tmp_path / "a.mp4",
        camera=CameraOptions(view="bev"),
        style=StyleOptions(size=SIZE, ego=False, legend=False),
        run=Run(1, progress=lambda *step: done.append(step)),
    )
    meta, frames = read_mp4(result.out)
    assert (result.frames, len(frames), meta["fps"]) == ((1, 2, 3), 3, 10.0)
    assert done == [(1, 3), (2, 3), (3, 3)]
    rows = [middle_of(red_pixels(frame))[1] for frame in frames]
    scale = 180 * 0.98 / 51.2
    # the block comes 2 m nearer a frame
    np.testing.assert_allclose(np.diff(rows), 2 * scale, atol=1.0)


def test_without_frames_a_film_has_all_of_them_and_a_picture_the_first(drive, tmp_path):
    assert render(drive, tmp_path / "a.gif", style=StyleOptions(size=SIZE)).frames == (0, 1, 2, 3)
    assert count_gif(tmp_path / "a.gif") == 4
    assert render(drive, tmp_path / "a.png", style=StyleOptions(size=SIZE)).frames == (0,)


@pytest.mark.parametrize("view", ["bev", "perspective"])
def test_with_a_still_camera_a_static_block_stays_in_place(drive, tmp_path, view):
    render(
        drive,
        tmp_path / "a.gif",
        camera=CameraOptions(view=view, still=True),
        style=StyleOptions(size=SIZE, ego=False, legend=False),
    )
    film, places = Image.open(tmp_path / "a.gif"), []
    for number in range(4):
        film.seek(number)
        places.append(middle_of(red_pixels(np.asarray(film.convert("RGB")))))
    np.testing.assert_allclose(places, np.broadcast_to(places[0], (4, 2)), atol=1.2)


@pytest.mark.slow
def test_two_processes_draw_what_one_draws(drive, tmp_path):
    one, two = (
        render(drive, tmp_path / f"{n}.gif", style=StyleOptions(size=(160, 90)), run=Run(n)).out
        for n in (1, 2)
    )
    assert one.read_bytes() == two.read_bytes()


def test_an_orbit_goes_once_around(drive, tmp_path):
    result = render(
        Scene(drive, frames=(0, 4)),
        tmp_path / "a.gif",
        camera=CameraOptions(orbit=True),
        style=StyleOptions(size=SIZE, ego=False, legend=False),
    )
    assert result.pictures == 4
    film, sides = Image.open(result.out), []
    for number in range(4):
        film.seek(number)
        sides.append(middle_of(red_pixels(np.asarray(film.convert("RGB"))))[0] > 160)
    # the block is ahead on the right: seen from behind, from the right, from ahead, from the left
    assert sides == [True, True, False, False]


def test_an_orbit_keeps_its_distance(tmp_path, monkeypatch):
    monkeypatch.setattr("carlasc.viewing.rendering.render.ORBIT_PICTURES", 8)
    writer = FolderSink(tmp_path).sequence("s")
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(COARSE.to_params()))
    writer.write("evaluation/labels", 0, grid_with({(0, 0, -0.5): RED}, size_m=2.4).labels)
    render(
        tmp_path,
        tmp_path / "a.gif",
        camera=CameraOptions(orbit=True),
        style=StyleOptions(size=SIZE, ego=False, legend=False),
    )
    film, places = Image.open(tmp_path / "a.gif"), []
    for number in range(8):
        film.seek(number)
        places.append(middle_of(red_pixels(np.asarray(film.convert("RGB")))))
    np.testing.assert_allclose(places, np.broadcast_to(places[0], (8, 2)), atol=1.5)


def test_an_orbit_of_one_frame_has_its_own_number_of_pictures_and_rate(
    drive, tmp_path, monkeypatch
):
    monkeypatch.setattr("carlasc.viewing.rendering.render.ORBIT_PICTURES", 5)
    result = render(
        Scene(drive, frames=(1, 2)),
        tmp_path / "a.mp4",
        camera=CameraOptions(orbit=True),
        style=StyleOptions(size=(160, 90)),
    )
    meta, frames = read_mp4(result.out)
    assert (result.frames, len(frames), meta["fps"]) == ((1,), 5, 20.0)
    with pytest.raises(ArgumentError, match="orbit"):
        render(drive, tmp_path / "a.png", camera=CameraOptions(orbit=True))


def test_grid_scan_and_flow_are_drawn_side_by_side(drive, tmp_path):
    result = render(
        drive,
        tmp_path / "a.png",
        what="grid,scan,flow",
        camera=CameraOptions(view="bev"),
        style=StyleOptions(size=(640, 240)),
    )
    assert result.what == ("grid", "scan", "flow")
    shown = red_pixels(picture(result.out))
    columns = [np.flatnonzero(part.any(0)) for part in np.array_split(shown, 3, axis=1)]
    assert all(len(found) for found in columns)


def test_a_prediction_is_drawn_beside_its_truth_and_its_errors(drive, tmp_path):
    prediction = write_sequence(tmp_path / "prediction", block=BLUE)
    result = render(
        Scene(prediction, truth=drive.parents[1]),
        tmp_path / "a.png",
        camera=CameraOptions(view="bev"),
        style=StyleOptions(size=(640, 360), legend=False),
    )
    assert result.what == ("grid", "truth", "errors")
    shown = picture(result.out)
    predicted, true = middle_of(blue_pixels(shown)), middle_of(red_pixels(shown[:180]))
    assert predicted[0] < true[0]
    assert predicted[1] == pytest.approx(true[1], abs=2)


def test_a_prediction_in_eleven_classes_is_compared_with_a_truth_in_twenty_three(drive, tmp_path):
    prediction = write_sequence(
        tmp_path / "p", metadata={"classes": "carlasc11"}, block=CARLASC11.id_of("Pedestrian")
    )
    options = {
        "what": "errors",
        "camera": CameraOptions(view="bev"),
        "style": StyleOptions(size=SIZE, ego=False, legend=False),
    }
    result = render(Scene(prediction, truth=drive), tmp_path / "a.png", **options)
    assert result.classes == "carlasc11"
    wrong = write_sequence(tmp_path / "w", block=BLUE)
    wrong = render(Scene(wrong, truth=drive), tmp_path / "b.png", **options)

    def orange(path):
        return (np.abs(picture(path).astype(int) - (213, 70, 0)).max(-1) < 20).any()

    assert orange(wrong.out) and not orange(result.out)


def test_a_prediction_beside_the_data_is_shown_in_its_own_classes(tmp_path):
    """Scans are CARLA's 4, a pedestrian; the prediction's params.json says eleven classes, of which
    6 is road.
    """
    folder = write_sequence(tmp_path)
    params = COARSE.to_params() | {"carlasc": {"classes": "carlasc11"}}
    writer = FolderSink(tmp_path).sequence("Train/Town01_Light/cartesian")
    writer.write_document(f"completion/{layout.PARAMS}", to_json(params))
    writer.write(
        "completion/labels",
        0,
        grid_with({(10, 5, -0.5): CARLASC11.id_of("Road")}, COARSE, size_m=2.4).labels,
    )
    options = {
        "camera": CameraOptions(view="bev"),
        "style": StyleOptions(size=SIZE, ego=False, legend=False),
    }
    scene = Scene(folder, grid="completion")
    result = render(scene, tmp_path / "a.png", **options)
    assert result.classes == "carlasc11"

    def shows(path, name):
        color = np.array(CARLASC11.palette[CARLASC11.id_of(name)])
        return (np.abs(picture(path).astype(int) - color).max(-1) < 40).any()

    assert shows(result.out, "Road")
    both = render(scene, tmp_path / "b.png", what="grid,scan", **options)
    assert shows(both.out, "Road") and shows(both.out, "Pedestrian")
    wrong = render(replace(scene, truth=folder), tmp_path / "c.png", what="errors", **options)
    assert (np.abs(picture(wrong.out).astype(int) - (213, 70, 0)).max(-1) < 20).any()


def test_the_papers_eleven_classes_can_be_shown(drive, tmp_path):
    result = render(
        Scene(drive, classes="carlasc11", palette="colorblind"),
        tmp_path / "a.png",
        style=StyleOptions(size=(640, 360)),
    )
    assert result.classes == "carlasc11"
    legend = picture(result.out)[-40:]
    color = colorblind_palette(CARLASC11)[CARLASC11.id_of("Pedestrian")]
    assert (legend == color).all(-1).any()
    with pytest.raises(ArgumentError, match="semantickitti19"):
        render(Scene(drive, classes="semantickitti19"), tmp_path / "b.png")
    with pytest.raises(ArgumentError, match="'mine'"):
        render(Scene(drive, classes="mine"), tmp_path / "b.png")


def test_data_with_y_on_the_left_are_drawn_with_left_on_the_left(tmp_path):
    sequence = write_sequence(tmp_path, metadata={"frame": "kitti"})
    render(
        sequence,
        tmp_path / "a.png",
        camera=CameraOptions(view="bev"),
        style=StyleOptions(size=SIZE, ego=False, legend=False),
    )
    assert middle_of(red_pixels(picture(tmp_path / "a.png")))[0] < 160


def test_the_legend_of_a_film_is_that_of_all_its_frames(tmp_path):
    writer = FolderSink(tmp_path).sequence("s/cartesian")
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(COARSE.to_params()))
    for frame, label in enumerate((RED, BLUE)):
        writer.write("evaluation/labels", frame, grid_with({(0, 0, -0.5): label}).labels)
    render(tmp_path, tmp_path / "a.mp4", style=StyleOptions(size=(640, 360)))
    for frame in read_mp4(tmp_path / "a.mp4")[1]:
        assert red_pixels(frame[-40:]).any() and blue_pixels(frame[-40:]).any()


@pytest.mark.parametrize(
    "ending",
    [
        "evaluation/000002.label",
        "evaluation/000002.bin",
        "labels/000002.label",
        "velodyne/000002.bin",
    ],
)
def test_a_frames_file_is_that_frame(drive, tmp_path, ending):
    result = render(drive / ending, tmp_path / "a.png", style=StyleOptions(size=SIZE))
    assert result.frames == (2,)
    assert result.what == (("grid",) if ending.startswith("evaluation") else ("scan",))
    assert red_pixels(picture(result.out)).any()


def test_every_kind_of_source_gives_the_same_picture(drive, tmp_path):
    source = FolderSource(drive.parents[2])
    (sequence,) = source.sequences().values()
    paths = [drive, drive.parent, drive.parents[2], drive / "evaluation", source, sequence]
    shown = [
        render(path, tmp_path / f"{i}.png", style=StyleOptions(size=SIZE)).out.read_bytes()
        for i, path in enumerate(paths)
    ]
    assert len(set(shown)) == 1


def test_the_first_of_several_sequences_is_shown_and_noted(tmp_path):
    for name in ("Town01_Light", "Town02_Heavy"):
        write_sequence(
            tmp_path / "set",
            f"Train/{name}/cartesian",
            frames=1,
            block=RED if "1" in name else BLUE,
        )
    result = render(tmp_path / "set", tmp_path / "a.png", style=StyleOptions(size=SIZE))
    assert result.sequence == "Train/Town01_Light/cartesian"
    assert "2 sequences" in result.notes[0] and "Town01_Light" in result.notes[0]
    other = render(
        Scene(tmp_path / "set", sequence="Town02_Heavy"),
        tmp_path / "b.png",
        style=StyleOptions(size=SIZE),
    )
    assert blue_pixels(picture(other.out)).any()
    with pytest.raises(MissingDataError, match="Town03"):
        render(Scene(tmp_path / "set", sequence="Town03"), tmp_path / "c.png")


def test_without_a_name_the_file_is_named_after_the_sequence(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(render(drive, style=StyleOptions(size=SIZE)).out) == "Town01_Light_000000.png"
    assert (
        str(render(Scene(drive, frames=(3, 4)), what="scan", style=StyleOptions(size=SIZE)).out)
        == "Town01_Light_scan_000003.png"
    )
    assert (
        str(render(Scene(drive, frames=(0, 2)), style=StyleOptions(size=SIZE)).out)
        == "Town01_Light_000000-000001.mp4"
    )


def test_an_empty_grid_is_noted(tmp_path):
    writer = FolderSink(tmp_path).sequence("s")
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(COARSE.to_params()))
    writer.write("evaluation/labels", 0, np.zeros(COARSE.size, np.uint32))
    result = render(tmp_path / "s", tmp_path / "a.png", style=StyleOptions(size=SIZE))
    assert result.notes == ("grid: no voxel is occupied",)
    assert result.out.is_file()


@pytest.mark.parametrize(
    ("scene", "options", "error", "message"),
    [
        ({"frames": (9, 10)}, {}, MissingDataError, "expected frames 9:10, found 0 to 3"),
        ({"frames": (7, 9)}, {}, MissingDataError, "expected frames 7:9"),
        ({"frames": (2, 2)}, {}, ArgumentError, "frames: expected a range that holds a frame"),
        ({"every": 0}, {}, ArgumentError, "every: expected 1 or more"),
        ({"classes": "mine"}, {}, ArgumentError, "classes: .*carlasc11.* found 'mine'"),
        ({"source_classes": "mine"}, {}, ArgumentError, "source_classes: .* found 'mine'"),
        ({"grid": "evaluation_256x256x16"}, {}, MissingDataError, "evaluation_256x256x16"),
        ({"palette": "rainbow"}, {}, ArgumentError, "palette: .* found 'rainbow'"),
        ({"truth": "nowhere"}, {}, MissingDataError, "nowhere"),
        ({}, {"what": "votes"}, ArgumentError, "what: .* found 'votes'"),
        (
            {},
            {"what": "errors"},
            ArgumentError,
            "what: errors needs a ground truth: give it with `truth`",
        ),
        ({}, {"camera": FIXED_ORBIT, "out": "a.gif"}, ArgumentError, "orbit"),
        ({}, {"out": "a.jpg"}, ArgumentError, "a.jpg"),
        ({"frames": (0, 3)}, {"out": "a.png"}, ArgumentError, "a single frame for a PNG"),
        ({}, {"out": "a.gif", "fps": -3.0}, ArgumentError, "fps"),
    ],
)
def test_impossible_arguments_are_refused_in_one_line_and_leave_no_file(
    drive, tmp_path, monkeypatch, scene, options, error, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message) as caught:
        render(Scene(drive, **scene), **options)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_impossible_cameras_and_styles_are_refused_when_they_are_made():
    with pytest.raises(ArgumentError, match="view: .* found 'front'"):
        CameraOptions(view="front")
    with pytest.raises(ArgumentError, match="size"):
        StyleOptions(size=(10, 10))


def test_bad_input_names_the_file(drive, tmp_path):
    with pytest.raises(MissingDataError, match="nowhere"):
        render(tmp_path / "nowhere", tmp_path / "a.png")
    lone = tmp_path / "000000.label"
    lone.write_bytes(b"\0" * 64)
    with pytest.raises(FormatError, match=r"000000.label: .*params.json"):
        render(lone, tmp_path / "a.png")
    broken = write_sequence(tmp_path / "broken", frames=1)
    (broken / "evaluation/000000.label").write_bytes(b"\0" * 64)
    with pytest.raises(FormatError, match=r"000000.label: expected 524288 bytes"):
        render(broken, tmp_path / "a.png")
    labels = np.full(COARSE.size, 77, np.uint32)
    (broken / "evaluation/000000.label").write_bytes(labels.tobytes())
    with pytest.raises(FormatError, match="found 77"):
        render(broken, tmp_path / "a.png")


def test_a_truth_of_another_geometry_is_refused(drive, tmp_path):
    other = write_sequence(tmp_path / "fine", spec=GridSpec.published("fine"), frames=1)
    with pytest.raises(ArgumentError, match="256 x 256 x 16"):
        render(Scene(drive, truth=other), tmp_path / "a.png")


def test_still_needs_poses(tmp_path):
    sequence = write_sequence(tmp_path, frames=2)
    (sequence / layout.POSES).unlink()
    with pytest.raises(CarlascError, match=r"poses.txt"):
        render(
            sequence,
            tmp_path / "a.gif",
            camera=CameraOptions(still=True),
            style=StyleOptions(size=SIZE),
        )


def test_an_existing_file_is_replaced_only_with_overwrite(drive, tmp_path):
    out = tmp_path / "a.png"
    out.write_bytes(b"mine")
    with pytest.raises(ConflictError, match="overwrite=True"):
        render(drive, out, style=StyleOptions(size=SIZE))
    assert out.read_bytes() == b"mine"
    render(drive, out, style=StyleOptions(size=SIZE), overwrite=True)
    assert red_pixels(picture(out)).any()


def test_ctrl_c_leaves_no_file(drive, tmp_path):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(drive, tmp_path / "a.mp4", style=StyleOptions(size=SIZE), run=Run(1, progress=stop))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "package"),
    [("embreex", "embreex"), ("PIL", "PIL"), ("imageio_ffmpeg", "imageio_ffmpeg")],
)
def test_a_missing_package_is_named_with_its_extra(drive, tmp_path, monkeypatch, module, package):
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DependencyError, match=rf"{package}.*pip install .*\[render\]'") as caught:
        render(Scene(drive, frames=(0, 1)), tmp_path / "a.mp4", style=StyleOptions(size=SIZE))
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_panels_are_titled_by_what_they_show(drive, tmp_path, monkeypatch):
    from carlasc.viewing.rendering import pictures

    titles = []
    original = pictures.draw_page
    monkeypatch.setattr(
        pictures, "draw_page", lambda *a, **k: titles.append(a[2]) or original(*a, **k)
    )
    for scene, options in (
        (Scene(drive, truth=drive), {}),
        (drive, {"what": "grid,scan,flow"}),
        (drive, {"camera": CameraOptions(view="both")}),
        (drive, {}),
    ):
        render(
            scene, tmp_path / "a.png", style=StyleOptions(size=(160, 90)), overwrite=True, **options
        )
    cells = "cartesian 128 x 128 x 8"
    assert titles[0] == ["prediction", "truth", "errors"]
    assert titles[1][1:] == ["scan", "scene flow"] and titles[1][0].endswith(
        cells.split(maxsplit=1)[1]
    )
    assert titles[2] == ["", ""] and titles[3] == [""]


def test_both_views_are_the_perspective_one_and_beside_it_the_one_from_above(drive, tmp_path):
    both, above = (
        picture(
            render(
                drive,
                tmp_path / f"{view}.png",
                camera=CameraOptions(view=view),
                style=StyleOptions(size=size, ego=False, legend=False),
            ).out
        )
        for view, size in (("both", (361, 180)), ("bev", (175, 180)))
    )
    places = [middle_of(red_pixels(part)) for part in (both[:, -175:], above)]
    np.testing.assert_allclose(places[0], places[1], atol=3)


def test_a_picture_shows_the_first_frame_and_every_chooses_others(drive, tmp_path):
    first, same, other = (
        render(scene, tmp_path / f"{number}.png", style=StyleOptions(size=SIZE)).out.read_bytes()
        for number, scene in enumerate(
            (drive, Scene(drive, frames=(0, 1)), Scene(drive, frames=(3, 4)))
        )
    )
    assert first == same != other
    assert render(
        Scene(drive, every=3), tmp_path / "d.gif", style=StyleOptions(size=(160, 90))
    ).frames == (0, 3)


def test_missed_voxels_are_those_of_the_truth_and_invented_ones_those_of_the_prediction(
    drive, tmp_path
):
    writer = FolderSink(tmp_path).sequence("p/Town01_Light/cartesian")
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(COARSE.to_params()))
    writer.write("evaluation/labels", 0, grid_with({(-10, -5, -0.5): RED}, size_m=2.4).labels)
    options = {
        "what": "errors",
        "camera": CameraOptions(view="bev"),
        "style": StyleOptions(size=SIZE, ego=False, legend=False),
    }
    shown = picture(
        render(Scene(tmp_path / "p", truth=drive), tmp_path / "a.png", **options).out
    ).astype(int)
    for color, ahead, right in (((16, 90, 190), 10, 5), ((240, 200, 40), -10, -5)):
        column, row = middle_of(np.abs(shown - color).max(-1) < 10)
        assert column - 160 == pytest.approx(right * 180 * 0.98 / 51.2, abs=4)
        assert 90 - row == pytest.approx(ahead * 180 * 0.98 / 51.2, abs=4)


def test_an_orbit_shows_the_corners_of_the_grid_from_every_side(tmp_path, monkeypatch):
    monkeypatch.setattr("carlasc.viewing.rendering.render.ORBIT_PICTURES", 8)
    writer = FolderSink(tmp_path).sequence("s")
    writer.write_document(f"evaluation/{layout.PARAMS}", to_json(COARSE.to_params()))
    writer.write("evaluation/labels", 0, grid_with({(23, 23, -0.5): RED}, size_m=4.0).labels)
    film = Image.open(
        render(
            tmp_path,
            tmp_path / "a.gif",
            camera=CameraOptions(orbit=True),
            style=StyleOptions(size=SIZE, ego=False, legend=False),
        ).out
    )
    for number in range(8):
        film.seek(number)
        red = red_pixels(np.asarray(film.convert("RGB")))
        assert red.any() and not (red[0] | red[-1]).any() and not (red[:, 0] | red[:, -1]).any()
