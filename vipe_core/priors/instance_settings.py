"""What is looked for in a video, and how often: settings of the masks by phrases.

Apart from what uses them, so that a service can read a job without loading a library of the engine.
"""

from __future__ import annotations

from dataclasses import dataclass

from vipe_core.errors import ConfigError

PHRASES = ("person", "animal", "vehicle", "ball", "balloon", "gun", "pet", "car", "bus", "sky")
"""What the paper looks for, and the sky, which does not move but has no depth."""

STATIC_PHRASES = ("sky",)
"""Things that may be used to find poses."""

_MAX_PHRASE_LENGTH = 64


@dataclass(frozen=True, slots=True)
class InstanceSettings:
    """What is looked for, and how often.

    Attributes:
        phrases: Kinds of things, in plain words.
        interval_s: Time between detections; things that come into view in between are found at the next one.
        min_score: A box must be this sure.
        min_share: Share of the picture that a thing must cover: a cell of the bundle adjustment's smallest grid.
        min_unclaimed: Share of a new thing that nothing else covers; else it is one that is followed already.
        max_share: New things that together cover more are a misunderstanding; the sky does not count.
        patience: Detections in a row that may miss a thing that is out of sight before it is forgotten.
        margin_px: By how much masks are wider than the network's, which keep to the inside of edges.
    """

    phrases: tuple[str, ...] = PHRASES
    interval_s: float = 2.0
    min_score: float = 0.35
    min_share: float = 1 / (64 * 48)
    min_unclaimed: float = 0.8
    max_share: float = 0.4
    patience: int = 3
    margin_px: int = 2

    def __post_init__(self) -> None:
        if not self.phrases:
            raise ConfigError("there must be at least one phrase to look for; to look for nothing, choose no masks")
        for phrase in self.phrases:
            if (
                not phrase.strip()
                or len(phrase) > _MAX_PHRASE_LENGTH
                or not phrase.isprintable()
                or set(".?:") & set(phrase)
            ):
                raise ConfigError(
                    f"{phrase[:_MAX_PHRASE_LENGTH]!r} is no phrase to look for; give a few plain words without"
                    " punctuation, such as 'person' or 'red car'"
                )
        if len(set(self.phrases)) != len(self.phrases):
            raise ConfigError(f"the phrases to look for are not different ones: {', '.join(self.phrases)}")
        if not 0 < self.interval_s < float("inf"):
            raise ConfigError(f"the time between detections must be positive, got {self.interval_s} s")
