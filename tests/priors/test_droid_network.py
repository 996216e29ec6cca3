"""The DROID network against an independent float64 implementation, and the public checkpoint's names and shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import droid_reference as reference
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from vipe_core.errors import WeightsInvalid
from vipe_core.priors.droid import DroidNetwork, load_network
from vipe_core.priors.droid.correlation import FeatureCorrelation, VolumeCorrelation
from vipe_core.priors.droid.features import encoded, grid_of
from vipe_core.priors.droid.matcher import DroidMatcher
from vipe_core.priors.droid.update import shares
from vipe_core.priors.protocols import WorkingFrame

Array = NDArray[Any]

HEIGHT, WIDTH = 24, 40


@pytest.fixture(scope="module")
def network() -> DroidNetwork:
    return DroidNetwork.random(1)


@pytest.fixture(scope="module")
def weights(network: DroidNetwork) -> dict[str, Array]:
    return {name: tensor.double().numpy() for name, tensor in network.state_dict().items()}


def picture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def working(seed: int, index: int = 0, height: int = HEIGHT, width: int = WIDTH) -> WorkingFrame:
    rgb = picture(seed, height, width)
    return WorkingFrame(index, rgb.mean(axis=2).astype(np.uint8), rgb)


def test_both_encoders_agree_with_the_reference(network: DroidNetwork, weights: dict[str, Array]) -> None:
    rgb = picture(3)
    tensor = network.normalised(torch.from_numpy(rgb.transpose(2, 0, 1)[None].copy()))
    np.testing.assert_allclose(network.features(tensor)[0].numpy(), reference.encode(weights, "fnet", rgb), atol=2e-5)
    begin, context = network.context(tensor)
    expected = reference.encode(weights, "cnet", rgb)
    np.testing.assert_allclose(begin[0].numpy(), np.tanh(expected[:128]), atol=2e-5)
    np.testing.assert_allclose(context[0].numpy(), np.maximum(expected[128:], 0), atol=2e-5)


@pytest.mark.parametrize(("height", "width"), [(8, 9), (3, 5), (1, 2)])
def test_volume_and_products_on_the_fly_agree_with_the_reference(height: int, width: int) -> None:
    rng = np.random.default_rng(0)
    frames = rng.standard_normal((3, 128, height, width)).astype(np.float32)
    cells = rng.uniform(-4, max(height, width) + 4, (2, height, width, 2)).astype(np.float32)
    cells[0, 0, 0] = 1e8, -1e8
    ends = ((0, 1), (2, 0))
    expected = np.stack([reference.correlate(frames[i], frames[j], cells[e]) for e, (i, j) in enumerate(ends)])
    at, tensor = torch.from_numpy(cells), torch.from_numpy(frames)
    source, target = (torch.tensor(end) for end in zip(*ends, strict=True))
    volume = VolumeCorrelation.of(tensor[source], tensor[target])
    on_the_fly = FeatureCorrelation.of(tensor, source, target)
    for correlation in (volume, on_the_fly):
        np.testing.assert_allclose(correlation.lookup(at).numpy(), expected, atol=1e-4)
        np.testing.assert_allclose(correlation.kept(torch.tensor([1])).lookup(at[1:]).numpy(), expected[1:], atol=1e-4)


def test_a_frame_is_most_like_itself_at_the_offset_of_zero() -> None:
    frames = torch.from_numpy(np.random.default_rng(2).standard_normal((1, 128, 9, 11)).astype(np.float32))
    y, x = np.mgrid[:9, :11].astype(np.float32)
    found = VolumeCorrelation.of(frames, frames).lookup(torch.from_numpy(np.stack((x, y), axis=-1)[None]))
    assert (found[0, :49].argmax(dim=0) == 24).all()
    # One cell to the right in the target is the channel of dx = -1: x is the slower one.
    moved = VolumeCorrelation.of(frames, frames).lookup(torch.from_numpy(np.stack((x + 1, y), axis=-1)[None]))
    assert (moved[0, :49].argmax(dim=0) == 24 - 7).all()


def test_an_update_agrees_with_the_reference(network: DroidNetwork, weights: dict[str, Array]) -> None:
    rng = np.random.default_rng(5)
    edges, height, width, sources = 3, 4, 5, (7, 2, 7)
    hidden, context = np.tanh(rng.standard_normal((2, edges, 128, height, width)))
    correlation = rng.standard_normal((edges, 196, height, width))
    motion = rng.uniform(-90, 90, (edges, 4, height, width))
    states, deltas, sure, damping = reference.update(weights, hidden, context, correlation, motion, sources)
    share = shares(sources)
    tensors = [torch.from_numpy(x).float() for x in (hidden, np.maximum(context, 0), correlation, motion)]
    tensors[1] = torch.from_numpy(context).float()
    found = network.step(*tensors, share)
    assert len(share) == len(damping)
    np.testing.assert_allclose(found.hidden.numpy(), np.stack(states), atol=1e-4)
    np.testing.assert_allclose(found.delta.numpy(), np.stack(deltas), atol=1e-4)
    np.testing.assert_allclose(found.weight.numpy(), np.stack(sure), atol=1e-4)
    np.testing.assert_allclose(found.damping.numpy(), np.stack([damping[k] for k in sorted(damping)]), atol=1e-6)


def test_cells_are_centred_on_their_sample_points() -> None:
    """What a cell sees is symmetric about its sample point when every weight is the same."""
    network = DroidNetwork()
    for name, tensor in network.state_dict().items():
        tensor.fill_(1e-3 if name.endswith("weight") else 1.0)
    row, column = 5, 7
    grid = grid_of((96, 128, 3))
    centre = grid.sample_px().view(grid.height, grid.width, 2)[row, column].tolist()
    flat = np.full((96, 128, 3), 100, np.uint8)

    def seen(du: int, dv: int) -> float:
        rgb = flat.copy()
        rgb[int(centre[1]) + dv, int(centre[0]) + du] = 255
        (features,) = encoded(network, [WorkingFrame(0, rgb[..., 0], rgb)])
        return float(features.context[1][0, row, column])

    assert centre == [8 * column + 4, 8 * row + 4]
    for offset in (1, 3, 9):
        assert seen(offset, 0) == pytest.approx(seen(-offset, 0), rel=1e-6)
        assert seen(0, offset) == pytest.approx(seen(0, -offset), rel=1e-6)
    assert seen(4, 0) != pytest.approx(seen(-5, 0), rel=1e-6)


def test_lean_and_full_refinements_say_the_same_and_forget_what_they_are_told_to(network: DroidNetwork) -> None:
    matcher = DroidMatcher(network)
    frames = [matcher.encode(working(seed, seed)) for seed in range(9)]
    grid = frames[0].grid
    ends = [(i, i - 1) for i in range(1, 9)] + [(0, 1), (3, 4), (8, 6)]
    seen = grid.sample_px(torch.float32) + torch.linspace(-5, 5, len(ends))[:, None, None]
    answers = []
    for lean in (False, True):
        refinement = matcher.begin(grid, lean=lean, spilled=lean)
        refinement.add([(frames[i], frames[j]) for i, j in ends[:-1]], seen[:-1])
        refinement.add([(frames[i], frames[j]) for i, j in ends[-1:]], seen[-1:])
        refinement.update(seen, [i for i, _ in ends])
        kept = [row for row in range(len(ends)) if row % 3]
        refinement.keep(kept)
        assert len(refinement) == len(kept)
        answers.append(refinement.update(seen[kept] + 1, [ends[row][0] for row in kept]))
    full, lean_answer = answers
    assert full.target_px.shape == (len(kept), grid.num_cells, 2)
    assert full.damping.shape[0] == len({ends[row][0] for row in kept})
    assert (full.damping > 0).all()
    torch.testing.assert_close(full.target_px, lean_answer.target_px, atol=2e-3, rtol=0)
    torch.testing.assert_close(full.weight, lean_answer.weight, atol=1e-4, rtol=0)
    torch.testing.assert_close(full.damping, lean_answer.damping, atol=1e-3, rtol=1e-4)


def test_graphs_get_shapes_that_repeat_and_the_filling_changes_nothing(network: DroidNetwork) -> None:
    shapes = []

    def captured(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        shapes.append([tuple(given.shape[:2]) for given in (inputs[0], inputs[-1])])
        return network._step(*inputs)

    rng = np.random.default_rng(6)
    for edges, sources in ((3, (7, 2, 7)), (16, tuple(range(8)) * 2), (17, (1,) * 17)):
        hidden, context = np.tanh(rng.standard_normal((2, edges, 128, 1, 2)))
        correlation, motion = rng.standard_normal((edges, 196, 1, 2)), rng.uniform(-9, 9, (edges, 4, 1, 2))
        inputs = [torch.from_numpy(x).float() for x in (hidden, context, correlation, motion)]
        share = shares(sources)
        plain = network.step(*inputs, share)
        network._graphs = captured
        try:
            filled = network.step(*inputs, share)
        finally:
            network._graphs = None
        for name in ("hidden", "delta", "weight", "damping"):
            torch.testing.assert_close(getattr(filled, name), getattr(plain, name), atol=1e-6, rtol=1e-5)
    assert shapes == [[(16, 128), (8, 16)], [(16, 128), (8, 16)], [(32, 128), (8, 32)]]


def test_an_overflow_is_no_measurement_and_does_not_stay(network: DroidNetwork) -> None:
    matcher = DroidMatcher(network)
    frames = [matcher.encode(working(seed, seed)) for seed in range(2)]
    seen = frames[0].grid.sample_px(torch.float32)[None] + 2
    refinement = matcher.begin(frames[0].grid, lean=False)
    refinement.add([(frames[0], frames[1])], seen)
    refinement._hidden = torch.full_like(frames[0].context[0][None], torch.nan)
    lost = refinement.update(seen, [0])
    torch.testing.assert_close(lost.target_px, seen)
    assert not lost.weight.any()
    assert lost.damping.isfinite().all()
    after = refinement.update(seen, [0])
    assert after.target_px.isfinite().all()
    assert after.weight.any()
    assert after.damping.isfinite().all()


def test_masked_cells_have_no_weight_and_a_pair_can_be_matched_without_geometry(network: DroidNetwork) -> None:
    matcher = DroidMatcher(network)
    first, second = working(1), working(2, 1)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :16] = False
    there, back = matcher.match(matcher.encode(WorkingFrame(0, first.gray, first.rgb, valid)), matcher.encode(second))
    assert (there.weight.reshape(3, 5, 2)[:, :2] == 0).all()
    assert np.isfinite(there.target_px).all()
    assert np.isfinite(back.target_px).all()
    fast = matcher.match_fast(matcher.encode(first), matcher.encode(second))
    assert fast.weight.shape == (15, 2)
    assert 0 <= fast.consistent <= 1
    assert matcher.motion_px(matcher.encode(first), matcher.encode(second)) > 0
    blank = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert matcher.is_blank(matcher.encode(WorkingFrame(0, blank[..., 0], blank)))
    assert not matcher.is_blank(matcher.encode(first))


def test_motion_of_a_batch_is_asked_at_once_until_a_keyframe_is_taken(
    network: DroidNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher = DroidMatcher(network)
    frames = [working(seed, index=seed) for seed in range(5)]
    alone = {
        (i, j): matcher.motion_px(matcher.encode(frames[i]), matcher.encode(frames[j]))
        for i, j in [(0, 1), (0, 2), (0, 3), (3, 4)]
    }
    step, edges = network.step, list[int]()
    monkeypatch.setattr(network, "step", lambda hidden, *rest: edges.append(len(hidden)) or step(hidden, *rest))
    features = matcher.encode_batch(frames)
    together = {(i, j): matcher.motion_px(features[i], features[j]) for i, j in alone}
    assert together == pytest.approx(alone, rel=1e-4)
    assert edges == [4, 1]
    assert matcher.motion_px(features[2], features[1]) != pytest.approx(alone[0, 1], rel=1e-3)


def public_checkpoint(network: DroidNetwork) -> dict[str, torch.Tensor]:
    """As the public file has it: the prefix of parallel training, and a third output of two heads."""
    found = {f"module.{name}": tensor.clone() for name, tensor in network.state_dict().items()}
    for head in ("weight", "delta"):
        for kind in ("weight", "bias"):
            name = f"module.update.{head}.2.{kind}"
            found[name] = torch.cat((found[name], found[name][:1] + 7))
    return found


def test_the_network_has_the_tensors_of_the_public_checkpoint(network: DroidNetwork) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert len(shapes) == 102
    assert sum(tensor.numel() for tensor in network.state_dict().values()) == 4_002_565
    by_part = {
        part: sum(t.numel() for n, t in network.state_dict().items() if n.startswith(part))
        for part in ("fnet", "cnet", "update")
    }
    assert by_part == {"fnet": 714_560, "cnet": 731_072, "update": 2_556_933}
    assert shapes["update.corr_encoder.0.weight"] == (128, 196, 1, 1)
    assert shapes["update.flow_encoder.0.weight"] == (128, 4, 7, 7)
    assert shapes["update.gru.convz.weight"] == (128, 448, 3, 3)
    assert shapes["update.agg.eta.0.weight"] == (1, 128, 3, 3)
    assert shapes["update.agg.upmask.0.weight"] == (576, 128, 1, 1)
    assert shapes["fnet.layer2.0.downsample.0.weight"] == (64, 32, 1, 1)


def test_the_public_checkpoint_is_read_by_name_and_trimmed(network: DroidNetwork, tmp_path: Path) -> None:
    content = public_checkpoint(network)
    torch.save(content, tmp_path / "droid.pth")
    save_file(content, tmp_path / "droid.safetensors")
    for name in ("droid.pth", "droid.safetensors"):
        loaded = load_network(tmp_path / name).state_dict()
        for key, tensor in network.state_dict().items():
            torch.testing.assert_close(loaded[key], tensor, rtol=0, atol=0)


def test_a_wrong_checkpoint_is_refused_by_what_is_wrong_with_it(network: DroidNetwork, tmp_path: Path) -> None:
    content = public_checkpoint(network)
    del content["module.fnet.conv1.bias"]
    content["module.extra"] = torch.zeros(1)
    content["module.update.gru.w.weight"] = torch.zeros(128, 64, 1, 1)
    content["module.cnet.conv2.bias"][3] = torch.nan
    torch.save(content, tmp_path / "droid.pth")
    with pytest.raises(WeightsInvalid) as caught:
        load_network(tmp_path / "droid.pth")
    for part in (
        "fnet.conv1.bias missing",
        "extra not known",
        "update.gru.w.weight (128, 64, 1, 1) instead of (128, 128, 1, 1)",
        "cnet.conv2.bias not finite",
    ):
        assert part in str(caught.value)
    (tmp_path / "noise.pth").write_bytes(b"not weights")
    (tmp_path / "noise.safetensors").write_bytes(b"not weights")
    torch.save({"module.fnet.conv1.bias": "text"}, tmp_path / "text.pth")
    for name in ("noise.pth", "noise.safetensors", "text.pth"):
        with pytest.raises(WeightsInvalid):
            load_network(tmp_path / name)
