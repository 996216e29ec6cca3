"""Binary PLY: points with colours and normals, or a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.formats.atomic import complete_file
from vipe_core.fusion import Mesh, PointCloud

Array = NDArray[Any]

_CHUNK = 1 << 18


def write_ply(out: str | Path, surface: PointCloud | Mesh, *, comments: Sequence[str] = ()) -> Path:
    """Write a cloud or a mesh: x y z, nx ny nz as float, red green blue as uchar, faces as lists of three int.

    Args:
        comments: Lines for the header, ASCII.
    """
    out = Path(out)
    if isinstance(surface, Mesh):
        points, colours, normals, faces = surface.vertices, surface.colours, surface.normals(), surface.faces
    else:
        points, colours, normals, faces = surface.points, surface.colours, surface.normals, None
    vertex = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with complete_file(out) as partial, partial.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            rows = np.empty(len(points[part]), vertex)
            rows["xyz"], rows["normal"], rows["rgb"] = points[part], normals[part], colours[part]
            file.write(rows.tobytes())
        for start in range(0, 0 if faces is None else len(faces), _CHUNK):
            assert faces is not None
            triangles = np.empty(len(faces[start : start + _CHUNK]), np.dtype([("n", "u1"), ("v", "<i4", 3)]))
            triangles["n"], triangles["v"] = 3, faces[start : start + _CHUNK]
            file.write(triangles.tobytes())
    return out
