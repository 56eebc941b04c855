"""A small network of our own: what past scans saw in, classes of all voxels out."""
