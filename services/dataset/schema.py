"""Columns of `meta.parquet` and `failures.parquet`, and how a commit record becomes rows of them.

The first three columns of the index are those of the data sets that NVIDIA published; their downloader reads no others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import pyarrow as pa

from services.commit.layout import MEMBERS, Member, attributes_of
from services.domain.errors import IntegrityError
from services.domain.models import Attribute, CommitRecord, JobSpec, VideoResult

META_KEY = "meta.parquet"
FAILURES_KEY = "failures.parquet"
DATASET_KEY = "dataset.json"
CARD_KEY = "README.md"
SCHEMA_VERSION = 1

_PARAMETERS = ("fx", "fy", "cx", "cy", "alpha")
_QUALITY = ("residual_px", "inlier_ratio", "coverage", "parallax_deg", "focal_sigma_ratio")
_MAIN_EXTENSIONS = {"npz", "zip", "mp4"}

FAILURES_SCHEMA = pa.schema(
    [
        ("sequence", pa.string()),
        ("uri", pa.string()),
        ("status", pa.string()),
        ("error_code", pa.string()),
        ("error_message", pa.string()),
        ("attempt", pa.int32()),
        ("shard_id", pa.string()),
        ("deaths_json", pa.string()),
    ]
)


def member_column(attribute: Attribute, member: Member) -> str:
    """Stem of the columns `<stem>_offset` and `<stem>_size`: `pose`, `depth`, and for companions `pose_json`."""
    if member.extension in _MAIN_EXTENSIONS:
        return attribute
    return f"{attribute}_{member.extension.replace('.', '_')}"


def meta_schema(spec: JobSpec) -> pa.Schema:
    """Schema of the index of a job; only the attributes that it wrote have offsets."""
    fields: list[tuple[str, pa.DataType]] = [
        ("sequence", pa.string()),
        ("num_frames", pa.int32()),
        ("tar_name", pa.string()),
        ("uri", pa.string()),
        ("shard_id", pa.string()),
        ("rig", pa.string()),
        ("view", pa.string()),
        ("width", pa.int32()),
        ("height", pa.int32()),
        ("fps", pa.float64()),
        ("duration_s", pa.float64()),
        ("num_keyframes", pa.int32()),
        ("camera_model", pa.string()),
        *((name, pa.float64()) for name in _PARAMETERS),
        ("distortion", pa.list_(pa.float64())),
        ("fov_x_deg", pa.float64()),
        ("trajectory_length", pa.float64()),
        ("scale", pa.string()),
        ("depth_kind", pa.string()),
        ("reliable", pa.string()),
        ("reasons", pa.list_(pa.string())),
        *((name, pa.float64()) for name in _QUALITY),
        ("seconds", pa.float64()),
        ("attempt", pa.int32()),
        ("preset", pa.string()),
        ("device", pa.string()),
        ("engine_version", pa.string()),
        ("config_hash", pa.string()),
        ("source_json", pa.string()),
        ("provenance_json", pa.string()),
        ("timings_json", pa.string()),
    ]
    for attribute in attributes_of(spec.attributes):
        for member in MEMBERS[attribute]:
            stem = member_column(attribute, member)
            fields += [(f"{stem}_offset", pa.int64()), (f"{stem}_size", pa.int64())]
    return pa.schema(fields)


def meta_row(record: CommitRecord, video: VideoResult) -> dict[str, Any]:
    """The index row of a sample: a video that succeeded, or a view of a rig that did.

    Raises:
        IntegrityError: The record does not say where its members lie, or how many frames it has.
    """
    if record.tar_name is None or video.num_frames is None:
        raise IntegrityError(f"the record of shard {record.shard_id} counts {video.key} as done, without its payload")
    quality: Mapping[str, Any] = video.quality or {}
    provenance: Mapping[str, Any] = video.provenance or {}
    params = video.camera_params or ()
    # What follows the principal point is the bend of a unified camera, or a lens's measured distortion.
    unified = video.camera_model == "mei"
    parameters = dict(zip(_PARAMETERS, params if unified else params[:4], strict=False))
    row: dict[str, Any] = {
        "sequence": video.key,
        "num_frames": video.num_frames,
        "tar_name": record.tar_name,
        "uri": public_uri(video.uri),
        "shard_id": record.shard_id,
        "rig": video.rig,
        "view": video.view,
        "width": video.width,
        "height": video.height,
        "fps": video.fps,
        "duration_s": video.duration_s,
        "num_keyframes": video.num_keyframes,
        "camera_model": video.camera_model,
        **{name: parameters.get(name) for name in _PARAMETERS},
        "distortion": None if unified or len(params) == 4 or not params else list(params[4:]),
        "fov_x_deg": video.fov_x_deg,
        "trajectory_length": video.trajectory_length,
        "scale": video.scale,
        "depth_kind": video.depth_kind,
        "reliable": quality.get("reliable"),
        "reasons": quality.get("reasons"),
        **{name: quality.get(name) for name in _QUALITY},
        "seconds": video.seconds,
        "attempt": video.attempt,
        "preset": provenance.get("preset"),
        "device": provenance.get("device"),
        "engine_version": provenance.get("engine_version"),
        "config_hash": record.config_hash,
        "source_json": _json(video.source),
        "provenance_json": _json(video.provenance),
        "timings_json": _json(video.timings_s),
    }
    for o in record.objects:
        files = o.members.get(video.key)
        if files is None:
            raise IntegrityError(f"{o.key} holds no sample {video.key}, which its record counts as done")
        for member in MEMBERS[o.attribute]:
            offset, size = files.get(member.name(video.key), (None, None))
            stem = member_column(o.attribute, member)
            row[f"{stem}_offset"], row[f"{stem}_size"] = offset, size
    return row


def failure_row(record: CommitRecord, video: VideoResult) -> dict[str, Any]:
    return {
        "sequence": video.key,
        "uri": public_uri(video.uri),
        "status": str(video.status),
        "error_code": video.error_code,
        "error_message": video.error_message,
        "attempt": video.attempt,
        "shard_id": record.shard_id,
        "deaths_json": None if video.deaths is None else json.dumps([death.to_json() for death in video.deaths]),
    }


def public_uri(uri: str) -> str:
    """The address without a user name, password or query, where secrets hide."""
    if "://" not in uri:
        return uri
    parts = urlsplit(uri)
    query = parts.query if parts.scheme in ("s3", "file") else ""  # there a `?` is part of the name
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2], query=query))


def public_spec(spec: JobSpec) -> dict[str, Any]:
    data = spec.to_json()
    return {
        **data,
        "inputs": [public_uri(uri) for uri in spec.inputs],
        "output": public_uri(spec.output),
        "attributes": list(spec.attributes),
    }


def _json(value: object) -> str | None:
    return None if value is None else json.dumps(value, sort_keys=True)
