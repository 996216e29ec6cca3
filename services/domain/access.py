"""Who calls, and what they may do. Values only, no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

DEFAULT_TENANT = "default"


class Scope(StrEnum):
    """What a key may be used for. `admin` includes the others."""

    JOBS_READ = "jobs:read"
    JOBS_WRITE = "jobs:write"
    ADMIN = "admin"


ALL_SCOPES = frozenset(Scope)


@dataclass(frozen=True, slots=True)
class Caller:
    """Whom a request comes from.

    Attributes:
        tenant: Whose jobs they see; those of others do not exist for them.
        key_id: Public id of the key; `bootstrap` for `VIPE_API_KEY`; None where the service answers without a key.
        scopes: What they may do.
    """

    tenant: str
    key_id: str | None
    scopes: frozenset[Scope]

    def may(self, scope: Scope) -> bool:
        return scope in self.scopes or Scope.ADMIN in self.scopes


@dataclass(frozen=True, slots=True)
class ApiKey:
    """A key without its secret."""

    id: str
    tenant: str
    name: str
    scopes: frozenset[Scope]
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = None


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """Who did what to which object, with what outcome.

    Attributes:
        tenant: Of the key; None where nobody's key was refused.
        key_id: As in `Caller`; of a key that was refused, the id that it claims.
        address: Of the caller.
        action: `<method> <route template>`, or `authenticate`.
        object: Path of what it was done to.
        status: HTTP status of the answer.
        code: Of the problem, where it was one.
        count: How many equal events this entry stands for.
    """

    tenant: str | None
    key_id: str | None
    address: str
    request_id: str
    action: str
    object: str
    status: int
    code: str | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class AuditEvent:
    """An entry as it was kept; `seq` grows over the whole store."""

    seq: int
    at: datetime
    entry: AuditEntry
