"""One surface from the depth of many frames: a point cloud, or a mesh. Both stream and stay within a stated memory."""

from vipe_core.fusion.cloud import CloudFuser, PointCloud
from vipe_core.fusion.tsdf import Mesh, TsdfVolume
from vipe_core.fusion.views import SurfaceView, surface_weight

__all__ = ["CloudFuser", "Mesh", "PointCloud", "SurfaceView", "TsdfVolume", "surface_weight"]
