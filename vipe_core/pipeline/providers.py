"""The providers of dense depth by name: what `Preset.depth` may say."""

from __future__ import annotations

from collections.abc import Callable

import torch

from vipe_core.errors import ConfigError
from vipe_core.priors.protocols import DepthFamily

DepthOpener = Callable[[torch.device], DepthFamily]
"""Device -> providers, ready to be used for any number of videos."""

_DEPTH: dict[str, DepthOpener] = {"classical.plane_sweep": lambda device: DepthFamily()}


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
