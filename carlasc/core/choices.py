"""The allowed values of options of the library and of its commands.

Imports nothing heavy, so that the help of commands is fast.
"""

from typing import Literal

Axes = Literal["left", "right"]
"""Handedness of the axes of data."""

Coordinates = Literal["cartesian", "cylindrical"]
"""Axes of a grid."""

Preset = Literal["coarse", "fine", "cylindrical"]
"""The grids of the published data set."""

VoteRule = Literal["sensor", "sample", "ray"]
"""How votes are counted."""

Dynamic = Literal["align", "current", "drop", "tube"]
"""Treatment of moving points when scans are merged."""

Complete = Literal["seen", "mirror", "body"]
"""Treatment of the parts of an actor that no scan saw."""

PoseSource = Literal["auto", "file", "kiss-icp"]
"""Where the poses of scans come from."""

RefineMode = Literal["auto", "always", "never"]
"""When poses are refined."""

LoopMode = Literal["auto", "never"]
"""Whether places that are met again join the poses of a drive."""

MotionSource = Literal["auto", "boxes", "instances", "flow", "evidence", "none"]
"""How moving points are found."""

CompareInputs = Literal["fast", "content", "never"]
"""How the inputs of existing outputs are compared with those of now: by size and time and then by
content where these differ, by content, or not at all.
"""

TrafficLevel = Literal["light", "medium", "heavy"]
"""Amount of simulated traffic."""

LidarName = Literal["carlasc", "hdl-64e", "vlp-16", "os1-128", "pandar64", "mid-360"]
"""Models of simulated LiDARs."""

SplitName = Literal["train", "val", "test", "all"]
"""Which sequences of a data set are converted."""

FlowSource = Literal["auto", "none"]
"""Whether converted sequences get scene flow."""

Voxels = Literal["known", "all"]
"""Which voxels are scored."""

Around = Literal["present", "future"]
"""The sensor pose around which forecast grids are centred: of the frame in which they are made, or
of the frame that they predict.
"""

Images = Literal["none", "link", "copy"]
"""Treatment of camera images in a conversion."""

ViewName = Literal["perspective", "bev", "both"]
"""Viewpoint of the pictures of a scene."""

StyleName = Literal["screen", "paper"]
"""Purpose of a picture."""

PaletteName = Literal["class", "colorblind", "height"]
"""The colours of classes, or colours by height."""

GridColor = Literal["class", "confidence", "views", "votes", "inferred", "actor", "seen"]
"""Meaning of the colours of a grid: its classes, one kind of evidence (see
`docs/format.md#evidence`), or its actors.
"""
