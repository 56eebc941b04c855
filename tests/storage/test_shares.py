"""The share of a part: sequences chosen by names, before any is opened."""

import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlparse

import numpy as np
import pytest
from helpers.datasets.captures import read_tree
from helpers.errors import raises
from helpers.processes.peak import PRINT_PEAK
from helpers.servers.object_store import environment_for

import carlasc
from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, MissingDataError
from carlasc.groundtruth import FromScans, regrid
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.running import Part
from carlasc.storage import FolderSink, open
from carlasc.storage.shares import Share

SPEC = GridSpec.published().with_size((8, 8, 4))
STILL = FromScans(motion=MotionOptions("none"), poses=PoseOptions(refine="never"))


def write_sequences(folder, number, frames=1, where="Train/clip{:05d}/cartesian"):
    points = np.random.default_rng(0).uniform(-9, 9, (60, 4)).astype(np.float32)
    for index in range(number):
        writer = FolderSink(folder).sequence(where.format(index))
        for frame in range(frames):
            writer.write("points", frame, points)
        writer.write_document("poses.txt", b"1 0 0 0 0 1 0 0 0 0 1 0\n" * frames)
    return folder


def names_of(folder, parts):
    return [Share(open(folder), Run(part=Part(n, parts))).own for n in range(1, parts + 1)]


def test_more_sequences_leave_the_others_in_their_parts(tmp_path):
    before = names_of(write_sequences(tmp_path, 30), 4)
    assert sorted(name for own in before for name in own) == open(tmp_path).places()
    after = names_of(write_sequences(tmp_path, 45), 4)
    assert all(set(own) <= set(more) for own, more in zip(before, after, strict=True))


def test_parts_that_outnumber_sequences_share_them():
    names = ["a", "b", "c"]
    shares = [Part(n, 8).share(names) for n in range(1, 9)]
    assert [(own, str(part)) for own, part in shares] == [
        (["a"], "1/3"), (["a"], "2/3"), (["a"], "3/3"),
        (["b"], "1/3"), (["b"], "2/3"), (["b"], "3/3"),
        (["c"], "1/2"), (["c"], "2/2"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "where",
    ["clip{:05d}/velodyne/..", "set/Train/clip{:05d}/cartesian", "clip{:05d}/cylindrical"],
)
def test_places_are_found_without_opening_them(tmp_path, where):
    write_sequences(tmp_path, 4, where=where.removesuffix("/velodyne/.."))
    found = open(tmp_path)
    assert len(found.places()) == 4
    assert list(found.sequences_in(found.places())) == list(found.sequences())


def test_a_part_touches_its_own_sequences_and_lists_the_others(tmp_path):
    """`docs/studies/scale.md` has the figures of 5,000 sequences."""
    calls, root = [], write_sequences(tmp_path / "in", 200, frames=2)
    share = Share(open(root), Run(part=Part(3, 40)))
    own = len(share.own)
    sys.addaudithook(
        lambda event, arguments: (
            calls.append(str(arguments[0]))
            if event in ("open", "os.scandir", "os.listdir", "os.mkdir", "os.rename")
            and str(tmp_path) in str(arguments[0])
            else None
        )
    )
    run = Run(1, part=Part(3, 40))
    made = regrid(root, SPEC, tmp_path / "out", observe=STILL, run=run).made
    assert made == 2 * own > 0
    touched = {path for path in calls if "clip" in path}
    assert not [
        path for path in touched if not any(name in path for name in (*share.own, share.first))
    ]
    assert len(calls) < 120 * own + 10
    calls.clear()  # the hook stays


@pytest.mark.slow
@pytest.mark.parametrize("out", ["folder", "store.zarr"])
def test_parts_of_whole_sequences_make_what_one_run_makes(tmp_path, out):
    write_sequences(tmp_path / "in", 6)
    regrid(tmp_path / "in", SPEC, tmp_path / f"whole{out}", observe=STILL, run=Run(1))
    path = tmp_path / "list.txt"
    for number in (3, 1, 2):
        run = Run(1, part=Part(number, 3), sequences_from=path)
        regrid(tmp_path / "in", SPEC, tmp_path / out, observe=STILL, run=run)
    assert path.read_text().splitlines() == open(tmp_path / "in").places()
    assert read_tree(tmp_path / out) == read_tree(tmp_path / f"whole{out}")


def test_finish_names_what_parts_left_out(tmp_path):
    write_sequences(tmp_path / "in", 3, frames=4)
    path, out = tmp_path / "list", tmp_path / "out"
    run = Run(1, part=Part(1, 6), sequences_from=path)  # half of the first sequence
    regrid(tmp_path / "in", SPEC, out, observe=STILL, run=run)
    with raises(ConflictError, where=str(out), advice="another rule"):
        carlasc.finish(out)
    result = carlasc.finish(out, sequences_from=path, incomplete=True)
    assert [*result.missing] == [
        "Train/clip00000/cartesian", "Train/clip00001", "Train/clip00002",
    ]  # fmt: skip
    regrid(tmp_path / "in", SPEC, out, observe=STILL, run=Run(1))
    assert not carlasc.finish(out, sequences_from=path).missing


def test_an_empty_list_and_a_wrong_folder_are_errors(tmp_path):
    write_sequences(tmp_path / "in", 2)
    (tmp_path / "list").write_text("\n")
    with raises(MissingDataError, expected="one per line"):
        Share(open(tmp_path / "in"), Run(sequences_from=tmp_path / "list"))
    (tmp_path / "empty").mkdir()
    with raises(MissingDataError):
        regrid(tmp_path / "empty", SPEC, tmp_path / "out", run=Run(1, part=Part(1, 2)))


class ManyFolders(BaseHTTPRequestHandler):
    """A bucket with folders Train/clip000000/cartesian/velodyne, ..., and nothing else."""

    count, requests = 300_000, 0

    def log_message(self, *_: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.send_error(404)

    def do_GET(self) -> None:
        type(self).requests += 1
        query = {name: value[0] for name, value in parse_qs(urlparse(self.path).query).items()}
        prefix = query.get("prefix", "")
        if "list-type" not in query:
            self.send_error(404)
            return
        above = {"": "Train/", "Train/": None}.get(
            prefix.removeprefix("set/"), f"{prefix}velodyne/"
        )
        first = int(query.get("continuation-token", "0"))
        end = min(first + 1000, self.count)
        names = [f"set/{above}"] if prefix == "set/" else [above]
        if above is None:
            names = [f"{prefix}clip{index:06d}/" for index in range(first, end)]
        more = above is None and end < self.count
        body = (
            f"<ListBucketResult><Name>b</Name><Prefix>{prefix}</Prefix><MaxKeys>1000</MaxKeys>"
            f"<KeyCount>{len(names)}</KeyCount><IsTruncated>{str(more).lower()}</IsTruncated>"
            + (f"<NextContinuationToken>{end}</NextContinuationToken>" if more else "")
            + "".join(f"<CommonPrefixes><Prefix>{n}</Prefix></CommonPrefixes>" for n in names)
            + "</ListBucketResult>"
        ).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@pytest.mark.slow
def test_three_hundred_thousand_folders_of_a_store_are_dealt_in_seconds(tmp_path):
    server = ThreadingHTTPServer(("127.0.0.1", 0), ManyFolders)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    code = (
        "import resource; from carlasc import Run; from carlasc.running import Part\n"
        "from carlasc.storage import open; from carlasc.storage.shares import Share\n"
        f"share = Share(open('s3://b/set'), Run(part=Part(7, 1000), sequences_from={str(tmp_path / 'list')!r}))\n"
        "used = resource.getrusage(resource.RUSAGE_SELF)\n"
        "print(len(share.own), len(share.others), used.ru_utime + used.ru_stime)\n" + PRINT_PEAK
    )
    address = f"http://127.0.0.1:{server.server_port}"
    own = {**os.environ, **environment_for(address)}
    done = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, "-c", code], env=own, capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr[-2000:]
        done.append([float(value) for value in ran.stdout.split()])
        if len(done) == 1:
            asked = ManyFolders.requests
    server.shutdown()
    assert done[0][:2] == done[1][:2] and sum(done[0][:2]) == ManyFolders.count
    assert all(seconds < 10 and memory < 500_000 for _, _, seconds, memory in done), done
    assert 300 <= asked <= 320 and ManyFolders.requests - asked <= 10, (asked, done)


@pytest.mark.slow
def test_finish_says_that_a_part_was_made_by_another_rule_and_what_exists_is_kept(
    tmp_path, monkeypatch
):
    write_sequences(tmp_path / "in", 8)
    path, out = tmp_path / "list", tmp_path / "out"

    def make(number):
        run = Run(1, part=Part(number, 2), sequences_from=path)
        return regrid(tmp_path / "in", SPEC, out, observe=STILL, run=run).made

    with monkeypatch.context() as patch:  # consecutive sequences, as parts were dealt before
        patch.setattr(Part, "share", lambda part, names: ([*part.take(names)], Part()))
        assert make(1) == 4
    before = read_tree(out)
    make(2)
    names = open(tmp_path / "in").places()
    left_out = [name for name in Part(1, 2).share(names)[0] if name not in names[:4]]
    assert left_out
    with raises(ConflictError, where=str(out), advice="another rule"):
        carlasc.finish(out, sequences_from=path)
    result = carlasc.finish(out, sequences_from=path, incomplete=True)
    assert [*result.missing] == left_out
    assert make(1) == len(left_out)
    assert not carlasc.finish(out, sequences_from=path).missing
    after = read_tree(out)
    assert {name: after[name] for name in before if "evaluation" in name} == {
        name: data for name, data in before.items() if "evaluation" in name
    }
