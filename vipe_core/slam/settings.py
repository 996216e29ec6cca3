"""Every number that steers the SLAM stage, in one frozen value.

Lengths are pixels of a working image that is 640 wide; `SlamSettings.scaled_px` converts them to the actual width.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from vipe_core.errors import ConfigError
from vipe_core.slam.recurrent.settings import RefinementSettings


@dataclass(frozen=True, slots=True)
class EnergyTerms:
    """Which terms of the energy are there (paper section 3.2): switches for the ablation of its table 4.

    Attributes:
        dense_flow: The dense flow term. Flow still guides the tracks and the choice of keyframes when it is off.
        sparse_tracks: The sparse point term.
        depth_prior: The inverse-depth prior.
        motion_masks: Masks on things that move by themselves.

    Raises:
        ConfigError: Neither dense flow nor sparse tracks are on, so that nothing would be measured.
    """

    dense_flow: bool = True
    sparse_tracks: bool = True
    depth_prior: bool = True
    motion_masks: bool = True

    def __post_init__(self) -> None:
        if not (self.dense_flow or self.sparse_tracks):
            raise ConfigError("one of the terms dense_flow and sparse_tracks must be on")


@dataclass(frozen=True, slots=True)
class SlamSettings:
    """Settings of keyframe selection, tracking, global bundle adjustment and infill.

    Attributes:
        working_area_px: Pixel budget of the working image; a frame is never enlarged.
        keyframe_motion_px: Median textured displacement that makes a new keyframe.
        min_keyframes: The displacement is lowered until a moving clip has this many keyframes.
        static_motion_px: A clip whose every frame stays below this displacement has no camera motion.
        frame_cache_bytes: A clip whose working pictures fit is decoded and encoded once.
        sample_frames: Bound on the frames held for the intrinsics initialisation.
        neighbours: Previous keyframes that a new one is matched with.
        window: Keyframes that the sliding window optimises.
        backend_at: Increasing keyframe counts at which a global adjustment runs in between; after the last of them at
            every doubling.
        depth_prior_weight: Information of the smoothness prior, px^2 per (inverse depth / its median)^2.
        robust_scale_px: Scale of the Geman-McClure kernel after annealing.
        loop_edges_per_keyframe: Bound on proximity edges of the global graph.
        proximity_px: Largest mean induced displacement of a proximity edge.
        proximity_overlap: Least share of cells seen by both ends of a proximity edge.
        min_consistent: Least forward-backward consistency of a proximity edge, least aligned share of a wide one.
        wide_steps: Keyframes apart of the edges that are added when the geometry is known.
        wide_overlap: Least share of cells seen by both ends of such an edge.
        focal_sigma_inflation: Factor on the solver's formal 1-sigma of log focal that makes it match real errors.
        lens_sigma: 1-sigma of log focal from what more measurements do not average away: what a pinhole leaves out of
            a real lens, and matching errors that all frames share.
        fov_doubt_ratio: Half the width of the 95 % interval of the field of view, as a share of it, from which on the
            focal length counts as not observed.
        infill_batch: Frames posed in one motion-only adjustment.
        terms: Which terms of the energy are there.
        refinement: The schedule where measurements are refined in turns with the map.
    """

    working_area_px: int = 640 * 480
    keyframe_motion_px: float = 24.0
    min_keyframes: int = 8
    static_motion_px: float = 1.0
    frame_cache_bytes: int = 256 << 20
    sample_frames: int = 128
    neighbours: int = 2
    window: int = 8
    backend_at: tuple[int, ...] = (8, 16, 64, 256)
    depth_prior_weight: float = 2.0
    robust_scale_px: float = 3.0
    loop_edges_per_keyframe: float = 0.5
    proximity_px: float = 80.0
    proximity_overlap: float = 0.6
    min_consistent: float = 0.4
    wide_steps: tuple[int, ...] = (3, 4)
    wide_overlap: float = 0.4
    focal_sigma_inflation: float = 6.0
    lens_sigma: float = 0.015
    fov_doubt_ratio: float = 0.1
    infill_batch: int = 16
    terms: EnergyTerms = field(default_factory=EnergyTerms)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)

    def backend_due(self, num_keyframes: int) -> bool:
        """Whether a global adjustment runs at this many keyframes; their sizes sum to less than twice the last one."""
        if not self.backend_at or num_keyframes <= self.backend_at[-1]:
            return num_keyframes in self.backend_at
        doublings, rest = divmod(num_keyframes, self.backend_at[-1])
        return rest == 0 and doublings.bit_count() == 1

    def scaled_px(self, length_px: float, working_width: int) -> float:
        """A length stated for a 640 px wide image, in pixels of the actual working image."""
        return length_px * working_width / 640.0
