"""The convolutional trunk that both encoders of the DROID network share: a picture to a grid of an eighth of its size.

Modules are named as the public checkpoint names their tensors. Norms have no parameters.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

_WIDTHS = (32, 64, 128)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut, which is a 1x1 convolution where the stride is not one."""

    def __init__(self, inputs: int, outputs: int, stride: int, *, normalised: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.downsample = None if stride == 1 else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride))
        self._normalised = normalised

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(_normed(self.conv1(x), self._normalised))
        y = functional.relu(_normed(self.conv2(y), self._normalised))
        shortcut = x if self.downsample is None else _normed(self.downsample(x), self._normalised)
        return functional.relu(shortcut + y)


class Encoder(nn.Module):
    """(B, 3, H, W) normalised pictures -> (B, outputs, H/8, W/8). Output cell (y, x) is centred on pixel (8y, 8x).

    Args:
        outputs: Channels of the answer.
        normalised: Whether every convolution but the last is followed by an instance norm.
    """

    def __init__(self, outputs: int, *, normalised: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, _WIDTHS[0], 7, 2, 3)
        self.layer1 = _layer(_WIDTHS[0], _WIDTHS[0], 1, normalised=normalised)
        self.layer2 = _layer(_WIDTHS[0], _WIDTHS[1], 2, normalised=normalised)
        self.layer3 = _layer(_WIDTHS[1], _WIDTHS[2], 2, normalised=normalised)
        self.conv2 = nn.Conv2d(_WIDTHS[2], outputs, 1)
        self._normalised = normalised

    def forward(self, pictures: Tensor) -> Tensor:
        x = functional.relu(_normed(self.conv1(pictures), self._normalised))
        answer: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return answer


def _layer(inputs: int, outputs: int, stride: int, *, normalised: bool) -> nn.Sequential:
    return nn.Sequential(
        ResidualBlock(inputs, outputs, stride, normalised=normalised),
        ResidualBlock(outputs, outputs, 1, normalised=normalised),
    )


def _normed(x: Tensor, normalised: bool) -> Tensor:
    return functional.instance_norm(x) if normalised else x
