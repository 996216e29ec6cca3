"""The providers by name: what the fields of a `Preset` may say.

Networks are imported when they are opened: their libraries are extras, and take seconds.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch

from vipe_core.errors import ConfigError, LibraryMissing
from vipe_core.pipeline.presets import CORNERS, CUVSLAM, DROID, FOUND_BY_PHRASES, GEOCALIB, NONE, VIDEO_DEPTH
from vipe_core.priors.classical import classical_priors
from vipe_core.priors.classical.following import CornerFollower
from vipe_core.priors.droid import DroidMatcher, load_network
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.priors.instances import FollowedInstances
from vipe_core.priors.protocols import DepthFamily, InstanceMasks, MetricDepth, PointFollower, PriorFamily
from vipe_core.priors.rectified import Rectified
from vipe_core.priors.weights import folder_of, path_of

if TYPE_CHECKING:
    from vipe_core.priors.nvidia_vipe.metric_depth import Metric3dSize

DepthOpener = Callable[[torch.device], DepthFamily]
"""Device -> providers, ready to be used for any number of videos."""

PriorMaker = Callable[[], PriorFamily]
"""New providers of the geometric roles for one video."""

PriorOpener = Callable[[str, torch.device], PriorMaker]
"""(camera model, device) -> maker; loads what all videos share."""

MetricOpener = Callable[[torch.device], MetricDepth]
FollowerOpener = Callable[[torch.device], PointFollower]
MaskOpener = Callable[[InstanceSettings, torch.device], InstanceMasks]


def require_libraries(providers: Iterable[str]) -> None:
    """Make sure that the extras of these providers are installed.

    Raises:
        LibraryMissing: One is not; the message says what installs it.
    """
    from vipe_core.priors.cuvslam import INSTALL as CUVSLAM_INSTALL
    from vipe_core.priors.hf.loading import EXTRA
    from vipe_core.priors.nvidia_vipe.loading import INSTALL

    needed = {
        "hf": ("transformers", EXTRA),
        "nvidia_vipe": ("vipe", INSTALL),
        "cuvslam": ("cuvslam", CUVSLAM_INSTALL),
    }
    for provider in providers:
        library, command = needed.get(provider.partition(".")[0], ("", ""))
        if library and importlib.util.find_spec(library) is None:
            raise LibraryMissing(
                f"{provider} needs the library {library}, which is not installed; install it: {command}"
            )


def _video_depth(device: torch.device) -> DepthFamily:
    from vipe_core.priors.nvidia_vipe.completion import PriorDa
    from vipe_core.priors.nvidia_vipe.video_depth import VideoDepthAnything

    video = VideoDepthAnything.load(path_of("video_depth_anything"), "vits", device)
    return DepthFamily(video=video, completion=PriorDa.load(folder_of("priorda"), device))


def _depth_pro(device: torch.device) -> MetricDepth:
    from vipe_core.priors.hf.metric_depth import DepthPro

    return Rectified(DepthPro.load(folder_of("depth_pro"), device))


def _depth_anything(scene: str) -> MetricOpener:
    def opened(device: torch.device) -> MetricDepth:
        from vipe_core.priors.hf.metric_depth import DepthAnything

        return Rectified(DepthAnything.load(folder_of(f"depth_anything_{scene}"), device))

    return opened


def _metric3d(size: Metric3dSize) -> MetricOpener:
    def opened(device: torch.device) -> MetricDepth:
        from vipe_core.priors.nvidia_vipe.metric_depth import Metric3d

        return Rectified(Metric3d.load(path_of(f"metric3d_{size}"), size, device))

    return opened


def _unidepth(device: torch.device) -> MetricDepth:
    from vipe_core.priors.nvidia_vipe.metric_depth import UniDepth

    return Rectified(UniDepth.load(folder_of("unidepth"), device))


def _unik3d(device: torch.device) -> MetricDepth:
    from vipe_core.priors.nvidia_vipe.metric_depth import UniK3d

    return UniK3d.load(folder_of("unik3d"), device)


def _cuvslam(device: torch.device) -> PointFollower:
    from vipe_core.priors.cuvslam import CuvslamFollower

    return CuvslamFollower.load(device)


def _found_by_phrases(settings: InstanceSettings, device: torch.device) -> InstanceMasks:
    from vipe_core.priors.hf.grounding_dino import LONGEST, SHORTEST, GroundingDino
    from vipe_core.priors.hf.sam2_video import Sam2Video

    detector = GroundingDino.load(folder_of("grounding_dino"), device)
    return FollowedInstances(detector, Sam2Video.load(folder_of("sam2_video"), device), settings, (LONGEST, SHORTEST))


_DEPTH: dict[str, DepthOpener] = {
    "classical.plane_sweep": lambda device: DepthFamily(),
    VIDEO_DEPTH: _video_depth,
    NONE: lambda device: DepthFamily(),
}
_METRIC: dict[str, MetricOpener] = {
    "hf.depth_pro": _depth_pro,
    "hf.depth_anything_indoor": _depth_anything("indoor"),
    "hf.depth_anything_outdoor": _depth_anything("outdoor"),
    "nvidia_vipe.metric3d_small": _metric3d("small"),
    "nvidia_vipe.metric3d_large": _metric3d("large"),
    "nvidia_vipe.metric3d_giant2": _metric3d("giant2"),
    "nvidia_vipe.unidepth": _unidepth,
    "nvidia_vipe.unik3d": _unik3d,
}
_TRACKS: dict[str, FollowerOpener] = {CORNERS: lambda device: CornerFollower(), CUVSLAM: _cuvslam}
_MASKS: dict[str, MaskOpener] = {FOUND_BY_PHRASES: _found_by_phrases}


def _classical(camera: str, device: torch.device) -> PriorMaker:
    # New matchers for each video: OpenCV's flow object keeps buffers of the last picture size and is not safe to use
    # with another one, and nothing of one video may reach the next.
    return lambda: classical_priors(camera)


def _droid(camera: str, device: torch.device) -> PriorMaker:
    network = load_network(path_of("droid")).ready(device)

    def family() -> PriorFamily:
        matcher = DroidMatcher(network)
        intrinsics = classical_priors(camera).intrinsics
        return PriorFamily(matcher, tracker=None, points=None, intrinsics=intrinsics, refiner=matcher)

    return family


_PRIORS: dict[str, PriorOpener] = {"classical.dis_flow": _classical, DROID: _droid}


def open_priors(matcher: str, sparse: str, intrinsics: str, camera: str, device: torch.device) -> PriorMaker:
    """The providers of the geometric roles, by that of dense matching.

    The initial camera is the family's own unless `intrinsics` names a network; so are tracks unless `sparse` names
    what follows points for one that is refined.

    Raises:
        ConfigError: There are none, or they need another device.
        LibraryMissing: The library of the tracks is not installed.
        WeightsMissing: Their weights are not on this machine; the message names the command that fetches them.
        WeightsInvalid: The weights are damaged.
    """
    if matcher not in _PRIORS:
        raise ConfigError(f"unknown provider of dense matching {matcher!r}; on offer: {', '.join(sorted(_PRIORS))}")
    maker = _PRIORS[matcher](camera, device)
    changed: dict[str, Any] = {}
    if sparse in _TRACKS:
        changed["follower"] = _TRACKS[sparse](device)
    if intrinsics in GEOCALIB.values():
        from vipe_core.priors.nvidia_vipe.geocalib import GeoCalibInit

        changed["intrinsics"] = GeoCalibInit.load(path_of(intrinsics.partition(".")[2]), camera, device)
    return lambda: dataclasses.replace(maker(), **changed)


def register_depth(name: str, opener: DepthOpener) -> None:
    """Put a family of depth providers on offer, for presets that name it.

    Raises:
        ConfigError: The name is taken.
    """
    if name in _DEPTH:
        raise ConfigError(f"there are depth providers called {name!r} already")
    _DEPTH[name] = opener


def open_depth(name: str, metric: str, device: torch.device) -> DepthFamily:
    """The depth providers of that name, with a network for metric depth unless `metric` is `none`.

    Raises:
        ConfigError: There are none.
        LibraryMissing, WeightsMissing, WeightsInvalid: What they need is not on this machine.
    """
    if name not in _DEPTH:
        raise ConfigError(f"unknown depth provider {name!r}; on offer: {', '.join(sorted(_DEPTH))}")
    if metric != NONE and metric not in _METRIC:
        raise ConfigError(f"unknown metric depth {metric!r}; on offer: {', '.join(sorted((NONE, *_METRIC)))}")
    family = _DEPTH[name](device)
    return family if metric == NONE else dataclasses.replace(family, metric=_METRIC[metric](device))


def register_masks(name: str, opener: MaskOpener) -> None:
    """Put a provider of masks on offer, for presets that name it.

    Raises:
        ConfigError: The name is taken.
    """
    if name in _MASKS:
        raise ConfigError(f"there is a provider of masks called {name!r} already")
    _MASKS[name] = opener


def open_masks(name: str, settings: InstanceSettings, device: torch.device) -> InstanceMasks | None:
    """The provider of masks of that name, or None for `none`.

    Raises:
        ConfigError: There is none of that name.
        LibraryMissing, WeightsMissing, WeightsInvalid: What it needs is not on this machine.
    """
    if name == NONE:
        return None
    if name not in _MASKS:
        raise ConfigError(f"unknown provider of masks {name!r}; on offer: {', '.join(sorted((NONE, *_MASKS)))}")
    return _MASKS[name](settings, device)
