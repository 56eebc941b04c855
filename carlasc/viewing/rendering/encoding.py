"""Writing pictures as PNG, GIF, MP4 and WebP (the last two with the encoder that imageio-ffmpeg
includes). A file is written completely or not at all.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.errors import ArgumentError, CarlascError, import_extra
from carlasc.storage.files import write_output

STILLS = (".png",)
FILMS = (".gif", ".mp4", ".webp")
NAME_A_FILM = "name a .gif, .mp4 or .webp"
_H264 = "-c:v libx264 -crf 18 -preset medium -pix_fmt yuv420p -movflags +faststart"
_ENCODERS = {
    ".mp4": f"{_H264} -f mp4".split(),
    ".webp": "-c:v libwebp_anim -quality 72 -loop 0 -f webp".split(),
}


def is_film(path: Path) -> bool:
    """Whether a file name has the ending of a format that holds several pictures."""
    return path.suffix.lower() in FILMS


def check_single(path: Path, frames: Sequence[int]) -> None:
    """Raise ArgumentError if several frames are given for a file that holds one picture."""
    if not is_film(path) and len(frames) > 1:
        raise ArgumentError(
            "out",
            expected="a single frame for a PNG",
            found=f"{len(frames)} frames for {path.name}",
            advice=NAME_A_FILM,
        )


def encodable_size(path: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Return the (width, height) of pictures for a file: H.264 in yuv420p needs even numbers, so
    odd ones grow by one pixel.
    """
    width, height = size
    return (width + width % 2, height + height % 2) if path.suffix.lower() == ".mp4" else size


def write_pictures(
    path: Path, pictures: Iterable[Uint8Array], fps: float, dpi: float | None = None
) -> None:
    """Write pictures one after the other: the first one into a PNG, all of them into a film.

    Args:
        path: a file name that ends in .png, or in one of `FILMS`.
        pictures: (H, W, 3) uint8, all of one size (see `encodable_size`); at least one.
        fps: pictures per second, above 0.
        dpi: pixels per inch in the metadata of a PNG; None for none. Not used for films.

    Raises:
        ArgumentError: an impossible `fps`.
        StorageError: it cannot be written; nothing is left behind.
        CarlascError: the encoder failed; nothing is left behind.
    """
    if not 0 < fps <= 240:
        raise ArgumentError(
            "fps", expected="above 0 and at most 240 pictures per second", found=f"{fps:g}"
        )
    suffix = path.suffix.lower()
    if suffix in STILLS:
        settings = {} if dpi is None else {"dpi": (dpi, dpi)}
        image = import_extra("PIL.Image", "render").fromarray(next(iter(pictures)))
        write_output(path, partial(image.save, format="PNG", compress_level=4, **settings))
    elif suffix == ".gif":
        write_output(path, lambda file: _write_gif(file, iter(pictures), fps))
    else:
        write_output(path, lambda file: _encode(file, iter(pictures), fps, _ENCODERS[suffix]))


def _write_gif(file: BinaryIO, pictures: Iterator[Uint8Array], fps: float) -> None:
    first = _to_palette(next(pictures))
    rest = (_to_palette(picture) for picture in pictures)
    hundredths = max(2, round(100 / fps))  # the unit of the format; viewers slow down below 2
    first.save(
        file,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=10 * hundredths,
        loop=0,
        disposal=1,
    )


def _to_palette(picture: Uint8Array) -> Any:
    """Return a picture in 256 colours.

    Rare colours have a weight above their frequency, so that small objects keep their colour.
    """
    module = import_extra("PIL.Image", "render")
    packed = picture.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    colors, counts = np.unique(packed, return_counts=True)
    weighed = np.repeat(colors, np.ceil(counts**0.7).astype(np.int64))
    sample = np.stack([weighed >> 16, weighed >> 8 & 255, weighed & 255], axis=-1).astype(np.uint8)
    palette = module.fromarray(sample[None]).quantize(256, kmeans=1)
    return module.fromarray(picture).quantize(palette=palette, dither=module.Dither.NONE)


def _encode(
    file: BinaryIO, pictures: Iterator[Uint8Array], fps: float, settings: list[str]
) -> None:
    """Encode a film into the file itself, by its name: a killed run leaves no other file, and the
    encoder can seek in it.
    """
    encoder = import_extra("imageio_ffmpeg", "render").get_ffmpeg_exe()
    with tempfile.TemporaryFile() as messages:
        picture = next(pictures)
        height, width, _ = picture.shape
        raw = f"-v error -y -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps:g} -i -"
        process = subprocess.Popen(
            [encoder, *raw.split(), *settings, f"file:{file.name}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=True,  # Ctrl-C must not reach the encoder: this process ends it
        )
        try:
            # if the encoder ends early, its exit code says so
            with suppress(BrokenPipeError), cast(BinaryIO, process.stdin) as pipe:
                for one in chain([picture], pictures):
                    pipe.write(np.ascontiguousarray(one).data)
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.wait() != 0:
            messages.seek(0)
            lines = messages.read().decode(errors="replace").strip().splitlines() or [
                "the encoder printed no message"
            ]
            raise CarlascError(
                encoder, problem=f"failed with exit code {process.returncode}", advice=lines[-1]
            )
