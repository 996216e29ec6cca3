"""Poses of the instants between keyframes of a rig: all views measure one pose; `infill.py` for a single camera."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Edges, Free, Problem, Rig
from vipe_core.geometry.arrays import interpolate_trajectory, relative
from vipe_core.priors.protocols import Aligner, DenseMatcher, Match, SparseTracker
from vipe_core.slam.adjustment import SETTLE, Step
from vipe_core.slam.consensus import MAJORITY
from vipe_core.slam.graph import sharpen
from vipe_core.slam.infill import MIN_INLIERS, SCHEDULE, Trajectory, blank_trajectory, judge, take_keyframe
from vipe_core.slam.mapping import ShotMap
from vipe_core.slam.reprojection import Induced, Reprojector
from vipe_core.slam.rig_consensus import Sighting, consensus_rig_pose
from vipe_core.slam.rig_frames import EncodedRig
from vipe_core.slam.segmentation import carried
from vipe_core.slam.selection import Report
from vipe_core.transfer import uploaded

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class _Pending:
    """An instant that waits for its batch.

    Attributes:
        start: (4, 4) rig_from_world.
        sightings: Matches from keyframes of the same view; `usable` are the cells that may take part in the fit.
    """

    index: int
    features: tuple[Any, ...]
    start: NDArray[np.float64]
    sightings: tuple[Sighting, ...]


def fill_in_rig(
    shot_map: ShotMap,
    frames: EncodedRig,
    placed: NDArray[np.bool_],
    reprojector: Reprojector,
    batch: int,
    report: Report,
    aligner: Aligner | None = None,
    tracks_only: SparseTracker | None = None,
    blind: frozenset[int] = frozenset(),
) -> list[Trajectory]:
    """Pose every instant against the finished map; arguments as `fill_in`.

    Args:
        blind: Views that measure nothing.

    Returns:
        The trajectory of every view. They are rigid to each other.

    Raises:
        InputError, DecodeError: From the source.
    """
    infill = _RigInfill(shot_map, frames, placed, reprojector, batch, aligner, tracks_only, blind)
    if shot_map.motion != "static":
        with closing(frames.again()) as stream:
            for index, features in stream:
                if placed[index]:
                    infill.add(index, features)
                report("infill", index + 1, len(frames))
        infill.finish()
    report("infill", len(frames), len(frames))
    return infill.trajectories


class _RigInfill:
    """Poses instants in order.

    Attributes:
        trajectories: Of the views.
    """

    def __init__(
        self,
        shot_map: ShotMap,
        frames: EncodedRig,
        placed: NDArray[np.bool_],
        reprojector: Reprojector,
        batch: int,
        aligner: Aligner | None,
        tracks_only: SparseTracker | None,
        blind: frozenset[int],
    ) -> None:
        self._blind = blind
        self._map = shot_map
        self._keyframes = keyframes = shot_map.keyframes
        assert keyframes.cam_from_rig is not None
        self._mounts = keyframes.cam_from_rig
        self._matcher: DenseMatcher = frames.matcher
        self._reprojector = reprojector
        self._batch = batch
        self._aligner = aligner
        self._tracks_only = tracks_only
        self._pending: list[_Pending] = []
        count, views = len(frames), keyframes.num_views
        self.trajectories = [blank_trajectory(count, keyframes.grid.num_cells) for _ in range(views)]
        self._instants = keyframes.frame_index[::views]
        times_s = np.array(frames.times_s)
        if shot_map.motion == "static":
            # Every picture of a rig that stands still shows what its keyframe shows.
            for view, into in enumerate(self.trajectories):
                into.cam_from_world[:] = keyframes.pose(view)
                into.inlier_ratio[:] = into.coverage[:] = placed
                into.residual_px[:] = np.where(placed, 0, np.nan)
                into.interpolated[:] = ~placed
            return
        rig_poses = np.stack([keyframes.rig_pose(instant) for instant in range(len(self._instants))])
        between = interpolate_trajectory(keyframes.times_s[::views], rig_poses, times_s)
        self._rig_from_world = between
        for view, into in enumerate(self.trajectories):
            into.cam_from_world[:] = self._mounts[view] @ between
            for instant, index in enumerate(self._instants):
                take_keyframe(into, index, shot_map, instant * views + view)
        self._known = set(self._instants)

    def add(self, index: int, features: tuple[Any, ...]) -> None:
        """Measure an instant; every so many are posed together."""
        if index in self._known:
            return
        self._pending.append(self._measure(index, features, self._rig_from_world[index]))
        if len(self._pending) == self._batch:
            self.finish()

    def finish(self) -> None:
        """Pose the instants that wait; one that its measurements do not support keeps its interpolated pose."""
        pending, self._pending = self._pending, []
        if not pending:
            return
        solved = self._adjusted(pending, SCHEDULE)
        if solved is not None and self._aligner is not None:
            pending = [self._sharpened(one, pose, self._aligner) for one, pose in zip(pending, solved, strict=True)]
            solved = self._adjusted(pending, SETTLE)
        if solved is None:
            return
        for one, rig_from_world in zip(pending, solved, strict=True):
            for view, into in enumerate(self.trajectories):
                pose = self._mounts[view] @ rig_from_world
                fit = judge(self._judged(one, view, pose), self._map.adjuster.robust_scale_px)
                into.residual_px[one.index] = fit.residual_px
                into.inlier_ratio[one.index] = fit.inlier_ratio
                into.coverage[one.index] = fit.coverage
            # One pose for all: it holds when any view bears it out.
            supported = max(float(into.inlier_ratio[one.index]) for into in self.trajectories) >= MIN_INLIERS
            if supported and np.isfinite(rig_from_world).all():
                for view, into in enumerate(self.trajectories):
                    into.cam_from_world[one.index] = self._mounts[view] @ rig_from_world
                    into.interpolated[one.index] = False

    def _measure(self, index: int, features: tuple[Any, ...], start: Array) -> _Pending:
        """Match each view from the keyframe before it and the one after it, or from the last two."""
        after = bisect.bisect_left(self._instants, index)
        nearest = {max(0, after - 1), min(after, len(self._instants) - 1)}
        if len(nearest) == 1 and len(self._instants) > 1:
            nearest.add(max(0, after - 2))
        sightings = []
        views = self._keyframes.num_views
        for view, seen in enumerate(features):
            if view in self._blind:
                continue
            said = np.zeros(self._keyframes.grid.num_cells, dtype=np.float32)
            for instant in sorted(nearest):
                k = instant * views + view
                guess_px = self._induced(k, self._mounts[view] @ start).target_px
                match = self._matcher.match_fast(self._keyframes.features[k], seen, guess_px)
                if self._tracks_only is not None:
                    match = self._tracks_only.match(self._keyframes.features[k], seen, match)
                sightings.append(Sighting(k, view, match, self._map.usable[k]))
                said += carried(self._map.labels[k], match, self._keyframes.grid)
            self.trajectories[view].labels[index] = np.sign(said)
        scale_px = self._map.adjuster.robust_scale_px
        found = consensus_rig_pose(self._reprojector, self._keyframes, sightings, scale_px)
        if found is None or found[1] < MAJORITY:
            return _Pending(index, features, np.array(start), tuple(sightings))
        agreed = []
        for sighting in sightings:
            induced = self._induced(sighting.keyframe, self._mounts[sighting.view] @ found[0])
            error = np.linalg.norm(induced.target_px - sighting.match.target_px, axis=1)
            agreed.append(replace(sighting, usable=sighting.usable & (error < scale_px)))
        return _Pending(index, features, found[0], tuple(agreed))

    def _sharpened(self, one: _Pending, rig_from_world: Array, aligner: Aligner) -> _Pending:
        """The instant with measurements that start from its pose."""
        sightings = []
        for sighting in one.sightings:
            k, view = sighting.keyframe, sighting.view
            induced = self._induced(k, self._mounts[view] @ rig_from_world)
            guess_px = np.where(induced.visible[:, None], induced.target_px, np.float32(np.nan))
            aligned = aligner.align(self._keyframes.features[k], one.features[view], guess_px, self._map.usable[k])
            sightings.append(replace(sighting, match=sharpen(sighting.match, aligned)))
        return _Pending(one.index, one.features, np.array(rig_from_world), tuple(sightings))

    def _induced(self, k: int, cam_from_world: Array) -> Induced:
        """Where a pose of the same view sees the cells of keyframe `k`."""
        seen_from_keyframe = relative(cam_from_world, self._keyframes.pose(k))
        return self._reprojector.induced(self._keyframes.intrinsics_at(k), seen_from_keyframe, self._keyframes.depth(k))

    def _adjusted(self, pending: list[_Pending], schedule: Sequence[Step]) -> NDArray[np.float64] | None:
        """(B, 4, 4) rig poses by a motion-only adjustment: keyframes are fixed sources, instants are free targets."""
        keyframes, device, views = self._keyframes, self._map.adjuster.device, self._keyframes.num_views
        sources = sorted({sighting.keyframe for one in pending for sighting in one.sightings})
        number = {k: row for row, k in enumerate(sources)}
        first = len(sources)
        total = first + len(pending) * views
        links = [(first + row * views, sighting) for row, one in enumerate(pending) for sighting in one.sightings]
        edges = Edges(
            source=torch.tensor([number[sighting.keyframe] for _, sighting in links]),
            target=torch.tensor([at + sighting.view for at, sighting in links]),
            target_px=uploaded(np.stack([sighting.match.target_px for _, sighting in links]), device),
            weight=torch.from_numpy(
                np.stack([sighting.match.weight * sighting.usable[:, None] for _, sighting in links])
            ).to(device),
        )
        start = [keyframes.pose(k) for k in sources]
        start += [mount @ one.start for one in pending for mount in self._mounts]
        depths = np.ones((total, keyframes.grid.num_cells), dtype=np.float32)
        depths[:first] = np.stack([keyframes.depth(k) for k in sources])
        behind = np.unique(np.array(sources) // views, return_inverse=True)[1]
        new, every = np.repeat(np.arange(len(pending)), views), np.tile(np.arange(views), len(pending))
        rig = Rig(
            uploaded(np.concatenate((behind, behind.max() + 1 + new)), device),
            uploaded(np.concatenate((np.array(sources) % views, every)), device),
        )
        problem = Problem(
            camera_model=keyframes.camera_model,
            grid=keyframes.grid,
            edges=edges,
            free=Free(
                poses=torch.arange(total) >= first,
                inverse_depth=torch.zeros(total, dtype=torch.bool),
            ),
            rig=rig,
        )
        state = self._map.adjuster.state(np.stack(start), depths, keyframes.intrinsics, self._mounts)
        result = self._map.adjuster.anneal(problem, state, schedule)
        if result is None:
            return None
        poses = result.state.cam_from_world[first::views].cpu().numpy()
        return np.asarray(np.linalg.inv(self._mounts[0]) @ poses)

    def _judged(self, one: _Pending, view: int, cam_from_world: Array) -> Iterator[tuple[Induced, Match, Array]]:
        for sighting in one.sightings:
            if sighting.view == view:
                induced = self._induced(sighting.keyframe, cam_from_world)
                yield induced, sighting.match, self._map.usable[sighting.keyframe]
