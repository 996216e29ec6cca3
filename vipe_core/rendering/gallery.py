"""Ten pictures and two films of an annotated sequence: its frames, depth, confidence, and the cloud that they make."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.formats.frames import read_frames, spread
from vipe_core.formats.reading import Artifacts
from vipe_core.rendering.canvas import Canvas, fitted, grid, save, save_animation
from vipe_core.rendering.cloud_picture import render_cloud
from vipe_core.rendering.depth_colours import DepthColours
from vipe_core.rendering.depth_video import export_depth_video
from vipe_core.rendering.overview import FOV_DEG, ZOOM, overview, paths, scene, tiles
from vipe_core.video.encode import VideoWriter

PICTURES = (
    "overview.jpg",
    "frames.jpg",
    "closeup.jpg",
    "cloud.jpg",
    "cloud_left.jpg",
    "cloud_right.jpg",
    "cloud_above.jpg",
    "cloud_shape.jpg",
    "turn.jpg",
    "turn.webp",
)
FILMS = ("turn.mp4", "depth.mp4")

_COLUMNS = 4
_CLOSE_PX = 640
_MARGIN = 6
_FILM_FPS = 20.0
_ASIDE_DEG, _QUARTER_DEG, _ABOVE_DEG = 30.0, 120.0, 68.0


@dataclass(frozen=True, slots=True)
class GallerySizes:
    """Pixels of the pictures and frames of the film; the defaults are for people, smaller ones for tests.

    Attributes:
        still: (width, height) of each view of the cloud.
        film: (width, height) of the rotating film.
        film_frames: How many.
        animation_width: Of the animated picture.
        animation_step: It has every n-th frame of the film.
    """

    still: tuple[int, int] = (1200, 840)
    film: tuple[int, int] = (640, 448)
    film_frames: int = 72
    animation_width: int = 384
    animation_step: int = 3


def write_gallery(
    artifacts: Artifacts,
    folder: str | Path,
    *,
    sizes: GallerySizes | None = None,
) -> list[Path]:
    """Write `NAME_overview.jpg` and the rest of `PICTURES` and `FILMS` into `folder`; returns them in this order.

    Of a sequence with cuts they show the longest shot.

    Raises:
        FormatError: No depth or no rgb.
    """
    gallery = _Gallery(artifacts.longest_shot(), Path(folder), sizes or GallerySizes())
    gallery.draw()
    return [gallery.path(name) for name in (*PICTURES, *FILMS)]


class _Gallery:
    def __init__(self, artifacts: Artifacts, folder: Path, sizes: GallerySizes) -> None:
        self._artifacts, self._folder, self._sizes = artifacts, folder, sizes
        folder.mkdir(parents=True, exist_ok=True)
        wanted = spread(artifacts.num_frames, _COLUMNS)
        with closing(read_frames(artifacts, wanted.__contains__)) as frames:
            self._frames = list(frames)
        self._colours = DepthColours.of(artifacts)
        self._cloud, self._stage = scene(artifacts)

    def path(self, name: str) -> Path:
        return self._folder / f"{self._artifacts.name}_{name}"

    def draw(self) -> None:
        columns = [tiles(frame, self._colours) for frame in self._frames]
        rows = [[column[row] for column in columns] for row in range(len(columns[0]))]
        save(grid(rows, margin=_MARGIN), self.path("frames.jpg"))
        middle = self._frames[len(self._frames) // 2]
        large = tiles(middle, self._colours, min(_CLOSE_PX, middle.rgb.shape[1]))
        save(grid([large], margin=_MARGIN), self.path("closeup.jpg"))
        self._views()
        self._film()
        export_depth_video(self._artifacts, self.path("depth.mp4"), beside_rgb=True)

    def _views(self) -> None:
        viewer = Camera.pinhole_from_fov(FOV_DEG, *self._sizes.still)
        stage = self._stage
        azimuth, elevation = stage.best(viewer)
        turn = _QUARTER_DEG if stage.all_around else _ASIDE_DEG
        main = stage.around(azimuth, elevation, viewer, zoom=ZOOM)
        views = {
            "cloud.jpg": main,
            "cloud_left.jpg": stage.around(azimuth + turn, elevation, viewer, zoom=ZOOM),
            "cloud_right.jpg": stage.around(azimuth - turn, elevation, viewer, zoom=ZOOM),
            "cloud_above.jpg": stage.around(0.0, _ABOVE_DEG, viewer),
        }
        for name, pose in views.items():
            picture = self._drawn(pose, viewer)
            save(picture, self.path(name))
            if pose is main:
                save(overview(self._frames, self._colours, picture), self.path("overview.jpg"))
        save(render_cloud(self._cloud, main, viewer, clay=True), self.path("cloud_shape.jpg"))

    def _film(self) -> None:
        sizes = self._sizes
        viewer = Camera.pinhole_from_fov(FOV_DEG, *sizes.film)
        poses = self._stage.turntable(sizes.film_frames, *self._stage.best(viewer), viewer, zoom=ZOOM)
        small: list[Canvas] = []
        with VideoWriter(self.path("turn.mp4"), _FILM_FPS, crf=18) as film:
            for k, pose in enumerate(poses):
                last = round(k * (self._artifacts.num_frames - 1) / max(1, len(poses) - 1))
                picture = self._drawn(pose, viewer, upto=last)
                film.write(picture)
                if k % sizes.animation_step == 0:
                    small.append(fitted(picture, sizes.animation_width))
        save_animation(small, self.path("turn.webp"), fps=_FILM_FPS / sizes.animation_step)
        shown = [small[k] for k in sorted(spread(len(small), 6))]
        save(grid([shown[:3], shown[3:]] if len(shown) > 3 else [shown], margin=_MARGIN), self.path("turn.jpg"))

    def _drawn(self, pose: NDArray[np.float64], viewer: Camera, upto: int | None = None) -> Canvas:
        return render_cloud(self._cloud, pose, viewer, paths=paths(self._artifacts, self._stage, upto=upto))
