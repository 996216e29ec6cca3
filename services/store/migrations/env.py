"""Alembic's entry: runs the revisions on the connection that `upgrade` hands over."""

from __future__ import annotations

from alembic import context

from services.store.schema import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    # Our SQLite connections begin transactions themselves, so DDL is transactional there too.
    transactional_ddl=True,
    render_as_batch=True,
)
context.run_migrations()
