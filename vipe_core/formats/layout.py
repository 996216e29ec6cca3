"""Where ViPE's directory layout keeps the parts of a sequence, and how they are named inside of tars.

On disk the camera models lie in `intrinsics/S_camera.txt`; in a tar that member is `S.camera.txt`, because a webdataset
key ends at the first dot and must be S for all members of a sample. The same holds for `confidence/S_kind.zip`.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from vipe_core.errors import FormatError

# attribute -> member suffix -> path below the root, with {} for the sequence name.
_MEMBERS: dict[str, dict[str, str]] = {
    "pose": {"npz": "pose/{}.npz"},
    "intrinsics": {"npz": "intrinsics/{}.npz", "camera.txt": "intrinsics/{}_camera.txt"},
    "depth": {"zip": "depth/{}.zip"},
    "mask": {"zip": "mask/{}.zip", "txt": "mask/{}.txt"},
    "rgb": {"mp4": "rgb/{}.mp4"},
    "confidence": {"zip": "confidence/{}.zip", "kind.zip": "confidence/{}_kind.zip"},
}
ATTRIBUTES = tuple(_MEMBERS)

INFO_FOLDER = "vipe"


def member_path(attribute: str, member: str) -> PurePosixPath:
    """Path below the root of tar member `member` (such as `S.camera.txt`) of `attribute`.

    Raises:
        FormatError: No such attribute, or a member that does not belong into its tar.
    """
    name, _, suffix = member.partition(".")
    template = _MEMBERS.get(attribute, {}).get(suffix)
    if template is None or not name or "/" in name:
        raise FormatError(f"{attribute}.tar: unexpected member {member!r}")
    return PurePosixPath(template.format(name))


def info_path(root: str | Path, name: str) -> Path:
    """Our description of the sequence; it is written last, so its presence means that the sequence is complete."""
    return Path(root, INFO_FOLDER, f"{name}_info.json")


def rig_path(root: str | Path, name: str) -> Path:
    """The rig that was found (`cameras.rig`), of a view in a data set."""
    return Path(root, INFO_FOLDER, f"{name}_rig.json")


def artifact_path(root: str | Path, name: str, attribute: str, suffix: str) -> Path:
    return Path(root, _MEMBERS[attribute][suffix].format(name))


def artifact_files(root: str | Path, name: str, attribute: str) -> list[Path]:
    """Where the files of one attribute of a sequence are, or would be."""
    return [Path(root, template.format(name)) for template in _MEMBERS[attribute].values()]


def sample_members(root: str | Path, name: str) -> dict[str, dict[str, Path]]:
    """The files of a sequence as attribute -> member suffix -> path; attributes without files are left out.

    Tar members are named `{name}.{suffix}`. Order is fixed.

    Raises:
        FormatError: The sequence has no poses, or an attribute is there in part only.
    """
    found: dict[str, dict[str, Path]] = {}
    for attribute, members in _MEMBERS.items():
        paths = {suffix: Path(root, template.format(name)) for suffix, template in members.items()}
        present = [suffix for suffix, path in paths.items() if path.is_file()]
        if present and len(present) < len(paths):
            missing = next(path for suffix, path in paths.items() if suffix not in present)
            raise FormatError(f"{name}: {missing.parent.name}/{missing.name} is missing beside its companion")
        if present:
            found[attribute] = paths
    if "pose" not in found:
        raise FormatError(f"{name}: no artifacts of this sequence in {Path(root).name}; pose/{name}.npz is missing")
    return found


def list_sequences(root: str | Path) -> list[str]:
    """Names of the sequences below `root` that have poses, sorted."""
    return sorted(path.stem for path in Path(root, "pose").glob("*.npz") if not path.name.startswith("."))
