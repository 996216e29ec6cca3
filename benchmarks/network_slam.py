"""The DROID network's SLAM put together from the engine's pieces, for benchmarks that choose keyframes themselves.

With random weights nothing that a network sees may decide anything: the benchmarks take keyframes as they like, and
leave the rest to the tracker, the global pass and the poses of the frames between.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vipe_core.cameras import Camera
from vipe_core.priors.droid import DroidMatcher, DroidNetwork
from vipe_core.slam.adjustment import Adjuster, FocalPrior
from vipe_core.slam.frames import EncodedFrames
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.recurrent.backend import RefinedBackend
from vipe_core.slam.recurrent.posing import FramePoser
from vipe_core.slam.recurrent.tracking import RefinedTracker
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.working import working_size
from vipe_core.video.source import FrameSource

FPS = 30.0
"""Of the clips that these benchmarks make."""

FOV_DEG = 60.0
"""What the focal length is held to be, across the width."""


@dataclass(frozen=True, slots=True)
class NetworkSlam:
    """The frames of a video, an empty map of them, and what fills it.

    Attributes:
        built: Poses and inverse depths of the keyframes.
        graph: Of the global passes.
        backend: Makes a global pass.
    """

    settings: SlamSettings
    matcher: DroidMatcher
    frames: EncodedFrames
    built: KeyframeMap
    graph: Graph
    adjuster: Adjuster
    tracker: RefinedTracker
    backend: RefinedBackend

    @classmethod
    def of(cls, source: FrameSource, network: DroidNetwork, settings: SlamSettings) -> NetworkSlam:
        """For a video, on the device of the network; nothing is read yet."""
        schedule = settings.refinement
        matcher = DroidMatcher(network)
        info = source.info
        size = working_size(info.width, info.height, settings.working_area_px, offset_px=matcher.offset_px)
        camera = Camera.pinhole_from_fov(FOV_DEG, size.width, size.height)
        built, graph = KeyframeMap(size.grid, "pinhole", camera.index_params()), Graph()
        reprojector = Reprojector("pinhole", size.grid)
        scale_px = settings.scaled_px(1.0, size.width)
        adjuster = Adjuster(settings, network.device, FocalPrior(math.log(camera.focal_px), 0.1), scale_px)
        return cls(
            settings,
            matcher,
            EncodedFrames(source, size, matcher, settings.frame_cache_bytes),
            built,
            graph,
            adjuster,
            RefinedTracker(matcher, built, adjuster, reprojector, schedule, scale_px),
            RefinedBackend(matcher, built, graph, adjuster, reprojector, schedule, scale_px),
        )

    def track(self, keyframes: Sequence[Keyframe]) -> Iterator[int]:
        """Fills the map, and yields its length after the first keyframes, which are taken at once, and after each."""
        first = min(self.settings.min_keyframes, len(keyframes))
        self.tracker.start(keyframes[:first], [one.index / FPS for one in keyframes[:first]])
        yield first
        for number, keyframe in enumerate(keyframes[first:], first + 1):
            self.tracker.add(keyframe, keyframe.index / FPS)
            yield number

    def poser(self) -> FramePoser:
        """What poses the frames between keyframes of the map as it is now."""
        usable = np.ones((len(self.built), self.built.grid.num_cells), np.bool_)
        return FramePoser(self.matcher, self.built, self.adjuster, usable, self.settings.refinement)
