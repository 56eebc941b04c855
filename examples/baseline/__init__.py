"""A small network of our own: from the visibility of past scans to the classes of all voxels."""
