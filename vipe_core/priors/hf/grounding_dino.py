"""Boxes around what phrases name, by GroundingDINO (Liu et al., 2023) as `transformers` has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.errors import ConfigError
from vipe_core.priors.hf.images import fitted, normalised
from vipe_core.priors.hf.loading import network, tokenizer, transformers
from vipe_core.priors.instances import Detection

SHORTEST, LONGEST = 800, 1333
"""Sides of the pictures that the public weights were trained with."""


@dataclass(frozen=True, slots=True)
class _Text:
    """Phrases as the network reads them.

    Attributes:
        inputs: Of the tokenizer.
        spans: First token of each phrase, and one past its last.
    """

    inputs: dict[str, Tensor]
    spans: tuple[tuple[int, int], ...]


class GroundingDino:
    """`Detector` by GroundingDINO.

    Args:
        model: `GroundingDinoForObjectDetection`.
        words: Its tokenizer.
        shortest, longest: Sides of the pictures that it is given.
    """

    def __init__(
        self, model: Any, words: Any, device: torch.device, shortest: int = SHORTEST, longest: int = LONGEST
    ) -> None:
        self._model = model
        self._words = words
        self._device = device
        self._sides = (shortest, longest)
        self._texts: dict[tuple[str, ...], _Text] = {}

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> GroundingDino:
        """The network in a folder.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = transformers("GroundingDinoForObjectDetection")
        # Its attention over the text loses boxes in half precision, and it runs once in many frames.
        return cls(network(kind, folder, device, torch.float32), tokenizer(folder), device)

    def detect(self, rgb: NDArray[np.uint8], phrases: Sequence[str], min_score: float) -> list[Detection]:
        """See `Detector.detect`. A box is of the phrase that has its surest word.

        Raises:
            ConfigError: The phrases are longer than the network can read.
        """
        text = self._text(tuple(phrases))
        height, width = rgb.shape[:2]
        picture = normalised(rgb, fitted(width, height, *self._sides), self._device)
        with torch.inference_mode():
            found = self._model(pixel_values=picture, **text.inputs)
            word_scores = found.logits[0].float().sigmoid()
            scores = torch.stack([word_scores[:, start:stop].amax(dim=1) for start, stop in text.spans], dim=1)
            score, which = scores.max(dim=1)
            centre, size = found.pred_boxes[0].float().split(2, dim=1)
            boxes = torch.cat((centre - size / 2, centre + size / 2), dim=1).clamp(0, 1)
            boxes = boxes * boxes.new_tensor([width, height, width, height])
            kept = (score > min_score) & (boxes[:, 2:] > boxes[:, :2]).all(dim=1)
            numbers = torch.cat((boxes, score[:, None], which[:, None].float()), dim=1)[kept].cpu().tolist()
        return [Detection((row[0], row[1], row[2], row[3]), row[4], phrases[int(row[5])]) for row in numbers]

    def _text(self, phrases: tuple[str, ...]) -> _Text:
        if phrases not in self._texts:
            # One set of phrases at a time is in use.
            self._texts = {phrases: self._read(phrases)}
        return self._texts[phrases]

    def _read(self, phrases: tuple[str, ...]) -> _Text:
        """Every phrase ends with a full stop: between the stops are its tokens."""
        caption = " ".join(f"{phrase.strip().lower()}." for phrase in phrases)
        read = self._words(caption, return_tensors="pt", return_token_type_ids=True)
        numbers = read["input_ids"][0].tolist()
        stop = self._words.convert_tokens_to_ids(".")
        ends = [place for place, number in enumerate(numbers) if number == stop]
        starts = [1, *(end + 1 for end in ends)][: len(ends)]
        spans = tuple(zip(starts, ends, strict=True))
        longest = self._model.config.max_text_len
        if len(numbers) > longest:
            raise ConfigError(f"the phrases to look for are {len(numbers)} words and parts of words; {longest} can be")
        if len(spans) != len(phrases) or any(start >= end for start, end in spans):
            raise ConfigError(f"the phrases to look for cannot be told apart: {caption}")
        inputs = {name: read[name].to(self._device) for name in ("input_ids", "token_type_ids", "attention_mask")}
        return _Text(inputs, spans)
