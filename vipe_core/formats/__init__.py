"""Annotations on disk: ViPE's artifact layout, the depth codec, and exports."""

from vipe_core.formats.artifacts import ArtifactPaths, write_artifacts
from vipe_core.formats.depth_zip import DepthZipReader, DepthZipWriter
from vipe_core.formats.exr import decode_depth, encode_depth
from vipe_core.formats.layout import list_sequences, member_path, sample_members
from vipe_core.formats.mask_zip import MaskZipReader, MaskZipWriter
from vipe_core.formats.names import SequenceNames
from vipe_core.formats.reading import Artifacts, read_artifacts
from vipe_core.formats.scorer_npz import export_npz

__all__ = [
    "ArtifactPaths",
    "Artifacts",
    "DepthZipReader",
    "DepthZipWriter",
    "MaskZipReader",
    "MaskZipWriter",
    "SequenceNames",
    "decode_depth",
    "encode_depth",
    "export_npz",
    "list_sequences",
    "member_path",
    "read_artifacts",
    "sample_members",
    "write_artifacts",
]
