"""Small shards for the tests of the service: artifacts as the engine writes them, and the lease they belong to."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import OpenEXR

from services.commit import CommitOutcome, prepare_payload, write_record
from services.domain.models import Attribute, JobSpec, Lease, ShardPlan, VideoRef, VideoResult, shard_id
from services.domain.states import VideoStatus
from services.storage import ObjectStore

WIDTH, HEIGHT = 16, 12
JOB = "job_01test"
ATTRIBUTES: tuple[Attribute, ...] = ("pose", "intrinsics", "depth", "rgb")  # what `write_artifacts` writes


def depth_of(index: int) -> np.ndarray:
    """(H, W) float16 depth of frame `index`, every value different from its neighbours."""
    return (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) / 64 + index + 1).astype(np.float16)


def poses_of(num_frames: int) -> np.ndarray:
    poses = np.tile(np.eye(4, dtype=np.float32), (num_frames, 1, 1))
    poses[:, 0, 3] = np.arange(num_frames) * 0.25
    return poses


def write_artifacts(root: Path, key: str, num_frames: int = 3, *, info: bool = False) -> None:
    """One video in ViPE's artifact layout (reference facts, section 2), without the project's own writer."""
    if info:
        description = {
            "num_frames": num_frames,
            "timestamps_s": [i / 10 for i in range(num_frames)],
            "width": WIDTH,
            "height": HEIGHT,
        }
        (root / "vipe").mkdir(parents=True, exist_ok=True)
        (root / "vipe" / f"{key}_info.json").write_text(json.dumps(description))
    for folder in ("pose", "intrinsics", "depth", "rgb"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    inds = np.arange(num_frames, dtype=np.int64)
    np.savez(root / "pose" / f"{key}.npz", data=poses_of(num_frames), inds=inds)
    row = np.array([10, 10, WIDTH / 2, HEIGHT / 2], dtype=np.float32)
    np.savez(root / "intrinsics" / f"{key}.npz", data=np.tile(row, (num_frames, 1)), inds=inds)
    (root / "intrinsics" / f"{key}_camera.txt").write_text("".join(f"{i}: PINHOLE\n" for i in range(num_frames)))
    with zipfile.ZipFile(root / "depth" / f"{key}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(num_frames):
            exr = root / "frame.exr"
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"Z": depth_of(i)}) as file:
                file.write(str(exr))
            archive.writestr(zipfile.ZipInfo(f"{i:05d}.exr"), exr.read_bytes())
            exr.unlink()
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for i in range(num_frames):
            image = np.full((HEIGHT, WIDTH, 3), 40 * i, dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    (root / "rgb" / f"{key}.mp4").write_bytes(buffer.getvalue())


def make_lease(
    keys: Sequence[str], *, ordinal: int = 0, attempt: int = 1, fence: int | None = None, output: str = "/out"
) -> Lease:
    plan = ShardPlan(ordinal, tuple(VideoRef(key, f"/in/{key}.mp4", 100) for key in keys))
    return Lease(
        job_id=JOB,
        shard_id=shard_id(JOB, ordinal),
        ordinal=ordinal,
        plan_hash=plan.plan_hash,
        videos=plan.videos,
        spec=JobSpec(inputs=("/in",), output=output, attributes=ATTRIBUTES),
        attempt=attempt,
        fence=attempt if fence is None else fence,
        holder=f"agent-{attempt}",
        expires_at=datetime(2030, 1, 1, tzinfo=UTC),
    )


def success(key: str, num_frames: int = 3, attempt: int = 1) -> VideoResult:
    return VideoResult(
        key=key,
        uri=f"/in/{key}.mp4",
        status=VideoStatus.SUCCEEDED,
        attempt=attempt,
        num_frames=num_frames,
        num_keyframes=2,
        width=WIDTH,
        height=HEIGHT,
        fps=10.0,
        duration_s=num_frames / 10,
        camera_model="pinhole",
        camera_params=(10.0, 10.0, WIDTH / 2, HEIGHT / 2),
        fov_x_deg=77.3,
        trajectory_length=0.25 * (num_frames - 1),
        scale="relative",
        depth_kind="z",
        quality={"reliable": "doubtful", "reasons": ["few_keyframes"], "residual_px": 0.4, "inlier_ratio": None},
        seconds=1.5,
        timings_s={"decode": 0.5, "slam": 1.0},
        source={"codec": "h264"},
        provenance={"engine_version": "0.1.0", "config_hash": "c0ffee", "preset": "classical", "device": "cpu"},
    )


def failure(key: str, *, quarantined: bool = False, attempt: int = 1) -> VideoResult:
    return VideoResult(
        key=key,
        uri=f"/in/{key}.mp4",
        status=VideoStatus.QUARANTINED if quarantined else VideoStatus.FAILED,
        attempt=attempt,
        error_code="worker_died" if quarantined else "media_corrupt",
        error_message=f"/in/{key}.mp4 cannot be decoded; check the file",
    )


def commit_shard(
    lease: Lease,
    results: Sequence[VideoResult],
    artifacts_root: Path,
    scratch: Path,
    store: ObjectStore,
    holds: Callable[[], bool],
) -> CommitOutcome:
    """Both steps of the protocol, one after the other."""
    return write_record(store, prepare_payload(lease, results, artifacts_root, scratch, store), holds)
