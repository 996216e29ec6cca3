"""Annotations on disk: ViPE's artifact layout, the depth codec, and exports."""

from vipe_core.formats.artifacts import ArtifactPaths, write_artifacts
from vipe_core.formats.colmap import export_colmap
from vipe_core.formats.depth_zip import DepthZipReader, DepthZipWriter
from vipe_core.formats.exr import decode_depth, encode_depth
from vipe_core.formats.frames import ArtifactFrame, read_frames
from vipe_core.formats.fused import fuse_cloud, fuse_mesh
from vipe_core.formats.layout import list_sequences, member_path, sample_members
from vipe_core.formats.names import SequenceNames
from vipe_core.formats.nerfstudio import export_nerfstudio
from vipe_core.formats.ply import write_ply
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
    "ArtifactFrame",
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
    "export_colmap",
    "export_nerfstudio",
    "export_npz",
    "export_png16",
    "fuse_cloud",
    "fuse_mesh",
    "list_sequences",
    "member_path",
    "read_artifacts",
    "read_frames",
    "read_png16",
    "sample_members",
    "write_artifacts",
    "write_ply",
]
