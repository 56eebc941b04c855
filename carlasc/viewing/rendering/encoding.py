"""Pictures into files: PNG, GIF, and MP4 by the encoder that imageio-ffmpeg brings along. Whole files or none."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, CarlascError, import_extra
from carlasc.storage.files import write_atomic

STILLS = (".png",)
FILMS = (".gif", ".mp4")


def check_ending(path: Path) -> None:
    """Raise ArgumentError where a file name tells no format that can be written."""
    if path.suffix.lower() not in STILLS + FILMS:
        raise ArgumentError(path, expected=f"a name that ends in {', '.join(STILLS + FILMS)}", found=f"{path.name!r}")


def is_film(path: Path) -> bool:
    """Whether a file name tells a format of many pictures."""
    return path.suffix.lower() in FILMS


def encodable_size(path: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size a picture for a file must have: H.264 in yuv420p wants even ones, so odd ones grow by a pixel."""
    width, height = size
    return (width + width % 2, height + height % 2) if path.suffix.lower() == ".mp4" else size


def write_pictures(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write pictures as they come: the first into a PNG, all of them into a GIF or MP4.

    Args:
        path: its ending tells the format.
        pictures: (H, W, 3) uint8, all of one size, see `encodable_size`; at least one.
        fps: pictures a second.

    Raises:
        ArgumentError: an ending that is no format, or no positive `fps`.
        StorageError: it cannot be written; nothing is left behind.
        CarlascError: the encoder failed; nothing is left behind.
    """
    check_ending(path)
    if not 0 < fps <= 240:
        raise ArgumentError("fps", expected="over 0 to 240 pictures a second", found=f"{fps:g}")
    writers = {".png": _write_png, ".gif": _write_gif, ".mp4": _write_mp4}
    write = writers[path.suffix.lower()]
    write_atomic(path, lambda file: write(file, iter(pictures), fps))


def _write_png(file: BinaryIO, pictures: Iterator[NDArray[np.uint8]], fps: float) -> None:
    import_extra("PIL.Image", "render").fromarray(next(pictures)).save(file, format="PNG", compress_level=4)


def _write_gif(file: BinaryIO, pictures: Iterator[NDArray[np.uint8]], fps: float) -> None:
    first, rest = _to_palette(next(pictures)), (_to_palette(picture) for picture in pictures)
    hundredths = max(2, round(100 / fps))  # what the format counts in; viewers slow down below 2
    first.save(file, format="GIF", save_all=True, append_images=rest, duration=10 * hundredths, loop=0, disposal=1)


def _to_palette(picture: NDArray[np.uint8]) -> Any:
    """Return a picture in 256 colours, chosen so that small things keep theirs: a colour weighs less than it is frequent."""
    module = import_extra("PIL.Image", "render")
    packed = picture.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    colors, counts = np.unique(packed, return_counts=True)
    weighed = np.repeat(colors, np.ceil(counts**0.7).astype(np.int64))
    sample = np.stack([weighed >> 16, weighed >> 8 & 255, weighed & 255], axis=-1).astype(np.uint8)
    palette = module.fromarray(sample[None]).quantize(256, kmeans=1)
    return module.fromarray(picture).quantize(palette=palette, dither=module.Dither.NONE)


def _write_mp4(file: BinaryIO, pictures: Iterator[NDArray[np.uint8]], fps: float) -> None:
    encoder = import_extra("imageio_ffmpeg", "render").get_ffmpeg_exe()
    with tempfile.TemporaryDirectory(prefix="carlasc-") as folder, tempfile.TemporaryFile() as messages:
        target = Path(folder) / "film.mp4"
        picture = next(pictures)
        height, width, _ = picture.shape
        process = subprocess.Popen(
            [
                *(encoder, "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"),
                *("-r", f"{fps:g}", "-i", "-", "-c:v", "libx264", "-crf", "18", "-preset", "medium"),
                *("-pix_fmt", "yuv420p", "-movflags", "+faststart", str(target)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=True,  # Ctrl-C is ours to handle
        )
        try:
            _feed(process, picture, pictures)
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.wait() != 0:
            messages.seek(0)
            said = messages.read().decode(errors="replace").strip().splitlines() or ["no word"]
            raise CarlascError(
                encoder, expected="a film", found=f"exit code {process.returncode}", advice=f"{said[-1]}"
            )
        with target.open("rb") as film:
            shutil.copyfileobj(film, file)


def _feed(process: subprocess.Popen[bytes], first: NDArray[np.uint8], rest: Iterator[NDArray[np.uint8]]) -> None:
    """Hand pictures to the encoder; one that has died says why by its exit code."""
    if process.stdin is None:
        raise CarlascError("the film's encoder", expected="a pipe to it", found="none")
    with process.stdin as pipe:
        try:
            pipe.write(np.ascontiguousarray(first).data)
            for picture in rest:
                pipe.write(np.ascontiguousarray(picture).data)
        except BrokenPipeError:
            return
