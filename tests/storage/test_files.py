import os
import subprocess
import sys

import pytest

from carlasc.errors import CarlascError, FormatError
from carlasc.storage.files import parse_json, remove_stale, write_atomic, write_json, write_output


def test_a_file_is_written_with_its_folders_and_nothing_beside_it(tmp_path):
    path = tmp_path / "a" / "b.bin"
    write_atomic(path, b"12")
    write_atomic(path, lambda file: file.write(b"345"))
    assert path.read_bytes() == b"345"
    assert os.listdir(path.parent) == ["b.bin"]


def test_a_write_that_breaks_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "b.bin"
    write_atomic(path, b"old")

    def interrupted(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, interrupted)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["b.bin"]


def test_files_get_the_permissions_of_the_umask(tmp_path):
    code = f"import os; os.umask(0o027); from carlasc.storage.files import write_atomic; from pathlib import Path; write_atomic(Path({str(tmp_path / 'x')!r}), b'')"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o640


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path):
    code = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000));"
        "from carlasc.storage.files import write_atomic; from carlasc.errors import CarlascError; "
        "from pathlib import Path\n"
        f"try: write_atomic(Path({str(tmp_path / 'x')!r}), bytes(5000))\n"
        "except CarlascError as error: print(error)"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    assert "cannot be written" in out
    assert out.count("\n") == 1
    assert os.listdir(tmp_path) == []


def test_a_folder_in_the_way_is_one_line(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CarlascError, match="cannot be written"):
        write_atomic(tmp_path / "file" / "x", b"")


def test_json_is_written_as_the_published_files_are(tmp_path):
    write_json(tmp_path / "params.json", {"grid_size": [128.0], "max_bound": [25.600000381469727]})
    assert (
        tmp_path / "params.json"
    ).read_text() == '{"grid_size": [128.0], "max_bound": [25.600000381469727]}'


@pytest.mark.parametrize("data", [b"{", b"\xff", b"[1]", b'{"a": "\\ud800"}'])
def test_what_is_no_json_object_is_refused_by_name(data):
    with pytest.raises(FormatError, match="here.json: expected"):
        parse_json(data, "here.json")


def test_escaped_pairs_are_one_character():
    assert parse_json(b'{"a": "\\ud83d\\ude97"}', "here.json") == {"a": "\U0001f697"}


def test_what_killed_writers_left_is_removed_and_what_others_write_now_is_not(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from carlasc.storage.files import "
        "write_atomic\n"
        "write_atomic(Path(sys.argv[1]), lambda file: os.kill(os.getpid(), signal.SIGKILL))"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "velodyne/000000.bin")], check=False)
    assert [path.suffix for path in (tmp_path / "velodyne").iterdir()] == [".part"]

    def sweep(file):
        remove_stale(tmp_path)
        file.write(b"whole")

    write_atomic(tmp_path / "velodyne" / "000001.bin", sweep)
    assert {path.name: path.read_bytes() for path in (tmp_path / "velodyne").iterdir()} == {
        "000001.bin": b"whole"
    }


def test_what_other_machines_left_is_removed_when_it_is_a_day_old(tmp_path):
    new, old = tmp_path / ".a.bin.elsewhere-1.x.part", tmp_path / ".b.bin.elsewhere-1.x.part"
    for path in (new, old):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    remove_stale(tmp_path)
    assert list(tmp_path.iterdir()) == [new]


def test_a_single_file_is_written_where_a_killed_run_left_a_part_of_it_and_other_files_stay(
    tmp_path,
):
    begun = "import os; from carlasc.storage.files import write_atomic; from pathlib import Path;"
    for name in ("film [1].mp4", "film 1.mp4"):
        path = tmp_path / name
        code = f"{begun} write_atomic(Path({str(path)!r}), lambda file: os.kill(os.getpid(), 9))"
        subprocess.run([sys.executable, "-c", code], check=False)
    assert len(os.listdir(tmp_path)) == 2
    write_output(tmp_path / "film [1].mp4", b"whole")
    assert sorted(name.partition(".mp4")[0] for name in os.listdir(tmp_path)) == [
        ".film 1",
        "film [1]",
    ]
