"""Reading pictures and films.

Test modules that import this are skipped if a package of the render extra is missing.
"""

from __future__ import annotations

import numpy as np
import pytest

Image = pytest.importorskip("PIL.Image")
imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")


def read_mp4(path):
    """Return the film's metadata and its frames, (H, W, 3) uint8 each."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def count_gif(path):
    """Return the number of pictures in a GIF."""
    with Image.open(path) as film:
        return getattr(film, "n_frames", 1)
