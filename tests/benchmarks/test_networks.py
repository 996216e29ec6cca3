"""The command that runs the public networks, where none of them is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch

from benchmarks import networks
from benchmarks.peers import random_weights, vipe_networks
from vipe_core.pipeline.presets import GEOCALIB, METRIC_DEPTH
from vipe_core.priors.weights import selected


def test_the_networks_are_those_that_can_be_pulled_and_their_weights_can_be_made() -> None:
    assert all(selected([name]) for name in networks.ADAPTERS)
    assert set(networks.ADAPTERS) <= {*random_weights._FILES, *random_weights._FOLDERS}
    on_offer = {provider.partition(".")[2] for provider in (*METRIC_DEPTH[1:], *GEOCALIB.values())}
    assert on_offer <= {*random_weights._FILES, *random_weights._FOLDERS}


def test_what_is_not_installed_is_listed_and_no_failure(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "vipe", None)
    before = os.environ.get("VIPE_WEIGHTS")
    assert networks.main(["geocalib_pinhole", "unik3d"]) == 0
    assert capsys.readouterr().err.count("not run") == 2
    assert os.environ.get("VIPE_WEIGHTS") == before


def test_a_network_that_fails_is_a_failure(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str, size: str) -> tuple[str, int]:
        raise RuntimeError("shapes do not fit")

    monkeypatch.setattr(networks, "write", broken)
    assert networks.main(["depth_pro"]) == 1
    assert "RuntimeError: shapes do not fit" in capsys.readouterr().err


def test_what_is_made_on_a_gpu_is_made_where_it_is_wanted() -> None:
    with vipe_networks.led_to(torch.device("cpu")):
        assert torch.linspace(0, 1, 3, device="cuda").device.type == "cpu"
        assert torch.zeros(2).device.type == "cpu"


def test_a_folder_without_the_source_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportError, match="source distribution"):
        vipe_networks.load(tmp_path)
