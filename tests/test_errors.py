import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.processes import jobs

from carlasc.errors import (
    ArgumentError,
    CarlascError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
    StorageError,
    count,
    first_names,
    import_extra,
    install_command,
    postponed_interrupts,
    printable,
    reading,
)
from carlasc.storage.folder import FolderSource

KINDS = (FormatError, MissingDataError, DependencyError, ArgumentError, ConflictError, StorageError)


def test_every_kind_is_a_carlasc_error_and_some_are_errors_of_python_too():
    assert all(issubclass(kind, CarlascError) for kind in KINDS)
    assert {kind for kind in KINDS if issubclass(kind, ValueError)} == {FormatError, ArgumentError}
    assert {kind for kind in KINDS if issubclass(kind, ImportError)} == {DependencyError}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "a.bin"),
        ({"problem": "cannot be read"}, "a.bin: cannot be read"),
        ({"expected": "4 bytes", "found": "3"}, "a.bin: expected 4 bytes, found 3"),
        ({"found": "3"}, "a.bin: found 3"),
        (
            {"expected": "4 bytes", "advice": "copy it again"},
            "a.bin: expected 4 bytes: copy it again",
        ),
        (
            {
                "problem": "is damaged",
                "expected": "4 bytes",
                "found": "3",
                "advice": "copy it again",
            },
            "a.bin: is damaged: expected 4 bytes, found 3: copy it again",
        ),
        ({"problem": "one\ntwo\r\nthree", "advice": "four\n"}, "a.bin: one two three: four"),
    ],
)
def test_the_message_is_one_line_made_of_the_parts(parts, message):
    error = FormatError(Path("a.bin"), **parts)
    assert str(error) == message
    assert error.where == "a.bin"


def test_errors_come_back_whole_from_another_process():
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for kind in KINDS:
            error = kind(Path("a"), problem="b", expected="c", found="d", advice="e")
            found = pool.submit(jobs.raise_error, error).exception()
            assert type(found) is kind
            assert str(found) == str(error) == "a: b: expected c, found d: e"
            assert (found.where, found.problem, found.expected, found.found, found.advice) == tuple(
                "abcde"
            )


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_within_a_place_names_both_and_leaves_the_first_as_it_is(kind):
    error = kind("b", expected="c", found="d", advice="e")
    outer = error.within("a.zip").within("c")
    assert type(outer) is kind
    assert str(outer) == "c: a.zip: b: expected c, found d: e"
    assert str(error) == "b: expected c, found d: e"
    assert str(pickle.loads(pickle.dumps(outer))) == str(outer)


@pytest.mark.parametrize("part", ["where", "problem", "expected", "found", "advice"])
def test_no_part_of_a_message_steers_a_terminal_or_fills_it(part):
    hostile = "a\x1b[2J\x07\u202eb\nc\x85d\udcff\u2066" + "x" * 5000 + "end"
    parts = {
        name: hostile if name == part else "fine"
        for name in ("where", "problem", "expected", "found", "advice")
    }
    message = str(FormatError(parts.pop("where"), **parts))
    assert "a\\x1b[2J\\x07\\u202eb c d\\udcff\\u2066xxx" in message
    assert message.isprintable()
    assert " [...] xxx" in message
    assert "end" in message
    assert len(message) < 1000


def test_names_are_shown_as_they_are_except_for_what_a_terminal_obeys():
    assert printable("Straße 京都 שלום [/bold] <b> \\ é") == "Straße 京都 שלום [/bold] <b> \\ é"
    assert printable("a\tb\x9b31m\u2028") == "a\\tb\\x9b31m\\u2028"


def test_whatever_a_block_raises_is_one_error_that_names_the_file_and_keeps_its_cause():
    for error, found in (
        (KeyError("a"), "KeyError: 'a'"),
        (RecursionError(), "RecursionError"),
        (OSError("b\nc"), "b c"),
    ):
        with pytest.raises(FormatError) as caught, reading("x.bin", "numbers", "copy it again"):
            raise error
        assert (
            str(caught.value)
            == f"x.bin: expected numbers, found something else ({found}): copy it again"
        )
        assert caught.value.__cause__ is error
    own = MissingDataError("y.bin")
    with pytest.raises(MissingDataError) as caught, reading("x.bin", "numbers"):
        raise own
    assert caught.value is own
    with pytest.raises(KeyboardInterrupt), reading("x.bin", "numbers"):
        raise KeyboardInterrupt


def test_a_missing_extra_is_one_line_that_says_what_to_install():
    with pytest.raises(
        DependencyError, match=r"no_such_module is not installed: .*pip install .*\[zarr\]'"
    ) as caught:
        import_extra("no_such_module.part", "zarr")
    assert "\n" not in str(caught.value)


ORIGINS = {
    '{"url": "file:///home/a%20b/carlasc", "dir_info": {"editable": true}}': "pip install -e "
    "'/home/a b/carlasc[zarr]'",
    '{"url": "file:///tmp/carlasc", "dir_info": {}}': "pip install '/tmp/carlasc[zarr]'",
    '{"url": "file:///tmp/carlasc-1.whl", "archive_info": {}}': "pip install "
    "'/tmp/carlasc-1.whl[zarr]'",
    '{"url": "https://example.org/carlasc.whl", "archive_info": {}}': "pip install 'carlasc[zarr]'",
    "broken": "pip install 'carlasc[zarr]'",
    None: "pip install 'carlasc[zarr]'",  # from an index
}


@pytest.mark.parametrize(("origin", "command"), ORIGINS.items(), ids=map(str, ORIGINS))
def test_an_extra_is_installed_from_where_carlasc_came(origin, command, monkeypatch):
    monkeypatch.setattr(
        metadata,
        "distribution",
        lambda name: SimpleNamespace(read_text={"direct_url.json": origin}.get),
    )
    assert install_command("zarr") == command


def test_a_module_that_fails_to_load_says_why(tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text("import libfoo_that_is_not_there\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        DependencyError, match="broken_module does not load .*libfoo_that_is_not_there"
    ):
        import_extra("broken_module", "view")


def test_ctrl_c_is_not_lost_in_a_module_that_catches_everything(tmp_path, monkeypatch):
    lines = (
        "import os, signal",
        "try:",
        "    os.kill(os.getpid(), signal.SIGINT)",
        "    sum(range(1000))",
    )
    (tmp_path / "catches_all.py").write_text(
        "\n".join([*lines, "except BaseException:", "    pass", ""])
    )
    monkeypatch.syspath_prepend(tmp_path)
    # a program that a shell starts with "&" ignores Ctrl-C
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            import_extra("catches_all", "view")
    finally:
        signal.signal(signal.SIGINT, usual)


def test_importing_carlasc_loads_numpy_and_nothing_heavier():
    code = (
        "import sys, carlasc; heavy = {'numba', 'torch', 'typer', 'rich', 'zarr', 'h5py', "
        "'pyarrow', 'trimesh', 'open3d', 'fsspec'};"
        "print(sorted(heavy & set(sys.modules)), 'numpy' in sys.modules or True)"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert out.startswith("[]")


def test_every_public_name_resolves():
    import carlasc

    for name in carlasc.__all__:
        assert getattr(carlasc, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        carlasc.no_such_name  # noqa: B018


PROGRAM = """
import os, signal, threading
from carlasc.storage.packed.chunks import in_threads

start = threading.Thread.start

def start_and_interrupt(thread):
    start(thread)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread.start = start_and_interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    in_threads(str, range(3))
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_waits_for_the_end_of_the_block():
    before, reached = signal.signal(signal.SIGINT, signal.default_int_handler), []
    try:
        with pytest.raises(KeyboardInterrupt), postponed_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            reached.append(True)
        assert reached == [True]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_are_left_alone():
    handlers = []

    def look():
        with postponed_interrupts():
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


def test_a_program_that_is_interrupted_while_its_threads_start_ends():
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        start_new_session=True,
    )
    assert (ran.returncode, ran.stdout) == (0, "interrupted\n"), ran.stderr


@pytest.mark.parametrize(
    "arguments, text",
    [
        ((1, "frame"), "1 frame"),
        ((0, "frame"), "0 frames"),
        ((12345, "file"), "12,345 files"),
        ((2, "box", "boxes"), "2 boxes"),
    ],
)
def test_a_noun_agrees_with_its_number(arguments, text):
    assert count(*arguments) == text


def test_names_after_the_first_few_are_counted():
    assert first_names(["a", "b", "c"], most=2) == "a, b and 1 more"
    assert first_names(["a", "b"], most=2) == "a, b"


def test_a_source_is_named_by_its_location(tmp_path):
    source = FolderSource(tmp_path)
    assert MissingDataError(source, expected="x").where == str(tmp_path)
