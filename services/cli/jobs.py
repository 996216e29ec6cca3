"""`vipectl submit | jobs | status | watch | videos | set | pause | resume | cancel | retry`: the service over REST."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.addresses import absolute
from services.cli.engine_options import CameraModel, DetectionInterval, Preset, listed

if TYPE_CHECKING:
    from services.client import Client

ApiUrl = Annotated[str, typer.Option("--api", envvar="VIPE_API_URL", help="Address of the service.")]
ApiKey = Annotated[
    str | None, typer.Option("--api-key", envvar="VIPE_API_KEY", help="Bearer key, where the service asks.")
]
AsJson = Annotated[bool, typer.Option("--json", help="The service's JSON instead of a table.")]
DEFAULT_API = "http://127.0.0.1:8080"

Deadline = Annotated[
    str | None, typer.Option(metavar="TIME", help="When it passes, the job is paused: 2030-01-31T12:00:00Z; none.")
]
SlotHours = Annotated[
    str | None, typer.Option(metavar="HOURS", help="Hours of worker slots after which the job is paused; none.")
]
WebhookUrl = Annotated[str | None, typer.Option(metavar="URL", help="Who is told about the job's events.")]
WebhookSecret = Annotated[str | None, typer.Option(metavar="NAME", help="Name of the secret that signs them.")]


def _limits(deadline: str | None, max_slot_hours: str | None) -> dict[str, Any]:
    """The limits that were named; `none` takes one away."""
    limits: dict[str, Any] = {}
    if deadline is not None:
        limits["deadline"] = None if deadline == "none" else deadline
    if max_slot_hours is not None:
        try:
            limits["max_slot_hours"] = None if max_slot_hours == "none" else float(max_slot_hours)
        except ValueError:
            raise typer.BadParameter(f"--max-slot-hours takes a number or none, not {max_slot_hours!r}") from None
    return limits


def _client(api: str, api_key: str | None) -> Client:
    from services.client import Client

    return Client(api, api_key=api_key)


def _print_json(value: Any) -> None:
    sys.stdout.write(json.dumps(value, indent=2) + "\n")


def submit(
    inputs: Annotated[list[str], typer.Argument(metavar="INPUT...", help="Videos, directories, s3://bucket/prefix/.")],
    output: Annotated[
        str, typer.Option("-o", "--output", metavar="OUT", help="Directory or s3://bucket/prefix of this job.")
    ],
    preset: Preset = "classical",
    camera: CameraModel = None,
    name: str = "",
    scale_from: Annotated[
        str | None,
        typer.Option(metavar="KNOWN", help="A known length of every video, as `vipectl annotate --scale-from`."),
    ] = None,
    phrases: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="What to find and mask, as `vipectl annotate --phrases`.")
    ] = None,
    detection_interval: DetectionInterval = None,
    metric_depth: Annotated[
        str | None, typer.Option(metavar="NETWORK", help="What tells the scale, as `vipectl annotate --metric-depth`.")
    ] = None,
    tracks: Annotated[
        str | None,
        typer.Option(metavar="FOLLOWER", help="Tracks beside the DROID network, as `vipectl annotate --tracks`."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The camera of every video, as `vipectl annotate --calibration`."),
    ] = None,
    attributes: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="Tars to write: depth,rgb,mask,confidence; the last only if named."),
    ] = None,
    priority: Annotated[int, typer.Option(help="The highest of your jobs goes first.")] = 0,
    deadline: Deadline = None,
    max_slot_hours: SlotHours = None,
    webhook: WebhookUrl = None,
    webhook_secret: WebhookSecret = None,
    key: Annotated[
        str | None, typer.Option("--idempotency-key", help="The same key and job is never run twice.")
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Show progress until the job ends.")] = False,
    api: ApiUrl = DEFAULT_API,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Submit a job to a running service."""
    client = _client(api, api_key)
    spec: dict[str, Any] = {
        "inputs": [absolute(item) for item in inputs],
        "output": absolute(output).rstrip("/"),
        "preset": preset,
        "name": name,
        "priority": priority,
        **_limits(deadline, max_slot_hours),
    }
    if webhook is not None:
        spec["webhook"] = {"url": webhook, "secret": webhook_secret or ""}
    if camera is not None:
        spec["camera"] = camera
    if scale_from is not None:
        spec["scale_from"] = scale_from
    if phrases is not None:
        spec["phrases"] = listed(phrases)
    if detection_interval is not None:
        spec["detection_interval_s"] = detection_interval
    if metric_depth is not None:
        spec["metric_depth"] = metric_depth
    if tracks is not None:
        spec["tracks"] = tracks
    if calibration is not None:
        spec["calibration"] = _calibration(calibration)
    if attributes is not None:
        spec["attributes"] = listed(attributes)
    job = client.submit(spec, idempotency_key=key)
    if as_json:
        _print_json(job)
    else:
        typer.echo(job["id"])
    if wait:
        _watch(client, job["id"])


def _calibration(path: Path) -> dict[str, Any]:
    from vipe_core.cameras.calibration_files import read_calibration
    from vipe_core.errors import ConfigError

    try:
        return read_calibration(path).to_json()
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint="--calibration") from error


def list_jobs(limit: int = 20, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """List jobs, newest first."""
    from rich.table import Table

    from services.cli.tables import print_table

    found = _client(api, api_key).jobs(limit=limit)
    if as_json:
        _print_json(found)
        return
    table = Table(
        "job", "state", "videos", "failed", "frames", "created", "output", show_edge=False, header_style="bold"
    )
    for job in found:
        progress = job["progress"]
        settled = progress["videos_succeeded"] + progress["videos_failed"] + progress["videos_quarantined"]
        failed = progress["videos_failed"] + progress["videos_quarantined"]
        counts = (f"{settled}/{progress['videos_total']}", str(failed), str(progress["frames_done"]))
        table.add_row(job["id"], job["state"], *counts, job["created_at"], job["spec"]["output"])
    print_table(table)


def status(job_id: str, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None) -> None:
    """Show one job as JSON."""
    _print_json(_client(api, api_key).job(job_id))


def watch(job_id: str, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None) -> None:
    """Show a job's progress until it ends.

    Exit code 1 unless it succeeded without errors.
    """
    _watch(_client(api, api_key), job_id)


def _watch(client: Client, job_id: str) -> None:
    from services.cli.progress import show_progress

    job = show_progress(client, job_id)
    typer.echo(f"{job_id} {job['state']}" + (f": {job['error_message']}" if job.get("error_message") else ""))
    if job["state"] != "succeeded":
        raise typer.Exit(1)


def videos(
    job_id: str,
    status: Annotated[str | None, typer.Option(help="pending, succeeded, failed or quarantined.")] = None,
    api: ApiUrl = DEFAULT_API,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """List the videos of a job with their results."""
    found = _client(api, api_key).videos(job_id, status=status)
    if as_json:
        for video in found:
            sys.stdout.write(json.dumps(video) + "\n")
        return
    from services.cli.tables import annotation_table, print_table

    print_table(annotation_table(video for video in found if video["status"] != "pending"))


def cancel(job_id: str, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None) -> None:
    """Cancel a job; what is committed stays."""
    typer.echo(_client(api, api_key).cancel(job_id)["state"])


def pause(job_id: str, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None) -> None:
    """Pause a job: no new work begins, what is finished stays."""
    typer.echo(_client(api, api_key).pause(job_id)["state"])


def resume(job_id: str, api: ApiUrl = DEFAULT_API, api_key: ApiKey = None) -> None:
    """Resume a paused job."""
    typer.echo(_client(api, api_key).resume(job_id)["state"])


def change(
    job_id: str,
    priority: Annotated[int | None, typer.Option(help="The highest of your jobs goes first.")] = None,
    deadline: Deadline = None,
    max_slot_hours: SlotHours = None,
    max_failure_ratio: Annotated[
        float | None, typer.Option(help="Pause when more of the last videos failed; 0.5 is half of them.")
    ] = None,
    webhook: WebhookUrl = None,
    webhook_secret: WebhookSecret = None,
    api: ApiUrl = DEFAULT_API,
    api_key: ApiKey = None,
) -> None:
    """Change how a job is run: its priority, limits, webhook."""
    changes = _limits(deadline, max_slot_hours)
    if priority is not None:
        changes["priority"] = priority
    if max_failure_ratio is not None:
        changes["max_failure_ratio"] = max_failure_ratio
    if webhook is not None:
        changes["webhook"] = None if webhook == "none" else {"url": webhook, "secret": webhook_secret or ""}
    _print_json(_client(api, api_key).change(job_id, **changes)["control"])


def retry(
    job_id: str,
    error_code: Annotated[
        list[str] | None, typer.Option("--error-code", metavar="CODE", help="Videos that failed with it; repeatable.")
    ] = None,
    quarantined: Annotated[bool, typer.Option("--quarantined", help="Videos that killed their workers.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Show progress until the job ends.")] = False,
    api: ApiUrl = DEFAULT_API,
    api_key: ApiKey = None,
) -> None:
    """Try videos of a job again that failed; by default those that another attempt can cure."""
    client = _client(api, api_key)
    job = client.retry(job_id, error_codes=error_code or (), select="quarantined" if quarantined else None)
    typer.echo(job["state"])
    if wait:
        _watch(client, job_id)
