"""Matches between two pictures for metrics that need no ground truth: learned where installed, SIFT otherwise."""

from __future__ import annotations

import importlib.util
import logging
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import ConfigError

logger = logging.getLogger(__name__)

Array = NDArray[Any]

MATCHERS = ("auto", "lightglue", "sift")
_MAX_POINTS = 2048
# A nearest neighbour must be this much nearer than the second one (Lowe 2004).
_RATIO = 0.8


class PointMatcher(Protocol):
    """Finds points that two pictures have in common.

    Attributes:
        kind: What `point_matcher` makes another one of.
        name: For reports: figures by different matchers do not compare.
    """

    @property
    def kind(self) -> str: ...

    @property
    def name(self) -> str: ...

    def detect(self, rgb: NDArray[np.uint8]) -> Any:
        """Points and descriptors of a picture, computed once for both of its neighbours."""

    def match(self, first: Any, second: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K, 2) and (K, 2) integer-index pixel coordinates of the same points."""


class SiftMatcher:
    """SIFT with the ratio test in both directions. No geometry is imposed, so nothing is hidden from the metric."""

    kind = "sift"
    name = "SIFT"

    def __init__(self) -> None:
        self._sift = cv2.SIFT.create(nfeatures=_MAX_POINTS)
        self._nearest = cv2.BFMatcher(cv2.NORM_L2)

    def detect(self, rgb: NDArray[np.uint8]) -> Any:
        points, descriptors = self._sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        px = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
        return px, np.zeros((0, 128), np.float32) if descriptors is None else descriptors

    def match(self, first: Any, second: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        there = self._clear(first[1], second[1])
        back = self._clear(second[1], first[1])
        pairs = np.array([(i, j) for i, j in there.items() if back.get(j) == i], dtype=np.int64).reshape(-1, 2)
        return first[0][pairs[:, 0]], second[0][pairs[:, 1]]

    def _clear(self, query: Array, train: Array) -> dict[int, int]:
        if len(query) < 2 or len(train) < 2:
            return {}
        found = self._nearest.knnMatch(query, train, k=2)
        return {best.queryIdx: best.trainIdx for best, second in found if best.distance < _RATIO * second.distance}


class LightGlueMatcher:
    """LightGlue on DISK features, from kornia; its weights are fetched by kornia when they are not cached.

    Raises:
        ConfigError: kornia is not installed, or its weights cannot be had.
    """

    kind = "lightglue"
    name = "LightGlue (DISK)"

    def __init__(self, device: str = "cpu") -> None:
        import torch

        try:
            from kornia.feature import DISK, LightGlue
        except ImportError as error:
            raise ConfigError("the matcher lightglue needs kornia; install kornia, or use sift") from error
        try:
            self._disk = DISK.from_pretrained("depth").eval().to(device)
            self._glue = LightGlue("disk").eval().to(device)
        except Exception as error:  # a download fails in as many ways as there are proxies
            raise ConfigError(
                f"the weights of lightglue cannot be loaded ({type(error).__name__}); use sift"
            ) from error
        self._torch = torch
        self._device = device

    def detect(self, rgb: NDArray[np.uint8]) -> Any:
        torch = self._torch
        image = torch.from_numpy(rgb.astype(np.float32) / 255).permute(2, 0, 1)[None].to(self._device)
        with torch.inference_mode():
            (features,) = self._disk(image, _MAX_POINTS, pad_if_not_divisible=True)
        size = torch.tensor([[rgb.shape[1], rgb.shape[0]]], device=self._device)
        return {"keypoints": features.keypoints[None], "descriptors": features.descriptors[None], "image_size": size}

    def match(self, first: Any, second: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        with self._torch.inference_mode():
            pairs = self._glue({"image0": first, "image1": second})["matches"][0].cpu().numpy()
        px = [side["keypoints"][0].cpu().numpy().astype(np.float64) for side in (first, second)]
        return px[0][pairs[:, 0]], px[1][pairs[:, 1]]


def point_matcher(name: str = "auto", device: str = "cpu") -> PointMatcher:
    """The matcher called `name`; `auto` is LightGlue where kornia and its weights are there, else SIFT.

    Raises:
        ConfigError: No such matcher, or LightGlue was asked for and is not there.
    """
    if name not in MATCHERS:
        raise ConfigError(f"unknown matcher {name!r}; on offer: {', '.join(MATCHERS)}")
    if name == "lightglue":
        return LightGlueMatcher(device)
    if name == "auto" and importlib.util.find_spec("kornia") is not None:
        try:
            return LightGlueMatcher(device)
        except ConfigError as error:
            logger.warning("%s: SIFT is used", error)
    return SiftMatcher()
