"""What a preset takes of a GPU, and the profile in which a clip fits into what it may have.

Nothing is measured here: sizes of networks and of what they work in are estimates, and a video that takes more than
planned runs out of memory as a typed error, which the service answers with the low-memory profile and then with more of
the GPU.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from vipe_core.ba.problem import Grid
from vipe_core.errors import OutOfDeviceMemory
from vipe_core.pipeline.presets import DROID, NONE, Preset
from vipe_core.priors.droid.memory import MemoryPlan, plan_memory
from vipe_core.priors.weights import WEIGHTS, selected

logger = logging.getLogger(__name__)

USABLE_SHARE = 0.9
"""Of a GPU: the rest is fragmentation, and what is not ours."""

_GB = 1e9
# Most that a network works in at a time, by provider: a few pictures of the size it takes, or a window of 32 frames.
_WORK_BYTES = {
    "hf.grounding_dino_sam2": 2_500_000_000,
    "hf.depth_pro": 4_000_000_000,
    "nvidia_vipe.metric3d_giant2": 3_000_000_000,
    "nvidia_vipe.video_depth_anything": 7_500_000_000,
}
_OTHER_WORK_BYTES = 1_500_000_000
# A working picture of 512 x 384: what clips are planned for before anything is known of them.
_USUAL_GRID = Grid(48, 64, 8.0, 4.0)
_USUAL_KEYFRAMES = 300


def plan_of(preset: Preset, grid: Grid, keyframes: int, *, lean: bool) -> MemoryPlan:
    """What a clip takes with a preset.

    Args:
        grid: Cells of its working pictures.
        keyframes: That it has, about.
        lean: In the low-memory profile.
    """
    slam = preset.slam
    refined = preset.matcher == DROID
    networks = [provider for provider in preset.providers.values() if provider != NONE and "classical" not in provider]
    others = [_WORK_BYTES.get(provider, _OTHER_WORK_BYTES) for provider in networks if provider != preset.matcher]
    return plan_memory(
        grid,
        keyframes=keyframes,
        window_edges=slam.refinement.window_edges,
        edges_per_keyframe=slam.refinement.global_edges,
        most_edges=slam.refinement.global_most_edges,
        fill_frames=slam.infill_batch,
        cache_bytes=slam.frame_cache_bytes,
        lean=lean or slam.refinement.lean,
        refined=refined,
        weight_bytes=sum(WEIGHTS[name].size_bytes for name in selected(preset.weights)),
        other_work_bytes=max(others, default=0),
    )


def usual_bytes(preset: Preset) -> int:
    """What a video of one or two minutes takes with a preset: what places on a GPU are planned for."""
    return plan_of(preset, _USUAL_GRID, _USUAL_KEYFRAMES, lean=False).total_bytes


def idle_bytes(preset: Preset) -> int:
    """What a process keeps of a GPU between two videos."""
    plan = plan_of(preset, _USUAL_GRID, 0, lean=True)
    return plan.process_bytes + plan.weight_bytes


@dataclass(slots=True)
class MemoryBudget:
    """What a video may take of its device, and what was made of it.

    Attributes:
        preset: That annotates it.
        size_bytes: None where nothing bounds it, as on a CPU.
        lean: The low-memory profile, whatever would fit; set where only that fits.
    """

    preset: Preset
    size_bytes: int | None
    lean: bool = False

    def fit(self, name: str, grid: Grid, keyframes: int) -> bool:
        """Whether so many keyframes take the low-memory profile.

        Raises:
            OutOfDeviceMemory: They do not fit in that either.
        """
        if self.size_bytes is None:
            return self.lean
        if not self.lean and plan_of(self.preset, grid, keyframes, lean=False).total_bytes > self.size_bytes:
            logger.info("%s: the low-memory profile, for %.1f GB", name, self.size_bytes / _GB)
            self.lean = True
        if not self.lean:
            return False
        needed_bytes = plan_of(self.preset, grid, keyframes, lean=True).total_bytes
        if needed_bytes > self.size_bytes:
            raise OutOfDeviceMemory(
                f"{name}: {keyframes} keyframes or more take about {needed_bytes / _GB:.1f} GB of GPU memory in the "
                f"low-memory profile, and {self.size_bytes / _GB:.1f} GB are there for it: use a larger GPU, run fewer "
                "videos on it at once, or split the video",
                needed_bytes,
            )
        return True
