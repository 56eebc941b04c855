"""Looking at sequences: a page that any browser opens, and a window on the desktop."""

from carlasc.viewing.clip import Clip, FrameContent, PanelSpec, open_clip
from carlasc.viewing.page import PageResult, make_page

__all__ = ["Clip", "FrameContent", "PageResult", "PanelSpec", "make_page", "open_clip"]
