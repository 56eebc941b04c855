"""Data and stores that carlasc 0.1.0 wrote, before carlasc.json had a format version: they must stay readable."""

import json
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

import carlasc
from carlasc import Run
from carlasc.core.tables import CARLA, CARLASC11, SEMANTICKITTI
from carlasc.storage import layout
from carlasc.storage.packing import pack
from carlasc.storage.unpacking import unpack
from carlasc.testing.data import published_bytes

ENDINGS = ("zarr", "h5", "parquet")
KITTI = "Val/KITTI_08/cartesian"
SEQUENCES = ("Test/Town10_Medium/cylindrical", "Train/Town01_Light/cartesian", KITTI, "Val/Town07_Heavy/cartesian")


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("before")
    with tarfile.open(Path(__file__).parents[1] / "data/before/0.1.0.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def stored(folder: Path, field: layout.Field, frame: int) -> np.ndarray:
    """Return a frame's numbers as they are in the published file, without carlasc's own code."""
    file = folder / field.file(frame)
    if field.suffix == ".votes.npz":
        with np.load(file) as archive:
            return np.stack([archive[name].astype(np.int64) for name in ("voxel", "label", "votes")])
    return np.fromfile(file, field.dtype)


@pytest.mark.parametrize("name", ["published", *(f"packed.{ending}" for ending in ENDINGS)])
def test_every_field_of_every_frame_is_read(before, name):
    if name.endswith(("zarr", "h5", "parquet")):
        pytest.importorskip({"zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[name.rpartition(".")[2]])
    sequences = carlasc.open(before / name).sequences()
    assert tuple(sequences) == SEQUENCES
    read = 0
    for path, sequence in sequences.items():
        folder = before / "published" / path
        fields = [layout.field_named(field) for field in sequence.fields()]
        files = sum(len(list(folder.glob(f"{field.folder}/[0-9]*{field.suffix}"))) for field in fields)
        assert files == sum(len(sequence.frames(field.name)) for field in fields)
        for field in fields:
            for frame in sequence.frames(field.name).tolist():
                found, wanted = sequence.read(field.name, frame), stored(folder, field, frame)
                if field.suffix == ".votes.npz":
                    found = np.stack([found[column].astype(np.int64) for column in ("voxel", "label", "votes")])
                assert np.array_equal(found.reshape(wanted.shape), wanted), (path, field.name, frame)
                read += 1
        assert {document: sequence.read_document(document) for document in sequence.documents()} == {
            document: (folder / document).read_bytes() for document in sequence.documents()
        }
    assert read == 50


@pytest.mark.parametrize("name", ["published", *(f"packed.{ending}" for ending in ENDINGS)])
def test_the_key_frame_and_the_names_of_class_tables_are_read(before, name):
    if name.endswith(("zarr", "h5", "parquet")):
        pytest.importorskip({"zarr": "zarr", "h5": "h5py", "parquet": "pyarrow"}[name.rpartition(".")[2]])
    sequences = carlasc.open(before / name).sequences()
    kitti = sequences[KITTI].metadata
    assert (kitti.axes, kitti.classes, kitti.sensor) == ("right", SEMANTICKITTI, "a LiDAR")
    assert (kitti.min_range_m, kitti.max_range_m, kitti.source, kitti.extra) == (2.5, 70, "kitti x", {"poses": "file"})
    assert sequences[KITTI].classes_of("prediction") is CARLASC11
    assert sequences[KITTI].predicted_by("prediction") == "lmscnet_ss"
    assert sequences[KITTI].classes_of("evaluation") is SEMANTICKITTI
    whole = sequences[SEQUENCES[1]].metadata
    assert (whole.axes, whole.classes, whole.sensor) == ("right", CARLA, "a")
    assert sequences[SEQUENCES[3]].metadata.axes == "left"


def test_a_grid_made_of_a_capture_is_read(before):
    (sequence,) = carlasc.open(before / "capture").sequences().values()
    folder = before / "capture/cartesian"
    spec = sequence.grids["small"]
    assert spec == carlasc.GridSpec.published().with_size((16, 16, 4))
    for frame in (0, 1):
        grid = sequence.grid("small", frame)
        labels = np.fromfile(folder / f"small/{frame:06d}.label", "<u4")
        counts = np.fromfile(folder / f"small/{frame:06d}.bin", "<f4")
        assert np.array_equal(grid.labels.reshape(-1), labels) and np.array_equal(grid.counts.reshape(-1), counts)
        votes = sequence.read("small/votes", frame)
        assert votes["votes"].sum() == counts.sum() > 0
    assert json.loads((folder / "small/params.json").read_text())["carlasc"]["vote"] == "sensor"


@pytest.mark.needs("numcodecs")
def test_a_zarr_store_of_version_1_is_read(tmp_path):
    with tarfile.open(Path(__file__).parents[1] / "data/before/zarr-1.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    published = carlasc.open(tmp_path / "published").sequences()
    source = carlasc.open(tmp_path / "store.zarr")
    assert source.version == 1
    assert list(source.sequences()) == list(published)
    read = 0
    for path, sequence in source.sequences().items():
        wanted = published[path]
        assert sequence.fields() == wanted.fields()
        assert sorted(sequence.documents()) == sorted(wanted.documents())
        assert all(sequence.read_document(name) == wanted.read_document(name) for name in wanted.documents())
        for name in sorted(wanted.fields()):
            frames = wanted.frames(name).tolist()
            assert sequence.frames(name).tolist() == frames
            for frame, array in zip(frames, sequence.read_many(name, frames), strict=True):
                assert published_bytes(name, array) == published_bytes(name, wanted.read(name, frame)), (name, frame)
                read += 1
        for frame in (2, 5):
            xyz = sequence.read_xyz([frame])[0]
            assert np.array_equal(xyz[:, :3], wanted.read("points", frame)[:, :3])
        shards = sequence.files_of("points", [2, 5])
        assert shards[0] == f"{path}/scans/points/xyz/c/0/0" and (tmp_path / "store.zarr" / shards[0]).is_file()
    assert read == 56
    assert source.sequences()[KITTI.replace("KITTI_08", "Town07_Heavy")].read("points", 5)[:, 3].any()


def files_of_layout(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file that the layout knows, by its path; of votes the unpacked ones, which no level of Deflate changes."""
    return {
        f"{path}/{name}": unpacked(folder / path / name)
        for path, sequence in carlasc.open(folder).sequences().items()
        for name in [
            *sequence.documents(),
            *(layout.field_named(field).file(frame) for field in sequence.fields() for frame in sequence.frames(field)),
        ]
    }


def unpacked(file: Path) -> bytes:
    if file.suffix != ".npz":
        return file.read_bytes()
    with zipfile.ZipFile(file) as archive:
        return b"".join(name.encode() + archive.read(name) for name in archive.namelist())


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", ["published", *(f"packed.{ending}" for ending in ENDINGS)])
def test_what_an_old_version_wrote_is_packed_and_unpacked_without_a_change(before, tmp_path, name, ending):
    for kind in {ending, name.rpartition(".")[2]} & set(ENDINGS):
        pytest.importorskip({"zarr": "numcodecs", "h5": "h5py", "parquet": "pyarrow"}[kind])
    pack(before / name, tmp_path / f"new.{ending}", run=Run(workers=1))
    unpack(tmp_path / f"new.{ending}", tmp_path / "files", run=Run(workers=1))
    found, wanted = files_of_layout(tmp_path / "files"), files_of_layout(before / "published")
    assert len(wanted) > 50
    assert found == wanted


@pytest.mark.needs("numcodecs")
def test_a_zarr_store_of_version_1_is_unpacked_and_packed_without_a_change(tmp_path):
    with tarfile.open(Path(__file__).parents[1] / "data/before/zarr-1.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    pack(tmp_path / "store.zarr", tmp_path / "new.zarr", run=Run(workers=1))
    wanted = files_of_layout(tmp_path / "published")
    for store in ("store.zarr", "new.zarr"):
        unpack(tmp_path / store, tmp_path / f"{store}.files", run=Run(workers=1))
        assert files_of_layout(tmp_path / f"{store}.files") == wanted
