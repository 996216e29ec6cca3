"""Job control over HTTP: change, pause, resume, retry."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request

from services.api.authentication import Writer
from services.api.control_schemas import JobChanges, RetryRequest
from services.api.problems import responses
from services.api.routes import JobId, TheStore, require_json
from services.api.schemas import JobView
from services.api.webhooks import check_webhook
from services.domain.control import JobControl

router = APIRouter(prefix="/v1/jobs", tags=["control"])


@router.patch(
    "/{job_id}",
    dependencies=[Depends(require_json)],
    responses=responses(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503),
)
def change_job(job_id: JobId, body: JobChanges, caller: Writer, store: TheStore, request: Request) -> JobView:
    """Change how a job is run: its priority, limits and webhook, until it has ended."""
    changes = body.named()
    if changes.get("webhook_url") is not None:
        url, secret = changes["webhook_url"], changes["webhook_secret"]
        check_webhook(JobControl(webhook_url=url, webhook_secret=secret), caller.tenant, request.app.state.settings)
    return JobView.of(store.change_job(job_id, changes, tenant=caller.tenant))


@router.post("/{job_id}/pause", status_code=202, responses=responses(401, 403, 404, 409, 422, 429, 503))
def pause_job(job_id: JobId, caller: Writer, store: TheStore) -> JobView:
    """Pause a job. No new work begins; work under way is given back within seconds, finished videos are kept."""
    return JobView.of(store.request_pause(job_id, tenant=caller.tenant))


@router.post("/{job_id}/resume", status_code=202, responses=responses(401, 403, 404, 409, 422, 429, 503))
def resume_job(job_id: JobId, caller: Writer, store: TheStore) -> JobView:
    """Resume a paused job. A limit that paused it must be changed first."""
    return JobView.of(store.resume(job_id, tenant=caller.tenant))


@router.post(
    "/{job_id}/retry",
    status_code=202,
    dependencies=[Depends(require_json)],
    responses=responses(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503),
)
def retry_job(job_id: JobId, body: RetryRequest, caller: Writer, store: TheStore) -> JobView:
    """Try videos again that failed or were quarantined, in a job that succeeded with errors.

    They get new shards of the same job and output. What succeeded stays as it is.
    """
    return JobView.of(store.retry(job_id, body.to_selection(), tenant=caller.tenant))
