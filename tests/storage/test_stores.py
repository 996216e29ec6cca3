"""What only one kind of store can get wrong."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from services.domain.errors import InvalidRequest, ObjectMissing, StorageError, StorageRefused
from services.storage import DirectoryStore, S3Store, open_store

SECRET = "a-secret-that-must-not-leak"


@pytest.fixture(autouse=True)
def aws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")


class _Scripted(BaseHTTPRequestHandler):
    """An S3 server that answers from a script: status codes, or `cut` for a body that breaks off."""

    protocol_version = "HTTP/1.1"  # answers `Expect: 100-continue`, for which the client would wait a second
    script: ClassVar[list[str]] = []
    objects: ClassVar[dict[str, bytes]] = {}

    def answer(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length)
        action = self.script.pop(0) if self.script else "200"
        if action == "stored-then-500":  # the write happens, the answer is lost
            self.objects[self.path] = body
            action = "500"
        elif action == "200" and self.command == "PUT":
            if self.headers.get("If-None-Match") == "*" and self.path in self.objects:
                action = "412"
            else:
                self.objects[self.path] = body
        data = self.objects.get(self.path, b"") if self.command == "GET" and action in ("200", "cut") else b""
        self.send_response(200 if action == "cut" else int(action))
        self.send_header("Content-Length", str(len(data) + (5 if action == "cut" else 0)))
        self.send_header("ETag", '"x"')
        self.end_headers()
        self.wfile.write(data)
        self.close_connection = action == "cut"

    def log_message(self, *args: object) -> None:
        return None


@pytest.fixture
def scripted() -> Iterator[tuple[S3Store, type[_Scripted]]]:
    methods = {f"do_{name}": _Scripted.answer for name in ("GET", "PUT", "HEAD", "DELETE")}
    handler = type("Handler", (_Scripted,), {"script": [], "objects": {}, **methods})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield S3Store("bucket", endpoint_url=f"http://127.0.0.1:{server.server_port}", max_attempts=3), handler
    server.shutdown()
    server.server_close()


def test_a_lost_answer_to_create_reads_as_exists(scripted: tuple[S3Store, type[_Scripted]]) -> None:
    store, server = scripted
    server.script[:] = ["stored-then-500"]
    assert store.create("k", b"mine") is False
    assert b"mine" in next(iter(server.objects.values()))


def test_a_conflicting_create_is_asked_again(scripted: tuple[S3Store, type[_Scripted]]) -> None:
    store, server = scripted
    server.script[:] = ["409", "409", "200"]
    assert store.create("k", b"mine") is True
    server.script[:] = ["409", "200"]
    assert store.create("k", b"other") is False


def test_a_body_that_breaks_off_is_read_again(scripted: tuple[S3Store, type[_Scripted]]) -> None:
    store, server = scripted
    server.objects["/bucket/k"] = b"hello"
    server.script[:] = ["cut", "cut", "200"]
    assert store.get_bytes("k") == b"hello"
    server.script[:] = ["cut"] * 10
    with pytest.raises(StorageError, match=r"s3://bucket/k"):
        store.get_bytes("k")


def test_server_errors_are_retried_then_typed(scripted: tuple[S3Store, type[_Scripted]]) -> None:
    store, server = scripted
    server.script[:] = ["503", "500", "200"]
    store.put_bytes("k", b"x")
    server.script[:] = ["503"] * 10
    with pytest.raises(StorageError, match="was refused: 503") as caught:
        store.put_bytes("k", b"x")
    assert caught.value.retryable
    server.script[:] = ["403"]
    with pytest.raises(StorageRefused, match=r"head of s3://bucket/k is not allowed \(403\)"):
        store.head("k")


def test_an_endpoint_that_does_not_answer_is_named_without_secrets() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    store = S3Store("bucket", endpoint_url=f"http://user:{SECRET}@127.0.0.1:{port}", max_attempts=1)
    with pytest.raises(StorageError, match="is the endpoint reachable") as caught:
        store.head("k")
    assert SECRET not in str(caught.value)


def test_a_missing_bucket_is_not_a_missing_object(s3_endpoint: str, tmp_path: Path) -> None:
    store = S3Store("no-such-bucket", endpoint_url=s3_endpoint)
    (tmp_path / "f").write_bytes(b"x")
    for use in (
        lambda: store.get_bytes("k"),
        lambda: store.put_bytes("k", b""),
        lambda: store.create("k", b""),
        lambda: store.put_file("k", tmp_path / "f"),
        lambda: list(store.list()),
    ):
        with pytest.raises(StorageRefused, match="bucket of s3://no-such-bucket"):
            use()


def test_missing_credentials_say_what_to_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    with pytest.raises(StorageRefused, match="AWS_ACCESS_KEY_ID"):
        S3Store("bucket", endpoint_url="http://127.0.0.1:9").head("k")


def test_the_endpoint_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, s3_endpoint: str) -> None:
    monkeypatch.setenv("VIPE_S3_ENDPOINT_URL", s3_endpoint)
    with pytest.raises(StorageRefused, match="bucket of s3://nobody-has-this"):
        open_store("s3://nobody-has-this/p").get_bytes("k")


@pytest.mark.parametrize(
    ("uri", "root"), [("/a/b", "/a/b"), ("file:///a/b%20c", "/a/b c"), ("file://localhost/a", "/a"), ("/a?b", "/a?b")]
)
def test_directory_addresses(uri: str, root: str) -> None:
    assert open_store(uri).uri == root


@pytest.mark.parametrize(
    "uri",
    ["", "a/b", "./a", "s3://", "s3:///p", "s3://k:s@b/p", "file://host/a", "gs://b/p", "http://x/y", "s3://b/p?x=1"],
)
def test_other_addresses_are_refused(uri: str) -> None:
    with pytest.raises(InvalidRequest, match="address"):
        open_store(uri)


@pytest.mark.parametrize(("uri", "shown"), [("s3://b", "s3://b"), ("s3://b/", "s3://b"), ("s3://b/p/q/", "s3://b/p/q")])
def test_s3_addresses(uri: str, shown: str) -> None:
    assert open_store(uri).uri == shown


def test_a_failed_write_leaves_no_trace(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    store.put_bytes("k", b"old")
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageError, match="folder"):
        store.put_bytes("folder", b"x")  # the name is taken by a folder
    with pytest.raises(StorageError, match="collides"):
        store.put_bytes("k/below", b"x")
    assert store.head("k/below") is None
    assert store.head("folder") is None
    store.delete("folder")
    with pytest.raises(ObjectMissing):
        store.get_bytes("folder")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "k"]
    assert store.get_bytes("k") == b"old"


def test_temporary_files_are_not_objects(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    store.put_bytes("a/k", b"1")
    (tmp_path / "a" / ".vipe-tmp-1-2").write_bytes(b"half")
    assert [o.key for o in store.list()] == ["a/k"]
    assert [o.key for o in store.list("a/.")] == []


def test_a_symbolic_link_must_not_lead_out(tmp_path: Path) -> None:
    outside, root = tmp_path / "outside", tmp_path / "root"
    outside.mkdir()
    root.mkdir()
    (outside / "secret").write_bytes(b"s")
    (root / "out").symlink_to(outside)
    (root / "file").symlink_to(outside / "secret")
    store = DirectoryStore(root)
    for use in (
        lambda: store.get_bytes("out/secret"),
        lambda: store.get_bytes("file"),
        lambda: store.put_bytes("out/new", b"x"),
        lambda: store.create("out/new", b"x"),
        lambda: store.delete("out/secret"),
    ):
        with pytest.raises(StorageError, match="symbolic link"):
            use()
    assert list(store.list()) == []
    assert [p.name for p in outside.iterdir()] == ["secret"]


def test_the_root_may_itself_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    store = DirectoryStore(tmp_path / "link")
    store.put_bytes("a", b"1")
    assert (tmp_path / "real" / "a").read_bytes() == b"1"
    assert [o.key for o in store.list()] == ["a"]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_refused_write_is_typed(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError, match="EACCES"):
        DirectoryStore(tmp_path).put_bytes("k", b"")


def test_a_relative_root_is_refused() -> None:
    with pytest.raises(StorageError, match="absolute"):
        DirectoryStore("relative")
