"""Sample files, their cache, their truth, and the picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation import samples
from vipe_core.evaluation.metrics import depth_errors, sample_depth
from vipe_core.evaluation.synthetic import render_frames
from vipe_core.evaluation.synthetic.crowd import CROWD_FPS, MAX_MOVING, MIN_MOVING, crowd, moving_share
from vipe_core.evaluation.truth import evaluate_static_guess, read_truth

KEYS = {"cam_to_world", "intrinsics", "camera", "depth", "depth_kind", "dynamic", "fps", "width", "height"}


@pytest.mark.parametrize("name", ["courtyard", "wide_room", "pano_room"])
def test_sample_files(tmp_path: Path, name: str) -> None:
    paths = samples.write_sample(name, tmp_path, num_frames=3)
    chosen = samples.sample(name, 3)
    with av.open(str(paths.video)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(pictures) == 3
    rendered = list(render_frames(chosen.scene, chosen.camera, chosen.world_from_cam, fps=chosen.fps))
    assert pictures[0].shape == rendered[0].rgb.shape
    assert np.abs(pictures[2].astype(float) - rendered[2].rgb).mean() < 8.0
    with np.load(paths.truth, allow_pickle=False) as file:
        assert set(file.files) == KEYS
        assert file["depth"].dtype == np.float16
        assert file["dynamic"].dtype == np.bool_
    truth = read_truth(paths.truth)
    assert truth.camera == chosen.camera
    np.testing.assert_array_equal(truth.world_from_cam, chosen.world_from_cam)
    assert truth.depth is not None
    assert truth.depth.shape == (3, chosen.camera.height // 4, chosen.camera.width // 4)
    # The small depth is the full one, sampled at the same places.
    full = sample_depth(rendered[1].depth, *truth.depth.shape[1:])
    errors = depth_errors([(full, truth.depth[1].astype(np.float32), np.ones(full.shape, np.bool_))])
    assert errors is not None
    assert errors.scale == pytest.approx(1.0, abs=1e-3)
    assert errors.delta125 > 0.97


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_a_crowd_covers_what_is_announced_and_is_the_same_every_time(seed: int) -> None:
    drawn = crowd(seed, 48)
    assert MIN_MOVING < moving_share(drawn.scene, drawn.camera, drawn.world_from_cam) < MAX_MOVING
    assert repr(crowd(seed, 48).scene) == repr(drawn.scene)
    torsos = [body for body in drawn.scene.primitives if body.motion is not None]
    for frame in (0, 24, 47):
        eye = drawn.world_from_cam[frame, :3, 3]
        for body in torsos:
            assert body.motion is not None
            at = np.array(body.centre) + body.motion.offset(frame / CROWD_FPS)
            assert np.linalg.norm((at - eye)[:2]) > 0.6


def test_the_demo_samples_are_as_announced() -> None:
    for name in samples.DEMO_NAMES:
        chosen = samples.sample(name)
        centres = chosen.world_from_cam[:, :3, 3]
        assert 48 <= len(centres) <= 72
        assert np.linalg.norm(np.diff(centres, axis=0), axis=1).sum() > 1.5
    ball = samples.sample("moving_ball")
    few = replace(ball, world_from_cam=ball.world_from_cam[::6])
    frames = render_frames(few.scene, few.camera.resized(120, 90), few.world_from_cam, fps=few.fps / 6)
    assert 0.06 < np.mean([frame.dynamic.mean() for frame in frames]) < 0.2


def test_cache_is_keyed_by_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = samples.sample_path("courtyard", tmp_path, num_frames=2)
    stamp = first.video.stat().st_mtime_ns
    assert samples.sample_path("courtyard", tmp_path, num_frames=2) == first
    assert first.video.stat().st_mtime_ns == stamp
    assert [path.name for path in tmp_path.iterdir()] == [first.video.parent.name]
    # Another scene under the same name is another file.
    changed = replace(samples.sample("courtyard"), seed=99)
    monkeypatch.setitem(samples._BUILDERS, "courtyard", lambda: changed)
    assert samples.sample_path("courtyard", tmp_path, num_frames=2) != first


def test_default_cache_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert samples.default_cache_dir() == tmp_path / "vipe_core" / "samples"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert samples.default_cache_dir() == Path(".cache/samples")


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="room_tour"):
        samples.sample_path("attic", tmp_path)
    with pytest.raises(SystemExit):
        samples.main([str(tmp_path), "attic"])
    assert list(tmp_path.iterdir()) == []


def test_damaged_truth_is_a_typed_error(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_truth(tmp_path / "gt.npz")
    (tmp_path / "gt.npz").write_bytes(b"not a zip")
    with pytest.raises(FormatError, match="not a readable"):
        read_truth(tmp_path / "gt.npz")


def test_the_trivial_answer_has_the_errors_it_must_have(tmp_path: Path) -> None:
    truth = read_truth(samples.write_sample("courtyard", tmp_path, num_frames=4).truth)
    report = evaluate_static_guess(truth)
    assert report.coverage == 1.0
    assert report.camera is not None
    assert report.camera.fov_x_deg == pytest.approx(10.0)
    assert report.trajectory.scale is None
    assert report.trajectory.ate_rmse == pytest.approx(np.sqrt(truth.world_from_cam[:, :3, 3].var(axis=0).sum()))
    assert report.depth is not None
    assert report.depth.abs_rel > 0.2
