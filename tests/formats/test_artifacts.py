"""ViPE's artifact layout: exact facts of the files, round trips, reproducible bytes, nothing half-written."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from artifact_samples import CAMERAS, HEIGHT, WIDTH, depth_of, make_annotation
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.annotation import DenseFrame
from vipe_core.errors import EngineError, FormatError
from vipe_core.formats import list_sequences, member_path, read_artifacts, sample_members, write_artifacts
from vipe_core.video import open_source

MODELS = ["pinhole", "mei", "equirect"]


def files_below(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(
    ("model", "disk_name", "values"),
    [
        ("pinhole", "PINHOLE", [40.5, 40.25, 24, 16]),
        ("mei", "MEI", [40.5, 40.25, 24, 16, 0.75]),
        ("equirect", "PANORAMA", [0, 0, 0, 0]),
    ],
)
def test_files_hold_what_vipe_writes(tmp_path: Path, model: str, disk_name: str, values: list[float]) -> None:
    annotation = make_annotation(model)
    write_artifacts(annotation, tmp_path)
    assert set(files_below(tmp_path)) == {
        "pose/clip.npz",
        "intrinsics/clip.npz",
        "intrinsics/clip_camera.txt",
        "depth/clip.zip",
        "rgb/clip.mp4",
        "mask/clip.zip",
        "mask/clip.txt",
        "confidence/clip.zip",
        "confidence/clip_kind.zip",
        "vipe/clip_info.json",
    }
    with np.load(tmp_path / "pose/clip.npz", allow_pickle=False) as pose:
        assert sorted(pose.files) == ["data", "inds"]
        assert (pose["data"].dtype, pose["inds"].dtype) == (np.float32, np.int64)
        assert np.array_equal(pose["data"], annotation.world_from_cam.astype(np.float32))
        assert pose["inds"].tolist() == list(range(7))
    with np.load(tmp_path / "intrinsics/clip.npz", allow_pickle=False) as intrinsics:
        assert sorted(intrinsics.files) == ["data", "inds"]
        assert (intrinsics["data"].dtype, intrinsics["inds"].dtype) == (np.float32, np.int64)
        assert intrinsics["data"].tolist() == [values] * 7
    lines = (tmp_path / "intrinsics/clip_camera.txt").read_text().splitlines()
    assert lines == [f"{index}: {disk_name}" for index in range(7)]


def test_the_video_has_the_frames_size_and_rate(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path)
    source = open_source(tmp_path / "rgb/clip.mp4")
    frames = list(source.frames())
    assert (len(frames), source.info.num_frames_hint) == (7, 7)
    assert (source.info.width, source.info.height, source.info.pixel_format) == (WIDTH, HEIGHT, "yuv420p")
    assert source.info.fps == pytest.approx(30000 / 1001)
    assert [float(frame.rgb.mean()) for frame in frames] == pytest.approx(
        [20 + 10 * index for index in range(7)], abs=2
    )


@pytest.mark.parametrize("model", MODELS)
def test_reading_gives_the_annotation_back(tmp_path: Path, model: str) -> None:
    annotation = make_annotation(model)
    write_artifacts(annotation, tmp_path)
    artifacts = read_artifacts(tmp_path, "clip")
    assert artifacts.camera == CAMERAS[model]
    assert artifacts.world_from_cam.dtype == np.float64
    assert np.allclose(artifacts.world_from_cam, annotation.world_from_cam, atol=1e-6)
    assert artifacts.frame_index.tolist() == list(range(7))
    assert np.array_equal(artifacts.timestamps_s, annotation.timestamps_s)
    assert artifacts.depth_kind == annotation.depth_kind
    with artifacts.open_depth() as reader:
        for index, depth in enumerate(reader):
            assert np.allclose(depth, depth_of(index), rtol=1e-3)
            assert np.array_equal(depth == 0, depth_of(index) == 0)
    assert artifacts.info["quality"]["reliable"] == "doubtful"
    assert artifacts.info["quality"]["focal_sigma_ratio"] is None
    assert artifacts.info["keyframes"] == [0, 6]
    assert artifacts.info["provenance"]["config_hash"] == "abc"
    assert "timings_s" not in artifacts.info


@pytest.mark.parametrize("model", ["pinhole", "mei"])
def test_distances_become_z_on_disk(tmp_path: Path, model: str) -> None:
    annotation = replace(make_annotation(model, 2), depth_kind="ray")
    write_artifacts(annotation, tmp_path, attributes=("pose", "intrinsics", "depth"))
    artifacts = read_artifacts(tmp_path, "clip")
    assert artifacts.depth_kind == artifacts.info["depth_kind"] == "z"
    fx, fy, cx, cy, *alpha = annotation.camera.params
    a = alpha[0] if alpha else 0.0
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    r2 = ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2
    # z of the unit ray of the unified model (a = 0 is the pinhole).
    z = (a + np.sqrt(1 + (1 - a * a) * r2)) / (1 + r2) - a
    with artifacts.open_depth() as reader:
        assert np.allclose(reader.read(1), depth_of(1) * z, rtol=1e-3)


def test_z_of_a_panorama_becomes_distance_ahead_and_nothing_behind(tmp_path: Path) -> None:
    annotation = replace(make_annotation("equirect", 1), depth_kind="z")
    write_artifacts(annotation, tmp_path, attributes=("pose", "intrinsics", "depth"))
    with read_artifacts(tmp_path, "clip").open_depth() as reader:
        depth = reader.read(0)
    v, u = HEIGHT // 2, WIDTH // 2 + 2
    angle = (u + 0.5 - WIDTH / 2) / WIDTH * 2 * np.pi
    elevation = (v + 0.5 - HEIGHT / 2) / HEIGHT * np.pi
    assert depth[v, u] == pytest.approx(depth_of(0)[v, u] / (np.cos(angle) * np.cos(elevation)), rel=1e-3)
    assert depth[:, : WIDTH // 4].max() == 0


def test_two_writes_give_the_same_bytes(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path / "a")
    write_artifacts(make_annotation(), tmp_path / "b")
    assert files_below(tmp_path / "a") == files_below(tmp_path / "b")


def test_no_file_is_a_pickle(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path)
    for data in files_below(tmp_path).values():
        with pytest.raises(
            (pickle.UnpicklingError, EOFError, ValueError, KeyError, IndexError, AttributeError, ImportError)
        ):
            pickle.loads(data)


def test_attributes_and_progress(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    paths = write_artifacts(
        make_annotation(), tmp_path, attributes=("pose", "depth"), progress=lambda *c: calls.append(c)
    )
    assert set(files_below(tmp_path)) == {"pose/clip.npz", "depth/clip.zip", "vipe/clip_info.json"}
    assert (paths.rgb, paths.intrinsics) == (None, None)
    assert set(paths.files) == {path for path in tmp_path.rglob("*") if path.is_file()}
    assert calls == [(index, 7) for index in range(1, 8)]
    assert json.loads(paths.info.read_text())["attributes"] == ["pose", "depth"]
    with pytest.raises(ValueError, match="unknown attributes"):
        write_artifacts(make_annotation(), tmp_path, attributes=("flow",))


def test_a_failure_leaves_nothing_and_keeps_an_earlier_result(tmp_path: Path) -> None:
    def interrupted(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_artifacts(make_annotation(), tmp_path, progress=interrupted)
    assert list(tmp_path.iterdir()) == []
    write_artifacts(make_annotation(num_frames=4), tmp_path)
    before = files_below(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        write_artifacts(make_annotation(), tmp_path, progress=interrupted)
    assert files_below(tmp_path) == before
    write_artifacts(make_annotation(), tmp_path)
    assert read_artifacts(tmp_path, "clip").num_frames == 7


@pytest.mark.parametrize("dense_frames", [0, 5, 9])
def test_a_dense_stream_of_another_length_is_an_error(tmp_path: Path, dense_frames: int) -> None:
    with pytest.raises((EngineError, ValueError), match="clip"):
        write_artifacts(make_annotation(dense_frames=dense_frames), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../clip", "a b", "a.b", ""])
def test_unsafe_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="sanitise_name"):
        write_artifacts(make_annotation(name=name), tmp_path)


def test_directories_of_the_original_tool_are_read(tmp_path: Path) -> None:
    """No info file; no camera file either, as in the published datasets."""
    write_artifacts(make_annotation(), tmp_path)
    shutil.rmtree(tmp_path / "vipe")
    (tmp_path / "intrinsics/clip_camera.txt").unlink()
    artifacts = read_artifacts(tmp_path, "clip")
    assert artifacts.camera == CAMERAS["pinhole"]
    assert (artifacts.timestamps_s, artifacts.info) == (None, {})
    (tmp_path / "depth/clip.zip").unlink()
    assert read_artifacts(tmp_path, "clip").camera == CAMERAS["pinhole"]
    (tmp_path / "rgb/clip.mp4").unlink()
    with pytest.raises(FormatError, match="size of the pictures"):
        read_artifacts(tmp_path, "clip")


def test_mei_without_its_camera_file_is_refused(tmp_path: Path) -> None:
    write_artifacts(make_annotation("mei"), tmp_path)
    (tmp_path / "intrinsics/clip_camera.txt").unlink()
    with pytest.raises(FormatError, match=r"intrinsics/clip\.npz"):
        read_artifacts(tmp_path, "clip")


BAD_POSES = {
    "truncated": b"PK\x03\x04 something",
    "empty": b"",
    "pickle": pickle.dumps({"data": 1}),
}


@pytest.mark.parametrize("content", BAD_POSES.values(), ids=BAD_POSES.keys())
def test_unreadable_poses_are_refused(tmp_path: Path, content: bytes) -> None:
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics", "depth"))
    (tmp_path / "pose/clip.npz").write_bytes(content)
    with pytest.raises(FormatError, match=r"pose/clip\.npz"):
        read_artifacts(tmp_path, "clip")


@pytest.mark.parametrize(
    "arrays",
    [
        {"data": np.zeros((7, 3, 4), np.float32), "inds": np.arange(7)},
        {"data": np.full((7, 4, 4), np.nan, np.float32), "inds": np.arange(7)},
        {"data": np.zeros((7, 4, 4), np.float32), "inds": np.arange(7)},
        {"data": np.tile(np.eye(4, dtype=np.float32), (7, 1, 1)), "inds": np.arange(6)},
        {"data": np.tile(np.eye(4, dtype=np.float32), (7, 1, 1))},
        {"data": np.array([{"a": 1}] * 7, dtype=object), "inds": np.arange(7)},
        {"data": np.zeros((0, 4, 4), np.float32), "inds": np.arange(0)},
    ],
)
def test_wrong_poses_are_refused(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics", "depth"))
    np.savez(tmp_path / "pose/clip.npz", **arrays)
    with pytest.raises(FormatError, match=r"pose/clip\.npz"):
        read_artifacts(tmp_path, "clip")


@pytest.mark.parametrize(
    "text",
    [
        "0: PINHOLE\n",
        "nonsense\n" * 7,
        "".join(f"{i}: FISHEYE\n" for i in range(7)),
        "".join(f"{i}: {'MEI' if i else 'PINHOLE'}\n" for i in range(7)),
    ],
)
def test_wrong_camera_files_are_refused(tmp_path: Path, text: str) -> None:
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics", "depth"))
    (tmp_path / "intrinsics/clip_camera.txt").write_text(text)
    with pytest.raises(FormatError, match=r"clip_camera\.txt"):
        read_artifacts(tmp_path, "clip")


def test_a_depth_archive_of_another_length_is_refused(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path / "a", attributes=("pose", "intrinsics", "depth"))
    write_artifacts(make_annotation(num_frames=3), tmp_path / "b", attributes=("depth",))
    shutil.copy(tmp_path / "b/depth/clip.zip", tmp_path / "a/depth/clip.zip")
    with pytest.raises(FormatError, match="3 depth maps for 7 poses"):
        read_artifacts(tmp_path / "a", "clip").open_depth()


def test_sample_members_and_their_inverse(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path)
    members = sample_members(tmp_path, "clip")
    assert {attribute: list(files) for attribute, files in members.items()} == {
        "pose": ["npz"],
        "intrinsics": ["npz", "camera.txt"],
        "depth": ["zip"],
        "mask": ["zip", "txt"],
        "rgb": ["mp4"],
        "confidence": ["zip", "kind.zip"],
    }
    for attribute, files in members.items():
        for suffix, path in files.items():
            assert tmp_path / member_path(attribute, f"clip.{suffix}") == path
    (tmp_path / "mask/clip.txt").unlink()
    with pytest.raises(FormatError, match=r"mask/clip\.txt"):
        sample_members(tmp_path, "clip")
    (tmp_path / "mask/clip.txt").touch()
    assert list_sequences(tmp_path) == ["clip"]
    with pytest.raises(FormatError, match=r"pose/other\.npz"):
        sample_members(tmp_path, "other")


@pytest.mark.parametrize(
    ("attribute", "member"),
    [
        ("pose", "clip.txt"),
        ("pose", "../clip.npz"),
        ("pose", ".npz"),
        ("flow", "clip.zip"),
        ("rgb", "clip"),
        ("pose", "a/b.npz"),
    ],
)
def test_members_that_do_not_belong_are_refused(attribute: str, member: str) -> None:
    with pytest.raises(FormatError):
        member_path(attribute, member)


@settings(max_examples=20, deadline=None)
@given(
    st.integers(1, 5),
    st.sampled_from(MODELS),
    st.from_regex(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,10}[A-Za-z0-9_])?", fullmatch=True),
)
def test_poses_and_cameras_round_trip(
    tmp_path_factory: pytest.TempPathFactory, count: int, model: str, name: str
) -> None:
    root = tmp_path_factory.mktemp("round")
    annotation = make_annotation(model, count, name)
    write_artifacts(annotation, root, attributes=("pose", "intrinsics"))
    artifacts = read_artifacts(root, name)
    assert np.allclose(artifacts.world_from_cam, annotation.world_from_cam, atol=1e-6)
    assert artifacts.camera == annotation.camera


def test_a_smaller_result_leaves_nothing_of_an_earlier_one(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path)
    write_artifacts(make_annotation(name="other"), tmp_path)
    write_artifacts(make_annotation(num_frames=4), tmp_path, attributes=("pose", "intrinsics"))
    members = sample_members(tmp_path, "clip")
    assert set(members) == {"pose", "intrinsics"}
    assert not read_artifacts(tmp_path, "clip").has_depth
    assert read_artifacts(tmp_path, "other").has_depth


def test_a_failed_write_closes_the_dense_stream_while_the_error_is_still_held(tmp_path: Path) -> None:
    annotation = make_annotation()
    streams = []

    def dense() -> Generator[DenseFrame, None, None]:
        streams.append(annotation.dense())
        return streams[0]

    def full_disk(done: int, total: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space") as caught:
        write_artifacts(replace(annotation, dense=dense), tmp_path, progress=full_disk)
    assert caught.value.__traceback__ is not None
    assert streams[0].gi_frame is None


@pytest.mark.parametrize("stamp", ["soon", None, [0.0]])
def test_times_that_are_no_numbers_are_refused(tmp_path: Path, stamp: object) -> None:
    info = write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics")).info
    document = json.loads(info.read_text())
    document["timestamps_s"][2] = stamp
    info.write_text(json.dumps(document))
    with pytest.raises(FormatError, match="timestamps_s"):
        read_artifacts(tmp_path, "clip")
