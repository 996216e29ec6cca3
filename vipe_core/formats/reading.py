"""Reading ViPE artifacts back as typed values: ours, and those that the original tool or its datasets hold."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import UNOBSERVED, DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.errors import ConfigError, FormatError, VipeError
from vipe_core.formats.artifacts import DISK_DEPTH_KINDS, disk_depth_factor
from vipe_core.formats.depth_zip import DepthZipReader
from vipe_core.formats.frame_zip import FrameZipReader
from vipe_core.formats.layout import artifact_path, info_path
from vipe_core.formats.png_zip import ConfidenceZipReader, KindZipReader, MaskZipReader
from vipe_core.video.opening import open_source
from vipe_core.video.probe import probe

Reader = TypeVar("Reader", bound=FrameZipReader[Any])
Sample = TypeVar("Sample", bound=np.generic)


# Ten million poses.
_MAX_ARRAY_BYTES = 10_000_000 * 16 * 8

_MODELS: dict[str, tuple[CameraModel, int]] = {
    "PINHOLE": ("pinhole", 4),
    "MEI": ("mei", 5),
    "PANORAMA": ("equirect", 4),
    "OPENCV": ("opencv", 12),
    "OPENCV_FISHEYE": ("opencv_fisheye", 8),
}


@dataclass(frozen=True, slots=True)
class Artifacts:
    """One sequence on disk. Poses and intrinsics are in memory, depth is read on demand.

    Attributes:
        world_from_cam: (N, 4, 4) float64, OpenCV axes.
        frame_index: (N,) int64 index of each pose within the processed stream.
        camera: Shared camera at the resolution of the files: per-parameter median over the frames, with all the digits
            that our info file has of it.
        intrinsics: (N, D) float64 as stored.
        depth_kind: `ray` for panoramas, else `z`.
        timestamps_s: (N,) float64, or None where no info file says.
        info: Our description of the sequence; empty for directories of the original tool.
        seen_by: How the pictures on disk become those of `camera`, where that is not the one they were taken with: see
            `rectified.py`.
        part: Which of the frames on disk these are; None for all.
    """

    root: Path
    name: str
    world_from_cam: NDArray[np.float64]
    frame_index: NDArray[np.int64]
    camera: Camera
    intrinsics: NDArray[np.float64]
    depth_kind: DepthKind
    timestamps_s: NDArray[np.float64] | None
    info: dict[str, Any]
    seen_by: PixelMap | None = None
    part: range | None = None

    @property
    def num_frames(self) -> int:
        return len(self.world_from_cam)

    @property
    def cuts(self) -> tuple[int, ...]:
        """First frames of the shots but the first. Each shot has a world of its own, and a scale where that is
        relative: what lies between them is not measured."""
        stated = (self.info.get("quality") or {}).get("cuts", ())
        return () if self.part is not None else tuple(int(cut) for cut in stated)

    def shot(self, number: int) -> Artifacts:
        """One shot by itself, numbered from 1; frames count from 0 again.

        Raises:
            FormatError: There is no such shot.
        """
        bounds = [0, *self.cuts, self.num_frames]
        if not 1 <= number < len(bounds):
            raise FormatError(f"{self.name}: there is no shot {number}; there are {len(bounds) - 1}, the first is 1")
        part = range(bounds[number - 1], bounds[number])
        rows = slice(part.start, part.stop)
        return replace(
            self,
            world_from_cam=self.world_from_cam[rows],
            frame_index=self.frame_index[rows],
            intrinsics=self.intrinsics[rows],
            timestamps_s=None if self.timestamps_s is None else self.timestamps_s[rows],
            part=part,
        )

    def longest_shot(self) -> Artifacts:
        """The whole sequence where it has no cuts."""
        if not self.cuts:
            return self
        lengths = np.diff([0, *self.cuts, self.num_frames])
        return self.shot(1 + int(lengths.argmax()))

    @property
    def has_depth(self) -> bool:
        return self._path("depth", "zip").is_file()

    @property
    def has_mask(self) -> bool:
        return self._path("mask", "zip").is_file()

    @property
    def has_confidence(self) -> bool:
        """Confidence and kind of each depth value; directories of the original tool have none."""
        return self._path("confidence", "zip").is_file() and self._path("confidence", "kind.zip").is_file()

    @property
    def rgb_path(self) -> Path | None:
        path = self._path("rgb", "mp4")
        return path if path.is_file() else None

    def pictures(self) -> Generator[NDArray[np.uint8], None, None]:
        """(H, W, 3) uint8 of every pose, in order. Closing the generator ends the decoder.

        Raises:
            FormatError: No rgb.
            InputError, DecodeError: It cannot be decoded.
        """
        if self.rgb_path is None:
            raise FormatError(f"{self.name}: the attribute rgb is needed and is not there")
        part = self.part or range(self.num_frames)
        with closing(open_source(self.rgb_path).frames(start=part.start, stop=part.stop)) as frames:
            for frame in frames:
                yield frame.rgb if self.seen_by is None else _in_black(self.seen_by, frame.rgb)

    def open_depth(self) -> DepthZipReader:
        """Depth maps, one per pose; close it after use.

        Raises:
            FormatError: No depth, a damaged archive, or another number of maps than poses. So do the others.
        """
        return self._checked(DepthZipReader(self._path("depth", "zip")), self._depth)

    def open_mask(self) -> MaskZipReader:
        """Masks of instance ids, one per pose; close it after use."""
        return self._checked(MaskZipReader(self._path("mask", "zip")), self._nearest)

    def open_confidence(self) -> ConfidenceZipReader:
        """Confidence in 0..1, one map per pose; close it after use."""
        return self._checked(ConfidenceZipReader(self._path("confidence", "zip")), self._nearest)

    def open_kind(self) -> KindZipReader:
        """Classes of `annotation.DEPTH_KINDS`, one map per pose; close it after use."""
        return self._checked(KindZipReader(self._path("confidence", "kind.zip")), self._kind)

    def _path(self, attribute: str, suffix: str) -> Path:
        return artifact_path(self.root, self.name, attribute, suffix)

    def _depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        assert self.seen_by is not None
        resampled = self.seen_by.depth(depth)
        if DISK_DEPTH_KINDS[self.seen_by.source.model] == self.depth_kind:
            return resampled
        factor = disk_depth_factor(self.camera, DISK_DEPTH_KINDS[self.seen_by.source.model])
        return resampled if factor is None else resampled * factor

    def _nearest(self, picture: NDArray[Sample]) -> NDArray[Sample]:
        assert self.seen_by is not None
        return self.seen_by.nearest(picture)

    def _kind(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        assert self.seen_by is not None
        return self.seen_by.nearest(picture, UNOBSERVED)

    def _checked(self, reader: Reader, resample: Callable[[NDArray[Any]], NDArray[Any]]) -> Reader:
        if self.part is not None and self.part.stop <= len(reader):
            reader.keep(self.part)
        if len(reader) != self.num_frames:
            reader.close()
            raise FormatError(f"{self.name}: {len(reader)} {reader.kind}s for {self.num_frames} poses")
        if self.seen_by is not None:
            reader.resample = resample
        return reader


def read_artifacts(root: str | Path, name: str) -> Artifacts:
    """Read the sequence `name` below `root`.

    Raises:
        FormatError: A file is missing or does not hold what it must; names the file.
    """
    root = Path(root)
    poses, inds = read_npz(artifact_path(root, name, "pose", "npz"))
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise FormatError(f"pose/{name}.npz: `data` has shape {poses.shape}, (N, 4, 4) is needed")
    if not np.isfinite(poses).all() or np.abs(poses[:, 3] - (0, 0, 0, 1)).max() > 1e-4:
        raise FormatError(f"pose/{name}.npz: `data` holds matrices that are not rigid transforms")
    intrinsics, intrinsics_inds = read_npz(artifact_path(root, name, "intrinsics", "npz"))
    if not np.array_equal(inds, intrinsics_inds):
        raise FormatError(f"intrinsics/{name}.npz: its frames are not those of pose/{name}.npz")
    info = _read_info(info_path(root, name), len(poses))
    model, num_params = _read_model(artifact_path(root, name, "intrinsics", "camera.txt"), inds)
    if intrinsics.ndim != 2 or intrinsics.shape[1] != num_params or not np.isfinite(intrinsics).all():
        raise FormatError(f"intrinsics/{name}.npz: `data` has shape {intrinsics.shape}, (N, {num_params}) is needed")
    width, height = _picture_size(root, name, info)
    params = () if model == "equirect" else tuple(float(value) for value in np.median(intrinsics, axis=0))
    try:
        camera = Camera(model, _with_all_digits(params, info.get("camera")), width, height)
    except ConfigError as error:
        raise FormatError(f"intrinsics/{name}.npz: {error}") from error
    stamps = info.get("timestamps_s")
    return Artifacts(
        root=root,
        name=name,
        world_from_cam=poses,
        frame_index=inds,
        camera=camera,
        intrinsics=intrinsics,
        depth_kind=DISK_DEPTH_KINDS[model],
        timestamps_s=None if stamps is None else np.asarray(stamps, dtype=np.float64),
        info=info,
    )


def read_npz(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """`data` (N, ...) and `inds` (N,) of a file of poses or intrinsics.

    Raises:
        FormatError: It is missing or does not hold them; names the file.
    """
    label = f"{path.parent.name}/{path.name}"
    if not path.is_file():
        raise FormatError(f"{label}: no such file; is the sequence name right?")
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.file_size > _MAX_ARRAY_BYTES for member in archive.infolist()):
                raise FormatError(f"{label}: an array of more than {_MAX_ARRAY_BYTES} bytes is no list of frames")
        with np.load(path, allow_pickle=False) as file:
            data, inds = file["data"], file["inds"]
    except KeyError as error:
        raise FormatError(f"{label}: `data` and `inds` are needed, {error.args[0]}") from error
    except (OSError, ValueError, EOFError, MemoryError, RuntimeError, zlib.error, zipfile.BadZipFile) as error:
        raise FormatError(f"{label}: not a readable npz; write the artifact again") from error
    if data.dtype.kind != "f" or inds.dtype.kind not in "iu" or inds.shape != data.shape[:1]:
        raise FormatError(f"{label}: `data` must be real numbers with one integer in `inds` per row")
    return data.astype(np.float64), inds.astype(np.int64)


def _read_model(path: Path, inds: NDArray[np.int64]) -> tuple[CameraModel, int]:
    """Model and number of parameters; without the file it is a pinhole, as in the published datasets."""
    if not path.is_file():
        return _MODELS["PINHOLE"]
    label = f"{path.parent.name}/{path.name}"
    try:
        lines = [line.split(":") for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        kinds = {int(index): kind.strip() for index, kind in lines}
    except (ValueError, UnicodeDecodeError) as error:
        raise FormatError(f"{label}: lines must read like `0: PINHOLE`") from error
    names = set(kinds.values())
    if set(kinds) != set(inds.tolist()) or len(names) != 1 or not names <= set(_MODELS):
        raise FormatError(f"{label}: one camera of {', '.join(_MODELS)} is needed for every frame, got {sorted(names)}")
    return _MODELS[names.pop()]


def _read_info(path: Path, num_frames: int) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FormatError(f"{path.parent.name}/{path.name}: not readable JSON") from error
    stamps = info.get("timestamps_s") if isinstance(info, dict) else None
    if not isinstance(stamps, list) or len(stamps) != num_frames or info.get("num_frames") != num_frames:
        raise FormatError(f"{path.parent.name}/{path.name}: does not describe the {num_frames} frames of the poses")
    if not all(isinstance(stamp, (int, float)) for stamp in stamps):
        raise FormatError(f"{path.parent.name}/{path.name}: `timestamps_s` must be numbers")
    return info


def _in_black(seen_by: PixelMap, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    picture = seen_by.colours(rgb)
    picture[seen_by.outside] = 0
    return picture


def _with_all_digits(params: tuple[float, ...], stated: Any) -> tuple[float, ...]:
    """The parameters as the info file has them where those are the same numbers: intrinsics on disk are float32."""
    whole = stated.get("params") if isinstance(stated, dict) else None
    if not isinstance(whole, list) or not all(isinstance(value, (int, float)) for value in whole):
        return params
    same = np.array_equal(np.array(whole, np.float32), np.array(params, np.float32))
    return tuple(float(value) for value in whole) if same else params


def _picture_size(root: Path, name: str, info: dict[str, Any]) -> tuple[int, int]:
    """(width, height) from our info, else from the first depth map, else from the video."""
    width, height = info.get("width"), info.get("height")
    if isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0:
        return width, height
    depth = artifact_path(root, name, "depth", "zip")
    if depth.is_file():
        with DepthZipReader(depth) as reader:
            if len(reader):
                rows, columns = reader.read(0).shape
                return columns, rows
    rgb = artifact_path(root, name, "rgb", "mp4")
    if not rgb.is_file():
        raise FormatError(f"{name}: neither depth/{name}.zip nor rgb/{name}.mp4 tells the size of the pictures")
    try:
        video = probe(rgb)
    except VipeError as error:
        raise FormatError(f"rgb/{name}.mp4: {error}") from error
    return video.width, video.height
