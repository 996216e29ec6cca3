"""Failures of the service, with a stable code, an HTTP status and whether trying again can help.

Video errors (rows of `failures.parquet`) use the engine's codes of `vipe_core.errors` and, on top of them:
`worker_died` (the process died on this video as often as allowed: quarantined), `video_timeout`, `input_unavailable`.
"""

from __future__ import annotations

from typing import ClassVar

from services.domain.redaction import redact


class ServiceError(Exception):
    """Base of every error that the service raises on purpose. The message is shown to the caller."""

    code: ClassVar[str] = "service_error"
    status: ClassVar[int] = 500
    retryable: ClassVar[bool] = False
    retry_after_s: float = 5.0
    """When trying again makes sense, where it does at all."""


class InvalidRequest(ServiceError):
    code = "invalid_request"
    status = 422


class JobNotFound(ServiceError):
    code = "job_not_found"
    status = 404


class ShardNotFound(ServiceError):
    code = "shard_not_found"
    status = 404


class InvalidPageToken(ServiceError):
    code = "invalid_page_token"
    status = 400


class JobNotCancellable(ServiceError):
    code = "job_not_cancellable"
    status = 409


class JobNotPausable(ServiceError):
    code = "job_not_pausable"
    status = 409


class JobNotResumable(ServiceError):
    """The job is not paused, or the limit that paused it is still exceeded."""

    code = "job_not_resumable"
    status = 409


class JobNotRetryable(ServiceError):
    """The job has not ended, or ended without an output to add to."""

    code = "job_not_retryable"
    status = 409


class NothingToRetry(ServiceError):
    """No video of the job failed in the way that was asked for."""

    code = "nothing_to_retry"
    status = 409


class JobEnded(ServiceError):
    """The job has ended: nothing about how it runs can be changed any more."""

    code = "job_ended"
    status = 409


class QuotaExceeded(ServiceError):
    """The tenant has as much in its queue as it may have."""

    code = "quota_exceeded"
    status = 429
    retryable = True


class InvalidTransition(ServiceError):
    """The job is in a state from which this step does not exist."""

    code = "invalid_transition"
    status = 409


class OutputInUse(ServiceError):
    """The output location already belongs to another job."""

    code = "output_in_use"
    status = 409


class IdempotencyConflict(ServiceError):
    """The same `Idempotency-Key` came with another body."""

    code = "idempotency_conflict"
    status = 422


class IdempotencyInFlight(ServiceError):
    """A request with the same `Idempotency-Key` is being worked on."""

    code = "idempotency_in_flight"
    status = 409
    retryable = True
    retry_after_s = 1.0


class KeyNotFound(ServiceError):
    code = "key_not_found"
    status = 404


class InputUnavailable(ServiceError):
    """An input cannot be listed or fetched: it does not exist, or access is denied."""

    code = "input_unavailable"
    status = 422


class AddressRefused(ServiceError):
    """A URL or an address that the operator does not let users name."""

    code = "address_refused"
    status = 422


class InvalidManifest(ServiceError):
    """A list of videos that cannot be read, or a row of it that is not understood."""

    code = "invalid_manifest"
    status = 422


class InputTooLarge(ServiceError):
    """An input has more bytes, rows or members than the settings allow."""

    code = "input_too_large"
    status = 422


class HttpFailed(ServiceError):
    """A web server did not answer, or broke off."""

    code = "http_failed"
    status = 503
    retryable = True


class NameUnresolved(HttpFailed):
    """The name of a host has no address, now."""

    code = "name_unresolved"


class StorageError(ServiceError):
    """The object store refused or did not answer."""

    code = "storage_error"
    status = 503
    retryable = True


class ObjectMissing(StorageError):
    """The key does not exist."""

    code = "object_missing"
    status = 404
    retryable = False


class StorageRefused(StorageError):
    """The object store will keep saying no: wrong credentials, no permission, or no such bucket."""

    code = "storage_refused"
    status = 422
    retryable = False


class ConditionUnsupported(StorageRefused):
    """The object store does not know writes on the condition that nothing is there."""

    code = "condition_unsupported"


class StoreUnavailable(ServiceError):
    """The database does not answer, or stayed locked for longer than its patience."""

    code = "store_unavailable"
    status = 503
    retryable = True


class CommitConflict(ServiceError):
    """A commit record with another plan exists under this shard's name: two jobs share one output."""

    code = "commit_conflict"
    status = 409


class IntegrityError(ServiceError):
    """Stored bytes do not match their record."""

    code = "integrity_error"


def code_and_message(error: Exception) -> tuple[str, str]:
    """What a failed job says: a code and one line."""
    code = error.code if isinstance(error, ServiceError) else "internal_error"
    return code, redact(next(iter(str(error).splitlines()), type(error).__name__))
