"""Jobs over HTTP. Handlers are synchronous: they run in the thread pool, never in the event loop.

What they depend on is asynchronous, as it waits for nothing: each would be a trip to the pool of its own.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from pydantic import AfterValidator

from services.api import paging
from services.api.authentication import Reader, Writer
from services.api.events import LAST_EVENT_ID, event_page, event_stream, wants_stream
from services.api.idempotency import IdempotencyKey, KeysInWork, RequestHash
from services.api.limits import address_of
from services.api.problems import UnsupportedMediaType, responses
from services.api.schemas import (
    EventPage,
    JobPage,
    JobRequest,
    JobView,
    ShardPage,
    ShardView,
    VideoPage,
    VideoView,
)
from services.api.webhooks import check_webhook
from services.domain.errors import InvalidRequest, JobNotFound, StorageRefused
from services.domain.models import JobSpec
from services.domain.states import JobState, VideoStatus
from services.settings import Settings
from services.store.base import Store


def _storable(job_id: str) -> str:
    """An id that no database can hold belongs to no job."""
    if "\x00" in job_id:
        raise JobNotFound(f"there is no job {job_id!r}")
    return job_id


JobId = Annotated[str, Path(max_length=64, description="`job_...`"), AfterValidator(_storable)]
Limit = Annotated[int, Query(ge=1, le=1000, description="Most items on the page.")]
PageToken = Annotated[str | None, Query(max_length=1024, description="`next_page_token` of the page before.")]


async def get_store(request: Request) -> Store:
    store: Store = request.app.state.store
    return store


async def require_json(content_type: Annotated[str, Header(include_in_schema=False)] = "") -> None:
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type != "application/json":
        raise UnsupportedMediaType(f"the body must be application/json, not {media_type or 'untyped'}")


TheStore = Annotated[Store, Depends(get_store)]

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    dependencies=[Depends(require_json)],
    responses={
        202: {
            "description": "Accepted. The job runs in the background.",
            "headers": {
                "Location": {"description": "Where the job is.", "schema": {"type": "string"}},
                "Idempotent-Replayed": {
                    "description": "`true` if this key and body had created the job before.",
                    "schema": {"type": "string", "enum": ["true"]},
                },
            },
        },
        **responses(400, 401, 403, 408, 409, 413, 415, 422, 429, 503),
    },
)
def create_job(
    body: JobRequest,
    caller: Writer,
    store: TheStore,
    request: Request,
    response: Response,
    request_hash: RequestHash,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Create a job. Sent again within 7 days with the same `Idempotency-Key` and body, it gets its first answer."""
    spec = body.to_spec()
    _check_places(spec, request.app.state.settings)
    control = body.to_control()
    check_webhook(control, caller.tenant, request.app.state.settings)
    working: KeysInWork = request.app.state.keys_in_work
    with working.on(caller.tenant, idempotency_key):
        job, created = store.create_job(
            spec, control=control, tenant=caller.tenant, idempotency_key=idempotency_key, request_hash=request_hash
        )
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if not created:
        response.headers["Idempotent-Replayed"] = "true"
    return JobView.of(job)


def _check_places(spec: JobSpec, settings: Settings) -> None:
    """Refuse at once what planning would refuse later."""
    from services.agent.config import input_rules  # The storage clients behind these are slow to import.
    from services.planner.planning import check_output_place

    rules = input_rules(settings)
    for uri in spec.inputs:
        rules.check(uri)
    try:
        check_output_place(spec.output, settings.output_roots, rules.buckets)
    except StorageRefused as error:
        raise InvalidRequest(str(error)) from error


@router.get("", responses=responses(400, 401, 403, 422, 429, 503))
def list_jobs(
    caller: Reader, store: TheStore, limit: Limit = 50, page_token: PageToken = None, state: JobState | None = None
) -> JobPage:
    """List jobs, newest first."""
    after = paging.cursor(page_token, of="jobs")
    jobs, after = store.list_jobs(tenant=caller.tenant, limit=limit, after=after, state=state)
    return JobPage(items=[JobView.of(job) for job in jobs], next_page_token=paging.token(after, of="jobs"))


@router.get("/{job_id}", responses=responses(401, 403, 404, 422, 429, 503))
def get_job(job_id: JobId, caller: Reader, store: TheStore) -> JobView:
    """Show a job and its progress."""
    return JobView.of(store.get_job(job_id, tenant=caller.tenant))


@router.post("/{job_id}/cancel", status_code=202, responses=responses(401, 403, 404, 409, 422, 429, 503))
def cancel_job(job_id: JobId, caller: Writer, store: TheStore) -> JobView:
    """Cancel a job. What is committed stays; work under way is stopped, and the job is cancelled when it has."""
    return JobView.of(store.request_cancel(job_id, tenant=caller.tenant))


@router.get("/{job_id}/videos", responses=responses(400, 401, 403, 404, 422, 429, 503))
def list_videos(
    job_id: JobId,
    caller: Reader,
    store: TheStore,
    status: VideoStatus | None = None,
    error_code: Annotated[str | None, Query(max_length=64, pattern=r"^[a-z0-9_]+$")] = None,
    limit: Limit = 100,
    page_token: PageToken = None,
) -> VideoPage:
    """List the videos of a job with their results, by key."""
    name = f"videos of {job_id}"
    after = paging.cursor(page_token, of=name)
    rows, after = store.list_videos(
        job_id, tenant=caller.tenant, status=status, error_code=error_code, limit=limit, after=after
    )
    return VideoPage(items=[VideoView.of(row) for row in rows], next_page_token=paging.token(after, of=name))


@router.get("/{job_id}/shards", responses=responses(400, 401, 403, 404, 422, 429, 503))
def list_shards(
    job_id: JobId, caller: Reader, store: TheStore, limit: Limit = 100, page_token: PageToken = None
) -> ShardPage:
    """List the shards of a job, in order."""
    name = f"shards of {job_id}"
    after = paging.cursor(page_token, of=name)
    shards, after = store.list_shards(job_id, tenant=caller.tenant, limit=limit, after=after)
    return ShardPage(items=[ShardView.of(s) for s in shards], next_page_token=paging.token(after, of=name))


@router.get(
    "/{job_id}/events",
    response_model=EventPage,
    responses={
        200: {
            "description": "A stream of events, or with `Accept: application/json` a page of them.",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
        204: {
            "description": "The job has ended, and `Last-Event-ID` names its last event: there is nothing to follow."
        },
        **responses(400, 401, 403, 404, 422, 429, 503),
    },
)
def list_events(
    request: Request,
    job_id: JobId,
    caller: Reader,
    store: TheStore,
    limit: Limit = 100,
    page_token: PageToken = None,
    last_event_id: Annotated[
        str | None, Header(max_length=20, pattern=LAST_EVENT_ID, description="Go on behind this event of the stream.")
    ] = None,
) -> Response | EventPage:
    """Follow a job.

    As a stream of server-sent events: its history and what happens next, each with its number as `id`, and while it
    runs a `progress` event about once a second (no `id`; its data is the job). It ends behind the last event of a job
    that has ended. Reconnect with `Last-Event-ID` to miss nothing.
    """
    if wants_stream(request.headers.get("accept", "")):
        state = request.app.state
        return event_stream(
            store,
            job_id,
            tenant=caller.tenant,
            after_seq=int(last_event_id or 0),
            draining=state.draining,
            reader=caller.key_id or address_of(request.scope),
            limit=state.streams,
            welcome=partial(state.authenticator.holds, caller),
        )
    return event_page(store, job_id, tenant=caller.tenant, limit=limit, page_token=page_token)
