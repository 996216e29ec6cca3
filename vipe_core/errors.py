"""Every failure of the engine, with a stable code.

    VipeError
    ├── InputError            the video (or image directory) is the cause
    │   ├── MediaNotFound         media_not_found
    │   ├── EmptyMedia            media_empty
    │   ├── CorruptMedia          media_corrupt
    │   ├── NoVideoStream         no_video_stream
    │   ├── UnsupportedMedia      media_unsupported
    │   ├── MediaTooLarge         media_too_large
    │   ├── MaskMismatch          mask_mismatch       given masks do not belong to the pictures
    │   ├── CalibrationMismatch   calibration_mismatch  the given calibration is not of the pictures
    │   ├── ViewsNotSynchronised  views_not_synchronised  the videos of a rig do not show the same instants
    │   └── ScaleUnobservable     scale_unobservable  the known length cannot be found in the video
    ├── DecodeError           the decoder child is the cause
    │   ├── DecodeTimeout         decode_timeout      (retryable)
    │   └── DecodeCrashed         decode_crashed      (retryable)
    ├── OutOfDeviceMemory     device_memory       the GPU has too little memory for the video (retryable)
    ├── ConfigError           invalid_config          a preset, camera or device that does not exist
    │   ├── LibraryMissing        library_missing     a preset needs a library that is not installed
    │   ├── WeightsMissing        weights_missing     a preset's network weights are not on this machine
    │   └── WeightsInvalid        weights_invalid     a file of weights is not what it should be
    ├── FormatError           format_error            an artifact on disk does not hold what it must
    │   └── ExportUnsupported     export_unsupported  a format cannot hold this sequence
    └── EngineError           engine_failed           a stage could not finish; always a defect of ours

Codes are part of the public interface: they are stored in databases and
parquet files and never change their meaning. The message names the input and
says what to do; it never holds more than one line of another library's text.
"""

from __future__ import annotations

from typing import ClassVar


class VipeError(Exception):
    """Base of every error that the engine raises on purpose.

    Attributes:
        code: Stable machine-readable code.
        retryable: Whether the same input can succeed on another attempt.
    """

    code: ClassVar[str] = "vipe_error"
    retryable: ClassVar[bool] = False

    @property
    def message(self) -> str:
        return str(self)


class InputError(VipeError):
    """The input itself is the cause; another attempt gives the same error."""

    code = "input_error"


class MediaNotFound(InputError):
    code = "media_not_found"


class EmptyMedia(InputError):
    """A zero-byte file, an empty directory, or a stream that holds no frame."""

    code = "media_empty"


class CorruptMedia(InputError):
    """Not a media container at all, or one whose contents cannot be decoded."""

    code = "media_corrupt"


class NoVideoStream(InputError):
    """A media file without pictures, such as an audio file."""

    code = "no_video_stream"


class UnsupportedMedia(InputError):
    """A container, codec or pixel format outside of what the engine opens."""

    code = "media_unsupported"


class MediaTooLarge(InputError):
    """More pixels or frames than the configured limits allow."""

    code = "media_too_large"


class MaskMismatch(InputError):
    """Masks were given that are not one per picture, or not of the pictures' size."""

    code = "mask_mismatch"


class CalibrationMismatch(InputError):
    """A calibration was given that cannot be of pictures of this size."""

    code = "calibration_mismatch"


class ViewsNotSynchronised(InputError):
    """Videos of a rig that differ in length, in rate, or in the times of their frames."""

    code = "views_not_synchronised"


class ScaleUnobservable(InputError):
    """A length was given to take the scale from, but the video does not show it: no ground, no motion, no pixel."""

    code = "scale_unobservable"


class DecodeError(VipeError):
    code = "decode_error"
    retryable = True


class DecodeTimeout(DecodeError):
    """The decoder made no progress within its wall-clock budget and was killed."""

    code = "decode_timeout"


class DecodeCrashed(DecodeError):
    """The decoder process died (a signal, or out of memory)."""

    code = "decode_crashed"


class OutOfDeviceMemory(VipeError):
    """The GPU has, or the video may take, too little memory for it; with more of it, or the low-memory profile, the
    same video can succeed.

    Attributes:
        needed_bytes: What the video takes by plan, where that alone was refused; None where memory ran out in the work,
            whose process had better end.
    """

    code = "device_memory"
    retryable = True

    def __init__(self, message: str, needed_bytes: int | None = None) -> None:
        super().__init__(message)
        self.needed_bytes = needed_bytes


class ConfigError(VipeError):
    code = "invalid_config"


class LibraryMissing(ConfigError):
    """A preset needs a library that is an extra and not installed; the message names the command that installs it."""

    code = "library_missing"


class WeightsMissing(ConfigError):
    """The network weights that a preset needs are not on this machine; the message names the command that gets them."""

    code = "weights_missing"


class WeightsInvalid(ConfigError):
    """A file of weights is damaged, has another checksum, or holds other tensors than the network has."""

    code = "weights_invalid"


class FormatError(VipeError):
    code = "format_error"


class ExportUnsupported(FormatError):
    """The format that was asked for cannot say what the sequence holds, such as its camera model."""

    code = "export_unsupported"


class EngineError(VipeError):
    code = "engine_failed"
