"""The backend: adjusts every keyframe at once, with the focal length free where it can be observed (section 3.1)."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Result
from vipe_core.slam.adjustment import REFINE, SETTLE, Adjuster, Step
from vipe_core.slam.centring import refine_principal_point
from vipe_core.slam.closing import LoopCloser
from vipe_core.slam.crossviews import CrossViews
from vipe_core.slam.lens import focal_sigma_ratio, plausible
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.proximity import close_pairs, loop_edges
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.settings import SlamSettings

logger = logging.getLogger(__name__)

Array = NDArray[Any]

# Share of a keyframe's cells whose change of mask calls for another adjustment.
_VISIBLE_CHANGE = 0.02
_SUBSAMPLE = 4
# The first sharpening measures every other cell, as on a chessboard.
_READYING = 2
# The principal point couples with rotation and position, so that one round of probes only comes near.
_MAX_CENTRINGS = 3


class Backend:
    """Global adjustment of the map that `MeasuredGraph` holds.

    Attributes:
        focal_sigma_ratio: 1-sigma of the focal length after the last adjustment, as a share of it; the prior's where
            the adjustment held it.
    """

    def __init__(
        self,
        measured: MeasuredGraph,
        adjuster: Adjuster,
        reprojector: Reprojector,
        masks: MotionMasks,
        settings: SlamSettings,
        working_width: int,
    ) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._masks = masks
        self._settings = settings
        self._width = working_width
        self._closer = LoopCloser(measured, adjuster, reprojector)
        self._cross = CrossViews(measured, reprojector)
        self.focal_sigma_ratio = adjuster.focal_prior.sigma

    def run(self) -> Result | None:
        """Add edges between keyframes that overlap, adjust everything, renormalise the scale to median depth 1."""
        if len(self._keyframes) < 2:
            return None
        self._connect_loops()
        if self._closer.run():
            self._connect_loops()
        self._cross.connect(range(len(self._keyframes)))
        everything = range(len(self._keyframes))
        self._masks.update(everything)
        result = self._adjust()
        if self._masks.update(everything) > _VISIBLE_CHANGE:
            result = self._adjust() or result
        self._keyframes.normalise_scale()
        return result

    def sharpen(self) -> Result | None:
        """Measure every edge again from the adjusted geometry and adjust; then once more, and keyframes farther apart.

        The second time starts from depths that know the distortion of the patches better, which wide edges need most;
        half of the cells are enough to get there.
        Steps between neighbours add up like a random walk. Edges over several keyframes hold the sum.
        The motion masks stay: alignments start from where the cells would be if nothing moved.
        """
        if len(self._keyframes) < 2 or not self._measured.can_sharpen:
            return None
        result: Result | None = None
        for wide in (False, True):
            edges = sorted({*self._measured.graph, *(self._wide_edges() if wide else ())})
            for i, j in edges:
                self._adjuster.alive()
                self._measured.sharpen(i, j, self._settings.min_consistent, every=1 if wide else _READYING)
            result = self._adjust(SETTLE)
        self._keyframes.normalise_scale()
        return result

    def _wide_edges(self) -> list[tuple[int, int]]:
        """Both directions between each keyframe and those a few steps on, as far as they see the same."""
        count, views = len(self._keyframes), self._keyframes.num_views
        pairs = [(i, i + step * views) for step in self._settings.wide_steps for i in range(count - step * views)]
        if not pairs:
            return []
        first, last = [i for i, _ in pairs], [j for _, j in pairs]
        there = self._reprojector.fan(self._keyframes, first, last, _SUBSAMPLE)
        back = self._reprojector.fan(self._keyframes, last, first, _SUBSAMPLE)
        seen = np.minimum(there.overlap, back.overlap) >= self._settings.wide_overlap
        return [edge for (i, j), keep in zip(pairs, seen, strict=True) if keep for edge in ((i, j), (j, i))]

    def recentre(self) -> None:
        """Find the principal point of the adjusted map, and adjust again where it moved; not where it is known.

        Nor that of a rig, whose cameras are calibrated together or have several.
        """
        known = self._adjuster.focal_prior.same_lens or self._adjuster.focal_prior.held
        if known or self._keyframes.cam_from_rig is not None:
            return
        everything = range(len(self._keyframes))
        rounds = 0
        while rounds < _MAX_CENTRINGS and refine_principal_point(self._keyframes, self._measured.graph, self._adjuster):
            rounds += 1
            self._adjust()
            if self._masks.update(everything) > _VISIBLE_CHANGE:
                self._adjust()
        self._keyframes.normalise_scale()

    def _connect_loops(self) -> None:
        count = len(self._keyframes)
        limit = max(1, round(self._settings.loop_edges_per_keyframe * count))
        scale = self._width / 640.0
        pairs = close_pairs(
            self._reprojector,
            self._keyframes,
            range(count),
            range(count),
            self._settings.proximity_px * scale,
            self._settings.proximity_overlap,
        )
        instant = self._keyframes.instant
        near = self._settings.neighbours + 1
        existing = sum(1 for i, j in self._measured.graph if instant(i) - instant(j) > near)
        for pair in loop_edges(pairs, self._measured.graph, limit - existing, num_views=self._keyframes.num_views):
            self._adjuster.alive()
            self._measured.connect(pair.target, pair.source, guided=True, min_consistent=self._settings.min_consistent)

    def _adjust(self, schedule: Sequence[Step] = REFINE) -> Result | None:
        """Adjust with a free focal length under its prior; take it back when it runs out of any lens's range."""
        if self._adjuster.focal_prior.held:
            return self._adjust_everything(schedule, free_focal=False)
        before = self._keyframes.snapshot()
        result = self._adjust_everything(schedule, free_focal=True)
        if result is None:
            return None
        # A pinhole leaves out the distortion of a real lens, which more measurements do not average away.
        cameras = [self._keyframes.camera_of(view) for view in range(len(result.intrinsics_covariances))]
        formal = max(map(focal_sigma_ratio, cameras, result.intrinsics_covariances))
        sigma = math.hypot(self._settings.focal_sigma_inflation * formal, self._settings.lens_sigma)
        if math.isfinite(sigma) and all(plausible(camera) for camera in cameras):
            self.focal_sigma_ratio = sigma
            return result
        fov_deg = cameras[0].fov_x_deg
        logger.info("focal length held: it went to a field of view of %.1f deg, sigma %.3f", fov_deg, sigma)
        self.focal_sigma_ratio = self._adjuster.focal_prior.sigma
        self._keyframes.restore(before)
        return self._adjust_everything(schedule, free_focal=False)

    def _adjust_everything(self, schedule: Sequence[Step], *, free_focal: bool) -> Result | None:
        frames = range(len(self._keyframes))
        return self._adjuster.adjust(
            self._keyframes,
            self._measured.graph,
            frames,
            (0,),
            schedule,
            free_focal=free_focal,
            free_extrinsics=self._adjuster.extrinsic_prior is not None,
            free_scale=self._keyframes.has_size,
        )
