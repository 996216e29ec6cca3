"""Rigid transforms: the algebra holds at every angle, tiny and close to pi included."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vipe_core.geometry import arrays, matrix_from_quaternion, quaternion_from_matrix, se3

ANGLES = st.one_of(
    st.just(0.0),
    st.floats(1e-12, 1e-3),
    st.floats(1e-3, math.pi - 1e-3),
    st.floats(math.pi - 1e-3, math.pi - 1e-9),
)
UNIT = st.floats(-1.0, 1.0)


@st.composite
def twists(draw: st.DrawFn) -> torch.Tensor:
    axis = np.array([draw(UNIT), draw(UNIT), draw(UNIT)])
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    linear = 5 * np.array([draw(UNIT), draw(UNIT), draw(UNIT)])
    return torch.from_numpy(np.concatenate((linear, draw(ANGLES) * axis)))


def assert_close(actual: torch.Tensor, expected: torch.Tensor, atol: float = 1e-10) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


@given(twists())
def test_exp_is_the_matrix_exponential(twist: torch.Tensor) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3] = se3.skew(twist[3:]).numpy()
    generator[:3, 3] = twist[:3]
    assert_close(se3.exp(twist), torch.from_numpy(expm(generator)), 1e-9)


@given(twists())
def test_log_inverts_exp(twist: torch.Tensor) -> None:
    assert_close(se3.log(se3.exp(twist)), twist, 1e-6)
    assert_close(se3.exp(se3.log(se3.exp(twist))), se3.exp(twist), 1e-9)


@given(twists())
def test_log_is_accurate_at_small_angles(twist: torch.Tensor) -> None:
    small = twist * 1e-4
    assert_close(se3.log(se3.exp(small)), small, 1e-14)


@given(twists(), twists())
def test_inverse_and_relative(first: torch.Tensor, second: torch.Tensor) -> None:
    a, b = se3.exp(first), se3.exp(second)
    assert_close(a @ se3.inverse(a), torch.eye(4, dtype=torch.float64))
    assert_close(se3.relative(a, b) @ b, a)


@given(twists(), twists())
def test_adjoint_moves_a_twist_through_a_transform(pose: torch.Tensor, twist: torch.Tensor) -> None:
    transform = se3.exp(pose)
    moved = se3.exp((se3.adjoint(transform) @ twist[:, None])[:, 0])
    assert_close(moved, transform @ se3.exp(twist) @ se3.inverse(transform), 1e-8)


@given(twists(), twists())
def test_left_perturbation_of_both_ends_is_one_relative_twist(first: torch.Tensor, second: torch.Tensor) -> None:
    """exp(dj) Gj Gi^-1 exp(-di) = exp(dj - Ad(Tji) di) Tji to first order: what the BA's Jacobians rest on."""
    source, target = se3.exp(first), se3.exp(second)
    target_from_source = se3.relative(target, source)
    step = 1e-5
    di = torch.tensor([0.3, -0.2, 0.5, 0.1, 0.4, -0.6], dtype=torch.float64)
    dj = torch.tensor([-0.1, 0.7, 0.2, -0.5, 0.2, 0.3], dtype=torch.float64)
    moved = se3.relative(se3.exp(step * dj) @ target, se3.exp(step * di) @ source)
    tau = se3.log(se3.relative(moved, target_from_source)) / step
    assert_close(tau, dj - (se3.adjoint(target_from_source) @ di[:, None])[:, 0], 5e-3)


@given(twists(), twists(), st.floats(-0.5, 1.5))
def test_interpolation(first: torch.Tensor, second: torch.Tensor, fraction: float) -> None:
    start, end = se3.exp(first), se3.exp(second)
    share = torch.tensor(fraction, dtype=torch.float64)
    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    assert_close(se3.interpolate(start, end, zero), start, 1e-8)
    assert_close(se3.interpolate(start, end, one), end, 1e-7)
    middle = se3.interpolate(start, end, share)
    assert_close(middle[:3, :3] @ middle[:3, :3].mT, torch.eye(3, dtype=torch.float64), 1e-9)
    if se3.log(se3.relative(end, start))[3:].norm() < math.pi - 1e-2:
        # Inverting both ends inverts the path.
        inverted = se3.interpolate(se3.inverse(start), se3.inverse(end), share)
        assert_close(inverted, se3.inverse(middle), 1e-6)


@given(twists())
def test_quaternions_agree_with_scipy(twist: torch.Tensor) -> None:
    rotation = se3.exp(twist)[:3, :3]
    quaternion = quaternion_from_matrix(rotation)
    assert quaternion[3] >= 0
    assert_close(matrix_from_quaternion(quaternion), rotation, 1e-12)
    assert_close(matrix_from_quaternion(-3 * quaternion), rotation, 1e-12)
    expected = Rotation.from_matrix(rotation.numpy()).as_quat()
    assert abs(abs(float(np.dot(expected, quaternion.numpy()))) - 1) < 1e-9


def test_half_turns_have_logarithms() -> None:
    axes = torch.eye(3, dtype=torch.float64)
    turns = torch.cat((torch.zeros(3, 3, dtype=torch.float64), math.pi * axes), dim=-1)
    found = se3.log(se3.exp(turns))
    assert_close(found.abs(), turns, 1e-7)


def test_exp_and_log_are_differentiable_at_zero() -> None:
    zero = torch.zeros(6, dtype=torch.float64)
    forward = torch.func.jacfwd(lambda x: se3.log(se3.exp(x)))(zero)
    assert_close(forward, torch.eye(6, dtype=torch.float64))
    reverse = torch.func.jacrev(lambda x: se3.exp(x))(zero)
    assert reverse.isfinite().all()
    assert_close(reverse[:3, 3, :3], torch.eye(3, dtype=torch.float64))


def test_functions_are_batched() -> None:
    twist = torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = se3.exp(twist)
    assert_close(poses[1, 2], se3.exp(twist[1, 2]), 1e-14)
    assert_close(se3.log(poses)[1, 2], se3.log(poses[1, 2]), 1e-14)
    assert_close(se3.adjoint(poses)[0, 1], se3.adjoint(poses[0, 1]), 1e-14)
    assert_close(quaternion_from_matrix(poses[..., :3, :3])[0, 1], quaternion_from_matrix(poses[0, 1, :3, :3]), 1e-14)


class TestTrajectory:
    times = np.array([0.0, 1.0, 3.0])
    poses = arrays.exp(np.array([[0, 0, 0, 0, 0, 0.0], [1, 0, 0, 0, 0.2, 0], [1, 2, 0, 0.1, 0.2, 0]]))

    def test_goes_through_its_knots(self) -> None:
        np.testing.assert_allclose(
            arrays.interpolate_trajectory(self.times, self.poses, self.times), self.poses, atol=1e-12
        )

    def test_stays_at_its_ends_unless_told_to_go_on(self) -> None:
        held = arrays.interpolate_trajectory(self.times, self.poses, [-1.0, 5.0])
        np.testing.assert_allclose(held, self.poses[[0, -1]], atol=1e-12)
        on = arrays.interpolate_trajectory(self.times, self.poses, [5.0], extrapolate=True)[0]
        velocity = self.poses[2] @ arrays.inverse(self.poses[1])
        np.testing.assert_allclose(on, velocity @ self.poses[2], atol=1e-12)

    def test_middle_is_half_of_the_relative_twist(self) -> None:
        middle = arrays.interpolate_trajectory(self.times, self.poses, [2.0])[0]
        half = arrays.log(self.poses[2] @ arrays.inverse(self.poses[1])) / 2
        np.testing.assert_allclose(middle, arrays.exp(half) @ self.poses[1], atol=1e-12)

    def test_a_single_knot_is_constant(self) -> None:
        single = arrays.interpolate_trajectory([2.0], self.poses[1:2], [0.0, 9.0])
        np.testing.assert_allclose(single, self.poses[[1, 1]])


def test_numpy_quaternions_round_trip() -> None:
    xyzw = np.array([[0.1, -0.2, 0.3, 0.9], [1.0, 0.0, 0.0, 0.0]])
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    np.testing.assert_allclose(arrays.quaternion_from_matrix(arrays.matrix_from_quaternion(xyzw)), xyzw, atol=1e-12)
    np.testing.assert_allclose(arrays.matrix_from_quaternion([0, 0, math.sin(0.5), math.cos(0.5)])[0, 0], math.cos(1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype: torch.dtype) -> None:
    twist = torch.ones(6, dtype=dtype)
    assert se3.exp(twist).dtype == dtype
    assert se3.log(se3.exp(twist)).dtype == dtype
