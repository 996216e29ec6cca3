"""The classical priors against exact flow, exact focal lengths, masks, and inputs that hold nothing to measure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from box_room import BoxRoom, look
from numpy.typing import NDArray

from vipe_core.priors.classical import (
    CombinedFocalInit,
    DisFlowMatcher,
    LkTracker,
    PatchAligner,
    TwoViewFocal,
    classical_priors,
)
from vipe_core.priors.classical.features import FlowFeatures, cell_centres_px, grid_of
from vipe_core.priors.protocols import WorkingFrame


@pytest.fixture(scope="module")
def room() -> BoxRoom:
    return BoxRoom()


def frame(rgb: np.ndarray, index: int = 0, valid: np.ndarray | None = None) -> WorkingFrame:
    return WorkingFrame(index, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), rgb, valid)


def pair(room: BoxRoom, source: np.ndarray, target: np.ndarray):
    matcher = DisFlowMatcher()
    a, b = (matcher.encode(frame(room.render(pose)[0], k)) for k, pose in enumerate((source, target)))
    truth, visible = room.flow_px(source, target, cell_centres_px(a.grid).astype(np.float64))
    return matcher, a, b, truth, visible


@pytest.mark.parametrize(("fine", "error_px"), [(True, 0.2), (False, 0.2)])
def test_match_is_accurate_and_occluded_or_outside_cells_have_no_weight(
    room: BoxRoom, fine: bool, error_px: float
) -> None:
    source, target = look((0, 0, -3)), look((0.45, 0.05, -2.9), yaw_deg=-2)
    _, a, b, truth, visible = pair(room, source, target)
    matcher = DisFlowMatcher(fine=fine)
    forward, backward = matcher.match(a, b)
    error = np.linalg.norm(forward.target_px - truth, axis=1)
    weight = forward.weight.max(axis=1)
    good = visible & (weight > 0.2)
    assert good.sum() > 0.7 * visible.sum()
    assert np.median(error[good]) < error_px
    assert np.quantile(error[good], 0.9) < 3 * error_px
    assert weight[~visible].mean() < 0.15 * weight[visible].mean()
    outside = ((truth < -1) | (truth > (room.width, room.height))).any(axis=1)
    assert outside.any()
    assert weight[outside].mean() < 0.05
    assert forward.consistent > 0.7
    truth_back, visible_back = room.flow_px(target, source, cell_centres_px(b.grid).astype(np.float64))
    error_back = np.linalg.norm(backward.target_px - truth_back, axis=1)
    assert np.median(error_back[visible_back & (backward.weight.max(1) > 0.2)]) < error_px


def test_match_fast_is_close_to_match(room: BoxRoom) -> None:
    matcher, a, b, truth, visible = pair(room, look((0, 0, -3)), look((0.25, 0.0, -3)))
    fast = matcher.match_fast(a, b)
    good = visible & (fast.weight.max(axis=1) > 0.2)
    assert good.sum() > 0.6 * visible.sum()
    assert np.median(np.linalg.norm(fast.target_px - truth, axis=1)[good]) < 0.4


def test_guess_carries_motion_that_is_too_wide_without_it(room: BoxRoom) -> None:
    matcher, a, b, truth, visible = pair(room, look((-0.5, 0, -3), yaw_deg=10), look((0.7, 0.1, -3), yaw_deg=-14))
    rough = truth + 5 * np.sin(cell_centres_px(a.grid) / 50)
    rough[::17] = np.nan  # cells that the current geometry puts behind the camera

    def share_below_a_pixel(match) -> float:
        error = np.linalg.norm(match.target_px - truth, axis=1)
        return float(np.mean((error < 1)[visible] & (match.weight.max(1) > 0.2)[visible]))

    without, guided = (share_below_a_pixel(matcher.match(a, b, g)[0]) for g in (None, rough))
    assert guided > 0.5
    assert guided > without + 0.1
    assert share_below_a_pixel(matcher.match_fast(a, b, rough)) > 0.3


def test_motion_is_the_median_displacement(room: BoxRoom) -> None:
    matcher, a, b, truth, _ = pair(room, look((0, 0, -3)), look((0.2, 0, -3)))
    expected = np.median(np.linalg.norm(truth - cell_centres_px(a.grid), axis=1)[a.textured_cells])
    assert matcher.motion_px(a, b) == pytest.approx(expected, rel=0.1)
    assert matcher.motion_px(a, a) < 0.1


def test_masks_of_source_and_target_are_honoured(room: BoxRoom) -> None:
    source, target = look((0, 0, -3)), look((0.2, 0, -3))
    matcher = DisFlowMatcher()
    left = np.ones((room.height, room.width), bool)
    left[:, :100] = False
    top = np.ones_like(left)
    top[:80] = False
    a = matcher.encode(frame(room.render(source)[0], 0, left))
    b = matcher.encode(frame(room.render(target)[0], 1, top))
    forward, backward = matcher.match(a, b)
    track = LkTracker().match(a, b, forward)
    centres = cell_centres_px(a.grid)
    for match in (forward, track):
        used = match.weight.max(axis=1) > 0
        assert used.any()
        assert centres[used, 0].min() >= 100
        assert match.target_px[used, 1].min() >= 80
    used = backward.weight.max(axis=1) > 0
    assert centres[used, 1].min() >= 80
    assert backward.target_px[used, 0].min() >= 100


def test_everything_masked_gives_no_weight_and_no_motion(room: BoxRoom) -> None:
    matcher = DisFlowMatcher()
    rgb, _ = room.render(look((0, 0, -3)))
    blind = matcher.encode(frame(rgb, 0, np.zeros(rgb.shape[:2], bool)))
    seen = matcher.encode(frame(rgb, 1))
    forward, backward = matcher.match(blind, seen)
    assert not forward.weight.any()
    assert not backward.weight.any()
    assert not LkTracker().match(blind, seen, forward).weight.any()
    assert matcher.motion_px(blind, seen) == 0


def test_blank_frames_do_not_fail_and_carry_almost_no_weight() -> None:
    matcher = DisFlowMatcher()
    blank = matcher.encode(frame(np.full((120, 168, 3), 90, np.uint8)))
    forward, _ = matcher.match(blank, blank)
    assert forward.weight.max() < 1e-3
    assert np.isfinite(forward.target_px).all()
    assert not LkTracker().match(blank, blank, forward).weight.any()


def test_low_contrast_keeps_measurements_with_weight() -> None:
    faint = BoxRoom(contrast=0.08)
    matcher, a, b, truth, visible = pair(faint, look((0, 0, -3)), look((0.15, 0, -3)))
    forward, _ = matcher.match(a, b)
    good = visible & (forward.weight.max(axis=1) > 0.2)
    assert good.mean() > 0.2
    assert np.median(np.linalg.norm(forward.target_px - truth, axis=1)[good]) < 0.5


def test_tracks_are_sharp_and_lie_on_the_grid(room: BoxRoom) -> None:
    matcher, a, b, truth, visible = pair(room, look((0, 0, -3)), look((0.3, 0.05, -2.8), yaw_deg=1))
    dense, _ = matcher.match(a, b)
    tracks = LkTracker().match(a, b, dense)
    used = tracks.weight[:, 0] > 0
    assert used.sum() > 150
    assert tracks.weight.max() <= 4.0 + 1e-6
    error = (tracks.target_px - truth)[used & visible]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.2
    # No systematic shift between corner and cell centre: the mean error is far below the scatter.
    assert np.abs(error[np.linalg.norm(error, axis=1) < 1].mean(axis=0)).max() < 0.05


def _all(features: FlowFeatures) -> NDArray[np.bool_]:
    return np.ones(features.grid.num_cells, dtype=np.bool_)


def test_only_wanted_cells_are_aligned(room: BoxRoom) -> None:
    _, a, b, truth, _ = pair(room, look((0, 0, -3)), look((0.2, 0.05, -2.9)))
    wanted = np.arange(a.grid.num_cells) % 2 == 0
    everything = PatchAligner().align(a, b, truth, _all(a))
    half = PatchAligner().align(a, b, truth, wanted)
    np.testing.assert_array_equal(half.weight[wanted], everything.weight[wanted])
    assert not half.weight[~wanted].any()
    assert abs(half.consistent - everything.consistent) < 0.1


def test_patches_are_sharper_than_flow_and_do_not_follow_the_error_of_their_guess(room: BoxRoom) -> None:
    source, target = look((0, 0, -3)), look((0.45, 0.05, -2.7), yaw_deg=-4)
    matcher, a, b, truth, visible = pair(room, source, target)
    rng = np.random.default_rng(0)
    # What a map with slightly wrong poses and depths would say: off by a smooth pixel or so.
    wave = np.stack([np.sin(truth[:, 1] / 60), np.cos(truth[:, 0] / 70)], axis=-1) + rng.normal(0, 0.05, truth.shape)
    guess = np.where(visible[:, None], truth + wave, np.nan)
    aligned = PatchAligner().align(a, b, guess, _all(a))
    good = visible & (aligned.weight.min(axis=1) > 1)
    assert good.sum() > 0.5 * visible.sum()
    error = np.linalg.norm(aligned.target_px - truth, axis=1)
    flow, _ = matcher.match(a, b)
    assert np.median(error[good]) < 0.5 * np.median(np.linalg.norm(flow.target_px - truth, axis=1)[good])
    # No bias: the error does not keep a share of the guess's.
    kept = (aligned.target_px - truth)[good] * wave[good]
    assert abs(kept.sum() / np.square(wave[good]).sum()) < 0.05
    assert (aligned.weight[~visible] == 0).all()
    assert aligned.consistent > 0.7


def test_patches_stand_a_change_of_exposure_and_refuse_another_scene(room: BoxRoom) -> None:
    source, target = look((0, 0, -3)), look((0.2, 0.0, -3))
    matcher, a, b, truth, visible = pair(room, source, target)
    guess = np.where(visible[:, None], truth + 0.7, np.nan)
    plain = PatchAligner().align(a, b, guess, _all(a))
    darker = matcher.encode(
        WorkingFrame(1, (0.7 * b.gray + 20).astype(np.uint8), np.zeros((*b.gray.shape, 3), np.uint8))
    )
    changed = PatchAligner().align(a, darker, guess, _all(a))
    both = (plain.weight.min(axis=1) > 1) & (changed.weight.min(axis=1) > 1)
    assert both.sum() > 0.8 * (plain.weight.min(axis=1) > 1).sum()
    assert np.median(np.linalg.norm(changed.target_px - plain.target_px, axis=1)[both]) < 0.05
    noise = np.random.default_rng(1).integers(0, 255, b.gray.shape).astype(np.uint8)
    other = matcher.encode(WorkingFrame(2, cv2.GaussianBlur(noise, (0, 0), 2), np.zeros((*b.gray.shape, 3), np.uint8)))
    assert PatchAligner().align(a, other, guess, _all(a)).weight.mean() < 0.1 * plain.weight.mean()


def test_patches_keep_off_masks_borders_and_cells_without_a_guess(room: BoxRoom) -> None:
    _, a, b, truth, _ = pair(room, look((0, 0, -3)), look((0.2, 0.0, -3)))
    half = np.ones(b.gray.shape, bool)
    half[:, : b.gray.shape[1] // 2] = False
    masked = DisFlowMatcher().encode(WorkingFrame(5, b.gray, np.zeros((*b.gray.shape, 3), np.uint8), half))
    match = PatchAligner().align(a, masked, truth, _all(a))
    assert (match.weight[truth[:, 0] < b.gray.shape[1] // 2 - 1] == 0).all()
    nothing = PatchAligner().align(a, b, np.full_like(truth, np.nan), _all(a))
    assert (nothing.weight == 0).all()
    assert np.isfinite(nothing.target_px).all()
    assert nothing.consistent == 0
    outside = PatchAligner().align(a, b, truth + 5000, _all(a))
    assert (outside.weight == 0).all()


def test_sizes_that_are_no_multiple_of_the_stride() -> None:
    room = BoxRoom(width=331, height=205)
    matcher, a, b, truth, visible = pair(room, look((0, 0, -3)), look((0.2, 0, -3)))
    assert a.grid.num_cells == 41 * 25
    forward, _ = matcher.match(a, b, truth)
    good = visible & (forward.weight.max(axis=1) > 0.2)
    assert np.median(np.linalg.norm(forward.target_px - truth, axis=1)[good]) < 0.2


def orbit(room: BoxRoom, count: int) -> list[WorkingFrame]:
    poses = [
        look((-0.8 + 1.6 * t, 0.15 * np.sin(5 * t), -3 + 0.3 * t), yaw_deg=10 - 20 * t)
        for t in np.linspace(0, 1, count)
    ]
    return [frame(room.render(p)[0], k) for k, p in enumerate(poses)]


@pytest.mark.parametrize("fov_deg", [pytest.param(45.0, marks=pytest.mark.long), 70.0])
def test_focal_is_recovered_and_sure(fov_deg: float) -> None:
    frames = orbit(BoxRoom(fov_x_deg=fov_deg), 14)
    estimate = CombinedFocalInit((TwoViewFocal(),)).estimate(frames, grid_of(frames[0].gray))
    assert estimate.camera.fov_x_deg == pytest.approx(fov_deg, abs=1.5)
    assert estimate.log_focal_sigma < 0.12
    assert estimate.num_pairs >= 3


def test_two_frames_give_a_less_sure_focal(room: BoxRoom) -> None:
    frames = orbit(room, 14)
    many = CombinedFocalInit((TwoViewFocal(),)).estimate(frames, grid_of(frames[0].gray))
    two = CombinedFocalInit((TwoViewFocal(),)).estimate(frames[:8:7], grid_of(frames[0].gray))
    assert two.num_pairs == 1
    assert two.log_focal_sigma > many.log_focal_sigma


def test_static_camera_and_single_frame_take_the_default(room: BoxRoom) -> None:
    still = frame(room.render(look((0, 0, -3)))[0])
    for frames in ([still], [still] * 5):
        estimate = CombinedFocalInit((TwoViewFocal(),)).estimate(frames, grid_of(still.gray))
        assert estimate.num_pairs == 0
        assert estimate.log_focal_sigma == pytest.approx(0.3)
        assert estimate.camera.fov_x_deg == pytest.approx(60)


def test_pure_rotation_gives_a_focal_with_a_wider_sigma(room: BoxRoom) -> None:
    frames = [frame(room.render(look((0, 0, -3), yaw_deg=y))[0], k) for k, y in enumerate(np.linspace(-14, 14, 12))]
    estimate = CombinedFocalInit((TwoViewFocal(),)).estimate(frames, grid_of(frames[0].gray))
    # Turning on the spot shows the focal length by itself, less surely than parallax does.
    assert estimate.camera.fov_x_deg == pytest.approx(60, abs=2)
    assert 0.05 < estimate.log_focal_sigma < 0.2


def test_a_plane_in_motion_is_no_rotation() -> None:
    """A flat wall seen by a camera that slides past it: a homography explains all, and the focal length is unknown."""
    wall = np.repeat(BoxRoom(640, 480).render(look((0, 0, 3.2)))[0][..., :1], 3, -1)
    views = [
        cv2.warpAffine(wall, np.array([[1.0, 0, -9 * k], [0, 1, 2 * k]]), (640, 480))[40:440, :400] for k in range(12)
    ]
    frames = [frame(np.ascontiguousarray(v), k) for k, v in enumerate(views)]
    estimate = CombinedFocalInit((TwoViewFocal(),)).estimate(frames, grid_of(frames[0].gray))
    assert estimate.log_focal_sigma > 0.25
    assert estimate.num_pairs == 0


def test_same_input_same_bytes(room: BoxRoom) -> None:
    frames = orbit(room, 6)
    results = []
    for _ in range(2):
        priors = classical_priors()
        a, b = priors.matcher.encode(frames[0]), priors.matcher.encode(frames[1])
        forward, backward = priors.matcher.match(a, b)
        assert priors.tracker is not None
        tracks = priors.tracker.match(a, b, forward)
        focal = priors.intrinsics.estimate(frames, a.grid)
        arrays = [x for m in (forward, backward, tracks) for x in (m.target_px, m.weight)]
        results.append((b"".join(x.tobytes() for x in arrays), focal))
    assert results[0] == results[1]


def picture(width: int, height: int, seed: int, shift: int = 0) -> WorkingFrame:
    noise = np.random.default_rng(seed).integers(0, 256, (height + 32, width + 64), dtype=np.uint8)
    gray = np.ascontiguousarray(cv2.GaussianBlur(noise, (0, 0), 2)[16:-16, 16 + shift : 16 + shift + width])
    return WorkingFrame(0, gray, cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB))


def test_a_matcher_forgets_earlier_pairs_and_their_guesses() -> None:
    used = DisFlowMatcher()
    for width, height in ((320, 240), (64, 96), (640, 480), (640, 480), (400, 32)):
        fresh = DisFlowMatcher()
        a, b = (fresh.encode(picture(width, height, 1, shift)) for shift in (0, 5))
        assert used.motion_px(a, b) == fresh.motion_px(a, b)
        for measured, expected in zip(used.match(a, b), fresh.match(a, b), strict=True):
            np.testing.assert_array_equal(measured.target_px, expected.target_px)
        np.testing.assert_array_equal(used.match_fast(a, b).target_px, fresh.match_fast(a, b).target_px)
        other = fresh.encode(picture(width, height, 2))
        guess = cell_centres_px(a.grid) + np.array([0.3 * width, 9])
        used.match(a, other, guess)
        used.match_fast(other, a, guess)


@pytest.mark.parametrize(
    ("gray", "blank"),
    [
        (np.zeros((96, 128)), True),
        (np.full((96, 128), 255), True),
        (16 + np.random.default_rng(0).integers(-1, 2, (96, 128)), True),
        (np.random.default_rng(0).integers(0, 256, (96, 128)), False),
        (np.pad(np.random.default_rng(0).integers(0, 256, (24, 24)), ((60, 12), (90, 14))), False),
        (np.linspace(0, 255, 128)[None].repeat(96, 0), False),
    ],
    ids=["black", "white", "noise of a grey level", "texture", "a logo", "a ramp"],
)
def test_blank_is_black_white_and_noise_but_no_picture(gray: np.ndarray, blank: bool) -> None:
    matcher = DisFlowMatcher()
    rgb = cv2.cvtColor(gray.astype(np.uint8), cv2.COLOR_GRAY2RGB)
    assert matcher.is_blank(matcher.encode(frame(rgb))) is blank


def test_a_frame_that_is_masked_all_over_is_blank(room: BoxRoom) -> None:
    matcher = DisFlowMatcher()
    rgb = room.render(look((0, 0, -3)))[0]
    assert not matcher.is_blank(matcher.encode(frame(rgb)))
    assert matcher.is_blank(matcher.encode(frame(rgb, valid=np.zeros(rgb.shape[:2], bool))))


def test_what_turns_black_is_not_measured_there() -> None:
    room = BoxRoom(192, 144)
    picture, _ = room.render(look((0.0, 0.0, -3.0)))
    patched = picture.copy()
    patched[40:104, 48:144] = 0
    matcher = DisFlowMatcher()
    frames = [WorkingFrame(k, rgb[..., 0], rgb) for k, rgb in enumerate((picture, patched))]
    source, target = (matcher.encode(frame) for frame in frames)
    there, _ = matcher.match(source, target)
    weight = there.weight.max(axis=1).reshape(18, 24)
    assert weight[7:11, 8:16].max() == 0
    assert np.median(weight[:3]) > 0.3
