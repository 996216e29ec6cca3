"""Every setting of the service: an environment variable `VIPE_<NAME>`, or an argument of `Settings`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, IPvAnyNetwork, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from services.network.addresses import NetworkPolicy
from vipe_core.video.limits import Limits


def _default_data_dir() -> Path:
    base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(base).expanduser() / "vipe"


class Settings(BaseSettings):
    """Defaults run everything on one machine: SQLite, a private Ray, the API on loopback."""

    model_config = SettingsConfigDict(
        env_prefix="VIPE_", extra="forbid", frozen=True, use_attribute_docstrings=True, hide_input_in_errors=True
    )

    data_dir: Path = Field(default_factory=_default_data_dir)
    """Where the embedded database and the scratch folder live. On a local disk."""

    database_url: str = Field(default_factory=lambda data: f"sqlite:///{data['data_dir']}/vipe.db")
    """`sqlite:////absolute/path.db` or `postgresql://user:password@host/name`; default: `vipe.db` in `data_dir`."""

    scratch_dir: Path = Field(default_factory=lambda data: data["data_dir"] / "scratch")
    """Node-local folder for inputs, artifacts and tars in the making; default: `scratch` in `data_dir`."""

    host: str = "127.0.0.1"
    """Address that the API listens on. On anything but loopback every request needs a key (see `allow_anonymous`)."""

    port: int = Field(default=8080, ge=0, le=65535)
    """Port that the API listens on; 0 takes a free one."""

    api_key: SecretStr | None = None
    """The first administrator's key, of the tenant `default` and with all scopes; others are made with it, or with
    `vipectl keys create`. When set, every `/v1` request needs a key, this one or another."""

    allow_anonymous: bool | None = None
    """Whether requests without a key act for the tenant `default` with all scopes, where no `api_key` is set. Default:
    where `host` is loopback. If true elsewhere, something else must keep strangers out."""

    allowed_hosts: tuple[str, ...] = ()
    """Names under which the API answers, `*.example.org` for all below one; empty: all, but only localhost where no
    key is needed on loopback. As JSON list."""

    cors_origins: tuple[str, ...] = ()
    """Web pages of these origins (`https://example.org`) may use the API from a browser; empty: of none. As JSON
    list."""

    trusted_proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies whose `X-Forwarded-For` and `X-Forwarded-Proto` are believed. As JSON list."""

    tls_cert_file: Path | None = None
    """Certificate chain (PEM); with it and `tls_key_file` the API speaks HTTPS only."""

    tls_key_file: Path | None = None
    """Private key (PEM) of `tls_cert_file`."""

    rate_limit_per_s: float = Field(default=100.0, gt=0)
    """Requests per second of one key, or of one address where no key is needed; more are answered with 429."""

    rate_limit_burst: int = Field(default=500, ge=1)
    """Requests that one key may send at once."""

    max_wrong_keys: int = Field(default=20, ge=1)
    """Wrong keys that one address may send at once; after that one every two seconds."""

    max_streams_per_key: int = Field(default=100, ge=1)
    """Event streams that one key, or one address where no key is needed, may have open."""

    max_connections: int = Field(default=2000, ge=1)
    """Connections that the API holds open; further ones are answered with 503."""

    receive_timeout_s: float = Field(default=30.0, gt=0)
    """A request whose headers and body have not arrived by then is given up."""

    max_body_bytes: int = Field(default=1 << 20, ge=1024)
    """Largest request body that the API reads."""

    input_roots: tuple[Path, ...] = ()
    """Local inputs must lie below one of these directories, symbolic links resolved; empty: anywhere. As JSON list."""

    http_hosts: tuple[str, ...] = ()
    """Hosts that inputs may be downloaded from over `http(s)`: `media.example.org`, `*.example.org`, `*`, each also
    with `:port` or `:*`; empty: no such inputs. As JSON list."""

    http_networks: tuple[IPvAnyNetwork, ...] = ()
    """Networks that are not public and that `http_hosts` may resolve to nevertheless, such as `10.1.0.0/16`. Loopback,
    link-local, private, shared and multicast addresses are refused otherwise. As JSON list."""

    s3_buckets: tuple[str, ...] = ()
    """Buckets that inputs and outputs may name, `*` for any part of a name; empty: every bucket that the credentials
    open. As JSON list."""

    max_input_bytes: int = Field(default=1 << 38, ge=1)
    """Largest input file: a video, an image, or a list of videos."""

    max_manifest_rows: int = Field(default=10_000_000, ge=1)
    """Most rows of one list of videos."""

    max_pixels: int = Field(default=1 << 26, ge=1)
    """Most pixels of one picture; the default is twice 8K."""

    max_frames: int = Field(default=1_000_000, ge=1)
    """Most frames of one video."""

    max_duration_s: float = Field(default=43_200, gt=0)
    """Longest video."""

    max_decoded_bytes: int = Field(default=1 << 44, ge=1)
    """Most bytes of all pictures of one video together, as RGB."""

    max_streams: int = Field(default=64, ge=1)
    """Most streams of one media file."""

    max_decoder_memory_bytes: int = Field(default=1 << 32, ge=1 << 26)
    """Memory that decoding one video may take, its index included."""

    output_roots: tuple[Path, ...] = ()
    """Local outputs must lie below one of these directories, symbolic links resolved; empty: anywhere. As JSON list."""

    s3_endpoint_url: str | None = None
    """S3 service other than AWS. Credentials come from where boto3 finds them."""

    ray_address: str | None = None
    """Address of a Ray cluster to join; None starts a private Ray on this machine."""

    num_slots: int | None = Field(default=None, ge=1)
    """Worker processes of the agent, one video in each; default: what the GPUs have room for, without GPUs one per
    core, 4 at most."""

    slots_per_gpu: int | None = Field(default=None, ge=1, le=64)
    """Worker processes that share a GPU, each with its part of the memory; default: planned from the memory of the
    smallest GPU and what a usual video of `gpu_preset` takes, 8 at most."""

    gpu_preset: str = "vipe_fast"
    """Preset whose videos `slots_per_gpu` is planned for. Jobs of another preset run all the same: a video that does
    not fit in the memory of its slot waits for that of others."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Where the engine runs."""

    lease_ttl_s: float = Field(default=60.0, gt=0)
    """A lease that is not renewed for so long is given to another agent; renewed every third of it."""

    max_worker_deaths: int = Field(default=3, ge=1)
    """A video that killed its worker process so often is quarantined; so is one that did it in two places."""

    recycle_videos: int = Field(default=1000, ge=0)
    """A worker process is replaced after so many videos, which bounds what a leak can cost; 0: never."""

    recycle_age_s: float = Field(default=7200.0, ge=0)
    """A worker process is replaced after so many seconds, between two videos; 0: never."""

    recycle_growth_bytes: int = Field(default=4 << 30, ge=0)
    """A worker process is replaced that has grown by so much since its first video; 0: never."""

    video_timeout_base_s: float = Field(default=300.0, gt=0)
    """Wall time that a video may take: this, plus `video_timeout_per_frame_s` for each of its frames."""

    video_timeout_per_frame_s: float = Field(default=5.0, ge=0)
    """See `video_timeout_base_s`."""

    webhook_secrets: dict[str, SecretStr] = Field(default_factory=dict)
    """Secrets that sign webhooks, `{"tenant/name": "secret"}` as JSON; jobs name them. For the API and its agents."""

    webhook_hosts: tuple[str, ...] = ("*",)
    """Hosts that webhooks may name: `host`, `*.domain` or `*`, each with `:port` or `:*` where it is not 443."""

    webhook_networks: tuple[IPvAnyNetwork, ...] = ()
    """Networks that are not public and that webhooks may reach, such as `10.1.0.0/16`. As JSON list."""

    webhook_allow_http: bool = False
    """Send webhooks to `http://` addresses too, where what they say can be read on the way."""

    log_level: str = "INFO"
    """Least severe messages that are logged."""

    log_format: Literal["text", "json"] = "text"
    """`json` for a log collector: one object a line."""

    @model_validator(mode="after")
    def _whole_pair(self) -> Self:
        if (self.tls_cert_file is None) != (self.tls_key_file is None):
            raise ValueError("tls_cert_file and tls_key_file go together")
        return self

    def webhook_policy(self) -> NetworkPolicy:
        """Where webhooks may go."""
        schemes = ("https", "http") if self.webhook_allow_http else ("https",)
        return NetworkPolicy(self.webhook_hosts, self.webhook_networks, schemes)

    @field_validator("http_hosts", "webhook_hosts")
    @classmethod
    def _host_patterns(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        return NetworkPolicy(value).hosts

    @field_validator("webhook_secrets")
    @classmethod
    def _scoped(cls, value: dict[str, SecretStr]) -> dict[str, SecretStr]:
        for name, secret in value.items():
            if not all(name.partition("/")[::2]):
                raise ValueError(f"{name!r} must be `tenant/name`: a secret belongs to one tenant")
            if len(secret.get_secret_value()) < 16:
                raise ValueError(f"the secret {name!r} is shorter than 16 characters")
        return value

    @field_validator("gpu_preset")
    @classmethod
    def _preset(cls, value: str) -> str:
        from vipe_core.pipeline.presets import PRESETS

        if value not in PRESETS:
            raise ValueError(f"unknown preset {value!r}; on offer: {', '.join(PRESETS)}")
        return value

    @field_validator("data_dir", "scratch_dir")
    @classmethod
    def _absolute(cls, value: Path) -> Path:
        return value.expanduser().absolute()

    @field_validator("input_roots", "output_roots")
    @classmethod
    def _absolute_roots(cls, value: tuple[Path, ...]) -> tuple[Path, ...]:
        return tuple(root.expanduser().absolute() for root in value)

    def media_limits(self) -> Limits:
        """How large one video may be."""
        return Limits(
            max_pixels=self.max_pixels,
            max_frames=self.max_frames,
            max_duration_s=self.max_duration_s,
            max_decoded_bytes=self.max_decoded_bytes,
            max_file_bytes=self.max_input_bytes,
            max_streams=self.max_streams,
            max_memory_bytes=self.max_decoder_memory_bytes,
        )
