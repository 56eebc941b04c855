"""How each actor moves: segments of moving points in each scan, linked into tracks; scene flow from tracks.

World is the frame of the poses: the first scan's sensor.
"""

from carlasc.motion.segments import Segment, Standing, segment_by_flow, segment_by_instances, standing_points
from carlasc.motion.tracks import Track, link_segments

__all__ = [
    "Segment",
    "Standing",
    "Track",
    "link_segments",
    "segment_by_flow",
    "segment_by_instances",
    "standing_points",
]
