"""A fresh store per test, on SQLite always and on PostgreSQL where there is one.

PostgreSQL comes from VIPE_TEST_POSTGRES_URL, or from a server binary on this machine, which is then started in a
temporary directory, as an unprivileged user, on a Unix socket only.
"""

from __future__ import annotations

import itertools
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, make_url, text

from services.store.sql import SqlStore

_counter = itertools.count()


def _server_binary() -> Path | None:
    on_path = shutil.which("initdb")
    if on_path is not None:
        return Path(on_path).resolve().parent
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[-3]))
    return versions[-1].parent if versions else None


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """Address of a PostgreSQL database in which the tests may create schemas."""
    given = os.environ.get("VIPE_TEST_POSTGRES_URL")
    if given:
        yield given
        return
    binaries = _server_binary()
    if binaries is None:
        pytest.skip(
            "NOT RUN: the store on PostgreSQL. Set VIPE_TEST_POSTGRES_URL, or install a server (Debian: postgresql)."
        )
    account: dict[str, str | int] = {}
    folder = Path(tempfile.mkdtemp(prefix="vipe-pg-"))
    if os.geteuid() == 0:  # the server refuses to run as root
        user = next(u for u in pwd.getpwall() if u.pw_name in ("postgres", "nobody"))
        account = {"user": user.pw_uid, "group": user.pw_gid}
        os.chown(folder, user.pw_uid, user.pw_gid)
    data = folder / "data"
    subprocess.run(
        [binaries / "initdb", "-D", data, "-U", "vipe", "-A", "trust", "-E", "UTF8", "--no-sync"],
        check=True,
        cwd=folder,
        stdout=subprocess.DEVNULL,
        **account,
    )
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen(
            [binaries / "postgres", "-D", data, "-k", folder, "-c", "listen_addresses=", "-c", "fsync=off"],
            cwd=folder,
            stdout=log,
            stderr=log,
            **account,
        )
    try:
        while (
            subprocess.run(
                [binaries / "pg_isready", "-q", "-h", folder, "-U", "vipe"], check=False, stdout=subprocess.DEVNULL
            ).returncode
            != 0
        ):
            assert server.poll() is None, (folder / "log").read_text()
        yield f"postgresql://vipe@/postgres?host={folder}"
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(params=["sqlite", "postgresql"])
def new_store_url(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], str]:
    """Gives the address of an empty database at each call."""
    if request.param == "sqlite":
        return lambda: f"sqlite:///{tmp_path}/store-{next(_counter)}.db"
    base = make_url(request.getfixturevalue("postgres_url")).set(drivername="postgresql+psycopg")

    def new_schema() -> str:
        name = f"vipe_test_{os.getpid()}_{next(_counter)}"
        engine = create_engine(base)
        with engine.begin() as conn:
            conn.execute(text(f"CREATE SCHEMA {name}"))
        engine.dispose()
        return base.update_query_dict({"options": f"-csearch_path={name}"}).render_as_string(hide_password=False)

    return new_schema


@pytest.fixture
def store_url(new_store_url: Callable[[], str]) -> str:
    return new_store_url()


@pytest.fixture
def store(store_url: str) -> Iterator[SqlStore]:
    opened = SqlStore(store_url)
    yield opened
    opened.close()
