"""Reading the files of other data sets: errors of the system or of other libraries become errors
that name the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, reading
from carlasc.storage import layout
from carlasc.storage.arrays import ArrayFormat, open_npz
from carlasc.storage.files import AnyPath

COPY = "the file may be cut short: copy it again"
_RAW = {
    "pcap": "pcap files hold packets of a LiDAR: convert them to PCD, LAS or a bag with the tool "
    "of its maker (Ouster: `ouster-cli`, Velodyne: VeloView, Hesai: PandarView, RoboSense: RSView, "
    "Livox: Livox Viewer), or replay them with its ROS driver and record its topic of points",
    "osf": "convert OSF to PCD, LAS or a bag with `ouster-cli source FILE save` of ouster-sdk",
    "lvx": "convert LVX to LAS, PCD or a bag with Livox Viewer or livox_ros_driver",
    "e57": "convert E57 to LAS or PLY with CloudCompare or `pdal translate`, a file for each scan",
}
_RAW |= {"pcapng": _RAW["pcap"], "lvx2": _RAW["lvx"]}
MAX_UNPACKED = 1 << 28
"""Greatest number of bytes that one compressed chunk, message or scan is unpacked to."""
_OF_THE_LAYOUT = {*layout.scan_folders(), *layout.SPLITS, *layout.COORDINATES, layout.EVALUATION}
_MISSING = "check the path, or unpack the archive that contains it"


@contextmanager
def opening(path: AnyPath, expected: str, advice: str = COPY) -> Iterator[None]:
    """Turn errors in a block that opens and reads one file into errors of carlasc.

    Args:
        path: the file.
        expected: content that it should have.
        advice: what to do if it does not.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file cannot be read, or has another content.
    """
    with reading(path, expected, advice):
        try:
            yield
        except FileNotFoundError:
            raise MissingDataError(
                path, expected=expected, found="nothing", advice=_MISSING
            ) from None


def raw_advice(names: Iterable[str]) -> str:
    """Return what to do with recordings in a format of a maker's tool; empty without one."""
    endings = {name.lower().rpartition(".")[2] for name in names}
    return "; ".join(text for ending, text in _RAW.items() if ending in endings)


def check_size(size: int, where: AnyPath) -> None:
    """Check the bytes that a compressed part of a file says it contains, before it is unpacked.

    Raises:
        FormatError: they are more than any scan or chunk has.
    """
    if size > MAX_UNPACKED:
        raise FormatError(
            where,
            expected=f"compressed parts of at most {MAX_UNPACKED >> 20} MiB",
            found=f"one of {size >> 20:,} MiB",
            advice="the file is damaged; if not, write it again without compression",
        )


def sequence_name(name: str) -> str:
    """Return a valid name of a sequence in the layout, from the name of a file or a folder."""
    name = re.sub(r"[^\w-]+", "_", name)
    return f"{name}_recording" if name in _OF_THE_LAYOUT else name


Version = tuple[int, int]
"""The version of a file: nanoseconds of its last change, and its size in bytes."""


def version_of(path: AnyPath, expected: str = "a file") -> Version:
    """Return the version of a file, for the keys of caches.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: its metadata cannot be read.
    """
    with opening(path, expected):
        status = Path(path).stat()
    return status.st_mtime_ns, status.st_size


def read_bytes(path: AnyPath, expected: str = "a file", advice: str = COPY) -> bytes:
    """Return a whole file.

    Raises:
        MissingDataError: it does not exist.
        FormatError: it cannot be read.
    """
    with opening(path, expected, advice):
        return Path(path).read_bytes()


def read_text(path: AnyPath, expected: str = "a text file", advice: str = COPY) -> str:
    """Return a whole text file in UTF-8.

    Raises:
        MissingDataError: it does not exist.
        FormatError: it cannot be read, or is not text.
    """
    with opening(path, expected, advice):
        return Path(path).read_text("utf-8")


def read_arrays(
    path: str | Path, formats: Mapping[str, ArrayFormat], advice: str
) -> list[AnyArray]:
    """Return some arrays of an .npz file, in the order of their names. No pickle is read.

    Args:
        path: the file.
        formats: type and shape of each required array, by its name.
        advice: what to do if the file is missing or damaged.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not an .npz file, is damaged, or lacks an array; or an array has another
            type, shape or size.
    """
    try:
        with open_npz(path) as arrays:
            return [arrays.read(name, expected) for name, expected in formats.items()]
    except (MissingDataError, FormatError) as error:
        error.advice = error.advice or advice
        raise


def no_data(source: Path, expected: str, advice: str) -> MissingDataError:
    """Return the error of a converter that finds no recording at a place."""
    found = "none" if source.exists() else "no such folder"
    return MissingDataError(source, expected=expected, found=found, advice=advice)


def missing_scans(
    files: Iterable[tuple[int, Path]], expected: str, advice: str = ""
) -> list[tuple[int, str]]:
    """Return the problems of a recording whose frames lack files: number and message of each."""
    found = "no such file"
    return [
        (number, str(MissingDataError(file, expected=expected, found=found, advice=advice)))
        for number, file in files
    ]


def check_labels(labels: AnyArray, points: int, path: AnyPath) -> None:
    """Check that a file has a label for each point.

    Raises:
        FormatError: it has another number of labels.
    """
    if len(labels) != points:
        raise FormatError(
            path,
            expected=f"a label for each of {points} points",
            found=len(labels),
            advice="the file belongs to another scan, or is incomplete",
        )


def is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
