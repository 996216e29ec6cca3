"""The API as Python calls. Answers are the API's JSON as dictionaries; its OpenAPI document names their fields."""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from types import TracebackType
from typing import Any, Literal

import httpx

from services.client.sse import parse_events
from services.domain.errors import IdempotencyInFlight, JobNotCancellable
from services.domain.events import ends_history
from services.domain.models import JobSpec
from services.domain.states import JobState

Json = dict[str, Any]
_RECONNECT_S = 1.0
_RECONNECT_FOR_S = 120.0
_RETRIES = 4
_MAX_WAIT_S = 30.0
_UNREACHABLE = "unreachable"


class ApiError(Exception):
    """The service said no, or did not answer.

    Attributes:
        code: The problem's stable code; `unreachable` when there was no answer.
        status: HTTP status; 0 when there was no answer.
        detail: One sentence.
        errors: What is wrong with which field, `[{"field": ..., "message": ...}]`.
        request_id: The service's log has it.
    """

    def __init__(
        self, code: str, status: int, detail: str, errors: list[dict[str, str]] | None = None, request_id: str = ""
    ) -> None:
        fields = "; ".join(f"{e['field']}: {e['message']}" for e in errors or [])
        super().__init__(f"{detail} ({fields})" if fields else detail)
        self.code = code
        self.status = status
        self.detail = detail
        self.errors = errors or []
        self.request_id = request_id


class Client:
    """Talks to one service. Thread-safe; close it, or use it as a context manager.

    Args:
        base_url: `http://host:port`.
        api_key: The service's key, where it has one.
        timeout_s: For an answer to begin.

    Raises:
        ApiError: By every method, when the service says no or cannot be reached.
    """

    def __init__(self, base_url: str, api_key: str | None = None, *, timeout_s: float = 30.0) -> None:
        headers = {"Accept": "application/json"}
        if api_key is not None:
            headers["Authorization"] = f"Bearer {api_key}"
        self._http = httpx.Client(base_url=base_url, headers=headers, timeout=timeout_s)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def ready(self) -> bool:
        """Whether the service answers and its store does."""
        try:
            return self._http.get("/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def submit(self, spec: JobSpec | Mapping[str, Any], *, idempotency_key: str | None = None) -> Json:
        """Create a job. Safe under lost answers: without a key of the caller's, one is made for this call.

        Args:
            spec: A `JobSpec`, or the fields of the request body.
            idempotency_key: The same key and spec give the same job, also in another call.
        """
        body = spec.to_json() if isinstance(spec, JobSpec) else dict(spec)
        key = idempotency_key or uuid.uuid4().hex
        return self._call("POST", "/v1/jobs", json=body, headers={"Idempotency-Key": key})

    def job(self, job_id: str) -> Json:
        """A job with its progress."""
        return self._call("GET", f"/v1/jobs/{job_id}")

    def jobs(self, *, state: JobState | str | None = None, limit: int | None = None) -> list[Json]:
        """Jobs, newest first; all of them, or the first `limit`."""
        page_size = None if limit is None else max(1, min(limit, 1000))
        return list(itertools.islice(self._pages("/v1/jobs", {"state": state, "limit": page_size}), limit))

    def videos(self, job_id: str, *, status: str | None = None, error_code: str | None = None) -> Iterator[Json]:
        """The videos of a job by key, fetched page by page."""
        return self._pages(f"/v1/jobs/{job_id}/videos", {"status": status, "error_code": error_code})

    def shards(self, job_id: str) -> Iterator[Json]:
        """The shards of a job in order, fetched page by page."""
        return self._pages(f"/v1/jobs/{job_id}/shards", {})

    def cancel(self, job_id: str) -> Json:
        """Ask for a job to be cancelled; what is committed stays. A job that is cancelled already is no error."""
        try:
            return self._call("POST", f"/v1/jobs/{job_id}/cancel")
        except ApiError as error:
            if error.code == JobNotCancellable.code:
                job = self.job(job_id)
                if job["state"] == JobState.CANCELLED:
                    return job
            raise

    def pause(self, job_id: str) -> Json:
        """Pause a job: no new work begins, what is under way is given back within seconds."""
        return self._call("POST", f"/v1/jobs/{job_id}/pause")

    def resume(self, job_id: str) -> Json:
        """Resume a paused job; a limit that paused it must be changed first."""
        return self._call("POST", f"/v1/jobs/{job_id}/resume")

    def change(self, job_id: str, **changes: Any) -> Json:
        """Change how a job is run: `priority`, `deadline` (aware, or RFC 3339), `max_slot_hours`, `max_failure_ratio`,
        `failure_window`, `webhook` (`{"url", "secret"}` or None)."""
        body = {name: value.isoformat() if isinstance(value, datetime) else value for name, value in changes.items()}
        return self._call("PATCH", f"/v1/jobs/{job_id}", json=body)

    def retry(
        self,
        job_id: str,
        *,
        error_codes: Sequence[str] = (),
        select: Literal["retryable", "quarantined"] | None = None,
    ) -> Json:
        """Try videos again, in new shards of a job that succeeded with errors.

        Not repeated when the answer is lost: look at the job's `retries` then.

        Args:
            job_id: Which.
            error_codes: Videos that failed with one of these; none: as `select` says.
            select: `retryable` (default): what another attempt can cure. `quarantined`: what killed its workers.
        """
        body: Json = {"error_codes": list(error_codes)} if error_codes else {}
        if select is not None:
            body["select"] = select
        return self._call("POST", f"/v1/jobs/{job_id}/retry", json=body)

    def events(self, job_id: str, *, after_seq: int = 0) -> Iterator[Json]:
        """A job's history and what happens next, until it has ended.

        A stream that breaks is taken up again behind the last event seen, for two minutes.

        Yields:
            `{"seq", "job_id", "at", "kind", "data"}`; and while the job runs, about once a second,
            `{"kind": "progress", "data": <the job>}`.
        """
        seq = after_seq
        heard_at = time.monotonic()
        ended = False
        while True:
            received, last = False, ""
            try:
                headers = {"Accept": "text/event-stream", "Last-Event-ID": str(seq)}
                with self._http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as response:
                    if response.status_code == 204:
                        return
                    if response.status_code != 200:
                        response.read()
                        raise _api_error(response)
                    for event in parse_events(response.iter_lines()):
                        heard_at = time.monotonic()
                        if event.name == "progress":
                            yield {"kind": "progress", "data": event.json()}
                            continue
                        seq = int(event.id or seq)
                        received, last = True, event.name
                        yield event.json()
                # It ended because the job has, or early because the service stops; a job that was retried goes on
                # behind an event that once was its last.
                terminal = JobState(self.job(job_id)["state"]).terminal
                if terminal and (ends_history(last) or (ended and not received)):
                    return
                ended = terminal
            except (httpx.TransportError, ApiError) as error:
                if isinstance(error, ApiError) and error.code != _UNREACHABLE:
                    raise
                if time.monotonic() - heard_at > _RECONNECT_FOR_S:
                    raise _unreachable(self._http, error) from error
            time.sleep(_RECONNECT_S)

    def wait(self, job_id: str, on_progress: Callable[[Json], None] | None = None, *, poll_s: float = 0.5) -> Json:
        """Wait until a job has ended.

        Args:
            job_id: Which.
            on_progress: Called with the job now and then, and at its end.
            poll_s: Pause between two looks.

        Returns:
            The job as it ended.
        """
        while True:
            job = self.job(job_id)
            if on_progress is not None:
                on_progress(job)
            if JobState(job["state"]).terminal:
                return job
            time.sleep(poll_s)

    def _pages(self, path: str, params: Mapping[str, Any], headers: dict[str, str] | None = None) -> Iterator[Json]:
        query = {name: str(value) for name, value in params.items() if value is not None}
        while True:
            page = self._call("GET", path, params=query, headers=headers)
            yield from page["items"]
            if page["next_page_token"] is None:
                return
            query["page_token"] = page["next_page_token"]

    def _call(self, method: str, path: str, **request: Any) -> Json:
        """Every call of this client may be repeated, so a connection that breaks is tried again."""
        for attempt in range(_RETRIES + 1):
            wait_s = 0.2 * 2**attempt
            try:
                response = self._http.request(method, path, **request)
            except httpx.TransportError as error:
                if attempt == _RETRIES:
                    raise _unreachable(self._http, error) from error
            else:
                if attempt == _RETRIES or not _may_be_repeated(response):
                    break
                wait_s = max(wait_s, min(_retry_after_s(response), _MAX_WAIT_S))
            time.sleep(wait_s)
        if not response.is_success:
            raise _api_error(response)
        answer: Json = response.json()
        return answer


def _may_be_repeated(response: httpx.Response) -> bool:
    """Whether the service was busy: without its store, with too many requests, or with the same one still."""
    if response.status_code == 409:
        return _api_error(response).code == IdempotencyInFlight.code
    return response.status_code in (429, 503)


def _retry_after_s(response: httpx.Response) -> float:
    if response.status_code == 503:
        return 0.0  # the store may be back sooner than the service can know
    given = response.headers.get("retry-after", "")
    return float(given) if given.isascii() and given.isdigit() else 0.0


def _api_error(response: httpx.Response) -> ApiError:
    if response.headers.get("content-type", "").startswith("application/problem+json"):
        problem = response.json()
        return ApiError(
            problem["code"], response.status_code, problem["detail"], problem["errors"], problem["request_id"]
        )
    return ApiError("unexpected_answer", response.status_code, f"unexpected answer from {response.url}")


def _unreachable(http: httpx.Client, error: Exception) -> ApiError:
    reason = str(error) or type(error).__name__
    return ApiError(_UNREACHABLE, 0, f"the service at {http.base_url} cannot be reached: {reason}")
