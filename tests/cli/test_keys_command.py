"""`vipectl keys` on a database."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from services.cli.main import app
from services.domain.access import Scope
from services.domain.keys import key_id_of, matches
from services.store.sql import SqlStore


def test_create_list_and_revoke(tmp_path: Path) -> None:
    database = f"sqlite:///{tmp_path}/store.db"

    def run(*arguments: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["keys", *arguments, "--database-url", database])
        return done.exit_code, done.output

    created, key = run("create", "nightly", "--tenant", "a", "--scope", "jobs:read", "--expires-days", "30")
    key = key.strip().splitlines()[-1]
    key_id = key_id_of(key)
    assert (created, key_id is not None) == (0, True)
    store = SqlStore(database)
    found = store.find_key(str(key_id))
    assert found is not None
    assert matches(key, found[1])
    assert (found[0].tenant, found[0].name, found[0].scopes) == ("a", "nightly", {Scope.JOBS_READ})
    assert found[0].expires_at is not None
    assert (found[0].expires_at - found[0].created_at).days == 30

    listed, table = run("list")
    assert listed == 0
    assert str(key_id) in table
    assert key not in table
    assert run("revoke", str(key_id))[0] == 0
    found = store.find_key(str(key_id))
    assert found is not None
    assert not found[2]
    store.close()
    for wrong in (
        ["create", "x", "--scope", "all"],
        ["create", ""],
        ["create", "x", "--tenant", ""],
        ["revoke", "nope"],
    ):
        assert run(*wrong)[0] != 0
