"""The motion of actors: moving points are grouped into segments in each scan, and segments are linked into tracks over time.

"World" is the frame of the poses, which is the sensor frame of the first scan.
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
