"""Presets of networks name what they need, and say at the start what is missing."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from vipe_core.errors import ConfigError, LibraryMissing, WeightsMissing
from vipe_core.pipeline import providers
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import METRIC_DEPTH, NONE, PRESETS, TRACKS, PresetOptions, resolve
from vipe_core.priors.classical import classical_priors
from vipe_core.priors.weights import WEIGHTS, selected


@pytest.fixture(autouse=True)
def _nothing_pulled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path))


def test_every_network_on_offer_has_an_opener_and_weights_that_can_be_pulled() -> None:
    assert set(METRIC_DEPTH) == {NONE, *providers._METRIC}
    for name in METRIC_DEPTH[1:]:
        needed = resolve("classical", options=PresetOptions(metric_depth=name)).weights
        assert selected(needed)
    for preset in PRESETS:
        for camera in ("pinhole", "mei", "auto"):
            assert set(selected(resolve(preset, camera).weights)) <= set(WEIGHTS)
    assert resolve("vipe", "mei").intrinsics == "nvidia_vipe.geocalib_distorted"
    assert resolve("vipe", "auto").intrinsics == "classical.unified_sweep"


def test_a_missing_library_is_told_before_missing_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(providers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(LibraryMissing, match=r"hf\.depth_pro needs the library transformers.*pip install"):
        Annotator(options=PresetOptions(metric_depth="hf.depth_pro"))
    with pytest.raises(LibraryMissing, match="pip install"):
        Annotator("vipe")


def test_one_command_fetches_all_that_a_preset_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(providers.importlib.util, "find_spec", lambda name: object())
    with pytest.raises(WeightsMissing) as caught:
        Annotator("vipe")
    command = str(caught.value).partition("`vipectl models pull ")[2].rstrip("`").split()
    assert set(command) == {
        "droid",
        "geocalib_pinhole",
        "grounding_dino",
        "metric3d_large",
        "priorda",
        "sam2_video",
        "video_depth_anything",
    }
    assert all(name in WEIGHTS for name in selected(command))


def test_unknown_networks_are_refused_with_those_on_offer() -> None:
    with pytest.raises(ConfigError, match=r"hf\.depth_pro"):
        resolve("classical", options=PresetOptions(metric_depth="magic"))


def test_tracks_are_chosen_for_the_droid_network_alone() -> None:
    assert set(TRACKS) == {NONE, *providers._TRACKS}
    assert resolve("vipe").sparse == "classical.corners"
    assert resolve("vipe", options=PresetOptions(tracks="none")).sparse == NONE
    assert resolve("pose_only").sparse == NONE
    assert resolve("pose_only", options=PresetOptions(tracks="cuvslam.odometry")).providers["sparse_tracks"] == (
        "cuvslam.odometry"
    )
    with pytest.raises(ConfigError, match=r"unknown tracks 'magic'.*cuvslam\.odometry"):
        resolve("vipe", options=PresetOptions(tracks="magic"))
    with pytest.raises(ConfigError, match="classical has tracks of its own"):
        resolve("classical", options=PresetOptions(tracks="classical.corners"))


def test_pycuvslam_is_asked_for_where_it_is_chosen_and_missing() -> None:
    with pytest.raises(LibraryMissing, match=r"cuvslam\.odometry needs the library cuvslam.*releases"):
        Annotator("pose_only", options=PresetOptions(tracks="cuvslam.odometry"))


def test_the_followers_join_the_family_of_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    family = object()
    monkeypatch.setitem(providers._PRIORS, "droid.network", lambda camera, device: classical_priors)
    monkeypatch.setitem(providers._TRACKS, "classical.corners", lambda device: family)
    cpu = torch.device("cpu")
    assert providers.open_priors("droid.network", "classical.corners", "", "pinhole", cpu)().follower is family
    assert providers.open_priors("droid.network", NONE, "", "pinhole", cpu)().follower is None
