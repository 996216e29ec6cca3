"""Artifacts on disk compared with the truth, and their picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import accuracy
from vipe_core.annotation import MEASURED, Annotation, DenseFrame, Provenance, Quality
from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import FormatError
from vipe_core.evaluation.artifact_sheet import artifact_sheet
from vipe_core.evaluation.synthetic import SyntheticClip, sample_camera, tiny_clip
from vipe_core.evaluation.truth import GroundTruth, evaluate_artifacts
from vipe_core.formats import read_artifacts, write_artifacts

SCALE = 0.5


def annotation_of(clip: SyntheticClip, name: str, camera: Camera) -> Annotation:
    """The truth as an engine would give it: in the first camera's frame, at half the scale, with `camera`."""
    poses = np.linalg.inv(clip.world_from_cam[0]) @ clip.world_from_cam
    poses[:, :3, 3] *= SCALE
    depth = SCALE * clip.depth
    if camera.model == "mei":  # on disk a wide-angle camera's depth is z
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        a, b = (u - camera.params[2]) / camera.params[0], (v - camera.params[3]) / camera.params[1]
        k, rho2 = clip.camera.params[4], a * a + b * b
        depth = depth * ((k + np.sqrt(1 + (1 - k * k) * rho2)) / (1 + rho2) - k)

    def dense() -> Iterator[DenseFrame]:
        for k, rgb in enumerate(clip.rgb):
            yield DenseFrame(
                k,
                rgb,
                depth[k].astype(np.float32),
                np.ones(depth[k].shape, np.float32),
                clip.dynamic[k].astype(np.uint8),
                np.full(depth[k].shape, MEASURED, np.uint8),
            )

    count = len(clip.rgb)
    return Annotation(
        name=name,
        world_from_cam=poses,
        camera=camera,
        timestamps_s=np.arange(count) / clip.fps,
        fps=clip.fps,
        keyframes=np.arange(count),
        scale="relative",
        depth_kind="ray" if camera.model == "equirect" else "z",
        quality=Quality("yes", (), 0.1, 1.0, 1.0, 5.0, 0.01, np.ones(count, np.float32)),
        provenance=Provenance("0", "test", "", "cpu", {}, {}, {}, {}),
        dense=dense,
    )


def truth_of(clip: SyntheticClip) -> GroundTruth:
    step = np.s_[:, 1::4, 1::4]
    return GroundTruth(
        clip.world_from_cam,
        np.arange(len(clip.rgb)),
        clip.camera,
        clip.depth.astype(np.float16)[step],
        clip.depth_kind,
        clip.dynamic[step],
    )


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_a_perfect_result_scores_perfectly(tmp_path: Path, model: CameraModel) -> None:
    clip = tiny_clip("dynamic", 4, 96, 48 if model == "equirect" else 72, model=model)
    write_artifacts(annotation_of(clip, "perfect", clip.camera), tmp_path)
    report = evaluate_artifacts(read_artifacts(tmp_path, "perfect"), truth_of(clip))
    assert report.coverage == 1.0
    assert report.trajectory.ate_percent == pytest.approx(0.0, abs=1e-3)
    assert report.trajectory.scale == pytest.approx(1 / SCALE, rel=1e-4)
    assert (report.camera is None) == (model == "equirect")
    if report.camera is not None:
        assert report.camera.fov_x_deg == pytest.approx(0.0, abs=1e-4)
    assert report.depth is not None
    # Truth is taken beside the centre of each block here, hence not exactly zero.
    assert report.depth.abs_rel < 0.03
    assert report.depth.delta125 > 0.97
    assert report.depth_pose_ratio == pytest.approx(1.0, abs=0.02)
    whole = dataclasses.replace(truth_of(clip), dynamic=clip.dynamic)
    report = evaluate_artifacts(read_artifacts(tmp_path, "perfect"), dataclasses.replace(whole, depth=None))
    assert report.mask is not None
    assert (report.mask.iou, report.mask.recall, report.mask.false_alarms) == (1.0, 1.0, 0.0)


def test_artifacts_without_masks_are_not_judged_by_them(tmp_path: Path) -> None:
    clip = tiny_clip("dynamic", 3, 48, 36)
    write_artifacts(annotation_of(clip, "a", clip.camera), tmp_path)
    (tmp_path / "mask" / "a.zip").unlink()
    report = evaluate_artifacts(read_artifacts(tmp_path, "a"), truth_of(clip))
    assert report.mask is None
    assert report.depth is not None


def test_a_wrong_focal_length_is_seen(tmp_path: Path) -> None:
    clip = tiny_clip("orbit", 3, 96, 72)
    wrong = Camera.pinhole_from_fov(clip.camera.fov_x_deg + 4, 96, 72)
    write_artifacts(annotation_of(clip, "wrong", wrong), tmp_path)
    report = evaluate_artifacts(read_artifacts(tmp_path, "wrong"), truth_of(clip))
    assert report.camera is not None
    assert report.camera.fov_x_deg == pytest.approx(4.0, abs=1e-3)


def test_truth_of_another_video_is_refused(tmp_path: Path) -> None:
    clip = tiny_clip("orbit", 3, 48, 36)
    write_artifacts(annotation_of(clip, "a", clip.camera), tmp_path)
    other = truth_of(clip)
    foreign = GroundTruth(other.world_from_cam, other.frame_index + 100, other.camera, None, "z", None)
    with pytest.raises(FormatError, match="another video"):
        evaluate_artifacts(read_artifacts(tmp_path, "a"), foreign)


def test_the_picture_of_artifacts(tmp_path: Path) -> None:
    clip = tiny_clip("orbit", 5, 96, 72)
    write_artifacts(annotation_of(clip, "orbit", clip.camera), tmp_path)
    artifacts = read_artifacts(tmp_path, "orbit")
    with_truth = cv2.imread(str(artifact_sheet(artifacts, tmp_path / "a.png", truth=truth_of(clip))))
    without = cv2.imread(str(artifact_sheet(artifacts, tmp_path / "b.png")))
    assert with_truth is not None
    assert without is not None
    assert with_truth.shape == without.shape
    assert (with_truth != without).any()
    (tmp_path / "rgb" / "orbit.mp4").unlink()
    with pytest.raises(FormatError, match="rgb"):
        artifact_sheet(artifacts, tmp_path / "c.png")


def test_the_accuracy_benchmark_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = tiny_clip("orbit", 3, 96, 72)
    write_artifacts(annotation_of(clip, "orbit", clip.camera), tmp_path / "out")
    sequence = tmp_path / "orbit"
    sequence.mkdir()
    truth = truth_of(clip)
    assert truth.depth is not None
    np.savez(
        sequence / "gt.npz",
        cam_to_world=clip.world_from_cam,
        intrinsics=np.array(clip.camera.params),
        camera=np.array("pinhole"),
        depth=truth.depth,
        depth_kind=np.array("z"),
        dynamic=truth.dynamic,
        fps=np.array(24.0),
        width=np.array(96),
        height=np.array(72),
    )
    assert accuracy.main([str(sequence), "--artifacts", str(tmp_path / "out")]) == 0
    assert "orbit" in capsys.readouterr().out
    assert accuracy.main([str(tmp_path / "nothing"), "--artifacts", str(tmp_path / "out")]) == 1
    assert "nothing" in capsys.readouterr().err


def test_sample_cameras_are_what_they_say() -> None:
    assert sample_camera("pinhole", 320, 240).fov_x_deg == pytest.approx(62.0)
    assert 95 < sample_camera("mei", 320, 240).fov_x_deg < 130
    assert sample_camera("equirect", 320, 160).fov_x_deg == 360.0
