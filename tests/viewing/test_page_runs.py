"""What a page holds besides grids and points: poses, evidence, scores, a second run; and the folder
of a page.
"""

import json
import re
import tracemalloc

import numpy as np
import pytest
from helpers.readers.page_arrays import unpack_arrays
from helpers.readers.pixels import BLUE, RED
from helpers.scenes.road_blocks import add_evidence, add_poses, write_blocks

from carlasc.core.grids import GridSpec, VoxelFlag
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.storage import open as open_source
from carlasc.viewing import Scene, view
from carlasc.viewing.page.contents import open_content


def described(path):
    return json.loads(re.search(r'id="scene">(.*?)</script>', path.read_text())[1])


def test_a_page_holds_the_poses_of_its_frames(golden_capture, tmp_path):
    scene = described(
        view(Scene(golden_capture / "cartesian", frames=(1, 3)), tmp_path / "a.html").out
    )
    (sequence,) = open_source(golden_capture / "cartesian").sequences().values()
    for frame, pose in zip(scene["frames"], scene["poses"], strict=True):
        assert np.allclose(np.reshape(pose, (3, 4)), sequence.read_pose(frame)[:3], atol=1e-5)


def test_without_poses_there_is_no_path(blocks, tmp_path):
    assert described(view(blocks, tmp_path / "a.html").out)["poses"] is None


def test_predictions_take_the_poses_of_the_truth(tmp_path):
    truth = write_blocks(tmp_path / "truth" / "cartesian", frames=2)
    add_poses(truth, [0, 0])
    prediction = write_blocks(tmp_path / "prediction" / "cartesian", frames=2, points=False)
    scene = described(view(Scene(prediction, truth=truth), tmp_path / "a.html").out)
    assert [pose[3] for pose in scene["poses"]] == [0, 5]


def test_evidence_of_the_occupied_voxels_is_in_the_page(tmp_path):
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=1)
    add_evidence(folder, frames=1)
    content = open_content(Scene(folder), 0.2)
    arrays, _ = content.read(0)
    label = arrays["panel0/label"]
    assert content.panels[0].evidence == ("occupied", "views", "flags")
    assert set(arrays["panel0/flags"][label == RED]) == {VoxelFlag.INFERRED}
    assert set(arrays["panel0/flags"][label == BLUE]) == {VoxelFlag.IN_ACTOR | VoxelFlag.SEEN_NOW}
    assert set(arrays["panel0/occupied"][label == RED]) == {153}  # 0.6 of 255
    assert set(arrays["panel0/views"][label == RED]) == {0} and arrays["panel0/views"].max() == 40
    assert len(arrays["panel0/flags"]) == len(label)


def test_scores_are_those_of_each_frame(blocks, tmp_path):
    prediction = write_blocks(
        tmp_path / "pred" / "Town01_Light" / "cartesian", shift=3.0, points=False
    )
    scene = described(view(Scene(prediction, truth=blocks), tmp_path / "a.html").out)
    predicted, true = (
        open_source(folder).sequences().popitem()[1] for folder in (prediction, blocks)
    )
    for at, frame in enumerate(scene["frames"]):
        grid, truth = predicted.grid("evaluation", frame), true.grid("evaluation", frame)
        a, b = grid.labels[truth.known], truth.labels[truth.known]
        classes = [c for c in np.union1d(a, b) if c]
        each = [((a == c) & (b == c)).sum() / ((a == c) | (b == c)).sum() for c in classes]
        assert scene["scores"]["miou"][0][at] == pytest.approx(np.mean(each), abs=1e-5)
        iou = ((a > 0) & (b > 0)).sum() / ((a > 0) | (b > 0)).sum()
        assert scene["scores"]["iou"][0][at] == pytest.approx(iou, abs=1e-5)
        assert 0 < iou < 1
    assert described(view(blocks, tmp_path / "b.html").out)["scores"] is None


def test_two_runs_share_panels_and_are_named_by_what_differs(blocks, tmp_path):
    tube, align = (
        write_blocks(tmp_path / name / "Town01_Light" / "cartesian", shift=shift, points=False)
        for name, shift in (("tube", 3.0), ("align", 0.0))
    )
    result = view(Scene(tube, truth=blocks), tmp_path / "a.html", beside=align)
    assert result.panels == ("tube", "truth", "errors of tube", "align", "errors of align")
    scene = described(result.out)
    assert [panel["beside"] for panel in scene["panels"]] == [3, None, 4, None, None]
    assert [panel["run"] for panel in scene["panels"]] == [0, 0, 0, 1, 1]
    assert scene["runs"] == ["tube", "align"]
    assert scene["scores"]["miou"][1] == [1, 1, 1] and max(scene["scores"]["miou"][0]) < 1


def test_another_grid_of_the_same_sequence_is_a_second_run(tmp_path):
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=2)
    (folder / "evaluation").rename(folder / "fine")
    write_blocks(folder, frames=3, spec=GridSpec.published().with_size((32, 32, 4)))
    result = view(folder, tmp_path / "a.html", beside_grid="fine")
    assert result.panels == ("evaluation", "fine") and result.frames == (0, 1)
    assert [panel["size"][0] for panel in described(result.out)["panels"]] == [32, 64]
    # a grid's folder says the same
    result = view(folder, tmp_path / "b.html", beside=folder / "fine")
    assert result.panels == ("evaluation", "fine")


def test_runs_that_cannot_be_compared_are_refused(blocks, tmp_path):
    right = write_blocks(tmp_path / "r" / "cartesian", metadata={"axes": "right"}, points=False)
    with pytest.raises(ArgumentError, match="the same axes"):
        view(blocks, tmp_path / "a.html", beside=right)
    with pytest.raises(
        MissingDataError, match="expected one of the frames 2 to 2, found frames 0 to 1"
    ):
        other = write_blocks(tmp_path / "o" / "cartesian", frames=2, points=False)
        view(Scene(blocks, frames=(2, 3)), tmp_path / "a.html", beside=other)
    with pytest.raises(MissingDataError, match="the grid fine"):
        view(blocks, tmp_path / "a.html", beside_grid="fine")
    coarse = write_blocks(
        tmp_path / "c" / "cartesian", spec=GridSpec.published().with_size((32, 32, 4)), points=False
    )
    with pytest.raises(ArgumentError, match="the geometry"):
        view(Scene(blocks, truth=blocks), tmp_path / "a.html", beside=coarse)
    assert not (tmp_path / "a.html").exists()


def test_a_folder_holds_the_whole_sequence_one_file_per_frame(tmp_path):
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=1, points=False)
    for frame in range(1, 65):
        for kind in ("label", "bin"):
            (folder / "evaluation" / f"{frame:06d}.{kind}").symlink_to(
                folder / "evaluation" / f"000000.{kind}"
            )
    result = view(folder, tmp_path / "page")
    assert result.frames == tuple(range(65)) and result.notes == ()
    files = sorted(
        path.relative_to(result.out).as_posix() for path in result.out.rglob("*") if path.is_file()
    )
    assert files == [*(f"frames/{n:06d}.bin" for n in range(65)), "index.html"]
    assert result.size_bytes == sum((result.out / name).stat().st_size for name in files)
    text = (result.out / "index.html").read_text()
    assert "connect-src 'self'" in text and 'id="frame0"' not in text
    scene = described(result.out / "index.html")
    assert scene["embedded"] is False and scene["frames"] == list(range(65))
    arrays = unpack_arrays((result.out / "frames/000064.bin").read_bytes())
    index = np.cumsum(arrays["panel0/index"].astype(np.int64))
    (sequence,) = open_source(folder).sequences().values()
    assert np.array_equal(index, np.flatnonzero(sequence.grid("evaluation", 64).labels))


def test_a_folder_is_replaced_only_if_it_is_a_page_and_with_overwrite(blocks, tmp_path):
    out = tmp_path / "page"
    out.mkdir()
    view(Scene(blocks, frames=(0, 3)), out)  # an empty folder is no conflict
    with pytest.raises(ConflictError, match="overwrite=True"):
        view(blocks, out)
    view(Scene(blocks, frames=(0, 1)), out, overwrite=True)
    assert [path.name for path in (out / "frames").iterdir()] == ["000000.bin"]
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "index.html").write_text("mine")
    with pytest.raises(ConflictError, match="a folder with other files"):
        view(blocks, mine, overwrite=True)
    assert (mine / "index.html").read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConflictError, match="found a file"):
        view(blocks, tmp_path / "file", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine", "page"]


def test_a_page_is_written_into_the_working_folder(blocks, tmp_path, monkeypatch):
    (tmp_path / "site").mkdir()
    monkeypatch.chdir(tmp_path / "site")
    view(Scene(blocks, frames=(0, 1)), ".")
    assert sorted(path.name for path in (tmp_path / "site").iterdir()) == ["frames", "index.html"]
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@pytest.mark.parametrize("name", ["page", "page.html"])
def test_a_run_that_fails_leaves_nothing_and_keeps_the_old_page(tmp_path, name):
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=3, points=False)
    out = tmp_path / "pages" / name
    view(folder, out)
    before = {path: path.read_bytes() for path in (tmp_path / "pages").rglob("*") if path.is_file()}
    (folder / "evaluation" / "000002.label").write_bytes(b"cut short")
    with pytest.raises(FormatError, match="000002"):
        view(folder, out, overwrite=True)
    assert {
        path: path.read_bytes() for path in (tmp_path / "pages").rglob("*") if path.is_file()
    } == before


@pytest.mark.parametrize("name", ["page", "page.html"])
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path, name):
    rng = np.random.default_rng(0)
    folder = write_blocks(tmp_path / "a" / "cartesian", frames=2, points=False)
    noise = rng.integers(1, 20, 64 * 64 * 4).astype(np.uint32)  # compresses badly: 16 kB per frame
    noise.tofile(folder / "evaluation/000000.label")
    for frame in range(2, 40):
        (folder / f"evaluation/{frame:06d}.label").symlink_to(folder / "evaluation/000000.label")
        (folder / f"evaluation/{frame:06d}.bin").symlink_to(folder / "evaluation/000000.bin")
    view(Scene(folder, frames=(0, 2)), tmp_path / f"first-{name}")
    peaks = []
    for count in (4, 40):
        tracemalloc.start()
        result = view(Scene(folder, frames=(0, count)), tmp_path / f"{count}-{name}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert len(result.frames) == 40
    assert peaks[1] < peaks[0] + 100_000  # 36 more frames are 800 kB of blocks
