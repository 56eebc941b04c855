import pickle
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.ply import PlyVertices

from carlasc.errors import FormatError, MissingDataError

DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("label", "<i4"), ("red", "u1")])
HEADER = "property float x\nproperty float32 y\nproperty int label\nproperty uchar red\n"


def vertices(count: int = 11) -> np.ndarray:
    rng = np.random.default_rng(3)
    rows = np.empty(count, DTYPE)
    rows["x"], rows["y"] = rng.normal(0, 30, (2, count)).astype(np.float32)
    rows["label"], rows["red"] = rng.integers(-5, 5, count), rng.integers(0, 256, count)
    return rows


def write(
    path: Path,
    rows: np.ndarray,
    kind: str,
    *,
    extra: str = "",
    before: bytes = b"",
    after: bytes = b"",
) -> Path:
    head = f"ply\nformat {kind} 1.0\ncomment made by a test\n{extra}element vertex {len(rows)}\n{HEADER}end_header\n"
    if kind == "ascii":
        body = "".join(f"{r['x']!s} {r['y']!s} {r['label']} {r['red']}\n" for r in rows).encode()
    else:
        body = rows.astype(rows.dtype.newbyteorder("<" if "little" in kind else ">")).tobytes()
    path.write_bytes(head.encode() + before + body + after)
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [0, 1, 11])
def test_every_kind_gives_the_rows_that_were_written(tmp_path: Path, kind: str, count: int) -> None:
    rows = vertices(count)
    ply = PlyVertices.open(write(tmp_path / "a.ply", rows, kind), ("x", "label"))
    assert len(ply) == count
    for name in DTYPE.names or ():
        np.testing.assert_array_equal(ply.read()[name], rows[name])
    chunks = [np.array(chunk[["x", "red"]].tolist()) for chunk in ply.chunks(4)]
    assert [len(chunk) for chunk in chunks] == [
        min(4, count - start) for start in range(0, count, 4)
    ]
    if count:
        np.testing.assert_array_equal(np.concatenate(chunks), np.array(rows[["x", "red"]].tolist()))


def test_rows_of_a_binary_file_are_read_alone_in_another_process(tmp_path: Path) -> None:
    rows = vertices()
    ply = PlyVertices.open(write(tmp_path / "a.ply", rows, "binary_little_endian"))
    again = pickle.loads(pickle.dumps(ply))
    np.testing.assert_array_equal(again.rows(3, 7), rows[3:7])
    assert len(again.rows(9, 100)) == 2
    assert len(again.rows(7, 7)) == 0


@pytest.mark.parametrize(
    ("kind", "before"), [("binary_little_endian", b"\x01\x02" * 8), ("ascii", b"1 2\n3 4\n")]
)
def test_elements_before_and_after_the_vertices_are_passed_over(
    tmp_path: Path, kind: str, before: bytes
) -> None:
    rows = vertices()
    extra = "element camera 2\nproperty float a\nproperty float b\n"
    path = write(tmp_path / "a.ply", rows, kind, extra=extra, before=before, after=b"1 2\n")
    np.testing.assert_array_equal(PlyVertices.open(path).read()["y"], rows["y"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", 'a PLY file, which begins with the line "ply"'),
        (b"PK\x03\x04 something", 'a PLY file, which begins with the line "ply"'),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n", "a PLY header that ends with end_header"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n1\n", "a line with the format"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "expected vertices, found face"),
        (b"ply\nformat binary_middle 1.0\nend_header\n", "'format binary_middle 1.0'"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "'property float x'"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "'element vertex many'"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n1\n",
            "half for the property x",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar half n\nend_header\n1 1\n",
            "'property list uchar half n'",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n1 1\n",
            "properties with names of their own",
        ),
    ],
)
def test_a_wrong_header_is_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(FormatError) as error:
        PlyVertices.open(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("cut", [4, 40])
def test_a_body_that_is_cut_short_is_refused(tmp_path: Path, kind: str, cut: int) -> None:
    path = write(tmp_path / "a.ply", vertices(), kind)
    content = path.read_bytes()
    path.write_bytes(
        content[:-cut] if kind != "ascii" else b"\n".join(content.split(b"\n")[: -cut // 3])
    )
    with pytest.raises(FormatError, match=r"the file is incomplete"):
        PlyVertices.open(path).read()


@pytest.mark.parametrize(
    "line", [b"1 2 three 4\n", b"1 2\n", b"1 2 3 4 5\n", "1 2 3 4\u00b5\n".encode()]
)
def test_text_that_is_no_number_is_refused(tmp_path: Path, line: bytes) -> None:
    path = write(tmp_path / "a.ply", vertices(), "ascii")
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:-4], line, *lines[-3:]]))
    with pytest.raises(FormatError, match=r"4 numbers in each of 11 rows") as error:
        PlyVertices.open(path).read()
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_missing_property_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="a PLY file"):
        PlyVertices.open(tmp_path / "none.ply")
    path = write(tmp_path / "a.ply", vertices(), "ascii")
    with pytest.raises(FormatError, match="vertices with z, semantic, found x, y, label, red"):
        PlyVertices.open(path, ("x", "z", "semantic"))


def test_rows_of_a_text_file_cannot_be_read_alone(tmp_path: Path) -> None:
    ply = PlyVertices.open(write(tmp_path / "a.ply", vertices(), "ascii"))
    with pytest.raises(FormatError, match="a binary PLY file, found a text file"):
        ply.rows(0, 1)
