"""Reading films."""

from __future__ import annotations

import imageio_ffmpeg
import numpy as np
from PIL import Image


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
