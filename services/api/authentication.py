"""Who calls, from the `Authorization` header, and whether they may use the route."""

from __future__ import annotations

import hashlib
import hmac
import logging
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated

from fastapi import Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer, SecurityScopes

from services.api.hosts import is_loopback
from services.api.problems import Forbidden, Unauthorized
from services.domain.access import ALL_SCOPES, DEFAULT_TENANT, Caller, Scope
from services.domain.errors import StoreUnavailable
from services.domain.keys import key_id_of, matches
from services.settings import Settings
from services.store.base import Store

BOOTSTRAP = "bootstrap"
"""The id under which `VIPE_API_KEY` acts."""

REVOCATION_S = 10.0
"""For so long a key that was verified is believed without asking the store: its revocation holds after that."""

_MAX_REMEMBERED = 10_000
_TOUCH_S = 60.0
_log = logging.getLogger(__name__)


def serves_anonymous(settings: Settings) -> bool:
    """Whether requests without a key are answered."""
    if settings.api_key is not None:
        return False
    return is_loopback(settings.host) if settings.allow_anonymous is None else settings.allow_anonymous


@dataclass(slots=True)
class _Verified:
    caller: Caller
    kept_hash: str
    checked_at_s: float
    touched_at_s: float


class Authenticator:
    """Verifies keys against the store. Thread-safe.

    A key costs its scrypt hash once per process; after that its row is read again every `REVOCATION_S`. What is
    remembered of a key is a hash under a secret of this process.
    """

    def __init__(self, store: Store, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._clock = clock
        self._salt = secrets.token_bytes(32)
        self._bootstrap = None if settings.api_key is None else self._digest(settings.api_key.get_secret_value())
        self.anonymous = Caller(DEFAULT_TENANT, None, ALL_SCOPES) if serves_anonymous(settings) else None
        self._lock = threading.Lock()
        # One hash at a time takes a core already; and each thread that hashes keeps 16 MiB, as malloc has it.
        self._hasher = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scrypt")
        self._verified: OrderedDict[bytes, _Verified] = OrderedDict()

    def remembered(self, key: str) -> Caller | None:
        """The caller, if that can be told without the store."""
        digest = self._digest(key)
        if self._bootstrap is not None and hmac.compare_digest(digest, self._bootstrap):
            return Caller(DEFAULT_TENANT, BOOTSTRAP, ALL_SCOPES)
        with self._lock:
            known = self._verified.get(digest)
        if known is None or self._clock() - known.checked_at_s >= REVOCATION_S:
            return None
        return known.caller

    def seen(self, key: str) -> bool:
        """Whether this key was right before."""
        with self._lock:
            return self._digest(key) in self._verified

    def verify(self, key: str) -> Caller:
        """Ask the store.

        Raises:
            Unauthorized: The key is unknown, wrong, revoked or expired.
            StoreUnavailable: It cannot be known.
        """
        checked_at_s = self._clock()
        digest = self._digest(key)
        key_id = key_id_of(key)
        found = None if key_id is None else self._store.find_key(key_id)
        if found is None:
            raise Unauthorized("this key is not known")
        api_key, kept_hash, valid = found
        with self._lock:
            known = self._verified.get(digest)
        right = known is not None and known.kept_hash == kept_hash
        if not right:
            right = self._hasher.submit(matches, key, kept_hash).result()
        if not right or not valid:
            with self._lock:
                self._verified.pop(digest, None)
            raise RefusedKey(
                "this key is not known" if not right else "this key was revoked or has expired",
                key_id=api_key.id,
                tenant=api_key.tenant,
            )
        touched_at_s = self._touch(api_key.id, known)
        caller = Caller(api_key.tenant, api_key.id, api_key.scopes)
        with self._lock:
            self._verified[digest] = _Verified(caller, kept_hash, checked_at_s, touched_at_s)
            self._verified.move_to_end(digest)
            if len(self._verified) > _MAX_REMEMBERED:
                self._verified.popitem(last=False)
        return caller

    def holds(self, caller: Caller) -> bool:
        """Whether a caller is still let in, for answers that take long."""
        if caller.key_id is None or caller.key_id == BOOTSTRAP:
            return True
        found = self._store.find_key(caller.key_id)
        return found is not None and found[2]

    def forget(self, key_id: str) -> None:
        """Believe nothing that is remembered of a key."""
        with self._lock:
            for digest in [d for d, known in self._verified.items() if known.caller.key_id == key_id]:
                del self._verified[digest]

    def _touch(self, key_id: str, known: _Verified | None) -> float:
        now_s = self._clock()
        if known is not None and now_s - known.touched_at_s < _TOUCH_S:
            return known.touched_at_s
        try:
            self._store.touch_key(key_id)
        except StoreUnavailable as error:  # no reason to refuse anybody
            _log.warning("could not note the use of key %s: %s", key_id, error)
        return now_s

    def _digest(self, key: str) -> bytes:
        return hashlib.blake2b(key.encode("utf-8", "surrogateescape"), key=self._salt, digest_size=32).digest()


class RefusedKey(Unauthorized):
    """A key that claims the id of a known one."""

    def __init__(self, message: str, *, key_id: str, tenant: str) -> None:
        super().__init__(message)
        self.key_id = key_id
        self.tenant = tenant


_bearer = HTTPBearer(
    auto_error=False, description="An API key. None is needed where the service listens on loopback without one."
)


async def authorised(
    request: Request,
    needed: SecurityScopes,
    _documented: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)],
) -> Caller:
    """The caller whom the guard let in, who has every scope that the route names.

    Raises:
        Forbidden: The key lacks a scope.
    """
    caller: Caller = request.state.caller
    for scope in needed.scopes:
        if not caller.may(Scope(scope)):
            raise Forbidden(f"this key lacks the scope {scope}")
    return caller


Reader = Annotated[Caller, Security(authorised, scopes=[Scope.JOBS_READ.value])]
Writer = Annotated[Caller, Security(authorised, scopes=[Scope.JOBS_WRITE.value])]
Admin = Annotated[Caller, Security(authorised, scopes=[Scope.ADMIN.value])]
