"""Decoding with FFmpeg (PyAV), as it runs inside of the decoder child: open safely, describe, decode, convert.

Nothing in a media file may make FFmpeg open a second file or a URL: the file is open already and read through Python,
no protocol at all is allowed, and only self-contained containers are: a playlist is refused instead of followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from vipe_core.errors import CorruptMedia, EmptyMedia, InputError, MediaTooLarge, NoVideoStream, UnsupportedMedia
from vipe_core.video.limits import Limits
from vipe_core.video.opened import OpenedMedia

# Self-contained containers. The audio ones are here so that an audio file is named as such.
_FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,flv,ogg,asf,gif,ivf,h264,hevc,nut,"
    "wav,mp3,aac,flac,aiff"
)
_OPTIONS = {"protocol_whitelist": "none", "format_whitelist": _FORMATS}
_READ_BYTES = 1 << 18

_PLAYLIST_HEADS = (
    b"#extm3u",
    b"ffconcat",
    b"<?xml",
    b"<mpd",
    b"<smoothstreamingmedia",
    b"[playlist]",
    b"v=0",
    b"[reference]",
)
_IMAGE_HEADS = (b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*", b"8BPS", b"\0\0\x01\0")

# swscale's default conversion truncates (1 to 2 grey levels too dark) and repeats chroma instead of interpolating it.
_EXACT = Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT

DEFAULT_FPS = 30.0
# Anamorphic lenses and old tapes stay below 2.4; beyond this it is a slip.
_MAX_PIXEL_ASPECT = 4.0
# A step back by more than this is a new clock (a spliced transport stream), not a jittering one.
_CLOCK_RESET_S = 1.0


@dataclass(frozen=True, slots=True)
class Description:
    """What one opened and once decoded stream says about itself; sizes are upright."""

    width: int
    height: int
    fps: float
    num_frames_hint: int | None
    duration_s: float | None
    rotation_deg: int
    codec: str
    pixel_format: str
    spherical: bool
    pixel_aspect: float


@dataclass(slots=True)
class Damage:
    """Defects met on the way; each one cost pictures but not the clip."""

    bad_packets: int = 0
    bad_pictures: int = 0
    cut_short: bool = False

    def sentence(self) -> str | None:
        parts = []
        if self.cut_short:
            parts.append("the file ends before its index says")
        if self.bad_packets:
            parts.append(f"{self.bad_packets} packets could not be decoded")
        if self.bad_pictures:
            parts.append(f"{self.bad_pictures} damaged pictures were dropped")
        return "; ".join(parts) or None


def open_video(media: OpenedMedia, limits: Limits) -> tuple[InputContainer, VideoStream]:
    """Open the container and choose its video stream (the largest that is not a cover picture).

    Raises:
        EmptyMedia, CorruptMedia, NoVideoStream, UnsupportedMedia, MediaTooLarge: Typed, naming the file.
    """
    label = media.label
    media.file.seek(0)
    options = {**_OPTIONS, "max_streams": str(limits.max_streams)}
    try:
        # The file's name goes along: its suffix decides between containers that look alike.
        container = av.open(media.file, mode="r", options=options, metadata_errors="ignore", buffer_size=_READ_BYTES)
    except (MemoryError, av.error.MemoryError) as error:
        raise limits.out_of_memory(label) from error
    except av.error.FFmpegError as error:
        raise _open_error(media, error) from error
    if len(container.streams) >= limits.max_streams:
        container.close()
        raise MediaTooLarge(f"{label}: the file holds {limits.max_streams} streams or more; keep only the video")
    pictures = [stream for stream in container.streams.video if not _is_cover(stream)]
    # A stream of a codec that is not known here has no decoder, whatever its type says.
    streams = [stream for stream in pictures if _has_decoder(stream)]
    if pictures and not streams:
        container.close()
        raise UnsupportedMedia(f"{label}: the codec of the video stream is not known here; re-encode it as h264")
    if not streams:
        name = container.format.name
        known = any(stream.type in ("audio", "subtitle") for stream in container.streams)
        container.close()
        if not known:
            # An index that is cut short leaves streams of no kind.
            raise CorruptMedia(f"{label}: the file holds nothing that is known; check that the upload is complete")
        if name in ("mp3", "aac") and not _starts_like_mpeg_audio(media):
            # Probing by content takes arbitrary bytes for MPEG audio now and then.
            raise CorruptMedia(f"{label}: not a media file; check that the upload is complete")
        raise NoVideoStream(f"{label}: the file holds no video stream; provide a file with pictures")
    stream = max(streams, key=lambda s: (s.codec_context.width * s.codec_context.height, -s.index))
    return container, stream


def describe(media: OpenedMedia, limits: Limits) -> Description:
    """Open, decode the first picture and report. Frame count and duration are the container's claims.

    Raises:
        InputError: Typed, naming the file.
    """
    label = media.label
    container, stream = open_video(media, limits)
    with container:
        limits.check_picture(label, stream.codec_context.width, stream.codec_context.height)
        duration_s = _duration_s(container, stream)
        limits.check_length(label, stream.frames or None, duration_s)
        limits.check_decoded(label, stream.frames, stream.codec_context.width, stream.codec_context.height)
        first = next(_pictures(container, stream, label, limits, 1, Damage()), None)
        if first is None:
            raise _no_picture(label, stream)
        converter = PictureConverter(label, None, limits)
        width, height = converter.upright_size(first)
        return Description(
            width=width,
            height=height,
            fps=_fps(stream),
            num_frames_hint=stream.frames or None,
            duration_s=duration_s,
            rotation_deg=converter.rotation_deg(first),
            codec=stream.codec_context.name,
            pixel_format=first.format.name,
            spherical=_is_spherical(first),
            pixel_aspect=_pixel_aspect(stream, converter.rotation_deg(first)),
        )


def decode(
    media: OpenedMedia,
    limits: Limits,
    threads: int,
    damage: Damage,
    on_progress: Callable[[], None],
) -> Iterator[tuple[int, float, VideoFrame]]:
    """Every picture in presentation order as (index, timestamp_s, frame), indices 0, 1, 2 ...

    Pictures that the decoder itself marks as damaged are dropped and counted in `damage`; a clip that is cut short ends
    early. `on_progress` is called for each packet.

    Raises:
        InputError: Typed, naming the file; CorruptMedia or EmptyMedia when there is no picture at all.
    """
    label = media.label
    container, stream = open_video(media, limits)
    with container:
        limits.check_picture(label, stream.codec_context.width, stream.codec_context.height)
        clock = Clock(1.0 / _fps(stream))
        index = -1
        begin_s: float | None = None
        for index, frame in enumerate(_pictures(container, stream, label, limits, threads, damage, on_progress)):
            timestamp_s = clock.repaired(_timestamp_s(frame))
            begin_s = timestamp_s if begin_s is None else begin_s
            limits.check_length(label, index + 1, timestamp_s - begin_s)
            limits.check_decoded(label, index + 1, frame.width, frame.height)
            yield index, timestamp_s, frame
        if index < 0:
            raise _no_picture(label, stream)


@dataclass(slots=True)
class Clock:
    """Makes timestamps strictly increasing and complete, the same way every time.

    Real timestamps pass unchanged. A missing one is one period after its predecessor; one that repeats or steps back a
    little lies half a period after its predecessor, so that the next good one still follows; a large step back is a
    new clock, and everything after it is shifted to continue one period later.

    Attributes:
        period_s: Nominal time between frames.
    """

    period_s: float
    _last_s: float = field(default=-math.inf)
    _shift_s: float = 0.0

    def repaired(self, raw_s: float | None) -> float:
        first = math.isinf(self._last_s)
        if raw_s is None or not math.isfinite(raw_s):
            value = 0.0 if first else self._last_s + self.period_s
        else:
            value = raw_s + self._shift_s
            if not first and value <= self._last_s - _CLOCK_RESET_S:
                self._shift_s = self._last_s + self.period_s - raw_s
                value = raw_s + self._shift_s
            if not first and value <= self._last_s:
                value = self._last_s + self.period_s / 2
        self._last_s = value
        return value


class PictureConverter:
    """Decoded frames of one clip -> upright (H, W, 3) uint8 RGB at one size.

    Resizing is swscale's area filter when the picture shrinks (bilinear when it grows), done before the conversion to
    RGB, so that the full-size RGB picture never exists.

    Args:
        label: Name of the input, for messages.
        size: (width, height) of the upright result, or None for the picture's own size.
    """

    def __init__(self, label: str, size: tuple[int, int] | None, limits: Limits) -> None:
        self._label = label
        self._size = size
        self._limits = limits
        self._coded_size: tuple[int, int] | None = None
        self._reformatter = VideoReformatter()

    @staticmethod
    def rotation_deg(frame: VideoFrame) -> int:
        """Clockwise turn that makes the picture upright: 0, 90, 180 or 270 (other angles are rounded)."""
        return round(-frame.rotation / 90) % 4 * 90

    def upright_size(self, frame: VideoFrame) -> tuple[int, int]:
        if self.rotation_deg(frame) % 180:
            return frame.height, frame.width
        return frame.width, frame.height

    def convert(self, frame: VideoFrame) -> NDArray[np.uint8]:
        """Raises:
        UnsupportedMedia: The picture size changes within the clip, or the pixel format has no conversion.
        """
        if self._coded_size is None:
            self._limits.check_picture(self._label, frame.width, frame.height)
            self._coded_size = (frame.width, frame.height)
        elif self._coded_size != (frame.width, frame.height):
            old, new = self._coded_size, (frame.width, frame.height)
            raise UnsupportedMedia(
                f"{self._label}: the picture size changes from {old[0]}x{old[1]} to {new[0]}x{new[1]} within the clip; "
                "split it there"
            )
        turns = self.rotation_deg(frame) // 90
        width, height = self._size or self.upright_size(frame)
        if turns % 2:
            width, height = height, width
        shrinks = width < frame.width or height < frame.height
        try:
            rgb = self._reformatter.reformat(
                frame,
                width,
                height,
                "rgb24",
                src_colorspace=_matrix(frame),
                dst_colorspace=_matrix(frame),
                interpolation=int((Interpolation.AREA if shrinks else Interpolation.BILINEAR) | _EXACT),
                src_color_range=_source_range(frame),
                dst_color_range=ColorRange.JPEG,
                threads=1,
            )
        except (av.error.FFmpegError, ValueError) as error:
            raise UnsupportedMedia(
                f"{self._label}: pixels of format {frame.format.name} cannot be converted to RGB; re-encode the video"
            ) from error
        return np.ascontiguousarray(np.rot90(rgb.to_ndarray(), -turns), dtype=np.uint8)


def _matrix(frame: VideoFrame) -> int:
    """YCbCr matrix: the one that is stated, else the convention of players (BT.709 from 720 lines on, else BT.601)."""
    stated = int(frame.colorspace)
    known = {
        1: Colorspace.ITU709,
        4: Colorspace.FCC,
        5: Colorspace.ITU601,
        6: Colorspace.SMPTE170M,
        7: Colorspace.SMPTE240M,
        9: Colorspace.BT2020,
        10: Colorspace.BT2020,
    }
    if stated in known:
        return int(known[stated])
    return int(Colorspace.ITU709 if min(frame.width, frame.height) >= 720 else Colorspace.ITU601)


def _source_range(frame: VideoFrame) -> int:
    if frame.color_range in (ColorRange.MPEG, ColorRange.JPEG):
        return int(frame.color_range)
    full = frame.format.name.startswith("yuvj") or frame.format.is_rgb
    return int(ColorRange.JPEG if full else ColorRange.MPEG)


def _pictures(
    container: InputContainer,
    stream: VideoStream,
    label: str,
    limits: Limits,
    threads: int,
    damage: Damage,
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[VideoFrame]:
    context = stream.codec_context
    context.thread_count = threads
    context.thread_type = "AUTO" if threads > 1 else "NONE"
    context.options = {"max_pixels": str(limits.max_pixels)}
    packets = container.demux(stream)
    without_picture = 0
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (MemoryError, av.error.MemoryError) as error:
            raise limits.out_of_memory(label) from error
        except av.error.FFmpegError:
            damage.cut_short = True
            packet = None
        on_progress()
        without_picture += 1
        if without_picture > limits.max_frames:
            raise CorruptMedia(f"{label}: {limits.max_frames} packets in a row hold no picture; re-encode the video")
        try:
            frames = context.decode(packet)
        except (MemoryError, av.error.MemoryError) as error:
            raise limits.out_of_memory(label) from error
        except (av.error.DecoderNotFoundError, av.error.PatchWelcomeError) as error:
            raise UnsupportedMedia(f"{label}: codec {context.name} cannot be decoded here; re-encode it") from error
        except (av.error.FFmpegError, ValueError):
            damage.bad_packets += 1
            frames = []
        if packet is not None and packet.is_corrupt:
            damage.cut_short = True
        for frame in frames:
            without_picture = 0
            if frame.is_corrupt:
                damage.bad_pictures += 1
            else:
                yield frame
        if packet is None:
            return


def _timestamp_s(frame: VideoFrame) -> float | None:
    if frame.pts is None or frame.time_base is None:
        return None
    return float(frame.pts * frame.time_base)


def _is_spherical(frame: VideoFrame) -> bool:
    """Whether the container says that the picture is a whole equirectangular panorama (spherical video metadata)."""
    # The first field of FFmpeg's description is the projection, of which 0 is this one.
    found: Any = frame.side_data.get("SPHERICAL")
    return found is not None and bytes(found)[:4] == bytes(4)


def _is_cover(stream: VideoStream) -> bool:
    disposition: Any = stream.disposition
    return bool(disposition & type(disposition).attached_pic)


def _has_decoder(stream: VideoStream) -> bool:
    context: Any = stream.codec_context
    return context is not None


def _fps(stream: VideoStream) -> float:
    for rate in (stream.average_rate, stream.guessed_rate, stream.base_rate):
        if rate is not None and 0 < rate <= 1000:
            return float(rate)
    return DEFAULT_FPS


def _pixel_aspect(stream: VideoStream, rotation_deg: int) -> float:
    """Width over height of a pixel of the upright picture; 1 where nothing sensible is stated."""
    stated = stream.sample_aspect_ratio
    aspect = 1.0 if stated is None or stated <= 0 else float(stated)
    if not 1 / _MAX_PIXEL_ASPECT <= aspect <= _MAX_PIXEL_ASPECT:
        return 1.0
    return 1 / aspect if rotation_deg % 180 else aspect


def _duration_s(container: InputContainer, stream: VideoStream) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return None if container.duration is None else container.duration / 1e6


def _no_picture(label: str, stream: VideoStream) -> InputError:
    if stream.frames == 0 and not stream.duration:
        return EmptyMedia(f"{label}: the video stream holds no picture; check the recording")
    return CorruptMedia(
        f"{label}: not one picture of the video stream can be decoded; check that the upload is complete"
    )


def _head(media: OpenedMedia, count: int = 4096) -> bytes:
    media.file.seek(0)
    return media.file.read(count)


def _starts_like_mpeg_audio(media: OpenedMedia) -> bool:
    head = _head(media, 4)
    return head[:3] == b"ID3" or (len(head) > 1 and head[0] == 0xFF and head[1] >= 0xE0)


def _open_error(media: OpenedMedia, error: av.error.FFmpegError) -> InputError:
    head, label = _head(media), media.label
    if head.lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_PLAYLIST_HEADS):
        return UnsupportedMedia(f"{label}: playlists and manifests are not followed; provide the media file itself")
    if head.startswith(_IMAGE_HEADS) or (head[:4] == b"RIFF" and head[8:12] == b"WEBP"):
        return UnsupportedMedia(f"{label}: a single image is not a video; provide a directory of images")
    if isinstance(error, (av.error.ProtocolNotFoundError, av.error.DemuxerNotFoundError, av.error.PatchWelcomeError)):
        return UnsupportedMedia(f"{label}: this kind of container is not supported; re-encode it as mp4")
    return CorruptMedia(f"{label}: not a readable media file; check that the upload is complete")
