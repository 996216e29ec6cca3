"""The backend of a refined map: all keyframes, linked anew and updated together, with the camera (section 3.1)."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

from vipe_core.ba.problem import Result
from vipe_core.priors.protocols import Refiner, TrackedPoints
from vipe_core.slam.adjustment import Adjuster
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.lens import focal_sigma_ratio, plausible
from vipe_core.slam.recurrent.depth_prior import DepthPrior
from vipe_core.slam.recurrent.edges import RefinedEdges
from vipe_core.slam.recurrent.linking import Reach, links
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.slam.reprojection import Reprojector

logger = logging.getLogger(__name__)


class RefinedBackend:
    """Global adjustment of a map by refinement. What it measured in the last run is in `graph`.

    Attributes:
        focal_sigma_ratio: 1-sigma of the focal length after the last run, as a share of it; the prior's where it was
            held.
    """

    def __init__(
        self,
        refiner: Refiner,
        keyframes: KeyframeMap,
        graph: Graph,
        adjuster: Adjuster,
        reprojector: Reprojector,
        settings: RefinementSettings,
        scale_px: float,
        prior: DepthPrior | None = None,
        seen: Mapping[int, TrackedPoints] | None = None,
    ) -> None:
        self._refiner = refiner
        self._keyframes = keyframes
        self._graph = graph
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._settings = settings
        self._prior = prior
        self._seen = seen
        self._max_px = scale_px * settings.global_px
        self.focal_sigma_ratio = adjuster.focal_prior.sigma

    def run(self, updates: int, *, settle: bool = False) -> None:
        """Link, update and adjust everything from scratch; renormalise the scale to median depth 1.

        Args:
            settle: Where there is a prior of depths, which depends on the camera: after half of the updates it is
                asked anew, once, and the camera is held from then on.
        """
        count = len(self._keyframes)
        if count < 2:
            return
        settings = self._settings
        most = min(settings.global_edges * count, settings.global_most_edges)
        reach = Reach(settings.neighbours, self._max_px, settings.global_gap, most)
        found = links(self._reprojector, self._keyframes, range(count), range(count), (), reach, settings)
        prior = self._prior
        edges = RefinedEdges(
            self._refiner,
            self._keyframes,
            self._adjuster,
            lean=True,
            spilled=settings.lean,
            prior=prior,
            prior_information=settings.metric_information,
            seen=self._seen,
        )
        edges.add(found)
        settled = updates if prior is None or not settle or self._adjuster.focal_prior.held else updates // 2
        for update in range(updates):
            if prior is not None and update == settled:
                prior.refresh()
            edges.update()
            if update < settled:
                self._adjust(edges)
            else:
                edges.adjust(1, settings.global_iterations)
        for edge in list(self._graph):
            self._graph.discard(*edge)
        edges.file(self._graph)
        self._keyframes.normalise_scale()

    def _adjust(self, edges: RefinedEdges) -> Result | None:
        """Adjust with free intrinsics; take that back when the focal length runs out of any lens's range."""
        before = self._keyframes.snapshot()
        result = edges.adjust(1, self._settings.global_iterations, free_focal=True)
        if result is None or self._adjuster.focal_prior.held:
            return result
        settings, camera = self._adjuster.settings, self._keyframes.camera
        formal = focal_sigma_ratio(camera, result.intrinsics_covariance)
        sigma = math.hypot(settings.focal_sigma_inflation * formal, settings.lens_sigma)
        if math.isfinite(sigma) and plausible(camera):
            self.focal_sigma_ratio = sigma
            return result
        logger.info("focal length held: it went to a field of view of %.1f deg, sigma %.3f", camera.fov_x_deg, sigma)
        self.focal_sigma_ratio = self._adjuster.focal_prior.sigma
        self._keyframes.restore(before)
        return edges.adjust(1, self._settings.global_iterations)
