"""Commands that read from and write to an S3 server."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults.comparing import is_record
from helpers.datasets.captures import read_tree, write_capture
from helpers.datasets.sequences import files_of
from helpers.datasets.tiny_kitti import write_tiny_kitti
from helpers.servers.object_store import (
    BUCKET,
    SECRET,
    FaultyServer,
    client_of,
    environment_for,
    every,
    faulty_server,
    options_for,
    s3_server,
)
from typer.testing import CliRunner

from carlasc.captures import find_captures
from carlasc.cli import app
from carlasc.storage.transport.remote_tree import RemoteTarget

pytest.importorskip("obstore")


@pytest.fixture(scope="module")
def server() -> Iterator[FaultyServer]:
    with (
        s3_server() as endpoint,
        faulty_server(endpoint) as found,
        pytest.MonkeyPatch.context() as patch,
    ):
        for name, value in environment_for(found.url).items():
            patch.setenv(name, value)
        yield found


@pytest.fixture(autouse=True)
def _sound(server: FaultyServer) -> None:
    server.reset(lambda number, method, path: None)


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def objects(url: str, server: FaultyServer) -> dict[str, bytes]:
    target = RemoteTarget(url, options_for(server.url))
    paths = sorted(target.paths())
    return {
        path: bytes(data) for path, data in zip(paths, target.tree.read_many(paths), strict=True)
    }


def outputs(files: dict[str, bytes]) -> dict[str, bytes]:
    """Return files without the records of inputs, which have the states of files."""
    return {
        path: data
        for path, data in files.items()
        if "/.carlasc/" not in f"/{path}" and not is_record(Path(path))
    }


@pytest.fixture(scope="module")
def made(server: FaultyServer, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the grids of a capture, and the URL of the same, made from the same capture in
    the bucket.
    """
    folder, url = tmp_path_factory.mktemp("made"), f"s3://{BUCKET}/made"
    write_capture(folder / "town", frames=3)
    RemoteTarget(f"{url}/town", options_for(server.url)).put_many(files_of(folder / "town"))
    server.reset(every(10, "503"))
    for place in (folder, url):
        code, _, err = run(
            "regrid", f"{place}/town", "-o", f"{place}/grids", "--res", "1.6", "--workers", "1"
        )
        assert code == 0, err
    assert server.made["503"] > 5
    return folder, url


def test_grids_are_the_same_files_in_a_bucket(made: tuple[Path, str], server: FaultyServer) -> None:
    folder, url = made
    assert outputs(objects(f"{url}/grids", server)) == outputs(files_of(folder / "grids"))


def test_a_second_run_makes_nothing_again(made: tuple[Path, str], server: FaultyServer) -> None:
    _, url = made
    code, out, _ = run(
        "regrid", f"{url}/town", "-o", f"{url}/grids", "--res", "1.6", "--workers", "1", "--json"
    )
    assert code == 0 and '"made": 0' in out and '"skipped": 3' in out
    puts = server.requests["PUT"]
    assert puts <= 2  # params.json, and nothing of the frames


def test_grids_are_made_beside_a_capture_in_a_bucket(
    made: tuple[Path, str], server: FaultyServer, tmp_path: Path
) -> None:
    folder, _ = made
    url = f"s3://{BUCKET}/beside/town"
    RemoteTarget(url, options_for(server.url)).put_many(files_of(folder / "town"))
    shutil.copytree(folder / "town", tmp_path / "town")
    for place in (url, f"{url}/raw", tmp_path / "town"):
        assert run("regrid", place, "--res", "1.6", "--workers", "1")[0] == 0
    kept = {path for path in outputs(objects(url, server)) if not path.startswith("raw/")}
    assert kept == set(read_tree(tmp_path / "town"))


def test_captures_are_found_in_a_bucket(made: tuple[Path, str], server: FaultyServer) -> None:
    folder, url = made
    captures = find_captures(url)
    assert list(captures) == list(find_captures(folder)) == ["town"]
    capture, local = captures["town"], find_captures(folder)["town"]
    assert capture.location == f"{url}/town/raw" and capture.sensors == local.sensors
    assert capture.frames.tolist() == local.frames.tolist() and capture.read_times(
        1
    ) == local.read_times(1)
    assert (
        capture.read_poses(0, local.frames).tolist() == local.read_poses(0, local.frames).tolist()
    )
    assert list(find_captures(f"{url}/town/raw")) == [""]


@pytest.mark.parametrize(
    "command",
    [
        ["info"],
        ["stats", "--workers", "1"],
        ["validate", "--full"],
        ["report"],
        ["evaluate", "{source}"],
        pytest.param(["pack", "{out}.zarr"], marks=pytest.mark.needs("zarr")),
        pytest.param(["export", "kitti", "{out}", "--json"], marks=pytest.mark.slow),
        ["view", "-o", "{out}.html"],
        pytest.param(
            ["render", "-o", "{out}.png", "--size", "64x64"],
            marks=pytest.mark.needs("embreex", "PIL", "imageio_ffmpeg"),
        ),
    ],
    ids=lambda command: str(command[0]),
)
def test_a_command_reads_from_a_url_what_it_reads_from_a_folder(
    made: tuple[Path, str], tmp_path: Path, command: list[str]
) -> None:
    folder, url = made
    results = []
    for place, out in (
        (f"{folder}/grids", tmp_path / "here"),
        (f"{url}/grids", tmp_path / "there"),
    ):
        name, *others = [part.format(source=place, out=out / "out") for part in command]
        before, others = (others[:1], others[1:]) if name == "export" else ([], others)
        out.mkdir()
        code, stdout, stderr = run(name, *before, place, *others)
        assert code == (1 if name == "validate" else 0), stderr  # the scans are random points
        results.append((stdout.replace(place, "PLACE"), outputs(files_of(out))))
    (shown_here, files_here), (shown_there, files_there) = results
    assert files_here.keys() == files_there.keys()
    if command[0] in ("pack", "export", "render"):
        assert files_here == files_there
    if command[0] in ("stats", "evaluate", "report"):
        assert shown_here == shown_there


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex")
def test_a_simulation_writes_the_same_bytes_to_a_bucket(
    server: FaultyServer, tmp_path: Path
) -> None:
    url, options = (
        f"s3://{BUCKET}/simulated",
        ["--count", "2", "--sensors", "2", "--channels", "8", "--points", "2000"],
    )
    server.reset(every(10, "503"))
    for place in (url, tmp_path):
        assert run("simulate", place, *options, "--no-bev", "--workers", "1")[0] == 0
    assert server.made["503"] >= 1
    assert outputs(objects(url, server)) == outputs(files_of(tmp_path))
    code, out, _ = run("simulate", url, *options, "--no-bev", "--workers", "1", "--json")
    assert code == 0 and '"written": 0' in out


WRONG = {
    "no bucket to read": (["info", "s3://no-such-bucket/x"], 1, "no such bucket"),
    "no bucket to write": (["simulate", "s3://no-such-bucket/x", "--count", "1"], 1, "no such "
                                                                                     "bucket"),
    "nothing there": (["stats", f"s3://{BUCKET}/nothing"], 1, "found nothing"),
    "a slash was lost": (["info", "s3:/bucket/x"], 2, "SOURCE: expected a path, or a URL such as "
                                                      "s3://bucket/folder"),
    "a picture in a bucket": (["render", ".", "-o", "s3://bucket/x.png"], 2, "--out: expected a "
                                                                             "path on this machine"),
    "an export to a bucket": (["export", "kitti", ".", "s3://bucket/x"], 2, "found the URL "
                                                                            "s3://bucket/x"),
    "a file in a bucket": (["regrid", ".", "-o", "s3://bucket/x.h5", "--preset", "coarse"], 2, "--out: expected a .zarr store, or a folder"),
    "a web server": (["simulate", "https://host/x"], 2, "found a web server"),
    "several processes in memory": (["simulate", "memory://x", "--workers", "2"], 2, "--workers: "
                                                                                     "expected 1 "
                                                                                     "with memory"),
    "nothing given": (["info", ""], 2, "SOURCE: expected a path or a URL"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_place_is_one_line(server: FaultyServer, wrong: str) -> None:
    arguments, code, message = WRONG[wrong]
    found, _, err = run(*arguments)
    assert found == code and message in err and err.count("\n") == 1 and SECRET not in err, err


@pytest.mark.parametrize(
    ("fault", "message"), [("503", "failed at each attempt"), ("403", "access was refused")]
)
@pytest.mark.parametrize("writing", [False, True])
def test_a_store_that_always_fails_is_one_line(
    made: tuple[Path, str], server: FaultyServer, fault: str, message: str, writing: bool
) -> None:
    folder, url = made
    server.reset(lambda number, method, path: fault if not writing or method == "PUT" else None)
    out = f"s3://{BUCKET}/other {fault}"
    arguments = (
        ["regrid", f"{folder}/town", "-o", out, "--size", "32,32,8", "--workers", "1"]
        if writing
        else ["info", url]
    )
    code, _, err = run(*arguments)
    assert code == 1 and message in err and err.count("\n") == 1 and SECRET not in err, err


def test_a_home_folder_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_capture(tmp_path / "town", frames=1)
    assert run("info", "~/town")[0] == 0


@pytest.mark.slow
@pytest.mark.needs("trimesh", "embreex", "zarr")
def test_the_example_of_the_documentation_runs(
    server: FaultyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[2] / "docs/storage.md").read_text()
    block = page.partition('```sh title="object-store"\n')[2].partition("```")[0]
    commands = [line for line in block.splitlines() if line.startswith("carlasc ")]
    variables = {
        text.partition("=")[0] for text in block.replace("export ", "").split() if "=" in text
    }
    assert len(commands) == 6 and variables <= environment_for("").keys()
    client_of(server.url).create_bucket(Bucket="bucket")
    monkeypatch.chdir(tmp_path)
    for command in commands:
        code, _, err = run(*shlex.split(command, comments=True)[1:])
        assert code == 0, (command, err)
    assert (tmp_path / "grids/cartesian/evaluation_32x32x2/000001.label").is_file()


@pytest.mark.slow
def test_storage_options_come_from_the_environment(
    made: tuple[Path, str], server: FaultyServer
) -> None:
    _, url = made
    options = {
        "FSSPEC_S3_ENDPOINT_URL": server.url,
        "FSSPEC_S3_KEY": "key",
        "FSSPEC_S3_SECRET": SECRET,
    }
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("AWS_")
    } | options
    command = [sys.executable, "-m", "carlasc", "info", f"{url}/grids"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "evaluation_32x32x2" in result.stdout, result.stderr


@pytest.mark.slow
def test_a_conversion_writes_the_same_files_to_a_bucket(
    server: FaultyServer, tmp_path: Path
) -> None:
    """Scans, then grids of these scans, which are read from the bucket again."""
    write_tiny_kitti(tmp_path / "kitti", points=400)
    url = f"s3://{BUCKET}/converted"
    server.reset(every(10, "503"))
    for place in (tmp_path / "here", url):
        options = [
            "--res",
            "3.2",
            "--window",
            "-1:1",
            "--poses",
            "file",
            "--force",
            "--workers",
            "1",
        ]
        code, _, err = run("convert", "kitti", tmp_path / "kitti", place, *options)
        assert code == 0, err
    assert server.made["503"] > 5
    found, wanted = outputs(objects(url, server)), outputs(files_of(tmp_path / "here"))
    assert found.keys() == wanted.keys() and any(
        path.endswith("/evaluation_16x16x1/000000.label") for path in found
    )
    assert found == wanted


@pytest.mark.slow
@pytest.mark.needs("zarr")
@pytest.mark.parametrize("fault", ["503", "drop", "lose the answer"])
def test_a_store_in_a_bucket_holds_what_a_folder_holds_although_the_server_fails_now_and_then(
    made: tuple[Path, str], server: FaultyServer, tmp_path: Path, fault: str
) -> None:
    folder, _ = made
    url = f"s3://{BUCKET}/store {fault}"
    server.reset(every(10, fault))
    for arguments in (
        ("regrid", folder / "town", "-o", f"{url}/grids.zarr", "--res", "1.6", "--workers", "1"),
        ("unpack", f"{url}/grids.zarr", tmp_path / "grids", "--workers", "1"),
        ("pack", f"{url}/grids.zarr", f"{url}/packed.zarr", "--workers", "1"),
        ("unpack", f"{url}/packed.zarr", f"{url}/files", "--workers", "1"),
    ):
        code, _, err = run(*arguments)
        assert code == 0, (arguments, err)
    assert server.made[fault] > 5
    assert (
        outputs(files_of(tmp_path / "grids"))
        == outputs(objects(f"{url}/files", server))
        == outputs(files_of(folder / "grids"))
    )
