"""Where things lie in an output, and how the engine's artifacts become members of webdataset tars.

payload/<prefix>-<8 hex>/{pose,intrinsics,depth,rgb,mask,confidence}.tar   what NVIDIA published its data sets in
_commits/<job id>/<shard id>.json                               the create-once records; readers trust nothing else
_claims/<prefix>-<8 hex>.json                                   who took a tar name
_plan/<number>.json                                             which shards there must be, see `services.commit.plan`
_job.json                                                       whose output it is
meta.parquet, failures.parquet, dataset.json, README.md         written once every shard has its record
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from services.domain.errors import IntegrityError
from services.domain.models import Attribute

ATTRIBUTES: tuple[Attribute, ...] = get_args(Attribute)
FOLDERS = ("payload/", "_commits/", "_claims/", "_plan/")
JOB_KEY = "_job.json"
REQUIRED: tuple[Attribute, ...] = ("pose", "intrinsics")


@dataclass(frozen=True, slots=True)
class Member:
    """One artifact of a sample.

    Attributes:
        extension: What follows the first dot of the member's name; webdataset calls it the field.
        artifact: Path below the artifact root, `{key}` stands for the sample key.
        optional: The engine may leave it out.
    """

    extension: str
    artifact: str
    optional: bool = False

    def path(self, root: Path, key: str) -> Path:
        return root / self.artifact.format(key=key)

    def name(self, key: str) -> str:
        return f"{key}.{self.extension}"


# Members in the order in which they lie in the tar: by extension, as the webdataset writer sorts them. The camera
# file is `S_camera.txt` on disk and `S.camera.txt` in a tar, because webdataset takes the key up to the first dot. The
# sample's json (quality, provenance, timestamps) travels with the poses, the one tar that everybody downloads, and so
# does the rig of a view.
MEMBERS: dict[Attribute, tuple[Member, ...]] = {
    "pose": (
        Member("json", "vipe/{key}_info.json", optional=True),
        Member("npz", "pose/{key}.npz"),
        Member("rig.json", "vipe/{key}_rig.json", optional=True),
    ),
    "intrinsics": (Member("camera.txt", "intrinsics/{key}_camera.txt"), Member("npz", "intrinsics/{key}.npz")),
    "depth": (Member("zip", "depth/{key}.zip"),),
    "rgb": (Member("mp4", "rgb/{key}.mp4"),),
    "mask": (Member("txt", "mask/{key}.txt"), Member("zip", "mask/{key}.zip")),
    "confidence": (Member("kind.zip", "confidence/{key}_kind.zip"), Member("zip", "confidence/{key}.zip")),
}


def attributes_of(requested: Sequence[Attribute]) -> tuple[Attribute, ...]:
    """The tars of a shard in their fixed order: what was requested, and always poses and intrinsics."""
    return tuple(a for a in ATTRIBUTES if a in requested or a in REQUIRED)


def sample_files(root: Path, attribute: Attribute, key: str) -> list[tuple[str, Path]]:
    """(member name, file) of one sample in tar order.

    Raises:
        IntegrityError: The engine reported success, but an artifact is not there.
    """
    files = []
    for member in MEMBERS[attribute]:
        path = member.path(root, key)
        if path.is_file():
            files.append((member.name(key), path))
        elif not member.optional:
            raise IntegrityError(f"the {attribute} artifact of video {key} is missing: {path.name}")
    return files


def commit_prefix(job_id: str) -> str:
    return f"_commits/{job_id}/"


def commit_key(job_id: str, shard_id: str) -> str:
    return f"{commit_prefix(job_id)}{shard_id}.json"


def claim_key(tar_name: str) -> str:
    return f"_claims/{tar_name}.json"


def payload_key(tar_name: str, attribute: Attribute) -> str:
    return f"payload/{tar_name}/{attribute}.tar"
