"""Camera models: one value type, and the projection functions of each model (`projection`)."""

from vipe_core.cameras.camera import Camera, CameraModel

__all__ = ["Camera", "CameraModel"]
