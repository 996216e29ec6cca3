"""The verdict follows from what the SLAM stage reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vipe_core.annotation import Quality
from vipe_core.cameras import Camera
from vipe_core.quality import assess
from vipe_core.slam.diagnostics import LoopReport, MapReport
from vipe_core.slam.infill import Trajectory
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import SlamResult, ViewOfRig
from vipe_core.slam.working import WorkingSize
from vipe_core.slam.zoom import Zoom

_FRAMES, _KEYFRAMES = 40, 10
_WORKING = WorkingSize(320, 240)
_CELLS = _WORKING.grid.num_cells


def good_map(**changes: float) -> MapReport:
    each = np.ones(_KEYFRAMES, dtype=np.float32)
    report = MapReport(
        residual_px=0.1,
        inlier_ratio=0.99,
        coverage=0.9,
        weakest_link=0.6,
        parallax_deg=4.0,
        confidence=np.ones((_KEYFRAMES, _CELLS), dtype=np.float32),
        keyframe_residual_px=0.1 * each,
        keyframe_inlier_ratio=each,
        keyframe_coverage=each,
    )
    return replace(report, **changes)


def posed(interpolated: int = 0) -> Trajectory:
    """The first frames are interpolated."""
    ratio = np.ones(_FRAMES, dtype=np.float32)
    ratio[:interpolated] = 0
    labels = np.zeros((_FRAMES, 1), dtype=np.int8)
    return Trajectory(np.tile(np.eye(4), (_FRAMES, 1, 1)), 0.1 * ratio, ratio, ratio, ratio == 0, labels)


def good(**changes: object) -> SlamResult:
    result = SlamResult(
        world_from_cam=np.tile(np.eye(4), (_FRAMES, 1, 1)),
        trajectory=posed(),
        timestamps_s=np.arange(_FRAMES) / 30.0,
        cuts=(),
        keyframes=np.arange(_KEYFRAMES, dtype=np.int64) * 4,
        inverse_depth=np.ones((_KEYFRAMES, _CELLS), dtype=np.float32),
        static=np.ones((_KEYFRAMES, _CELLS), dtype=np.bool_),
        working=_WORKING,
        camera=Camera.pinhole_from_fov(60.0, 320, 240),
        motion="general",
        focal_sigma_ratio=0.01,
        map=good_map(),
        loops=LoopReport(3, 2.0, 0.5, 0.01),
        timings_s={},
    )
    return replace(result, **changes)


def verdict(result: SlamResult) -> Quality:
    return assess(result, SlamSettings(), source_width=640)


@pytest.mark.parametrize(
    ("view", "reliable", "reasons"),
    [
        (ViewOfRig(rotation_sigma_deg=0.2, place_sigma=0.01), "yes", ()),
        (ViewOfRig(rotation_sigma_deg=0.8, place_sigma=0.01), "doubtful", ("extrinsics_unobserved",)),
        (ViewOfRig(blind=True), "no", ("blind_view",)),
    ],
)
def test_a_view_of_a_rig_has_reasons_of_its_own(view: ViewOfRig, reliable: str, reasons: tuple[str, ...]) -> None:
    nothing = good_map(residual_px=float("nan"), inlier_ratio=0.0, coverage=0.0)
    quality = verdict(good(rig=view, map=nothing if view.blind else good_map()))
    assert (quality.reliable, quality.reasons) == (reliable, reasons)


def test_a_good_result_is_reliable_and_its_residual_is_in_source_pixels() -> None:
    quality = verdict(good())
    assert (quality.reliable, quality.reasons) == ("yes", ())
    assert quality.residual_px == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("result", "reason", "reliable"),
    [
        (good(motion="static"), "static_camera", "doubtful"),
        (good(motion="rotation"), "pure_rotation", "doubtful"),
        (good(map=good_map(parallax_deg=0.4)), "low_parallax", "doubtful"),
        (good(map=good_map(coverage=0.2)), "low_texture", "doubtful"),
        (good(map=good_map(residual_px=0.6)), "high_residual", "doubtful"),
        (good(map=good_map(residual_px=1.0)), "high_residual", "no"),
        (good(map=good_map(residual_px=0.6, inlier_ratio=0.8)), "low_inliers", "no"),
        (good(map=good_map(residual_px=float("nan"))), "high_residual", "no"),
        (good(map=good_map(inlier_ratio=0.85)), "low_inliers", "doubtful"),
        (good(map=good_map(inlier_ratio=0.5)), "low_inliers", "doubtful"),
        (good(map=good_map(inlier_ratio=0.3)), "low_inliers", "no"),
        (good(map=good_map(weakest_link=0.01)), "weak_link", "no"),
        (good(focal_sigma_ratio=0.2), "focal_unobservable", "doubtful"),
        (good(keyframes=np.arange(3, dtype=np.int64)), "few_keyframes", "doubtful"),
        (good(timestamps_s=np.arange(4) / 30.0), "few_frames", "doubtful"),
        (good(trajectory=posed(4)), "interpolated_frames", "doubtful"),
        (good(trajectory=posed(_FRAMES - 4)), "interpolated_frames", "no"),
        (good(cuts=(20,)), "shot_cut", "doubtful"),
    ],
)
def test_each_defect_is_named(result: SlamResult, reason: str, reliable: str) -> None:
    quality = verdict(result)
    assert reason in quality.reasons
    assert quality.reliable == reliable


def test_the_field_of_view_comes_with_an_interval_as_wide_as_the_focal_length_is_unsure() -> None:
    low, high = verdict(good()).fov_interval_deg
    # log(f) +- 0.0196 about 60 degrees: d fov = sin(fov) d log(f)
    assert (low, high) == pytest.approx((60 - 0.9726, 60 + 0.9726), abs=0.02)
    wider = verdict(good(focal_sigma_ratio=0.3)).fov_interval_deg
    assert wider[0] < 40 < 80 < wider[1] < 180


def test_the_summary_is_json_ready() -> None:
    summary = verdict(good(map=good_map(residual_px=float("nan")))).summary()
    assert summary["residual_px"] is None
    assert summary["reasons"] == ["high_residual"]


def test_what_is_known_of_each_frame_is_handed_on_in_source_pixels() -> None:
    quality = verdict(good(trajectory=posed(1)))
    frames = quality.per_frame()
    assert frames["interpolated_frames"] == [0]
    assert frames["frame_inlier_ratio"] == [0.0] + [1.0] * (_FRAMES - 1)
    assert frames["frame_residual_px"] == [0.0] + [0.2] * (_FRAMES - 1)
    summary = quality.summary()
    assert (summary["num_interpolated"], summary["loop_edges"], summary["loop_residual_before_px"]) == (1, 3, 4.0)


def test_a_zoom_is_reported_with_its_ratio() -> None:
    quality = verdict(good(zoom=Zoom(1.4, 0.02)))
    assert (quality.reliable, quality.reasons, quality.zoom_ratio) == ("doubtful", ("zoom",), 1.4)
    assert quality.summary()["zoom_ratio"] == 1.4
    unsure = verdict(good(zoom=Zoom(1.4, 0.2)))
    assert (unsure.reasons, unsure.zoom_ratio) == ((), 1.0)


def test_the_focal_length_of_a_given_camera_is_known_though_it_stands_still() -> None:
    assert "focal_unobservable" in verdict(good(motion="static")).reasons
    assert "focal_unobservable" not in verdict(good(motion="static", focal_sigma_ratio=0.0)).reasons
