"""The affine map from video depth to the inverse depth of the scene, frame by frame and smooth over time.

Paper, section 3.3: per frame, y = alpha x + beta in inverse depth by least squares over where the map is seen, with
momentum over frames. Here the fit is robust, and the momentum is a Kalman filter over (alpha, beta): a frame counts as
much as it knows. So nothing is switched where a frame shows too small a range of depth to tell alpha from beta, or no
map at all: what it does not tell, the frames around it do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.statistics import MAD_TO_SIGMA, weighted_median

Array = NDArray[Any]
Affine = tuple[float, float]
Regime = Literal["affine", "scale"]

_SEED, _HYPOTHESES, _JUDGES = 17, 200, 1500
# Relative errors: at which a sample is half lost to a hypothesis, and the least and most that are taken for noise.
_HALF_LOST, _LEAST_SIGMA, _MOST_SIGMA = 0.04, 0.01, 0.1
# The hypothesis that the frames before lead to is only left for one whose cost is lower than so much of its own.
_LOYALTY = 0.95
# Errors of inverse depth grow with it, from a floor that is this share of the median.
_FLOOR = 0.3
_ITERATIONS, _WIDTH = 8, 2.5
# What holds a fit that its samples leave open: standard deviations of alpha (relative) and beta (over the median).
_LOOSE_SCALE, _LOOSE_SHIFT = 1.0, 0.3
# A frame that tells beta to better than this share of the median is fitted with both numbers.
_KNOWN_SHIFT = 0.1
# Power of the explained share of the variance by which the slope is trusted: a third of it where the range of depth is
# three times the noise.
_FLATNESS = 8
# Squared Mahalanobis distance that two numbers hardly ever exceed, and frames in a row that must before it is believed.
_SURPRISE, _PATIENCE = 12.0, 3


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """Parameters of the alignment.

    Attributes:
        drift_ratio: How much the scale of video depth changes from a frame to the next, standard deviation.
        lag_frames: Later frames that a frame's alignment is smoothed with.
    """

    drift_ratio: float = 0.02
    lag_frames: int = 8


@dataclass(frozen=True, slots=True)
class Samples:
    """Where video depth meets the scene in one frame.

    Attributes:
        video: (n,) the video depth's inverse depth.
        scene: (n,) inverse depth of the scene, positive, of the same kind.
        weight: (n,) not negative; together, how many independent measurements the samples are worth, which are far
            fewer than there are: neighbours share their errors.
    """

    video: NDArray[np.float64]
    scene: NDArray[np.float64]
    weight: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the samples of one frame say.

    Attributes:
        information: (2, 2) inverse covariance of (alpha, beta), singular where the frame does not tell them apart.
        vector: (2,) information times the estimate.
        median: Median inverse depth of the samples.
        sigma: Relative standard deviation of what fits.
        inliers: Share of the weight that fits.
        regime: Whether the frame tells both numbers or only their sum at its depth.
    """

    information: NDArray[np.float64]
    vector: NDArray[np.float64]
    median: float
    sigma: float
    inliers: float
    regime: Regime

    def solution(self, start: Affine) -> Affine:
        """(alpha, beta) of this frame by itself; what it leaves open is as in `start`."""
        weak = 1e-6 * np.diag(np.diag(self.information))
        alpha, beta = np.linalg.solve(self.information + weak, self.vector + weak @ np.array(start))
        return float(alpha), float(beta)


def guess(video: Array, median: float) -> Affine:
    """An affine map that makes any video depth positive with a given median, where nothing else is known."""
    values = video[np.isfinite(video)]
    if not len(values):
        return 1.0, median
    low, middle = (float(value) for value in np.quantile(values, (0.01, 0.5)))
    if middle > 0 and low > -0.1 * middle:
        return median / middle, 0.0
    if middle - low < 1e-9 * max(abs(middle), 1e-9):
        return 1e-9, median
    return 0.9 * median / (middle - low), median - 0.9 * median / (middle - low) * middle


def measure(samples: Samples, start: Affine) -> Measurement | None:
    """Robust fit of one frame.

    The best of many hypotheses from two samples each, from one, and `start`, is refined with the weights of Geman and
    McClure; errors are relative to the inverse depth, so that near and far count alike.

    Returns:
        None where there is nothing to fit.
    """
    use = np.isfinite(samples.video) & (samples.scene > 0) & (samples.weight > 0)
    x, y, w = samples.video[use], samples.scene[use], samples.weight[use]
    if len(x) < 3:
        return None
    median = weighted_median(y, w)
    best = _best_hypothesis(x, y, w, median, start)
    u = np.stack((x, np.ones_like(x)), axis=-1)
    loose = np.array([1 / (_LOOSE_SCALE * max(abs(start[0]), 1e-12)) ** 2, 1 / (_LOOSE_SHIFT * median) ** 2])
    theta = np.array(best)
    information, vector, sigma, inliers = np.zeros((2, 2)), np.zeros(2), _LEAST_SIGMA, 0.0
    s = weight = np.ones_like(x)
    for _ in range(_ITERATIONS):
        expected = u @ theta
        s = np.maximum(expected, 0) + _FLOOR * median
        error = (expected - y) / s
        # The error of a hypothesis that most samples contradict is not noise.
        sigma = min(max(MAD_TO_SIGMA * weighted_median(np.abs(error), w), _LEAST_SIGMA), _MOST_SIGMA)
        kernel = 1 / np.square(1 + np.square(error / (_WIDTH * sigma)))
        inliers = float((w * kernel).sum() / w.sum())
        weight = w * kernel / np.square(s * sigma)
        information = (u * weight[:, None]).T @ u
        vector = u.T @ (weight * y)
        theta = np.linalg.solve(information + np.diag(loose), vector + loose * np.array(best))
        if theta[0] <= 0:
            # Nearer is larger in both: what says otherwise is a scene too flat for its noise.
            theta = np.array((best[0], (weight @ y) / weight.sum() - best[0] * (weight @ x) / weight.sum()))
    # Noise of the video depth flattens the slope that is found, so of a scene whose range of depth is small against the
    # noise, only the middle is taken: one number for the two.
    middle, mean = weight @ u / weight.sum(), float(weight @ y / weight.sum())
    spread = float(weight @ np.square(y - mean))
    noise = float(weight @ np.square(np.maximum(np.abs(u @ theta - y), _LEAST_SIGMA * s)))
    trust = max(0.0, 1 - noise / spread) ** _FLATNESS if spread > 0 else 0.0
    information = trust * information + (1 - trust) * weight.sum() * np.outer(middle, middle)
    vector = trust * vector + (1 - trust) * middle * float(weight @ y)
    covariance = np.linalg.inv(information + np.diag(loose))
    regime: Regime = "affine" if covariance[1, 1] < (_KNOWN_SHIFT * median) ** 2 else "scale"
    return Measurement(information, vector, median, sigma, inliers, regime)


def _best_hypothesis(x: Array, y: Array, w: Array, median: float, start: Affine) -> Affine:
    rng = np.random.default_rng(_SEED)
    chosen = rng.integers(0, len(x), (_HYPOTHESES, 2))
    dx, dy = x[chosen[:, 1]] - x[chosen[:, 0]], y[chosen[:, 1]] - y[chosen[:, 0]]
    spread = float(np.ptp(x))
    sound = np.abs(dx) > 0.05 * spread if spread > 0 else np.zeros(len(dx), np.bool_)
    alpha = dy[sound] / dx[sound]
    beta = y[chosen[sound, 0]] - alpha * x[chosen[sound, 0]]
    # Nearer is larger in both.
    rising = alpha > 0
    middle = weighted_median(x, w)
    alone = [(median / middle, 0.0)] if middle > 0 else []
    alpha = np.concatenate(([start[0]], [a for a, _ in alone], alpha[rising]))
    beta = np.concatenate(([start[1]], [b for _, b in alone], beta[rising]))
    judges = rng.permutation(len(x))[:_JUDGES]
    expected = alpha[:, None] * x[judges] + beta[:, None]
    # Geman-McClure, as in the refinement: without a bound up to which all errors are fine, flat scenes do not favour
    # flat answers.
    error = np.square((expected - y[judges]) / ((np.maximum(expected, 0) + _FLOOR * median) * _HALF_LOST))
    cost = (error / (1 + error)) @ w[judges]
    cost[0] *= _LOYALTY
    best = int(cost.argmin())
    return float(alpha[best]), float(beta[best])


@dataclass(frozen=True, slots=True)
class _State:
    """A frame's (alpha, beta) before and after its own measurement, with covariances."""

    before: NDArray[np.float64]
    before_covariance: NDArray[np.float64]
    after: NDArray[np.float64]
    after_covariance: NDArray[np.float64]


class AffineTrack:
    """(alpha, beta) of the frames of one shot, each weighed by what it knows; smoothed once later frames are known.

    Args:
        drift_ratio: Standard deviation of the change of scale from one frame to the next; that of the shift, over the
            median inverse depth, is the same.
    """

    def __init__(self, drift_ratio: float) -> None:
        self._drift = drift_ratio
        self._states: list[_State] = []
        self._median = 1.0
        self._surprised = 0
        self._known = False

    def predicted(self, video: Array, median: float) -> Affine:
        """Where the next frame should be: where the last one was, or a guess for the first of a shot."""
        if not self._states:
            return guess(video, median)
        return float(self._states[-1].after[0]), float(self._states[-1].after[1])

    def add(self, start: Affine, measurement: Measurement | None, median: float) -> None:
        """Take a frame.

        Args:
            start: What `predicted` said of it.
            measurement: None where the frame shows nothing of the scene.
            median: Typical inverse depth of the scene.
        """
        self._median = median if measurement is None else measurement.median
        if self._states:
            mean = self._states[-1].after
            covariance = self._states[-1].after_covariance + self._noise(mean)
        else:
            mean = np.array(start)
            covariance = np.diag([(_LOOSE_SCALE * start[0]) ** 2, (_LOOSE_SHIFT * self._median) ** 2])
        if measurement is not None and not self._known:
            # Guesses of frames that nothing was known of are no reason to doubt the first that something is.
            covariance = np.diag([(2 * start[0]) ** 2, self._median**2])
            self._known = True
            # The frames before it, if any, follow it: their guesses were as unsure.
            self._states = [_State(s.before, covariance, s.after, covariance) for s in self._states]
        if measurement is None:
            self._states.append(_State(mean, covariance, mean, covariance))
            return
        information, vector = measurement.information, measurement.vector
        surprise = _surprise(mean, covariance, information, vector)
        self._surprised = self._surprised + 1 if surprise > _SURPRISE else 0
        if self._surprised >= _PATIENCE:
            # Not one odd frame: the video depth has changed. What was known before counts for less.
            covariance = covariance * (surprise / _SURPRISE)
        elif self._surprised:
            doubt = (_SURPRISE / surprise) ** 2
            information, vector = information * doubt, vector * doubt
        prior = np.linalg.inv(covariance)
        after_covariance = np.asarray(np.linalg.inv(prior + information), np.float64)
        after = after_covariance @ (prior @ mean + vector)
        self._states.append(_State(mean, covariance, after, after_covariance))

    def smoothed_first(self) -> tuple[Affine, float]:
        """(alpha, beta) of the oldest frame that is held, in the light of all later ones (Rauch, Tung and Striebel),
        and the relative standard deviation of the median inverse depth that they give."""
        mean, covariance = self._states[-1].after, self._states[-1].after_covariance
        for state, later in zip(self._states[-2::-1], self._states[:0:-1], strict=True):
            gain = state.after_covariance @ np.linalg.inv(later.before_covariance)
            mean = state.after + gain @ (mean - later.before)
            covariance = state.after_covariance + gain @ (covariance - later.before_covariance) @ gain.T
        alpha, beta = float(mean[0]), float(mean[1])
        at = np.array([(self._median - beta) / alpha if alpha > 0 else 0.0, 1.0])
        sigma = float(np.sqrt(max(at @ covariance @ at, 0))) / self._median
        return (alpha, beta), sigma

    def drop_first(self) -> None:
        """Forget the oldest frame; the newest one is always kept."""
        if len(self._states) > 1:
            del self._states[0]

    def _noise(self, mean: Array) -> NDArray[np.float64]:
        """Covariance of the change from frame to frame: both numbers together, and each a little by itself."""
        together = np.outer(mean, mean) * self._drift**2
        alone = np.diag([(0.3 * self._drift * mean[0]) ** 2, (self._drift * self._median) ** 2])
        return np.asarray(together + alone)


def _surprise(mean: Array, covariance: Array, information: Array, vector: Array) -> float:
    """Squared Mahalanobis distance of a measurement from a prediction, in the directions that it measures."""
    residual = vector - information @ mean
    spread = information + information @ covariance @ information
    # Along what is not measured both are 0, up to rounding.
    return float(residual @ np.linalg.pinv(spread, rcond=1e-10, hermitian=True) @ residual)


def apply(video: Array, affine: Affine, least: float) -> NDArray[np.float32]:
    """alpha x + beta, at least `least`."""
    return np.asarray(np.maximum(np.float32(affine[0]) * video + np.float32(affine[1]), least), np.float32)
