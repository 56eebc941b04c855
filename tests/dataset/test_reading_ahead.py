"""Training from a store behind a URL: loaders with a ShardSampler and a cache, what is fetched and
when, and going on in an epoch.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.servers.object_store import BUCKET, client_of, options_for, s3_server
from helpers.servers.range_server import serve_folder

import carlasc
from carlasc.core.grids import GridSpec
from carlasc.dataset import Dataset, ShardSampler, sampling
from carlasc.storage.packing import pack

pytest.importorskip("torch", reason="needs carlasc[torch]")
pytest.importorskip("urllib3")
pytest.importorskip("zarr")

from torch.utils.data import DataLoader

SPEC = GridSpec("cartesian", (16, 16, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
FRAMES, HISTORY, BATCH = 24, 3, 4
SHAPE = {"seed": 1, "shard": 4, "window": 2}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives")
    for seed in range(2):
        write_drive(
            root / "files" / "Train" / f"Town0{seed}_Light" / "cartesian",
            range(FRAMES),
            spec=SPEC,
            seed=seed,
        )
    (root / "served").mkdir()
    pack(root / "files", root / "served" / "x.zarr")
    return root


@pytest.fixture
def served(drives):
    with serve_folder(drives / "served") as at:
        yield at


@pytest.fixture(scope="module")
def truth(drives):
    """The occupancy of each sample, by sequence and frame."""
    dataset = Dataset(drives / "files", history=HISTORY)
    return {
        (sample["sequence"], sample["frame"]): sample["occupancy"]
        for sample in map(dataset.__getitem__, range(len(dataset)))
    }


def dataset_at(served, cache, split="train", **options):
    source = carlasc.open(f"{served.url}/x.zarr", cache=cache and carlasc.Cache(cache, **options))
    return Dataset(source, split, history=HISTORY)


def frames_of(batches, truth=None):
    """Return (sequence, frame) of each sample, in order; check the scans against the truth."""
    found = []
    for batch in batches:
        keys = list(zip(batch["sequence"], batch["frame"].tolist(), strict=True))
        for key, occupancy in zip(keys, batch["occupancy"], strict=True):
            assert truth is None or np.array_equal(occupancy.numpy(), truth[key])
        found += keys
    return found


def order_of(sampler, epoch):
    dataset = sampler.dataset
    return [
        (sample["sequence"], sample["frame"])
        for sample in (dataset[int(i)] for i in sampler.order(epoch))
    ]


def fetching_threads():
    return [thread for thread in threading.enumerate() if thread.name == "carlasc-read-ahead"]


@pytest.mark.parametrize(
    "workers, method",
    [(0, None), (1, "fork"), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)],
)
def test_loaders_read_each_file_once_and_give_the_samples_of_the_files_in_the_order_of_the_sampler(
    served, truth, tmp_path, workers, method
):
    dataset = dataset_at(served, tmp_path)
    sampler = ShardSampler(dataset, **SHAPE)
    loader = DataLoader(dataset, BATCH, sampler=sampler, num_workers=workers, multiprocessing_context=method, persistent_workers=workers == 2)  # fmt: skip
    for epoch in range(2):
        sampler.set_epoch(epoch)
        assert frames_of(loader, truth) == order_of(sampler, epoch)
        assert not fetching_threads()
    sizes = {path: (served.folder / path).stat().st_size for path in served.sent}
    assert served.sent == sizes


def test_files_are_fetched_before_their_samples_are_drawn_but_not_much_earlier(tmp_path):
    for seed in range(4):
        write_drive(
            tmp_path / "files" / f"Town0{seed}_Light" / "cartesian", range(4), spec=SPEC, seed=seed
        )
    pack(tmp_path / "files", tmp_path / "served" / "x.zarr")
    with serve_folder(tmp_path / "served") as served:
        dataset = dataset_at(served, tmp_path / "cache", split=None)
        sampler = ShardSampler(dataset, shard=4, window=1, read_ahead=1)  # each sequence is a shard
        order = [
            sequence
            for sequence, frame in order_of(
                ShardSampler(dataset_at(served, None, split=None), shard=4, window=1), 0
            )
        ]
        served.sent.clear()

        def fetched():
            return [
                name
                for name in dict.fromkeys(order)
                if any(f"{name}/cartesian/scans" in path for path in served.sent)
            ]

        drawing = iter(sampler)
        assert not fetching_threads()
        for drawn in range(1, 17):
            next(drawing)
            begun = -(-drawn // 4)
            wait_until(lambda begun=begun: fetched() == list(dict.fromkeys(order))[: begun + 1])
            assert len(fetching_threads()) == 3
        time.sleep(0.1)
        assert list(drawing) == [] and not fetching_threads()


def wait_until(holds):
    end = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_files_of_histories_are_in_the_plan(served, tmp_path):
    dataset = dataset_at(served, tmp_path)
    paths = [path for _, path in dataset.cached_files([5])]
    assert {path.rpartition("/c/")[0].partition("cartesian/")[2] for path in paths} == {
        "scans/points/xyz",
        "grids/evaluation/labels/values",
        "grids/evaluation/counts/values",
    }
    part, _ = dataset._frame_at(5)
    assert part.with_history([5], HISTORY) == [3, 4, 5]
    assert part.with_history([0, 1], HISTORY) == [0, 1]


def test_an_iterator_that_is_left_in_the_middle_leaves_no_thread(served, tmp_path):
    dataset = dataset_at(served, tmp_path)
    loader = DataLoader(dataset, BATCH, sampler=ShardSampler(dataset, **SHAPE))
    for _ in loader:
        break
    wait_until(lambda: not fetching_threads())
    assert len(frames_of(loader)) == 2 * FRAMES


@pytest.mark.posix("fork")
def test_workers_may_be_forked_while_files_are_fetched(served, truth, tmp_path):
    dataset = dataset_at(served, tmp_path)
    served.before = lambda path: time.sleep(0.02)
    drawing = iter(ShardSampler(dataset, **SHAPE))
    next(drawing)
    assert fetching_threads()
    loader = DataLoader(dataset, BATCH, num_workers=2, multiprocessing_context="fork")
    assert len(frames_of(loader, truth)) == 2 * FRAMES
    drawing.close()


def test_a_server_that_is_lost_does_not_hold_up_the_end(served, tmp_path, monkeypatch):
    monkeypatch.setattr(sampling.ReadAhead, "_stop_s", 0.1)
    dataset = dataset_at(served, tmp_path)
    drawing = iter(ShardSampler(dataset, **SHAPE))
    lost, back = threading.Event(), threading.Event()
    served.before = lambda path: (lost.set(), back.wait(60))
    next(drawing)
    assert lost.wait(30)
    start = time.monotonic()
    drawing.close()
    assert time.monotonic() - start < 20 and fetching_threads()
    back.set()
    wait_until(lambda: not fetching_threads())


def test_a_cache_that_is_too_small_only_costs_time(served, truth, tmp_path):
    dataset = dataset_at(served, tmp_path, max_bytes=30_000)
    sampler = ShardSampler(dataset, **SHAPE)
    assert frames_of(DataLoader(dataset, BATCH, sampler=sampler), truth) == order_of(sampler, 0)
    assert sum(path.stat().st_size for path in tmp_path.glob("??/*")) <= 30_000


def test_a_server_that_fails_is_reported_by_whoever_reads(served, tmp_path, monkeypatch):
    monkeypatch.setenv("CARLASC_REMOTE_BACKOFF_S", "0.001")
    dataset = dataset_at(served, tmp_path)
    dataset.cached_files(range(len(dataset)))  # what a sampler looks up
    served.broken = True
    with pytest.raises(carlasc.errors.CarlascError, match="x.zarr"):
        list(DataLoader(dataset, BATCH, sampler=ShardSampler(dataset, **SHAPE)))
    wait_until(lambda: not fetching_threads())


@pytest.mark.parametrize("before, after", [(0, 2), (2, 0), (2, 1)])
def test_an_epoch_goes_on_with_another_number_of_workers(drives, before, after):
    dataset = Dataset(drives / "served" / "x.zarr", "train", history=HISTORY)
    sampler = ShardSampler(dataset, **SHAPE)
    sampler.set_epoch(1)
    done = []
    for step, batch in enumerate(DataLoader(dataset, BATCH, sampler=sampler, num_workers=before)):
        done += frames_of([batch])
        if step == 4:
            state = json.loads(json.dumps(sampler.state_dict(trained=(step + 1) * BATCH)))
            break
    other = ShardSampler(dataset, **SHAPE)
    other.load_state_dict(state)
    other.set_epoch(1)
    rest = frames_of(DataLoader(dataset, BATCH, sampler=other, num_workers=after))
    assert done + rest == order_of(sampler, 1)


def test_an_epoch_goes_on_with_another_number_of_processes(drives):
    dataset = Dataset(drives / "served" / "x.zarr", "train", history=HISTORY)
    one = ShardSampler(dataset, **SHAPE)
    loader = iter(DataLoader(dataset, BATCH, sampler=one))
    done = frames_of(next(loader) for _ in range(3))
    state = one.state_dict(trained=3 * BATCH)
    ranks = []
    for rank in range(2):
        sampler = ShardSampler(dataset, rank=rank, num_replicas=2, **SHAPE)
        sampler.load_state_dict(state)
        ranks.append(frames_of(DataLoader(dataset, BATCH // 2, sampler=sampler)))
    rest = [frame for pair in zip(*ranks, strict=True) for frame in pair]
    assert done + rest == order_of(one, 0)


SCRIPT = """
import sys
import carlasc
from carlasc import Dataset, ShardSampler
url, cache, workers, end = sys.argv[1:]
dataset = Dataset(carlasc.open(url, cache=cache), history=3)
drawing = iter(ShardSampler(dataset, shard=4, window=2))
if workers == "no loader":
    dataset[next(drawing)]
else:
    from torch.utils.data import DataLoader
    batches = iter(DataLoader(dataset, 4, sampler=drawing, num_workers=int(workers)))
    next(batches)
print("begun")
if end == "error":
    raise SystemExit(3)
"""


@pytest.mark.parametrize(
    "workers, end, status",
    [
        pytest.param("no loader", "error", 3, marks=pytest.mark.slow),
        pytest.param("0", "", 0, marks=pytest.mark.slow),
        pytest.param("2", "", 0, marks=pytest.mark.slow),
    ],
)
def test_a_program_ends_at_once_in_the_middle_of_an_epoch(served, tmp_path, workers, end, status):
    served.before = lambda path: time.sleep(0.05)  # so that it ends while files are being fetched
    command = [
        sys.executable,
        "-c",
        SCRIPT,
        f"{served.url}/x.zarr",
        str(tmp_path / "cache"),
        workers,
        end,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (status, "begun\n", "")


class TestStatefulDataLoader:
    """torchdata's loader saves the position of the batch that it gave last, whatever its workers
    have drawn since.
    """

    @pytest.fixture
    def loader(self, drives):
        stateful = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
        dataset = Dataset(drives / "served" / "x.zarr", "train", history=HISTORY)

        def build(workers):
            return stateful(
                dataset, BATCH, sampler=ShardSampler(dataset, **SHAPE), num_workers=workers
            )

        return build

    @pytest.mark.slow
    @pytest.mark.parametrize("workers", [0, 1, 2])
    @pytest.mark.parametrize("steps", [1, 7, 12])
    def test_an_epoch_goes_on_where_its_state_was_saved(self, loader, workers, steps):
        first = loader(workers)
        first.sampler.set_epoch(2)
        done = []
        for batch in first:
            done += frames_of([batch])
            if len(done) == steps * BATCH:
                state = first.state_dict()
                break
        other = loader(workers)
        other.load_state_dict(state)
        rest = frames_of(other)
        assert other.sampler.epoch == (2 if rest else 3)
        assert done + rest == order_of(first.sampler, 2)
        other.sampler.set_epoch(3)
        assert frames_of(other) == order_of(first.sampler, 3)

    @pytest.mark.parametrize("workers", [0, 2])
    def test_after_the_state_of_a_finished_epoch_comes_the_next_one(self, loader, workers):
        first = loader(workers)
        list(first)
        other = loader(workers)
        other.load_state_dict(first.state_dict())
        assert frames_of(other) == order_of(first.sampler, 1)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_bucket_is_read_through_the_cache_and_a_new_version_of_it_is_seen(
    drives, truth, tmp_path, workers
):
    with s3_server() as endpoint:
        options = options_for(endpoint)
        bucket = client_of(endpoint)
        store = drives / "served" / "x.zarr"
        for file in store.rglob("*"):
            if file.is_file():
                key = f"x.zarr/{file.relative_to(store).as_posix()}"
                bucket.upload_file(str(file), BUCKET, key)
        for _ in range(2):  # the second time from the cache
            dataset = Dataset(
                carlasc.open(f"s3://{BUCKET}/x.zarr", cache=tmp_path, **options), history=HISTORY
            )
            sampler = ShardSampler(dataset, **SHAPE)
            loader = DataLoader(dataset, BATCH, sampler=sampler, num_workers=workers)
            assert frames_of(loader, truth) == order_of(sampler, 0)
        (_, path), *_ = dataset.cached_files([0])
        bucket.put_object(Bucket=BUCKET, Key=f"x.zarr/{path}", Body=b"something else")
        with pytest.raises(carlasc.errors.CarlascError, match=r"x\.zarr"):
            Dataset(
                carlasc.open(f"s3://{BUCKET}/x.zarr", cache=tmp_path, **options), history=HISTORY
            )[0]
