"""What a job may ask for, from the engine's own lists: only what works is offered."""

from __future__ import annotations

import re
from functools import cache
from typing import Any, Literal, get_args

from services.domain.errors import AddressRefused
from services.domain.redaction import redact
from services.network.addresses import NetworkPolicy

# What the engine writes for every video.
OfferedAttribute = Literal["pose", "intrinsics", "depth", "rgb", "mask", "confidence"]
ATTRIBUTES: tuple[OfferedAttribute, ...] = get_args(OfferedAttribute)

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_UNWELCOME = re.compile(r"[\x00-\x1f\x7f\\]")


@cache
def presets() -> tuple[str, ...]:
    from vipe_core.pipeline.presets import PRESETS

    return PRESETS


@cache
def cameras() -> tuple[str, ...]:
    from vipe_core.pipeline.presets import CAMERAS

    return CAMERAS


@cache
def metric_depths() -> tuple[str, ...]:
    from vipe_core.pipeline.presets import METRIC_DEPTH

    return METRIC_DEPTH


@cache
def tracks() -> tuple[str, ...]:
    from vipe_core.pipeline.presets import TRACKS

    return TRACKS


def camera_of(preset: str) -> str:
    """The camera model that a preset takes where a job names none."""
    from vipe_core.pipeline.presets import resolve

    return resolve(preset).camera


def makes_depth(preset: str) -> bool:
    """Whether there is any depth in what a preset makes."""
    from vipe_core.pipeline.presets import resolve

    return resolve(preset).makes_depth


def one_of(value: str, offered: tuple[str, ...]) -> str:
    if value not in offered:
        raise ValueError(f"{value!r} is not on offer; on offer: {', '.join(offered)}")
    return value


def preset_options(preset: str, camera: str | None, options: dict[str, Any]) -> None:
    """Check what a job changes of a preset: its camera model, and what `JobSpec.preset_options` has.

    Raises:
        ValueError: The engine does not take it.
    """
    from vipe_core.errors import ConfigError
    from vipe_core.pipeline.presets import PresetOptions, resolve

    try:
        resolve(preset, camera, PresetOptions(**options))
    except ConfigError as error:
        raise ValueError(str(error)) from error


def known_length(value: str) -> str:
    """Check a known length as the engine takes it.

    Raises:
        ValueError: It is not understood.
    """
    from vipe_core.depth.known import KnownLength
    from vipe_core.errors import ConfigError

    try:
        return str(KnownLength.parse(value))
    except ConfigError as error:
        raise ValueError(str(error)) from error


def calibration(value: dict[str, Any]) -> dict[str, Any]:
    """Check a calibration as the engine takes it.

    Returns:
        The same in one form, so that equal calibrations are equal configurations.

    Raises:
        ValueError: It is not understood.
    """
    from vipe_core.cameras.calibration import Calibration
    from vipe_core.errors import ConfigError

    try:
        return Calibration.from_json(value).to_json()
    except ConfigError as error:
        raise ValueError(str(error)) from error


def address(value: str) -> str:
    """Check an absolute path, `s3://bucket/key` or `http(s)://host/path`.

    Raises:
        ValueError: It is neither.
    """
    if _UNWELCOME.search(value) or not value.isprintable():
        raise ValueError("an address must not hold control characters or backslashes")
    if value.startswith("s3://"):
        bucket, _, key = value.removeprefix("s3://").partition("/")
        if not _BUCKET.fullmatch(bucket):
            raise ValueError(f"{bucket!r} is not the name of an S3 bucket")
        if "?" in key or "#" in key:
            raise ValueError("an S3 address must not hold '?' or '#'")
        segments = key.rstrip("/").split("/") if key.rstrip("/") else []
    elif value.startswith(("http://", "https://")):
        try:
            NetworkPolicy(("*:*",)).endpoint(value)
        except AddressRefused as error:
            raise ValueError(str(error)) from error
        if redact(value) != value:
            raise ValueError("an address must not hold credentials: it is kept in the database and in the output")
        segments = []
    elif value.startswith("/") and not value.startswith("//"):
        segments = [s for s in value.split("/") if s]
    else:
        raise ValueError(f"{value!r} must be an absolute path, s3://bucket/key or http(s)://host/path")
    if any(s in ("", ".", "..") for s in segments):
        raise ValueError("an address must not hold empty, '.' or '..' segments")
    return value
