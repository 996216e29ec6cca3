"""Readers of public datasets, on tiny folders in exactly their layouts, and the paper's protocols on them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_folders import (
    depth_map,
    picture,
    trajectory,
    write_euroc,
    write_kitti,
    write_png,
    write_rgbd,
    write_seven_scenes,
    write_sintel,
)

from vipe_core.errors import ConfigError, FormatError, MediaNotFound
from vipe_core.evaluation.datasets import GroundTruthSequence, SequenceRef, find_sequences
from vipe_core.evaluation.datasets.sequence import nearest_rows
from vipe_core.evaluation.truth import Estimate, evaluate

COUNT = 5


def only(dataset: str, root: Path, protocol: str = "all", max_frames: int | None = None) -> GroundTruthSequence:
    (ref,) = find_sequences(dataset, root, protocol, max_frames).sequences
    return ref.load()


def brightness(sequence: GroundTruthSequence, size: tuple[int, int] | None = None) -> list[int]:
    """What tells the frames apart, in the order in which the source gives them."""
    return [round(float(frame.rgb.mean()) / 10) for frame in sequence.pictures.open().frames(size)]


@pytest.mark.parametrize("dataset", ["tum", "eth3d"])
def test_rgbd_layout(tmp_path: Path, dataset: str) -> None:
    name = "rgbd_dataset_freiburg1_xyz" if dataset == "tum" else "table_3"
    poses = write_rgbd(tmp_path / name, COUNT, calibration=dataset == "eth3d")
    sequence = only(dataset, tmp_path)
    truth = sequence.truth
    assert (sequence.dataset, sequence.name) == (dataset, name)
    assert truth.frame_index.tolist() == [1, 2, 3, 4]  # the first picture is older than the truth
    np.testing.assert_allclose(truth.world_from_cam, poses, atol=1e-6)
    assert truth.camera is not None
    expected = (51.73, 60.5)[dataset == "eth3d"]
    assert truth.camera.params[0] == pytest.approx(expected)
    assert truth.depth is not None
    np.testing.assert_allclose(truth.depth[0], depth_map(1), atol=1e-4)
    assert not truth.depth[1].any()  # the picture that was lost
    source = sequence.pictures.open()
    assert brightness(sequence) == list(range(COUNT))
    assert [frame.timestamp_s for frame in source.frames()] == pytest.approx([k / 30 for k in range(COUNT)], abs=1e-5)
    assert source.info.fps == pytest.approx(30, rel=1e-3)


def test_tum_without_a_known_camera_has_none(tmp_path: Path) -> None:
    write_rgbd(tmp_path / "own_recording", COUNT, calibration=False)
    assert only("tum", tmp_path).truth.camera is None


def test_kitti_layout(tmp_path: Path) -> None:
    poses = write_kitti(tmp_path, "03", COUNT)
    sequence = only("kitti", tmp_path)
    np.testing.assert_allclose(sequence.truth.world_from_cam, poses, atol=1e-6)
    assert sequence.truth.camera is not None
    assert sequence.truth.camera.params == (700.0, 700.0, 322.0, 186.0)
    assert sequence.pictures.path.name == "image_2"
    assert brightness(sequence) == list(range(COUNT))
    shutil.rmtree(tmp_path / "sequences" / "03" / "image_2")
    grey = only("kitti", tmp_path).truth
    np.testing.assert_allclose(grey.world_from_cam, trajectory(COUNT), atol=1e-6)


def test_kitti_protocol_crops_and_shortens(tmp_path: Path) -> None:
    write_kitti(tmp_path, "00", 3)
    write_kitti(tmp_path, "07", 3)
    found = find_sequences("kitti", tmp_path, "paper")
    assert [ref.name for ref in found.sequences] == ["00", "07"]
    assert len(found.missing) == 9
    assert found.protocol.max_frames == 1024
    sequence = found.sequences[0].load()
    assert sequence.truth.camera is not None
    assert (sequence.truth.camera.width, sequence.truth.camera.height) == (512, 368)
    assert sequence.truth.camera.params == (700.0, 700.0, 322.0 - 64, 186.0 - 4)
    source = sequence.pictures.open()
    assert (source.info.width, source.info.height) == (512, 368)
    assert next(source.frames()).rgb.shape == (368, 512, 3)


def test_the_middle_of_the_picture_is_what_a_crop_shows(tmp_path: Path) -> None:
    write_kitti(tmp_path, "00", 2)
    image = np.zeros((376, 640, 3), np.uint8)
    image[4:372, 64:576] = 200
    for k in range(2):
        write_png(tmp_path / "sequences" / "00" / "image_2" / f"{k:06d}.png", image)
    source = only("kitti", tmp_path, "paper").pictures.open()
    assert all((frame.rgb == 200).all() for frame in source.frames())
    assert all((frame.rgb == 200).all() and frame.rgb.shape == (92, 128, 3) for frame in source.frames((128, 92)))


def test_sintel_layout(tmp_path: Path) -> None:
    poses = write_sintel(tmp_path, "alley_2", COUNT)
    write_sintel(tmp_path, "market_5", COUNT)
    found = find_sequences("sintel", tmp_path, "paper")
    assert [ref.name for ref in found.sequences] == ["alley_2"]
    sequence = found.sequences[0].load()
    np.testing.assert_allclose(sequence.truth.world_from_cam, poses, atol=1e-9)
    assert sequence.truth.camera is not None
    assert sequence.truth.camera.params[0] == pytest.approx(70.2)  # the median of a lens that changes
    assert sequence.truth.depth is not None
    np.testing.assert_array_equal(sequence.truth.depth[3], depth_map(3).astype(np.float32))
    assert sequence.pictures.path.parent.name == "final"
    assert brightness(sequence) == list(range(COUNT))


def test_seven_scenes_layout(tmp_path: Path) -> None:
    poses = write_seven_scenes(tmp_path / "chess" / "seq-01", COUNT)
    lost = "NaN NaN NaN NaN\n" * 4
    (tmp_path / "chess" / "seq-01" / "frame-000002.pose.txt").write_text(lost)
    sequence = only("7scenes", tmp_path)
    assert sequence.name == "chess/seq-01"
    kept = [0, 1, 3, 4]
    assert sequence.truth.frame_index.tolist() == kept
    np.testing.assert_allclose(sequence.truth.world_from_cam, poses[kept], atol=1e-6)
    assert sequence.truth.depth is not None
    np.testing.assert_allclose(sequence.truth.depth[2], depth_map(3), atol=1e-3)
    assert brightness(sequence) == list(range(COUNT))  # depth pictures lie in the same folder


def test_euroc_layout(tmp_path: Path) -> None:
    poses = write_euroc(tmp_path / "MH_01_easy", COUNT)
    sequence = only("euroc", tmp_path)
    assert sequence.name == "MH_01_easy"
    assert sequence.truth.frame_index.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(sequence.truth.world_from_cam, poses, atol=1e-6)
    assert sequence.truth.camera is not None
    assert sequence.truth.camera.params == (45.8, 45.7, 31.7 + 0.5, 24.8 + 0.5)  # published for integer centres
    frames = list(sequence.pictures.open().frames())
    assert [round(frame.rgb[20:28, 28:36].mean() / 10) for frame in frames] == list(range(COUNT))
    assert [frame.timestamp_s for frame in frames] == pytest.approx([k / 20 for k in range(COUNT)])


def test_euroc_pictures_are_undistorted(tmp_path: Path) -> None:
    """A point that the published lens images at one place is seen where a pinhole would see it."""
    write_euroc(tmp_path / "V1", 3)
    matrix = np.array([[45.8, 0, 31.7], [0, 45.7, 24.8], [0, 0, 1]])
    coefficients = np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
    ray = np.array([[0.4, -0.3, 1.0]])
    seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, coefficients)[0].ravel()
    for path in (tmp_path / "V1" / "mav0" / "cam0" / "data").iterdir():
        image = np.zeros((48, 64), np.float32)
        v, u = np.mgrid[:48, :64]
        image = 255 * np.exp(-((u - seen[0]) ** 2 + (v - seen[1]) ** 2) / 4)
        write_png(path, image.astype(np.uint8))
    rgb = next(only("euroc", tmp_path).pictures.open().frames()).rgb[..., 0].astype(np.float64)
    v, u = np.mgrid[:48, :64]
    centre = np.array([(u * rgb).sum(), (v * rgb).sum()]) / rgb.sum()
    np.testing.assert_allclose(centre, (45.8 * 0.4 + 31.7, -45.7 * 0.3 + 24.8), atol=0.25)


def test_own_layout(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    for k in range(3):
        write_png(folder / "images" / f"{k:03d}.png", picture(k))
    np.savez(
        folder / "gt.npz",
        cam_to_world=trajectory(3),
        camera="pinhole",
        intrinsics=np.array([60.0, 60, 32, 24]),
        width=64,
        height=48,
    )
    sequence = only("gt", tmp_path)
    assert brightness(sequence) == [0, 1, 2]
    shorter = only("gt", tmp_path, max_frames=2)
    assert brightness(shorter) == [0, 1]
    assert len(shorter.truth.world_from_cam) == 2


def test_tum_protocol_groups(tmp_path: Path) -> None:
    for name in ("freiburg1_desk", "freiburg3_walking_xyz", "freiburg2_desk", "freiburg1_desk_validation"):
        write_rgbd(tmp_path / f"rgbd_dataset_{name}", 3, calibration=False)
    found = find_sequences("tum", tmp_path, "paper")
    assert [ref.group for ref in found.sequences] == ["Freiburg1", "Freiburg3"]
    assert len(found.missing) == 15


def test_eth3d_protocol_leaves_the_dark_out(tmp_path: Path) -> None:
    for name in ("sofa_1", "sofa_dark_1", "kidnap_dark"):
        write_rgbd(tmp_path / "training" / name, 3, calibration=True)
    found = find_sequences("eth3d", tmp_path, "paper")
    assert [ref.name for ref in found.sequences] == ["training/sofa_1"]
    assert found.protocol.with_depth


def test_the_truth_scores_perfectly_against_itself(tmp_path: Path) -> None:
    write_rgbd(tmp_path / "table_3", COUNT, calibration=True)
    truth = only("eth3d", tmp_path).truth
    assert truth.camera is not None
    assert truth.depth is not None
    depth = [2 * np.asarray(truth.depth[k], np.float32) for k in range(len(truth.frame_index))]
    poses = truth.world_from_cam.copy()
    poses[:, :3, 3] *= 2
    report = evaluate(Estimate("x", poses, truth.frame_index, truth.camera, depth), truth)
    assert report.coverage == 1
    assert report.trajectory.ate_rmse == pytest.approx(0, abs=1e-9)
    assert report.depth is not None
    assert report.depth.abs_rel == pytest.approx(0, abs=1e-6)
    assert report.depth_pose_ratio == pytest.approx(1)
    metric = evaluate(Estimate("x", poses, truth.frame_index, truth.camera, depth), truth, "metric").depth
    assert metric is not None
    assert metric.abs_rel == pytest.approx(1.0)


def _remove(*parts: str) -> Callable[[Path], None]:
    return lambda root: root.joinpath(*parts).unlink()


def _overwrite(text: str, *parts: str) -> Callable[[Path], None]:
    def overwrite(root: Path) -> None:
        root.joinpath(*parts).write_text(text)

    return overwrite


@pytest.mark.parametrize(
    ("dataset", "damage", "named"),
    [
        ("tum", _remove("seq", "groundtruth.txt"), "seq/groundtruth.txt"),
        ("tum", _overwrite("1.0 2 3\n", "seq", "groundtruth.txt"), "seq/groundtruth.txt"),
        ("tum", _overwrite("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n", "seq", "groundtruth.txt"), "seq/groundtruth.txt"),
        ("tum", _overwrite("# only a comment\n", "seq", "rgb.txt"), "seq/rgb.txt"),
        ("tum", _overwrite("now rgb/1.png\n", "seq", "rgb.txt"), "seq/rgb.txt"),
        ("eth3d", _remove("seq", "calibration.txt"), "seq/calibration.txt"),
        ("kitti", _remove("sequences", "00", "calib.txt"), "00/calib.txt"),
        ("kitti", _overwrite("P0: 1 2 3\n", "sequences", "00", "calib.txt"), "00/calib.txt"),
        ("kitti", _remove("sequences", "00", "times.txt"), "00/times.txt"),
        ("kitti", _overwrite("1 0 0 0 0 1 0 0 0 0 1 0\n", "poses", "00.txt"), "poses/00.txt"),
        ("sintel", _remove("training", "camdata_left", "seq", "frame_0002.cam"), "seq/frame_0002.cam"),
        ("sintel", _overwrite("text", "training", "camdata_left", "seq", "frame_0001.cam"), "seq/frame_0001.cam"),
        ("sintel", _overwrite("text", "training", "depth", "seq", "frame_0001.dpt"), "seq/frame_0001.dpt"),
        ("7scenes", _remove("seq", "frame-000001.pose.txt"), "seq/frame-000001.pose.txt"),
        ("7scenes", _overwrite("1 0 0 0\n", "seq", "frame-000001.pose.txt"), "seq/frame-000001.pose.txt"),
        ("euroc", _remove("seq", "mav0", "cam0", "sensor.yaml"), "cam0/sensor.yaml"),
        ("euroc", _overwrite("a: [", "seq", "mav0", "cam0", "sensor.yaml"), "cam0/sensor.yaml"),
        ("euroc", _overwrite("a: 1", "seq", "mav0", "cam0", "sensor.yaml"), "cam0/sensor.yaml"),
        ("euroc", _remove("seq", "mav0", "state_groundtruth_estimate0", "data.csv"), "estimate0/data.csv"),
        ("gt", _overwrite("no", "seq", "gt.npz"), "seq/gt.npz"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, dataset: str, damage: Callable[[Path], None], named: str) -> None:
    write: dict[str, Callable[[], object]] = {
        "tum": lambda: write_rgbd(tmp_path / "seq", 3, calibration=False),
        "eth3d": lambda: write_rgbd(tmp_path / "seq", 3, calibration=True),
        "kitti": lambda: write_kitti(tmp_path, "00", 3),
        "sintel": lambda: write_sintel(tmp_path, "seq", 3),
        "7scenes": lambda: write_seven_scenes(tmp_path / "seq", 3),
        "euroc": lambda: write_euroc(tmp_path / "seq", 3),
        "gt": lambda: (tmp_path / "seq").mkdir(),
    }
    write[dataset]()
    damage(tmp_path)
    with pytest.raises(FormatError) as caught:
        only(dataset, tmp_path)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_picture_that_is_listed_but_missing_is_named(tmp_path: Path) -> None:
    write_rgbd(tmp_path / "seq", 3, calibration=False)
    lost = sorted((tmp_path / "seq" / "rgb").iterdir())[1]
    lost.unlink()
    with pytest.raises(MediaNotFound, match=lost.name):
        only("tum", tmp_path).pictures.open()


@pytest.mark.parametrize("dataset", ["tum", "eth3d", "kitti", "sintel", "7scenes", "euroc", "gt"])
def test_a_folder_of_something_else(tmp_path: Path, dataset: str) -> None:
    write_png(tmp_path / "holiday" / "1.png", picture(1))
    with pytest.raises(FormatError, match="are needed"):
        find_sequences(dataset, tmp_path)


def test_unknown_names(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown dataset"):
        find_sequences("imagenet", tmp_path)
    with pytest.raises(ConfigError, match="unknown protocol"):
        find_sequences("tum", tmp_path, "strict")
    with pytest.raises(ConfigError, match="no protocol for 'euroc'"):
        find_sequences("euroc", tmp_path, "paper")


def test_a_reference_survives_the_way_to_another_process(tmp_path: Path) -> None:
    import pickle

    write_kitti(tmp_path, "00", 2)
    (ref,) = find_sequences("kitti", tmp_path, "paper").sequences
    again: SequenceRef = pickle.loads(pickle.dumps(ref))
    assert again.load().truth.camera == ref.load().truth.camera


def test_association_takes_the_nearest_and_only_a_near_one() -> None:
    reference = np.array([0.0, 1.0, 2.0])
    assert nearest_rows([0.4, 0.5, 0.6, 2.3, 9.0, -0.4], reference, 0.5).tolist() == [0, 0, 1, 2, -1, 0]
