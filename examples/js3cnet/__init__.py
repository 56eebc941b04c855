"""JS3C-Net: what each point is, and from that what each voxel is."""
