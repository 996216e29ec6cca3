"""Rig files: what they hold comes back, and what is wrong in them is said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import ExtrinsicSigma, Rig, RigView, angle_between_deg, read_rig
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import exp

CAMERA = Calibration(Camera.pinhole_from_fov(70.0, 640, 480))


def rig_json() -> dict[str, Any]:
    other = np.eye(4)
    other[0, 3] = 0.12
    views = (RigView("left", np.eye(4), CAMERA, "left.mp4"), RigView("right", other, CAMERA, "right.mp4"))
    return Rig(views, metric=True, refine=True, shared=True).to_json()


@given(
    st.lists(arrays(np.float64, 6, elements=st.floats(-3, 3)), min_size=2, max_size=4),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
def test_a_rig_survives_its_file(twists: list[Any], metric: bool, refine: bool, shared: bool) -> None:
    sigma = ExtrinsicSigma(0.3, 0.002)
    views = [
        RigView(f"view{k}", exp(twist), CAMERA if k else None, sigma=sigma if k else None)
        for k, twist in enumerate(twists)
    ]
    rig = Rig(tuple(views), metric, refine, shared)
    again = Rig.from_json(json.loads(json.dumps(rig.to_json())))
    assert (again.metric, again.refine, again.shared) == (metric, refine, shared)
    for before, after in zip(rig.views, again.views, strict=True):
        assert (after.name, after.calibration, after.sigma) == (before.name, before.calibration, before.sigma)
        assert after.video == before.video
        np.testing.assert_allclose(after.rig_from_cam, before.rig_from_cam, atol=1e-12)
    np.testing.assert_allclose(rig.cam_from_rig[0] @ views[0].rig_from_cam, np.eye(4), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": 2}, "version"),
        ({"extrinsic": "fixed"}, "unknown keys extrinsic"),
        ({"extrinsics": "free"}, "fixed or refined"),
        ({"metric": 1}, "metric"),
        ({"views": {}}, "list"),
    ],
)
def test_a_slip_in_the_file_is_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(rig_json() | change))
    with pytest.raises(ConfigError, match=says):
        read_rig(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"name": "../up"}, "plain name"),
        ({"name": "left"}, "different names"),
        ({"rig_from_cam": [[1, 2], [3, 4]]}, "4x4"),
        ({"rig_from_cam": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "not a rotation"),
        ({"rig_from_cam": np.zeros((4, 4)).tolist()}, "not a rotation"),
        ({"rig_from_cam": [[1, 0, 0, 120], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "120 m apart; give .* metres"),
        ({"video": "left.mp4"}, "a video of its own"),
        ({"sigma": {"rotation_deg": 0, "place": 0.1}}, "must be positive"),
        ({"sigma": {"rotation": 1}}, "unknown keys rotation"),
        ({"camera": "pinhole"}, "calibration"),
        ({"camera": Calibration(Camera.pinhole_from_fov(60.0, 640, 480)).to_json()}, "share one camera"),
    ],
)
def test_a_slip_in_a_view_is_named(change: dict[str, Any], says: str) -> None:
    data = rig_json()
    data["views"][1] |= change
    with pytest.raises(ConfigError, match=says):
        Rig.from_json(data)


def test_a_rig_of_one_camera_or_without_a_file_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"view bent: .* not a rotation"):
        RigView("bent", 2 * np.eye(4))
    with pytest.raises(ConfigError, match="2 to"):
        Rig((RigView("alone", np.eye(4)),))
    with pytest.raises(ConfigError, match="cannot be read"):
        read_rig(tmp_path / "no.json")


def test_angles_between_rotations() -> None:
    turned = exp(np.array([1.0, 2.0, 3.0, 0.0, np.radians(2.0), 0.0]))
    assert angle_between_deg(np.eye(4), turned) == pytest.approx(2.0)
