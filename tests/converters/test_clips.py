"""A list of clips: each is fetched, converted and deleted again, in a space that is never exceeded,
by several processes that are killed and started again.
"""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from helpers.converters.ncore_files import write_store
from helpers.datasets.captures import read_tree
from helpers.servers.http_server import Site, serve
from helpers.servers.object_store import BUCKET, client_of, environment_for, s3_server

from carlasc import Run
from carlasc.converting import LayoutOptions, convert
from carlasc.converting.stages import Conversion
from carlasc.errors import ArgumentError
from carlasc.running import Part, open_cluster
from carlasc.storage.inputs import combined
from carlasc.testing import SimulatedDrive

pytestmark = pytest.mark.needs("cbor2", "numcodecs")
MANY = int(os.environ.get("CARLASC_TEST_CLIPS", "8"))


def write_clips(folder: Path, number: int) -> dict[str, bytes]:
    """Return stores of NCore, by the paths of their files; each is a sequence of its own name."""
    files = {}
    folder.mkdir(exist_ok=True)
    for index in range(number):
        drive = SimulatedDrive(2, channels=6, columns=40)
        path = write_store(folder, drive, sequence=f"clip{index:04d}")
        files[f"/{path.name}"] = path.read_bytes()
    return files


def scans(folder: Path) -> dict[str, bytes]:
    return {name: data for name, data in read_tree(folder).items() if ".carlasc/" not in name}


def listed(folder: Path, *names: str) -> Path:
    path = folder / "clips.txt"
    path.write_text("".join(f"{name.lstrip('/')}\n" for name in names))
    return path


def test_clips_of_a_server_are_converted_once_and_what_fails_is_listed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    files = write_clips(tmp_path, 3)
    names = [*files]
    damaged, large = "/damaged.ncore4.zarr.itar", "/large.ncore4.zarr.itar"
    site = Site(files | {damaged: b"not a store", large: bytes(500_000)})
    path = listed(tmp_path, *names, damaged, large, "gone.ncore4.zarr.itar")
    with serve(site):
        run = Run(1, sequences_from=path)
        space = f"{3 * max(map(len, files.values())) // 1000}KB"
        result = convert("ncore", site.url, tmp_path / "out", grids=None, scratch=space, run=run)
        assert len(result.sequences) == 3 and result.made == 6
        assert {Path(one.sequence).name: one.frame for one in result.failures} == dict.fromkeys(
            ["damaged.ncore4.zarr.itar", "large.ncore4.zarr.itar", "gone.ncore4.zarr.itar"], -1
        )
        asked = len(site.requests)
        site.files[damaged] = b"still not a store"
        again = convert("ncore", site.url, tmp_path / "out", grids=None, scratch=space, run=run)
        assert len(again.failures) == 3 and not again.sequences
        whole_files = {f"bytes=0-{len(data) - 1}" for data in files.values()}
        assert not whole_files & {*site.requests[asked:]}  # nothing that is done is fetched
        other = LayoutOptions(allow_unknown=True)
        run = Run(1, sequences_from=listed(tmp_path, *names))
        again = convert("ncore", site.url, tmp_path / "out", grids=None, layout=other, run=run)
        assert again.skipped == 6  # of other options: they are looked at again
    assert not [one for one in (tmp_path / "scratch").rglob("*") if one.suffix != ".lock"]
    whole = convert_whole(tmp_path, files)
    assert scans(tmp_path / "out") == whole


def test_a_sequence_of_two_clips_is_a_conflict_and_what_does_not_fit_is_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_clips(tmp_path / name, 1)
    path = listed(tmp_path, "a", "b")
    run = Run(1, sequences_from=path)
    result = convert("ncore", tmp_path, tmp_path / "out", grids=None, run=run)
    assert result.made == 2 and [one.sequence for one in result.failures] == ["b"]
    assert "only b" in result.failures[0].message
    for arguments in ({"scratch": "much"}, {"grids": None, "scratch": ""}):
        with pytest.raises(ArgumentError) as error:
            convert("ncore", tmp_path, tmp_path / "out", run=run, **arguments)
        assert error.value.where in ("scratch", "follow_ground")
    with pytest.raises(ArgumentError) as error:
        convert("ncore", tmp_path, tmp_path / "out.zarr", grids=None, run=run)
    assert error.value.where == "out"


def interrupt(*arguments: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize("is_served", [False, True])
@pytest.mark.parametrize("is_killed", [False, True])
def test_a_clip_that_changed_is_converted_again(tmp_path, is_served, is_killed, monkeypatch):
    files, out = write_clips(tmp_path / "in", 2), tmp_path / "out"
    path = listed(tmp_path, *files)
    site = Site(dict(files))
    with serve(site):
        source = site.url if is_served else tmp_path / "in"

        def run(target: Path):
            one = Run(1, sequences_from=path)
            return convert("ncore", source, target, grids=None, run=one)

        run(out)
        assert not run(out).sequences
        name = min(files)
        other = SimulatedDrive(2, channels=6, columns=48)
        write_store(tmp_path / "in", other, sequence=Path(name).name.partition(".")[0])
        site.files[name] = (tmp_path / "in" / name[1:]).read_bytes()
        if is_killed:
            with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
                killed.setattr(Conversion, "_finish", interrupt)
                run(out)
        assert len(run(out).sequences) == 1
        (tmp_path / "in" / name[1:]).unlink()
        del site.files[name]
        assert not run(out).failures  # what is done may be deleted at its source
        write_store(tmp_path / "in", other, sequence=Path(name).name.partition(".")[0])
        site.files[name] = (tmp_path / "in" / name[1:]).read_bytes()
        run(tmp_path / "fresh")
    assert scans(out) == scans(tmp_path / "fresh")


@pytest.mark.slow
def test_a_list_is_written_by_the_first_part_and_all_parts_make_one_conversion(tmp_path):
    files = write_clips(tmp_path / "in", 5)
    path = tmp_path / "list"
    for number in (1, 2):
        run = Run(1, part=Part(number, 2), sequences_from=path)
        convert("ncore", tmp_path / "in", tmp_path / "out", grids=None, run=run)
    assert len(path.read_text().splitlines()) == 5
    assert scans(tmp_path / "out") == convert_whole(tmp_path / "in", files)


def convert_whole(folder: Path, files: dict[str, bytes]) -> dict[str, bytes]:
    """Return what one process makes of clips on this machine."""
    run = Run(1, sequences_from=listed(folder, *files))
    result = convert("ncore", folder, folder / "whole", grids=None, run=run)
    assert result.made == 2 * len(files) and not result.failures
    return scans(folder / "whole")


def sizes(folder: Path) -> int:
    total = 0
    for place, _, names in os.walk(folder):  # passes over folders that are being deleted
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += Path(place, name).stat().st_size
    return total


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("server", ["http", "s3"])
def test_two_killed_machines_convert_many_clips_once_in_bounded_space(tmp_path, server):
    """`CARLASC_TEST_CLIPS=200` for 200 clips."""
    files = write_clips(tmp_path / "in", MANY)
    bad = {"/bad.ncore4.zarr.itar": b"not a store", "/large.ncore4.zarr.itar": bytes(2_000_000)}
    path = listed(tmp_path, *files, *bad, "gone.ncore4.zarr.itar")
    space = 3 * max(map(len, files.values())) // 1000 * 1000
    environment = dict(os.environ)
    with contextlib.ExitStack() as servers:
        if server == "http":
            url = servers.enter_context(serve(Site(files | bad))).url
        else:
            endpoint = servers.enter_context(s3_server())
            client, environment = client_of(endpoint), environment | environment_for(endpoint)
            for name, data in (files | bad).items():
                client.put_object(Bucket=BUCKET, Key=f"clips{name}", Body=data)
            url = f"s3://{BUCKET}/clips"

        def start(number: int) -> subprocess.Popen[str]:
            scratch = tmp_path / f"scratch{number}"
            scratch.mkdir(exist_ok=True)
            command = [sys.executable, "-c", "from carlasc.cli import main; main()"]
            command += ["convert", "ncore", url, str(tmp_path / "out"), "--grids", "none"]
            command += ["--sequences-from", str(path), "--scratch", f"{space}B", "--json"]
            command += ["--workers", "1", "--part", f"{number}/2"]
            own = environment | {"TMPDIR": str(scratch)}
            return subprocess.Popen(command, env=own, stdout=subprocess.PIPE, text=True)

        chance, largest = random.Random(52), 0
        # a kill follows each of these numbers of clips that are there
        kills = sorted(chance.sample(range(1, MANY - 1), 3))
        machines, results = {number: start(number) for number in (1, 2)}, dict[int, dict]()
        while machines:
            for number, machine in list(machines.items()):
                largest = max(largest, sizes(tmp_path / f"scratch{number}"))
                if machine.poll() is not None:
                    results[number] = json.loads(machine.communicate()[0])
                    del machines[number]
            there = len(list((tmp_path / "out").glob("*/*")))
            if machines and kills and there >= kills[0]:
                number = chance.choice(list(machines))
                machines[number].send_signal(signal.SIGKILL)
                machines[number].communicate()
                machines[number] = start(number)
                kills.pop(0)
            time.sleep(0.02)
    assert not kills and 0 < largest <= space
    failed = sorted(one["sequence"] for one in results[1]["failures"] + results[2]["failures"])
    assert failed == ["bad.ncore4.zarr.itar", "gone.ncore4.zarr.itar", "large.ncore4.zarr.itar"]
    assert scans(tmp_path / "out") == convert_whole(tmp_path / "in", files)


@pytest.mark.slow
@pytest.mark.needs("distributed")
def test_each_clip_is_a_task_of_a_cluster_and_all_tasks_share_the_scratch(tmp_path, monkeypatch):
    scratch, ended, largest = tmp_path / "scratch", threading.Event(), [0]
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    files = write_clips(tmp_path / "in", 6)
    damaged = "/damaged.ncore4.zarr.itar"
    path = listed(tmp_path, *files, damaged, "gone.ncore4.zarr.itar")
    space = 3 * max(map(len, files.values())) // 2  # for one clip of three workers
    out = tmp_path / "out"
    dead = scratch / f"carlasc-{combined(str(out), '1/1')}" / "clip"  # of a worker that was killed
    dead.mkdir(parents=True)
    (dead / "data").write_bytes(bytes(space))

    def watch() -> None:
        while not ended.wait(0.005):
            largest[0] = max(largest[0], sizes(scratch))

    with (
        serve(Site(files | {damaged: b"not a store"})) as site,
        ThreadPoolExecutor(1) as pool,
        open_cluster("local:3") as cluster,
    ):
        pool.submit(watch)
        run = Run(executor=cluster, sequences_from=path)
        result = convert("ncore", site.url, out, grids=None, scratch=f"{space}B", run=run)
        ended.set()
    assert result.made == 12 and 0 < largest[0] <= space
    assert sorted(Path(one.sequence).name[:4] for one in result.failures) == ["dama", "gone"]
    assert scans(out) == convert_whole(tmp_path / "in", files)
    assert not list(scratch.glob("carlasc-*/*"))
