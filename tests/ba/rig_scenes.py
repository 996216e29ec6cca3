"""Synthetic bundle adjustment problems of rigs with a known answer."""

from __future__ import annotations

import torch
from ba_scenes import disturbed

from vipe_core.ba import Edges, Free, Grid, Problem, Rig, State, reproject
from vipe_core.cameras import CameraModel
from vipe_core.geometry import se3


def rig_scene(
    camera_model: CameraModel = "pinhole",
    num_poses: int = 4,
    num_views: int = 2,
    own_intrinsics: bool = False,
    seed: int = 0,
    height: int = 4,
    width: int = 5,
    spread: float = 0.15,
) -> tuple[Problem, State]:
    """A rig of cameras that look about the same way before a rough wall; exact measurements.

    Every view is linked with itself one and two instants away, and with the next view at the same instant and one away.
    Frames are in order of time, the views of an instant together; two poses hold the gauge.
    """
    rng = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    grid = Grid(height, width)
    focal = 0.9 * width * grid.stride * torch.exp(0.1 * noise(num_views, 1))
    centre = torch.tensor([width * grid.stride / 2 - 0.5, height * grid.stride / 2 - 0.5], dtype=torch.float64)
    parts = [focal, 1.05 * focal, centre + noise(num_views, 2)]
    if camera_model == "mei":
        alpha = 0.6 + 0.1 * noise(num_views, 1)
        parts = [focal * (1 + alpha), focal * (1 + alpha), centre + noise(num_views, 2), alpha]
    cameras = torch.cat(parts, dim=1)
    cam_from_rig = se3.exp(spread * noise(num_views, 6))
    twists = 0.03 * noise(num_poses, 6)
    twists[:, 0] += 0.25 * torch.arange(num_poses, dtype=torch.float64)
    rig = Rig(torch.arange(num_poses).repeat_interleave(num_views), torch.arange(num_views).repeat(num_poses))
    poses = cam_from_rig[rig.view_of_frame] @ se3.exp(twists)[rig.pose_of_frame]
    depth = 0.3 + 0.7 * torch.rand(len(poses), grid.num_cells, generator=rng, dtype=torch.float64)
    state = State(poses, depth, cameras if own_intrinsics else cameras[0], cam_from_rig)
    pairs = []
    for i in range(len(poses)):
        for j in range(len(poses)):
            apart, view_apart = abs(i // num_views - j // num_views), (j - i) % num_views
            if i != j and ((view_apart == 0 and apart <= 2) or (view_apart == 1 and apart <= 1)):
                pairs.append((i, j))
    source, target = torch.tensor(pairs).T.contiguous()
    target_px, valid = reproject(camera_model, grid, state, source, target, rig=rig)
    weight = 0.2 + torch.rand(len(pairs), grid.num_cells, 2, generator=rng, dtype=torch.float64)
    free_poses = rig.pose_of_frame >= 2
    free = Free(free_poses, torch.ones(len(poses), dtype=torch.bool))
    return Problem(
        camera_model, grid, Edges(source, target, target_px, weight * valid[..., None]), free, rig=rig
    ), state


def disturbed_rig(problem: Problem, state: State, seed: int = 1, twist: float = 0.02, turn: float = 0.0) -> State:
    """The state with noise on depths, focal lengths, free poses, and extrinsics (`turn`) but for view 0."""
    rng = torch.Generator().manual_seed(seed)
    rig, extrinsics = problem.rig, state.cam_from_rig
    assert rig is not None
    assert extrinsics is not None
    start = disturbed(state, seed, twist=0.0, log_focal=0.0)
    rig_from_world = se3.inverse(extrinsics[rig.view_of_frame]) @ state.cam_from_world
    noise = twist * torch.randn(int(rig.pose_of_frame.max()) + 1, 6, generator=rng, dtype=torch.float64)
    moved = se3.exp(noise[rig.pose_of_frame] * problem.free.poses[:, None]) @ rig_from_world
    off = turn * torch.randn(len(extrinsics), 6, generator=rng, dtype=torch.float64)
    off[0] = 0
    cam_from_rig = se3.exp(off) @ extrinsics
    intrinsics = start.intrinsics.clone()
    intrinsics[..., :2] *= 1.01 if problem.free.focal else 1.0
    return State(cam_from_rig[rig.view_of_frame] @ moved, start.inverse_depth, intrinsics, cam_from_rig)


__all__ = ["disturbed_rig", "rig_scene"]
