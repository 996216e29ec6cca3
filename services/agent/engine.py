"""The engine as a worker uses it: one call from a local file to artifacts on disk and one index row.

`AgentConfig.engine` names the opener by its dotted path; `open_engine` is the one that ships.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from services.agent.messages import Grant
from services.domain.models import Attribute, JobSpec, VideoRef, VideoResult, is_rig, view_key
from services.domain.states import VideoStatus
from vipe_core.errors import ConfigError

if TYPE_CHECKING:
    from vipe_core.annotation import Annotation
    from vipe_core.annotation import Progress as EngineProgress
    from vipe_core.pipeline.rig_annotator import RigAnnotator

ProgressCallback = Callable[[str, int, int | None, float], None]
"""(stage, frames done in it, frames of the video where the stage knows, share of the whole work that is done, 0..1)."""

# Where the stages that count frames lie in the whole work. Only the smoothness of a progress bar depends on it: a stage
# that is not named here leaves the bar where it is.
_SHARES: dict[str, tuple[float, float]] = {
    "scan": (0.0, 0.1),
    "track": (0.1, 0.6),
    "infill": (0.6, 0.7),
    "depth": (0.7, 1.0),
}


class Engine(Protocol):
    def annotate(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        progress: ProgressCallback,
        grant: Grant | None = None,
    ) -> VideoResult:
        """Annotate the video at `path` and write its artifacts, named by `video.key`, below `root`.

        Where `video` is a rig, `path` is a rig file that names local videos, and artifacts are named by `view_key`.

        Args:
            grant: What it may take of the GPU; None where there is none.

        Returns:
            The index row of a success, with `attempt` 0; the caller sets it.

        Raises:
            VipeError: Typed; any other exception is a defect of the engine.
        """


EngineOpener = Callable[..., Engine]
"""(preset, camera model, device) -> engine; called with `options`, a mapping, where a job changes the preset.

Raises VipeError where the combination cannot work at all.
"""


class VipeEngine:
    """`vipe_core` with one preset, camera model and device; stays warm between videos."""

    def __init__(self, annotator: RigAnnotator) -> None:
        self._annotator = annotator

    def annotate(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        progress: ProgressCallback,
        grant: Grant | None = None,
    ) -> VideoResult:
        from vipe_core.cameras.calibration import Calibration
        from vipe_core.formats.artifacts import ALL_ATTRIBUTES

        attributes = [name for name in ALL_ATTRIBUTES if name in (*spec.attributes, "pose", "intrinsics")]
        if missing := set(spec.attributes) - set(attributes):
            raise ConfigError(f"preset {spec.preset!r} does not make the attributes {', '.join(sorted(missing))}")
        if is_rig(video.uri):
            if spec.calibration is not None:
                raise ConfigError("a rig file holds the cameras of its views; submit rigs in a job without calibration")
            return self._annotate_rig(path, video, spec, root, attributes, progress, grant)
        shares = _Shares(progress)
        known = None if spec.calibration is None else Calibration.from_json(spec.calibration)
        try:
            annotation = self._annotator.annotate(
                path,
                name=video.key,
                scale_from=spec.scale_from,
                calibration=known,
                memory_bytes=None if grant is None else grant.memory_bytes,
                low_memory=grant is not None and grant.low_memory,
                progress=shares.during,
            )
            shares.write(annotation, root, attributes)
        finally:
            self._annotator.release()
        return index_row(annotation, video)

    def _annotate_rig(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        attributes: Sequence[Attribute],
        progress: ProgressCallback,
        grant: Grant | None,
    ) -> VideoResult:
        """The views of a rig as samples of their own, each with the rig that was found."""
        from vipe_core.cameras.rig import read_rig
        from vipe_core.formats.layout import rig_path

        known = read_rig(path, video.uri)
        shares = _Shares(progress, len(known.views))
        keys = [view_key(video.key, view.name) for view in known.views]
        rows = []
        try:
            found = self._annotator.annotate_rig(
                known,
                names=keys,
                scale_from=spec.scale_from,
                memory_bytes=None if grant is None else grant.memory_bytes,
                progress=shares.during,
            )
            document = json.dumps(found.rig.to_json(), indent=1) + "\n"
            for view, key, annotation in zip(known.views, keys, found.views, strict=True):
                shares.write(annotation, root, attributes)
                rig_path(root, key).write_text(document, encoding="utf-8")
                row = index_row(annotation, replace(video, key=key))
                rows.append(replace(row, rig=video.key, view=view.name))
        finally:
            self._annotator.release()
        return rig_row(rows, video)


class _Shares:
    """Turns the progress of stages into that of the whole work."""

    def __init__(self, progress: ProgressCallback, num_views: int = 1) -> None:
        self._progress = progress
        self._views = num_views
        self._written = 0
        self._share = 0.0

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        """Of a stage that all views go through together, `done` and `total` are instants."""
        begin, end = _SHARES.get(stage, (0.0, 0.0))
        if end and total:
            part = min(1.0, done / total)
            if stage == "depth":
                part = (self._written + part) / self._views
            self._share = max(self._share, begin + (end - begin) * part)
        self._progress(stage, done, total * self._views if end and total else None, self._share)

    def during(self, at: EngineProgress) -> None:
        self(at.stage, at.frames_done, at.frames_total)

    def write(self, annotation: Annotation, root: Path, attributes: Sequence[Attribute]) -> None:
        """Write the artifacts of one view, the only one or the next."""
        from vipe_core.formats.artifacts import write_artifacts

        write_artifacts(
            annotation, root, attributes=attributes, progress=lambda done, total: self("depth", done, total)
        )
        self._written += 1


def open_engine(preset: str, camera: str, device: str, options: Mapping[str, Any] | None = None) -> Engine:
    """Open the engine that ships, with `JobSpec.preset_options`. Imports the heavy libraries here, not in the agent."""
    from vipe_core.pipeline.presets import PresetOptions
    from vipe_core.pipeline.rig_annotator import RigAnnotator

    changed = None if options is None else PresetOptions(**options)
    return VipeEngine(RigAnnotator(preset=preset, camera=camera, device=device, options=changed))


def index_row(annotation: Annotation, video: VideoRef) -> VideoResult:
    """The index row of an annotation whose dense stream was consumed."""
    camera, provenance = annotation.camera, asdict(annotation.provenance)
    stamps = annotation.timestamps_s
    return VideoResult(
        key=video.key,
        uri=video.uri,
        status=VideoStatus.SUCCEEDED,
        attempt=0,
        num_frames=annotation.num_frames,
        num_keyframes=len(annotation.keyframes),
        width=camera.width,
        height=camera.height,
        fps=annotation.fps,
        duration_s=float(stamps[-1] - stamps[0]) + 1.0 / annotation.fps,
        camera_model=camera.model,
        camera_params=tuple(float(value) for value in camera.params),
        fov_x_deg=camera.fov_x_deg,
        trajectory_length=annotation.trajectory_length,
        scale=annotation.scale,
        depth_kind=annotation.depth_kind,
        quality=annotation.quality.summary(),
        timings_s={stage: round(seconds, 4) for stage, seconds in annotation.timings_s.items()},
        peak_bytes=dict(annotation.peak_bytes) or None,
        source=provenance.pop("source"),
        provenance=provenance,
    )


def rig_row(views: Sequence[VideoResult], rig: VideoRef) -> VideoResult:
    """The row of a rig: the frames of all its views, the least reliable of their verdicts, else the first view's."""
    order = ("no", "doubtful", "yes")
    worst = min(views, key=lambda view: order.index((view.quality or {}).get("reliable", "no")))
    timings: dict[str, float] = {}
    for view in views:
        # What all views went through together is in the timings of each.
        for stage, seconds in (view.timings_s or {}).items():
            timings[stage] = round(timings.get(stage, 0.0) + seconds, 4) if stage == "depth" else seconds
    return replace(
        views[0],
        key=rig.key,
        uri=rig.uri,
        num_frames=sum(view.num_frames or 0 for view in views),
        num_keyframes=sum(view.num_keyframes or 0 for view in views),
        quality=worst.quality,
        timings_s=timings,
        views=tuple(views),
        rig=None,
        view=None,
    )


def load_opener(dotted: str) -> EngineOpener:
    """Import `module:callable`.

    Raises:
        ConfigError: There is no such callable.
    """
    module_name, _, name = dotted.partition(":")
    try:
        opener = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"the engine {dotted!r} cannot be imported: {error}") from error
    if not callable(opener):
        raise ConfigError(f"the engine {dotted!r} is not callable")
    return cast(EngineOpener, opener)
