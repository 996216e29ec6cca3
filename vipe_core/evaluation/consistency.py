"""Errors that need no ground truth (paper section 4.1, "Camera pose consistency metrics"): shuttle and Sampson.

Shuttle: the video is annotated forwards and backwards; the two paths, each scaled to length 1, are compared after a
rigid alignment, and the two fields of view with one another. Sampson: how far, to first order, points matched in
consecutive frames lie from the epipolar lines of the estimated poses and camera; the mean over the matches of a pair,
then over the pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.cameras.epipolar import RaySlopes, essential_matrix, sampson_distances
from vipe_core.evaluation.matching import PointMatcher
from vipe_core.evaluation.metrics import trajectory_errors
from vipe_core.geometry.arrays import inverse
from vipe_core.video.source import FrameSource

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class ShuttleErrors:
    """How far the forward and the backward run are apart. None where the forward path does not move.

    Attributes:
        ate: S-ATE, RMS distance of the camera centres, in path lengths.
        rte: S-RTE, RMS translation error of consecutive frames, in path lengths.
        rre_deg: S-RRE, RMS rotation error of consecutive frames.
        fov_deg: S-Focal, absolute difference of the horizontal fields of view.
    """

    ate: float | None
    rte: float | None
    rre_deg: float | None
    fov_deg: float


@dataclass(frozen=True, slots=True)
class SampsonErrors:
    """Epipolar errors, pixels of the source video.

    Attributes:
        mean_px: The paper's: mean over pairs of the mean over matches.
        median_px: Median over pairs of the median over matches: what false matches and moving things do not touch.
        pairs: Pairs of consecutive frames that were measured.
        matches: Matches in all of them.
        matcher: Whose matches.
    """

    mean_px: float
    median_px: float
    pairs: int
    matches: int
    matcher: str


def shuttle_errors(
    forward: NDArray[np.float64], forward_camera: Camera, backward: NDArray[np.float64], backward_camera: Camera
) -> ShuttleErrors:
    """Compares a run over a video with one over its reverse.

    Args:
        forward: (N, 4, 4) world_from_cam in order of the video.
        backward: (N, 4, 4) world_from_cam in order of the reversed video.

    Raises:
        ValueError: They have different lengths, or fewer than two frames.
    """
    errors = trajectory_errors(unit_length(backward[::-1]), unit_length(forward), with_scale=False)
    return ShuttleErrors(
        ate=errors.ate_rmse,
        rte=errors.rte_rmse,
        rre_deg=errors.rre_rmse_deg,
        fov_deg=abs(forward_camera.fov_x_deg - backward_camera.fov_x_deg),
    )


def unit_length(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """The poses with positions scaled so that the path has length 1; a camera that stands still is left as it is."""
    length = float(np.linalg.norm(np.diff(world_from_cam[:, :3, 3], axis=0), axis=1).sum())
    scaled = world_from_cam.copy()
    if length > 0:
        scaled[:, :3, 3] /= length
    return scaled


def sampson_px(
    second_from_first: NDArray[np.float64],
    camera: Camera,
    first_px: NDArray[np.float64],
    second_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(K,) Sampson distances in pixels of matches (K, 2) and (K, 2), integer-index coordinates; of a pinhole the
    paper's formula, of another camera the same with epipolar curves in place of lines.

    Args:
        second_from_first: (4, 4) with a translation.
    """
    rays = (RaySlopes.of(camera, px) for px in (first_px, second_px))
    return np.abs(sampson_distances(essential_matrix(second_from_first), *rays))


def sampson_errors(
    source: FrameSource,
    world_from_cam: NDArray[np.float64],
    camera: Camera,
    matcher: PointMatcher,
    report: Callable[[int], None] = lambda done: None,
) -> SampsonErrors | None:
    """Measures all pairs of consecutive frames at full resolution; holds two frames at a time.

    Args:
        world_from_cam: (N, 4, 4) of the first N frames of the source.
        camera: At the source's resolution.
        report: Told how many frames are done.

    Returns:
        None when no pair can be measured: nothing matches, or the camera never moves, when there is no epipolar line.

    Raises:
        InputError, DecodeError: From the source.
    """
    means: list[float] = []
    medians: list[float] = []
    matches = 0
    previous: Any = None
    cam_from_world = inverse(world_from_cam)
    with closing(source.frames(stop=len(world_from_cam))) as frames:
        for frame in frames:
            current = matcher.detect(frame.rgb)
            if previous is not None:
                relative = cam_from_world[frame.index] @ world_from_cam[frame.index - 1]
                first_px, second_px = matcher.match(previous, current)
                if len(first_px) and np.linalg.norm(relative[:3, 3]) > 0:
                    distance = sampson_px(relative, camera, first_px, second_px)
                    means.append(float(distance.mean()))
                    medians.append(float(np.median(distance)))
                    matches += len(distance)
            previous = current
            report(frame.index + 1)
    if not means:
        return None
    return SampsonErrors(float(np.mean(means)), float(np.median(medians)), len(means), matches, matcher.name)
