"""The DROID network: both encoders and the update operator, with the precision that they run in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional

from vipe_core.priors.droid.encoder import Encoder
from vipe_core.priors.droid.graphs import GraphCache
from vipe_core.priors.droid.update import HIDDEN, Updated, UpdateOperator
from vipe_core.transfer import uploaded

FEATURES = 128
"""Channels of what is correlated."""

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
# Edges and frames come in multiples of these where graphs are captured: few shapes, which repeat.
_EDGE_STEP, FRAME_STEP = 16, 8
# Motion beyond this many cells is not told apart.
_MAX_MOTION = 64.0


class DroidNetwork(nn.Module):
    """Feature encoder, context encoder and update operator; a module for inference.

    Float32 on a CPU. On a GPU, 16-bit arithmetic where it is safe; positions, corrections and weights stay float32.
    """

    def __init__(self) -> None:
        super().__init__()
        self.fnet = Encoder(FEATURES, normalised=True)
        self.cnet = Encoder(2 * HIDDEN, normalised=False)
        self.update = UpdateOperator()
        self.register_buffer("_mean", torch.tensor(_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("_std", torch.tensor(_STD).view(1, 3, 1, 1), persistent=False)
        self._mean: Tensor
        self._std: Tensor
        self._graphs: GraphCache | None = None
        self.requires_grad_(False)
        self.eval()

    @classmethod
    def random(cls, seed: int) -> DroidNetwork:
        """One with weights that mean nothing, the same for a seed: for tests and measurements of speed."""
        state = torch.get_rng_state()
        try:
            torch.manual_seed(seed)
            return cls()
        finally:
            torch.set_rng_state(state)

    @property
    def device(self) -> torch.device:
        return self._mean.device

    @property
    def dtype(self) -> torch.dtype:
        """Of features and states: float16, whose rounding the network was trained with; float32 on a CPU."""
        return torch.float32 if self.device.type == "cpu" else torch.float16

    def ready(self, device: torch.device) -> DroidNetwork:
        """The network on a device, laid out for it."""
        self.to(device)
        if device.type == "cuda":
            for parameter in self.parameters():
                if parameter.ndim == 4:
                    parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
            self._graphs = GraphCache(self._step)
        return self

    def normalised(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W) pictures for the encoders of uint8 ones (RGB)."""
        layout = torch.channels_last if self.device.type == "cuda" else torch.contiguous_format
        wide = uploaded(pictures, self.device).float().contiguous(memory_format=layout)
        return (wide / 255 - self._mean) / self._std

    def features(self, pictures: Tensor) -> Tensor:
        """(B, 128, H/8, W/8) what is correlated, of normalised pictures."""
        with self._precision():
            found: Tensor = self.fnet(pictures)
        return found.to(self.dtype)

    def context(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 128, H/8, W/8) each: where the states of a frame's edges begin, and their context."""
        with self._precision():
            found: Tensor = self.cnet(pictures)
            begin, context = found[:, :HIDDEN], found[:, HIDDEN:]
            return begin.tanh().to(self.dtype), context.relu().to(self.dtype)

    def step(self, hidden: Tensor, context: Tensor, correlation: Tensor, motion: Tensor, share: Tensor) -> Updated:
        """One update; see `UpdateOperator`. `motion` is of any size.

        Graphs are captured for a few numbers of edges and frames; others are filled up with edges of nothing.
        """
        with torch.inference_mode():
            if self._graphs is None:
                return Updated(*self._step(hidden, context, correlation, motion, share))
            frames, edges = share.shape
            more = -edges % _EDGE_STEP
            filled = [_filled(given, more) for given in (hidden, context, correlation, motion)]
            share = functional.pad(share, (0, more, 0, -frames % FRAME_STEP))
            state, delta, weight, damping = self._graphs(*filled, share)
            return Updated(state[:edges], delta[:edges], weight[:edges], damping[:frames])

    def _step(
        self, hidden: Tensor, context: Tensor, correlation: Tensor, motion: Tensor, share: Tensor
    ) -> tuple[Tensor, ...]:
        with self._precision():
            near = motion.clamp(-_MAX_MOTION, _MAX_MOTION).to(self.dtype)
            updated: Updated = self.update(hidden, context, correlation, near, share)
        return updated.hidden, updated.delta, updated.weight, updated.damping

    @contextmanager
    def _precision(self) -> Iterator[None]:
        with torch.inference_mode():
            if self.device.type == "cpu":
                yield
                return
            # Weights cast once and kept would belong to the graph in which that happened.
            with torch.autocast(self.device.type, dtype=self.dtype, cache_enabled=False):
                yield


def _filled(given: Tensor, more: int) -> Tensor:
    """With so many more rows of zeros."""
    return functional.pad(given, (0, 0, 0, 0, 0, 0, 0, more)) if more else given
