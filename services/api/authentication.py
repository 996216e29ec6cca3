"""Who calls, from the `Authorization` header, and whether they may use the route."""

from __future__ import annotations

import secrets
from typing import Annotated

from fastapi import Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer, SecurityScopes

from services.api.problems import Forbidden, Unauthorized
from services.domain.access import ALL_SCOPES, DEFAULT_TENANT, Caller, Scope
from services.settings import Settings

BOOTSTRAP = "bootstrap"
_bearer = HTTPBearer(auto_error=False, description="An API key; none is needed where the service listens on loopback.")


def authorised(
    request: Request,
    needed: SecurityScopes,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)],
) -> Caller:
    """The caller, who has every scope that the route names.

    Raises:
        Unauthorized: The request carries no key that is known.
        Forbidden: The key is known, but lacks a scope.
    """
    settings: Settings = request.app.state.settings
    caller = Caller(DEFAULT_TENANT, None, ALL_SCOPES)
    if settings.api_key is not None:
        given = "" if credentials is None else credentials.credentials
        if not secrets.compare_digest(given.encode(), settings.api_key.get_secret_value().encode()):
            raise Unauthorized("send the service's key as `Authorization: Bearer <key>`")
        caller = Caller(DEFAULT_TENANT, BOOTSTRAP, ALL_SCOPES)
    for scope in needed.scopes:
        if not caller.may(Scope(scope)):
            raise Forbidden(f"this key lacks the scope {scope}")
    return caller


Reader = Annotated[Caller, Security(authorised, scopes=[Scope.JOBS_READ.value])]
Writer = Annotated[Caller, Security(authorised, scopes=[Scope.JOBS_WRITE.value])]
Admin = Annotated[Caller, Security(authorised, scopes=[Scope.ADMIN.value])]
