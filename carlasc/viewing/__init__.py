"""Looking at sequences: a page that any browser opens, and a window on the desktop."""

from carlasc.viewing.clip import Clip, FrameContent, PanelSpec, open_clip
from carlasc.viewing.page import PageResult, make_page
from carlasc.viewing.window import Window, show

__all__ = ["Clip", "FrameContent", "PageResult", "PanelSpec", "Window", "make_page", "open_clip", "show"]
