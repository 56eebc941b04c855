"""Pictures and films without a screen: grids, scans, scene flow and the errors of a prediction."""
