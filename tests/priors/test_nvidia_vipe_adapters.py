"""What the adapters give the networks of `nvidia-vipe`, and what they make of the answers.

The package needs a GPU to be installed; stand-ins with its signatures answer here with what they were asked.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, LibraryMissing, WeightsInvalid, WeightsMissing
from vipe_core.priors.nvidia_vipe.completion import PriorDa
from vipe_core.priors.nvidia_vipe.geocalib import GeoCalibInit
from vipe_core.priors.nvidia_vipe.loading import filled, from_folder, part, tensors
from vipe_core.priors.nvidia_vipe.metric_depth import Metric3d, UniDepth, UniK3d
from vipe_core.priors.nvidia_vipe.video_depth import VideoDepthAnything
from vipe_core.priors.protocols import MetricEstimate, WorkingFrame
from vipe_core.priors.rectified import Rectified, nearest_pinhole

CPU = torch.device("cpu")
CAMERA = Camera.pinhole_from_fov(60, 64, 48)


def picture(seed: int = 0, height: int = 48, width: int = 64) -> Any:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


class GeoCalibDouble:
    """Sure of the focal length to a share of it, one for each picture."""

    def __init__(self, vfov_rad: float, doubt: tuple[float, ...] = (0.0,)) -> None:
        self.vfov_rad = vfov_rad
        self.doubt = torch.tensor(doubt)
        self.asked: list[tuple[tuple[int, ...], dict[str, Any]]] = []

    def calibrate(self, img: Tensor, **options: Any) -> dict[str, Any]:
        self.asked.append((tuple(img.shape), options))
        focal_px = torch.full((len(self.doubt), 2), 24 / math.tan(self.vfov_rad / 2 or 1.0))
        camera = SimpleNamespace(vfov=torch.tensor([self.vfov_rad]), f=focal_px, dist=torch.tensor([[0.4]]))
        return {"camera": camera, "focal_uncertainty": self.doubt * focal_px[:, 1]}


def test_four_pictures_share_a_focal_length_and_one_tells_a_bent_lens() -> None:
    frames = [WorkingFrame(index, picture()[..., 0], picture()) for index in range(9)]
    model = GeoCalibDouble(math.radians(50))
    found = GeoCalibInit(model, "pinhole", CPU).estimate(frames, Grid(6, 8))
    assert found.camera.focal_px == pytest.approx(24 / math.tan(math.radians(25)))
    assert found.num_pairs == 4
    bent = GeoCalibInit(model, "mei", CPU).estimate(frames[:1], Grid(6, 8))
    assert (bent.camera.model, bent.camera.params[4]) == ("mei", pytest.approx(0.4))
    assert model.asked == [
        ((4, 3, 48, 64), {"shared_intrinsics": True}),
        ((1, 3, 48, 64), {"camera_model": "simple_mei"}),
    ]
    unsure = GeoCalibInit(GeoCalibDouble(0.0), "pinhole", CPU).estimate(frames, Grid(6, 8))
    assert unsure.num_pairs == 0
    assert unsure.log_focal_sigma > found.log_focal_sigma
    assert 40 < unsure.camera.fov_x_deg < 70


@pytest.mark.parametrize(
    ("doubt", "sigma"),
    [((0.0,), 0.1), ((0.05, 0.1, 0.1, 0.05), math.hypot(0.1, 0.075)), ((2.0,), 0.3), ((math.inf, 0.1), 0.3)],
)
def test_the_doubt_of_the_network_widens_the_published_one_up_to_that_of_a_default(
    doubt: tuple[float, ...], sigma: float
) -> None:
    frames = [WorkingFrame(index, picture()[..., 0], picture()) for index in range(4)]
    found = GeoCalibInit(GeoCalibDouble(math.radians(50), doubt), "pinhole", CPU).estimate(frames, Grid(6, 8))
    assert found.log_focal_sigma == pytest.approx(sigma)


class Metric3dDouble:
    """Depth is the row number of its picture."""

    def inference(self, data: dict[str, Tensor]) -> tuple[Tensor, Tensor, dict[str, Any]]:
        height, width = data["input"].shape[-2:]
        rows = torch.arange(height, dtype=torch.float32)[:, None].expand(height, width) + 1
        return rows[None, None], torch.ones(1, 1, height, width), {}


def test_metric3d_sees_a_canonical_camera_and_its_depth_scales_with_the_focal_length() -> None:
    network = Metric3d(Metric3dDouble(), CPU, size=(128, 112))
    found = network.estimate(picture(), CAMERA)
    # Twice as large, with 8 rows of padding above: rows 9 to 104 of the network's picture.
    rows = (np.arange(48) * 2 + 8 + 1 + 0.5) * CAMERA.focal_px * 2 / 1000
    np.testing.assert_allclose(found.depth_m[:, 5], rows, rtol=1e-5)
    np.testing.assert_allclose(network.estimate(picture(), CAMERA.zoomed(3)).depth_m, 3 * found.depth_m, rtol=1e-5)
    assert network.input_size(640, 480) == (128, 96)
    with pytest.raises(ConfigError, match="pinhole"):
        network.estimate(picture(), Camera("mei", (60.0, 60.0, 32.0, 24.0, 0.8), 64, 48))


class InferDouble:
    """Depth is the third root of a hundred everywhere, but for a row of nothing and one of the sky."""

    def __init__(self, key: str) -> None:
        self.key = key
        self.asked: Any = None

    def infer(self, rgb: Tensor, camera: Any = None, rays: Tensor | None = None) -> dict[str, Tensor]:
        self.asked = camera if rays is None else rays
        assert rgb.dtype == torch.uint8
        depth = torch.full((1, 1, *rgb.shape[-2:]), 4.6)
        depth[..., 0, :], depth[..., 1, :] = float("nan"), 1e6
        return {self.key: depth}


def test_unidepth_is_told_the_whole_camera() -> None:
    model = InferDouble("depth")
    camera = Camera("pinhole", (50.0, 51.0, 30.0, 20.0), 64, 48)
    found = UniDepth(model, lambda K: K, CPU).estimate(picture(), camera)
    np.testing.assert_array_equal(model.asked[0], [[50, 0, 30], [0, 51, 20], [0, 0, 1]])
    assert not found.depth_m[:2].any()
    assert not found.confidence[:2].any()
    assert (found.confidence[2:] == 1).all()


def test_unik3d_is_told_the_ray_of_every_pixel_of_any_camera() -> None:
    model = InferDouble("distance")
    network = UniK3d(model, CPU)
    for camera in (CAMERA, Camera("mei", (60.0, 60.0, 32.0, 24.0, 0.8), 64, 48)):
        assert network.estimate(picture(), camera).depth_m.shape == (48, 64)
        rays = model.asked[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-5)
        px, _ = camera.project(rays.astype(np.float64))
        np.testing.assert_allclose(px[7, 9], (9, 7), atol=1e-3)
    assert network.depth_kind == "ray"


class VideoDouble:
    def __init__(self) -> None:
        self.shapes: list[tuple[int, ...]] = []

    def __call__(self, x: Tensor) -> Tensor:
        self.shapes.append(tuple(x.shape))
        return x.mean(dim=2)


def test_video_depth_sees_whole_windows_and_answers_for_what_it_was_given() -> None:
    model = VideoDouble()
    network = VideoDepthAnything(model, CPU, shortest=28)
    found = network.predict([picture(seed) for seed in range(3)])
    assert found.shape == (3, 48, 64)
    assert model.shapes == [(1, 32, 3, 28, 42)]
    real = VideoDepthAnything(model, CPU)
    assert real.input_size(640, 480) == (686, 518)
    # Wider than 16:9, smaller for memory.
    assert real.input_size(2000, 500) == (924, 224)
    assert all(side % 14 == 0 for side in real.input_size(1080, 1920))


class PriorDouble:
    def infer_one_sample(self, image: Tensor, prior: Tensor) -> Tensor:
        assert image.shape == (48, 64, 3)
        assert image.max() > 1
        out = prior + torch.rand(prior.shape)
        out[0, 0], out[0, 1] = -1, float("inf")
        return out


def test_completion_is_positive_and_the_same_twice() -> None:
    sparse = np.zeros((48, 64), np.float32)
    sparse[::9, ::7] = 3
    state = torch.random.get_rng_state()
    first, second = (PriorDa(PriorDouble(), CPU).complete(picture(), sparse, CAMERA) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    assert (first > 0).all()
    assert np.isfinite(first).all()
    assert torch.equal(state, torch.random.get_rng_state())


class Slanted:
    """Depth grows from left to right of a pinhole's picture."""

    depth_kind = "z"
    shared_sigma_ratio = 0.1

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return width, height

    def estimate(self, rgb: Any, camera: Camera) -> MetricEstimate:
        assert camera.model == "pinhole"
        depth = (1 + camera.rays()[..., 0]).clip(0.1).astype(np.float32)
        return MetricEstimate(depth, np.ones_like(depth))


def test_a_bent_camera_is_seen_as_a_pinhole_and_z_goes_back_along_the_rays() -> None:
    bent = Camera("mei", (60.0, 60.0, 32.0, 24.0, 0.8), 64, 48)
    assert nearest_pinhole(bent).focal_px == pytest.approx(60 / 1.8, rel=1e-4)
    found = Rectified(Slanted()).estimate(picture(), bent)
    rays = bent.rays()
    expected = (1 + rays[..., 0] / rays[..., 2]).clip(0.1)
    known = found.depth_m > 0
    assert 0.5 < known.mean() < 1
    # To the nearest pixel of the pinhole.
    np.testing.assert_allclose(found.depth_m[known], expected[known], atol=0.6 / nearest_pinhole(bent).focal_px)
    assert not found.confidence[~known].any()
    with pytest.raises(ConfigError, match="panorama"):
        Rectified(Slanted()).estimate(picture(), Camera("equirect", (), 64, 32))


def test_a_missing_package_names_what_installs_it() -> None:
    with pytest.raises(LibraryMissing, match=r"install it: pip install .*nvidia-vipe") as caught:
        part("geocalib.nothing_of_the_kind", "GeoCalib")
    assert caught.value.code == "library_missing"


def test_what_the_package_wrote_for_cuda_is_refused_elsewhere(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"Metric3D .* on CUDA only, not on cpu"):
        Metric3d.load(tmp_path / "none.pth", "small", CPU)
    with pytest.raises(ConfigError, match=r"PriorDA .* on CUDA only"):
        PriorDa.load(tmp_path, CPU)


def test_weights_are_tensors_and_all_of_them(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissing, match="vipectl models pull"):
        tensors(tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("not weights")
    with pytest.raises(WeightsInvalid, match="cannot be read"):
        tensors(tmp_path / "text.pth")
    network = nn.Linear(2, 3)
    torch.save({"model": network.state_dict(), "step": 5}, tmp_path / "good.pth")
    found = tensors(tmp_path / "good.pth", "model")
    assert torch.equal(filled(nn.Linear(2, 3), found, "good.pth", CPU).weight, network.weight)
    with pytest.raises(WeightsInvalid, match="named tensors"):
        tensors(tmp_path / "good.pth")
    with pytest.raises(WeightsInvalid, match="other shapes"):
        filled(nn.Linear(2, 4), found, "good.pth", CPU)
    found.pop("bias")
    with pytest.raises(WeightsInvalid, match="bias"):
        filled(nn.Linear(2, 3), found, "good.pth", CPU)
    with pytest.raises(WeightsMissing, match=r"config\.json"):
        from_folder(nn.Linear, tmp_path, CPU)
