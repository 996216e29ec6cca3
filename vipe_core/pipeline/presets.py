"""The presets on offer: which family provides each role, and the settings that go with it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field

from vipe_core.depth.alignment import AlignmentSettings
from vipe_core.depth.types import DepthSettings
from vipe_core.errors import ConfigError
from vipe_core.slam.settings import SlamSettings

CAMERAS = ("pinhole", "mei", "auto")


@dataclass(frozen=True, slots=True)
class Preset:
    """Everything that determines a result besides the input and the device.

    Attributes:
        name: Name that users choose it by.
        camera: Camera model that is estimated; `auto` for what the video says.
        matcher: Provider of dense matching.
        sparse: Provider of sparse tracks.
        intrinsics: Provider of the initial camera.
        depth: Providers of dense depth, a name of `providers.py`.
        slam: Settings of the SLAM stage.
        dense_depth: Settings of the depth stage where depth is multi-view stereo.
        alignment: Settings of the depth stage where the depth providers have video depth.
    """

    name: str
    camera: str
    matcher: str
    sparse: str
    intrinsics: str
    depth: str
    slam: SlamSettings = field(default_factory=SlamSettings)
    dense_depth: DepthSettings = field(default_factory=DepthSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)

    def canonical_json(self) -> str:
        """All fields, keys sorted, no white space: equal presets give equal text."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True, separators=(",", ":"))

    @property
    def config_hash(self) -> str:
        """First 16 hex digits of the SHA-256 of `canonical_json`."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()[:16]

    @property
    def providers(self) -> dict[str, str]:
        """Role -> provider."""
        return {
            "dense_matching": self.matcher,
            "sparse_tracks": self.sparse,
            "intrinsics_init": self.intrinsics,
            "dense_depth": self.depth,
        }


_CLASSICAL = Preset(
    name="classical",
    camera="pinhole",
    matcher="classical.dis_flow",
    sparse="classical.lucas_kanade",
    intrinsics="classical.two_view_focal",
    depth="classical.plane_sweep",
)
_PRESETS = {
    preset.name: preset
    for preset in (
        _CLASSICAL,
        dataclasses.replace(_CLASSICAL, name="classical_fast", dense_depth=DepthSettings.fast()),
        dataclasses.replace(_CLASSICAL, name="wide_angle", camera="mei"),
    )
}
_INTRINSICS = {
    "pinhole": "classical.two_view_focal",
    "mei": "classical.unified_sweep",
    "auto": "classical.unified_sweep",
}

PRESETS = tuple(_PRESETS)
"""Names, the default first. `classical_fast` has the same poses and map, and coarser dense depth for less time;
`wide_angle` estimates the bend of the lens as well."""


def resolve(preset: str | Preset, camera: str | None = None) -> Preset:
    """The preset of that name, for that camera model or its own.

    Raises:
        ConfigError: It is not on offer; the message lists what is.
    """
    if isinstance(preset, Preset):
        found = preset
    elif preset in _PRESETS:
        found = _PRESETS[preset]
    else:
        raise ConfigError(f"unknown preset {preset!r}; on offer: {', '.join(PRESETS)}")
    camera = found.camera if camera is None else camera
    if camera not in CAMERAS:
        raise ConfigError(f"camera model {camera!r} is not on offer for annotation; on offer: {', '.join(CAMERAS)}")
    return dataclasses.replace(found, camera=camera, intrinsics=_INTRINSICS[camera])
