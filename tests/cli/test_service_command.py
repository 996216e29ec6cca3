"""`vipectl up` as a process: a job over REST from S3 to S3, killed in the middle, and complete all the same."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import boto3
import httpx
import numpy as np
import pytest
from cli_helpers import VIPECTL, Run

from services.client import Client
from services.dataset import iterate, verify
from services.storage import open_store

pytestmark = pytest.mark.slow


class Service:
    """One `vipectl up`; killed or stopped, and started again on the same data."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.folder = folder
        self._environment = environment
        self.client = Client(f"http://127.0.0.1:{self.port}")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        log = (self.folder / "service.log").open("ab")
        command = [str(VIPECTL), "up", "--port", str(self.port), "--data-dir", str(self.folder), "--slots", "1"]
        environment = {**os.environ, **self._environment, "HOME": str(self.folder)}
        self.process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        wait_for(self.client.ready, "the service to be ready", 60)

    def end(self, number: int) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(60)


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 180) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.2)


@pytest.fixture
def service(tmp_path: Path, s3_endpoint: str) -> Iterator[Service]:
    folder = tmp_path / "service"
    folder.mkdir()
    running = Service(folder, {"VIPE_S3_ENDPOINT_URL": s3_endpoint, "VIPE_LEASE_TTL_S": "6"})
    running.start()
    yield running
    if running.process is not None and running.process.poll() is None:
        running.end(signal.SIGTERM)


@pytest.fixture
def bucket(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    name = f"vipe-{uuid.uuid4().hex[:8]}"
    boto3.client("s3", endpoint_url=s3_endpoint).create_bucket(Bucket=name)
    return name


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_job_from_s3_to_s3_survives_kill_9(
    bucket: str, service: Service, clip: Path, vipectl: Run, tmp_path: Path, s3_endpoint: str
) -> None:
    s3 = boto3.client("s3", endpoint_url=s3_endpoint)
    for number in range(3):
        s3.upload_file(str(clip), bucket, f"videos/walk {number}.mp4")
    s3.put_object(Bucket=bucket, Key="videos/sub/broken.mp4", Body=b"\0" * 4096)
    spec = {"inputs": [f"s3://{bucket}/videos/"], "output": f"s3://{bucket}/run-1"}
    job_id = service.client.submit(spec, idempotency_key="once")["id"]

    def progress() -> dict[str, Any]:
        answer: dict[str, Any] = service.client.job(job_id)["progress"]
        return answer

    wait_for(lambda: progress()["shards_committed"] >= 1, "the first commit", 400)
    service.end(signal.SIGKILL)
    service.start()
    assert service.client.submit(spec, idempotency_key="once")["id"] == job_id
    wait_for(lambda: service.client.job(job_id)["finished_at"], "the job to end", 400)

    job = service.client.job(job_id)
    assert job["state"] == "succeeded_with_errors"
    videos = {Path(video["uri"]).name: video for video in service.client.videos(job_id)}
    assert len(videos) == 4
    assert videos["broken.mp4"]["error_code"] == "media_corrupt"
    report = verify(open_store(f"s3://{bucket}/run-1", endpoint_url=s3_endpoint), deep=True)
    assert report.ok, report.problems
    assert (report.totals.videos, report.totals.succeeded, report.totals.failed) == (4, 3, 1)

    done = vipectl("verify", f"s3://{bucket}/run-1", "--s3-endpoint", s3_endpoint)
    assert done.returncode == 0, done.stderr
    assert "4 videos of 4 planned = 3 succeeded + 1 failed + 0 quarantined" in done.stdout
    done = vipectl("export", f"s3://{bucket}/run-1", "npz", "--format", "npz", "--s3-endpoint", s3_endpoint)
    assert done.returncode == 0, done.stderr
    exported = sorted((tmp_path / "npz").glob("*.npz"))
    assert len(exported) == 3
    with np.load(exported[0], allow_pickle=False) as arrays:
        assert arrays["cam_to_world"].shape == (12, 4, 4)
        assert arrays["depth"].shape == (12, 24, 32)
        assert str(arrays["depth_kind"]) == "z"

    metrics = httpx.get(f"http://127.0.0.1:{service.port}/metrics").text
    assert 'vipe_jobs{state="succeeded_with_errors"} 1.0' in metrics


def test_commands_of_a_running_service(service: Service, clip: Path, vipectl: Run, tmp_path: Path) -> None:
    api = ("--api", f"http://127.0.0.1:{service.port}")
    done = vipectl("submit", clip, "-o", "out", "--wait", *api)
    assert done.returncode == 0, done.stderr
    job_id = done.stdout.splitlines()[0]
    assert f"{job_id} succeeded" in done.stdout
    assert job_id in vipectl("jobs", *api).stdout
    assert '"videos_succeeded": 1' in vipectl("status", job_id, *api).stdout
    assert "128x96" in vipectl("videos", job_id, *api).stdout
    done = vipectl("cancel", job_id, *api)
    assert done.returncode == 1
    assert "job_not_cancellable" in done.stderr
    done = vipectl("submit", clip, "-o", "out", *api)
    assert "output_in_use" in done.stderr

    views = []
    for name in ("left", "right"):
        shutil.copy(clip, tmp_path / f"{name}.mp4")
        views.append({"name": name, "video": f"{name}.mp4", "rig_from_cam": np.eye(4).tolist()})
    (tmp_path / "car.rig.json").write_text(json.dumps({"version": 1, "intrinsics": "shared", "views": views}))
    spec = {"inputs": [str(tmp_path / "car.rig.json")], "output": str(tmp_path / "rigs"), "attributes": ["pose"]}
    rigs = service.client.submit(spec)["id"]
    wait_for(lambda: service.client.job(rigs)["finished_at"], "the job of a rig to end")
    assert service.client.job(rigs)["state"] == "succeeded"
    report = verify(open_store(str(tmp_path / "rigs")), deep=True)
    assert report.ok, report.problems
    assert (report.totals.videos, report.totals.frames) == (1, 24)
    left, right = iterate(open_store(str(tmp_path / "rigs")))
    assert (left.row["view"], right.row["view"]) == ("left", "right")
    np.testing.assert_allclose(left.world_from_cam, right.world_from_cam, atol=1e-6)

    done = vipectl("unpack", "out", "artifacts")
    assert done.returncode == 0, done.stderr
    (pose,) = (tmp_path / "artifacts/pose").glob("*.npz")
    with np.load(pose) as arrays:
        assert arrays["data"].dtype == np.float32
        assert arrays["inds"].tolist() == list(range(12))

    assert service.end(signal.SIGTERM) == 0
    with contextlib.suppress(httpx.TransportError):
        pytest.fail(f"still answering: {httpx.get(f'http://127.0.0.1:{service.port}/healthz')}")


def test_nobody_there(vipectl: Run) -> None:
    done = vipectl("jobs", "--api", "http://127.0.0.1:9")
    assert done.returncode == 1
    assert "[unreachable]" in done.stderr
    assert "Traceback" not in done.stderr
