"""Rigid and similarity transforms, batched."""

from vipe_core.geometry.quaternion import matrix_from_quaternion, quaternion_from_matrix
from vipe_core.geometry.sim3 import Sim3, umeyama

__all__ = ["Sim3", "matrix_from_quaternion", "quaternion_from_matrix", "umeyama"]
