"""Poses of frames between keyframes by refinement: the keyframes on either side, and nothing but the pose is free
(paper section 3.1, step 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Edges, Free, Problem
from vipe_core.ba.reprojection import reproject
from vipe_core.priors.protocols import Match, Refiner
from vipe_core.slam.adjustment import Adjuster, Step
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.transfer import downloaded, uploaded

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Unposed:
    """A frame that is to be posed.

    Attributes:
        features: The matcher's of it.
        start: (4, 4) cam_from_world.
        sources: Keyframes that it is seen from.
    """

    features: Any
    start: NDArray[np.float64]
    sources: tuple[int, ...]


class FramePoser:
    """Poses frames against a finished map.

    Args:
        usable: (K, P) bool, cells of each keyframe that take part.
    """

    def __init__(
        self,
        refiner: Refiner,
        keyframes: KeyframeMap,
        adjuster: Adjuster,
        usable: NDArray[np.bool_],
        settings: RefinementSettings,
    ) -> None:
        self._refiner = refiner
        self._keyframes = keyframes
        self._adjuster = adjuster
        self._usable = usable
        self._settings = settings

    def run(self, frames: Sequence[Unposed]) -> tuple[NDArray[np.float64], list[tuple[tuple[int, Match], ...]]]:
        """Pose frames together.

        Returns:
            (B, 4, 4) cam_from_world, and for each frame what was measured of it from its keyframes.
        """
        keyframes, device = self._keyframes, self._adjuster.device
        sources = sorted({k for frame in frames for k in frame.sources})
        number = {k: row for row, k in enumerate(sources)}
        first, total = len(sources), len(sources) + len(frames)
        edges = [(k, row) for row, frame in enumerate(frames) for k in frame.sources]
        ends = torch.tensor([[number[k], first + row] for k, row in edges], dtype=torch.int64)
        source, target = ends[:, 0].contiguous(), ends[:, 1].contiguous()
        # A graph is laid out on the host, and read where the state is.
        there = uploaded(ends, device)
        depths = np.ones((total, keyframes.grid.num_cells), dtype=np.float32)
        depths[:first] = np.stack([keyframes.depth(k) for k in sources])
        poses = np.stack([*(keyframes.pose(k) for k in sources), *(frame.start for frame in frames)])
        state = self._adjuster.state(poses, depths, keyframes.intrinsics)
        kept = uploaded(np.stack([self._usable[k] for k, _ in edges]), device)
        free = Free(poses=torch.arange(total) >= first, inverse_depth=torch.zeros(total, dtype=torch.bool))
        refinement = self._refiner.begin(keyframes.grid, lean=self._settings.lean)
        step = Step("none", 1.0, self._settings.iterations, 1e-4)
        for update in range(self._settings.fill_updates):
            px, valid = reproject(keyframes.camera_model, keyframes.grid, state, there[:, 0], there[:, 1])
            seen = torch.where(valid[..., None], px, torch.nan)
            if update == 0:
                refinement.add([(keyframes.features[k], frames[row].features) for k, row in edges], seen)
            refined = refinement.update(seen, [k for k, _ in edges])
            measured = Edges(source, target, refined.target_px.to(device), refined.weight.to(device) * kept[..., None])
            problem = Problem(keyframes.camera_model, keyframes.grid, measured, free)
            result = self._adjuster.anneal(problem, state, (step,))
            if result is not None:
                state = result.state
        poses, targets, weights = downloaded(state.cam_from_world[first:], refined.target_px, refined.weight)
        matches: list[list[tuple[int, Match]]] = [[] for _ in frames]
        for (k, row), target_px, weight in zip(edges, targets, weights, strict=True):
            sure = float((weight.max(axis=1) > 0.5).mean())
            matches[row].append((k, Match(target_px, weight, sure)))
        return poses, [tuple(each) for each in matches]
