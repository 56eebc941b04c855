"""The audit of anybody's ground truth: grids and the scans that they belong to are counted frame by frame, and judged by the sums."""
