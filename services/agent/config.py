"""What an agent must know. Values only; `services.settings` decides where they come from."""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import SecretStr

from services.inputs.rules import InputRules
from services.network.addresses import NetworkPolicy
from vipe_core.video.limits import Limits

if TYPE_CHECKING:
    from services.settings import Settings

DEFAULT_ENGINE = "services.agent.engine:open_engine"


def new_holder() -> str:
    """A holder name that no other agent process ever has: host, process and a random part."""
    return f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """Settings of one agent.

    Attributes:
        scratch_dir: Node-local folder for inputs, artifacts and tars in the making. On a cluster: the same path on
            every node, each with its own contents.
        slots: Worker processes; one video in each. None: as many as the GPUs have room for, if `device` is `cuda`.
        device: Where the engine runs.
        slots_per_gpu: Slots that share a GPU when `device` is `cuda`; None: as its memory has room for.
        gpu_preset: Preset whose videos that is planned for.
        cpus_per_slot: Cores that a slot reserves, and the threads its numeric libraries may use.
        ray_address: None starts a private Ray on this machine; otherwise the address of a cluster to join.
        lease_ttl_s: A lease that is not renewed for so long is given to somebody else; renewed every third of it.
        poll_s: Pause between two looks for work when there is none.
        video_budget_base_s: Wall budget of one video: this, plus the next two terms.
        video_budget_per_frame_s: Seconds per frame of the video.
        fetch_min_bytes_per_s: Slowest download that is still waited for.
        pack_budget_s: Wall budget for building, verifying and uploading the tars of one shard.
        start_timeout_s: A worker process that is not ready by then counts as failed.
        cancel_grace_s: How long a worker may take to stop by itself before it is killed.
        max_worker_deaths: A video that killed its worker so often is quarantined.
        max_death_places: So is one that killed workers in so many places, GPUs or slots.
        max_video_tries: Attempts within one lease at a video whose error says that another attempt can succeed.
        max_slot_deaths: Deaths in a row, with no success between, after which a slot is fenced.
        storage_tries: Attempts at one storage operation before the lease is given back.
        max_give_backs: How often this agent gives one shard back. After that an input that still cannot be fetched
            becomes an error row, and a shard that still cannot be packed fails its job.
        fence_cooloff_s: How long a fenced slot rests before it gets another chance.
        backoff_base_s, backoff_max_s: Full-jitter exponential backoff after a failure of storage or the store.
        recycle_videos: A worker is replaced after so many videos, which bounds what a leak can cost; 0: never.
        recycle_age_s: A worker is replaced after so long, between two videos; 0: never.
        recycle_growth_bytes: A worker is replaced that has grown by so much since its first video; 0: never.
        scratch_max_age_s: Leftovers of shards that nobody came back for are removed after this.
        engine: `module:callable` that opens an engine from (preset, camera, device).
        inputs: What inputs may name.
        media: Bounds on one video, see `vipe_core.video.Limits`.
        output_roots: Where local outputs must lie; empty: anywhere.
        s3_endpoint_url: S3 service other than AWS.
        webhook_secrets: `tenant/name` -> secret that signs the webhooks that name it.
        webhook_policy: Where webhooks may go.
    """

    scratch_dir: Path
    slots: int | None = 1
    device: Literal["cpu", "cuda"] = "cpu"
    slots_per_gpu: int | None = None
    gpu_preset: str = "vipe_fast"
    cpus_per_slot: int = 1
    ray_address: str | None = None
    lease_ttl_s: float = 60.0
    poll_s: float = 1.0
    video_budget_base_s: float = 300.0
    video_budget_per_frame_s: float = 5.0
    fetch_min_bytes_per_s: float = 1e6
    pack_budget_s: float = 3600.0
    start_timeout_s: float = 120.0
    cancel_grace_s: float = 5.0
    max_worker_deaths: int = 3
    max_death_places: int = 2
    max_video_tries: int = 2
    max_slot_deaths: int = 3
    storage_tries: int = 4
    max_give_backs: int = 6
    fence_cooloff_s: float = 300.0
    backoff_base_s: float = 1.0
    backoff_max_s: float = 60.0
    recycle_videos: int = 1000
    recycle_age_s: float = 7200.0
    recycle_growth_bytes: int = 4 << 30
    scratch_max_age_s: float = 86400.0
    engine: str = DEFAULT_ENGINE
    inputs: InputRules = field(default_factory=InputRules)
    media: Limits = field(default_factory=Limits)
    output_roots: tuple[Path, ...] = ()
    s3_endpoint_url: str | None = None
    webhook_secrets: Mapping[str, SecretStr] = field(default_factory=dict)
    webhook_policy: NetworkPolicy = field(default_factory=NetworkPolicy)
    holder: str = field(default_factory=new_holder)

    def __post_init__(self) -> None:
        if self.slots is not None and self.slots < 1:
            raise ValueError(f"slots must be at least 1, got {self.slots}")
        if self.slots is None and self.device != "cuda":
            raise ValueError("slots must be given where there are no GPUs to count")
        if self.slots_per_gpu is not None and self.slots_per_gpu < 1:
            raise ValueError(f"slots_per_gpu must be at least 1, got {self.slots_per_gpu}")
        if self.lease_ttl_s <= 0:
            raise ValueError(f"lease_ttl_s must be positive, got {self.lease_ttl_s}")
        if not self.scratch_dir.is_absolute():
            raise ValueError(f"scratch_dir must be an absolute path, got {self.scratch_dir}")


def input_rules(settings: Settings) -> InputRules:
    """What the service's settings say about inputs."""
    return InputRules(
        roots=settings.input_roots,
        buckets=settings.s3_buckets,
        network=NetworkPolicy(settings.http_hosts, settings.http_networks),
        max_file_bytes=settings.max_input_bytes,
        max_rows=settings.max_manifest_rows,
    )


def config_from_settings(settings: Settings) -> AgentConfig:
    """What the service's settings say about its agent."""
    slots = settings.num_slots
    if slots is None and settings.device == "cpu":
        slots = min(4, os.cpu_count() or 1)
    return AgentConfig(
        scratch_dir=settings.scratch_dir,
        slots=slots,
        device=settings.device,
        slots_per_gpu=settings.slots_per_gpu,
        gpu_preset=settings.gpu_preset,
        ray_address=settings.ray_address,
        lease_ttl_s=settings.lease_ttl_s,
        video_budget_base_s=settings.video_timeout_base_s,
        video_budget_per_frame_s=settings.video_timeout_per_frame_s,
        max_worker_deaths=settings.max_worker_deaths,
        recycle_videos=settings.recycle_videos,
        recycle_age_s=settings.recycle_age_s,
        recycle_growth_bytes=settings.recycle_growth_bytes,
        inputs=input_rules(settings),
        media=settings.media_limits(),
        output_roots=settings.output_roots,
        s3_endpoint_url=settings.s3_endpoint_url,
        webhook_secrets=settings.webhook_secrets,
        webhook_policy=settings.webhook_policy(),
    )
