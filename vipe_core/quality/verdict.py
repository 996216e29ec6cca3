"""The verdict on a result, with reasons. Everything is judged from the result itself; no ground truth is involved.

Reason codes are stable: they are stored with every video.

    few_frames          fewer frames than the initialisation wants
    few_keyframes       the camera moved too little for a well-connected graph
    static_camera       no camera motion: poses are identity, depth and focal length are not measured
    pure_rotation       no parallax: rotations are measured, positions and depth are not
    low_parallax        little parallax: positions and depth are weak
    low_texture         most of the picture could not be measured
    focal_unobservable  the field of view is not known to 10 %, or nothing but single pictures tells it
    zoom                the focal length changes within a shot, but the result has one: depth and path are bent
    high_residual       the measurements that fit, fit badly
    low_inliers         much of the picture contradicts the camera motion (moving objects, or a wrong solution)
    weak_link           two parts of a shot hang together by almost nothing: a blur, a jump
    shot_cut            the video has cuts: shots are right by themselves, what lies between them is not measured
    interpolated_frames frames whose own pose fit failed, or that show nothing
    blind_view          a view of a rig that shows nothing, or stands still while the others move: its poses are those
                        that the others found, and nothing measures its depth
    extrinsics_unobserved  the recording does not say how this view of a rig is turned against the first: it was to be
                        refined, but its rotation is hardly surer than before
"""

from __future__ import annotations

import math

import numpy as np

from vipe_core.annotation import Quality, Reliability
from vipe_core.slam.diagnostics import MapReport
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import SlamResult

_MIN_FRAMES = 8
_MIN_KEYFRAMES = 5
_LOW_PARALLAX_DEG = 1.0
_LOW_COVERAGE = 0.35
_HIGH_RESIDUAL_RATIO = 0.8 / 640
# A residual of so many times that is no fit at all.
_VERY_HIGH = 2.0
_MATCHING_NOISE_PX = 0.3
_LOW_INLIERS = 0.9
_VERY_LOW_INLIERS = 0.4
_WEAK_LINK = 0.08
_MAX_INTERPOLATED = 0.02
_MOSTLY_INTERPOLATED = 0.5
# Half a degree is a tenth of the picture of a telephoto lens, and 9 cm at ten metres.
_UNOBSERVED_ROTATION_DEG = 0.5
# A sigma of log(f) beyond this says nothing more.
_NO_IDEA = 1.0


def assess(result: SlamResult, settings: SlamSettings, source_width: int) -> Quality:
    """Judge a SLAM result.

    Args:
        source_width: Width of the source video; residuals are reported in its pixels.
    """
    found = result.map
    # Its lens is no question, and its faces, enlarged to its own pixels, are 1 / 2.75 of its width.
    panorama = result.camera.model == "equirect"
    reasons: list[str] = []
    fatal = False
    if len(result.timestamps_s) < _MIN_FRAMES:
        reasons.append("few_frames")
    if result.motion == "static":
        reasons.append("static_camera")
    else:
        if len(result.keyframes) < _MIN_KEYFRAMES:
            reasons.append("few_keyframes")
        if result.motion == "rotation":
            reasons.append("pure_rotation")
        elif found.parallax_deg < _LOW_PARALLAX_DEG:
            reasons.append("low_parallax")
        if result.rig is not None and result.rig.blind:
            reasons.append("blind_view")
            fatal = True
        else:
            width = result.working.width / (2.75 if panorama else 1)
            misfits, fatal = _misfits(found, max(_MATCHING_NOISE_PX, _HIGH_RESIDUAL_RATIO * width))
            reasons += misfits
        if found.weakest_link < _WEAK_LINK:
            reasons.append("weak_link")
            fatal = True
    if result.rig is not None and result.rig.rotation_sigma_deg > _UNOBSERVED_ROTATION_DEG:
        reasons.append("extrinsics_unobserved")
    if result.zoom.changes:
        reasons.append("zoom")
    if result.cuts:
        reasons.append("shot_cut")
    interpolated = float(result.trajectory.interpolated.mean())
    if interpolated > _MAX_INTERPOLATED:
        reasons.append("interpolated_frames")
        fatal = fatal or interpolated > _MOSTLY_INTERPOLATED
    low_deg, high_deg = _fov_interval_deg(result)
    # Lines may tell the focal length of a camera that never moves, but nothing then confirms it. A given one needs that
    # not.
    unconfirmed = result.motion == "static" and result.focal_sigma_ratio > 0
    doubt_deg = 2 * settings.fov_doubt_ratio * result.camera.fov_x_deg
    if not panorama and (unconfirmed or high_deg - low_deg > doubt_deg):
        reasons.append("focal_unobservable")
    reliable: Reliability = "no" if fatal else "doubtful" if reasons else "yes"
    to_source = source_width / result.working.width
    return Quality(
        reliable=reliable,
        reasons=tuple(reasons),
        residual_px=found.residual_px * to_source,
        inlier_ratio=found.inlier_ratio,
        coverage=found.coverage,
        parallax_deg=found.parallax_deg,
        focal_sigma_ratio=result.focal_sigma_ratio,
        fov_interval_deg=(low_deg, high_deg),
        frame_inlier_ratio=result.trajectory.inlier_ratio,
        frame_residual_px=(result.trajectory.residual_px * to_source).astype(np.float32),
        frame_coverage=result.trajectory.coverage,
        frame_interpolated=result.trajectory.interpolated,
        cuts=result.cuts,
        zoom_ratio=result.zoom.ratio if result.zoom.changes else 1.0,
        loop_edges=result.loops.edges,
        loop_residual_before_px=result.loops.residual_before_px * to_source,
        loop_residual_after_px=result.loops.residual_after_px * to_source,
        loop_moved_ratio=result.loops.moved_ratio,
    )


def _misfits(found: MapReport, high_px: float) -> tuple[list[str], bool]:
    """What of the picture was not measured or does not fit, and whether that leaves nothing to rely on."""
    reasons, fatal = [], False
    if found.coverage < _LOW_COVERAGE:
        reasons.append("low_texture")
    # Written so that a NaN residual, of a map without a single measurement, counts as high.
    if not found.residual_px <= high_px:
        reasons.append("high_residual")
        fatal = not found.residual_px <= _VERY_HIGH * high_px
    if found.inlier_ratio < _LOW_INLIERS:
        reasons.append("low_inliers")
        fatal = fatal or found.inlier_ratio < _VERY_LOW_INLIERS
    # Each of them can have an honest cause (walls, moving things, a bad lens); together they say that nothing fits.
    return reasons, fatal or len(reasons) > 1


def _fov_interval_deg(result: SlamResult) -> tuple[float, float]:
    """The field of view for the focal length's 95 % interval, in which log(f) is taken to be normal."""
    camera = result.camera
    half = math.exp(1.96 * min(result.focal_sigma_ratio, _NO_IDEA))
    return camera.zoomed(half).fov_x_deg, camera.zoomed(1 / half).fov_x_deg
