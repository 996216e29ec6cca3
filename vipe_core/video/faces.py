"""The frames of a panoramic video as its six faces: synchronised views out of one decoder."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.cameras.cube import CubeFaces
from vipe_core.video.source import Frame, FrameSource, VideoInfo

Array = NDArray[Any]


class FaceSource:
    """Six views of a panorama in the order of `cameras.cube.FACES`, resampled once per frame.

    The panorama is decoded at the resolution of the faces first, by the area filter of the decoder: nothing that is too
    fine for them is left when they are sampled.

    Args:
        source: Frames of the panorama: the width is 360 degrees and the height 180, whatever their ratio.
        faces: What it is seen through.
    """

    def __init__(self, source: FrameSource, faces: CubeFaces) -> None:
        self._source = source
        self.faces = faces
        info = source.info
        self._info = dataclasses.replace(info, width=faces.size, height=faces.size)
        self._panorama_size = min(info.width, 4 * faces.size), min(info.height, 2 * faces.size)
        px = faces.panorama_px(Camera("equirect", (), *self._panorama_size)) + 1
        self._maps = [(face[..., 0].astype(np.float32), face[..., 1].astype(np.float32)) for face in px]

    @property
    def infos(self) -> tuple[VideoInfo, ...]:
        """Of the panorama, with the size of a face, for every face."""
        return (self._info,) * len(self._maps)

    def frames(
        self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None
    ) -> Generator[tuple[Frame, ...], None, None]:
        """The faces of the frames [start, stop), in order; closing the iterator ends the decoder.

        A pixel is masked where any of those that it is interpolated from is.

        Args:
            size: That of the faces, the only one that there is.

        Raises:
            InputError, DecodeError: From the source.
            ValueError: Another size.
        """
        if size not in (None, (self.faces.size, self.faces.size)):
            raise ValueError(f"the faces have {(self.faces.size, self.faces.size)} pixels, not {size}")
        with closing(self._source.frames(self._panorama_size, start, stop)) as frames:
            for frame in frames:
                masks: Sequence[NDArray[np.bool_] | None] = [None] * len(self._maps)
                if frame.masked is not None:
                    masks = [share > 0 for share in self._faces(frame.masked.astype(np.float32))]
                yield tuple(
                    Frame(frame.index, frame.timestamp_s, face, masked)
                    for face, masked in zip(self._faces(frame.rgb), masks, strict=True)
                )

    def _faces(self, picture: Array) -> list[Array]:
        import cv2

        around = _with_neighbours(picture)
        return [cv2.remap(around, u, v, cv2.INTER_LINEAR) for u, v in self._maps]


def _with_neighbours(picture: Array) -> Array:
    """The picture (h, w, ...) with the pixels that adjoin its borders: (h + 2, w + 2, ...).

    Beyond the left and right border is the other end; beyond a pole the same row goes on, half way round. Of an odd
    width, half way round lies between two columns, and the left one is taken.
    """
    height, width = picture.shape[:2]
    out = np.empty((height + 2, width + 2, *picture.shape[2:]), picture.dtype)
    out[1:-1, 1:-1] = picture
    for row, source in ((0, 0), (-1, -1)):
        out[row, 1:-1] = np.roll(picture[source], width // 2, axis=0)
    out[:, 0], out[:, -1] = out[:, -2], out[:, 1]
    return out
