"""The recurrent update operator: one step from correlations and motion to a correction of every edge's flow.

A convolutional GRU per edge, and heads for the flow's correction, its weights, and what edges out of one frame agree on
(Teed & Deng, DROID-SLAM, NeurIPS 2021, section 3.1). Modules are named as the public checkpoint names their tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from vipe_core.priors.droid.correlation import NUM_CHANNELS

HIDDEN = 128
"""Channels of an edge's state, and of its context."""

_MOTION = 64
_DAMPING_SCALE = 0.01
_UPSAMPLING = 8 * 8 * 9


@dataclass(frozen=True, slots=True)
class Updated:
    """What one step says.

    Attributes:
        hidden: (E, 128, h, w) the next state of each edge.
        delta: (E, 2, h, w) float32 correction (x, y) of the flow, cells.
        weight: (E, 2, h, w) float32 confidence of x and y, 0..1.
        damping: (S, h, w) float32 positive, of each source frame's inverse depth.
    """

    hidden: Tensor
    delta: Tensor
    weight: Tensor
    damping: Tensor


class GlobalGru(nn.Module):
    """A ConvGRU whose gates also see a gated mean of the state over the picture."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convr = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convq = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.w = nn.Conv2d(hidden, hidden, 1)
        self.convz_glo = nn.Conv2d(hidden, hidden, 1)
        self.convr_glo = nn.Conv2d(hidden, hidden, 1)
        self.convq_glo = nn.Conv2d(hidden, hidden, 1)

    def forward(self, hidden: Tensor, inputs: Tensor) -> Tensor:
        everywhere = (self.w(hidden).sigmoid() * hidden).mean(dim=(2, 3), keepdim=True)
        both = torch.cat((hidden, inputs), dim=1)
        update = (self.convz(both) + self.convz_glo(everywhere)).sigmoid()
        reset = (self.convr(both) + self.convr_glo(everywhere)).sigmoid()
        candidate = self.convq(torch.cat((reset * hidden, inputs), dim=1)) + self.convq_glo(everywhere)
        following: Tensor = (1 - update) * hidden + update * candidate.tanh()
        return following


class FrameAggregation(nn.Module):
    """The mean over the edges out of each frame, and the damping of the frame's inverse depth that it says.

    `upmask` belongs to the checkpoint and enlarges depths of keyframes; dense depth here is measured in every frame.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(hidden, hidden, 3, padding=1)
        self.conv2 = nn.Conv2d(hidden, hidden, 3, padding=1)
        self.eta = nn.Sequential(nn.Conv2d(hidden, 1, 3, padding=1), nn.Softplus())
        self.upmask = nn.Sequential(nn.Conv2d(hidden, _UPSAMPLING, 1))

    def forward(self, hidden: Tensor, share: Tensor) -> Tensor:
        each = functional.relu(self.conv1(hidden))
        # A product with the matrix of shares: a fixed order of summation, which scattering on a GPU has not.
        mean = (share.to(each.dtype) @ each.flatten(1)).view(-1, *each.shape[1:])
        damping: Tensor = _DAMPING_SCALE * self.eta(functional.relu(self.conv2(mean)))[:, 0].float()
        return damping


class UpdateOperator(nn.Module):
    """One step of all edges of a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.corr_encoder = _head(NUM_CHANNELS, HIDDEN, HIDDEN, first=1, then=3, activated=True)
        self.flow_encoder = _head(4, HIDDEN, _MOTION, first=7, then=3, activated=True)
        self.weight = _head(HIDDEN, HIDDEN, 2)
        self.delta = _head(HIDDEN, HIDDEN, 2)
        self.gru = GlobalGru(HIDDEN, 2 * HIDDEN + _MOTION)
        self.agg = FrameAggregation(HIDDEN)

    def forward(self, hidden: Tensor, context: Tensor, correlation: Tensor, motion: Tensor, share: Tensor) -> Updated:
        """One step.

        Args:
            hidden: (E, 128, h, w) states.
            context: (E, 128, h, w) of the source frames.
            correlation: (E, 196, h, w) looked up where the geometry sees the cells.
            motion: (E, 4, h, w) where the geometry sees the cells relative to themselves (x, y), and where the last
                step saw them relative to the geometry (x, y), cells.
            share: (S, E) of each edge in the mean of its source frame: one over the number of its edges, or 0.
        """
        inputs = torch.cat((context, self.corr_encoder(correlation), self.flow_encoder(motion)), dim=1)
        hidden = self.gru(hidden, inputs)
        return Updated(
            hidden, self.delta(hidden).float(), self.weight(hidden).float().sigmoid(), self.agg(hidden, share)
        )


def shares(sources: Sequence[int]) -> Tensor:
    """(S, E) float32 on the host: each edge's share in the mean of its source frame, those in increasing order."""
    frames, row, count = np.unique(np.array(sources, np.int64), return_inverse=True, return_counts=True)
    share = torch.zeros(len(frames), len(sources))
    share[row, torch.arange(len(sources))] = torch.from_numpy((1 / count[row]).astype(np.float32))
    return share


def _head(
    inputs: int, width: int, outputs: int, *, first: int = 3, then: int = 3, activated: bool = False
) -> nn.Sequential:
    layers: list[nn.Module] = [
        nn.Conv2d(inputs, width, first, padding=first // 2),
        nn.ReLU(),
        nn.Conv2d(width, outputs, then, padding=then // 2),
    ]
    return nn.Sequential(*layers, nn.ReLU()) if activated else nn.Sequential(*layers)
