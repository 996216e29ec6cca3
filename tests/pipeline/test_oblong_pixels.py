"""A video whose pixels are not square, from its container to the exports: the focal lengths differ by their aspect."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from vipe_core.cameras import Camera
from vipe_core.cameras.calibration_files import read_calibration
from vipe_core.evaluation.metrics import trajectory_errors
from vipe_core.evaluation.synthetic import SyntheticClip, render_clip, room_scene
from vipe_core.evaluation.synthetic.paths import arc, look_at
from vipe_core.formats import Artifacts, read_artifacts, write_artifacts
from vipe_core.formats.colmap import export_colmap
from vipe_core.formats.rectified import rectified
from vipe_core.pipeline.annotator import Annotator
from vipe_core.video import open_source

ASPECT = Fraction(4, 3)
LENS = Camera("pinhole", (105.0, 140.0, 60.0, 60.0), 120, 120)
COUNT = 12


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    eye = arc((3.0, 2.5, 1.45), 1.9, -85.0, -30.0, COUNT)
    return render_clip(room_scene(), LENS, look_at(eye, np.array([3.0, 2.5, 0.7])))


@pytest.fixture(scope="module")
def found(clip: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    folder = tmp_path_factory.mktemp("oblong")
    with av.open(str(folder / "tape.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = LENS.width, LENS.height, "yuv420p"
        stream.sample_aspect_ratio = ASPECT
        for rgb in clip.rgb:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode(None))
    write_artifacts(Annotator("classical_fast").annotate(folder / "tape.mp4"), folder / "out")
    return read_artifacts(folder / "out", "tape")


def test_poses_and_intrinsics_are_of_the_pixels_as_they_are(found: Artifacts, clip: SyntheticClip) -> None:
    camera = found.camera
    assert (camera.width, camera.height) == (LENS.width, LENS.height)
    assert camera.params[1] / camera.params[0] == pytest.approx(float(ASPECT))
    # So small a clip hardly tells the focal length, of square pixels neither.
    assert camera.fov_x_deg == pytest.approx(LENS.fov_x_deg, abs=20)
    errors = trajectory_errors(found.world_from_cam, clip.world_from_cam, np.arange(COUNT))
    assert errors.ate_percent is not None
    assert errors.ate_percent < 2


def test_our_video_of_it_says_so_too(found: Artifacts) -> None:
    info = open_source(found.root / "rgb" / "tape.mp4").info
    assert info.pixel_aspect == pytest.approx(float(ASPECT))
    assert (info.width, info.height) == (LENS.width, LENS.height)


def test_exports(found: Artifacts, tmp_path: Path) -> None:
    out = export_colmap(found, tmp_path / "colmap", text=True, voxel=0.4, step=5)
    exported = read_calibration(out / "sparse/0/cameras.txt").camera
    np.testing.assert_allclose(exported.params, found.camera.params)
    flat = rectified(found).camera
    assert (flat.width, flat.height) == (160, 120)
    assert flat.params[0] == flat.params[1] == pytest.approx(found.camera.params[1])
    assert flat.fov_y_deg == pytest.approx(found.camera.fov_y_deg)
