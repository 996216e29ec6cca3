"""Every setting of the service: an environment variable `VIPE_<NAME>`, or an argument of `Settings`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict


def _default_data_dir() -> Path:
    base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(base).expanduser() / "vipe"


class Settings(BaseSettings):
    """Defaults run everything on one machine: SQLite, a private Ray, the API on loopback."""

    model_config = SettingsConfigDict(env_prefix="VIPE_", extra="forbid", frozen=True, use_attribute_docstrings=True)

    data_dir: Path = Field(default_factory=_default_data_dir)
    """Where the embedded database and the scratch folder live. On a local disk."""

    database_url: str = Field(default_factory=lambda data: f"sqlite:///{data['data_dir']}/vipe.db")
    """`sqlite:////absolute/path.db` or `postgresql://user:password@host/name`; default: `vipe.db` in `data_dir`."""

    scratch_dir: Path = Field(default_factory=lambda data: data["data_dir"] / "scratch")
    """Node-local folder for inputs, artifacts and tars in the making; default: `scratch` in `data_dir`."""

    host: str = "127.0.0.1"
    """Address that the API listens on. Anything but loopback needs `api_key`, or `allow_anonymous`."""

    port: int = Field(default=8080, ge=0, le=65535)
    """Port that the API listens on; 0 takes a free one."""

    api_key: SecretStr | None = None
    """When set, every `/v1` request must carry `Authorization: Bearer <api_key>`."""

    allow_anonymous: bool = False
    """Serve without an `api_key` where `host` is not loopback; something else must then keep strangers out."""

    max_body_bytes: int = Field(default=1 << 20, ge=1024)
    """Largest request body that the API reads."""

    input_roots: tuple[Path, ...] = ()
    """Local inputs must lie below one of these directories, symbolic links resolved; empty: anywhere. As JSON list."""

    output_roots: tuple[Path, ...] = ()
    """Local outputs must lie below one of these directories, symbolic links resolved; empty: anywhere. As JSON list."""

    s3_endpoint_url: str | None = None
    """S3 service other than AWS. Credentials come from where boto3 finds them."""

    ray_address: str | None = None
    """Address of a Ray cluster to join; None starts a private Ray on this machine."""

    num_slots: int | None = Field(default=None, ge=1)
    """Worker processes of the agent, one video in each; default: one per GPU, without GPUs one per core, 4 at most."""

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

    log_level: str = "INFO"
    """Least severe messages that are logged."""

    log_format: Literal["text", "json"] = "text"
    """`json` for a log collector: one object a line."""

    @field_validator("data_dir", "scratch_dir")
    @classmethod
    def _absolute(cls, value: Path) -> Path:
        return value.expanduser().absolute()

    @field_validator("input_roots", "output_roots")
    @classmethod
    def _absolute_roots(cls, value: tuple[Path, ...]) -> tuple[Path, ...]:
        return tuple(root.expanduser().absolute() for root in value)
