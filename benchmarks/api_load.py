"""How the API holds up: `python -m benchmarks.api_load`.

A real server process on a database, and clients that each submit a job, look at it a few times, list their jobs, and
begin again. The same clients ask `/healthz` first, in the same run: what that costs is HTTP and this machine, so the
ratio of the two is what the service adds. Prints requests per second, errors, median and 99th percentile by route, the
CPU time of the server per request, and its memory at the start, the middle and the end.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx

from benchmarks.processes import cpu_s_of, resident_bytes
from services.store.sql import SqlStore


@dataclass
class Load:
    """What one phase did."""

    seconds_by_route: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    errors: Counter[str] = field(default_factory=Counter)

    @property
    def requests(self) -> int:
        return sum(map(len, self.seconds_by_route.values()))


class Connection:
    """A client with one connection that is kept: as little work as possible, the server shares the cores with it."""

    def __init__(self, port: int, key: str) -> None:
        self._port = port
        self._head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {key}\r\nContent-Type: application/json\r\n"

    async def request(
        self, load: Load, method: str, route: str, path: str, body: object = None, headers: str = ""
    ) -> dict[str, Any] | None:
        """One request, timed; None and an error in `load` for what is not a success."""
        content = b"" if body is None else json.dumps(body).encode()
        head = f"{method} {path} HTTP/1.1\r\n{self._head}{headers}Content-Length: {len(content)}\r\n\r\n"
        start = time.perf_counter()
        try:
            if not hasattr(self, "_reader"):
                self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)
            self._writer.write(head.encode() + content)
            status_line, *lines = (await self._reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
            length = next(int(line.split(":")[1]) for line in lines if line.lower().startswith("content-length"))
            answer = await self._reader.readexactly(length)
        except (OSError, EOFError, StopIteration) as error:
            load.errors[f"{method} {route}: {type(error).__name__}"] += 1
            with contextlib.suppress(AttributeError):
                del self._reader
            return None
        load.seconds_by_route[f"{method} {route}"].append(time.perf_counter() - start)
        status = status_line.split()[1]
        if not status.startswith("2"):
            load.errors[f"{method} {route}: {status}"] += 1
            return None
        found: dict[str, Any] = json.loads(answer)
        return found


Behaviour = Callable[[Connection, Load, float, int], Awaitable[None]]


def submit_and_poll(pause_s: float, polls: int) -> Behaviour:
    numbers = itertools.count()

    async def behave(http: Connection, load: Load, until: float, client: int) -> None:
        await asyncio.sleep(pause_s * client / 200)  # not all in the same moment
        while time.monotonic() < until:
            number = next(numbers)
            body = {"inputs": ["/videos"], "output": f"/out/{os.getpid()}-{id(numbers)}-{number}"}
            job = await http.request(
                load, "POST", "/v1/jobs", "/v1/jobs", body, f"Idempotency-Key: {id(numbers)}-{number}\r\n"
            )
            for _ in range(polls):
                await asyncio.sleep(pause_s)
                if job is None or time.monotonic() >= until:
                    break
                await http.request(load, "GET", "/v1/jobs/{id}", f"/v1/jobs/{job['id']}")
            await http.request(load, "GET", "/v1/jobs", "/v1/jobs?limit=20")

    return behave


def ask_for_health(pause_s: float) -> Behaviour:
    async def behave(http: Connection, load: Load, until: float, client: int) -> None:
        await asyncio.sleep(pause_s * client / 200)
        while time.monotonic() < until:
            await http.request(load, "GET", "/healthz", "/healthz")
            await asyncio.sleep(pause_s)

    return behave


async def run(
    behaviour: Behaviour, port: int, keys: list[str], seconds: float, middle: Callable[[], None] = lambda: None
) -> Load:
    """All clients at once, each with a connection and a key of its own; `middle` is called at half time."""
    load = Load()
    until = time.monotonic() + seconds
    asyncio.get_running_loop().call_later(seconds / 2, middle)
    await asyncio.gather(*(behaviour(Connection(port, key), load, until, n) for n, key in enumerate(keys)))
    return load


@contextlib.contextmanager
def server(database_url: str, data_dir: str) -> Iterator[tuple[int, int]]:
    """`vipectl api` as a process: its port and process id."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = {
        "VIPE_DATA_DIR": data_dir,
        "VIPE_ALLOW_ANONYMOUS": "false",
        "VIPE_LOG_LEVEL": "WARNING",
    }
    command = [sys.executable, "-m", "services.cli.main", "api", "--port", str(port), "--database-url", database_url]
    process = subprocess.Popen(command, env={**os.environ, **settings})
    url = f"http://127.0.0.1:{port}"
    try:
        while True:
            with contextlib.suppress(httpx.TransportError):
                if httpx.get(f"{url}/readyz").is_success:
                    break
            if process.poll() is not None:
                raise SystemExit("the API did not start")
            time.sleep(0.2)
        yield port, process.pid
    finally:
        process.terminate()
        process.wait()


def report(title: str, load: Load, seconds: float, server_cpu_s: float) -> float:
    """Print a phase; gives the server's CPU milliseconds per request."""
    per_request_ms = 1e3 * server_cpu_s / max(load.requests, 1)
    print(
        f"\n{title}: {load.requests} requests in {seconds:.0f} s = {load.requests / seconds:.0f}/s, "
        f"{sum(load.errors.values())} errors, {per_request_ms:.2f} ms of the server's CPU each"
    )
    for route, taken in sorted(load.seconds_by_route.items()):
        p99 = statistics.quantiles(taken, n=100)[98] if len(taken) > 1 else taken[0]
        print(f"  {route:22} {len(taken):7}   p50 {1e3 * statistics.median(taken):7.1f} ms   p99 {1e3 * p99:7.1f} ms")
    for error, number in load.errors.most_common():
        print(f"  ERROR {error} x {number}")
    return per_request_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--pause", type=float, default=1.0, help="seconds between two requests of one client")
    parser.add_argument("--polls", type=int, default=6, help="looks at a job before the next one is submitted")
    parser.add_argument("--tenants", type=int, default=20)
    parser.add_argument("--database-url", help="default: SQLite in a temporary folder; postgresql://... for the other")
    args = parser.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        database_url = args.database_url or f"sqlite:///{folder}/load.db"
        store = SqlStore(database_url)
        keys = [store.create_key(f"client {i}", tenant=f"load-{i % args.tenants}")[1] for i in range(args.clients)]
        store.close()
        with server(database_url, folder) as (port, pid):
            memory = {"start": resident_bytes(pid) / 2**20}
            before = cpu_s_of(pid)
            health_s = args.seconds / 4
            health = asyncio.run(run(ask_for_health(args.pause), port, keys, health_s))
            base_ms = report(f"/healthz, {args.clients} clients", health, health_s, cpu_s_of(pid) - before)
            # Memory is compared from here on: by now everything that is made once is made.
            warm = asyncio.run(run(submit_and_poll(args.pause, 2), port, keys, 5.0))
            memory["after 5 s"] = resident_bytes(pid) / 2**20
            before = cpu_s_of(pid)

            def middle() -> None:
                memory["middle"] = resident_bytes(pid) / 2**20

            work = asyncio.run(run(submit_and_poll(args.pause, args.polls), port, keys, args.seconds, middle))
            title = f"submit and poll, {args.clients} clients"
            cost_ms = report(title, work, args.seconds, cpu_s_of(pid) - before)
            memory["end"] = resident_bytes(pid) / 2**20
        print(f"\na request costs the server {cost_ms / base_ms:.1f} times what /healthz costs it")
        print("memory of the API, MiB: " + ", ".join(f"{when} {mib:.0f}" for when, mib in memory.items()))
        if work.errors or warm.errors or health.errors:
            raise SystemExit(1)


if __name__ == "__main__":
    main()
