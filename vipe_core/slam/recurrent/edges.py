"""The edges between keyframes under refinement, and the adjustment of the map to what they say."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from vipe_core.ba.problem import Edges, Free, Priors, Problem, Result, State
from vipe_core.ba.reprojection import reproject
from vipe_core.priors.protocols import Match, Refined, Refiner, TrackedPoints
from vipe_core.slam.adjustment import Adjuster, Step
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.recurrent.depth_prior import DepthPrior
from vipe_core.slam.recurrent.tracks import EdgeTracks
from vipe_core.transfer import downloaded, uploaded

Pair = tuple[int, int]

# Information on staying put of a depth that no update has spoken of yet, as a share of the median squared.
_LEAST_DAMPING = 1e-2


class RefinedEdges:
    """Directed edges between the keyframes of a map, refined in turns with it.

    Args:
        lean, spilled: See `Refiner.begin`.
        prior: Of inverse depths; None where nothing is known of them.
        prior_information: Of it, in units of the map's median.
        seen: Points that were followed to the frames of the video, by their index; None without tracks.

    Attributes:
        active: Edges that are refined, in the order of their rows.
        stored: Edges that are not refined any more -> where they saw the cells (P, 2), and their weights (P, 2).
    """

    def __init__(
        self,
        refiner: Refiner,
        keyframes: KeyframeMap,
        adjuster: Adjuster,
        *,
        lean: bool,
        spilled: bool = False,
        prior: DepthPrior | None = None,
        prior_information: float = 0.0,
        seen: Mapping[int, TrackedPoints] | None = None,
    ) -> None:
        self._keyframes = keyframes
        self._adjuster = adjuster
        self._prior, self._prior_information = prior, prior_information
        self._refinement = refiner.begin(keyframes.grid, lean=lean, spilled=spilled)
        self._tracks = None if seen is None else EdgeTracks(keyframes.grid, seen, adjuster.device)
        self.active: list[Pair] = []
        self.stored: dict[Pair, tuple[Tensor, Tensor]] = {}
        self._ages: list[int] = []
        self._target_px: Tensor | None = None
        self._weight: Tensor | None = None
        self._damping: dict[int, Tensor] = {}

    def add(self, pairs: Sequence[Pair], most: int | None = None) -> None:
        """Start to refine edges; the oldest of the others are stored where there would be more than `most`."""
        if not pairs:
            return
        if most is not None and len(self.active) + len(pairs) > most:
            order = sorted(range(len(self.active)), key=lambda row: (-self._ages[row], row))
            dropped = set(order[: len(self.active) + len(pairs) - most])
            self._store(lambda row: row in dropped)
        seen = self.seen(pairs)
        features = self._keyframes.features
        self._refinement.add([(features[i], features[j]) for i, j in pairs], seen)
        if self._tracks is not None:
            index = self._keyframes.frame_index
            self._tracks.add((index[i], index[j]) for i, j in pairs)
        self.active += pairs
        self._ages += [0] * len(pairs)
        nothing = torch.zeros_like(seen)
        self._target_px = seen if self._target_px is None else torch.cat((self._target_px, seen))
        self._weight = nothing if self._weight is None else torch.cat((self._weight, nothing))

    def retire(self, oldest: int, first_source: int = 0) -> None:
        """Store the edges that were refined more than `oldest` times, or whose source is before `first_source`."""
        self._store(lambda row: self._ages[row] > oldest or self.active[row][0] < first_source)

    def forget(self, first: int) -> None:
        """Forget the stored edges that have an end before keyframe `first`: nothing asks for them any more."""
        self.stored = {edge: said for edge, said in self.stored.items() if min(edge) >= first}
        self._damping = {frame: said for frame, said in self._damping.items() if frame >= first}

    def remove_keyframe(self, k: int) -> None:
        """Forget the edges of keyframe `k`, whose number the next one takes."""
        self._select([row for row, edge in enumerate(self.active) if k not in edge])

        def renumbered(edge: Pair) -> Pair:
            return edge[0] - (edge[0] > k), edge[1] - (edge[1] > k)

        self.active = [renumbered(edge) for edge in self.active]
        self.stored = {renumbered(edge): said for edge, said in self.stored.items() if k not in edge}
        self._damping = {frame - (frame > k): said for frame, said in self._damping.items() if frame != k}

    def update(self) -> None:
        """One update of the active edges, from where the map sees their cells now."""
        refined: Refined = self._refinement.update(self.seen(self.active), [i for i, _ in self.active])
        device = self._adjuster.device
        self._target_px, self._weight = refined.target_px.to(device), refined.weight.to(device)
        if self._tracks is not None:
            self._target_px, self._weight = self._tracks.joined(self._target_px, self._weight)
        for frame, damping in zip(sorted({i for i, _ in self.active}), refined.damping.to(device), strict=True):
            self._damping[frame] = damping
        self._ages = [age + 1 for age in self._ages]

    def adjust(
        self, first_free: int, iterations: int, *, stored_from: int | None = None, free_focal: bool = False
    ) -> Result | None:
        """Adjust poses from keyframe `first_free` on and the depths of all sources; writes into the map.

        Without robust kernels: the weights are the network's own (paper, equation 2).

        Args:
            stored_from: Stored edges take part whose ends are both this keyframe or later; None leaves them out.
            free_focal: Whether the intrinsics are adjusted as well, under the prior of the focal length.
        """
        again = [edge for edge in sorted(self.stored) if stored_from is not None and min(edge) >= stored_from]
        pairs = [*self.active, *again]
        if not pairs or self._target_px is None or self._weight is None:
            return None
        frames = sorted({k for edge in pairs for k in edge})
        number = {k: row for row, k in enumerate(frames)}
        state = self._state(frames)
        # The graph stays on the host, where it is laid out: a solve waits for the GPU only for its answer.
        ends = torch.tensor([[number[i], number[j]] for i, j in pairs], dtype=torch.int64)
        measured = [(self._target_px, self._weight)]
        if again:
            said = [self.stored[edge] for edge in again]
            measured.append((torch.stack([px for px, _ in said]), torch.stack([weight for _, weight in said])))
        settings, prior = self._adjuster.settings, self._adjuster.focal_prior
        free_focal = free_focal and not prior.held
        expected, information = self._expected(frames, state)
        problem = Problem(
            camera_model=self._keyframes.camera_model,
            grid=self._keyframes.grid,
            edges=Edges(
                source=ends[:, 0].contiguous(),
                target=ends[:, 1].contiguous(),
                target_px=torch.cat([px for px, _ in measured]),
                weight=torch.cat([weight for _, weight in measured]),
            ),
            free=Free(
                poses=torch.tensor([k >= first_free for k in frames]),
                inverse_depth=torch.ones(len(frames), dtype=torch.bool),
                focal=free_focal,
                distortion=free_focal and not prior.same_lens,
            ),
            priors=Priors(
                inverse_depth=expected,
                inverse_depth_weight=information,
                log_focal=prior.log_focal if free_focal else None,
                log_focal_sigma=prior.sigma / settings.focal_sigma_inflation,
            ),
        )
        result = self._adjuster.anneal(problem, state, (Step("none", 1.0, iterations, 1e-4),))
        if result is None:
            return None
        after = result.state
        poses, depths, intrinsics = downloaded(after.cam_from_world, after.inverse_depth, after.intrinsics)
        for row, k in enumerate(frames):
            self._keyframes.set_pose(k, poses[row])
            self._keyframes.set_depth(k, depths[row])
        self._keyframes.intrinsics = intrinsics.astype(np.float64)
        return result

    def seen(self, pairs: Sequence[Pair]) -> Tensor:
        """(E, P, 2) float32 where the map sees the source cells of edges; NaN where it does not."""
        frames = sorted({k for edge in pairs for k in edge})
        number = {k: row for row, k in enumerate(frames)}
        ends = torch.tensor([[number[i], number[j]] for i, j in pairs], dtype=torch.int64)
        ends = uploaded(ends, self._adjuster.device)
        keyframes = self._keyframes
        px, valid = reproject(keyframes.camera_model, keyframes.grid, self._state(frames), ends[:, 0], ends[:, 1])
        return torch.where(valid[..., None], px, torch.nan)

    def file(self, graph: Graph) -> None:
        """Put what the active edges measured into a graph.

        The weights are in the unit of the others, but nothing like the share of cells that agree is known: what has
        half of the possible weight counts as that.
        """
        if self._target_px is None or self._weight is None:
            return
        targets, weights = downloaded(self._target_px, self._weight)
        for (i, j), target_px, weight in zip(self.active, targets, weights, strict=True):
            graph.add(i, j, Match(target_px, weight, float((weight.max(axis=1) > 0.5).mean())))

    def _expected(self, frames: Sequence[int], state: State) -> tuple[Tensor, Tensor]:
        """(F, P) each: inverse depths to keep to, and the information on them: where they are, and what is known."""
        median = state.inverse_depth.median().clamp(min=1e-6)
        unknown = torch.zeros_like(state.inverse_depth[0])
        each = torch.stack([self._damping.get(k, unknown) for k in frames]).to(state.inverse_depth)
        staying = (each + _LEAST_DAMPING) / median**2
        if self._prior is None:
            return state.inverse_depth, staying
        said = uploaded(self._prior.inverse_depths(frames), state.inverse_depth.device).to(state.inverse_depth)
        known = (said > 0) * (self._prior_information / median**2)
        information = staying + known
        return (staying * state.inverse_depth + known * said) / information, information

    def _state(self, frames: Sequence[int]) -> State:
        keyframes = self._keyframes
        return self._adjuster.state(
            np.stack([keyframes.pose(k) for k in frames]),
            np.stack([keyframes.depth(k) for k in frames]),
            keyframes.intrinsics,
        )

    def _store(self, finished: Callable[[int], bool]) -> None:
        rows = [row for row in range(len(self.active)) if finished(row)]
        if not rows or self._target_px is None or self._weight is None:
            return
        for row in rows:
            # Copies, so that no edge holds the memory of all.
            self.stored[self.active[row]] = (self._target_px[row].clone(), self._weight[row].clone())
        gone = set(rows)
        self._select([row for row in range(len(self.active)) if row not in gone])

    def _select(self, rows: list[int]) -> None:
        if len(rows) == len(self.active):
            return
        self._refinement.keep(rows)
        if self._tracks is not None:
            self._tracks.keep(rows)
        self.active = [self.active[row] for row in rows]
        self._ages = [self._ages[row] for row in rows]
        if self._target_px is not None and self._weight is not None:
            index = uploaded(torch.tensor(rows, dtype=torch.int64), self._target_px.device)
            self._target_px, self._weight = self._target_px[index], self._weight[index]
