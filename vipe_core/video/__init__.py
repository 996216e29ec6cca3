"""Reading and writing video: probe, decode in a killable child, and sources with bounded memory.

Kept free of heavy imports (torch, OpenCV, PyAV): the decoder child imports this package at every start.
"""

from vipe_core.video.image_directory import ImageDirectorySource
from vipe_core.video.limits import Limits
from vipe_core.video.masks import MaskedView
from vipe_core.video.naming import sanitise_name
from vipe_core.video.opening import open_source
from vipe_core.video.probe import probe
from vipe_core.video.source import Frame, FrameSource, FrameStream, VideoInfo
from vipe_core.video.video_file import VideoFileSource

__all__ = [
    "Frame",
    "FrameSource",
    "FrameStream",
    "ImageDirectorySource",
    "Limits",
    "MaskedView",
    "VideoFileSource",
    "VideoInfo",
    "open_source",
    "probe",
    "sanitise_name",
]
