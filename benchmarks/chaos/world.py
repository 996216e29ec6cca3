"""The processes of a chaos run: PostgreSQL or SQLite, an S3 service behind a proxy, the API, two agents with Ray."""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import boto3

from benchmarks.chaos.engine import AGENT_VARIABLE, PACE_VARIABLE, REAL_VARIABLE, ROOT_VARIABLE
from benchmarks.chaos.s3_proxy import S3Proxy
from services.client import Client

AGENTS = ("a", "b")
BUCKET = "chaos"
_REPOSITORY = Path(__file__).resolve().parents[2]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Process:
    """A process of this machine, as the kernel shows it."""

    pid: int
    parent: int
    name: str
    command: str


def processes() -> dict[int, Process]:
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                stat = (folder / "stat").read_text()
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                name, _, rest = stat.partition("(")[2].rpartition(")")
                state, parent = rest.split()[:2]
                if state != "Z":
                    pid = int(folder.name)
                    found[pid] = Process(pid, int(parent), name, command)
    return found


def descendants(pid: int) -> list[Process]:
    table = processes()
    family = {pid}
    while grown := {p.pid for p in table.values() if p.parent in family} - family:
        family |= grown
    return [table[p] for p in sorted(family - {pid}) if p in table]


class Postgres:
    """A server of our own: on a Unix socket, as an unprivileged user where we are root."""

    def __init__(self, root: Path, binaries: Path) -> None:
        self._binaries = binaries
        self._folder = Path(tempfile.mkdtemp(prefix="vipe-chaos-pg-"))
        self._account: dict[str, int] = {}
        if os.geteuid() == 0:
            user = next(u for u in pwd.getpwall() if u.pw_name in ("postgres", "nobody"))
            self._account = {"user": user.pw_uid, "group": user.pw_gid}
            os.chown(self._folder, user.pw_uid, user.pw_gid)
        self._log = root / "postgres.log"
        self._process: subprocess.Popen[bytes] | None = None
        subprocess.run(
            [binaries / "initdb", "-D", self._folder / "data", "-U", "vipe", "-A", "trust", "-E", "UTF8", "--no-sync"],
            check=True,
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            user=self._account.get("user"),
            group=self._account.get("group"),
        )
        self.url = f"postgresql://vipe@/postgres?host={self._folder}"

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [
                    self._binaries / "postgres",
                    "-D",
                    self._folder / "data",
                    "-k",
                    self._folder,
                    "-c",
                    "listen_addresses=",
                ],
                cwd=self._folder,
                stdout=log,
                stderr=log,
                user=self._account.get("user"),
                group=self._account.get("group"),
            )
        while not self._ready():
            time.sleep(0.1)

    def crash(self) -> None:
        """Immediate shutdown: connections break, and the next start has to recover."""
        assert self._process is not None
        self._process.send_signal(signal.SIGQUIT)
        self._process.wait()

    def remove(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self.crash()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _ready(self) -> bool:
        command = [str(self._binaries / "pg_isready"), "-q", "-h", str(self._folder), "-U", "vipe"]
        return subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode == 0


def postgres_binaries() -> Path | None:
    """Folder of `initdb` and `postgres`; None if there is no server on this machine."""
    on_path = shutil.which("initdb")
    if on_path is not None:
        return Path(on_path).resolve().parent
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[-3]))
    return versions[-1].parent if versions else None


@dataclass
class World:
    """Everything that runs, in a folder of its own. `start` and `stop` once each."""

    root: Path
    pace_s: float
    seed: int
    real_engine: bool = False
    postgres: Postgres | None = None
    _children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self) -> None:
        for folder in ("orders", "taken", "data", "inputs"):
            (self.root / folder).mkdir(parents=True, exist_ok=True)
        binaries = postgres_binaries()
        if binaries is not None:
            self.postgres = Postgres(self.root, binaries)
            self.postgres.start()
        self.database_url = self.postgres.url if self.postgres else f"sqlite:///{self.root}/vipe.db"
        self._spawn("s3", [sys.executable, "-u", "-m", "moto.server", "-H", "127.0.0.1", "-p", "0"])
        self.proxy = S3Proxy(self._s3_address(), seed=self.seed).start()
        os.environ.update(AWS_ACCESS_KEY_ID="chaos", AWS_SECRET_ACCESS_KEY="chaos", AWS_DEFAULT_REGION="us-east-1")
        boto3.client("s3", endpoint_url=self.proxy.url).create_bucket(Bucket=BUCKET)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.client = Client(f"http://127.0.0.1:{self.port}")
        self.start_api()
        for agent in AGENTS:
            self.start_agent(agent)

    def start_api(self) -> None:
        command = ["-m", "services.cli.main", "api", "--port", str(self.port), "--database-url", self.database_url]
        self._spawn("api", [sys.executable, *command])

    def start_agent(self, agent: str) -> None:
        arguments = [self.database_url, str(self.root / f"agent-{agent}" / "scratch")]
        self._spawn(agent, [sys.executable, "-m", "benchmarks.chaos.agent_process", *arguments], agent=agent)

    def stop(self) -> None:
        for name in (*AGENTS, "api", "s3"):
            child = self._children.get(name)
            if child is not None and child.poll() is None:
                child.send_signal(signal.SIGCONT)
                child.terminate()
        for child in self._children.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(30)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        self.proxy.stop()
        if self.postgres is not None:
            self.postgres.remove()

    def break_database(self) -> Callable[[], None]:
        """Crash PostgreSQL, or lock SQLite against everybody; returns what ends it."""
        if self.postgres is not None:
            self.postgres.crash()
            return self.postgres.start
        lock = sqlite3.connect(self.root / "vipe.db", isolation_level=None, check_same_thread=False)
        lock.execute("BEGIN EXCLUSIVE")
        return lock.close

    def pid(self, name: str) -> int:
        return self._children[name].pid

    def signal(self, name: str, number: int) -> None:
        self._children[name].send_signal(number)
        if number == signal.SIGKILL:
            self._children[name].wait()

    def worker(self, agent: str) -> Process | None:
        """The worker process of an agent that is running a task."""
        return next((p for p in descendants(self.pid(agent)) if p.command.startswith("ray::SlotActor")), None)

    def decoder(self, agent: str) -> Process | None:
        return next((p for p in descendants(self.pid(agent)) if "decoder_child" in p.command), None)

    def head(self, agent: str) -> list[Process]:
        return [p for p in descendants(self.pid(agent)) if p.name in ("gcs_server", "raylet")]

    def log_lines(self, name: str) -> list[tuple[float, str]]:
        """(unix time, message) of what a process logged."""
        lines = []
        for line in (self.root / f"{name}.log").read_text(errors="replace").splitlines():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                document = json.loads(line)
                lines.append((_unix(document["time"]), str(document["message"])))
        return lines

    def work(self) -> list[dict[str, Any]]:
        """Beginnings and ends of videos, oldest first."""
        path = self.root / "work.log"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def _spawn(self, name: str, command: list[str], *, agent: str = "") -> None:
        environment = {key: value for key, value in os.environ.items() if not key.startswith("VIPE_")}
        environment.update(dict.fromkeys(_THREADS, "1"), OMP_WAIT_POLICY="passive", PYTHONPATH=str(_REPOSITORY))
        environment["RAY_USAGE_STATS_ENABLED"] = "0"
        environment[ROOT_VARIABLE] = str(self.root)
        environment[PACE_VARIABLE] = str(self.pace_s)
        environment[AGENT_VARIABLE] = agent
        environment[REAL_VARIABLE] = str(int(self.real_engine))
        environment["VIPE_DATA_DIR"] = str(self.root / "data")
        environment["VIPE_LOG_FORMAT"] = "json"
        if name != "s3":
            environment["VIPE_S3_ENDPOINT_URL"] = self.proxy.url
        with (self.root / f"{name}.log").open("ab") as log:
            self._children[name] = subprocess.Popen(
                command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment, start_new_session=True
            )

    def _s3_address(self) -> str:
        log = self.root / "s3.log"
        while not (found := re.search(r"Running on (http://127\.0\.0\.1:\d+)", log.read_text())):
            if self._children["s3"].poll() is not None:
                raise RuntimeError(f"the S3 service did not start: {log.read_text()[-500:]}")
            time.sleep(0.1)
        return found[1]


def _unix(stamp: str) -> float:
    return datetime.fromisoformat(stamp).timestamp()
