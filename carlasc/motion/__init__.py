"""The motion of actors: moving points are grouped into segments in each scan, and segments are linked into tracks over time.

"World" is the frame of the poses, which is the sensor frame of the first scan.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.motion.bodies import Extent, seen_from, usual_shell
    from carlasc.motion.boxes import segment_by_boxes, tracks_from_boxes
    from carlasc.motion.evidence import HORIZON_S, FreeSpaceEvidence, Sighting, find_evidence
    from carlasc.motion.ground import ground_height, ground_points
    from carlasc.motion.movers import Movers, find_movers, follow_movers
    from carlasc.motion.options import MotionOptions, MotionSource, PoseOptions, PoseSource
    from carlasc.motion.segments import (
        Chain,
        Linker,
        Segment,
        Standing,
        is_fast,
        segment_by_flow,
        segment_by_instances,
        standing_points,
    )
    from carlasc.motion.tracks import BODY_MARGIN_M, LONGEST_M, Track, complete_bodies, link_segments, make_track
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "bodies": ("Extent", "seen_from", "usual_shell"),
            "boxes": ("segment_by_boxes", "tracks_from_boxes"),
            "evidence": ("HORIZON_S", "FreeSpaceEvidence", "Sighting", "find_evidence"),
            "ground": ("ground_height", "ground_points"),
            "movers": ("Movers", "find_movers", "follow_movers"),
            "options": ("MotionOptions", "MotionSource", "PoseOptions", "PoseSource"),
            "segments": (
                "Chain",
                "Linker",
                "Segment",
                "Standing",
                "is_fast",
                "segment_by_flow",
                "segment_by_instances",
                "standing_points",
            ),
            "tracks": ("BODY_MARGIN_M", "LONGEST_M", "Track", "complete_bodies", "link_segments", "make_track"),
        },
    )

__all__ = [
    "BODY_MARGIN_M",
    "HORIZON_S",
    "LONGEST_M",
    "Chain",
    "Extent",
    "FreeSpaceEvidence",
    "Linker",
    "MotionOptions",
    "MotionSource",
    "Movers",
    "PoseOptions",
    "PoseSource",
    "Segment",
    "Sighting",
    "Standing",
    "Track",
    "complete_bodies",
    "find_evidence",
    "find_movers",
    "follow_movers",
    "ground_height",
    "ground_points",
    "is_fast",
    "link_segments",
    "make_track",
    "seen_from",
    "segment_by_boxes",
    "segment_by_flow",
    "segment_by_instances",
    "standing_points",
    "tracks_from_boxes",
    "usual_shell",
]
