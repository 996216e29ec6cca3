"""The data set's README: a card that the Hugging Face hub and people can read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from services.commit.layout import attributes_of
from services.domain.models import JobSpec
from vipe_core.annotation import DEPTH_KINDS

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))

_CONTENT = {
    "pose": "`S.npz`: `data` float32 (N, 4, 4) camera-to-world, OpenCV axes; `inds` int64 (N,). "
    "`S.json`: timestamps, keyframes, quality, provenance",
    "intrinsics": "`S.npz`: `data` float32 (N, D), `inds` int64 (N,); PINHOLE fx fy cx cy, MEI adds k. "
    "`S.camera.txt`: camera type of each frame",
    "depth": "`S.zip`: `%05d.exr` per frame, one half channel `Z`, 0 = no value",
    "rgb": "`S.mp4`: the frames that the annotation belongs to, H.264",
    "mask": "`S.zip`: `%05d.png` instance ids per frame, 0 = background; `S.txt`: id and phrase",
    "confidence": "`S.zip`: `%05d.png` per frame, confidence of the depth in steps of 1/255, 0 = filled in; "
    "`S.kind.zip`: `%05d.png`, where it comes from: " + ", ".join(f"{n} {word}" for n, word in DEPTH_KINDS.items()),
}

_CARD = """---
pretty_name: "{title}"
license: unknown
size_categories:
- {size}
task_categories:
- depth-estimation
tags:
- camera-pose
- camera-intrinsics
- video
- webdataset
- vipe
configs:
- config_name: index
  data_files: meta.parquet
---

# {title}

Camera poses, intrinsics and dense depth of {succeeded} videos ({frames} frames), made by ViPE's method with the preset
`{preset}` and camera model `{camera}`. The rights in the videos stay with their owners.

| | |
|---|---|
| Videos in | {videos} |
| Annotated | {succeeded} |
| Failed, see `failures.parquet` | {failed} |
| Quarantined, see `failures.parquet` | {quarantined} |
| Frames | {frames} |
| Hours of video | {hours:.2f} |
| Payload | {size_bytes} bytes in {objects} tars |
| Job | `{job_id}` |
| Config | `{config_hash}` |

## Layout

`meta.parquet` has one row per video: `sequence` (its key S), `num_frames`, `tar_name`, then camera, quality and
provenance, and for each member its `_offset` and `_size` in the tar, so that one video can be fetched by range
requests.
`dataset.json` lists every tar with its size and sha256; it was written last, so its presence means completeness.

Every `payload/<tar_name>/<attribute>.tar` is a webdataset tar; the tars of one folder hold the same keys in the same
order.

| tar | members |
|---|---|
{members}

```python
import webdataset as wds
for sample in wds.WebDataset("payload/<tar_name>/pose.tar", shardshuffle=False):
    sample["__key__"], sample["npz"]
```
"""


def dataset_card(job_id: str, spec: JobSpec, totals: Mapping[str, Any]) -> str:
    """Markdown with YAML front matter. `totals` are those of `finalise.Totals`."""
    title = " ".join("".join(c for c in spec.name if c.isprintable() and c not in '"\\').split()) or f"ViPE {job_id}"
    return _CARD.format(
        **totals,
        title=title,
        size=next((label for limit, label in _SIZES if totals["succeeded"] < limit), "1M<n<10M"),
        preset=spec.preset,
        camera=spec.camera if spec.calibration is None else spec.calibration["model"],
        hours=totals["duration_s"] / 3600,
        job_id=job_id,
        config_hash=spec.config_hash,
        members="\n".join(f"| `{a}.tar` | {_CONTENT[a]} |" for a in attributes_of(spec.attributes)),
    )
