"""The unknowns of a rig behind those of its frames.

A frame n = (pose p, view v) of a rig has G_n = C_v Q_p with C = cam_from_rig and Q = rig_from_world. With left
perturbations of both, exp(eps_v) C_v exp(delta_p) Q_p, the frame moves by the left twists

    delta_n = Ad(C_v) delta_p + eps_v

to first order, and exactly by exp(eps_v) exp(Ad(C_v) delta_p). So a solver that knows what a system says about the
twists of frames is done: frames of one pose, and of one view, add up through these maps. An edge between two frames of
one pose cancels in delta_p by itself, for Ad(T) Ad(C_i) = Ad(C_j); what it leaves there is rounding, so a pose that has
no other edge is not an unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vipe_core.ba.problem import Priors, Problem, State
from vipe_core.ba.solver import Step
from vipe_core.geometry import se3


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Which poses of a problem are unknown; without a rig every frame has one of its own.

    Attributes:
        pose_of_frame: (N,) int64, on the host.
        view_of_frame: (N,) int64, on the host; zeros without a rig.
        poses: (R,) bool, poses that move.
        views: (V,) bool, extrinsics that move.
    """

    pose_of_frame: Tensor
    view_of_frame: Tensor
    poses: Tensor
    views: Tensor

    @property
    def frames(self) -> Tensor:
        """(N,) bool, frames that move with anything."""
        return self.poses[self.pose_of_frame] | self.views[self.view_of_frame]


def unknowns_of(problem: Problem) -> Unknowns:
    """What moves.

    Raises:
        ValueError: The frames of a rig pose are not all free or all fixed.
    """
    edges, free = problem.edges, problem.free.poses.cpu()
    source, target = edges.source.cpu(), edges.target.cpu()
    num_frames = len(free)
    if problem.rig is None:
        touched = torch.zeros(num_frames, dtype=torch.bool)
        touched[source] = True
        touched[target] = True
        nowhere = torch.zeros(num_frames, dtype=torch.int64)
        return Unknowns(torch.arange(num_frames), nowhere, free & touched, torch.zeros(1, dtype=torch.bool))
    pose, view = problem.rig.pose_of_frame.cpu(), problem.rig.view_of_frame.cpu()
    num_poses, num_views = int(pose.max()) + 1, int(view.max()) + 1
    moving, held = torch.zeros(num_poses, dtype=torch.bool), torch.zeros(num_poses, dtype=torch.bool)
    moving[pose[free]] = True
    held[pose[~free]] = True
    if bool((moving & held).any()):
        raise ValueError("all frames of a rig pose must be free, or all fixed")
    apart = pose[source] != pose[target]
    touched = torch.zeros(num_poses, dtype=torch.bool)
    touched[pose[source[apart]]] = True
    touched[pose[target[apart]]] = True
    views = torch.zeros(num_views, dtype=torch.bool)
    if problem.free.extrinsics:
        views[view[source]] = True
        views[view[target]] = True
        views[0] = False
    return Unknowns(pose, view, moving & touched, views)


def turns_of(problem: Problem, state: State) -> Tensor | None:
    """(N, 6, 6) maps from the twists of rig poses to those of their frames, Ad(cam_from_rig); None without a rig.

    Raises:
        ValueError: The state of a rig without its extrinsics.
    """
    if problem.rig is None:
        return None
    if state.cam_from_rig is None:
        raise ValueError("the state of a rig needs cam_from_rig")
    return se3.adjoint(state.cam_from_rig)[problem.rig.view_of_frame.to(state.cam_from_rig.device)]


def moved_poses(problem: Problem, state: State, step: Step) -> tuple[Tensor, Tensor | None]:
    """cam_from_world and cam_from_rig after a step."""
    poses = se3.exp(step.pose) @ state.cam_from_world
    if problem.rig is None or step.extrinsic is None or state.cam_from_rig is None:
        return poses, state.cam_from_rig
    shift = se3.exp(step.extrinsic)
    return shift[problem.rig.view_of_frame.to(shift.device)] @ poses, shift @ state.cam_from_rig


def extrinsic_residual(cam_from_rig: Tensor, priors: Priors) -> Tensor:
    """(V, 6) how far extrinsics are from their prior, in standard deviations: place, and sine of the angle about the
    axes."""
    assert priors.cam_from_rig is not None
    assert priors.extrinsic_sigma is not None
    off = se3.relative(cam_from_rig, priors.cam_from_rig.to(cam_from_rig))
    rotation = off[:, :3, :3]
    skewed = rotation - rotation.mT
    sine = torch.stack((skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]), dim=-1) / 2
    place_sigma, rotation_sigma = priors.extrinsic_sigma.to(off)[..., None].unbind(1)
    return torch.cat((off[:, :3, 3] / place_sigma, sine / rotation_sigma), dim=-1)


def extrinsic_prior(priors: Priors, state: State) -> tuple[Tensor, Tensor, Tensor] | None:
    """Residual (V, 6), J^T J (V, 6, 6) and -J^T r (V, 6) of the prior by left twists of cam_from_rig; None without."""
    if priors.cam_from_rig is None or priors.extrinsic_sigma is None or state.cam_from_rig is None:
        return None
    residual = extrinsic_residual(state.cam_from_rig, priors)
    off = se3.relative(state.cam_from_rig, priors.cam_from_rig.to(state.cam_from_rig))
    rotation, place = off[:, :3, :3], off[:, :3, 3]
    place_sigma, rotation_sigma = priors.extrinsic_sigma.to(off)[..., None, None].unbind(1)
    jacobian = residual.new_zeros(len(off), 6, 6)
    identity = torch.eye(3, dtype=residual.dtype, device=residual.device)
    jacobian[:, :3, :3] = identity / place_sigma
    jacobian[:, :3, 3:] = -se3.skew(place) / place_sigma
    # R^T [w] + [w] R = [(tr(R) 1 - R) w].
    trace = rotation.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
    jacobian[:, 3:, 3:] = (trace * identity - rotation) / (2 * rotation_sigma)
    return residual, jacobian.mT @ jacobian, -(jacobian.mT @ residual[..., None])[..., 0]
