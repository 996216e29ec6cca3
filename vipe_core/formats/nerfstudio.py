"""A sequence as a nerfstudio data set: `transforms.json`, `images/`, 16-bit `depths/`, and the fused `points.ply`.

nerfstudio's cameras have OpenGL axes (y up, looking along -z) and its world has z up. Ours has the axes of the first
camera (y down), so the world is turned by `applied_transform`, points included. Depth is in 1/1000 of the world's unit
(millimetres if the sequence is metric), which is what nerfstudio expects; along the axis, for panoramas the distance.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from vipe_core.cameras import Camera
from vipe_core.errors import ExportUnsupported
from vipe_core.formats.atomic import EXPORT_FILE, complete_folder, write_json
from vipe_core.formats.colmap import write_jpeg
from vipe_core.formats.frames import read_frames
from vipe_core.formats.fused import MIN_CONFIDENCE, fuse_cloud
from vipe_core.formats.ply import write_ply
from vipe_core.formats.png16 import Png16Code, write_png16
from vipe_core.formats.reading import Artifacts
from vipe_core.fusion import PointCloud

_ZUP_FROM_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_OPENCV_FROM_OPENGL = np.diag([1.0, -1, -1, 1])
_DEPTH = Png16Code("depth", 1e-3, 0.0)


def export_nerfstudio(
    artifacts: Artifacts,
    out: str | Path,
    *,
    step: int = 1,
    voxel: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
) -> Path:
    """Write the folder `out`.

    Args:
        step: Every n-th frame becomes an image.
        voxel, min_confidence: Of the cloud, see `fuse_cloud`.

    Raises:
        ExportUnsupported: A unified (mei) camera, or a rational distortion, which nerfstudio has no models for; or the
            sequence has cuts.
        FormatError: No depth or no rgb, or `out` is something else than an earlier export.
    """
    intrinsics = _intrinsics(artifacts.name, artifacts.camera)
    cloud = fuse_cloud(artifacts, voxel=voxel, min_confidence=min_confidence, step=step)
    turn = _ZUP_FROM_WORLD[:3, :3].astype(np.float32)
    cloud = PointCloud(cloud.points @ turn.T, cloud.colours, cloud.normals @ turn.T, cloud.spacing)
    with complete_folder(Path(out)) as folder:
        (folder / "images").mkdir()
        (folder / "depths").mkdir()
        rows: list[dict[str, Any]] = []
        with closing(read_frames(artifacts, lambda index: index % step == 0)) as frames:
            for frame in frames:
                image, depth = f"images/{frame.index:05d}.jpg", f"depths/{frame.index:05d}.png"
                write_jpeg(folder / image, frame.rgb)
                write_png16(folder / depth, _DEPTH.encode(frame.depth))
                pose = _ZUP_FROM_WORLD @ artifacts.world_from_cam[frame.index] @ _OPENCV_FROM_OPENGL
                rows.append({"file_path": image, "depth_file_path": depth, "transform_matrix": pose.tolist()})
        write_ply(folder / "points.ply", cloud)
        transforms = {
            **intrinsics,
            "w": artifacts.camera.width,
            "h": artifacts.camera.height,
            "applied_transform": _ZUP_FROM_WORLD[:3].tolist(),
            "ply_file_path": "points.ply",
            "frames": rows,
        }
        write_json(folder / "transforms.json", transforms)
        description = {"format": "nerfstudio", "sequence": artifacts.name, "num_frames": len(rows)}
        write_json(folder / EXPORT_FILE, {**description, "scale": artifacts.info.get("scale", "metric")})
    return Path(out)


def _intrinsics(name: str, camera: Camera) -> dict[str, Any]:
    if camera.model == "mei":
        raise ExportUnsupported(
            f"{name}: nerfstudio has no model of a unified (mei) camera; use the format colmap, or --rectify"
        )
    if camera.model == "equirect":
        # Its panoramas map x / fl_x = -1..1 to the full turn, and y / fl_y = -1/2..1/2 to the half turn.
        half = camera.width / 2
        names = dict(zip(("fl_x", "fl_y", "cx", "cy"), (half, camera.height, half, camera.height / 2), strict=True))
        return {"camera_model": "EQUIRECTANGULAR", **names}
    names = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.params, strict=False))
    if camera.model == "opencv_fisheye":
        lens = dict(zip(("k1", "k2", "k3", "k4"), camera.params[4:], strict=True))
        return {"camera_model": "OPENCV_FISHEYE", **names, **lens}
    k1, k2, p1, p2, k3, *rational = camera.params[4:] or (0.0,) * 8
    if any(rational):
        raise ExportUnsupported(
            f"{name}: nerfstudio has no model of a rational distortion (k4 to k6); use the format colmap, or --rectify"
        )
    return {"camera_model": "OPENCV", **names, "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
