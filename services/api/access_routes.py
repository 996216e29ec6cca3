"""Keys and the audit trail of the caller's tenant, over HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from services.api import paging
from services.api.authentication import Admin
from services.api.problems import responses
from services.api.routes import Limit, PageToken, TheStore, require_json
from services.domain.access import ApiKey, AuditEvent, Scope

KeyId = Annotated[str, Path(min_length=1, max_length=16, pattern=r"^[a-z2-7]+$", description="The middle of a key.")]

router = APIRouter(prefix="/v1", tags=["access"])


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("a name must not hold control characters")
    return name


class KeyRequest(BaseModel):
    """A key to make, for the caller's tenant."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"name": "nightly", "scopes": ["jobs:read", "jobs:write"]}]}
    )

    name: Annotated[str, AfterValidator(_printable)] = Field(min_length=1, max_length=200, description="For humans.")
    scopes: list[Scope] = Field(min_length=1, max_length=len(Scope), description="`admin` includes the others.")
    expires_in_s: int | None = Field(default=None, ge=1, le=10 * 366 * 86400, description="Default: never.")


class KeyView(BaseModel):
    id: str
    tenant: str
    name: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None = Field(description="To the minute.")

    @classmethod
    def of(cls, key: ApiKey) -> KeyView:
        fields = {name: getattr(key, name) for name in KeyView.model_fields}
        return cls.model_validate({**fields, "scopes": sorted(key.scopes)})


class NewKey(KeyView):
    key: str = Field(description="To be kept by its owner: it is not shown again.")


class KeyPage(BaseModel):
    items: list[KeyView]
    next_page_token: str | None


class AuditView(BaseModel):
    """Who did what to which object, with what outcome."""

    seq: int
    at: datetime
    tenant: str | None = Field(description="Null where nobody's key was refused.")
    key_id: str | None = Field(description="`bootstrap` for VIPE_API_KEY; null without a key.")
    address: str
    request_id: str
    action: str = Field(description="`<method> <route>`, or `authenticate` for refused keys.")
    object: str
    status: int
    code: str | None = Field(description="Of the problem that it was answered with.")
    count: int = Field(description="How many equal events this stands for.")

    @classmethod
    def of(cls, event: AuditEvent) -> AuditView:
        entry = {name: getattr(event.entry, name) for name in cls.model_fields if name not in ("seq", "at")}
        return cls(seq=event.seq, at=event.at, **entry)


class AuditPage(BaseModel):
    items: list[AuditView]
    next_page_token: str | None


@router.post(
    "/keys",
    status_code=201,
    dependencies=[Depends(require_json)],
    responses={
        201: {
            "description": "Created.",
            "headers": {"Location": {"description": "Where the key is.", "schema": {"type": "string"}}},
        },
        **responses(400, 401, 403, 408, 413, 415, 422, 429, 503),
    },
)
def create_key(body: KeyRequest, caller: Admin, store: TheStore, response: Response) -> NewKey:
    """Make a key for the caller's tenant. This answer is the only place where it is shown."""
    made, key = store.create_key(
        body.name, tenant=caller.tenant, scopes=frozenset(body.scopes), expires_in_s=body.expires_in_s
    )
    response.headers["Location"] = f"/v1/keys/{made.id}"
    return NewKey(**KeyView.of(made).model_dump(), key=key)


@router.get("/keys", responses=responses(400, 401, 403, 422, 429, 503))
def list_keys(caller: Admin, store: TheStore, limit: Limit = 100, page_token: PageToken = None) -> KeyPage:
    """List the keys of the caller's tenant, those that ended too, by id."""
    keys, after = store.list_keys(tenant=caller.tenant, limit=limit, after=paging.cursor(page_token, of="keys"))
    return KeyPage(items=[KeyView.of(key) for key in keys], next_page_token=paging.token(after, of="keys"))


@router.get("/keys/{key_id}", responses=responses(401, 403, 404, 422, 429, 503))
def get_key(key_id: KeyId, caller: Admin, store: TheStore) -> KeyView:
    """Show a key, without its secret."""
    return KeyView.of(store.get_key(key_id, tenant=caller.tenant))


@router.post("/keys/{key_id}/revoke", responses=responses(401, 403, 404, 422, 429, 503))
def revoke_key(key_id: KeyId, caller: Admin, store: TheStore, request: Request) -> KeyView:
    """End a key for ever. It is refused by this process at once, by others within ten seconds."""
    revoked = store.revoke_key(key_id, tenant=caller.tenant)
    request.app.state.authenticator.forget(key_id)
    return KeyView.of(revoked)


@router.get("/audit", responses=responses(400, 401, 403, 422, 429, 503))
def list_audit(
    caller: Admin, store: TheStore, request: Request, limit: Limit = 100, page_token: PageToken = None
) -> AuditPage:
    """List who did what in the caller's tenant, newest first.

    The tenant `default`, which is that of who runs the service, also sees refused keys that are nobody's.
    """
    request.app.state.trail.flush()
    events, after = store.audit(caller.tenant, limit=limit, after=paging.cursor(page_token, of="audit"))
    return AuditPage(items=[AuditView.of(event) for event in events], next_page_token=paging.token(after, of="audit"))
