"""A length in metres that the user knows, as text: what `--scale-from` and `scale_from` take."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

from vipe_core.errors import ConfigError

KnownKind = Literal["path", "height", "depth"]

FORMS = "path=METRES, height=METRES or depth=METRES@X,Y,FRAME"

_NUMBER = r"[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?|\.[0-9]+(?:[eE][-+]?[0-9]+)?"
_TEXT = re.compile(rf"(path|height|depth)=({_NUMBER})(?:@({_NUMBER}),({_NUMBER}),([0-9]+))?")


@dataclass(frozen=True, slots=True)
class KnownLength:
    """One known length.

    Attributes:
        kind: `path` is the length of the camera's path, `height` the camera's height above the ground, `depth` the
            distance from the camera to what one pixel shows.
        metres: Positive.
        place: (x, y, frame) of a `depth`, None for the others: pixels of the source video with half-pixel centres,
            (0.5, 0.5) is the middle of the first; frames from 0.
    """

    kind: KnownKind
    metres: float
    place: tuple[float, float, int] | None = None

    @classmethod
    def parse(cls, text: str) -> KnownLength:
        """Read one of `FORMS`.

        Raises:
            ConfigError: It is none of them; the message shows them.
        """
        found = _TEXT.fullmatch(text.strip())
        if found is None or (found[1] == "depth") != (found[3] is not None):
            raise ConfigError(f"scale from {text!r} is not understood; say {FORMS}")
        metres = float(found[2])
        if not (math.isfinite(metres) and metres > 0):
            raise ConfigError(f"scale from {text!r} needs a positive number of metres")
        if found[3] is None:
            return cls("path" if found[1] == "path" else "height", metres)
        return cls("depth", metres, (float(found[3]), float(found[4]), int(found[5])))

    def __str__(self) -> str:
        place = "" if self.place is None else "@{:.9g},{:.9g},{}".format(*self.place)
        return f"{self.kind}={self.metres:.9g}{place}"
