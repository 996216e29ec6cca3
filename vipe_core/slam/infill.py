"""Poses of the frames between keyframes (paper section 3.1, step 5): two one-way measurements and a motion-only fit."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Edges, Free, Problem
from vipe_core.geometry.arrays import interpolate_trajectory, relative
from vipe_core.priors.protocols import Aligner, DenseMatcher, Match, Refiner, SparseTracker
from vipe_core.slam.adjustment import SETTLE, Step
from vipe_core.slam.consensus import MAJORITY, consensus_pose
from vipe_core.slam.frames import EncodedFrames
from vipe_core.slam.graph import sharpen
from vipe_core.slam.mapping import ShotMap
from vipe_core.slam.recurrent.posing import FramePoser, Unposed
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.slam.reprojection import Induced, Reprojector
from vipe_core.slam.rotation import Link, RotationFitter
from vipe_core.slam.segmentation import UNKNOWN, carried
from vipe_core.slam.selection import Report
from vipe_core.transfer import uploaded

Array = NDArray[Any]

SCHEDULE = (Step("geman_mcclure", 3.0, 6), Step("geman_mcclure", 1.0, 4, 1e-4))
MIN_INLIERS = 0.1
_MIN_WEIGHT = 0.02


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of all frames, and how well each is supported.

    Attributes:
        cam_from_world: (N, 4, 4) float64; every shot has a world of its own.
        residual_px: (N,) float32 median residual of the inliers of each frame, working pixels; NaN without any.
        inlier_ratio: (N,) float32 share of the measurements' weight within the robust scale; 0 where a pose could only
            be interpolated.
        coverage: (N,) float32 share of the cells that fit: of a keyframe its own, of any other frame those of the
            keyframe that sees it best.
        interpolated: (N,) bool, True on frames whose pose is interpolated because nothing measures it.
        labels: (N, P) int8, what each cell of a frame does; see `segmentation.py`.
    """

    cam_from_world: NDArray[np.float64]
    residual_px: NDArray[np.float32]
    inlier_ratio: NDArray[np.float32]
    coverage: NDArray[np.float32]
    interpolated: NDArray[np.bool_]
    labels: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class _Pending:
    """A frame that waits for its batch: its number, its features, its start, and its measurements from keyframes.

    Attributes:
        agreed: (P,) bool for each match, cells that may take part in the fit.
        sources: Keyframes that it is to be measured from, where that has not been done.
    """

    index: int
    features: Any
    start: NDArray[np.float64]
    matches: tuple[tuple[int, Match], ...]
    agreed: tuple[NDArray[np.bool_], ...]
    sources: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a pose explains the measurements of its frame; see `Trajectory`."""

    residual_px: float
    inlier_ratio: float
    coverage: float


def fill_in(
    maps: Sequence[ShotMap],
    frames: EncodedFrames,
    placed: NDArray[np.bool_],
    reprojector: Reprojector,
    batch: int,
    report: Report,
    aligner: Aligner | None = None,
    tracks_only: SparseTracker | None = None,
    refined: tuple[Refiner, RefinementSettings] | None = None,
) -> Trajectory:
    """Pose every frame of the video against the finished map of its shot; holds one batch of measurements at a time.

    Args:
        maps: Of the shots, in the order of the video.
        placed: (N,) bool; frames that are False keep their interpolated pose.
        batch: Frames that are posed together.
        aligner: Sharpens the measurements from the first fit, for a second one; None leaves it at one.
        tracks_only: Gives the measurements instead of dense flow, which then only guides it.
        refined: Measurements are refined in turns with the poses, by this schedule; None measures each frame once.

    Raises:
        InputError, DecodeError: From the source.
    """
    count = len(frames)
    trajectory = blank_trajectory(count, reprojector.grid.num_cells)
    times_s = np.array(frames.times_s)
    shots = [
        _ShotInfill(one, frames.matcher, reprojector, times_s, placed, trajectory, batch, aligner, tracks_only, refined)
        for one in maps
    ]
    waiting = [shot for shot in shots if shot.moves]
    if not waiting:
        report("infill", count, count)
        return trajectory
    with closing(frames.again(waiting[0].start, waiting[-1].stop)) as stream:
        for index, features in stream:
            if index == waiting[0].stop:
                waiting.pop(0).finish()
            if placed[index] and index >= waiting[0].start:
                waiting[0].add(index, features)
            report("infill", index + 1, count)
    waiting[0].finish()
    return trajectory


class _ShotInfill:
    """Poses the frames of one shot, in order, into a `Trajectory`.

    Attributes:
        start, stop: The frames of the shot.
        moves: Whether its frames have poses of their own to find.
    """

    def __init__(
        self,
        shot_map: ShotMap,
        matcher: DenseMatcher,
        reprojector: Reprojector,
        times_s: NDArray[np.float64],
        placed: NDArray[np.bool_],
        into: Trajectory,
        batch: int,
        aligner: Aligner | None,
        tracks_only: SparseTracker | None,
        refined: tuple[Refiner, RefinementSettings] | None,
    ) -> None:
        self.start, self.stop = shot_map.shot.start, shot_map.shot.stop
        self.moves = shot_map.motion != "static"
        self._keyframes = keyframes = shot_map.keyframes
        self._adjuster = shot_map.adjuster
        self._fitter = shot_map.fitter
        self._usable = shot_map.usable
        self._labels = shot_map.labels
        self._matcher = matcher
        self._reprojector = reprojector
        self._into = into
        self._batch = batch
        self._aligner = aligner
        self._tracks_only = tracks_only
        self._poser: FramePoser | None = None
        if refined is not None and self._fitter is None:
            refiner, schedule = refined
            self._poser = FramePoser(refiner, keyframes, shot_map.adjuster, shot_map.usable, schedule)
        self._pending: list[_Pending] = []
        frames = slice(self.start, self.stop)
        if not self.moves:
            # Every picture of a camera that stands still shows what its keyframe shows.
            into.inlier_ratio[frames] = into.coverage[frames] = placed[frames]
            into.residual_px[frames] = np.where(placed[frames], 0, np.nan)
            into.interpolated[frames] = ~placed[frames]
            return
        into.cam_from_world[frames] = interpolate_trajectory(keyframes.times_s, keyframes.poses(), times_s[frames])
        self._known = set(keyframes.frame_index)
        for k, index in enumerate(keyframes.frame_index):
            take_keyframe(into, index, shot_map, k)

    def add(self, index: int, features: Any) -> None:
        """Measure a frame; every so many are posed together."""
        if index in self._known:
            return
        self._pending.append(self._measure(index, features, self._into.cam_from_world[index]))
        if len(self._pending) == self._batch:
            self.finish()

    def finish(self) -> None:
        """Pose the frames that wait; one that its measurements do not support keeps its interpolated pose."""
        pending, self._pending = self._pending, []
        if not pending:
            return
        solved: NDArray[np.float64] | None
        if self._fitter is not None:
            solved = self._turned(pending, self._fitter)
        elif self._poser is not None:
            pending, solved = self._refined(pending, self._poser)
        else:
            solved = self._adjusted(pending, SCHEDULE)
            if solved is not None and self._aligner is not None:
                pending = [
                    self._sharpened(frame, pose, self._aligner) for frame, pose in zip(pending, solved, strict=True)
                ]
                solved = self._adjusted(pending, SETTLE)
        if solved is None:
            return
        into = self._into
        for frame, pose in zip(pending, solved, strict=True):
            fit = judge(self._judged(frame, pose), self._adjuster.robust_scale_px)
            if fit.inlier_ratio >= MIN_INLIERS and np.isfinite(pose).all():
                into.cam_from_world[frame.index] = pose
                into.residual_px[frame.index] = fit.residual_px
                into.inlier_ratio[frame.index] = fit.inlier_ratio
                into.coverage[frame.index] = fit.coverage
                into.interpolated[frame.index] = False

    def _measure(self, index: int, features: Any, start: Array) -> _Pending:
        """Match a frame from the keyframe before it and the one after it, or from the last two."""
        after = bisect.bisect_left(self._keyframes.frame_index, index)
        nearest = {max(0, after - 1), min(after, len(self._keyframes) - 1)}
        if len(nearest) == 1 and len(self._keyframes) > 1:
            nearest.add(max(0, after - 2))
        if self._poser is not None:
            return _Pending(index, features, np.array(start), (), (), tuple(sorted(nearest)))
        matches = []
        for k in sorted(nearest):
            guess_px = self._induced(k, start).target_px
            match = self._matcher.match_fast(self._keyframes.features[k], features, guess_px)
            if self._tracks_only is not None:
                match = self._tracks_only.match(self._keyframes.features[k], features, match)
            matches.append((k, match))
        self._label(index, matches)
        return self._started(index, features, np.array(start), tuple(matches))

    def _label(self, index: int, matches: Sequence[tuple[int, Match]]) -> None:
        """What the cells of a frame do, by those of the keyframes that it is seen from."""
        said = np.zeros(self._keyframes.grid.num_cells, dtype=np.float32)
        for k, match in matches:
            said += carried(self._labels[k], match, self._keyframes.grid)
        self._into.labels[index] = np.sign(said)

    def _refined(self, pending: list[_Pending], poser: FramePoser) -> tuple[list[_Pending], NDArray[np.float64]]:
        """The frames with what the refinement measured of them, and their poses."""
        poses, measured = poser.run([Unposed(frame.features, frame.start, frame.sources) for frame in pending])
        found = []
        for frame, matches in zip(pending, measured, strict=True):
            self._label(frame.index, matches)
            usable = tuple(self._usable[k] for k, _ in matches)
            found.append(_Pending(frame.index, frame.features, frame.start, matches, usable))
        return found, poses

    def _started(
        self, index: int, features: Any, interpolated: NDArray[np.float64], matches: tuple[tuple[int, Match], ...]
    ) -> _Pending:
        """Start at the pose that most of the picture agrees on, with the cells that do; where no majority agrees on
        one, at the interpolated pose with all cells."""
        scale_px = self._adjuster.robust_scale_px
        usable = tuple(self._usable[k] for k, _ in matches)
        if self._fitter is not None:
            return _Pending(index, features, interpolated, matches, usable)
        found = consensus_pose(self._reprojector, self._keyframes, matches, usable, scale_px)
        if found is None or found[1] < MAJORITY:
            return _Pending(index, features, interpolated, matches, usable)
        agreed = []
        for (k, match), known in zip(matches, usable, strict=True):
            error = np.linalg.norm(self._induced(k, found[0]).target_px - match.target_px, axis=1)
            agreed.append(known & (error < scale_px))
        return _Pending(index, features, found[0], matches, tuple(agreed))

    def _sharpened(self, frame: _Pending, cam_from_world: Array, aligner: Aligner) -> _Pending:
        """The frame with measurements that start from its pose."""
        matches = []
        for k, match in frame.matches:
            induced = self._induced(k, cam_from_world)
            guess_px = np.where(induced.visible[:, None], induced.target_px, np.float32(np.nan))
            aligned = aligner.align(self._keyframes.features[k], frame.features, guess_px, self._usable[k])
            matches.append((k, sharpen(match, aligned)))
        return _Pending(frame.index, frame.features, cam_from_world, tuple(matches), frame.agreed)

    def _induced(self, k: int, cam_from_world: Array) -> Induced:
        """Where a pose sees the cells of keyframe `k`."""
        frame_from_keyframe = relative(cam_from_world, self._keyframes.pose(k))
        return self._reprojector.induced(self._keyframes.intrinsics, frame_from_keyframe, self._keyframes.depth(k))

    def _turned(self, pending: list[_Pending], fitter: RotationFitter) -> NDArray[np.float64]:
        """(B, 4, 4) rotation-only poses of a batch."""
        sources = sorted({k for frame in pending for k, _ in frame.matches})
        number = {k: row for row, k in enumerate(sources)}
        first = len(sources)
        links = [
            Link(number[k], first + row, match, self._usable[k])
            for row, frame in enumerate(pending)
            for k, match in frame.matches
        ]
        start = np.stack([self._keyframes.pose(k) for k in sources] + [frame.start for frame in pending])
        fit = fitter.fit(start[:, :3, :3], range(first), links, self._keyframes.intrinsics)
        poses = np.tile(np.eye(4), (len(pending), 1, 1))
        poses[:, :3, :3] = fit.rotations[first:]
        return poses

    def _adjusted(self, pending: list[_Pending], schedule: Sequence[Step]) -> NDArray[np.float64] | None:
        """(B, 4, 4) by a motion-only adjustment: keyframes are fixed sources, frames are free targets."""
        device = self._adjuster.device
        sources = sorted({k for frame in pending for k, _ in frame.matches})
        number = {k: row for row, k in enumerate(sources)}
        first = len(sources)
        total = first + len(pending)
        links = [(number[k], first + row, match) for row, frame in enumerate(pending) for k, match in frame.matches]
        agreed = [cells for frame in pending for cells in frame.agreed]
        weight = np.stack([match.weight * cells[:, None] for (_, _, match), cells in zip(links, agreed, strict=True)])
        edges = Edges(
            source=torch.tensor([i for i, _, _ in links], dtype=torch.int64),
            target=torch.tensor([j for _, j, _ in links], dtype=torch.int64),
            target_px=uploaded(np.stack([match.target_px for _, _, match in links]), device),
            weight=uploaded(weight, device),
        )
        start = np.stack([self._keyframes.pose(k) for k in sources] + [frame.start for frame in pending])
        depths = np.ones((total, self._keyframes.grid.num_cells), dtype=np.float32)
        depths[:first] = np.stack([self._keyframes.depth(k) for k in sources])
        problem = Problem(
            camera_model=self._keyframes.camera_model,
            grid=self._keyframes.grid,
            edges=edges,
            free=Free(
                poses=torch.arange(total) >= first,
                inverse_depth=torch.zeros(total, dtype=torch.bool),
            ),
        )
        state = self._adjuster.state(start, depths, self._keyframes.intrinsics)
        result = self._adjuster.anneal(problem, state, schedule)
        return None if result is None else result.state.cam_from_world[first:].cpu().numpy()

    def _judged(self, frame: _Pending, cam_from_world: Array) -> Iterator[tuple[Induced, Match, Array]]:
        for k, match in frame.matches:
            yield self._induced(k, cam_from_world), match, self._usable[k]


def blank_trajectory(count: int, num_cells: int) -> Trajectory:
    """Of `count` frames of which nothing is known."""
    return Trajectory(
        np.tile(np.eye(4), (count, 1, 1)),
        np.full(count, np.nan, dtype=np.float32),
        np.zeros(count, dtype=np.float32),
        np.zeros(count, dtype=np.float32),
        np.ones(count, dtype=np.bool_),
        np.full((count, num_cells), UNKNOWN, dtype=np.int8),
    )


def take_keyframe(into: Trajectory, index: int, shot_map: ShotMap, k: int) -> None:
    """Frame `index` is the map's keyframe k: what the map knows of it."""
    into.cam_from_world[index] = shot_map.keyframes.pose(k)
    into.residual_px[index] = shot_map.found.keyframe_residual_px[k]
    into.inlier_ratio[index] = shot_map.found.keyframe_inlier_ratio[k]
    into.coverage[index] = shot_map.found.keyframe_coverage[k]
    into.interpolated[index] = False
    into.labels[index] = shot_map.labels[k]


def judge(seen: Iterable[tuple[Induced, Match, Array]], robust_scale_px: float) -> Fit:
    """What a pose makes of measurements.

    Args:
        seen: Where it sees the cells of a keyframe, their measurement, and (P,) bool, which of them count.
    """
    inside = total = coverage = 0.0
    errors = [np.zeros(0, np.float32)]
    for induced, match, usable in seen:
        weight = match.weight.mean(axis=1) * usable
        weight = np.where(weight > _MIN_WEIGHT, weight, 0)
        error = np.linalg.norm(induced.target_px - match.target_px, axis=1)
        fits = (weight > 0) & (error < robust_scale_px)
        inside += float(weight[fits].sum())
        total += float(weight.sum())
        coverage = max(coverage, float(fits.mean()))
        errors.append(error[fits])
    all_errors = np.concatenate(errors)
    residual_px = float(np.median(all_errors)) if len(all_errors) else float("nan")
    return Fit(residual_px, inside / total if total > 0 else 0.0, coverage)
