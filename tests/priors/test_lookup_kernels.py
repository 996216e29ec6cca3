"""The lookup kernels: executed on a CPU by the emulator of the bundle adjustment's tests, and compiled by NVRTC."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import torch
from lookup_emulator import COMPILER, ORDERS, EmulatedLookups

from vipe_core.ba.cuda.compiler import compile_kernels
from vipe_core.priors.droid import kernels
from vipe_core.priors.droid.correlation import FeatureCorrelation, VolumeCorrelation


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to run the kernels with")
@pytest.mark.parametrize(("height", "width"), [(5, 7), (9, 4), (1, 2)])
def test_the_kernels_give_what_torch_gives_in_any_order_of_threads(
    height: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(height)
    features = torch.from_numpy(rng.standard_normal((3, 128, height, width)).astype(np.float32))
    cells = torch.from_numpy(rng.uniform(-5, max(height, width) + 5, (2, height, width, 2)).astype(np.float32))
    cells[0, 0, 0] = torch.tensor([1e9, -1e9])
    cells[1, 0, 1] = torch.tensor([1.0, 0.0])
    source, target = torch.tensor([0, 2]), torch.tensor([1, 0])
    volume = VolumeCorrelation.of(features[source], features[target])
    on_the_fly = FeatureCorrelation.of(features, source, target)
    for correlation in (volume, on_the_fly):
        expected = correlation.lookup(cells)
        answers = []
        for order in range(ORDERS):
            emulated = EmulatedLookups(order)
            with monkeypatch.context() as patched:
                patched.setattr(
                    "vipe_core.priors.droid.correlation.lookup_kernels", lambda *_, emulated=emulated: emulated
                )
                answers.append(correlation.lookup(cells))
            torch.testing.assert_close(answers[-1], expected, atol=2e-5, rtol=0)
        assert all(torch.equal(answers[0], other) for other in answers[1:])


@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_120"])
def test_the_kernels_compile_for_every_architecture_without_spilling(architecture: str) -> None:
    pytest.importorskip("cuda.core")
    for dtype in kernels.VALUE_MACROS:
        log = io.StringIO()
        code = compile_kernels(kernels.source(dtype), architecture, cache=None, log=log)
        assert code is not None
        report = log.getvalue()
        registers = [int(found) for found in re.findall(r"Used (\d+) registers", report)]
        spills = [int(found) for found in re.findall(r"(\d+) bytes spill", report)]
        assert len(registers) == len(kernels.NAMES)
        assert max(registers) <= 128
        assert not any(spills)
