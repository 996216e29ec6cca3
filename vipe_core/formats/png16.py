"""Depth as 16-bit PNG, the form of most RGB-D data sets: `depth/%05d.png` and `export.json`, which says what they mean.

A metric sequence is in millimetres, or in centimetres if anything lies beyond 65.535 m. A relative one is 16-bit
inverse depth, whose precision does not depend on the unknown scale. 0 is no value; `depth` of `export.json` holds
`encoding` (depth or inverse_depth), `scale` s, `offset` o, `unit` (m or relative) and `kind` (z or ray),
and a pixel p > 0 means s p + o, of depth or of inverse depth.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats.atomic import EXPORT_FILE, complete_folder, write_json
from vipe_core.formats.reading import Artifacts

_MAX = 65535
_MM, _CM = 1e-3, 1e-2


@dataclass(frozen=True, slots=True)
class Png16Code:
    """How numbers of 16 bits stand for depth; see the module."""

    encoding: str
    scale: float
    offset: float

    def encode(self, depth: NDArray[np.floating]) -> NDArray[np.uint16]:
        """(H, W) uint16; 0 where there is no value or none that fits."""
        known = np.isfinite(depth) & (depth > 0)
        value = np.where(known, depth, 1).astype(np.float64)
        if self.encoding == "inverse_depth":
            value = 1 / value
        steps = np.rint((value - self.offset) / self.scale)
        if self.encoding == "inverse_depth":
            steps = np.maximum(steps, 1)  # far is not nothing
        return np.where(known & (steps >= 1) & (steps <= _MAX), steps, 0).astype(np.uint16)

    def decode(self, picture: NDArray[np.uint16]) -> NDArray[np.float32]:
        """(H, W) float32 depth; 0 is no value."""
        value = picture.astype(np.float64) * self.scale + self.offset
        known = (picture > 0) & (value > 0)
        if self.encoding == "inverse_depth":
            value = 1 / np.where(known, value, 1)
        return np.where(known, value, 0).astype(np.float32)


def png16_code(artifacts: Artifacts) -> Png16Code:
    """The finest code that holds every depth of the sequence; reads all of its depth maps."""
    nearest, farthest = np.inf, 0.0
    with artifacts.open_depth() as reader:
        for depth in reader:
            known = depth[np.isfinite(depth) & (depth > 0)]
            if len(known):
                nearest, farthest = min(nearest, float(known.min())), max(farthest, float(known.max()))
    if artifacts.info.get("scale", "metric") == "metric":
        return Png16Code("depth", _MM if farthest <= _MM * _MAX else _CM, 0.0)
    return Png16Code("inverse_depth", (1 / nearest if np.isfinite(nearest) else 1.0) / _MAX, 0.0)


def export_png16(artifacts: Artifacts, out: str | Path) -> Path:
    """Write the folder `out`. Sequences that do not state their scale, as those of nvidia-vipe, are taken for metric.

    Raises:
        FormatError: No depth, or `out` is something else than an earlier export.
    """
    code = png16_code(artifacts)
    with complete_folder(Path(out)) as folder:
        (folder / "depth").mkdir()
        with artifacts.open_depth() as reader:
            for index, depth in enumerate(reader):
                write_png16(folder / "depth" / f"{index:05d}.png", code.encode(depth))
        metric = code.encoding == "depth"
        description: dict[str, Any] = {
            "format": "png16",
            "sequence": artifacts.name,
            "num_frames": artifacts.num_frames,
            "depth": {
                "encoding": code.encoding,
                "scale": code.scale,
                "offset": code.offset,
                "unit": "m" if metric else "relative",
                "kind": artifacts.depth_kind,
            },
        }
        write_json(folder / EXPORT_FILE, description)
    return Path(out)


def read_png16(folder: str | Path) -> Iterator[NDArray[np.float32]]:
    """(H, W) float32 depth of every frame of an export.

    Raises:
        FormatError: Not such an export, or a picture is missing or damaged.
    """
    folder = Path(folder)
    try:
        description = json.loads((folder / EXPORT_FILE).read_text(encoding="utf-8"))
        depth = description["depth"]
        code = Png16Code(str(depth["encoding"]), float(depth["scale"]), float(depth["offset"]))
        count = int(description["num_frames"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{folder.name}/{EXPORT_FILE}: does not describe 16-bit depth") from error
    for index in range(count):
        path = folder / "depth" / f"{index:05d}.png"
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if picture is None or picture.dtype != np.uint16 or picture.ndim != 2:
            raise FormatError(f"{folder.name}/depth/{path.name}: not a 16-bit picture of one channel")
        yield code.decode(np.asarray(picture, np.uint16))


def write_png16(path: Path, picture: NDArray[np.uint16]) -> None:
    _, data = cv2.imencode(".png", picture)
    path.write_bytes(data.tobytes())
