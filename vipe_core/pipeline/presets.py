"""The presets on offer: which family provides each role, and the settings that go with it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field

from vipe_core.depth.alignment import AlignmentSettings
from vipe_core.depth.types import DepthSettings
from vipe_core.errors import ConfigError
from vipe_core.slam.settings import EnergyTerms, SlamSettings

CAMERAS = ("pinhole", "mei", "auto")
NO_DEPTH = "none"
"""What `Preset.depth` says where no dense depth is made."""

_NO_TRACKS = "none"
_PROVIDER_WEIGHTS: dict[str, tuple[str, ...]] = {"droid.network": ("droid",)}


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

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the weights that its providers need, of `vipe_core.priors.weights`."""
        return tuple(name for provider in self.providers.values() for name in _PROVIDER_WEIGHTS.get(provider, ()))

    @property
    def makes_depth(self) -> bool:
        """Whether its dense stream has any depth."""
        return self.depth != NO_DEPTH


_CLASSICAL = Preset(
    name="classical",
    camera="pinhole",
    matcher="classical.dis_flow",
    sparse="classical.lucas_kanade",
    intrinsics="classical.two_view_focal",
    depth="classical.plane_sweep",
)
# The network was trained on pictures of this size, and its edges know what moves: no tracks, no masks beside it.
_NETWORK = dataclasses.replace(
    _CLASSICAL,
    matcher="droid.network",
    sparse=_NO_TRACKS,
    slam=SlamSettings(working_area_px=512 * 384, terms=EnergyTerms(sparse_tracks=False)),
    dense_depth=DepthSettings.fast(),
)
_PRESETS = {
    preset.name: preset
    for preset in (
        _CLASSICAL,
        dataclasses.replace(_CLASSICAL, name="classical_fast", dense_depth=DepthSettings.fast()),
        dataclasses.replace(_CLASSICAL, name="wide_angle", camera="mei"),
        dataclasses.replace(_NETWORK, name="vipe_fast"),
        dataclasses.replace(_NETWORK, name="pose_only", depth=NO_DEPTH),
    )
}
_INTRINSICS = {
    "pinhole": "classical.two_view_focal",
    "mei": "classical.unified_sweep",
    "auto": "classical.unified_sweep",
}

PRESETS = tuple(_PRESETS)
"""Names, the default first. `classical_fast` has the same poses and map, and coarser dense depth for less time;
`wide_angle` estimates the bend of the lens as well. `vipe_fast` and `pose_only` find poses as the paper does, by the
DROID network and bundle adjustment in turns, and need its weights; the one has coarse dense depth, the other none."""


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
