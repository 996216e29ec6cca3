"""The pipeline of a GPU on a machine without one: tensors that claim to be there, and say what a real one would."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks import gpu_pipeline, network_slam
from benchmarks.claimed_gpu import ClaimedGpu, claimed_gpu
from benchmarks.gpu_pipeline import Run, Workload
from vipe_core.priors.droid import DroidNetwork
from vipe_core.priors.droid.graphs import GraphCache
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.transfer import downloaded, uploaded

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


def test_tensors_of_two_devices_do_not_meet() -> None:
    with claimed_gpu():
        there, here = torch.arange(12.0, device="cuda").view(3, 4), torch.ones(3, 4)
        assert there.device == torch.device("cuda", 0)
        with pytest.raises(RuntimeError, match="same device"):
            there + here
        with pytest.raises(RuntimeError, match="same device"):
            torch.cat((there, here))
        with pytest.raises(RuntimeError, match="same device"):
            torch.tensor(1.0).add_(there.sum())
        with pytest.raises(RuntimeError, match="same device"):
            here[there[0].long() % 3]
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        # Numbers, indices and copies may come from the host.
        assert torch.equal((there + torch.tensor(2.0)).cpu(), torch.arange(12.0).view(3, 4) + 2)
        assert torch.equal(there[torch.tensor([2, 0])].cpu()[:, 0], torch.tensor([8.0, 0.0]))
        assert there[..., (0, 2)].shape == (3, 2)
        with torch.inference_mode():
            assert there.squeeze(0).is_inference() == there.is_inference()
        there[1] = here[0]
        assert there[1].tolist() == [1, 1, 1, 1]
    with pytest.raises(RuntimeError, match="after its end"):
        there + 1


def kinds(gpu: ClaimedGpu) -> list[str]:
    return [place.kind for place in gpu.waits.elements()]


def test_what_makes_the_host_wait_is_counted() -> None:
    with claimed_gpu() as gpu:
        there = torch.zeros(3, 4, device="cuda")
        _ = there @ there.mT + 1, there[1:, None, 2], torch.where(there > 0, there, 2.0)
        there[0] = 5.0
        there[there > 1] = 0.0
        torch.ones(4).to("cuda", non_blocking=True)
        assert kinds(gpu) == []
        assert gpu.copies == 1
        _ = bool(there.any()), float(there.sum()), there.cpu(), there.tolist()
        assert kinds(gpu) == ["read"] * 4
        gpu.waits.clear()
        _ = torch.tensor([1], device="cuda"), torch.ones(4).cuda(), there[[0, 2]]
        assert kinds(gpu) == ["upload"] * 3
        # The driver keeps a copy of what is small until it is sent; what is large has to be pinned.
        gpu.waits.clear()
        frame = torch.ones(1 << 20, dtype=torch.uint8)
        large = uploaded(frame, there.device)
        assert kinds(gpu) == []
        frame.to("cuda", non_blocking=True)
        assert kinds(gpu) == ["upload"]
        assert torch.equal(large.cpu(), frame)
        gpu.waits.clear()
        _ = there[there > 0], there.unique(), there.nonzero()
        assert kinds(gpu) == ["shape"] * 3
        (place,) = {place.function for place in gpu.waits}
        torch.cuda.set_sync_debug_mode("error")
        with pytest.raises(RuntimeError, match="synchronizing"):
            there.sum().item()
        assert place.endswith("test_what_makes_the_host_wait_is_counted")


def test_tensors_of_any_type_are_read_in_one_piece() -> None:
    with claimed_gpu() as gpu:
        there = torch.arange(6.0, device="cuda").view(2, 3) - 2
        given = there > 0, there.half(), there.double().mT, there[0, :0], there[1, 1]
        expected = [one.cpu().numpy() for one in given]
        gpu.waits.clear()
        found = downloaded(*given)
        assert kinds(gpu) == ["read"]
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_graphs_are_replayed_and_waits_are_refused_while_they_are_captured() -> None:
    with claimed_gpu() as gpu, torch.inference_mode():
        cache = GraphCache(lambda a, b: (a @ b, (a + b).relu_()))
        for number in range(4):
            a, b = (torch.full((2, 2), value, device="cuda") for value in (number + 1.0, -2.0))
            product, positive = cache(a, b)
            assert product.tolist() == [[-4 * (number + 1.0)] * 2] * 2
            assert positive.tolist() == [[max(number - 1.0, 0.0)] * 2] * 2
        assert gpu.replays == 3
        graph = torch.cuda.CUDAGraph()
        for wait in (lambda: a.sum().item(), lambda: torch.ones(2).to("cuda", non_blocking=True)):
            with pytest.raises(RuntimeError, match="capturing"), torch.cuda.graph(graph):
                wait()


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Seven tiny pictures of noise that the camera pans over."""
    noise = np.random.default_rng(0).integers(0, 256, (12, 30, 3), dtype=np.uint8)
    wide = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    for index in range(7):
        cv2.imwrite(str(tmp_path / f"{index}.png"), wide[:, 5 * index : 5 * index + 64])
    return tmp_path


def annotated(clip: Path, device: str, maps: list[KeyframeMap]) -> Run:
    settings = gpu_pipeline._settings(lean=False, short=True)
    schedule = replace(
        settings.refinement, first_updates=2, global_updates=(1, 1, 1), iterations=2, global_iterations=2
    )
    settings = replace(settings, working_area_px=64 * 48, min_keyframes=3, refinement=schedule)
    network = DroidNetwork.random(1).ready(torch.device(device))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(network_slam, "KeyframeMap", lambda *of: maps.append(KeyframeMap(*of)) or maps[-1])
        return gpu_pipeline._annotate(Workload(clip, 2, device, settings), network)


def test_tracker_backend_and_infill_do_there_what_they_do_here(clip: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    maps: list[KeyframeMap] = []
    expected = annotated(clip, "cpu", maps)
    with claimed_gpu() as gpu:
        found = annotated(clip, "cuda", maps)
    assert (found.keyframes, found.edges) == (expected.keyframes, expected.edges)
    assert gpu.replays > 5
    assert not caplog.records
    waiting = {place.function.removeprefix("vipe_core.priors.droid.") for place in gpu.waits}
    assert not any(name.startswith(("refinement.", "update.", "correlation.", "graphs.")) for name in waiting)
    here, there = maps
    # To what half precision leaves of it.
    moved = np.abs(here.poses() - np.eye(4)).max()
    assert np.abs(here.poses() - there.poses()).max() < 1e-2 * moved
    assert np.abs(np.log(here.depths() / there.depths())).max() < 2e-2 * np.abs(np.log(here.depths())).max()
