"""Ground truth from one sensor's scans, merged over time."""
