"""The annotator end to end on small rendered clips: accuracy, determinism, progress, and inputs that give it little."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import vipe_core
from vipe_core.annotation import Annotation, Progress
from vipe_core.depth.types import DepthSettings
from vipe_core.errors import ConfigError, EmptyMedia, EngineError
from vipe_core.evaluation.synthetic.clip import ClipKind, SyntheticClip, tiny_clip
from vipe_core.geometry import umeyama
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import PRESETS, Preset, resolve

Folder = Callable[[NDArray[np.uint8], str], Path]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """Writes frames as a directory of images."""

    def write(rgb: NDArray[np.uint8], name: str) -> Path:
        path = tmp_path_factory.mktemp(name) / name
        path.mkdir()
        for index, frame in enumerate(rgb):
            assert cv2.imwrite(str(path / f"{index:04d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        return path

    return write


@pytest.fixture(scope="session")
def annotator() -> Annotator:
    return Annotator()


@pytest.fixture(scope="session")
def orbit() -> SyntheticClip:
    return tiny_clip("orbit", num_frames=16)


@pytest.fixture(scope="session")
def orbit_folder(orbit: SyntheticClip, folder: Folder) -> Path:
    return folder(orbit.rgb, "orbit")


@pytest.fixture(scope="session")
def orbit_annotation(annotator: Annotator, orbit_folder: Path) -> Annotation:
    return annotator.annotate(orbit_folder)


@pytest.fixture(scope="session")
def small() -> SyntheticClip:
    """Enough for every stage, where accuracy is not the question."""
    return tiny_clip("orbit", 14, 192, 144, noise=1.0)


@pytest.fixture(scope="session")
def small_folder(small: SyntheticClip, folder: Folder) -> Path:
    return folder(small.rgb, "small")


def test_orbit_is_recovered(orbit: SyntheticClip, orbit_annotation: Annotation) -> None:
    truth, found = orbit.world_from_cam[:, :3, 3], orbit_annotation.world_from_cam[:, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.01 * path
    assert orbit_annotation.camera.fov_x_deg == pytest.approx(orbit.camera.fov_x_deg, abs=3.0)
    assert (orbit_annotation.camera.width, orbit_annotation.camera.height) == (320, 240)
    assert orbit_annotation.quality.reliable != "no"
    assert orbit_annotation.num_frames == 16


def test_dense_depth_has_the_scale_of_the_trajectory(orbit: SyntheticClip, orbit_annotation: Annotation) -> None:
    scale = umeyama(orbit_annotation.world_from_cam[:, :3, 3], orbit.world_from_cam[:, :3, 3]).scale
    ratios = []
    for frame, truth in zip(orbit_annotation.dense(), orbit.depth, strict=True):
        assert frame.depth.shape == truth.shape
        assert frame.rgb.shape == (*truth.shape, 3)
        sure = (frame.confidence > 0) & (truth > 0)
        ratios.append(np.median(scale * frame.depth[sure] / truth[sure]))
    assert np.median(ratios) == pytest.approx(1.0, abs=0.05)
    assert orbit_annotation.timings_s["depth"] > 0


@pytest.mark.long
def test_two_runs_give_the_same_bytes(annotator: Annotator, folder: Folder, small_folder: Path) -> None:
    first = annotator.annotate(small_folder)
    # Another size in between: nothing of one video may reach the next.
    annotator.annotate(folder(np.zeros((3, 120, 200, 3), dtype=np.uint8), "between"))
    again = annotator.annotate(small_folder)
    assert again.world_from_cam.tobytes() == first.world_from_cam.tobytes()
    assert again.camera == first.camera
    assert again.quality.summary() == first.quality.summary()
    assert again.provenance == first.provenance


def test_progress_goes_through_the_stages_and_can_cancel(annotator: Annotator, small_folder: Path) -> None:
    class Cancelled(Exception):
        pass

    seen: list[Progress] = []

    def watch(progress: Progress) -> None:
        seen.append(progress)
        if progress.stage == "infill":
            raise Cancelled

    with pytest.raises(Cancelled):
        annotator.annotate(small_folder, progress=watch)
    stages = list(dict.fromkeys(progress.stage for progress in seen))
    assert stages == ["scan", "intrinsics", "track", "backend", "infill"]
    scan = [progress.frames_done for progress in seen if progress.stage == "scan"]
    assert scan == sorted(scan)


@pytest.mark.parametrize(("kind", "reason"), [("static", "static_camera"), ("pure_rotation", "pure_rotation")])
def test_cameras_that_do_not_travel_say_so(annotator: Annotator, folder: Folder, kind: ClipKind, reason: str) -> None:
    clip = tiny_clip(kind, 12, 192, 144, noise=1.0)
    annotation = annotator.annotate(folder(clip.rgb, kind))
    assert reason in annotation.quality.reasons
    assert annotation.quality.reliable == "doubtful"
    np.testing.assert_array_equal(annotation.world_from_cam[:, :3, 3], 0)
    depth = next(annotation.dense()).depth
    assert np.isfinite(depth).all()
    assert (depth > 0).all()


@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_handful_of_frames(annotator: Annotator, folder: Folder, orbit: SyntheticClip, count: int) -> None:
    annotation = annotator.annotate(folder(orbit.rgb[: 4 * count : 4], f"few{count}"))
    assert annotation.num_frames == count
    assert np.isfinite(annotation.world_from_cam).all()
    assert "few_frames" in annotation.quality.reasons
    assert annotation.quality.reliable != "yes"


def test_black_frames_and_noise_give_a_result_that_is_not_called_reliable(annotator: Annotator, folder: Folder) -> None:
    black = np.zeros((10, 96, 128, 3), dtype=np.uint8)
    noise = np.random.default_rng(0).integers(0, 255, (10, 96, 128, 3), dtype=np.uint8)
    for name, rgb in (("black", black), ("noise", noise)):
        annotation = annotator.annotate(folder(rgb, name))
        assert np.isfinite(annotation.world_from_cam).all()
        assert annotation.quality.reliable != "yes"
        assert annotation.camera.focal_px > 0


def test_unknown_presets_cameras_and_devices_are_refused_with_what_is_on_offer() -> None:
    with pytest.raises(ConfigError, match="classical"):
        Annotator("nonsense")
    with pytest.raises(ConfigError, match="pinhole"):
        Annotator(camera="fisheye")
    with pytest.raises(ConfigError, match="cuda"):
        Annotator(device="abacus")
    with pytest.raises(ConfigError, match="threads"):
        Annotator(threads=0)


def test_an_empty_directory_is_a_typed_error(annotator: Annotator, tmp_path: Path) -> None:
    with pytest.raises(EmptyMedia):
        annotator.annotate(tmp_path)


def test_config_hash_follows_the_settings() -> None:
    preset = resolve("classical")
    assert preset.config_hash == resolve("classical").config_hash
    slower = Preset(**{name: getattr(preset, name) for name in preset.__slots__ if name != "name"}, name="slower")
    assert slower.config_hash != preset.config_hash
    assert preset.name in PRESETS


def test_the_fast_preset_differs_in_dense_depth_alone() -> None:
    default, fast = resolve("classical"), resolve("classical_fast")
    assert {default.name, fast.name} <= set(PRESETS)
    assert PRESETS[0] == default.name
    assert fast.dense_depth == DepthSettings.fast() != default.dense_depth
    assert replace(fast, name=default.name, dense_depth=default.dense_depth) == default


def test_importing_the_video_package_leaves_torch_alone() -> None:
    code = "import sys, vipe_core.video; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert callable(vipe_core.annotate)
    with pytest.raises(AttributeError):
        _ = vipe_core.nothing


@pytest.mark.parametrize("turn", ["fade in", "black end"])
def test_black_frames_at_an_end_are_passed_over(
    annotator: Annotator, folder: Folder, small: SyntheticClip, turn: str
) -> None:
    rgb = small.rgb.copy()
    black = np.arange(14) < 4 if turn == "fade in" else np.arange(14) >= 10
    rgb[black] = 0
    annotation = annotator.annotate(folder(rgb, turn.replace(" ", "-")))
    truth, found = small.world_from_cam[~black, :3, 3], annotation.world_from_cam[~black, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.02 * path
    np.testing.assert_array_equal(annotation.quality.frame_inlier_ratio[black], 0)
    assert (annotation.quality.frame_inlier_ratio[~black] > 0.5).all()
    assert "interpolated_frames" in annotation.quality.reasons
    assert "static_camera" not in annotation.quality.reasons
    np.testing.assert_allclose(annotation.world_from_cam[0], np.eye(4), atol=1e-9)


def test_what_a_library_throws_becomes_an_engine_error(
    annotator: Annotator, orbit_folder: Path, orbit_annotation: Annotation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise cv2.error("OpenCV(4) something\nwith a second line")

    with monkeypatch.context() as patch:
        patch.setattr("vipe_core.depth.stream.complete", broken)
        with pytest.raises(EngineError, match=r"orbit: error: OpenCV.* something; please report") as caught:
            list(orbit_annotation.dense())
        assert isinstance(caught.value.__cause__, cv2.error)
    monkeypatch.setattr("vipe_core.slam.system.select_keyframes", broken)
    with pytest.raises(EngineError, match="orbit"):
        annotator.annotate(orbit_folder)


@pytest.mark.parametrize("stage", ["scan", "track", "infill", "depth"])
def test_the_error_of_a_progress_callback_comes_back_as_it_is_and_leaves_no_decoder(
    annotator: Annotator, small_folder: Path, stage: str
) -> None:
    cancelled = ZeroDivisionError("the caller's own")

    def cancel(progress: Progress) -> None:
        if progress.stage == stage:
            raise cancelled

    with pytest.raises(ZeroDivisionError) as caught:
        list(annotator.annotate(small_folder, progress=cancel).dense())
    assert caught.value is cancelled
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    commands = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in children]
    assert not [command for command in commands if b"decoder_child" in command]
