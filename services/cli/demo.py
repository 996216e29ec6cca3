"""`vipectl demo`: the whole system on sample videos, as a user would: a service process, REST, tars."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from services.client import Client

_MARKER = ".vipe-demo"
_START_TIMEOUT_S = 120.0
_STOP_TIMEOUT_S = 30.0


def demo(
    videos: Annotated[
        list[Path] | None, typer.Argument(metavar="[VIDEO...]", help="Your videos instead of the samples.")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of this run; replaced if a demo made it.")
    ] = Path("vipe_output/demo"),
) -> None:
    """Show the whole system on sample videos, or on yours.

    Starts the service, submits a job over REST, waits, verifies the output, scores it where the truth is known, and
    stops everything that it started.
    """
    from services.cli.tables import results_console

    console = results_console()
    output = output.resolve()
    inputs = [path.resolve() for path in videos or []]
    _make_room(output, inputs)
    samples = _samples(output / "videos", console) if not inputs else {}
    inputs = inputs or list(samples)
    with running_service(output / "service", console) as client:
        job = client.submit(
            {"inputs": [str(path) for path in inputs], "output": str(output / "dataset"), "name": "demo"}
        )
        console.print(
            f"Submitted [bold]{job['id']}[/] over REST: {len(inputs)} videos -> {output / 'dataset'}", soft_wrap=True
        )
        from services.cli.progress import describe, show_progress

        job = show_progress(client, job["id"], console)
        console.print(describe(job))
        rows = list(client.videos(job["id"])) if job["progress"]["videos_total"] else []
    succeeded = _report(console, job, rows, samples, output)
    if not succeeded:
        raise typer.Exit(1)


def _make_room(output: Path, inputs: list[Path]) -> None:
    """An earlier demo is replaced; anything else in the way is the user's and stays."""
    for path in inputs:
        if not path.exists():
            raise typer.BadParameter(f"{path} does not exist")
        if path.is_relative_to(output):
            raise typer.BadParameter(f"{path} lies in {output}, which this run replaces; choose another --output")
    if output.exists() and any(output.iterdir()):
        if not (output / _MARKER).is_file():
            raise typer.BadParameter(f"{output} is not empty and was not made by a demo; choose another with --output")
        shutil.rmtree(output)
    output.mkdir(parents=True, exist_ok=True)
    (output / _MARKER).touch()


def _samples(folder: Path, console: Console) -> dict[Path, Path]:
    """Sample video -> its ground truth; rendered on first use, then taken from the cache."""
    from vipe_core.evaluation.samples import DEMO_NAMES, sample_path

    folder.mkdir()
    truths = {}
    for name in DEMO_NAMES:
        with console.status(f"Rendering the sample video {name} ..."):
            sample = sample_path(name)
        video = folder / f"{name}.mp4"
        shutil.copyfile(sample.video, video)
        truths[video] = sample.truth
    return truths


@contextlib.contextmanager
def running_service(folder: Path, console: Console, slots: int | None = None) -> Iterator[Client]:
    """A service process of its own on a free loopback port; stopped, children included, on the way out."""
    folder.mkdir(parents=True)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log_path = folder / "service.log"
    command = [sys.executable, "-m", "services.cli.main", "up", "--port", str(port), "--data-dir", str(folder)]
    # Settings of a production service on this machine (its database, its Ray) are not for the demo.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("VIPE_")}
    if slots is not None:
        environment["VIPE_NUM_SLOTS"] = str(slots)
    with log_path.open("wb") as log, _interrupted_by_signals():
        process = subprocess.Popen(
            command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=environment, start_new_session=True
        )
        yield from _attend(process, port, log_path, console)


@contextlib.contextmanager
def _interrupted_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP (a closed terminal) end a block like Ctrl-C does, so that it can clean up."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _attend(process: subprocess.Popen[bytes], port: int, log_path: Path, console: Console) -> Iterator[Client]:
    from services.client import Client

    try:
        client = Client(f"http://127.0.0.1:{port}")
        with console.status("Starting the service (SQLite, local Ray, API on loopback) ..."):
            _wait_ready(client, process, log_path)
        console.print(
            f"Service on http://127.0.0.1:{port} (docs at /docs, metrics at /metrics), log in {log_path}",
            soft_wrap=True,
        )
        yield client
    finally:
        _stop(process)


def _wait_ready(client: Client, process: subprocess.Popen[bytes], log_path: Path) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not client.ready():
        if process.poll() is not None or time.monotonic() > deadline:
            tail = "\n".join(log_path.read_text(errors="replace").splitlines()[-20:])
            typer.echo(f"The service did not start. The end of {log_path}:\n{tail}", err=True)
            raise typer.Exit(1)
        time.sleep(0.2)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Graceful first; what is left of the session's process group is killed."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_STOP_TIMEOUT_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _report(
    console: Console, job: dict[str, Any], rows: list[dict[str, Any]], samples: dict[Path, Path], output: Path
) -> bool:
    """Verify, unpack, score and show; True if every video has an annotation and the output is whole."""
    from services.cli.data import summary
    from services.cli.tables import annotation_table
    from services.dataset import unpack, verify
    from services.storage import open_store

    if job["state"] not in {"succeeded", "succeeded_with_errors"}:
        console.print(f"[red]The job {job['state']}: {job.get('error_message') or 'see the service log'}")
        return False
    dataset = open_store(str(output / "dataset"))
    report = verify(dataset, deep=True)
    console.print(f"Verified {output / 'dataset'} by reading it back. {summary(report)}", soft_wrap=True)
    for problem in report.problems:
        console.print(f"  {problem}", style="red", soft_wrap=True)
    done = [row for row in rows if row["status"] == "succeeded"]
    scores = {}
    if done:
        unpack(dataset, output / "artifacts")
        scores = _scores(done, samples, output)
    console.print()
    console.print(annotation_table(rows, scores))
    console.print()
    if done:
        _say_what_next(console, output)
    return report.ok and len(done) == len(rows)


def _scores(done: list[dict[str, Any]], samples: dict[Path, Path], output: Path) -> dict[str, dict[str, float]]:
    """Errors of the videos that have ground truth, by key; draws one picture per video on the way."""
    from vipe_core.evaluation.artifact_sheet import artifact_sheet
    from vipe_core.evaluation.truth import evaluate_artifacts, read_truth
    from vipe_core.formats import read_artifacts

    scores = {}
    for row in done:
        artifacts = read_artifacts(output / "artifacts", row["key"])
        truth_path = samples.get(Path(row["uri"]))
        truth = read_truth(truth_path) if truth_path else None
        artifact_sheet(artifacts, output / "pictures" / f"{row['key']}.png", truth=truth)
        if truth is None:
            continue
        errors = evaluate_artifacts(artifacts, truth)
        if errors.camera is not None and errors.trajectory.ate_percent is not None:
            scores[row["key"]] = {"ate_pct": errors.trajectory.ate_percent, "fov_err_deg": errors.camera.fov_x_deg}
    return scores


def _say_what_next(console: Console, output: Path) -> None:
    here, vipectl = _near(output), _near(Path(sys.executable).parent / "vipectl")
    lines = (
        ("Look at the result:", ""),
        (f"  {here}/pictures/", "frames, depth, points and camera path of each video in one PNG"),
        (f"  {here}/artifacts/", "pose/ intrinsics/ depth/ rgb/ mask/, as nvidia-vipe lays them out"),
        (f"  {here}/dataset/", "webdataset tars, meta.parquet, failures.parquet, dataset.json"),
        ("Go on:", ""),
        (f"  {vipectl} verify {here}/dataset --deep", ""),
        (f"  {vipectl} export {here}/dataset {here}/npz --format npz", ""),
        (f"  {vipectl} gallery {here}/dataset {here}/gallery", "ten pictures and two films of each video"),
        (f"  {vipectl} annotate YOUR_VIDEO.mp4 -o vipe_output/mine", ""),
        (f"  {vipectl} up", "the service on http://127.0.0.1:8080, until Ctrl-C"),
    )
    for text, comment in lines:
        console.print(text + (f"   [dim]# {comment}[/]" if comment else ""), soft_wrap=True)


def _near(path: Path) -> Path:
    """Relative to the current folder where the path is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
