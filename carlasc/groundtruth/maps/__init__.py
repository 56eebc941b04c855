"""Maps: what is static in a drive, in one frame."""
