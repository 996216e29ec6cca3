"""The providers by name: what the fields of a `Preset` may say."""

from __future__ import annotations

from collections.abc import Callable

import torch

from vipe_core.errors import ConfigError
from vipe_core.pipeline.presets import NO_DEPTH
from vipe_core.priors.classical import classical_priors
from vipe_core.priors.droid import DroidMatcher, load_network
from vipe_core.priors.protocols import DepthFamily, PriorFamily
from vipe_core.priors.weights import require

DepthOpener = Callable[[torch.device], DepthFamily]
"""Device -> providers, ready to be used for any number of videos."""

PriorMaker = Callable[[], PriorFamily]
"""New providers of the geometric roles for one video."""

PriorOpener = Callable[[str, torch.device], PriorMaker]
"""(camera model, device) -> maker; loads what all videos share."""

_DEPTH: dict[str, DepthOpener] = {
    "classical.plane_sweep": lambda device: DepthFamily(),
    NO_DEPTH: lambda device: DepthFamily(),
}


def _classical(camera: str, device: torch.device) -> PriorMaker:
    # New matchers for each video: OpenCV's flow object keeps buffers of the last picture size and is not safe to use
    # with another one, and nothing of one video may reach the next.
    return lambda: classical_priors(camera)


def _droid(camera: str, device: torch.device) -> PriorMaker:
    network = load_network(require("droid").path).ready(device)

    def family() -> PriorFamily:
        matcher = DroidMatcher(network)
        intrinsics = classical_priors(camera).intrinsics
        return PriorFamily(matcher, tracker=None, points=None, intrinsics=intrinsics, refiner=matcher)

    return family


_PRIORS: dict[str, PriorOpener] = {"classical.dis_flow": _classical, "droid.network": _droid}


def open_priors(matcher: str, camera: str, device: torch.device) -> PriorMaker:
    """The providers of the geometric roles, by that of dense matching.

    Raises:
        ConfigError: There are none.
        WeightsMissing: Their weights are not on this machine; the message names the command that fetches them.
        WeightsInvalid: The weights are damaged.
    """
    if matcher not in _PRIORS:
        raise ConfigError(f"unknown provider of dense matching {matcher!r}; on offer: {', '.join(sorted(_PRIORS))}")
    return _PRIORS[matcher](camera, device)


def register_depth(name: str, opener: DepthOpener) -> None:
    """Put a family of depth providers on offer, for presets that name it.

    Raises:
        ConfigError: The name is taken.
    """
    if name in _DEPTH:
        raise ConfigError(f"there are depth providers called {name!r} already")
    _DEPTH[name] = opener


def open_depth(name: str, device: torch.device) -> DepthFamily:
    """The providers of that name.

    Raises:
        ConfigError: There are none.
    """
    if name not in _DEPTH:
        raise ConfigError(f"unknown depth provider {name!r}; on offer: {', '.join(sorted(_DEPTH))}")
    return _DEPTH[name](device)
