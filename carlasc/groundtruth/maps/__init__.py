"""Maps: the static points of a drive, in one frame."""
