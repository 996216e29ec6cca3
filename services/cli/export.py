"""`vipectl export`: annotated videos in the formats of other tools."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from services.cli.data import Endpoint

if TYPE_CHECKING:
    from services.domain.models import Attribute
    from vipe_core.formats import Artifacts

Format = Literal["npz", "png16", "video", "ply", "mesh", "colmap", "nerfstudio", "pictures"]


def export(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A job's output, or a folder of artifacts.")],
    destination: Annotated[Path, typer.Argument(metavar="DEST", help="Gets one file or folder per video.")],
    format: Annotated[
        Format,
        typer.Option(
            "--format",
            help="npz: arrays. png16: 16-bit depth. video: coloured depth. ply: fused points. mesh: fused surface. "
            "colmap: sparse model. nerfstudio: transforms.json. pictures: frames and camera.json.",
        ),
    ] = "npz",
    key: Annotated[list[str] | None, typer.Option("--key", help="Only these videos.")] = None,
    depth_stride: Annotated[int, typer.Option(min=1, help="npz: keep every n-th depth pixel per axis.")] = 4,
    beside_rgb: Annotated[bool, typer.Option("--beside-rgb", help="video: the frames to the left.")] = False,
    text: Annotated[bool, typer.Option("--text", help="colmap: write .txt instead of .bin.")] = False,
    every: Annotated[
        int, typer.Option(min=1, help="ply, mesh, colmap, nerfstudio, pictures: use every n-th frame.")
    ] = 1,
    voxel: Annotated[
        float | None,
        typer.Option(min=1e-9, help="Distance of points in units of the world; by default a share of the depth."),
    ] = None,
    min_confidence: Annotated[
        float | None, typer.Option(min=0, max=1, help="Depth of less confidence is no part of a cloud or a mesh.")
    ] = None,
    rectify: Annotated[
        bool,
        typer.Option(
            "--rectify", help="As a pinhole sees it: straight lines are straight. With the maps, rectification.npz."
        ),
    ] = False,
    fov: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="--rectify: horizontal field of view; by default the camera's, 100 at most."),
    ] = None,
    shot: Annotated[
        int | None, typer.Option(min=1, help="Of a video with cuts, this shot only; the first is 1.")
    ] = None,
    endpoint: Endpoint = None,
) -> None:
    """Export each video to a file or a folder of another format.

    Clouds and meshes leave out what moves. The scale of everything is that of the poses.
    """
    from vipe_core.formats.fused import MIN_CONFIDENCE
    from vipe_core.formats.rectified import MAPS_FILE, rectified, write_maps

    least = MIN_CONFIDENCE if min_confidence is None else min_confidence
    # Without the pictures where they are not needed: they are most of what would be fetched.
    attributes: tuple[Attribute, ...] | None = ("pose", "intrinsics", "depth") if format in ("npz", "png16") else None
    if fov is not None and not rectify:
        raise typer.BadParameter("the field of view is that of --rectify", param_hint="--fov")
    for artifacts in sequences(source, key, endpoint, attributes):
        chosen = artifacts if shot is None else artifacts.shot(shot)
        if rectify:
            chosen = rectified(chosen, fov)
        stem = artifacts.name if shot is None else f"{artifacts.name}-shot{shot}"
        out = destination / f"{stem}{_SUFFIXES.get(format, '')}"
        typer.echo(_write(chosen, out, format, depth_stride, beside_rgb, text, every, voxel, least))
        if rectify:
            write_maps(chosen, out / MAPS_FILE if out.is_dir() else out.with_name(f"{stem}_{MAPS_FILE}"))


# What has no suffix is a folder.
_SUFFIXES = {"npz": ".npz", "video": ".mp4", "ply": ".ply", "mesh": ".ply"}


def _write(
    artifacts: Artifacts,
    out: Path,
    format: Format,
    depth_stride: int,
    beside_rgb: bool,
    text: bool,
    step: int,
    voxel: float | None,
    least: float,
) -> Path:
    from vipe_core.formats import export_npz, export_png16
    from vipe_core.formats.colmap import export_colmap
    from vipe_core.formats.fused import fuse_cloud, fuse_mesh
    from vipe_core.formats.nerfstudio import export_nerfstudio
    from vipe_core.formats.ply import write_ply
    from vipe_core.formats.rectified import export_pictures

    match format:
        case "npz":
            return export_npz(artifacts, out, depth_stride=depth_stride)
        case "png16":
            return export_png16(artifacts, out)
        case "video":
            from vipe_core.rendering.depth_video import export_depth_video

            return export_depth_video(artifacts, out, beside_rgb=beside_rgb)
        case "ply":
            cloud = fuse_cloud(artifacts, voxel=voxel, min_confidence=least, step=step)
            return write_ply(out, cloud, comments=_comments(artifacts))
        case "mesh":
            mesh = fuse_mesh(artifacts, voxel=voxel, min_confidence=least, step=step)
            return write_ply(out, mesh, comments=_comments(artifacts))
        case "colmap":
            return export_colmap(artifacts, out, text=text, step=step, voxel=voxel, min_confidence=least)
        case "nerfstudio":
            return export_nerfstudio(artifacts, out, step=step, voxel=voxel, min_confidence=least)
        case "pictures":
            return export_pictures(artifacts, out, step=step)


def _comments(artifacts: Artifacts) -> list[str]:
    scale = artifacts.info.get("scale", "metric")
    unit = "metres" if scale == "metric" else "relative, as the poses"
    return [
        f"sequence {artifacts.name}",
        f"unit: {unit}",
        "axes of the first camera: x right, y down, z forward",
    ]


def sequences(
    source: str, keys: list[str] | None, endpoint: str | None, attributes: Sequence[Attribute] | None = None
) -> Iterator[Artifacts]:
    """The chosen sequences of a job's output (unpacked one at a time) or of a folder of artifacts.

    Args:
        attributes: What to unpack; None for all that is there.

    Raises:
        typer.BadParameter: One of `keys` is not there, or there is nothing at all.
    """
    import tempfile

    from services.cli.addresses import absolute
    from services.dataset import DatasetIndex
    from services.dataset import unpack as unpack_dataset
    from services.storage import open_store
    from vipe_core.formats import list_sequences, read_artifacts

    if (Path(source) / "pose").is_dir():
        for name in _chosen(list_sequences(source), keys):
            yield read_artifacts(source, name)
        return
    store = open_store(absolute(source), endpoint_url=endpoint)
    with DatasetIndex(store) as index:
        names = _chosen([str(row["sequence"]) for row in index.rows(["sequence"])], keys)
    for name in names:
        # One video at a time, so that an export needs little room beside its result.
        with tempfile.TemporaryDirectory(prefix="vipe-export-") as scratch:
            unpack_dataset(store, Path(scratch), keys=[name], attributes=attributes)
            yield read_artifacts(scratch, name)


def _chosen(names: list[str], keys: list[str] | None) -> list[str]:
    unknown = sorted(set(keys or ()) - set(names))
    if unknown:
        raise typer.BadParameter(f"no such video here: {', '.join(unknown)}")
    return [name for name in names if not keys or name in keys]
