"""Poses of the frames between keyframes (paper section 3.1, step 5): two one-way measurements and a motion-only fit."""

from __future__ import annotations

import bisect
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Edges, Free, Problem, State
from vipe_core.geometry.arrays import interpolate_trajectory
from vipe_core.priors.protocols import DenseMatcher, Match, SparseTracker
from vipe_core.slam.adjustment import Adjuster, Step
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector, relative_pose
from vipe_core.slam.rotation import Link, RotationFitter
from vipe_core.slam.selection import Report
from vipe_core.slam.working import WorkingSize, working_frame
from vipe_core.video.source import FrameSource

Array = NDArray[Any]

_SCHEDULE = (Step("geman_mcclure", 3.0, 6), Step("geman_mcclure", 1.0, 4))
_MIN_INLIERS = 0.1
_MIN_WEIGHT = 0.02


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of all frames.

    Attributes:
        cam_from_world: (N, 4, 4) float64.
        inlier_ratio: (N,) float32 share of the measurements' weight within the robust scale; 0 where a pose could only
            be interpolated.
    """

    cam_from_world: NDArray[np.float64]
    inlier_ratio: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Pending:
    """A frame that waits for its batch: its number, its start, and its measurements from keyframes."""

    index: int
    start: NDArray[np.float64]
    matches: tuple[tuple[int, Match], ...]


class Infill:
    """Poses every frame of the video against the finished map.

    Args:
        graph: Says how raw weights are to be seen.
        batch: Frames that are posed together.
        rotation_only: Fits rotations instead of poses, for a camera that only turns.
        tracks_only: Gives the measurements instead of dense flow, which then only guides it.
    """

    def __init__(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        matcher: DenseMatcher,
        adjuster: Adjuster,
        reprojector: Reprojector,
        batch: int,
        rotation_only: RotationFitter | None = None,
        tracks_only: SparseTracker | None = None,
    ) -> None:
        self._keyframes = keyframes
        self._graph = graph
        self._matcher = matcher
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._batch = batch
        self._rotation_only = rotation_only
        self._tracks_only = tracks_only

    def run(self, source: FrameSource, size: WorkingSize, times_s: Array, report: Report) -> Trajectory:
        """Decode the video once more and pose its frames; holds one batch of measurements at a time.

        Raises:
            InputError, DecodeError: From the source.
        """
        keyframes = self._keyframes
        count = len(times_s)
        knots = np.array(keyframes.times_s)
        poses = np.asarray(interpolate_trajectory(knots, keyframes.poses(), times_s))
        inlier_ratio = np.zeros(count, dtype=np.float32)
        number = {index: k for k, index in enumerate(keyframes.frame_index)}
        for index, k in number.items():
            poses[index] = keyframes.pose(k)
            inlier_ratio[index] = 1.0
        pending: list[_Pending] = []
        with closing(source.frames(size.size, stop=count)) as frames:
            for frame in frames:
                if frame.index not in number:
                    features = self._matcher.encode(working_frame(frame))
                    # Against a blank frame everything seems to stand still: it keeps its interpolated pose.
                    if not self._matcher.is_blank(features):
                        pending.append(self._measure(frame.index, features, poses[frame.index]))
                    if len(pending) == self._batch:
                        self._solve(pending, poses, inlier_ratio)
                        pending = []
                report("infill", frame.index + 1, count)
        if pending:
            self._solve(pending, poses, inlier_ratio)
        return Trajectory(poses, inlier_ratio)

    def _measure(self, index: int, features: Any, start: Array) -> _Pending:
        """Match a frame from the keyframe before it and the one after it, or from the last two."""
        after = bisect.bisect_left(self._keyframes.frame_index, index)
        nearest = {max(0, after - 1), min(after, len(self._keyframes) - 1)}
        if len(nearest) == 1 and len(self._keyframes) > 1:
            nearest.add(max(0, after - 2))
        matches = []
        for k in sorted(nearest):
            guess = self._reprojector.induced(
                self._keyframes.intrinsics, relative_pose(start, self._keyframes.pose(k)), self._keyframes.depth(k)
            )
            match = self._matcher.match_fast(self._keyframes.features[k], features, guess.target_px)
            if self._tracks_only is not None:
                match = self._tracks_only.match(self._keyframes.features[k], features, match)
            matches.append((k, match))
        return _Pending(index, np.array(start), tuple(matches))

    def _solve(self, pending: list[_Pending], poses: Array, inlier_ratio: Array) -> None:
        """Fit the poses of a batch; a frame that its measurements do not support keeps its interpolated pose."""
        solved = self._adjusted(pending) if self._rotation_only is None else self._turned(pending, self._rotation_only)
        if solved is None:
            return
        for frame, pose in zip(pending, solved, strict=True):
            ratio = self._inliers(frame, pose)
            if ratio >= _MIN_INLIERS and np.isfinite(pose).all():
                poses[frame.index] = pose
                inlier_ratio[frame.index] = ratio

    def _turned(self, pending: list[_Pending], fitter: RotationFitter) -> NDArray[np.float64]:
        """(B, 4, 4) rotation-only poses of a batch."""
        sources = sorted({k for frame in pending for k, _ in frame.matches})
        number = {k: row for row, k in enumerate(sources)}
        first = len(sources)
        links = [
            Link(number[k], first + row, match, self._keyframes.static(k))
            for row, frame in enumerate(pending)
            for k, match in frame.matches
        ]
        start = np.stack([self._keyframes.pose(k) for k in sources] + [frame.start for frame in pending])
        fit = fitter.fit(start[:, :3, :3], range(first), links, self._keyframes.intrinsics)
        poses = np.tile(np.eye(4), (len(pending), 1, 1))
        poses[:, :3, :3] = fit.rotations[first:]
        return poses

    def _adjusted(self, pending: list[_Pending]) -> NDArray[np.float64] | None:
        """(B, 4, 4) by a motion-only adjustment: keyframes are fixed sources, frames are free targets."""
        device = self._adjuster.device
        sources = sorted({k for frame in pending for k, _ in frame.matches})
        number = {k: row for row, k in enumerate(sources)}
        first = len(sources)
        total = first + len(pending)
        links = [(number[k], first + row, match) for row, frame in enumerate(pending) for k, match in frame.matches]
        weight = np.stack(
            [self._graph.weigh(match.weight) * self._keyframes.static(sources[i])[:, None] for i, _, match in links]
        )
        edges = Edges(
            source=torch.tensor([i for i, _, _ in links], dtype=torch.int64, device=device),
            target=torch.tensor([j for _, j, _ in links], dtype=torch.int64, device=device),
            target_px=torch.from_numpy(np.stack([match.target_px for _, _, match in links])).to(device),
            weight=torch.from_numpy(weight).to(device),
        )
        start = np.stack([self._keyframes.pose(k) for k in sources] + [frame.start for frame in pending])
        depths = np.ones((total, self._keyframes.grid.num_cells), dtype=np.float32)
        depths[:first] = np.stack([self._keyframes.depth(k) for k in sources])
        problem = Problem(
            camera_model="pinhole",
            grid=self._keyframes.grid,
            edges=edges,
            free=Free(
                poses=torch.arange(total, device=device) >= first,
                inverse_depth=torch.zeros(total, dtype=torch.bool, device=device),
            ),
        )
        state = State(
            cam_from_world=torch.from_numpy(start).to(device),
            inverse_depth=torch.from_numpy(depths).to(device),
            intrinsics=torch.from_numpy(self._keyframes.intrinsics.copy()).to(device),
        )
        result = self._adjuster.anneal(problem, state, _SCHEDULE)
        return None if result is None else result.state.cam_from_world[first:].cpu().numpy()

    def _inliers(self, frame: _Pending, cam_from_world: Array) -> float:
        """Share of the weight of a frame's measurements whose residual is within the robust scale."""
        inside = total = 0.0
        for k, match in frame.matches:
            induced = self._reprojector.induced(
                self._keyframes.intrinsics,
                relative_pose(cam_from_world, self._keyframes.pose(k)),
                self._keyframes.depth(k),
            )
            weight = self._graph.weigh(match.weight).mean(axis=1) * self._keyframes.static(k)
            weight = np.where(weight > _MIN_WEIGHT, weight, 0)
            error = np.linalg.norm(induced.target_px - match.target_px, axis=1)
            inside += float(weight[error < self._adjuster.robust_scale_px].sum())
            total += float(weight.sum())
        return inside / total if total > 0 else 0.0
