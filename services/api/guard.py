"""The gate before every route: who calls, whether too often, and what they did.

An ASGI application itself, so that a stranger's body is never read and streams pass through unbuffered.
"""

from __future__ import annotations

from functools import partial

from anyio.to_thread import run_sync
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api import problems
from services.api.audit import AuditTrail
from services.api.authentication import Authenticator, RefusedKey
from services.api.limits import TokenBuckets, address_of
from services.api.problems import RateLimited, Unauthorized
from services.domain.access import AuditEntry, Caller
from services.domain.errors import ServiceError
from services.domain.redaction import redact

_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_ALWAYS_ANSWERED = "/healthz"
_WRONG_KEYS_PER_S = 0.5


class Guard:
    """Lets known callers through as `request.state.caller`, each at its rate, and audits what they change.

    Args:
        app: What answers.
        authenticator: Knows the keys.
        trail: Takes what happened.
        rate_per_s: Requests of one key, or of one address where no key is needed.
        burst: How many of them at once.
        max_wrong_keys: How many wrong keys of one address at once; then one every two seconds. Each may cost a scrypt.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        authenticator: Authenticator,
        trail: AuditTrail,
        rate_per_s: float,
        burst: int,
        max_wrong_keys: int,
    ) -> None:
        self._app = app
        self._authenticator = authenticator
        self._trail = trail
        self._requests = TokenBuckets(rate_per_s, burst)
        self._wrong_keys = TokenBuckets(_WRONG_KEYS_PER_S, max_wrong_keys)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] == _ALWAYS_ANSWERED:
            await self._app(scope, receive, send)
            return
        address = address_of(scope)
        try:
            caller = await self._caller(scope, address) if _needs_caller(scope["path"]) else None
            self._count((caller.key_id if caller is not None else None) or address)
        except ServiceError as error:
            await problems.of(scope, error)(scope, receive, send)
            return
        scope.setdefault("state", {})["caller"] = caller
        if caller is None or scope["method"] in _READING:
            await self._app(scope, receive, send)
        else:
            await self._audited(caller, address, scope, receive, send)

    async def _caller(self, scope: Scope, address: str) -> Caller:
        kind, _, key = Headers(scope=scope).get("authorization", "").partition(" ")
        if not kind and self._authenticator.anonymous is not None:
            return self._authenticator.anonymous
        key = key.strip() if kind.lower() == "bearer" else ""
        if key:
            caller = self._authenticator.remembered(key)
            if caller is not None:
                return caller
            if not self._authenticator.seen(key) and (wait_s := self._wrong_keys.wait_s(address)) > 0:
                raise RateLimited("too many wrong keys came from this address", retry_after_s=wait_s)
        else:
            self._count(address)
        try:
            if not key:
                raise Unauthorized("send an API key in the header `Authorization`, after the word `Bearer`")
            return await run_sync(self._authenticator.verify, key)
        except Unauthorized as error:
            if key:
                self._wrong_keys.take(address)
            tenant, key_id = (error.tenant, error.key_id) if isinstance(error, RefusedKey) else (None, None)
            entry = AuditEntry(
                tenant, key_id, address, _request_id(scope), "authenticate", _object(scope), error.status, error.code
            )
            await run_sync(self._trail.refused, entry)
            raise

    def _count(self, name: str) -> None:
        wait_s = self._requests.wait_s(name)
        if wait_s > 0:
            raise RateLimited("too many requests", retry_after_s=wait_s)
        self._requests.take(name)

    async def _audited(self, caller: Caller, address: str, scope: Scope, receive: Receive, send: Send) -> None:
        recorded = False

        async def record(status: int, location: str = "") -> None:
            nonlocal recorded
            recorded = True
            route = getattr(scope.get("route"), "path", "unmatched")
            entry = AuditEntry(
                caller.tenant,
                caller.key_id,
                address,
                _request_id(scope),
                f"{scope['method'][:10]} {route}",
                location or _object(scope),
                status,
                scope["state"].get("problem_code"),
            )
            await run_sync(partial(self._trail.record, entry))

        async def send_recorded(message: Message) -> None:
            if message["type"] == "http.response.start" and not recorded:
                await record(message["status"], Headers(raw=message["headers"]).get("location", ""))
            await send(message)

        try:
            await self._app(scope, receive, send_recorded)
        except Exception:
            if not recorded:
                await record(500)
            raise


def _needs_caller(path: str) -> bool:
    return path == "/v1" or path.startswith("/v1/")


def _request_id(scope: Scope) -> str:
    return str(scope.get("state", {}).get("request_id", ""))


def _object(scope: Scope) -> str:
    """The path, as a database can and may hold it."""
    path = redact(str(scope["path"]))[:512].replace("\x00", "\ufffd")
    return path.encode("utf-8", "replace").decode()
