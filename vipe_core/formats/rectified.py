"""A sequence as a pinhole sees it, for tools that know nothing else, and its pictures as files."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.errors import ConfigError, ExportUnsupported
from vipe_core.formats.artifacts import DISK_DEPTH_KINDS
from vipe_core.formats.atomic import EXPORT_FILE, complete_file, complete_folder, write_json
from vipe_core.formats.colmap import write_jpeg
from vipe_core.formats.reading import Artifacts

MAPS_FILE = "rectification.npz"
# A pinhole that sees more is all corners.
_MAX_OWN_FOV_DEG = 100.0
_WIDEST_DEG = 170.0


def pinhole_for(camera: Camera, fov_x_deg: float | None = None) -> Camera:
    """The centred pinhole with square pixels that shows the pictures of a camera; arguments as `rectified`.

    Raises:
        ConfigError: No pinhole has this field of view.
    """
    fov_x_deg = min(camera.fov_x_deg, _MAX_OWN_FOV_DEG) if fov_x_deg is None else fov_x_deg
    if not 0 < fov_x_deg < _WIDEST_DEG:
        raise ConfigError(f"a pinhole has a field of view of 0 to {_WIDEST_DEG:g} degrees, not {fov_x_deg:g}")
    return Camera.pinhole_from_fov(fov_x_deg, max(1, round(camera.width * camera.pixel_aspect)), camera.height)


def rectified(artifacts: Artifacts, fov_x_deg: float | None = None) -> Artifacts:
    """The same sequence as a pinhole sees it: centred, with square pixels, and at the same poses.

    The size is the same, but that oblong pixels make a picture wider or narrower, as players show it. Straight lines
    are straight. What the pinhole does not see is left out; what the pictures do not show is black, and without depth.

    Args:
        fov_x_deg: Horizontal field of view of the pinhole; that of the camera if None, but at most 100 degrees.

    Raises:
        ConfigError: No pinhole has this field of view.
    """
    camera = artifacts.camera
    pinhole = pinhole_for(camera, fov_x_deg)
    return replace(
        artifacts,
        camera=pinhole,
        intrinsics=np.tile(np.array(pinhole.params), (artifacts.num_frames, 1)),
        depth_kind=DISK_DEPTH_KINDS["pinhole"],
        seen_by=PixelMap(camera, pinhole),
    )


def write_maps(artifacts: Artifacts, path: str | Path) -> Path:
    """How the pictures of a rectified sequence were made, as an npz for `cv2.remap`.

    Keys: map_x, map_y (h, w) float32, pixel indices in the pictures on disk; K (3, 3) of the rectified ones, for pixel
    indices (half a pixel less than `params`); camera, params, width, height of the rectified ones, half-pixel centres,
    and source_camera, source_params, source_width, source_height of those on disk.

    Raises:
        ValueError: The sequence is not a rectified one.
    """
    if artifacts.seen_by is None:
        raise ValueError(f"{artifacts.name} is not rectified")
    pinhole, source, (map_x, map_y) = artifacts.camera, artifacts.seen_by.source, artifacts.seen_by.xy
    fx, fy, cx, cy = pinhole.index_params()
    with complete_file(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            map_x=map_x,
            map_y=map_y,
            K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            camera=np.array(pinhole.model),
            params=np.array(pinhole.params),
            width=np.array(pinhole.width),
            height=np.array(pinhole.height),
            source_camera=np.array(source.model),
            source_params=np.array(source.params),
            source_width=np.array(source.width),
            source_height=np.array(source.height),
        )
    return Path(path)


def export_pictures(artifacts: Artifacts, out: str | Path, *, step: int = 1) -> Path:
    """Write the folder `out`: `images/%05d.jpg`, and `camera.json`, which a run takes as its calibration.

    Args:
        step: Every n-th frame becomes a picture.

    Raises:
        ExportUnsupported: A panorama, which no calibration describes.
        FormatError: No rgb, or `out` is something else than an earlier export.
    """
    if artifacts.camera.model == "equirect":
        raise ExportUnsupported(f"{artifacts.name}: camera.json has no model of a panorama; use --rectify")
    count = 0
    with complete_folder(Path(out)) as folder:
        (folder / "images").mkdir()
        with closing(artifacts.pictures()) as pictures:
            for index, rgb in enumerate(pictures):
                if index % step == 0:
                    write_jpeg(folder / "images" / f"{index:05d}.jpg", rgb)
                    count += 1
        write_json(folder / "camera.json", Calibration(artifacts.camera).to_json())
        write_json(folder / EXPORT_FILE, {"format": "pictures", "sequence": artifacts.name, "num_frames": count})
    return Path(out)
