"""The single npz for evaluation scripts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from artifact_samples import CAMERAS, HEIGHT, WIDTH, depth_of, make_annotation
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.formats import export_npz, read_artifacts, write_artifacts
from vipe_core.formats.scorer_npz import reduce_depth


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_keys_types_and_values(tmp_path: Path, model: str) -> None:
    annotation = make_annotation(model)
    write_artifacts(annotation, tmp_path)
    out = export_npz(read_artifacts(tmp_path, "clip"), tmp_path / "out" / "clip.npz")
    with np.load(out, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    assert np.allclose(arrays["cam_to_world"], annotation.world_from_cam, atol=1e-6)
    assert arrays["frame_index"].tolist() == list(range(7))
    assert (str(arrays["camera"]), int(arrays["width"]), int(arrays["height"])) == (model, WIDTH, HEIGHT)
    assert arrays["intrinsics"][0].tolist() == list(CAMERAS[model].params or (0, 0, 0, 0))
    assert str(arrays["depth_kind"]) == ("ray" if model == "equirect" else "z")
    assert (arrays["depth"].shape, arrays["depth"].dtype) == ((7, HEIGHT // 4, WIDTH // 4), np.float16)
    assert np.allclose(arrays["depth"][3, 4], depth_of(3)[16:20].reshape(4, -1, 4).mean((0, 2)), rtol=5e-3)


def test_full_resolution_and_no_depth(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics", "depth"))
    with np.load(export_npz(read_artifacts(tmp_path, "clip"), tmp_path / "full.npz", depth_stride=1)) as file:
        assert np.array_equal(file["depth"][2], depth_of(2).astype(np.float16))
    (tmp_path / "depth/clip.zip").unlink()
    with np.load(export_npz(read_artifacts(tmp_path, "clip"), tmp_path / "none.npz")) as file:
        assert "depth" not in file.files
    with pytest.raises(ValueError, match="stride"):
        export_npz(read_artifacts(tmp_path, "clip"), tmp_path / "x.npz", depth_stride=0)
    assert list(tmp_path.glob(".*")) == []


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.integers(2, 6))
def test_a_plane_stays_a_plane(slope_x: float, slope_y: float, stride: int) -> None:
    """Inverse depth of a plane is linear in the pixel, so area averages must lie on it at the new pixel centres."""
    height, width = 24 * stride // 2, 36 * stride // 2
    y, x = np.mgrid[:height, :width] + 0.5
    inverse = 1 + slope_x * (x - width / 2) + slope_y * (y - height / 2)
    inverse = np.maximum(inverse, 0.05) if inverse.min() <= 0 else inverse
    small = reduce_depth((1 / inverse).astype(np.float32), stride)
    rows, columns = small.shape
    v, u = np.mgrid[:rows, :columns] + 0.5
    expected = 1 + slope_x * (u * stride - width / 2) + slope_y * (v * stride - height / 2)
    linear = expected > 0.2
    assert np.allclose(1 / small[linear], expected[linear], rtol=1e-3)


def test_pixels_without_a_value_do_not_dilute_their_neighbours() -> None:
    depth = np.zeros((8, 8), np.float32)
    depth[:4, :4] = 2
    depth[0, 4:8] = 5
    depth[4, 4] = 7
    assert reduce_depth(depth, 4).tolist() == [[2, 5], [0, 0]]
