"""Every metric of the service, declared in one place.

Names follow the Prometheus guide: one prefix, base units, bounded label values. No label ever holds a video, an
address, a process or free text. A process makes one `Metrics` and hands it to the parts that emit; embedded, the API
and the agent share it, so that one `/metrics` page tells everything.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
    start_http_server,
)

from services.domain.control import PauseReason, Tenant
from services.domain.errors import InputUnavailable
from services.domain.models import VideoResult
from services.domain.states import JobState, ShardState, VideoStatus
from vipe_core import errors as engine_errors
from vipe_core.errors import OutOfDeviceMemory

if TYPE_CHECKING:
    from threading import Thread
    from wsgiref.simple_server import WSGIServer

CONTENT_TYPE = CONTENT_TYPE_LATEST
"""The media type of `Metrics.render()`."""

_STAGE_BUCKETS_S = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
_MEMORY_BUCKETS_BYTES = tuple(float(1 << exponent) for exponent in range(28, 38))
_REQUEST_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)

WORKER_DIED = "worker_died"


def _engine_codes() -> set[str]:
    """The code of every error in the engine's taxonomy."""
    return {
        kind.code
        for kind in vars(engine_errors).values()
        if isinstance(kind, type) and issubclass(kind, engine_errors.VipeError)
    }


FAILURE_CODES = tuple(sorted(_engine_codes() | {"video_timeout", InputUnavailable.code}))
"""What a video can fail with: the engine's codes, and those that the service adds to them."""


class Metrics:
    """Typed handles on the service's metrics.

    Args:
        registry: Where to register; a new one, with this process's CPU, memory and file handles, when omitted.
    """

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        if registry is None:
            registry = CollectorRegistry()
            ProcessCollector(registry=registry)
        self.registry = registry

        # The store's view. Every process that reports them reports the same value: aggregate with max, not sum.
        self.jobs = Gauge("vipe_jobs", "Jobs in the store by state.", ["state"], registry=registry)
        self.shards = Gauge("vipe_shards", "Shards in the store by state.", ["state"], registry=registry)
        self.store_up = Gauge(
            "vipe_store_up",
            "Whether the store answered this process the last time it was asked; NaN before the first time.",
            registry=registry,
        )
        self.store_up.set(math.nan)

        self.paused_jobs = Gauge(
            "vipe_paused_jobs",
            "Paused jobs by reason: requested, deadline, slot_hours, failure_ratio, tenant_videos.",
            ["reason"],
            registry=registry,
        )
        self.tenant_slots = Gauge("vipe_tenant_slots", "Live leases by tenant.", ["tenant"], registry=registry)
        self.tenant_open_videos = Gauge(
            "vipe_tenant_open_videos",
            "Videos that are not settled, of jobs that have not ended, by tenant.",
            ["tenant"],
            registry=registry,
        )
        self.tenant_slot_seconds = Gauge(
            "vipe_tenant_slot_seconds",
            "Seconds of worker slots that a tenant's jobs have used since ever, lost and live leases included.",
            ["tenant"],
            registry=registry,
        )
        self.webhooks_waiting = Gauge(
            "vipe_webhooks_waiting", "Events that their webhook has not taken yet.", registry=registry
        )

        # Work done by this process.
        self.videos = Counter(
            "vipe_videos_total",
            "Videos settled by a committed shard, by outcome and stable error code.",
            ["outcome", "error_class"],
            registry=registry,
        )
        self.frames_in_progress = Gauge(
            "vipe_frames_in_progress",
            "Frames that count as done in the shards that this process holds; as long as it changes, work goes on.",
            registry=registry,
        )
        self.frames = Counter("vipe_frames_total", "Annotated frames in committed shards.", registry=registry)
        self.stage_duration = Histogram(
            "vipe_stage_duration_seconds",
            "Wall time of a stage: fetch and the engine's own per video; pack and commit per shard; finalise per job.",
            ["stage"],
            buckets=_STAGE_BUCKETS_S,
            registry=registry,
        )

        self.stage_gpu_peak = Histogram(
            "vipe_stage_gpu_peak_bytes",
            "Most memory of the GPU that a stage of a video took; nothing without a GPU.",
            ["stage"],
            buckets=_MEMORY_BUCKETS_BYTES,
            registry=registry,
        )

        # Leases and commits.
        self.lease_expired = Counter(
            "vipe_lease_expired_total", "Leases that ran out and were requeued.", registry=registry
        )
        self.lease_renew_failures = Counter(
            "vipe_lease_renew_failures_total",
            "Renewals that failed: the store did not answer, or it said that the lease is lost.",
            registry=registry,
        )
        self.commit_conflicts = Counter(
            "vipe_commit_conflicts_total",
            "Commits that found something in their way: `adopted` the record of a faster attempt, `lost_lease` "
            "before the commit point, `conflict` with a record of another plan.",
            ["result"],
            registry=registry,
        )

        # Actors.
        self.actor_restarts = Counter(
            "vipe_actor_restarts_total",
            "Worker processes that had to be replaced, by reason: died, video_timeout, start_failed, recycled, "
            "device_memory.",
            ["reason"],
            registry=registry,
        )
        self.executor_restarts = Counter(
            "vipe_executor_restarts_total",
            "How often Ray was started or joined anew because its head, or every worker process, was gone.",
            registry=registry,
        )
        self.actors = Gauge(
            "vipe_actors",
            "Worker slots by role and state: starting, idle, busy, fenced, lost.",
            ["role", "state"],
            registry=registry,
        )

        # Object storage, as seen by the agent and its workers.
        self.object_store_bytes = Counter(
            "vipe_object_store_bytes_total", "Bytes moved to and from object storage.", ["op"], registry=registry
        )
        self.object_store_requests = Counter(
            "vipe_object_store_requests_total",
            "Requests to object storage by HTTP status, `error` where no answer came.",
            ["op", "status"],
            registry=registry,
        )

        # Webhooks.
        self.webhook_deliveries = Counter(
            "vipe_webhook_deliveries_total",
            "Attempts to send an event to a webhook: delivered, failed (and sent again), abandoned.",
            ["result"],
            registry=registry,
        )

        # API.
        self.api_request_duration = Histogram(
            "vipe_api_request_duration_seconds",
            "Time to answer an HTTP request, by route template.",
            ["route", "method", "status"],
            buckets=_REQUEST_BUCKETS_S,
            registry=registry,
        )

        self.build_info = Gauge(
            "vipe_build_info", "Always 1; the labels tell what runs.", ["version", "python"], registry=registry
        )
        self.build_info.labels(version=package_version(), python=platform.python_version()).set(1)
        self._begin_at_zero()

    def _begin_at_zero(self) -> None:
        """Create the known children of counters: a series that begins at 1 shows no increase, so its first is lost."""
        self.videos.labels(outcome=VideoStatus.SUCCEEDED.value, error_class="")
        self.videos.labels(outcome=VideoStatus.QUARANTINED.value, error_class=WORKER_DIED)
        for code in FAILURE_CODES:
            self.videos.labels(outcome=VideoStatus.FAILED.value, error_class=code)
        for reason in ("died", "video_timeout", "start_failed", "recycled", OutOfDeviceMemory.code):
            self.actor_restarts.labels(reason=reason)
        for result in ("delivered", "failed", "abandoned"):
            self.webhook_deliveries.labels(result=result)
        for result in ("adopted", "lost_lease", "conflict"):
            self.commit_conflicts.labels(result=result)

    def set_counts(self, counts: Mapping[str, Mapping[str, int]]) -> None:
        """Publish `Store.counts()`; a state that the store does not mention is 0, not stale."""
        self.store_up.set(1)
        for job_state in JobState:
            self.jobs.labels(state=job_state.value).set(counts.get("jobs", {}).get(job_state.value, 0))
        for shard_state in ShardState:
            self.shards.labels(state=shard_state.value).set(counts.get("shards", {}).get(shard_state.value, 0))

        for reason in PauseReason:
            self.paused_jobs.labels(reason=reason.value).set(counts.get("paused", {}).get(reason.value, 0))

    def set_tenants(self, tenants: Iterable[Tenant]) -> None:
        """Publish `Store.list_tenants()`."""
        for gauge in (self.tenant_slots, self.tenant_open_videos, self.tenant_slot_seconds):
            gauge.clear()
        for tenant in tenants:
            self.tenant_slots.labels(tenant=tenant.name).set(tenant.slots)
            self.tenant_open_videos.labels(tenant=tenant.name).set(tenant.open_videos)
            self.tenant_slot_seconds.labels(tenant=tenant.name).set(tenant.slot_seconds)

    def store_is_down(self) -> None:
        """Publish that the store does not answer: its counts are unknown, not what they were."""
        self.store_up.set(0)
        for gauge in (self.jobs, self.shards, self.paused_jobs):
            gauge.clear()
        self.set_tenants(())
        self.webhooks_waiting.set(math.nan)

    def observe_video(self, result: VideoResult) -> None:
        """Count one video of a shard that this process committed."""
        self.videos.labels(outcome=result.status.value, error_class=result.error_code or "").inc()
        if result.num_frames and result.status is VideoStatus.SUCCEEDED:
            self.frames.inc(result.num_frames)
        for stage, seconds in (result.timings_s or {}).items():
            self.stage_duration.labels(stage=stage).observe(seconds)
        for stage, peak_bytes in (result.peak_bytes or {}).items():
            self.stage_gpu_peak.labels(stage=stage).observe(peak_bytes)

    def render(self) -> bytes:
        """The Prometheus text page, of type `CONTENT_TYPE`."""
        return generate_latest(self.registry)

    def serve(self, port: int, host: str = "127.0.0.1") -> tuple[WSGIServer, Thread]:
        """Answer `GET /metrics` from a daemon thread, for an agent without the API beside it.

        Args:
            port: 0 picks a free one; read it from `server.server_port`.
        """
        return start_http_server(port, addr=host, registry=self.registry)


def package_version() -> str:
    """The installed version of this distribution."""
    try:
        return version("vipe-cluster")
    except PackageNotFoundError:  # Imported from a checkout that was never installed.
        return "unknown"
