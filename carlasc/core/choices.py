"""The words that options of the library and of its commands may have. Loads nothing, so that the help of a command need not wait."""

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
"""What happens to moving points where scans are merged."""

Complete = Literal["seen", "mirror", "body"]
"""What happens to the parts of an actor that no scan saw."""

Rays = Literal["all", "enough"]
"""Which rays are followed where scans are merged."""

TrafficLevel = Literal["light", "medium", "heavy"]
"""Amount of simulated traffic."""

SplitName = Literal["train", "val", "test", "all"]
"""Which sequences of a data set are converted."""

FlowSource = Literal["auto", "none"]
"""Whether converted sequences get scene flow."""

Voxels = Literal["known", "all"]
"""Which voxels are scored."""

Around = Literal["present", "future"]
"""Whose sensor the grids of forecasts are around: that of the frame that they are made in, or that of the frame that they predict."""

Images = Literal["none", "link", "copy"]
"""What a conversion does with the images of cameras."""

ViewName = Literal["perspective", "bev", "both"]
"""Where the pictures of a scene are taken from."""

StyleName = Literal["screen", "paper"]
"""What a picture is made for."""

PaletteName = Literal["class", "colorblind", "height"]
"""The colours of classes, or colours by height."""

GridColor = Literal["class", "confidence", "views", "votes", "inferred", "actor", "seen"]
"""What the colours of a grid mean: its classes, one of the kinds of evidence (see `docs/format.md#evidence`), or who is in it."""
