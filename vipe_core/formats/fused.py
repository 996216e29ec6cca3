"""Clouds and meshes of a sequence on disk."""

from __future__ import annotations

from contextlib import closing

import numpy as np

from vipe_core.cameras import Camera
from vipe_core.errors import ExportUnsupported, FormatError
from vipe_core.formats.frames import read_frames, spread
from vipe_core.formats.reading import Artifacts
from vipe_core.fusion import CloudFuser, Mesh, PointCloud, TsdfVolume

MIN_CONFIDENCE = 0.1
# A voxel as a share of the median depth, so that a room is about half a million points whatever its scale; and in
# pixels: what one covers at that depth, and a margin.
_CLOUD_SHARE = 1 / 250
_MESH_SHARE = 1 / 120
_VOXEL_PX = 1.5
_MIN_FRAMES = 3
# Frames that must look through a point before it goes, of this many that are asked.
_WITNESSES = 32
_AGAINST = 3


def median_depth(artifacts: Artifacts) -> float:
    """Of nine frames, in units of the world.

    Raises:
        FormatError: No depth, or none of its values is one.
    """
    with artifacts.open_depth() as reader:
        values = [depth[depth > 0][::7] for depth in (reader.read(k) for k in sorted(spread(len(reader), 9)))]
    known = np.concatenate(values)
    if not len(known):
        raise FormatError(f"{artifacts.name}: its depth maps hold no value")
    return float(np.median(known))


def pixel_angle(camera: Camera) -> float:
    """Radians between neighbouring pixels in the middle of the picture."""
    x, y = camera.width / 2, camera.height / 2
    a, b = camera.unproject(np.array([[x, y], [x + 1, y]]))
    return float(np.linalg.norm(np.cross(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b)))


def _need_one_shot(artifacts: Artifacts) -> None:
    """Raises:
    ExportUnsupported: The sequence has cuts, so no world that its frames share.
    """
    if artifacts.cuts:
        at = ", ".join(map(str, artifacts.cuts))
        raise ExportUnsupported(
            f"{artifacts.name}: the video has cuts (at frame {at}), and its shots share no world; take one by --shot"
        )


def fuse_cloud(
    artifacts: Artifacts,
    *,
    voxel: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
    max_points: int = 4_000_000,
    step: int = 1,
) -> PointCloud:
    """One cloud of all frames: what moves, what nobody measured, edges, and what other frames see through are left out.

    Args:
        voxel: Distance between points, units of the world; a share of the median depth if None.
        min_confidence: Depth of less confidence is not used.
        max_points: Bounds memory; a cloud that would have more gets larger voxels.
        step: Use every n-th frame.

    Raises:
        ExportUnsupported: The sequence has cuts.
        FormatError: No depth or no rgb.
    """
    _need_one_shot(artifacts)
    depth, pixel = median_depth(artifacts), pixel_angle(artifacts.camera)
    size = depth * max(_CLOUD_SHARE, _VOXEL_PX * pixel) if voxel is None else voxel
    fuser = CloudFuser(artifacts.camera, artifacts.depth_kind, size, max_points=max_points)
    with closing(read_frames(artifacts, lambda index: index % step == 0)) as frames:
        for frame in frames:
            fuser.add(frame.view(artifacts, min_confidence))
    # Voxels that are smaller than pixels are not hit twice, however often their place is seen.
    cloud = fuser.cloud(min_frames=_MIN_FRAMES if fuser.voxel > pixel * depth else 1)
    against = np.zeros(len(cloud), np.int32)
    asked = spread(artifacts.num_frames, _WITNESSES)
    with closing(read_frames(artifacts, asked.__contains__)) as frames:
        for frame in frames:
            fuser.looked_through(cloud, frame.view(artifacts, min_confidence), against)
    return cloud.where(against < min(_AGAINST, len(asked)))


def fuse_mesh(
    artifacts: Artifacts,
    *,
    voxel: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
    max_blocks: int = 24_000,
    step: int = 1,
) -> Mesh:
    """One mesh of all frames, from a truncated signed distance field; the arguments are those of `fuse_cloud`.

    Args:
        max_blocks: Bounds memory at about 10 kB each; a field that would have more gets larger voxels.

    Raises:
        ExportUnsupported: The sequence has cuts.
        FormatError: No depth or no rgb.
    """
    _need_one_shot(artifacts)
    depth, pixel = median_depth(artifacts), pixel_angle(artifacts.camera)
    size = depth * max(_MESH_SHARE, _VOXEL_PX * pixel) if voxel is None else voxel
    volume = TsdfVolume(artifacts.camera, artifacts.depth_kind, size, max_blocks=max_blocks)
    used = 0
    with closing(read_frames(artifacts, lambda index: index % step == 0)) as frames:
        for frame in frames:
            volume.add(frame.view(artifacts, min_confidence))
            used += 1
    # What one frame saw, once and with little confidence, is not yet a surface.
    return volume.mesh(min_weight=min_confidence * min(_MIN_FRAMES, used))
