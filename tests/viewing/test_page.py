import base64
import json
import re

import numpy as np
import pytest
from helpers.readers.page_arrays import unpack_arrays
from helpers.scenes.road_blocks import write_blocks

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.storage import open as open_source
from carlasc.viewing import Scene, view


def read_page(path):
    """Return the page's text, the scene it describes, and the arrays of its frames."""
    text = path.read_text()
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', text)[1])
    frames = re.findall(r'id="frame\d+">(.*?)</script>', text)
    return text, scene, [unpack_arrays(base64.b64decode(frame)) for frame in frames]


def test_a_page_holds_the_grids_as_they_are(golden_capture, tmp_path):
    result = view(golden_capture / "cartesian", tmp_path / "scene.html")
    _, scene, frames = read_page(result.out)
    (sequence,) = open_source(golden_capture / "cartesian").sequences().values()
    assert scene["frames"] == [0, 1, 2] == list(result.frames)
    assert scene["times"] == pytest.approx([0, 0.1, 0.2])
    assert scene["panels"][0]["lower"] == list(sequence.grids["evaluation"].lower)
    for frame, arrays in zip(scene["frames"], frames, strict=True):
        grid = sequence.grid("evaluation", frame)
        index = np.cumsum(arrays["panel0/index"].astype(np.int64))
        assert np.array_equal(index, np.flatnonzero(grid.labels))
        assert np.array_equal(arrays["panel0/label"], grid.labels.reshape(-1)[index])
        assert np.array_equal(arrays["panel0/votes"], grid.counts.reshape(-1)[index])


def test_a_page_describes_classes_panels_and_axes(blocks, tmp_path):
    prediction = write_blocks(tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0)
    _, scene, frames = read_page(view(Scene(prediction, truth=blocks), tmp_path / "a.html").out)
    assert scene["leftHanded"] is True
    assert scene["tables"]["carla"][4] == ["Pedestrian", "#dc143c"]
    assert scene["tables"]["errors"][1:] == [
        ["right class", "#cdd1d6"],
        ["wrong class", "#d54600"],
        ["missed: predicted free", "#105abe"],
        ["invented: free in truth", "#f0c828"],
    ]
    assert scene["colorBy"] == "class"
    assert [panel["title"] for panel in scene["panels"]] == ["prediction", "truth", "errors"]
    assert [panel["table"] for panel in scene["panels"]] == ["carla", "carla", "errors"]
    assert scene["panels"][0]["upper"] == pytest.approx([25.6, 25.6, 1.0], abs=1e-3)
    assert (scene["pointTable"], scene["hasPoints"], scene["hasFlow"], scene["pointCell"]) == (
        "carla",
        True,
        True,
        0.2,
    )
    own, truth, errors = (frames[1][f"panel{number}/label"] for number in range(3))
    assert (own == 4).sum() == (truth == 4).sum() > 0 and set(np.unique(errors)) == {1, 3, 4}
    assert {"actors/arrows", "scan/label"} <= set(frames[1])


def test_data_with_y_on_the_left_say_so_in_the_page(tmp_path):
    folder = write_blocks(
        tmp_path / "a" / "cartesian", frames=1, metadata={"frame": "kitti"}, points=False
    )
    _, scene, _ = read_page(view(folder, tmp_path / "scene.html").out)
    assert (scene["leftHanded"], scene["hasPoints"], scene["hasFlow"]) == (False, False, False)


def test_a_page_loads_nothing_from_a_network(golden_capture, tmp_path):
    text, _, _ = read_page(
        view(Scene(golden_capture / "cartesian", frames=(0, 1)), tmp_path / "scene.html").out
    )
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=[\"'](?!data:)", text)
    assert "default-src 'none'" in text
    assert "Permission is hereby granted" in text  # three.js's licence goes with it
    assert "{{" not in text.split("<script>")[0]


def test_a_name_cannot_break_the_page(tmp_path):
    folder = write_blocks(tmp_path / "a<script>alert(1)<b" / "cartesian", frames=1, points=False)
    text, scene, _ = read_page(view(folder, tmp_path / "scene.html").out)
    assert scene["name"] == "a<script>alert(1)<b"
    assert "<script>alert" not in text


def test_a_page_shows_the_first_sixty_frames_unless_a_range_is_given(tmp_path):
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=1, points=False)
    for frame in range(1, 65):
        for kind in ("label", "bin"):
            (folder / "evaluation" / f"{frame:06d}.{kind}").symlink_to(
                folder / "evaluation" / f"000000.{kind}"
            )
    result = view(folder, tmp_path / "a.html")
    assert result.frames == tuple(range(60)) and result.notes == (
        "65 frames found, showing the first 60",
    )
    ranged = view(Scene(folder, frames=(1, 65)), tmp_path / "b.html")
    assert ranged.frames == tuple(range(1, 65)) and ranged.notes == ()


def test_what_cannot_be_written_is_refused(blocks, tmp_path):
    with pytest.raises(MissingDataError, match="expected frames 7:9, found 0 to 2"):
        view(Scene(blocks, frames=(7, 9)), tmp_path / "a.html")
    with pytest.raises(ArgumentError, match=r"\.html"):
        view(blocks, tmp_path / "a.pdf")
    with pytest.raises(ArgumentError, match="every"):
        view(Scene(blocks, every=0), tmp_path / "a.html")
    with pytest.raises(ArgumentError, match="palette: expected class or colorblind"):
        view(Scene(blocks, palette="height"), tmp_path / "a.html")
    for thin_m in (0, 11):
        with pytest.raises(ArgumentError, match="thin_m: expected 0.01 to 10 metres"):
            view(blocks, tmp_path / "a.html", thin_m=thin_m)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.html").write_text("mine")
    with pytest.raises(ConflictError, match="overwrite=True"):
        view(blocks, tmp_path / "a.html")


@pytest.mark.slow
def test_sixty_dense_frames_stay_under_fifteen_megabytes(tmp_path):
    """A frame as full as a real one: 130,000 points, a coarse grid of 20,000 voxels; its bytes
    times 60.
    """
    from helpers.scenes.box_street import Street

    from carlasc.core.geometry import translation
    from carlasc.storage.folder import FolderSink

    rng = np.random.default_rng(0)
    points, labels = Street.random().scan(translation((0, 0, 1.8)), rng, channels=64, columns=2031)
    writer = FolderSink(tmp_path).sequence("cartesian")
    spec = GridSpec.published()
    grid = np.zeros(spec.size, np.uint32)
    flat = spec.flat_index(points)
    grid.reshape(-1)[flat[flat >= 0]] = labels[flat >= 0]
    grid[:, :, 0] = np.where(rng.random((128, 128)) < 0.95, 7, grid[:, :, 0])
    writer.write_document("evaluation/params.json", json.dumps(spec.to_params()).encode())
    writer.write("evaluation/labels", 0, grid)
    writer.write(
        "evaluation/counts",
        0,
        np.where(rng.random(spec.size) < 0.7, rng.integers(1, 21, spec.size), 0).astype(np.float32),
    )
    writer.write("points", 0, np.column_stack([points, np.zeros(len(points), np.float32)]))
    writer.write("labels", 0, labels.astype(np.uint32))
    assert len(points) > 90_000 and (grid > 0).sum() > 15_000
    result = view(tmp_path / "cartesian", tmp_path / "scene.html")
    text, _, _ = read_page(result.out)
    frame = len(re.search(r'id="frame0">(.*?)</script>', text)[1])
    assert result.size_bytes + 59 * frame < 15e6
    assert result.size_bytes < 1.2e6
