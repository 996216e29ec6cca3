"""`vipectl export` and `vipectl gallery` on a job's output with all its tars, and on a folder of artifacts."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import plyfile
import pytest
from exact_room import distance_to_surfaces
from room_artifacts import write_room
from shard_factory import JOB, commit_shard, make_lease, success
from typer.testing import CliRunner

from services.cli.main import app
from services.dataset import finalise, iterate, verify
from services.domain.models import DEFAULT_ATTRIBUTES, Attribute, JobSpec, Lease
from services.storage import DirectoryStore
from vipe_core.annotation import MOVING
from vipe_core.formats import KindZipReader
from vipe_core.video import open_source

ALL: tuple[Attribute, ...] = (*DEFAULT_ATTRIBUTES, "confidence")


def commit(tmp_path: Path, attributes: tuple[Attribute, ...]) -> DirectoryStore:
    """A finished job of two videos with these tars."""
    store = DirectoryStore(tmp_path / "dataset")
    spec = JobSpec(inputs=("/in",), output="/out", attributes=attributes)
    keys = ["hall-1", "room-2"]
    frames = {key: write_room(tmp_path / "artifacts", name=key).num_frames for key in keys}
    lease = make_lease(keys)
    lease = Lease(**{name: getattr(lease, name) for name in lease.__slots__} | {"spec": spec})
    results = [success(key, count) for key, count in frames.items()]
    commit_shard(lease, results, tmp_path / "artifacts", tmp_path / "scratch", store, lambda: True)
    finalise(store, JOB, spec, num_shards=1, num_videos=2)
    return store


def run(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.output


def test_confidence_is_a_tar_of_its_own_when_it_is_asked_for(tmp_path: Path) -> None:
    store = commit(tmp_path, ALL)
    (path,) = (tmp_path / "dataset").rglob("confidence.tar")
    with tarfile.open(path) as tar:
        assert tar.getnames() == ["hall-1.kind.zip", "hall-1.zip", "room-2.kind.zip", "room-2.zip"]
    assert verify(store, deep=True).problems == []
    samples = list(iterate(store))
    assert [sample.key for sample in samples] == ["hall-1", "room-2"]
    (tmp_path / "kind.zip").write_bytes(samples[0].files["confidence"]["kind.zip"])
    with KindZipReader(tmp_path / "kind.zip") as kinds:
        assert (kinds.read(0)[40, 30], len(kinds)) == (MOVING, 9)
    assert "confidence" not in DEFAULT_ATTRIBUTES
    assert JobSpec(("/in",), "/out").attributes == DEFAULT_ATTRIBUTES == ("pose", "intrinsics", "depth", "rgb", "mask")


@pytest.mark.parametrize("attributes", [DEFAULT_ATTRIBUTES, ALL])
def test_a_data_set_is_exported_to_every_format(tmp_path: Path, attributes: tuple[Attribute, ...]) -> None:
    commit(tmp_path, attributes)
    source = tmp_path / "dataset"
    said = run("export", source, tmp_path / "npz")
    assert [Path(line).name for line in said.splitlines()] == ["hall-1.npz", "room-2.npz"]
    with np.load(tmp_path / "npz" / "hall-1.npz") as arrays:
        assert arrays["depth"].shape == (9, 30, 40)

    run("export", source, tmp_path / "ply", "--format", "ply", "--key", "room-2", "--voxel", 0.05)
    assert [path.name for path in (tmp_path / "ply").iterdir()] == ["room-2.ply"]
    vertex = plyfile.PlyData.read(tmp_path / "ply" / "room-2.ply")["vertex"]
    points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    away = distance_to_surfaces(points)
    # The moving patch is masked in both; without confidence, what was filled in looks measured.
    assert np.quantile(away, 0.99 if attributes == ALL else 0.8) < 0.02

    run("export", source, tmp_path / "mp4", "--format", "video", "--beside-rgb", "--key", "hall-1")
    assert open_source(tmp_path / "mp4" / "hall-1.mp4").info.width == 320
    run("export", source, tmp_path / "png", "--format", "png16", "--key", "hall-1")
    assert len(list((tmp_path / "png" / "hall-1" / "depth").glob("*.png"))) == 9


def test_a_folder_of_artifacts_and_what_is_wrong(tmp_path: Path) -> None:
    write_room(tmp_path / "a")
    write_room(tmp_path / "a", "mei", name="wide")
    run("export", tmp_path / "a", tmp_path / "mesh", "--format", "mesh", "--key", "room", "--voxel", 0.08)
    assert len(plyfile.PlyData.read(tmp_path / "mesh" / "room.ply")["face"]) > 1000
    run("export", tmp_path / "a", tmp_path / "colmap", "--format", "colmap", "--text", "--every", 4, "--key", "room")
    assert (tmp_path / "colmap/room/sparse/0/points3D.txt").is_file()
    run("export", tmp_path / "a", tmp_path / "ns", "--format", "nerfstudio", "--every", 4, "--key", "room")
    assert len(json.loads((tmp_path / "ns/room/transforms.json").read_text())["frames"]) == 3
    refused = CliRunner().invoke(app, ["export", str(tmp_path / "a"), str(tmp_path / "x"), "--format", "nerfstudio"])
    assert refused.exit_code == 1
    assert "[export_unsupported]" in refused.output
    unknown = CliRunner().invoke(app, ["export", str(tmp_path / "a"), str(tmp_path / "x"), "--key", "nobody"])
    assert unknown.exit_code == 2
    assert "nobody" in unknown.output
