"""The SLAM stage of a panorama: its six faces are a rigid rig of known cameras (paper section 3.2.6).

What the faces find is handed on as the map of the panorama: inverse distances on a grid all round. Dense depth then
works on the panorama itself, whose rays have no borders, so that there is nothing to stitch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.cameras.cube import CubeFaces
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import PriorFamily
from vipe_core.slam.infill import Trajectory
from vipe_core.slam.panorama_shots import find_shots, one_after_the_other, report_of_shot
from vipe_core.slam.rig_system import RigCameras, RigSlam, RigSlamResult
from vipe_core.slam.selection import Report
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import SlamResult
from vipe_core.slam.working import WorkingSize
from vipe_core.video.faces import FaceSource
from vipe_core.video.source import FrameSource
from vipe_core.video.views import FrameView

Array = NDArray[Any]

# Pixels of a panorama, and of its faces together, beside those of an ordinary picture: it sees ten times as much.
_AREA = 2.0
# Inverse distances that differ by less are one surface, and faces that see it share the answer.
_SAME_SURFACE = 0.1


class FaceBlender:
    """Carries values on the cells of six faces to the cells of a panorama.

    Args:
        faces: At their working size.
        panorama: Equirectangular, at its working size.
    """

    def __init__(self, faces: CubeFaces, panorama: Camera) -> None:
        self._side = faces.size // 8
        self._shape = (panorama.height // 8, panorama.width // 8)
        px, self._weight, self._cosine = faces.seen(panorama.rays(*self._shape))
        # Index coordinates on the grid of cells, whose borders are those of the picture.
        cell = np.clip((px + 0.5) / 8 - 0.5, 0, self._side - 1)
        whole = np.minimum(np.floor(cell), self._side - 2).astype(np.int64)
        share = cell - whole
        self._corners = []
        for down in (0, 1):
            for right in (0, 1):
                index = (whole[..., 1] + down) * self._side + whole[..., 0] + right
                along = np.where(right, share[..., 0], 1 - share[..., 0])
                self._corners.append((index, along * np.where(down, share[..., 1], 1 - share[..., 1])))
        self._middle = np.argmax(self._weight, axis=0)
        nearest = np.rint(cell).astype(np.int64)
        self._nearest = nearest[..., 1] * self._side + nearest[..., 0]

    def distances(self, inverse_depth: Array, confidence: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Inverse distance and confidence (h8, w8) all round, 0 where no face is confident.

        Args:
            inverse_depth: (6, P) of one instant, along the axes of the faces.
            confidence: (6, P); 0 where nothing is known.
        """
        shares, values = [], []
        trust = np.zeros_like(self._weight)
        for index, share in self._corners:
            sure = np.take_along_axis(confidence[:, None], index.reshape(len(index), 1, -1), 2).reshape(index.shape)
            found = np.take_along_axis(inverse_depth[:, None], index.reshape(len(index), 1, -1), 2).reshape(index.shape)
            shares.append(share * (sure > 0))
            values.append(found)
            trust += share * sure
        total = np.sum(shares, axis=0)
        mean = np.sum([share * value for share, value in zip(shares, values, strict=True)], axis=0)
        # Most of a cell must be known.
        known = (total > 0.5) & (self._weight > 0)
        distance = np.where(known, mean / np.where(known, total, 1), 0) * np.where(self._weight > 0, self._cosine, 0)
        belief = np.where(known, trust * self._weight, 0)
        best = np.argmax(belief, axis=0)[None]
        leading = np.take_along_axis(distance, best, 0)
        same = known & (np.abs(distance - leading) <= _SAME_SURFACE * leading)
        belief = np.where(same, belief, 0)
        summed = belief.sum(axis=0)
        blended = (belief * distance).sum(axis=0) / np.where(summed > 0, summed, 1)
        return blended.astype(np.float32), np.where(summed > 0, summed, 0).astype(np.float32)

    def labels(self, labels: NDArray[np.int8]) -> NDArray[np.int8]:
        """(h8 w8) of one frame: what the face that sees a cell best says of it; `labels` is (6, P)."""
        nearest = np.take_along_axis(self._nearest, self._middle[None], 0)
        return np.asarray(labels[self._middle.ravel(), nearest.ravel()], np.int8)


class PanoramaSlam:
    """The stage for panoramas; reusable for any number of videos, one at a time. Shots are worked on one by one.

    Args:
        priors: Makes a new family.
    """

    def __init__(self, priors: Callable[[], PriorFamily], settings: SlamSettings, device: torch.device) -> None:
        self._priors = priors
        self._rig = RigSlam(priors(), settings, device)
        self._area_px = round(_AREA * settings.working_area_px)

    def run(self, source: FrameSource, report: Report) -> SlamResult:
        """Pose every frame of the video, whose width is 360 degrees and whose height is 180, whatever their ratio.

        The camera of the result is `equirect` at the working size, which is twice as wide as high.

        Args:
            report: Told the stage and how far it is; what it raises ends the run.

        Raises:
            InputError, DecodeError: From the source; EmptyMedia when it holds no frame.
        """
        faces = CubeFaces.for_panorama(source.info.width, self._area_px)
        shots = find_shots(source, self._priors().matcher, report)
        if len(shots) == 1:
            return self._shot(source, faces, report)
        results = [
            self._shot(FrameView(source, start=start, stop=stop), faces, report_of_shot(report, shots, number))
            for number, (start, stop) in enumerate(shots)
        ]
        return one_after_the_other(results)

    def _shot(self, source: FrameSource, faces: CubeFaces, report: Report) -> SlamResult:
        cameras = RigCameras(
            cam_from_rig=inverse(faces.panorama_from_face),
            cameras=(faces.camera,) * len(faces.panorama_from_face),
            shared=True,
        )
        found = self._rig.run(FaceSource(source, faces), cameras, report)
        return joined(found, faces, panorama_size(source.info.width, self._area_px))


def panorama_size(width: int, area_px: int) -> WorkingSize:
    """Working size of a panorama `width` pixels wide: about `area_px`, two to one, whole cells, never enlarged."""
    rows = max(4, int(min(width, math.sqrt(2 * area_px)) / 16))
    return WorkingSize(16 * rows, 8 * rows)


def joined(found: RigSlamResult, faces: CubeFaces, size: WorkingSize) -> SlamResult:
    """What the faces found as the result of one equirectangular camera, in pixels of its working image."""
    camera = Camera("equirect", (), size.width, size.height)
    blender = FaceBlender(faces, camera)
    # The panorama's axes are those of the front face.
    front = found.views[0]
    maps = [
        blender.distances(
            np.stack([view.inverse_depth[k] for view in found.views]),
            np.stack([np.where(view.static[k], view.map.confidence[k], np.float32(0)) for view in found.views]),
        )
        for k in range(len(front.keyframes))
    ]
    confidence = np.stack([trust.ravel() for _, trust in maps])
    px_per_face_px = size.width / (2 * math.pi) / faces.camera.focal_px
    return dataclasses.replace(
        front,
        trajectory=_together([view.trajectory for view in found.views], blender, px_per_face_px),
        inverse_depth=np.stack([value.ravel() for value, _ in maps]),
        static=confidence > 0,
        working=size,
        camera=camera,
        focal_sigma_ratio=0.0,
        map=dataclasses.replace(found.map, confidence=confidence, residual_px=found.map.residual_px * px_per_face_px),
        rig=None,
        loops=dataclasses.replace(
            front.loops,
            residual_before_px=front.loops.residual_before_px * px_per_face_px,
            residual_after_px=front.loops.residual_after_px * px_per_face_px,
        ),
    )


def _together(views: Sequence[Trajectory], blender: FaceBlender, px_per_face_px: float) -> Trajectory:
    """How well all faces together support the poses: means over them, of the residuals over those that measure any."""
    residual_px = np.stack([view.residual_px for view in views])
    measured = np.isfinite(residual_px)
    count = measured.sum(axis=0)
    mean_px = np.where(measured, residual_px, 0).sum(axis=0) / np.maximum(count, 1) * px_per_face_px
    labels = np.stack([view.labels for view in views], axis=1)
    return Trajectory(
        views[0].cam_from_world,
        np.where(count > 0, mean_px, np.nan).astype(np.float32),
        np.mean([view.inlier_ratio for view in views], axis=0).astype(np.float32),
        np.mean([view.coverage for view in views], axis=0).astype(np.float32),
        views[0].interpolated,
        np.stack([blender.labels(of_frame) for of_frame in labels]),
    )
