"""What a clip may be before it is refused: guards against decompression bombs, not a quality choice."""

from __future__ import annotations

from dataclasses import dataclass, fields

from vipe_core.errors import ConfigError, MediaTooLarge


@dataclass(frozen=True, slots=True)
class Limits:
    """Upper bounds on one clip.

    Attributes:
        max_pixels: Pixels of one picture (the default admits 8K twice over).
        max_dimension_px: Longest side of one picture.
        max_frames: Frames of the clip, checked on the container's figure first and on the decoded count again.
        max_duration_s: Duration as the container states it, and from the first to the last decoded frame.
        max_decoded_bytes: RGB bytes of all frames together (the default is three hours of 4K at 60 frames a second).
        max_file_bytes: Size of the file, or of one image.
        max_streams: Streams of the container, whatever they hold.
        max_memory_bytes: What decoding may take, the index of the file included (on Linux).
    """

    max_pixels: int = 1 << 26
    max_dimension_px: int = 16_384
    max_frames: int = 1_000_000
    max_duration_s: float = 12 * 3600.0
    max_decoded_bytes: int = 1 << 44
    max_file_bytes: int = 1 << 38
    max_streams: int = 64
    max_memory_bytes: int = 1 << 32

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ConfigError(f"the limit {field.name} must be positive, got {getattr(self, field.name)}")

    def check_picture(self, label: str, width: int, height: int) -> None:
        """Raises:
        MediaTooLarge: The picture has more pixels, or a longer side, than allowed.
        """
        if width * height > self.max_pixels or max(width, height) > self.max_dimension_px:
            raise MediaTooLarge(
                f"{label}: a picture of {width}x{height} exceeds the limit of {self.max_pixels} pixels "
                f"and {self.max_dimension_px} pixels per side; scale the video down"
            )

    def check_length(self, label: str, num_frames: int | None, duration_s: float | None) -> None:
        """Raises:
        MediaTooLarge: More frames or seconds than allowed. None means unknown and passes.
        """
        if num_frames is not None and num_frames > self.max_frames:
            raise MediaTooLarge(
                f"{label}: {num_frames} frames exceed the limit of {self.max_frames}; cut the video into parts"
            )
        if duration_s is not None and duration_s > self.max_duration_s:
            raise MediaTooLarge(
                f"{label}: {duration_s:.12g} s exceed the limit of {self.max_duration_s:.12g} s; "
                "cut the video into parts"
            )

    def check_decoded(self, label: str, num_frames: int, width: int, height: int) -> None:
        """Raises:
        MediaTooLarge: So many pictures of this size are more bytes than allowed.
        """
        if 3 * num_frames * width * height > self.max_decoded_bytes:
            raise MediaTooLarge(
                f"{label}: {num_frames} frames of {width}x{height} exceed the limit of {self.max_decoded_bytes} "
                "decoded bytes; cut the video into parts or scale it down"
            )

    def check_file(self, label: str, size_bytes: int) -> None:
        """Raises:
        MediaTooLarge: The file has more bytes than allowed.
        """
        if size_bytes > self.max_file_bytes:
            raise MediaTooLarge(
                f"{label}: {size_bytes} bytes exceed the limit of {self.max_file_bytes}; cut the video into parts"
            )

    def out_of_memory(self, label: str) -> MediaTooLarge:
        """The error of a file whose decoder asked for more memory than it may have."""
        return MediaTooLarge(
            f"{label}: decoding needs more than the {self.max_memory_bytes} bytes of memory that are allowed; "
            "re-encode the video, or scale it down"
        )


_default = Limits()


def use_limits(limits: Limits) -> None:
    """Make these the bounds of everything in this process that names none of its own."""
    global _default
    _default = limits


def default_limits() -> Limits:
    return _default
