"""The client of a CARLA server that records raw captures."""
