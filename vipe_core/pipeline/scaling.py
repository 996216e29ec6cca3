"""Which scale a result has: metres from what the user knows or from metric depth, else the map's own unit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from vipe_core.annotation import Scale
from vipe_core.depth.ground import scale_from_height
from vipe_core.depth.known import KnownLength
from vipe_core.depth.scale import (
    FrameRatio,
    ScaleEstimate,
    believed_cells,
    normalised,
    ratio_to_prior,
    rescaled,
    scale_from_path,
    scale_from_pixel,
    scale_from_ratios,
    shots_of,
)
from vipe_core.depth.types import SceneMap
from vipe_core.errors import ScaleUnobservable
from vipe_core.priors.protocols import MetricDepth
from vipe_core.video.resampled import ResampledView
from vipe_core.video.source import FrameSource

# Pictures of a shot that are given to metric depth: their errors are far from independent, so more say little more.
_MAX_PICTURES = 32
# The size of a rig tells metres only where the map is that sure of it.
_SURE_OF_SIZE = 0.2


@dataclass(frozen=True, slots=True)
class ScaledScene:
    """A map with its scale.

    Attributes:
        scene: In metres, or normalised.
        scale: Which of them.
        source: What the scale was taken from: `normalised`, `metric_depth`, `rig`, or the known length as text.
        sigma_ratio: Standard deviation of the logarithm of the scale, of the worst shot; NaN for `normalised`.
    """

    scene: SceneMap
    scale: Scale
    source: str
    sigma_ratio: float


@dataclass(frozen=True, slots=True)
class RigSize:
    """What the extrinsics of a rig say of the scale.

    Attributes:
        metric: They are metres.
        units: Length of the map's unit in theirs.
        sigma_ratio: Standard deviation of the logarithm of that; infinite where the size of the rig is not seen.
    """

    metric: bool
    units: float
    sigma_ratio: float


def set_scale(
    scene: SceneMap,
    source: FrameSource,
    known: KnownLength | None,
    metric: MetricDepth | None,
    report: Callable[[str, int, int | None], None],
) -> ScaledScene:
    """The map in metres where something tells them, else normalised; what the user knows comes first.

    Raises:
        ScaleUnobservable: The known length is not to be found in the video. Metric depth that says nothing is no error:
            the scale is relative then.
        InputError, DecodeError: From the source, which is read for metric depth.
    """
    # In these units the estimators need no thought for those of bundle adjustment.
    scene = normalised(scene)
    if known is not None:
        estimates = _from_known(scene, source, known)
        name = str(known)
    elif metric is not None:
        found = _from_metric(scene, source, metric, report)
        if found is None:
            return ScaledScene(scene, "relative", "normalised", float("nan"))
        estimates, name = found, "metric_depth"
    else:
        return ScaledScene(scene, "relative", "normalised", float("nan"))
    scaled = rescaled(scene, [estimate.metres_per_unit for estimate in estimates])
    return ScaledScene(scaled, "metric", name, max(estimate.sigma_ratio for estimate in estimates))


def set_rig_scale(
    scenes: Sequence[SceneMap],
    source: FrameSource,
    known: KnownLength | None,
    metric: MetricDepth | None,
    size: RigSize,
    report: Callable[[str, int, int | None], None],
) -> tuple[list[ScaledScene], float]:
    """The maps of the views of a rig, brought to one scale.

    It is that of what the user knows of the first view, else of the size of the rig where that is known and seen, else
    of metric depth, else of the first view's normalisation.

    Args:
        scenes: All in one world and one unit.
        source: The first view.

    Returns:
        The maps, and by how much their lengths were multiplied.

    Raises:
        ScaleUnobservable: The known length is not to be found in the first view.
        InputError, DecodeError: From the source, which is read for metric depth.
    """
    if known is None and size.metric and size.sigma_ratio <= _SURE_OF_SIZE:
        first = ScaledScene(scenes[0], "metric", "rig", size.sigma_ratio)
        factor = size.units
    else:
        first = set_scale(scenes[0], source, known, metric, report)
        seen = scenes[0].inverse_depth > 0
        before, after = scenes[0].inverse_depth[seen], first.scene.inverse_depth[seen]
        factor = float(np.median(before) / np.median(after)) if len(before) else 1.0
    scaled = []
    for scene in scenes:
        world_from_cam = scene.world_from_cam.copy()
        world_from_cam[:, :3, 3] *= factor
        inverse_depth = (scene.inverse_depth / np.float32(factor)).astype(np.float32)
        moved = dataclasses.replace(scene, world_from_cam=world_from_cam, inverse_depth=inverse_depth)
        scaled.append(dataclasses.replace(first, scene=moved))
    return scaled, factor


def _from_known(scene: SceneMap, source: FrameSource, known: KnownLength) -> list[ScaleEstimate]:
    """One estimate per shot."""
    try:
        if known.place is not None:
            x, y, frame = known.place
            size = (source.info.width, source.info.height)
            at = source.seen_at(x, y) if isinstance(source, ResampledView) else (x, y)
            if at is None:
                raise ScaleUnobservable(
                    f"pixel ({x:g}, {y:g}) is not in the picture, or the calibration has no ray there"
                )
            return [scale_from_pixel(scene, at, frame, known.metres, size)]
        if known.kind == "path":
            return [scale_from_path(scene, known.metres)]
        return [scale_from_height(scene, shot, known.metres) for shot in shots_of(scene)]
    except ScaleUnobservable as error:
        raise ScaleUnobservable(f"{source.info.name}: scale from {known}: {error}") from error


def _from_metric(
    scene: SceneMap, source: FrameSource, metric: MetricDepth, report: Callable[[str, int, int | None], None]
) -> list[ScaleEstimate] | None:
    """One estimate per shot, or None where one of them has none: a video has one kind of scale."""
    wanted: dict[int, tuple[int, int]] = {}
    cells = {}
    for number, shot in enumerate(shots_of(scene)):
        keyframes, believed = believed_cells(scene, shot)
        spread = np.unique(np.linspace(0, len(keyframes) - 1, min(len(keyframes), _MAX_PICTURES)).round().astype(int))
        for i in spread:
            k = int(keyframes[i])
            wanted[int(scene.keyframes[k])] = (number, k)
            cells[k] = believed[i]
    ratios: dict[int, list[FrameRatio]] = {number: [] for number in range(len(shots_of(scene)))}
    size = metric.input_size(source.info.width, source.info.height)
    camera = scene.camera.resized(*size)
    done = 0
    with closing(source.frames(size=size, stop=max(wanted, default=-1) + 1)) as frames:
        for frame in frames:
            if frame.index not in wanted:
                continue
            number, k = wanted[frame.index]
            ratio = ratio_to_prior(scene, k, cells[k], metric.estimate(frame.rgb, camera), metric.depth_kind)
            if ratio is not None:
                ratios[number].append(ratio)
            done += 1
            report("scale", done, len(wanted))
    found = [scale_from_ratios(heard, metric.shared_sigma_ratio) for heard in ratios.values()]
    estimates = [estimate for estimate in found if estimate is not None]
    return estimates if len(estimates) == len(found) else None
