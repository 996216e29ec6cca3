"""One sequence as a single npz of plain arrays, for evaluation scripts that do not know ViPE's layout.

Keys: cam_to_world (N,4,4) float64; intrinsics (N,D) float64 (`Camera.params`: fx, fy, cx, cy [, alpha or distortion],
half-pixel centres, pixels of width x height); frame_index (N,) int64; camera (a model of `Camera`); width, height;
depth (N,h,w) float16, where 0 is no value; depth_kind (`z` or `ray`); cuts (K,) int64, first frames of the
shots but the first, each of which has a world of its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.formats.atomic import complete_file
from vipe_core.formats.exr import MAX_DEPTH
from vipe_core.formats.reading import Artifacts

# A smaller pixel exists where at least this share of its area has a value.
_MIN_SHARE = 0.25


def export_npz(artifacts: Artifacts, out: str | Path, *, depth_stride: int = 4) -> Path:
    """Write a sequence to `out`; holds all depth maps in memory at the reduced size.

    Args:
        out: File to write, ending in `.npz`.
        depth_stride: Depth is reduced by this factor, averaged in inverse depth; 1 keeps it as it is.

    Raises:
        FormatError: The depth is not readable.
        ValueError: A stride below 1, or another suffix.
    """
    out = Path(out)
    if depth_stride < 1 or out.suffix != ".npz":
        raise ValueError(f"need a stride of at least 1 and an .npz file, got {depth_stride} and {out.name}")
    arrays: dict[str, Any] = {
        "cam_to_world": artifacts.world_from_cam,
        "intrinsics": artifacts.intrinsics,
        "frame_index": artifacts.frame_index,
        "camera": np.array(artifacts.camera.model),
        "width": np.array(artifacts.camera.width),
        "height": np.array(artifacts.camera.height),
        "cuts": np.array(artifacts.cuts, dtype=np.int64),
    }
    if artifacts.has_depth:
        arrays["depth"] = _stacked_depth(artifacts, depth_stride)
        arrays["depth_kind"] = np.array(artifacts.depth_kind)
    with complete_file(out) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return out


def reduce_depth(depth: NDArray[np.float32], stride: int) -> NDArray[np.float32]:
    """(H, W) -> (H / stride, W / stride), rounded: mean of the inverse depth of the pixels that have a value.

    Inverse depth is linear on planes, so that slanted surfaces stay where they are.
    """
    if stride == 1:
        return depth
    size = (max(1, round(depth.shape[1] / stride)), max(1, round(depth.shape[0] / stride)))
    valid = np.isfinite(depth) & (depth > 0)
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float32)
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(inverse, size, interpolation=cv2.INTER_AREA)
    usable = (share >= _MIN_SHARE) & (total > 0)
    return np.where(usable, share / np.where(usable, total, 1), 0).astype(np.float32)


def _stacked_depth(artifacts: Artifacts, stride: int) -> NDArray[np.float16]:
    stacked: NDArray[np.float16] | None = None
    with artifacts.open_depth() as reader:
        for index, depth in enumerate(reader):
            small = np.clip(reduce_depth(depth, stride), 0, MAX_DEPTH)
            if stacked is None:
                stacked = np.zeros((len(reader), *small.shape), dtype=np.float16)
            stacked[index] = small
    assert stacked is not None
    return stacked
