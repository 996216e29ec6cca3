"""A job of many small videos while everything around it breaks: `python -m benchmarks.chaos --seed 1 --minutes 5`.

Real processes: the API, two agents with a private Ray each, PostgreSQL (SQLite where there is no server), an S3 service
behind a proxy; the real decoder, artifacts, tars and commits on clips of a second. The engine itself is left out (its
processor time says nothing about the service) unless `--real-engine` asks for it, on a machine that has the cores. A
seed decides which fault comes when and where. In the end `vipectl verify --deep` has the last word, and every video
must have the outcome that it deserves.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import boto3
import cv2
import numpy as np

from benchmarks.chaos.faults import Injected, Injector, schedule
from benchmarks.chaos.report import Verdict, account_for_lost_work, judge, print_report
from benchmarks.chaos.world import AGENTS, BUCKET, World
from services.domain.errors import StoreUnavailable
from services.domain.models import Event, JobSpec
from services.store.sql import SqlStore
from vipe_core.video.encode import VideoWriter

_POISON = 2
_FRAMES, _WIDTH, _HEIGHT = 16, 128, 96
# The faults come within this share of the time; the rest is for the job to end.
_SPAN = 0.8
_PATIENCE = 4.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=5.0, help="over which the faults and the work are spread")
    parser.add_argument("--videos", type=int, default=64)
    parser.add_argument("--real-engine", action="store_true", help="estimate poses and depth, too")
    parser.add_argument("--keep", type=Path, help="keep logs and database in this folder")
    arguments = parser.parse_args()
    root = arguments.keep or Path(tempfile.mkdtemp(prefix="vipe-chaos-"))
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    try:
        verdict = run(root.resolve(), arguments.seed, arguments.minutes * 60, arguments.videos, arguments.real_engine)
    finally:
        if arguments.keep is None:
            shutil.rmtree(root, ignore_errors=True)
    sys.exit(0 if verdict.ok else 1)


def run(root: Path, seed: int, seconds: float, num_videos: int, real_engine: bool = False) -> Verdict:
    # What the agents would do in half of the time is stretched over most of it, or the job would end before the faults.
    pace_s = seconds * 0.7 * len(AGENTS) / num_videos
    world = World(root, pace_s, seed, real_engine)
    try:
        world.start()
        names = upload_inputs(world, num_videos, seed)
        store = SqlStore(world.database_url)
        try:
            return watch(world, store, seed, seconds, names)
        finally:
            store.close()
    finally:
        world.stop()


def watch(world: World, store: SqlStore, seed: int, seconds: float, names: list[str]) -> Verdict:
    """Submit the job, break things on time, see who notices, and judge the end."""
    while not world.client.ready():
        time.sleep(0.2)
    spec = JobSpec((f"s3://{BUCKET}/in/",), f"s3://{BUCKET}/out", attributes=("pose", "intrinsics", "depth"))
    job_id = world.client.submit(JobSpec(**{**spec.to_json(), "shard_max_videos": 3}))["id"]
    while not world.work():  # Ray and the engine start slowly; the faults wait for work to break into.
        time.sleep(0.5)
    faults = schedule(seed, seconds * _SPAN)
    injector, waiting = Injector(world), list(faults)
    events: list[Event] = []
    started = time.time()
    print(f"seed {seed}: {len(names)} videos, {len(faults)} faults over {seconds * _SPAN:.0f} s", flush=True)
    while True:
        while waiting and time.time() - started >= waiting[0].planned_s:
            fault = waiting.pop(0)
            print(f"{time.time() - started:6.1f} s  {fault.kind.name} ({fault.agent})", flush=True)
            threading.Thread(target=injector.inject, args=(fault,), daemon=True).start()
        with contextlib.suppress(StoreUnavailable):
            events += store.events(job_id, after_seq=events[-1].seq if events else 0)
        for fault in faults:
            if fault.at:
                _look(world, fault, events)
        ended = [e for e in events if e.kind in ("job.succeeded", "job.succeeded_with_errors", "job.failed")]
        late = time.time() - started > _PATIENCE * seconds
        if late or (ended and not waiting and all(f.recovered or not f.happened for f in faults if f.at)):
            break
        if ended and time.time() - ended[0].at.timestamp() > 20:
            break
        time.sleep(0.5)
    account_for_lost_work(world.work(), faults)
    verdict = judge(store, job_id, faults, verify(world), names)
    print_report(verdict, faults, time.time() - started)
    return verdict


def verify(world: World) -> tuple[int, str]:
    """Exit code and last words of `vipectl verify --deep` in a process of its own."""
    world.proxy.modes.clear()
    command = ["-m", "services.cli.main", "verify", f"s3://{BUCKET}/out", "--deep", "--s3-endpoint", world.proxy.url]
    done = subprocess.run([sys.executable, *command], check=False, capture_output=True, text=True)
    return done.returncode, (done.stdout + done.stderr).strip()


def _look(world: World, fault: Injected, events: list[Event]) -> None:
    """Has it been noticed, does it work again?"""
    kind = fault.kind
    if kind.by_order and kind.name != "bad-slot" and not fault.video:
        taken = next((world.root / "taken").glob(f"{kind.name}.*"), None)
        if taken is None:
            return
        _, fault.video, at = taken.name.split(".", 2)
        fault.at = fault.over = float(at)
    if not fault.happened:
        return
    if fault.noticed is None:
        if kind.name == "agent-sigkill":
            fault.noticed = _first(
                e.at.timestamp() for e in events if e.kind == "shard.expired" and e.at.timestamp() > fault.at
            )
        elif kind.noticed:
            agents = (fault.agent,) if kind.working == "agent" else AGENTS
            lines = (line for agent in agents for line in world.log_lines(agent))
            fault.noticed = _first(at for at, text in lines if at >= fault.at and kind.noticed in text)
        if fault.noticed is not None and kind.name == "bad-slot":
            (world.root / "orders" / f"bad-slot.{fault.agent}").unlink(missing_ok=True)
            fault.over = time.time()
    since = max(fault.over, fault.noticed or 0.0)
    if fault.recovered is None and (kind.name != "bad-slot" or fault.noticed):
        match kind.working:
            case "agent":
                ends = (float(w["at"]) for w in world.work() if w["agent"] == fault.agent and w["event"] == "end")
                fault.recovered = _first(at for at in ends if at > since)
            case "commit":
                commits = (e.at.timestamp() for e in events if e.kind == "shard.committed")
                fault.recovered = _first(at for at in commits if at > since)
            case _:
                fault.recovered = time.time() if time.time() > since and world.client.ready() else None


def _first(times: Any) -> float | None:
    return min(times, default=None)


def upload_inputs(world: World, number: int, seed: int) -> list[str]:
    """Clips of a camera that moves past a textured wall, two that kill and one that is cut short; their names."""
    client = boto3.client("s3", endpoint_url=world.proxy.url)
    names = [f"v{n:03d}" for n in range(number - _POISON - 1)]
    names += [f"poison{n}" for n in range(_POISON)] + ["cut"]
    order = np.random.default_rng(seed).permutation(len(names))
    renamed = {}
    for position, index in enumerate(order):
        # Keys are listed in name order; a prefix spreads the bad ones over the job.
        name = names[index]
        renamed[name] = name if name.startswith(("poison", "cut")) else f"v{position:03d}"
    path = world.root / "clip.mp4"
    for name in sorted(renamed.values()):
        write_clip(path, seed * 1000 + len(name) + hash_of(name))
        data = path.read_bytes()
        client.put_object(Bucket=BUCKET, Key=f"in/{name}.mp4", Body=data[: len(data) // 3] if name == "cut" else data)
    return sorted(renamed.values())


def hash_of(name: str) -> int:
    return int.from_bytes(name.encode()[-3:], "big")


def write_clip(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    near, far = (_texture(rng) for _ in range(2))
    with VideoWriter(path, 10.0) as writer:
        for index in range(_FRAMES):
            picture = far[:, index : index + _WIDTH].copy()
            picture[_HEIGHT // 2 :] = near[_HEIGHT // 2 :, 4 * index : 4 * index + _WIDTH]
            writer.write(np.ascontiguousarray(picture))


def _texture(rng: np.random.Generator) -> np.ndarray:
    picture = np.zeros((_HEIGHT, 3 * _WIDTH, 3), np.float32)
    for cells in (4, 12, 36):
        noise = rng.uniform(0, 80, (cells, 3 * cells, 3)).astype(np.float32)
        picture += cv2.resize(noise, (3 * _WIDTH, _HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    main()
