"""Sparse correspondences between any two frames: keypoints, mutual matches, epipolar check."""

from __future__ import annotations

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.priors.classical.features import FlowFeatures
from vipe_core.priors.classical.keypoints import mutual_matches
from vipe_core.priors.protocols import Correspondences

_MIN_MATCHES = 12
_EPIPOLAR = {"max_iterations": 1000, "min_iterations": 100, "max_epipolar_error": 1.5, "seed": 0}


class SiftMatcher:
    """`PointMatcher` on the features of `DisFlowMatcher`."""

    def correspond(self, source: FlowFeatures, target: FlowFeatures) -> Correspondences:
        """Verified correspondences; see `PointMatcher.correspond`."""
        pairs = mutual_matches(source.keypoints, target.keypoints)
        if len(pairs) < _MIN_MATCHES:
            return Correspondences.none()
        source_px = source.keypoints.points_px[pairs[:, 0]]
        target_px = target.keypoints.points_px[pairs[:, 1]]
        _, report = poselib.estimate_fundamental(
            source_px.astype(np.float64), target_px.astype(np.float64), dict(_EPIPOLAR), {}
        )
        inlier = np.asarray(report["inliers"], dtype=np.bool_)
        if inlier.sum() < _MIN_MATCHES:
            return Correspondences.none()
        return Correspondences(source_px[inlier], target_px[inlier])

    def overview(self, features: FlowFeatures) -> NDArray[np.float32]:
        """Descriptors of the same keypoints; see `PointMatcher.overview`."""
        return features.keypoints.vectors()
