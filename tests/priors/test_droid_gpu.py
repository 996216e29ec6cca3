"""The DROID network on a GPU against itself on a CPU, with its graphs and kernels against without."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vipe_core.priors.droid import DroidMatcher, DroidNetwork
from vipe_core.priors.droid.correlation import FeatureCorrelation, VolumeCorrelation
from vipe_core.priors.droid.features import DroidFeatures
from vipe_core.priors.droid.kernels import lookup_kernels
from vipe_core.priors.protocols import Refined, WorkingFrame

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.fixture
def gpu() -> DroidMatcher:
    return DroidMatcher(DroidNetwork.random(1).ready(torch.device("cuda")))


def frames(matcher: DroidMatcher) -> list[DroidFeatures]:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(4)]
    return matcher.encode_batch([WorkingFrame(k, rgb[..., 0].copy(), rgb) for k, rgb in enumerate(pictures)])


def refined(matcher: DroidMatcher, *, lean: bool, updates: int = 3) -> Refined:
    found = frames(matcher)
    grid = found[0].grid
    ends = [(i, j) for i in range(4) for j in range(4) if i != j]
    seen = grid.sample_px(torch.float32).repeat(len(ends), 1, 1) + 3
    refinement = matcher.begin(grid, lean=lean)
    refinement.add([(found[i], found[j]) for i, j in ends], seen)
    for _ in range(updates):
        answer = refinement.update(seen, [i for i, _ in ends])
    return answer


@needs_gpu
def test_a_gpu_says_what_a_cpu_says_to_half_precision(gpu: DroidMatcher) -> None:
    expected = refined(DroidMatcher(DroidNetwork.random(1)), lean=False)
    for lean in (False, True):
        found = refined(gpu, lean=lean)
        torch.testing.assert_close(found.target_px.cpu(), expected.target_px, atol=0.1, rtol=0)
        torch.testing.assert_close(found.weight.cpu(), expected.weight, atol=1e-2, rtol=0)
        torch.testing.assert_close(found.damping.cpu(), expected.damping, atol=0, rtol=2e-2)


@needs_gpu
def test_graphs_change_nothing_and_runs_are_bitwise_equal(gpu: DroidMatcher) -> None:
    with_graphs = [refined(gpu, lean=False) for _ in range(3)]
    network = DroidNetwork.random(1).ready(torch.device("cuda"))
    # Of the same shapes, which are those of the graphs: a library may sum in another order for others.
    assert network._graphs is not None
    network._graphs._works = False
    without = refined(DroidMatcher(network), lean=False)
    for found in with_graphs:
        assert torch.equal(found.target_px, without.target_px)
        assert torch.equal(found.damping, without.damping)


@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_kernels_look_up_what_torch_looks_up(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    device = torch.device("cuda")
    assert lookup_kernels(device, dtype) is not None
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(3, 128, 30, 41, generator=generator).to(device, dtype)
    cells = (50 * torch.rand(2, 30, 41, 2, generator=generator) - 5).to(device)
    source, target = torch.tensor([0, 2], device=device), torch.tensor([1, 0], device=device)
    for correlation in (
        VolumeCorrelation.of(features[source], features[target]),
        FeatureCorrelation.of(features, source, target),
    ):
        found = correlation.lookup(cells)
        with monkeypatch.context() as patched:
            patched.setattr("vipe_core.priors.droid.correlation.lookup_kernels", lambda *_: None)
            expected = correlation.lookup(cells)
        torch.testing.assert_close(found.float(), expected.float(), atol=2e-2, rtol=1e-2)
