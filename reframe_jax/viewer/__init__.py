"""Show a body, its path and the constraint frame over time in a browser; needs the extra ``viewer``."""

from reframe_jax.viewer.page import Page, write_page
from reframe_jax.viewer.tracks import FrameTrack, WindowTrack, track_window

__all__ = ["FrameTrack", "Page", "WindowTrack", "track_window", "write_page"]
