"""What goes in and out over HTTP. Names are snake_case, times RFC 3339 in UTC."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from services.api import offer
from services.api.control_schemas import ControlFields, ControlView
from services.domain.control import PauseReason
from services.domain.models import DEFAULT_ATTRIBUTES, Event, Job, JobSpec, Shard
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.base import VideoRow

Address = Annotated[str, Field(min_length=1, max_length=2048), AfterValidator(offer.address)]


class JobRequest(ControlFields):
    """A job to run."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={"examples": [{"inputs": ["s3://bucket/videos/"], "output": "s3://bucket/annotations"}]},
    )

    inputs: list[Address] = Field(
        min_length=1,
        max_length=1000,
        description="Each a directory, a video file, `s3://bucket/key`, `s3://bucket/prefix/` (trailing slash), "
        "`http(s)://host/path` where the operator allows the host, the file of a rig (`rig.json`, `*.rig.json`), which "
        "names the videos of its views, or a list of videos in one of these places: `.csv`, "
        "`.jsonl` or `.parquet` with a column `uri`, and `key`, `size_bytes` and `etag` where they are known.",
    )
    output: Address = Field(description="A directory or `s3://bucket/prefix` that belongs to this job alone.")
    preset: Annotated[str, AfterValidator(lambda v: offer.one_of(v, offer.presets()))] = Field(
        default="classical",
        max_length=64,
        description="Engine preset: `classical`, `classical_fast` with coarser dense depth for less time, `wide_angle` "
        "for bent lenses, `panorama` for 360-degree video; with the DROID network's weights on the workers, "
        "`vipe_fast`, or `pose_only` without depth; with those of docs/models.md, `vipe`.",
    )
    camera: Annotated[str, AfterValidator(lambda v: offer.one_of(v, offer.cameras()))] | None = Field(
        default=None,
        max_length=64,
        description="Camera model: `pinhole`, `mei` (wide angle), `equirect` (360 degrees), or `auto` for what each "
        "video says. Default: the preset's own.",
    )
    attributes: list[offer.OfferedAttribute] = Field(
        default_factory=lambda: list(DEFAULT_ATTRIBUTES),
        max_length=8,
        description="Tars to write; `pose` and `intrinsics` always are, `confidence` only when it is asked for, and "
        "`depth` unless the preset makes none.",
    )
    shard_max_videos: int = Field(default=16, ge=1, le=1000, description="Most videos in one shard.")
    shard_max_input_bytes: int = Field(
        default=1 << 30, ge=1, le=1 << 40, description="Most input bytes in one shard; one video always fits."
    )
    name: str = Field(default="", max_length=200, description="Free text for humans.")
    scale_from: Annotated[str, AfterValidator(offer.known_length)] | None = Field(
        default=None,
        max_length=200,
        description="A length that is known of every video, which makes scale metric: `path=METRES` that the camera "
        "goes, `height=METRES` of the camera above the ground, or `depth=METRES@X,Y,FRAME` from the camera to what a "
        "pixel of a frame shows. A video that does not show it fails with `scale_unobservable`.",
    )
    calibration: Annotated[dict[str, Any], AfterValidator(offer.calibration)] | None = Field(
        default=None,
        description="The camera that took every video: `version` 1, `model` (`pinhole`, `mei`, `opencv` or "
        "`opencv_fisheye`), `width`, `height`, `fx`, `fy`, `cx`, `cy`, `alpha` or `distortion`, `pixel_centre` (`half` "
        "or `integer`) and `use` (`fixed`, or `initial` for a starting point). In place of `camera`. A video of "
        "another aspect fails with `calibration_mismatch`.",
    )

    phrases: list[Annotated[str, Field(max_length=64)]] | None = Field(
        default=None,
        max_length=64,
        description="What is found in the videos, followed and masked, in plain words such as `person`; an empty list "
        "for nothing. Default: the preset's own. Workers need the extra `hf` and the weights.",
    )
    detection_interval_s: float | None = Field(
        default=None, gt=0, le=3600, description="Time between looks for new things. Default: the preset's own."
    )
    metric_depth: Annotated[str, AfterValidator(lambda v: offer.one_of(v, offer.metric_depths()))] | None = Field(
        default=None,
        max_length=64,
        description="Network that tells the scale, such as `hf.depth_pro`, or `none`. Default: the preset's own.",
    )
    tracks: Annotated[str, AfterValidator(lambda v: offer.one_of(v, offer.tracks()))] | None = Field(
        default=None,
        max_length=64,
        description="Tracks through consecutive frames that join what the DROID network measures, with its presets: "
        "`classical.corners`, `cuvslam.odometry` (workers need PyCuVSLAM) or `none`. Default: the preset's own.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if "://" in self.output and not self.output.startswith("s3://"):
            raise ValueError("output must be a directory or s3://bucket/prefix")
        if self.output.strip("/") == "":
            raise ValueError("output must not be the root directory")
        if self.output.rstrip("/") in {uri.rstrip("/") for uri in self.inputs}:
            raise ValueError("output must not be one of the inputs")
        if self.calibration is not None and self.camera is not None:
            raise ValueError("camera and calibration exclude each other: the calibration says which model it is")
        if self.calibration is not None and offer.camera_of(self.preset) == "equirect":
            raise ValueError("a panorama has no calibration: its pixels are angles; choose another preset")
        if "\x00" in self.name:
            raise ValueError("name must not hold NUL characters")
        offer.preset_options(self.preset, self.camera, self._options())
        if not offer.makes_depth(self.preset) and "attributes" in self.model_fields_set and self._of_depth():
            raise ValueError(f"the preset {self.preset} makes no depth; leave {', '.join(self._of_depth())} out")
        if self.calibration is not None and offer.camera_of(self.preset) == "equirect":
            raise ValueError(f"the preset {self.preset} is for 360-degree video, which needs no calibration")
        return self

    def _options(self) -> dict[str, Any]:
        return {
            "phrases": None if self.phrases is None else tuple(self.phrases),
            "detection_interval_s": self.detection_interval_s,
            "metric_depth": self.metric_depth,
            "tracks": self.tracks,
        }

    def _of_depth(self) -> list[str]:
        return [name for name in self.attributes if name in ("depth", "confidence")]

    def to_spec(self) -> JobSpec:
        wanted = {"pose", "intrinsics", *self.attributes}
        if not offer.makes_depth(self.preset):
            wanted -= {*self._of_depth()}
        return JobSpec(
            inputs=tuple(self.inputs),
            output=self.output.rstrip("/"),
            preset=self.preset,
            camera=self.camera or offer.camera_of(self.preset),
            attributes=tuple(a for a in offer.ATTRIBUTES if a in wanted),
            shard_max_videos=self.shard_max_videos,
            shard_max_input_bytes=self.shard_max_input_bytes,
            name=self.name,
            scale_from=self.scale_from,
            **self._options(),
            calibration=self.calibration,
        )


class _View(BaseModel):
    model_config = ConfigDict(from_attributes=True)


class SpecView(_View):
    inputs: list[str]
    output: str
    preset: str
    camera: str
    attributes: list[str]
    shard_max_videos: int
    shard_max_input_bytes: int
    name: str
    scale_from: str | None
    phrases: list[str] | None
    detection_interval_s: float | None
    metric_depth: str | None
    tracks: str | None
    calibration: dict[str, Any] | None


class ProgressView(_View):
    """Videos count as succeeded, failed or quarantined once their shard is committed."""

    shards_total: int
    shards_committed: int
    videos_total: int
    videos_done: int = Field(description="Settled videos plus what workers report as done in shards under way.")
    videos_succeeded: int
    videos_failed: int
    videos_quarantined: int
    frames_done: int
    frames_expected: int | None = Field(description="Estimate of all frames; null until something is known.")
    frames_per_s: float = Field(description="Over the recent past; 0 when idle.")
    eta_s: float | None = Field(description="Null when unknown.")


class JobView(_View):
    id: str
    tenant: str
    state: JobState
    spec: SpecView
    planned: bool = Field(description="Whether every shard is known, so that the totals are final.")
    control: ControlView
    pause_reason: PauseReason | None = Field(description="Why it is paused; null where it is not.")
    pause_message: str | None
    slot_seconds: float = Field(description="Seconds that worker slots spent on it, lost and live leases included.")
    retries: int = Field(description="How often videos of it that failed were tried again.")
    error_code: str | None
    error_message: str | None
    created_at: datetime
    updated_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    progress: ProgressView

    @classmethod
    def of(cls, job: Job) -> JobView:
        return cls.model_validate(job)


class ShardView(_View):
    id: str
    job_id: str
    ordinal: int
    state: ShardState
    num_videos: int
    attempts: int
    holder: str | None
    lease_expires_at: datetime | None
    tar_name: str | None

    @classmethod
    def of(cls, shard: Shard) -> ShardView:
        return cls.model_validate(shard)


class VideoView(_View):
    """A video; what was found out about it is null until its shard is committed, and where it failed."""

    key: str
    uri: str
    size_bytes: int
    etag: str | None
    shard_id: str
    status: VideoStatus
    attempt: int | None = None
    error_code: str | None = None
    error_message: str | None = None
    num_frames: int | None = None
    num_keyframes: int | None = None
    width: int | None = None
    height: int | None = None
    fps: float | None = None
    duration_s: float | None = None
    camera_model: str | None = None
    camera_params: list[float] | None = None
    fov_x_deg: float | None = None
    trajectory_length: float | None = None
    scale: str | None = None
    depth_kind: str | None = None
    quality: dict[str, Any] | None = None
    seconds: float | None = None
    timings_s: dict[str, float] | None = Field(default=None, description="Wall seconds per stage.")
    peak_bytes: dict[str, int] | None = Field(
        default=None, description="Most memory of the GPU per stage; null without one."
    )
    source: dict[str, Any] | None = None
    provenance: dict[str, Any] | None = None

    @classmethod
    def of(cls, row: VideoRow) -> VideoView:
        found = {} if row.result is None else row.result.to_json()
        ref = row.ref
        place = {"key": ref.key, "uri": ref.uri, "size_bytes": ref.size_bytes, "etag": ref.etag}
        return cls.model_validate({**found, **place, "shard_id": row.shard_id, "status": row.status})


class EventView(_View):
    seq: int
    job_id: str
    at: datetime
    kind: str
    data: dict[str, Any]

    @classmethod
    def of(cls, event: Event) -> EventView:
        return cls.model_validate(event)


class JobPage(BaseModel):
    items: list[JobView]
    next_page_token: str | None


class ShardPage(BaseModel):
    items: list[ShardView]
    next_page_token: str | None


class VideoPage(BaseModel):
    items: list[VideoView]
    next_page_token: str | None


class EventPage(BaseModel):
    items: list[EventView]
    next_page_token: str | None


class Status(BaseModel):
    status: Literal["ok"] = "ok"


class Readiness(Status):
    agent: Literal["ready", "starting"] | None = Field(
        default=None,
        description="Whether the agent in this process has a worker; until then jobs stay queued. Absent: no agent.",
    )
