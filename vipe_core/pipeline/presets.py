"""The presets on offer: which family provides each role, and the settings that go with it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field

from vipe_core.depth.alignment import AlignmentSettings
from vipe_core.depth.types import DepthSettings
from vipe_core.errors import ConfigError
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.slam.settings import SlamSettings

CAMERAS = ("pinhole", "mei", "auto", "equirect")
NONE = "none"
"""The provider of a role that nobody fills: no tracks, no dense depth, no metric depth, no masks."""

DROID = "droid.network"
"""Dense matching by the network that is refined in turns with the map."""

FOUND_BY_PHRASES = "hf.grounding_dino_sam2"
"""The provider of masks of what phrases name."""

VIDEO_DEPTH = "nvidia_vipe.video_depth_anything"
"""Dense depth by video depth that is aligned to the map, which is completed where it is sparse."""

GEOCALIB = {"pinhole": "nvidia_vipe.geocalib_pinhole", "mei": "nvidia_vipe.geocalib_distorted"}
"""Camera model -> the provider of the initial camera that is a network."""

METRIC_DEPTH = (
    NONE,
    "hf.depth_pro",
    "hf.depth_anything_indoor",
    "hf.depth_anything_outdoor",
    "nvidia_vipe.metric3d_small",
    "nvidia_vipe.metric3d_large",
    "nvidia_vipe.metric3d_giant2",
    "nvidia_vipe.unidepth",
    "nvidia_vipe.unik3d",
)
"""Networks that tell the scale."""

CORNERS, CUVSLAM = "classical.corners", "cuvslam.odometry"
TRACKS = (NONE, CORNERS, CUVSLAM)
"""Tracks through consecutive frames that join what the DROID network measures."""

_PROVIDER_WEIGHTS: dict[str, tuple[str, ...]] = {
    DROID: ("droid",),
    FOUND_BY_PHRASES: ("grounding_dino", "sam2_video"),
    VIDEO_DEPTH: ("video_depth_anything", "priorda"),
    **{provider: (provider.partition(".")[2],) for provider in (*GEOCALIB.values(), *METRIC_DEPTH[1:])},
}


@dataclass(frozen=True, slots=True)
class Preset:
    """Everything that determines a result besides the input and the device.

    Attributes:
        name: Name that users choose it by.
        camera: Camera model that is estimated; `auto` for what the video says, `equirect` has nothing to estimate.
        matcher: Provider of dense matching.
        sparse: Provider of sparse tracks.
        intrinsics: Provider of the initial camera.
        depth: Providers of dense depth, a name of `providers.py`.
        metric: Provider of metric depth, `none` where scale is what the user says or relative.
        masks: Provider of masks, `none` where only geometry and the user say what must not be used.
        slam: Settings of the SLAM stage.
        dense_depth: Settings of the depth stage where depth is multi-view stereo.
        alignment: Settings of the depth stage where the depth providers have video depth.
        instances: What masks are of.
    """

    name: str
    camera: str
    matcher: str
    sparse: str
    intrinsics: str
    depth: str
    metric: str = NONE
    masks: str = NONE
    slam: SlamSettings = field(default_factory=SlamSettings)
    dense_depth: DepthSettings = field(default_factory=DepthSettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    instances: InstanceSettings = field(default_factory=InstanceSettings)

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
            "metric_depth": self.metric,
            "masks": self.masks,
        }

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the weights that its providers need, of `vipe_core.priors.weights`."""
        return tuple(name for provider in self.providers.values() for name in _PROVIDER_WEIGHTS.get(provider, ()))

    @property
    def makes_depth(self) -> bool:
        """Whether its dense stream has any depth."""
        return self.depth != NONE


@dataclass(frozen=True, slots=True)
class PresetOptions:
    """What a user changes of a preset; None leaves it as it is.

    Attributes:
        phrases: What is found, followed and kept out of the way. With them, any preset makes masks; with an empty tuple
            none does.
        detection_interval_s: Time between looks for new things.
        metric_depth: Network that tells the scale, one of `METRIC_DEPTH`.
        tracks: What follows points for the DROID network, one of `TRACKS`.
    """

    phrases: tuple[str, ...] | None = None
    detection_interval_s: float | None = None
    metric_depth: str | None = None
    tracks: str | None = None

    def applied(self, preset: Preset) -> Preset:
        """The preset with the changes.

        Raises:
            ConfigError: The phrases or the interval cannot be, or there is no such network, or no such tracks.
        """
        if self.metric_depth is not None and self.metric_depth not in METRIC_DEPTH:
            raise ConfigError(f"unknown metric depth {self.metric_depth!r}; on offer: {', '.join(METRIC_DEPTH)}")
        if self.tracks is not None and self.tracks not in TRACKS:
            raise ConfigError(f"unknown tracks {self.tracks!r}; on offer: {', '.join(TRACKS)}")
        if self.tracks is not None and preset.matcher != DROID:
            raise ConfigError(
                f"the preset {preset.name} has tracks of its own: only those of the DROID network are chosen"
            )
        masks, instances = preset.masks, preset.instances
        if self.phrases is not None:
            masks = FOUND_BY_PHRASES if self.phrases else NONE
            if self.phrases:
                instances = dataclasses.replace(instances, phrases=self.phrases)
        if self.detection_interval_s is not None:
            if masks == NONE:
                raise ConfigError("a time between detections means nothing without phrases to look for")
            instances = dataclasses.replace(instances, interval_s=self.detection_interval_s)
        metric = preset.metric if self.metric_depth is None else self.metric_depth
        sparse = preset.sparse if self.tracks is None else self.tracks
        return dataclasses.replace(preset, masks=masks, instances=instances, metric=metric, sparse=sparse)


_CLASSICAL = Preset(
    name="classical",
    camera="pinhole",
    matcher="classical.dis_flow",
    sparse="classical.lucas_kanade",
    intrinsics="classical.two_view_focal",
    depth="classical.plane_sweep",
)
# The network was trained on pictures of this size, and its edges know what moves: no masks beside it.
_NETWORK = dataclasses.replace(
    _CLASSICAL,
    matcher=DROID,
    sparse=NONE,
    slam=SlamSettings(working_area_px=512 * 384),
    dense_depth=DepthSettings.fast(),
)
_PRESETS = {
    preset.name: preset
    for preset in (
        _CLASSICAL,
        dataclasses.replace(_CLASSICAL, name="classical_fast", dense_depth=DepthSettings.fast()),
        dataclasses.replace(_CLASSICAL, name="wide_angle", camera="mei"),
        dataclasses.replace(_CLASSICAL, name="panorama", camera="equirect"),
        dataclasses.replace(_NETWORK, name="vipe_fast"),
        dataclasses.replace(_NETWORK, name="pose_only", depth=NONE),
        dataclasses.replace(
            _NETWORK,
            name="vipe",
            sparse=CORNERS,
            intrinsics=GEOCALIB["pinhole"],
            depth=VIDEO_DEPTH,
            metric="nvidia_vipe.metric3d_large",
            masks=FOUND_BY_PHRASES,
        ),
    )
}
_PANORAMIC_DEPTH = ("nvidia_vipe.unik3d",)
_INTRINSICS = {
    "pinhole": "classical.two_view_focal",
    "mei": "classical.unified_sweep",
    "auto": "classical.unified_sweep",
    "equirect": "classical.cube_faces",
}

PRESETS = tuple(_PRESETS)
"""Names, the default first. `classical_fast` has the same poses and map, and coarser dense depth for less time;
`wide_angle` estimates the bend of the lens as well; `panorama` is for equirectangular video. `vipe_fast` and
`pose_only` find poses as the paper does, by the DROID network and bundle adjustment in turns, and need its weights; the
one has coarse dense depth, the other none. `vipe` is the paper's whole: masks of what its phrases name, the camera from
GeoCalib, tracks of corners, metric depth, and video depth aligned to the map; it needs the extras `hf` and
`nvidia-vipe`, and their weights."""


def resolve(preset: str | Preset, camera: str | None = None, options: PresetOptions | None = None) -> Preset:
    """The preset of that name, for that camera model or its own, with the user's changes.

    Raises:
        ConfigError: It is not on offer, and the message lists what is; or the changes cannot be.
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
    learned = found.intrinsics in GEOCALIB.values() and camera in GEOCALIB
    intrinsics = GEOCALIB[camera] if learned else _INTRINSICS[camera]
    found = dataclasses.replace(found, camera=camera, intrinsics=intrinsics)
    if options is not None:
        found = options.applied(found)
    if camera == "equirect":
        _require_panoramic(found)
    return found


def _require_panoramic(preset: Preset) -> None:
    if preset.matcher != _CLASSICAL.matcher:
        raise ConfigError(f"the preset {preset.name} does not annotate panoramas; panorama and classical do")
    if preset.metric not in (NONE, *_PANORAMIC_DEPTH):
        raise ConfigError(
            f"{preset.metric} does not know panoramas; metric depth that does: {', '.join(_PANORAMIC_DEPTH)}"
        )
