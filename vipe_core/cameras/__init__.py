"""Camera models: one value type, and the projection functions of each model (`projection`)."""

from vipe_core.cameras.camera import MODEL_CODE, Camera, CameraModel

__all__ = ["MODEL_CODE", "Camera", "CameraModel"]
