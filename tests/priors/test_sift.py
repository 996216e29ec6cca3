"""Sparse correspondences against exact geometry, masks, and pictures that hold nothing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from box_room import BoxRoom, look

from vipe_core.priors.classical import DisFlowMatcher, FlowFeatures, SiftMatcher
from vipe_core.priors.protocols import WorkingFrame


@pytest.fixture(scope="module")
def room() -> BoxRoom:
    return BoxRoom()


def features(rgb: np.ndarray, valid: np.ndarray | None = None) -> FlowFeatures:
    return DisFlowMatcher().encode(WorkingFrame(0, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), rgb, valid))


def test_correspondences_of_a_wide_step_are_right(room: BoxRoom) -> None:
    source, target = look((-0.5, 0, -3), yaw_deg=10), look((0.7, 0.1, -3), yaw_deg=-14)
    points = SiftMatcher().correspond(features(room.render(source)[0]), features(room.render(target)[0]))
    truth, visible = room.flow_px(source, target, points.source_px.astype(np.float64))
    error = np.linalg.norm(points.target_px - truth, axis=1)
    assert len(points) > 60
    assert np.median(np.linalg.norm(points.target_px - points.source_px, axis=1)) > 40
    assert np.median(error[visible]) < 1.0
    assert (error[visible] < 3).mean() > 0.9


def test_nothing_is_found_on_masked_pixels(room: BoxRoom) -> None:
    rgb = room.render(look((0, 0, -3)))[0]
    valid = np.ones(rgb.shape[:2], bool)
    valid[:, : rgb.shape[1] // 2] = False
    masked = features(rgb, valid)
    assert len(masked.keypoints) > 20
    assert (masked.keypoints.points_px[:, 0] > rgb.shape[1] // 2 - 2).all()


def test_pictures_without_a_common_scene_have_no_correspondences(room: BoxRoom) -> None:
    blank = features(np.full((120, 160, 3), 90, np.uint8))
    textured = features(room.render(look((0, 0, -3)))[0])
    matcher = SiftMatcher()
    assert len(matcher.correspond(blank, textured)) == len(matcher.correspond(textured, blank)) == 0
    assert len(matcher.overview(blank)) == 0


def test_keypoints_of_a_large_picture_lie_where_those_of_a_small_one_do(room: BoxRoom) -> None:
    rgb = room.render(look((0, 0, -3)))[0]
    small = features(rgb).keypoints.points_px
    large = features(cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)).keypoints.points_px
    nearest = np.linalg.norm(large[:, None] - (2 * small[None] + 0.5), axis=-1).min(axis=1)
    assert np.median(nearest) < 0.5
    assert large[:, 0].max() > 1.5 * rgb.shape[1]


def test_overview_holds_unit_vectors(room: BoxRoom) -> None:
    found = features(room.render(look((0, 0, -3)))[0])
    np.testing.assert_allclose(np.linalg.norm(SiftMatcher().overview(found), axis=1), 1, atol=1e-3)
