"""Writing an annotation as ViPE artifacts: `pose`, `intrinsics`, `depth`, `rgb`, `mask`, our own `confidence`, and
`vipe/NAME_info.json`.

Payload bytes depend on the annotation only (never on time, order of hashing or this machine's paths), and nothing
appears under its final name before all of it is complete. Upstream keeps its description in a pickle; ours is JSON.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DEPTH_KINDS, Annotation, DenseFrame, DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import EngineError
from vipe_core.formats.depth_zip import DepthZipWriter
from vipe_core.formats.frame_zip import FrameZipWriter
from vipe_core.formats.layout import artifact_files, artifact_path, info_path
from vipe_core.formats.png_zip import ConfidenceZipWriter, KindZipWriter, MaskZipWriter
from vipe_core.video.encode import VideoWriter
from vipe_core.video.naming import sanitise_name

Attribute = Literal["pose", "intrinsics", "depth", "rgb", "mask", "confidence"]
ALL_ATTRIBUTES: tuple[Attribute, ...] = ("pose", "intrinsics", "depth", "rgb", "mask", "confidence")

INFO_SCHEMA = 1
# What a depth value means on disk is fixed by the camera: along the axis, except for panoramas.
DISK_DEPTH_KINDS: dict[CameraModel, DepthKind] = {
    "pinhole": "z",
    "mei": "z",
    "equirect": "ray",
    "opencv": "z",
    "opencv_fisheye": "z",
}
# Key, attribute and member of everything that is written frame by frame.
_DENSE = (
    ("depth", "depth", "zip"),
    ("rgb", "rgb", "mp4"),
    ("mask", "mask", "zip"),
    ("confidence", "confidence", "zip"),
    ("kind", "confidence", "kind.zip"),
)
# The last two are no models of the original tool: it refuses them, which is better than to take them for pinholes.
DISK_CAMERA_NAMES: dict[CameraModel, str] = {
    "pinhole": "PINHOLE",
    "mei": "MEI",
    "equirect": "PANORAMA",
    "opencv": "OPENCV",
    "opencv_fisheye": "OPENCV_FISHEYE",
}


@dataclass(frozen=True, slots=True)
class ArtifactPaths:
    """What was written; None for an attribute that was not asked for."""

    root: Path
    name: str
    info: Path
    pose: Path | None
    intrinsics: Path | None
    camera_txt: Path | None
    depth: Path | None
    rgb: Path | None
    mask: Path | None
    mask_txt: Path | None
    confidence: Path | None
    kind: Path | None

    @property
    def files(self) -> tuple[Path, ...]:
        optional = (
            *(self.pose, self.intrinsics, self.camera_txt, self.depth, self.rgb),
            *(self.mask, self.mask_txt, self.confidence, self.kind),
        )
        return (*(path for path in optional if path is not None), self.info)


def write_artifacts(
    annotation: Annotation,
    root: str | Path,
    *,
    attributes: Sequence[Attribute] = ALL_ATTRIBUTES,
    progress: Callable[[int, int], None] | None = None,
) -> ArtifactPaths:
    """Write `annotation` below `root`, consuming its dense stream once (not at all for poses and intrinsics).

    An earlier result of the same name is replaced: first its `_info.json` goes, then its files, then the new
    `_info.json` appears, so that its presence always means a complete sequence with nothing of an earlier one. Depth is
    converted to what ViPE's files hold: z for pinhole and mei, distance for panoramas.

    Args:
        annotation: Its name must be a sanitised one.
        root: Output directory, created if need be.
        attributes: What to write.
        progress: Called with (frames done, all frames).

    Raises:
        ValueError: A name that is not sanitised, or an unknown attribute.
        EngineError: The dense stream does not match the poses and the camera.
        OSError: From the file system.
    """
    name = annotation.name
    if name != sanitise_name(name):
        raise ValueError(f"sequence name {name!r} is not safe in paths; use sanitise_name")
    unknown = set(attributes) - set(ALL_ATTRIBUTES)
    if unknown:
        raise ValueError(f"unknown attributes {sorted(unknown)}; known: {', '.join(ALL_ATTRIBUTES)}")
    root = Path(root)
    root.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{name}.", suffix=".partial", dir=root))
    try:
        written = _write_all(annotation, work, attributes, progress)
        info_path(root, name).unlink(missing_ok=True)
        for attribute in set(ALL_ATTRIBUTES) - set(attributes):
            for path in artifact_files(root, name, attribute):
                path.unlink(missing_ok=True)
        moved: dict[str, Path] = {}
        for key, path in written.items():
            moved[key] = root / path.relative_to(work)
            moved[key].parent.mkdir(exist_ok=True)
            path.replace(moved[key])
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return ArtifactPaths(
        root=root,
        name=name,
        info=moved["info"],
        pose=moved.get("pose"),
        intrinsics=moved.get("intrinsics"),
        camera_txt=moved.get("camera_txt"),
        depth=moved.get("depth"),
        rgb=moved.get("rgb"),
        mask=moved.get("mask"),
        mask_txt=moved.get("mask_txt"),
        confidence=moved.get("confidence"),
        kind=moved.get("kind"),
    )


def disk_intrinsics(camera: Camera) -> NDArray[np.float32]:
    """`Camera.params` as they lie on disk, half-pixel centres: (4,) pinhole, (5,) mei, (12,) opencv, (8,)
    opencv_fisheye; four zeros for a panorama."""
    return np.array(camera.params or (0.0, 0.0, 0.0, 0.0), dtype=np.float32)


def disk_depth_factor(camera: Camera, kind: DepthKind) -> NDArray[np.float32] | None:
    """(H, W) factor from depth of `kind` to the kind that lies on disk; None where they are the same.

    0 where there is no such depth: a pixel at or beyond 90 degrees has no depth along the axis.
    """
    if kind == DISK_DEPTH_KINDS[camera.model]:
        return None
    rays = camera.rays()
    z_per_distance = rays[..., 2] / np.linalg.norm(rays, axis=-1)
    ahead = z_per_distance > 0
    factor = z_per_distance if kind == "ray" else 1 / np.where(ahead, z_per_distance, 1)
    return np.where(ahead, factor, 0).astype(np.float32)


def _write_all(
    annotation: Annotation,
    work: Path,
    attributes: Sequence[Attribute],
    progress: Callable[[int, int], None] | None,
) -> dict[str, Path]:
    """Write everything below `work`; key -> path, the info last."""
    name, count = annotation.name, annotation.num_frames
    written: dict[str, Path] = {}

    def new(key: str, path: Path) -> Path:
        path.parent.mkdir(exist_ok=True)
        written[key] = path
        return path

    inds = np.arange(count, dtype=np.int64)
    if "pose" in attributes:
        path = new("pose", artifact_path(work, name, "pose", "npz"))
        np.savez(path, data=annotation.world_from_cam.astype(np.float32), inds=inds)
    if "intrinsics" in attributes:
        path = new("intrinsics", artifact_path(work, name, "intrinsics", "npz"))
        np.savez(path, data=np.tile(disk_intrinsics(annotation.camera), (count, 1)), inds=inds)
        kind = DISK_CAMERA_NAMES[annotation.camera.model]
        path = new("camera_txt", artifact_path(work, name, "intrinsics", "camera.txt"))
        path.write_text("".join(f"{index}: {kind}\n" for index in range(count)), encoding="ascii")
    if "mask" in attributes:
        path = new("mask_txt", artifact_path(work, name, "mask", "txt"))
        phrases = sorted(annotation.mask_phrases.items())
        path.write_text("".join(f"{number}: {phrase}\n" for number, phrase in phrases), encoding="utf-8")
    dense = {
        key: new(key, artifact_path(work, name, attribute, suffix))
        for key, attribute, suffix in _DENSE
        if attribute in attributes
    }
    if dense:
        _write_dense(annotation, dense, progress)
    new("info", info_path(work, name)).write_text(_info_json(annotation, attributes), encoding="utf-8")
    return written


def _write_dense(annotation: Annotation, paths: dict[str, Path], progress: Callable[[int, int], None] | None) -> None:
    """Write the parts of the dense stream that have a path, by the keys of `_DENSE`."""
    total = annotation.num_frames
    done = 0
    factor = disk_depth_factor(annotation.camera, annotation.depth_kind)
    writers: dict[str, Callable[[Path], FrameZipWriter]] = {
        "depth": DepthZipWriter,
        "mask": MaskZipWriter,
        "confidence": ConfidenceZipWriter,
        "kind": KindZipWriter,
    }
    with ExitStack() as stack:
        rgb: VideoWriter | None = None
        if "rgb" in paths:
            writer = VideoWriter(paths["rgb"], annotation.fps, pixel_aspect=annotation.camera.pixel_aspect)
            rgb = stack.enter_context(writer)
        zips = {key: stack.enter_context(opened(paths[key])) for key, opened in writers.items() if key in paths}
        # Closed here, not when an exception's traceback lets go of it: decoder processes are behind it.
        for frame in stack.enter_context(closing(annotation.dense())):
            _check_dense(annotation, frame, done)
            if rgb is not None:
                rgb.write(frame.rgb)
            maps: dict[str, NDArray[Any]] = {
                "mask": frame.mask,
                "confidence": frame.confidence,
                "kind": frame.kind,
                "depth": frame.depth,
            }
            if factor is not None:
                maps["depth"] = frame.depth * factor
            for key, archive in zips.items():
                archive.append(maps[key])
            done += 1
            if progress is not None:
                progress(done, total)
        if done != total:
            raise EngineError(f"{annotation.name}: the dense stream gave {done} of {total} frames")


def _check_dense(annotation: Annotation, frame: DenseFrame, expected_index: int) -> None:
    camera = annotation.camera
    if frame.index != expected_index or frame.index >= annotation.num_frames:
        raise EngineError(f"{annotation.name}: the dense stream gave frame {frame.index} as number {expected_index}")
    size = (camera.height, camera.width)
    maps = (frame.depth, frame.mask, frame.confidence, frame.kind)
    if any(values.shape != size for values in maps) or frame.rgb.shape != (*size, 3):
        raise EngineError(
            f"{annotation.name}: frame {frame.index} is not of the camera's size {camera.width}x{camera.height}"
        )


def _info_json(annotation: Annotation, attributes: Sequence[Attribute]) -> str:
    camera = annotation.camera
    info = {
        "schema": INFO_SCHEMA,
        "name": annotation.name,
        "num_frames": annotation.num_frames,
        "attributes": [attribute for attribute in ALL_ATTRIBUTES if attribute in attributes],
        "width": camera.width,
        "height": camera.height,
        "camera": {"model": camera.model, "params": list(camera.params), "fov_x_deg": round(camera.fov_x_deg, 6)},
        "fps": annotation.fps,
        "scale": annotation.scale,
        "depth_kind": DISK_DEPTH_KINDS[camera.model],
        "depth_kinds": {str(number): phrase for number, phrase in DEPTH_KINDS.items()},
        "trajectory_length": annotation.trajectory_length,
        "quality": annotation.quality.summary(),
        **annotation.quality.per_frame(),
        "provenance": asdict(annotation.provenance),
        "keyframes": [int(index) for index in annotation.keyframes],
        "timestamps_s": [float(value) for value in annotation.timestamps_s],
    }
    return json.dumps(_json_ready(info), indent=1, sort_keys=True, allow_nan=False) + "\n"


def _json_ready(value: Any) -> Any:
    """Numbers that JSON cannot hold become null; numpy scalars become plain."""
    if isinstance(value, dict):
        return {str(key): _json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_ready(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
