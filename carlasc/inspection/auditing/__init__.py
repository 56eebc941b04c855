"""The audit of ground truth of any origin: grids are compared with their scans frame by frame, and
the sums give the verdicts.
"""
