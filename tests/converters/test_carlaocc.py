import shutil
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.carlaocc import CarlaOcc, CarlaOccRecording
from converters.formats.carlaocc import (
    FIRST_ACTOR,
    SURROUND,
    TAG_OF_KIND,
    TAGS,
    mesh_voxels,
    write_carlaocc,
)

import carlasc
from carlasc import FromScans
from carlasc.converting import convert
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, CARLAOCC
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError
from carlasc.groundtruth import GridOptions
from carlasc.running import Run
from carlasc.storage import layout
from carlasc.testing import KINDS, ConverterContract, SimulatedDrive
from carlasc.testing.drives import world_T_sensor

DRIVE = SimulatedDrive(frames=3, channels=10, columns=90)
BOUNDS = (0.0, -6.4, -2.4), (12.8, 6.4, 4.0)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("carlaocc")
    write_carlaocc(folder, DRIVE)
    return folder


@pytest.fixture
def sequence(root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(root / "Town01_Opt_Seq07", tmp_path / "Town01_Opt_Seq07"))


def recording(folder: Path, **options: str) -> CarlaOccRecording:
    found = CarlaOcc(folder, **options).sequences()[0]
    assert isinstance(found, CarlaOccRecording)
    return found


def test_scans_hold_the_points_the_tags_and_the_actors_that_may_move(root: Path) -> None:
    found = recording(root)
    assert [frame.number for frame in found.frames] == [0, 1, 2]
    for frame in found.frames:
        truth = DRIVE.scan(frame.number)
        (cloud,) = frame.read()
        # four decimals
        np.testing.assert_allclose(cloud.points[:, :3], truth.points[:, :3], rtol=2e-7, atol=5.1e-5)
        assert cloud.points.dtype == np.float32
        np.testing.assert_array_equal(cloud.labels, TAG_OF_KIND[truth.kinds])
        expected = np.where(truth.instances > 0, truth.instances + FIRST_ACTOR, 0)
        # none of poles, which have an ObjIdx too
        np.testing.assert_array_equal(cloud.instances, expected)
        assert expected.any()


def test_poses_and_times_are_those_of_the_simulation(root: Path) -> None:
    found = recording(root)
    times = found.times()
    trajectory = found.poses()
    assert trajectory is not None
    np.testing.assert_allclose(times, DRIVE.times, atol=1e-12)
    for frame in range(DRIVE.frames):
        np.testing.assert_allclose(
            trajectory.at(times)[frame], world_T_sensor(DRIVE, frame), atol=1e-6
        )
    assert found.sensors[0].height_m == pytest.approx(1.73)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1000, 2048])
def test_grids_of_meshes_are_read_whichever_way_their_labels_are_written(
    tmp_path: Path, factor: int
) -> None:
    write_carlaocc(tmp_path, DRIVE, factor=factor)
    found = recording(tmp_path)
    assert found.voxels == SURROUND
    assert found.frames[1].read_voxels() is None
    for number in (0, 2):
        content = found.frames[number].read_voxels()
        assert content is not None
        tags, _ = mesh_voxels(DRIVE, number, SURROUND)
        np.testing.assert_array_equal(content.labels, tags)
        assert content.known.all()
        assert {1, 3, 6, 9, 12, 13, 14, 15} <= set(np.unique(content.labels).tolist())


def test_an_occupied_voxel_without_a_class_is_unknown(sequence: Path) -> None:
    path = sequence / "occupancy" / "vs_0_4_surround_view" / "0000.npz"
    arrays = dict(np.load(path))
    arrays["occupancy"][0, 3] = 5  # class 0, instance 5
    np.savez(path, **arrays)
    content = recording(sequence).frames[0].read_voxels()
    assert content is not None
    cell = tuple(arrays["occupancy"][0, :3].tolist())
    assert not content.known[cell]
    assert (~content.known).sum() == 1
    assert content.labels[cell] == 0


def test_an_option_names_the_grid(tmp_path: Path) -> None:
    forward = GridSpec("cartesian", (64, 64, 32), *BOUNDS).with_bounds(*BOUNDS)
    write_carlaocc(tmp_path, DRIVE, grids={"vs_0_2_forward_view": forward, "own": SURROUND})
    assert recording(tmp_path).voxels == forward
    assert recording(tmp_path, voxels="own").voxels == SURROUND
    with pytest.raises(
        ArgumentError, match="voxels: expected one of own, vs_0_2_forward_view, found vs_9"
    ):
        CarlaOcc(tmp_path, voxels="vs_9").sequences()


def test_scans_without_grids_are_a_recording_too(tmp_path: Path) -> None:
    write_carlaocc(tmp_path, DRIVE, grids={})
    found = recording(tmp_path)
    assert found.voxels is None
    assert found.frames[0].read_voxels() is None


def test_sequences_have_names_and_the_splits_of_their_frames(tmp_path: Path) -> None:
    drive = SimulatedDrive(frames=1, channels=4, columns=8)
    for name in ("Town01_Opt_Seq07", "Town10HD_Opt_Seq12", "Town02_Opt_Seq01"):
        write_carlaocc(tmp_path, drive, name, grids={})
    (tmp_path / "splits").mkdir()
    (tmp_path / "splits" / "train.txt").write_text("01 07 0000\n10 12 0000\n")
    (tmp_path / "splits" / "val.txt").write_text("10 12 0001\n10 12 0002\n")
    (tmp_path / "splits" / "test.txt").write_text("02 01 0000\n")
    found = {recording.name: recording.split for recording in CarlaOcc(tmp_path).sequences()}
    assert found == {
        "CARLAOCC_Town01-Opt-Seq07": "Train",
        "CARLAOCC_Town02-Opt-Seq01": "Test",
        "CARLAOCC_Town10HD-Opt-Seq12": "Val",
    }
    assert CarlaOcc(tmp_path / "Town10HD_Opt_Seq12").sequences()[0].split == "Val"


def test_every_tag_has_the_class_of_carlasc_with_the_same_role() -> None:
    assert len(CARLAOCC.names) == 30
    remap = CarlaOcc.to_carla
    assert set(remap.mapping) == set(CARLAOCC.names)
    for role in ("movable", "ground"):
        assert {tag for tag in CARLAOCC.names if remap.mapping[tag] in getattr(CARLA, role)} - {
            29
        } == getattr(CARLAOCC, role)
    for kind, name in (
        ("car", "Vehicle"),
        ("van", "Vehicle"),
        ("pedestrian", "Pedestrian"),
        ("road", "Road"),
    ):
        assert CARLA.names[remap.mapping[int(TAG_OF_KIND[KINDS.index(kind)])]] == name
    assert CARLA.names[remap.mapping[29]] == "Terrain"


def test_a_grid_without_its_scan_is_a_problem(sequence: Path) -> None:
    (sequence / "semantic_lidar" / "0002.ply").unlink()
    ((number, message),) = recording(sequence).problems()
    assert number == 2
    assert "0002.ply" in message


def spoil_header(folder: Path) -> None:
    path = folder / "semantic_lidar" / "0000.ply"
    path.write_text(path.read_text().replace("ObjTag", "intensity"))


def cut_scan(folder: Path) -> None:
    path = folder / "semantic_lidar" / "0000.ply"
    path.write_text(path.read_text()[:-400])


def empty_scan(folder: Path) -> None:
    path = folder / "semantic_lidar" / "0000.ply"
    head = path.read_text().partition("end_header\n")[0].splitlines()
    path.write_text("\n".join([*head[:2], "element vertex 0", *head[3:], "end_header\n"]))


def drop_pose(folder: Path) -> None:
    path = folder / "poses" / "lidar.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


def repeat_pose(folder: Path) -> None:
    path = folder / "poses" / "lidar.txt"
    path.write_text(path.read_text() + path.read_text().splitlines(keepends=True)[-1])


def shorten_pose(folder: Path) -> None:
    path = folder / "poses" / "lidar.txt"
    path.write_text(
        "".join(" ".join(line.split()[1:]) + "\n" for line in path.read_text().splitlines())
    )


def change_grid(folder: Path, **changes: object) -> None:
    path = folder / "occupancy" / "vs_0_4_surround_view" / "0002.npz"
    arrays = dict(np.load(path)) | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})


def cut_grid(folder: Path) -> None:
    path = folder / "occupancy" / "vs_0_4_surround_view" / "0002.npz"
    path.write_bytes(path.read_bytes()[:-300])


def move_rows(folder: Path) -> None:
    change_grid(folder, occupancy=np.array([[1, 2, 16, 2048]], np.uint16))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoil_header, "0000.ply: expected vertices with ObjTag"),
        (cut_scan, "0000.ply: expected"),
        (empty_scan, "0000.ply: expected points, found none"),
        (drop_pose, "lidar.txt: expected a pose for frame 2, found none for 1 frames"),
        (repeat_pose, "lidar.txt: expected times that increase, found none at pose 3"),
        (shorten_pose, "lidar.txt: expected 17 numbers per line: frame and 4 x 4 pose, found 16"),
        (
            cut_grid,
            "0002.npz: expected an .npz file, found something else (File is not a zip file): the "
            "file is incomplete",
        ),
        (
            move_rows,
            "0002.npz: expected voxels inside of cartesian 128 x 128 x 16, found 1 voxels outside",
        ),
        (
            lambda folder: change_grid(folder, voxel_size=None),
            "0002.npz: expected an array voxel_size, found occupancy, voxel_origin, volume_size",
        ),
        (lambda folder: change_grid(folder, voxel_size=0.2), "0002.npz: expected the geometry of"),
        (
            lambda folder: change_grid(folder, volume_size=np.array([65408, 128, 255])),
            "0002.npz: expected at most 268435456 bytes, found uint8 of shape",
        ),
        (
            lambda folder: change_grid(folder, volume_size=np.array([1, 2])),
            "0002.npz: expected voxel_size, and 3",
        ),
        (
            lambda folder: change_grid(folder, occupancy=np.zeros((4, 3), np.uint16)),
            "0002.npz: occupancy: expected an array of N x 4 values, found 4 x 3",
        ),
        (
            lambda folder: change_grid(folder, occupancy=np.array([{}])),
            "0002.npz: occupancy: expected uint16",
        ),
    ],
)
def test_a_wrong_file_is_named_in_one_line(sequence: Path, spoil: object, message: str) -> None:
    assert callable(spoil)
    spoil(sequence)
    with pytest.raises(CarlascError) as error:
        found = recording(sequence)
        found.poses()
        for frame in found.frames:
            frame.read()
            frame.read_voxels()
    assert isinstance(error.value, FormatError)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_without_sequences_says_what_was_looked_for(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(
            MissingDataError, match="folders such as Town01_Opt_Seq07 with semantic_lidar/ in them"
        ):
            CarlaOcc(folder).sequences()


class TestContract(ConverterContract):
    converter = "carlaocc"
    ids = TAGS
    drive = SimulatedDrive(channels=16, columns=120)
    keeps = frozenset({"labels", "instances", "poses", "times"})
    poses_m = 2e-6  # six decimals, of both poses of which one is given relative to the other

    def write(self, folder: Path) -> None:
        write_carlaocc(folder, self.drive, grids={})


@pytest.mark.slow
def test_meshes_are_a_truth_for_the_grids_that_scans_give(tmp_path: Path) -> None:
    drive = SimulatedDrive(frames=3, channels=24, columns=180)
    write_carlaocc(tmp_path / "source", drive)
    grids = {}
    for kind, how in (
        ("scans", GridOptions(SURROUND, FromScans(window=(-2, 0)))),
        ("voxels", "voxels"),
    ):
        out = tmp_path / kind
        result = convert("carlaocc", tmp_path / "source", out, grids=how, run=Run(workers=1))
        assert result.failures == ()
        (sequence,) = carlasc.open(out).sequences().values()
        grids[kind] = sequence.grid(layout.grid_folder(SURROUND), 2)
    scans, meshes = grids["scans"], grids["voxels"]
    tags, _ = mesh_voxels(drive, 2, SURROUND)
    # left-handed axes
    np.testing.assert_array_equal(meshes.labels, CarlaOcc.to_carla(tags)[:, ::-1])
    assert meshes.known.all()
    seen = scans.known & (scans.labels > 0)
    free = scans.known & (scans.labels == 0)
    assert (scans.labels == meshes.labels)[seen].mean() > 0.95
    assert (meshes.labels == 0)[free].mean() > 0.97
