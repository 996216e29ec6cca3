"""Focal length from pairs of frames: shared-focal 6-point RANSAC and a robust vote.

Each pair gives a focal length (minimal solver of Kukelova et al., ECCV 2008, as found in PoseLib) and a weight that
tells how much better an essential matrix explains it than a homography: without parallax the focal length of a pair
is not observable. The answer is the weighted median; its sigma comes from how well the pairs agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.priors.classical.claims import FocalClaim
from vipe_core.priors.classical.features import FlowFeatures, cell_centres_px
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.protocols import WorkingFrame

# Where motion stops growing before it reaches the wanted amount, a pair is still taken from this share on.
_ENOUGH_MOTION = 0.5
_STILL_GROWING = 1.15
# A pair of which only this share (or more) of the cells is matched consistently has its full weight.
_FULL_CONSISTENCY = 0.5
_MIN_TOTAL_WEIGHT = 0.05
_MIN_LOG_SIGMA = 0.03
# Rotation on the spot: a homography must explain this share of the pair, be a rotation up to this share of its angle,
# and so many pairs must say so. Their sigma is wider: a plane seen in motion can pass for a rotation.
_ALL_FLAT = 0.85
_MAX_ROTATION_MISFIT = 0.15
_MIN_ROTATIONS = 3
_MIN_ROTATION_LOG_SIGMA = 0.08
_MIN_FOCAL_RATIO, _MAX_FOCAL_RATIO = 0.2, 4.0


@dataclass(frozen=True, slots=True)
class FocalVote:
    """What one pair of frames says.

    Attributes:
        source, target: Positions in the sequence that `votes` was given.
        focal_px: Focal length at the working resolution.
        weight: Inlier ratio x (1 - homography inlier ratio), less where little is matched, 0..1.
        motion_px: Median displacement between the frames.
        rotation_focal_px: Focal length from the homography where one explains the pair and is a rotation, else NaN.
    """

    source: int
    target: int
    focal_px: float
    weight: float
    motion_px: float
    rotation_focal_px: float = math.nan


class TwoViewFocal:
    """What pairs of frames say about the focal length.

    Picks anchors and their partners itself and looks at no pair that the motion between them does not call for.

    Args:
        matcher: Dense matcher; one of fine flow if None.
        num_anchors: Frames that look for a partner.
        motion_ratio: Wanted median displacement to the partner, share of the image width.
        max_points: Upper bound of correspondences per pair.
    """

    def __init__(
        self,
        matcher: DisFlowMatcher | None = None,
        num_anchors: int = 10,
        motion_ratio: float = 30 / 640,
        max_points: int = 1500,
    ) -> None:
        self._matcher = matcher or DisFlowMatcher(fine=True)
        self._num_anchors = num_anchors
        self._motion_ratio = motion_ratio
        self._max_points = max_points

    def claim(self, frames: Sequence[WorkingFrame]) -> FocalClaim | None:
        """Weighted median of the votes; None when no pair shows parallax or a rotation."""
        return _claim(self.votes(frames))

    def votes(self, frames: Sequence[WorkingFrame]) -> list[FocalVote]:
        """One vote for each anchor that found a partner and whose pair could be solved."""
        last = len(frames) - 1
        if last < 1:
            return []
        features: dict[int, FlowFeatures] = {}

        def at(position: int) -> FlowFeatures:
            if position not in features:
                features[position] = self._matcher.encode(frames[position])
            return features[position]

        anchors = np.unique(np.rint(np.linspace(0, last, self._num_anchors)).astype(int)).tolist()
        pairs: dict[tuple[int, int], float] = {}
        for anchor in anchors:
            for direction in (1, -1):
                found = self._partner(at, anchor, direction, last)
                if found is not None:
                    pairs.setdefault((min(anchor, found[0]), max(anchor, found[0])), found[1])
                    break
        solved = [self._vote(at(a), at(b), a, b, motion) for (a, b), motion in sorted(pairs.items())]
        return [v for v in solved if v is not None]

    def _partner(
        self, at: Callable[[int], FlowFeatures], anchor: int, direction: int, last: int
    ) -> tuple[int, float] | None:
        """The nearest frame in `direction` that has moved enough: doubling steps, then bisection."""
        source = at(anchor)
        wanted = self._motion_ratio * source.gray.shape[1]

        def motion(position: int) -> float:
            return self._matcher.motion_px(source, at(position))

        end = last if direction > 0 else 0
        low, moved_low, step = anchor, 0.0, 1
        while True:
            high = low + direction * step
            high = min(high, end) if direction > 0 else max(high, end)
            if high == low:
                return None
            reached = motion(high)
            if reached >= wanted:
                break
            if moved_low >= _ENOUGH_MOTION * wanted and reached < _STILL_GROWING * moved_low:
                # Motion no longer grows with time: the flow has lost the scene (or the camera turns back).
                return low, moved_low
            low, moved_low, step = high, reached, step * 2
        while abs(high - low) > 1:
            middle = (low + high) // 2
            moved = motion(middle)
            if moved >= wanted:
                high, reached = middle, moved
            else:
                low = middle
        return high, reached

    def _vote(
        self, source: FlowFeatures, target: FlowFeatures, source_at: int, target_at: int, motion: float
    ) -> FocalVote | None:
        points = self._correspondences(source, target)
        if points is None:
            return None
        height, width = source.gray.shape
        first, second, consistent = points
        trust = min(1.0, consistent / _FULL_CONSISTENCY)
        ransac = {
            "max_iterations": 1000,
            "min_iterations": 200,
            "max_epipolar_error": 1.0,
            "max_reproj_error": 1.0,
            "seed": 0,
        }
        pp = np.array([(width - 1) / 2, (height - 1) / 2])
        pair, report = poselib.estimate_shared_focal_relative_pose(first, second, pp, ransac, {})
        homography, flat = poselib.estimate_homography(first, second, ransac, {})
        focal = float(pair.camera1.focal())
        inliers, flat_inliers = float(report["inlier_ratio"]), float(flat["inlier_ratio"])
        if not math.isfinite(focal) or not _MIN_FOCAL_RATIO * width < focal < _MAX_FOCAL_RATIO * width:
            return None
        turned = math.nan
        if flat_inliers * trust > _ALL_FLAT:
            turned = _rotation_focal(np.asarray(homography, np.float64), pp, width)
        weight = inliers * max(0.0, 1 - flat_inliers) * trust
        return FocalVote(source_at, target_at, focal, weight, motion, turned)

    def _correspondences(
        self, source: FlowFeatures, target: FlowFeatures
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """Consistent, corner-like cells, spread evenly over the frame; None when too few."""
        forward, _ = self._matcher.match(source, target)
        structure = source.structure
        # Weight = agreement x structure; agreement of 0.3 is a forward-backward error of about 0.7 px.
        agreement = (forward.weight * (structure + source.structure_floor) / np.maximum(structure, 1e-9)).max(axis=1)
        corner = structure.min(axis=1)
        usable = source.usable_cells
        if not usable.any():
            return None
        bar = min(4.0, float(np.quantile(corner[usable], 0.6)))
        kept = np.flatnonzero((agreement > 0.3) & (corner >= bar))
        if len(kept) < 40:
            return None
        if len(kept) > self._max_points:
            kept = kept[np.linspace(0, len(kept) - 1, self._max_points).astype(int)]
        centres = cell_centres_px(source.grid)[kept]
        return centres.astype(np.float64), forward.target_px[kept].astype(np.float64), forward.consistent


def _claim(votes: Sequence[FocalVote]) -> FocalClaim | None:
    """Weighted median of log(f), an honest sigma, and the number of votes behind them.

    Without parallax, rotations vote in place of the pairs. Pairs that contradict each other (forward driving, moving
    objects) make the sigma wide.
    """
    weights = np.array([v.weight for v in votes])
    turned = np.array([v.rotation_focal_px for v in votes])
    turned = turned[np.isfinite(turned)]
    if weights.sum() >= _MIN_TOTAL_WEIGHT * max(1, len(weights)):
        log_focal, weights = _sorted(np.log([v.focal_px for v in votes]), weights)
        floor = _MIN_LOG_SIGMA
    elif len(turned) >= _MIN_ROTATIONS:
        log_focal, weights = np.sort(np.log(turned)), np.full(len(turned), 0.5)
        floor = _MIN_ROTATION_LOG_SIGMA
    else:
        return None
    median = _weighted_quantile(log_focal, weights, 0.5)
    spread = 1.4826 * _weighted_quantile(*_sorted(np.abs(log_focal - median), weights), 0.5)
    # Pairs share their errors (same scene, same kind of motion), so the spread is not divided by their number; with
    # few or light pairs the spread itself is uncertain.
    sigma = max(floor, spread) * math.sqrt(1 + 1 / float(weights.sum()))
    return FocalClaim("two views", median, sigma, len(log_focal))


def _rotation_focal(homography: NDArray[np.float64], pp: NDArray[np.float64], width: int) -> float:
    """The focal length for which K^-1 H K is a rotation; NaN if there is none.

    H = K R K^-1 holds for a camera that turns on the spot (Hartley, ECCV 1994). The search is over a grid of log(f)
    with a parabola at the minimum of the distance from orthogonality.
    """
    centred = np.array([[1, 0, -pp[0]], [0, 1, -pp[1]], [0, 0, 1]]) @ homography
    centred = centred @ np.array([[1, 0, pp[0]], [0, 1, pp[1]], [0, 0, 1]])
    determinant = float(np.linalg.det(centred))
    if not abs(determinant) > 1e-12:
        return math.nan
    centred /= math.cbrt(determinant)  # a homography is given up to sign and scale
    logs = np.log(width) + np.linspace(math.log(_MIN_FOCAL_RATIO), math.log(_MAX_FOCAL_RATIO), 200)
    focal = np.exp(logs)
    scale = np.stack([focal, focal, np.ones_like(focal)], axis=-1)
    rotations = centred * scale[:, None, :] / scale[:, :, None]
    misfit = np.linalg.norm(rotations @ rotations.transpose(0, 2, 1) - np.eye(3), axis=(1, 2)) / 2
    best = int(misfit.argmin())
    angle = float(np.linalg.norm(rotations[best] - np.eye(3))) / math.sqrt(2)
    if best in (0, len(logs) - 1) or misfit[best] > _MAX_ROTATION_MISFIT * angle:
        return math.nan
    before, here, after = np.square(misfit[best - 1 : best + 2])
    shift = 0.5 * (before - after) / (before - 2 * here + after)
    return float(math.exp(logs[best] + float(np.clip(shift, -0.5, 0.5)) * (logs[1] - logs[0])))


def _sorted(
    values: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    order = np.argsort(values, kind="stable")
    return values[order], weights[order]


def _weighted_quantile(values: NDArray[np.float64], weights: NDArray[np.float64], q: float) -> float:
    """Of sorted values, linear between the middles of their weights."""
    middle = np.cumsum(weights) - 0.5 * weights
    return float(np.interp(q * weights.sum(), middle, values))
