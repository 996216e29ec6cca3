"""Annotations on disk: ViPE's artifact layout, the depth codec, and exports.

What needs the fused surface of a sequence (`fused`, `colmap`, `nerfstudio`, `ply`, `rectified`) is imported from its
module: workers and readers of plain files do without it.
"""

from vipe_core.formats.artifacts import ArtifactPaths, write_artifacts
from vipe_core.formats.depth_zip import DepthZipReader, DepthZipWriter
from vipe_core.formats.exr import decode_depth, encode_depth
from vipe_core.formats.layout import list_sequences, member_path, sample_members
from vipe_core.formats.names import SequenceNames
from vipe_core.formats.png16 import export_png16, read_png16
from vipe_core.formats.png_zip import (
    ConfidenceZipReader,
    ConfidenceZipWriter,
    KindZipReader,
    KindZipWriter,
    MaskZipReader,
    MaskZipWriter,
)
from vipe_core.formats.reading import Artifacts, read_artifacts
from vipe_core.formats.scorer_npz import export_npz

__all__ = [
    "ArtifactPaths",
    "Artifacts",
    "ConfidenceZipReader",
    "ConfidenceZipWriter",
    "DepthZipReader",
    "DepthZipWriter",
    "KindZipReader",
    "KindZipWriter",
    "MaskZipReader",
    "MaskZipWriter",
    "SequenceNames",
    "decode_depth",
    "encode_depth",
    "export_npz",
    "export_png16",
    "list_sequences",
    "member_path",
    "read_artifacts",
    "read_png16",
    "sample_members",
    "write_artifacts",
]
