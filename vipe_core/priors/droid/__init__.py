"""The recurrent matching network of DROID-SLAM, implemented here; it takes the weights of the public checkpoint."""

from __future__ import annotations

from vipe_core.priors.droid.checkpoint import load_network
from vipe_core.priors.droid.matcher import DroidMatcher
from vipe_core.priors.droid.network import DroidNetwork

__all__ = ["DroidMatcher", "DroidNetwork", "load_network"]
