"""The networks of `transformers`, at their smallest and with random weights: shapes, memory, ids, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_networks
import torch

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, WeightsInvalid, WeightsMissing
from vipe_core.priors.hf.grounding_dino import GroundingDino
from vipe_core.priors.hf.metric_depth import DepthAnything, DepthPro
from vipe_core.priors.hf.sam2_video import Sam2Propagation, Sam2Video
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.priors.instances import FollowedInstances
from vipe_core.video.source import Frame

pytest.importorskip("transformers", reason="the extra hf is not installed")

CPU = torch.device("cpu")
PHRASES = ("person", "red cars", "sky")
BOXES = np.array([[5, 5, 30, 30], [20, 10, 60, 40.0]])


def picture(seed: int, height: int = 48, width: int = 64) -> Any:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def sam() -> Any:
    return tiny_networks.sam2_video()


@pytest.fixture(scope="module")
def dino(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dino")
    tiny_networks.grounding_dino().save_pretrained(folder)
    tiny_networks.write_words(folder)
    return folder


@pytest.fixture
def propagation(sam: Any) -> Sam2Propagation:
    return Sam2Video(sam, CPU).begin()


def test_each_box_is_of_the_phrase_with_the_surest_word(dino: Path) -> None:
    detector = GroundingDino.load(dino, CPU)
    found = detector.detect(picture(0), PHRASES, 0.0)
    assert 0 < len(found) <= 12
    assert {one.phrase for one in found} <= set(PHRASES)
    for one in found:
        left, top, right, bottom = one.box_px
        assert 0 <= left < right <= 64
        assert 0 <= top < bottom <= 48
    # [CLS] person . red car ##s . sky . [SEP]
    assert detector._text(PHRASES).spans == ((1, 2), (3, 6), (7, 8))
    scores = sorted(one.score for one in found)
    middle = scores[len(scores) // 2]
    kept = detector.detect(picture(0), PHRASES, middle)
    assert sorted(one.score for one in kept) == [score for score in scores if score > middle]
    assert detector.detect(picture(0), PHRASES, 1.0) == []


def test_phrases_beyond_what_the_network_reads_are_refused(dino: Path) -> None:
    with pytest.raises(ConfigError, match="32 can be"):
        GroundingDino.load(dino, CPU).detect(picture(0), ("person " * 31,), 0.3)


def test_ids_stay_as_things_come_and_go(propagation: Sam2Propagation) -> None:
    assert propagation.advance(picture(0)).shape[0] == 0
    outlined = propagation.outline(BOXES)
    assert outlined.shape[0] == 2
    propagation.add({2: 1, 5: 0})
    assert propagation.ids == (2, 5)
    for seed in range(3):
        assert propagation.advance(picture(seed)).shape == outlined.shape
    propagation.outline(BOXES[:1])
    propagation.add({9: 0})
    assert propagation.ids == (2, 5, 9)
    propagation.forget([2])
    assert propagation.ids == (5, 9)
    assert propagation.advance(picture(7)).shape[0] == 2


def test_a_thing_is_followed_the_same_whoever_else_is(sam: Any) -> None:
    """What is remembered of it is handed over as it is when others come or go."""
    alone, company = Sam2Video(sam, CPU).begin(), Sam2Video(sam, CPU).begin()
    for one in (alone, company):
        one.advance(picture(0))
        one.outline(BOXES)
    alone.add({4: 1})
    company.add({3: 0, 4: 1})
    for seed in range(1, 6):
        expected, found = alone.advance(picture(seed)), company.advance(picture(seed))
        torch.testing.assert_close(found[-1], expected[0])
        if seed == 3:
            company.forget([3])


def test_memory_of_a_video_does_not_grow_with_it(propagation: Sam2Propagation) -> None:
    propagation.advance(picture(0))
    propagation.outline(BOXES)
    propagation.add({2: 0, 3: 1})

    def held() -> int:
        return sum(
            value.numel()
            for outputs in propagation._session.output_dict_per_obj.values()
            for frames in outputs.values()
            for one in frames.values()
            for value in one.values()
        )

    counts = []
    for seed in range(8):
        propagation.advance(picture(seed))
        counts.append(held())
    assert counts[-1] == counts[-2] == counts[-3]
    assert not propagation._session.processed_frames


def test_detector_and_propagator_together_give_the_same_bytes_twice(sam: Any, dino: Path) -> None:
    settings = InstanceSettings(phrases=PHRASES, interval_s=0.2, min_score=0.0, max_share=1.0)
    masks = FollowedInstances(GroundingDino.load(dino, CPU), Sam2Video(sam, CPU), settings, (96, 64))
    frames = [Frame(index, index / 10, picture(index)) for index in range(4)]
    first, second = (list(masks.follow(frames)) for _ in range(2))
    for one, two in zip(first, second, strict=True):
        assert one.ids.shape == (48, 64)
        assert one.ids.tobytes() == two.ids.tobytes()
        assert one.phrases == two.phrases


def test_depth_pro_is_told_the_focal_length() -> None:
    network = DepthPro(tiny_networks.depth_pro(), CPU, side=64)
    camera = Camera.pinhole_from_fov(60, 64, 48)
    near, far = (network.estimate(picture(0), one) for one in (camera, camera.zoomed(1.5)))
    known = (near.depth_m > 0) & (far.depth_m > 0)
    assert known.any()
    np.testing.assert_allclose(far.depth_m[known], 1.5 * near.depth_m[known], rtol=1e-5)
    np.testing.assert_array_equal(near.confidence, near.depth_m > 0)
    assert network.input_size(3840, 2160) == (64, 36)


def test_depth_anything_must_be_metric() -> None:
    network = DepthAnything(tiny_networks.depth_anything(), CPU, shortest=56)
    found = network.estimate(picture(0), Camera.pinhole_from_fov(60, 64, 48))
    assert found.depth_m.shape == (48, 64)
    assert 0 < found.depth_m.min() <= found.depth_m.max() < 20
    assert network.input_size(640, 480) == (70, 56)
    with pytest.raises(WeightsInvalid, match="relative depth"):
        DepthAnything(tiny_networks.depth_anything("relative"), CPU)


def test_weights_are_there_as_a_whole_or_not_at_all(sam: Any, dino: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    with pytest.raises(WeightsMissing, match="vipectl models pull"):
        Sam2Video.load(tmp_path, CPU)
    sam.save_pretrained(tmp_path)
    assert Sam2Video.load(tmp_path, CPU).begin().ids == ()
    # The library would make up a missing tensor, and say so in a warning.
    tensors = load_file(tmp_path / "model.safetensors")
    tensors.pop("memory_temporal_positional_encoding")
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(WeightsInvalid, match="memory_temporal_positional_encoding"):
        Sam2Video.load(tmp_path, CPU)
    (tmp_path / "model.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsInvalid, match="cannot be read"):
        Sam2Video.load(tmp_path, CPU)
    (dino / "tokenizer.json").unlink()
    with pytest.raises(WeightsMissing, match=r"tokenizer\.json"):
        GroundingDino.load(dino, CPU)
