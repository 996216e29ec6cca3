"""The engine as a worker uses it: one call from a local file to artifacts on disk and one index row.

`AgentConfig.engine` names the opener by its dotted path; `open_engine` is the one that ships.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from services.agent.messages import Grant
from services.domain.models import JobSpec, VideoRef, VideoResult
from services.domain.states import VideoStatus
from vipe_core.errors import ConfigError

if TYPE_CHECKING:
    from vipe_core.annotation import Annotation
    from vipe_core.annotation import Progress as EngineProgress
    from vipe_core.pipeline.annotator import Annotator

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

    def __init__(self, annotator: Annotator) -> None:
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
        from vipe_core.formats.artifacts import ALL_ATTRIBUTES, write_artifacts

        attributes = [name for name in ALL_ATTRIBUTES if name in (*spec.attributes, "pose", "intrinsics")]
        if missing := set(spec.attributes) - set(attributes):
            raise ConfigError(f"preset {spec.preset!r} does not make the attributes {', '.join(sorted(missing))}")
        share = 0.0

        def report(stage: str, done: int, total: int | None) -> None:
            nonlocal share
            begin, end = _SHARES.get(stage, (0.0, 0.0))
            if end and total:
                share = max(share, begin + (end - begin) * min(1.0, done / total))
            progress(stage, done, total if end else None, share)

        def during(at: EngineProgress) -> None:
            report(at.stage, at.frames_done, at.frames_total)

        known = None if spec.calibration is None else Calibration.from_json(spec.calibration)
        try:
            annotation = self._annotator.annotate(
                path,
                name=video.key,
                scale_from=spec.scale_from,
                calibration=known,
                memory_bytes=None if grant is None else grant.memory_bytes,
                low_memory=grant is not None and grant.low_memory,
                progress=during,
            )
            write_artifacts(
                annotation, root, attributes=attributes, progress=lambda done, all_: report("depth", done, all_)
            )
        finally:
            self._annotator.release()
        return index_row(annotation, video)


def open_engine(preset: str, camera: str, device: str, options: Mapping[str, Any] | None = None) -> Engine:
    """Open the engine that ships, with `JobSpec.preset_options`. Imports the heavy libraries here, not in the agent."""
    from vipe_core.pipeline.annotator import Annotator
    from vipe_core.pipeline.presets import PresetOptions

    changed = None if options is None else PresetOptions(**options)
    return VipeEngine(Annotator(preset=preset, camera=camera, device=device, options=changed))


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
