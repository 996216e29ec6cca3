"""Focal length from pairs of frames: shared-focal 6-point RANSAC and a robust vote.

Each pair gives a focal length (minimal solver of Kukelova et al., ECCV 2008, as found in PoseLib) and a weight that
tells how much better an essential matrix explains it than a homography: without parallax the focal length of a pair
is not observable. The answer is the weighted median; its sigma comes from how well the pairs agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.priors.classical.claims import FocalClaim
from vipe_core.priors.classical.pairs import FramePair, PairPicker
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.statistics import weighted_median, weighted_spread

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
        source, target: Positions in the sequence of frames.
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

    Args:
        picker: Where the pairs come from.
    """

    def __init__(self, picker: PairPicker | None = None) -> None:
        self._picker = picker or PairPicker()

    def claim(self, frames: Sequence[WorkingFrame]) -> FocalClaim | None:
        """Weighted median of the votes; None when no pair shows parallax or a rotation."""
        return _claim(self.votes(frames))

    def votes(self, frames: Sequence[WorkingFrame]) -> list[FocalVote]:
        """One vote for each pair that could be solved."""
        if not frames:
            return []
        height, width = frames[0].gray.shape
        votes = [_vote(pair, width, height) for pair in self._picker.pairs(frames)]
        return [vote for vote in votes if vote is not None]


def _vote(pair: FramePair, width: int, height: int) -> FocalVote | None:
    first, second = pair.source_px, pair.target_px
    trust = min(1.0, pair.consistent / _FULL_CONSISTENCY)
    ransac = {
        "max_iterations": 1000,
        "min_iterations": 200,
        "max_epipolar_error": 1.0,
        "max_reproj_error": 1.0,
        "seed": 0,
    }
    pp = np.array([(width - 1) / 2, (height - 1) / 2])
    solved, report = poselib.estimate_shared_focal_relative_pose(first, second, pp, ransac, {})
    homography, flat = poselib.estimate_homography(first, second, ransac, {})
    focal = float(solved.camera1.focal())
    inliers, flat_inliers = float(report["inlier_ratio"]), float(flat["inlier_ratio"])
    if not math.isfinite(focal) or not _MIN_FOCAL_RATIO * width < focal < _MAX_FOCAL_RATIO * width:
        return None
    turned = math.nan
    if flat_inliers * trust > _ALL_FLAT:
        turned = _rotation_focal(np.asarray(homography, np.float64), pp, width)
    weight = inliers * max(0.0, 1 - flat_inliers) * trust
    return FocalVote(pair.source, pair.target, focal, weight, pair.motion_px, turned)


def _claim(votes: Sequence[FocalVote]) -> FocalClaim | None:
    """Weighted median of log(f), an honest sigma, and the number of votes behind them.

    Without parallax, rotations vote in place of the pairs. Pairs that contradict each other (forward driving, moving
    objects) make the sigma wide.
    """
    weights = np.array([v.weight for v in votes])
    turned = np.array([v.rotation_focal_px for v in votes])
    turned = turned[np.isfinite(turned)]
    if weights.sum() >= _MIN_TOTAL_WEIGHT * max(1, len(weights)):
        log_focal = np.log([v.focal_px for v in votes])
        floor = _MIN_LOG_SIGMA
    elif len(turned) >= _MIN_ROTATIONS:
        log_focal, weights = np.log(turned), np.full(len(turned), 0.5)
        floor = _MIN_ROTATION_LOG_SIGMA
    else:
        return None
    median = weighted_median(log_focal, weights)
    spread = weighted_spread(log_focal, weights, median)
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
