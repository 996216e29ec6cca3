"""What a clip may be before it is refused: guards against decompression bombs, not a quality choice."""

from __future__ import annotations

from dataclasses import dataclass

from vipe_core.errors import MediaTooLarge


@dataclass(frozen=True, slots=True)
class Limits:
    """Upper bounds on one clip.

    Attributes:
        max_pixels: Pixels of one picture (the default admits 8K twice over).
        max_dimension_px: Longest side of one picture.
        max_frames: Frames of the clip, checked on the container's figure first and on the decoded count again.
        max_duration_s: Duration as the container states it.
    """

    max_pixels: int = 1 << 26
    max_dimension_px: int = 16_384
    max_frames: int = 1_000_000
    max_duration_s: float = 12 * 3600.0

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
                f"{label}: {duration_s:.0f} s exceed the limit of {self.max_duration_s:.0f} s; cut the video into parts"
            )
