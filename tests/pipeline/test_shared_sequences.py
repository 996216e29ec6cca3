"""Accuracy on the sequences with exact ground truth that lie beside the checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vipe_core import Annotator
from vipe_core.geometry import umeyama


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "max_ate_share", "max_fov_error_deg"),
    [pytest.param("room_handheld", 0.003, 1.5, marks=pytest.mark.long), ("zoom_free_short", 0.005, 1.5)],
)
def test_poses_and_focal_length(shared_data: Path, name: str, max_ate_share: float, max_fov_error_deg: float) -> None:
    folder = shared_data / "synthetic" / name
    annotation = Annotator().annotate(folder / "video.mp4")
    with np.load(folder / "gt.npz") as gt:
        truth, fx, width = gt["cam_to_world"][:, :3, 3], float(gt["intrinsics"][0]), int(gt["width"])
    found = annotation.world_from_cam[:, :3, 3]
    assert len(found) == len(truth)
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < max_ate_share * path
    fov_deg = np.degrees(2 * np.arctan(width / 2 / fx))
    assert annotation.camera.fov_x_deg == pytest.approx(fov_deg, abs=max_fov_error_deg)
    assert annotation.quality.reliable != "no"
