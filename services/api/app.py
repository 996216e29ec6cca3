"""The application: routes, authentication, errors, OpenAPI."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.openapi.utils import get_openapi
from starlette.middleware.cors import CORSMiddleware

from services.api import access_routes, control, problems, routes
from services.api.audit import AuditTrail
from services.api.authentication import Authenticator, serves_anonymous
from services.api.guard import Guard
from services.api.hosts import KnownHosts, OwnOrigins, is_loopback
from services.api.idempotency import KeysInWork
from services.api.limits import StreamLimit
from services.api.middleware import BodyLimit, RequestContext
from services.api.problems import Problem
from services.api.schemas import Readiness, Status
from services.domain.errors import StoreUnavailable
from services.observability.metrics import CONTENT_TYPE, Metrics, package_version
from services.settings import Settings
from services.store.base import Store

# No cookies: who may use the API has a key to send.
_CORS: dict[str, Any] = {
    "allow_methods": ["GET", "POST", "PUT", "PATCH", "DELETE"],
    "allow_headers": ["Authorization", "Content-Type", "Idempotency-Key", "If-Match", "Last-Event-ID", "X-Request-ID"],
    "expose_headers": ["ETag", "Idempotent-Replayed", "Location", "Retry-After", "X-Request-ID"],
}


def create_app(
    store: Store,
    settings: Settings,
    metrics: Metrics | None = None,
    agent_ready: Callable[[], bool] | None = None,
) -> FastAPI:
    """The API over a store. The caller opens and closes the store.

    Args:
        store: Where the jobs are.
        settings: What concerns access, names and limits is used here.
        metrics: What `/metrics` shows; share it with an agent in the same process. Default: one of its own.
        agent_ready: Whether the agent in the same process can work, shown by `/readyz`; None where there is no agent.
    """
    app = FastAPI(
        title="ViPE annotation service",
        version=package_version(),
        summary="Camera poses, intrinsics and dense depth from raw video.",
        redoc_url=None,
    )
    metrics = metrics or Metrics()
    app.state.store = store
    app.state.settings = settings
    app.state.metrics = metrics
    app.state.agent_ready = agent_ready
    app.state.draining = threading.Event()
    app.state.authenticator = Authenticator(store, settings)
    app.state.trail = AuditTrail(store)
    app.state.streams = StreamLimit(settings.max_streams_per_key)
    app.state.keys_in_work = KeysInWork()

    problems.install(app)
    # The last that is added is the first that sees a request.
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes, timeout_s=settings.receive_timeout_s)
    app.add_middleware(
        Guard,
        authenticator=app.state.authenticator,
        trail=app.state.trail,
        rate_per_s=settings.rate_limit_per_s,
        burst=settings.rate_limit_burst,
        max_wrong_keys=settings.max_wrong_keys,
    )
    app.add_middleware(OwnOrigins, allowed=settings.cors_origins)
    if settings.cors_origins:
        app.add_middleware(CORSMiddleware, **_CORS, allow_origins=settings.cors_origins)
    open_on_loopback = serves_anonymous(settings) and is_loopback(settings.host)
    if open_on_loopback or settings.allowed_hosts:
        app.add_middleware(KnownHosts, names=settings.allowed_hosts, loopback=open_on_loopback)
    app.add_middleware(RequestContext, metrics=metrics)
    app.include_router(routes.router)
    app.include_router(control.router)
    app.include_router(access_routes.router)
    app.include_router(_operations)
    _document_problems(app)
    return app


_operations = APIRouter(tags=["operations"])


@_operations.get("/healthz")
async def healthz() -> Status:
    """The process answers, also while every thread waits for the database."""
    return Status()


@_operations.get("/readyz", responses=problems.responses(503), response_model_exclude_none=True)
def readyz(request: Request) -> Readiness:
    """The store answers too. An agent beside the API is shown, but jobs are accepted without it."""
    request.app.state.store.ping()
    agent_ready: Callable[[], bool] | None = request.app.state.agent_ready
    if agent_ready is None:
        return Readiness()
    return Readiness(agent="ready" if agent_ready() else "starting")


@_operations.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def metrics(request: Request) -> Response:
    """Prometheus metrics, without the store's counts while it does not answer."""
    page: Metrics = request.app.state.metrics
    store: Store = request.app.state.store
    try:
        page.set_counts(store.counts())
        page.set_tenants(store.list_tenants())
        page.webhooks_waiting.set(store.undelivered())
    except StoreUnavailable:
        page.store_is_down()
    return Response(page.render(), media_type=CONTENT_TYPE)


def _document_problems(app: FastAPI) -> None:
    """Add the schema of problems, which routes refer to by name, and drop the framework's own error schemas."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
            schemas = document["components"]["schemas"]
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(problem.pop("$defs"))
            schemas["Problem"] = problem
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
