"""A sequence as a COLMAP reconstruction: `images/`, and `sparse/0/{cameras,images,points3D}` in binary or text.

The world is that of the poses. COLMAP's pixels have half-pixel centres like ours, its image poses are cam_from_world
with quaternions wxyz. Camera models: pinhole is PINHOLE; opencv is OPENCV, or FULL_OPENCV where it has more than four
coefficients; opencv_fisheye is OPENCV_FISHEYE; mei is EUCM with beta = 1 and panoramas are EQUIRECTANGULAR,
which COLMAP reads from version 4 on. u = fx X / (Z + a |P|) is EUCM's fx' X / (a' |P| + (1 - a') Z) with
a' = a / (1 + a) and fx' = fx / (1 + a). Points are those of the fused cloud that frames see, with where they see them.
"""

from __future__ import annotations

import struct
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.formats.atomic import EXPORT_FILE, complete_folder, write_json
from vipe_core.formats.frames import ArtifactFrame, read_frames
from vipe_core.formats.fused import MIN_CONFIDENCE, fuse_cloud
from vipe_core.formats.reading import Artifacts
from vipe_core.fusion import PointCloud
from vipe_core.geometry.arrays import inverse, quaternion_from_matrix

Array = NDArray[Any]

_JPEG_QUALITY = 95
_MAX_POINTS = 60_000
_MAX_SEEN = 2_000
# A frame sees a point where its own depth is this close to the point's.
_SAME = 0.02


@dataclass(frozen=True, slots=True)
class _Image:
    """A picture of the model: what it sees is rows of the cloud, and where, in COLMAP's pixels."""

    name: str
    rotation_wxyz: Array
    translation: Array
    seen: NDArray[np.int64]
    px: NDArray[np.float64]


def colmap_camera(camera: Camera) -> tuple[str, int, tuple[float, ...]]:
    """Name, number and parameters of the camera model in COLMAP."""
    if camera.model == "pinhole":
        return "PINHOLE", 1, camera.params
    if camera.model == "mei":
        fx, fy, cx, cy, alpha = camera.params
        return "EUCM", 16, (fx / (1 + alpha), fy / (1 + alpha), cx, cy, alpha / (1 + alpha), 1.0)
    if camera.model == "opencv_fisheye":
        return "OPENCV_FISHEYE", 5, camera.params
    if camera.model == "opencv":
        return ("FULL_OPENCV", 6, camera.params) if any(camera.params[8:]) else ("OPENCV", 4, camera.params[:8])
    return "EQUIRECTANGULAR", 17, (float(camera.width), float(camera.height))


def export_colmap(
    artifacts: Artifacts,
    out: str | Path,
    *,
    text: bool = False,
    step: int = 1,
    voxel: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
) -> Path:
    """Write the folder `out`.

    Args:
        text: Write `.txt` instead of `.bin`.
        step: Every n-th frame becomes an image.
        voxel, min_confidence: Of the cloud, see `fuse_cloud`.

    Raises:
        ExportUnsupported: The sequence has cuts.
        FormatError: No depth or no rgb, or `out` is something else than an earlier export.
    """
    cloud = fuse_cloud(artifacts, voxel=voxel, min_confidence=min_confidence, step=step)
    cloud = cloud.where(np.arange(0, len(cloud), max(1, -(-len(cloud) // _MAX_POINTS))))
    with complete_folder(Path(out)) as folder:
        (folder / "images").mkdir()
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        images = []
        with closing(read_frames(artifacts, lambda index: index % step == 0)) as frames:
            for frame in frames:
                images.append(_image(artifacts, frame, cloud))
                write_jpeg(folder / "images" / images[-1].name, frame.rgb)
        write = _write_text if text else _write_binary
        write(model, artifacts.camera, images, cloud)
        description = {"format": "colmap", "sequence": artifacts.name, "num_frames": len(images)}
        write_json(folder / EXPORT_FILE, {**description, "scale": artifacts.info.get("scale", "metric")})
    return Path(out)


def write_jpeg(path: Path, rgb: NDArray[np.uint8], quality: int = _JPEG_QUALITY) -> None:
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    path.write_bytes(data.tobytes())


def _image(artifacts: Artifacts, frame: ArtifactFrame, cloud: PointCloud) -> _Image:
    camera = artifacts.camera
    pose = inverse(artifacts.world_from_cam[frame.index])
    points = cloud.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    px, imaged = camera.project(points)
    col, row = np.rint(px[:, 0]), np.rint(px[:, 1])
    inside = imaged & (col >= 0) & (row >= 0) & (col < camera.width) & (row < camera.height)
    seen = np.flatnonzero(inside)
    depth = frame.depth[row[seen].astype(np.int64), col[seen].astype(np.int64)]
    away = points[seen, 2] if artifacts.depth_kind == "z" else np.linalg.norm(points[seen], axis=1)
    seen = seen[(away > 0) & (depth > 0) & (np.abs(depth - away) < _SAME * away)]
    seen = seen[:: max(1, -(-len(seen) // _MAX_SEEN))]
    x, y, z, w = quaternion_from_matrix(pose[:3, :3])
    return _Image(f"{frame.index:05d}.jpg", np.array([w, x, y, z]), pose[:3, 3], seen, px[seen] + 0.5)


def _tracks(images: list[_Image], count: int) -> list[list[tuple[int, int]]]:
    """For each point, (number of the image, number of the pixel in it)."""
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for number, image in enumerate(images, 1):
        for at, point in enumerate(image.seen.tolist()):
            tracks[point].append((number, at))
    return tracks


def _write_binary(folder: Path, camera: Camera, images: list[_Image], cloud: PointCloud) -> None:
    _, model, params = colmap_camera(camera)
    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<QIiQQ", 1, 1, model, camera.width, camera.height))
        file.write(struct.pack(f"<{len(params)}d", *params))
    seen_type = np.dtype([("px", "<f8", 2), ("point", "<u8")])
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for number, image in enumerate(images, 1):
            file.write(struct.pack("<I4d3dI", number, *image.rotation_wxyz, *image.translation, 1))
            file.write(image.name.encode("ascii") + b"\0" + struct.pack("<Q", len(image.seen)))
            rows = np.empty(len(image.seen), seen_type)
            rows["px"], rows["point"] = image.px, image.seen + 1
            file.write(rows.tobytes())
    tracks = _tracks(images, len(cloud))
    used = [n for n, track in enumerate(tracks) if track]
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(used)))
        for n in used:
            track = tracks[n]
            file.write(
                struct.pack("<Q3d3BdQ", n + 1, *cloud.points[n].tolist(), *cloud.colours[n].tolist(), -1.0, len(track))
            )
            file.write(np.array(track, "<u4").tobytes())


def _write_text(folder: Path, camera: Camera, images: list[_Image], cloud: PointCloud) -> None:
    name, _, params = colmap_camera(camera)
    numbers = " ".join(repr(float(value)) for value in params)
    (folder / "cameras.txt").write_text(f"1 {name} {camera.width} {camera.height} {numbers}\n", encoding="ascii")
    with (folder / "images.txt").open("w", encoding="ascii") as file:
        for number, image in enumerate(images, 1):
            pose = " ".join(repr(float(value)) for value in (*image.rotation_wxyz, *image.translation))
            file.write(f"{number} {pose} 1 {image.name}\n")
            pixels = zip(image.px.tolist(), image.seen.tolist(), strict=True)
            file.write(" ".join(f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in pixels) + "\n")
    with (folder / "points3D.txt").open("w", encoding="ascii") as file:
        for n, track in enumerate(_tracks(images, len(cloud))):
            if track:
                place = " ".join(repr(value) for value in cloud.points[n].tolist())
                colour = " ".join(str(value) for value in cloud.colours[n].tolist())
                file.write(f"{n + 1} {place} {colour} -1 " + " ".join(f"{i} {at}" for i, at in track) + "\n")
