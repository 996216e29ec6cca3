"""Every error leaves as `application/problem+json` (RFC 9457) with a stable code and the request's id."""

from __future__ import annotations

import logging
import math
import re
from http import HTTPStatus
from typing import Any, ClassVar

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.types import Scope

from services.domain.errors import ServiceError
from services.domain.redaction import redact

MEDIA_TYPE = "application/problem+json"
_MAX_FIELD_ERRORS = 50
_FRAMEWORK_CODES = {
    400: "bad_request",
    404: "not_found",
    405: "method_not_allowed",
    408: "body_too_slow",
    413: "body_too_large",
}
_log = logging.getLogger(__name__)


class Unauthorized(ServiceError):
    """The key is missing or wrong."""

    code = "unauthorized"
    status = 401


class Forbidden(ServiceError):
    """The key is known, but it lacks the scope that the route needs."""

    code = "forbidden"
    status = 403


class RateLimited(ServiceError):
    """The caller asks more often than it may."""

    code = "rate_limited"
    status = 429
    retryable = True

    def __init__(self, message: str, *, retry_after_s: float) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class TooManyStreams(ServiceError):
    """The caller follows as many jobs at the same time as it may."""

    code = "too_many_streams"
    status = 429
    retryable = True


class UnsupportedMediaType(ServiceError):
    code = "unsupported_media_type"
    status = 415


class FieldError(BaseModel):
    """What is wrong with one part of a request."""

    field: str = Field(description="Where: `body.inputs.0`, `query.limit`.")
    message: str


class Problem(BaseModel):
    """An error as RFC 9457 has it, with a stable `code` for programs."""

    type: str = Field(description="`urn:vipe:problem:<code>`.")
    title: str
    status: int
    detail: str
    instance: str = Field(description="Path of the request.")
    code: str = Field(description="Stable; see the table of codes.")
    request_id: str = Field(description="Also in the `X-Request-ID` header and in the logs.")
    errors: list[FieldError] = Field(default_factory=list)

    media_type: ClassVar[str] = MEDIA_TYPE


def response(
    scope: Scope,
    status: int,
    code: str,
    detail: str,
    errors: list[FieldError] | None = None,
    headers: dict[str, str] | None = None,
) -> JSONResponse:
    """A problem about the request in `scope`."""
    scope.setdefault("state", {})["problem_code"] = code
    problem = Problem(
        type=f"urn:vipe:problem:{code}",
        title=code.replace("_", " ").capitalize(),
        status=status,
        detail=redact(detail),
        instance=redact(scope["path"]),
        code=code,
        request_id=scope.get("state", {}).get("request_id", ""),
        errors=errors or [],
    )
    return JSONResponse(problem.model_dump(), status_code=status, media_type=MEDIA_TYPE, headers=headers)


def of(scope: Scope, error: ServiceError) -> JSONResponse:
    """The problem that an error of the service is."""
    headers = {}
    if error.status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    if error.retryable:
        headers["Retry-After"] = str(max(1, math.ceil(error.retry_after_s)))
    return response(scope, error.status, error.code, str(error), headers=headers)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries for the problems that a route can answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": HTTPStatus(status).phrase, "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in statuses
    }


def _methods(document: dict[str, Any], path: str) -> str:
    """What a path can be asked for; the framework names the methods of the first route that has it only."""
    found = set()
    for template, operations in document["paths"].items():
        if re.fullmatch(re.sub(r"\\{\w+\\}", "[^/]+", re.escape(template)), path):
            found |= {method.upper() for method in operations}
    return ", ".join(sorted(found))


def install(app: FastAPI) -> None:
    """Handle the service's errors, invalid requests, and what the framework raises by itself."""

    @app.exception_handler(ServiceError)
    def on_service_error(request: Request, error: ServiceError) -> JSONResponse:
        if error.status >= 500:
            _log.error("%s %s: %s", request.method, request.url.path, error)
        return of(request.scope, error)

    @app.exception_handler(RequestValidationError)
    def on_invalid_request(request: Request, error: RequestValidationError) -> JSONResponse:
        found = [
            FieldError(field=".".join(str(part) for part in e["loc"]), message=redact(str(e["msg"])))
            for e in error.errors()[:_MAX_FIELD_ERRORS]
        ]
        if any(e["type"] == "json_invalid" for e in error.errors()):
            return response(request.scope, 400, "invalid_json", "the request body is not valid JSON", found)
        where = ", ".join(dict.fromkeys(e.field for e in found))
        return response(request.scope, 422, "invalid_request", f"the request is not valid: see {where}", found)

    @app.exception_handler(HTTPException)
    def on_http_error(request: Request, error: HTTPException) -> JSONResponse:
        code = _FRAMEWORK_CODES.get(error.status_code, f"http_{error.status_code}")
        detail = {
            404: f"there is nothing at {request.url.path}",
            405: f"{request.method} is not allowed at {request.url.path}",
        }.get(error.status_code, str(error.detail))
        headers = dict(error.headers or {})
        if error.status_code == 405 and (methods := _methods(request.app.openapi(), request.url.path)):
            headers["Allow"] = methods
        return response(request.scope, error.status_code, code, detail, headers=headers)
