"""Ten pictures and two films of an annotated sequence: its frames, depth, confidence, and the cloud that they make."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.formats.frames import ArtifactFrame, read_frames, spread
from vipe_core.formats.fused import fuse_cloud
from vipe_core.formats.reading import Artifacts
from vipe_core.rendering.canvas import BACKGROUND, Canvas, fitted, grid, label, save, save_animation
from vipe_core.rendering.cloud_picture import Path3D, render_cloud
from vipe_core.rendering.depth_colours import DepthColours, paint_confidence
from vipe_core.rendering.depth_video import export_depth_video
from vipe_core.rendering.viewpoints import Stage, foreground
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

_FOV_DEG = 42.0
_COLUMNS = 4
_TILE_PX = 320
_FILM_FPS = 20.0
_ZOOM = 1.04
_FRUSTUM = 0.055  # of the extent of the scene


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
    animation_width: int = 400
    animation_step: int = 3


def write_gallery(
    artifacts: Artifacts,
    folder: str | Path,
    *,
    sizes: GallerySizes | None = None,
) -> list[Path]:
    """Write `NAME_overview.jpg` and the rest of `PICTURES` and `FILMS` into `folder`; returns them in this order.

    Raises:
        FormatError: No depth or no rgb.
    """
    gallery = _Gallery(artifacts, Path(folder), sizes or GallerySizes())
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
        poses = artifacts.world_from_cam
        cloud = fuse_cloud(artifacts)
        self._cloud = cloud.where(foreground(cloud, poses))
        self._stage = Stage.of(cloud, poses)
        self._poses = poses

    def path(self, name: str) -> Path:
        return self._folder / f"{self._artifacts.name}_{name}"

    def draw(self) -> None:
        save(self._sheet(), self.path("frames.jpg"))
        save(self._closeup(), self.path("closeup.jpg"))
        self._views()
        self._film()
        export_depth_video(self._artifacts, self.path("depth.mp4"), beside_rgb=True)

    def _tiles(self, frame: ArtifactFrame, width: int) -> list[Canvas]:
        """The frame, its depth, and its confidence where there is one."""
        depth = self._colours.paint(frame.depth, kind=frame.kind, moving=frame.moving)
        tiles = [
            label(fitted(frame.rgb, width), f"frame {frame.index}"),
            label(fitted(depth, width), "depth"),
        ]
        if frame.confidence is not None:
            tiles.append(label(fitted(paint_confidence(frame.confidence), width), "confidence"))
        return tiles

    def _sheet(self) -> Canvas:
        columns = [self._tiles(frame, _TILE_PX) for frame in self._frames]
        return grid([[column[row] for column in columns] for row in range(len(columns[0]))], margin=6)

    def _closeup(self) -> Canvas:
        frame = self._frames[len(self._frames) // 2]
        return grid([self._tiles(frame, min(640, frame.rgb.shape[1]))], margin=6)

    def _views(self) -> None:
        width, height = self._sizes.still
        viewer = Camera.pinhole_from_fov(_FOV_DEG, width, height)
        stage = self._stage
        azimuth, elevation = stage.best(viewer)
        turn_deg = 120.0 if stage.all_around else 30.0
        main = stage.around(azimuth, elevation, viewer, zoom=_ZOOM)
        views = {
            "cloud.jpg": main,
            "cloud_left.jpg": stage.around(azimuth + turn_deg, elevation, viewer, zoom=_ZOOM),
            "cloud_right.jpg": stage.around(azimuth - turn_deg, elevation, viewer, zoom=_ZOOM),
            "cloud_above.jpg": stage.around(0.0, 68.0, viewer),
        }
        drawn = {name: self._drawn(pose, viewer) for name, pose in views.items()}
        for name, picture in drawn.items():
            save(picture, self.path(name))
        save(render_cloud(self._cloud, main, viewer, clay=True), self.path("cloud_shape.jpg"))
        save(self._overview(drawn["cloud.jpg"]), self.path("overview.jpg"))

    def _overview(self, cloud: Canvas) -> Canvas:
        """Frames over their depth, and the cloud beside them."""
        gap, margin = 6, 8
        tiles = [self._tiles(frame, _TILE_PX)[:2] for frame in self._frames[:: max(1, len(self._frames) - 1)]]
        left = grid([list(pair) for pair in zip(*tiles, strict=True)], gap)
        width = round(cloud.shape[1] * left.shape[0] / cloud.shape[0])
        right = fitted(cloud, width)[: left.shape[0]]
        height = min(left.shape[0], right.shape[0])
        canvas = np.empty((height + 2 * margin, left.shape[1] + gap + width + 2 * margin, 3), np.uint8)
        canvas[:] = BACKGROUND
        canvas[margin:-margin, margin : margin + left.shape[1]] = left[:height]
        canvas[margin:-margin, margin + left.shape[1] + gap : -margin] = right[:height]
        return canvas

    def _film(self) -> None:
        sizes = self._sizes
        viewer = Camera.pinhole_from_fov(_FOV_DEG, *sizes.film)
        poses = self._stage.turntable(sizes.film_frames, *self._stage.best(viewer), viewer, zoom=_ZOOM)
        small: list[Canvas] = []
        with VideoWriter(self.path("turn.mp4"), _FILM_FPS, crf=18) as film:
            for k, pose in enumerate(poses):
                last = round(k * (len(self._poses) - 1) / max(1, len(poses) - 1))
                picture = self._drawn(pose, viewer, upto=last)
                film.write(picture)
                if k % sizes.animation_step == 0:
                    small.append(fitted(picture, sizes.animation_width))
        save_animation(small, self.path("turn.webp"), fps=_FILM_FPS / sizes.animation_step)
        shown = [small[k] for k in sorted(spread(len(small), 6))]
        save(grid([shown[:3], shown[3:]] if len(shown) > 3 else [shown], margin=6), self.path("turn.jpg"))

    def _drawn(self, pose: NDArray[np.float64], viewer: Camera, upto: int | None = None) -> Canvas:
        path = Path3D(self._poses, self._artifacts.camera, _FRUSTUM * self._stage.extent, upto=upto)
        return render_cloud(self._cloud, pose, viewer, path=path)
