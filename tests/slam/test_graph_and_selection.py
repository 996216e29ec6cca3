"""Measurements in the graph, keyframe selection, and the working size."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.errors import EmptyMedia
from vipe_core.priors.protocols import Match, WorkingFrame
from vipe_core.slam.frames import EncodedFrames
from vipe_core.slam.graph import Graph, fuse, sharpen
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.proximity import Pair, loop_edges
from vipe_core.slam.selection import Keyframe, Selection, select_keyframes
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.smoothness import smooth_inverse_depth
from vipe_core.slam.working import working_size
from vipe_core.video.source import Frame, VideoInfo

SIZE = working_size(640, 480, 640 * 480)


def match(target: Sequence[Sequence[float]], weight: Sequence[Sequence[float]]) -> Match:
    return Match(np.array(target, dtype=np.float32), np.array(weight, dtype=np.float32), 1.0)


# -- graph ---------------------------------------------------------------------------------------------------------


def test_fused_measurement_is_the_minimum_of_the_sum_of_both_terms() -> None:
    dense = match([[10.0, 20.0]], [[1.0, 1.0]])
    sparse = match([[11.0, 20.5]], [[3.0, 1.0]])
    fused = fuse(dense, sparse)
    np.testing.assert_allclose(fused.target_px, [[10.75, 20.25]])
    np.testing.assert_allclose(fused.weight, [[4.0, 2.0]])


def test_a_track_that_contradicts_the_flow_is_left_out_and_one_without_flow_is_taken() -> None:
    dense = match([[10.0, 20.0], [50.0, 50.0]], [[1.0, 1.0], [0.0, 0.0]])
    sparse = match([[15.0, 20.0], [60.0, 60.0]], [[4.0, 4.0], [4.0, 4.0]])
    fused = fuse(dense, sparse)
    np.testing.assert_allclose(fused.target_px, [[10.0, 20.0], [60.0, 60.0]])
    np.testing.assert_allclose(fused.weight, [[1.0, 1.0], [4.0, 4.0]])


def test_an_alignment_replaces_flow_it_agrees_with_and_flow_stays_where_they_contradict() -> None:
    flow = match([[10.0, 20.0], [50.0, 50.0], [70.0, 70.0], [0.0, 0.0]], [[1, 1], [1, 1], [1, 1], [0, 0]])
    aligned = match([[10.5, 20.0], [53.0, 50.0], [70.1, 70.0], [30.0, 30.0]], [[4, 3], [4, 4], [0.5, 0.5], [2, 2]])
    sharp = sharpen(flow, aligned)
    np.testing.assert_allclose(sharp.target_px, [[10.5, 20.0], [50.0, 50.0], [70.0, 70.0], [30.0, 30.0]])
    np.testing.assert_allclose(sharp.weight, [[4, 3], [1, 1], [1, 1], [2, 2]])


def test_masks_apply_when_edges_are_read_and_the_measurement_stays() -> None:
    grid = Grid(1, 2)
    keyframes = KeyframeMap(grid, "pinhole", Camera.pinhole_from_fov(60, 16, 8).index_params())
    for index in range(2):
        keyframes.append(Keyframe(index, None), float(index), np.eye(4), np.ones(2))
    graph = Graph()
    graph.add(0, 1, match([[1, 1], [2, 2]], [[1, 1], [1, 1]]))
    keyframes.set_static(0, np.array([True, False]))
    edges = graph.read([(0, 1)], {0: 0, 1: 1}, keyframes, torch.device("cpu"))
    np.testing.assert_array_equal(edges.weight[0].numpy(), [[1, 1], [0, 0]])
    np.testing.assert_array_equal(graph[0, 1].weight, [[1, 1], [1, 1]])


def test_loop_edges_keep_their_distance_from_each_other() -> None:
    pairs = [Pair(20, 3, 5.0), Pair(21, 3, 6.0), Pair(20, 4, 7.0), Pair(30, 3, 8.0)]
    chosen = loop_edges(pairs, Graph(), limit=10)
    assert [(p.source, p.target) for p in chosen] == [(20, 3), (30, 3)]
    assert len(loop_edges(pairs, Graph(), limit=1)) == 1
    assert loop_edges(pairs, Graph(), limit=-3) == [], "there are more than enough already"


def test_scale_is_normalised_without_moving_a_reprojection() -> None:
    keyframes = KeyframeMap(Grid(1, 2), "pinhole", Camera.pinhole_from_fov(60, 16, 8).index_params())
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 2.0, 3.0)
    keyframes.append(Keyframe(0, None), 0.0, pose, np.array([2.0, 6.0]))
    before = keyframes.pose(0)[:3, 3, None] * keyframes.depth(0)
    keyframes.normalise_scale()
    assert np.median(keyframes.depths()) == pytest.approx(1.0)
    np.testing.assert_allclose(keyframes.pose(0)[:3, 3, None] * keyframes.depth(0), before, rtol=1e-6)


def test_unmeasured_cells_take_their_neighbours_depth() -> None:
    grid = Grid(12, 16)
    depth = np.full((12, 16), 2.0, dtype=np.float32)
    depth[4:8, 6:10] = 50.0
    confidence = np.ones((12, 16), dtype=np.float32)
    confidence[4:8, 6:10] = 0.0
    smooth = smooth_inverse_depth(depth, confidence, grid)
    np.testing.assert_allclose(smooth, 2.0, rtol=1e-3)


# -- selection -----------------------------------------------------------------------------------------------------


class Ruler:
    """A video on a line: frame k shows position `positions[k]`, and the motion between frames is their distance.

    NaN is a blank frame. `opened` counts the streams, `open` those that nobody has closed.
    """

    def __init__(self, positions: Sequence[float]) -> None:
        self._positions = list(positions)
        self.open = 0
        self.opened = 0

    @property
    def info(self) -> VideoInfo:
        return VideoInfo("ruler", "ruler", 640, 480, 30.0, None, None, 0, "none", "rgb24", 0)

    def frames(
        self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None
    ) -> Generator[Frame, None, None]:
        picture: NDArray[np.uint8] = np.zeros((8, 8, 3), dtype=np.uint8)
        self.open += 1
        self.opened += 1
        try:
            for index in range(len(self._positions))[start:stop]:
                yield Frame(index, index * 0.1, picture)
        finally:
            self.open -= 1

    def encode(self, frame: WorkingFrame) -> float:
        return self._positions[frame.index]

    def is_blank(self, features: float) -> bool:
        return math.isnan(features)

    def motion_px(self, source: float, target: float) -> float:
        assert not math.isnan(source + target), "motion against a blank frame means nothing"
        return abs(target - source)

    def match(self, source: float, target: float, guess_px: object = None) -> tuple[Match, Match]:
        raise AssertionError("selection does not match")

    def match_fast(self, source: float, target: float, guess_px: object = None) -> Match:
        raise AssertionError("selection does not match")


def select(positions: Sequence[float], **settings: object) -> Selection:
    chosen = SlamSettings(**settings)
    return select_keyframes(encoded(Ruler(positions)), SIZE, chosen, lambda *_: None)


def encoded(ruler: Ruler, cache_bytes: int = 1 << 30) -> EncodedFrames:
    return EncodedFrames(ruler, SIZE, ruler, cache_bytes)


def indices(selection: Selection) -> list[int]:
    (shot,) = selection.shots
    return [keyframe.index for keyframe in shot.keyframes]


def test_a_keyframe_for_every_threshold_of_motion_and_the_last_frame() -> None:
    selection = select([10.0 * k for k in range(60)])
    assert indices(selection)[:3] == [0, 3, 6]
    assert indices(selection)[-1] == 59
    np.testing.assert_allclose(selection.timestamps_s, np.arange(60) * 0.1)


def test_a_slow_clip_gets_enough_keyframes_by_a_lower_threshold() -> None:
    assert len(indices(select([1.5 * k for k in range(40)]))) >= 8


def test_a_jump_makes_the_frame_before_it_a_keyframe() -> None:
    positions = [2.0 * k for k in range(11)] + [200.0 + 10 * k for k in range(40)]
    assert {10, 11} <= set(indices(select(positions)))


def test_a_camera_that_stands_still_has_one_keyframe() -> None:
    selection = select([0.1 * (k % 3) for k in range(50)])
    assert selection.shots[0].max_motion_px < 1.0
    assert indices(selection)[0] == 0


@settings(max_examples=30)
@given(count=st.integers(1, 700), capacity=st.integers(2, 64))
def test_the_sample_is_bounded_and_evenly_spaced(count: int, capacity: int) -> None:
    sample = [frame.index for frame in select([0.0] * count, sample_frames=capacity).sample]
    assert sample[0] == 0
    assert min(count, (capacity + 1) // 2) <= len(sample) <= capacity
    assert len(set(np.diff(sample))) <= 1


def test_no_frame_is_a_typed_error() -> None:
    with pytest.raises(EmptyMedia):
        select([])


def test_blank_frames_are_passed_over() -> None:
    walk = [10.0 * k for k in range(30)]
    selection = select([math.nan] * 5 + walk[:10] + [math.nan] * 2 + walk[10:] + [math.nan] * 3)
    assert selection.num_frames == 40
    assert indices(selection)[:3] == [5, 8, 11]
    assert not {15, 16} & set(indices(selection))
    assert indices(selection)[-1] == 36
    assert selection.shots[0].max_motion_px >= 24
    np.testing.assert_array_equal(np.flatnonzero(~selection.placed), [0, 1, 2, 3, 4, 15, 16, 37, 38, 39])


def test_a_video_of_blank_frames_keeps_its_first() -> None:
    selection = select([math.nan] * 9)
    assert indices(selection) == [0]
    assert selection.shots[0].max_motion_px == 0
    assert not selection.placed.any()


@pytest.mark.parametrize("passes", [1, 2])
def test_a_cancelled_selection_closes_the_video_while_the_error_is_still_held(passes: int) -> None:
    # Slow, and not kept: the second pass, at a lower threshold, decodes again.
    ruler = Ruler([1.5 * k for k in range(40)])
    calls = 0

    def report(stage: str, done: int, total: int | None) -> None:
        nonlocal calls
        calls += 1
        if calls == 40 * (passes - 1) + 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        select_keyframes(encoded(ruler, cache_bytes=0), SIZE, SlamSettings(), report)
    assert caught.value.__traceback__ is not None
    assert ruler.open == 0


@pytest.mark.parametrize(("cache_frames", "decodings"), [(40, 1), (39, 3)])
def test_a_clip_that_fits_in_the_cache_is_decoded_once(cache_frames: int, decodings: int) -> None:
    ruler = Ruler([10.0 * k for k in range(40)])
    frames = encoded(ruler, cache_bytes=round(cache_frames * 1.5 * SIZE.width * SIZE.height))
    assert [index for _, index in frames.first_pass()] == [10.0 * k for k in range(40)]
    assert list(frames.again()) == [(k, 10.0 * k) for k in range(40)]
    assert list(frames.again(3, 5)) == [(3, 30.0), (4, 40.0)]
    assert ruler.opened == decodings


# -- working size --------------------------------------------------------------------------------------------------


@given(width=st.integers(16, 8000), height=st.integers(16, 8000))
def test_working_size_is_whole_cells_within_the_budget(width: int, height: int) -> None:
    size = working_size(width, height, 640 * 480)
    assert size.width % 8 == size.height % 8 == 0
    assert size.width >= 32
    assert size.height >= 32
    if min(width, height) >= 32:
        assert size.width <= width
        assert size.height <= height
    if max(width, height) <= 4 * min(width, height) and min(width, height) >= 640:
        assert 0.9 < size.width * size.height / (640 * 480) < 1.1
        assert size.width / size.height == pytest.approx(width / height, rel=0.03)


def test_working_size_of_common_videos() -> None:
    assert working_size(640, 480, 640 * 480).size == (640, 480)
    assert working_size(1920, 1080, 640 * 480).size == (736, 416)
    assert working_size(320, 240, 640 * 480).size == (320, 240)
