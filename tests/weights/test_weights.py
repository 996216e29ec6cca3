"""Weights from a real web server and from a mirror: resumed, verified, and never in place with a wrong checksum."""

from __future__ import annotations

import hashlib
import json
import logging
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner
from web_server import Web, page, serve

from services.cli.main import app
from services.domain.errors import HttpFailed, ObjectMissing, StorageError, StorageRefused
from services.weights import fetching, mirror, pull
from vipe_core.errors import WeightsInvalid, WeightsMissing
from vipe_core.priors import weights as registry
from vipe_core.priors.weights import checksum, path_of, record_of, require

CONTENT = bytes(range(256)) * 2000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class File:
    """A file on the server that can break off and be replaced.

    Attributes:
        breaks_at: Byte at which the next answer ends, once.
        ranges: What `Range` said, request by request.
    """

    def __init__(self, content: bytes, etag: str = '"one"', *, ranges_known: bool = True) -> None:
        self.content, self.etag, self.ranges_known = content, etag, ranges_known
        self.breaks_at: int | None = None
        self.ranges: list[str | None] = []

    def __call__(self, request: BaseHTTPRequestHandler) -> None:
        asked = request.headers.get("Range")
        self.ranges.append(asked)
        begin = 0
        if asked and self.ranges_known and request.headers.get("If-Range") == self.etag:
            begin = int(asked.removeprefix("bytes=").rstrip("-"))
        request.send_response(206 if begin else 200)
        if begin:
            last = len(self.content) - 1
            request.send_header("Content-Range", f"bytes {begin}-{last}/{len(self.content)}")
        request.send_header("ETag", self.etag)
        request.send_header("Content-Length", str(len(self.content) - begin))
        request.end_headers()
        end, self.breaks_at = self.breaks_at, None
        request.wfile.write(self.content[begin:end])
        if end is not None:
            request.close_connection = True


@pytest.fixture
def web() -> Iterator[Web]:
    with serve() as running:
        yield running


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path / "weights"))
    return tmp_path / "weights"


def publish(monkeypatch: pytest.MonkeyPatch, web: Web, sha256: str | None) -> None:
    """Let the registry name the test's server."""
    one = replace(registry.WEIGHTS["droid"], urls=(web.url("/gone"), web.url("/droid.pth")), sha256=sha256)
    monkeypatch.setitem(registry.WEIGHTS, "droid", one)


def test_a_pull_takes_the_first_address_that_answers_and_verifies(
    web: Web, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(monkeypatch, web, SHA256)
    web.pages["/droid.pth"] = File(CONTENT)
    told: list[tuple[int, int | None]] = []
    pulled = pull("droid", progress=lambda here, total: told.append((here, total)))
    assert (pulled.fetched, pulled.first_use) == (True, False)
    assert pulled.path.read_bytes() == CONTENT
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert require("droid").sha256 == SHA256
    assert sorted(path.name for path in folder.iterdir()) == ["droid.pth", "droid.pth.json"]
    asked = len(web.asked)
    assert not pull("droid").fetched
    assert len(web.asked) == asked


@pytest.mark.parametrize("ranges_known", [True, False])
def test_a_download_that_breaks_off_goes_on_with_the_next_pull(web: Web, folder: Path, ranges_known: bool) -> None:
    file = File(CONTENT, ranges_known=ranges_known)
    file.breaks_at = 300_000
    web.pages["/droid.pth"] = file
    with pytest.raises(HttpFailed, match="pull again"):
        pull("droid", origin=web.url("/droid.pth"))
    assert not path_of("droid").exists()
    pulled = pull("droid", origin=web.url("/droid.pth"))
    assert pulled.path.read_bytes() == CONTENT
    assert file.ranges[0] is None
    assert file.ranges[1] is not None
    assert 0 < int(file.ranges[1].removeprefix("bytes=").rstrip("-")) <= 300_000


def test_a_file_that_was_replaced_meanwhile_is_fetched_from_its_start(web: Web, folder: Path) -> None:
    file = File(bytes(len(CONTENT)))
    file.breaks_at = 300_000
    web.pages["/droid.pth"] = file
    with pytest.raises(HttpFailed):
        pull("droid", origin=web.url("/droid.pth"))
    web.pages["/droid.pth"] = File(CONTENT, '"two"')
    assert pull("droid", origin=web.url("/droid.pth")).record.sha256 == SHA256


def test_a_wrong_checksum_leaves_nothing_in_place(web: Web, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(monkeypatch, web, "0" * 64)
    web.pages["/droid.pth"] = File(CONTENT)
    with pytest.raises(WeightsInvalid, match=SHA256):
        pull("droid")
    assert list(folder.iterdir()) == []
    with pytest.raises(WeightsMissing):
        require("droid")


def test_without_a_published_checksum_the_first_one_counts(web: Web, folder: Path) -> None:
    web.pages["/droid.pth"] = File(CONTENT)
    assert pull("droid", origin=web.url("/droid.pth")).first_use
    record = record_of("droid")
    assert record is not None
    assert record.sha256 == SHA256
    web.pages["/droid.pth"] = File(CONTENT + b"more", '"two"')
    with pytest.raises(WeightsInvalid):
        pull("droid", origin=web.url("/droid.pth"), force=True)
    assert checksum(path_of("droid")) == SHA256
    with pytest.raises(WeightsInvalid):
        pull("droid", sha256="1" * 64)
    with pytest.raises(WeightsInvalid, match="1" * 64):
        pull("droid", origin=web.url("/droid.pth"), sha256="1" * 64, force=True)
    # The user may know better than the first pull.
    newer = hashlib.sha256(CONTENT + b"more").hexdigest()
    assert pull("droid", origin=web.url("/droid.pth"), sha256=newer.upper(), force=True).record.sha256 == newer
    assert require("droid").sha256 == newer


def test_a_web_page_in_the_place_of_a_file_and_a_refusal_are_told_apart_from_weights(web: Web, folder: Path) -> None:
    web.pages["/droid.pth"] = page(b"<html>Sign in</html>", Content_Type="text/html; charset=utf-8")
    with pytest.raises(HttpFailed, match="web page"):
        pull("droid", origin=web.url("/droid.pth"))
    with pytest.raises(HttpFailed, match="status 404"):
        pull("droid", origin=web.url("/nothing"))
    with pytest.raises(WeightsMissing, match=r"known: .*droid"):
        pull("android")


def test_a_mirror_serves_a_machine_without_internet(
    web: Web, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    web.pages["/droid.pth"] = File(CONTENT)
    pull("droid", origin=web.url("/droid.pth"))
    store = tmp_path / "mirror"
    assert mirror(["droid"], str(store)) == [f"{store}/droid.pth"]
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path / "elsewhere"))
    pulled = pull("droid", origin=str(store))
    assert pulled.path.read_bytes() == CONTENT
    assert not pulled.first_use
    (store / "droid.pth").write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsInvalid, match="deleted"):
        pull("droid", origin=str(store), force=True)
    assert require("droid").sha256 == SHA256
    with pytest.raises(ObjectMissing):
        pull("droid", origin=str(tmp_path / "empty"), force=True)


def test_the_files_of_a_network_keep_their_names_in_a_mirror(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("sam2_video/config.json", "sam2_video/model.safetensors", "depth_pro/model.safetensors")
    for name in names:
        path_of(name).parent.mkdir(parents=True, exist_ok=True)
        path_of(name).write_text(name)
    store = tmp_path / "mirror"
    assert mirror(names, str(store)) == [f"{store}/{name}" for name in names]
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path / "elsewhere"))
    for name in names:
        assert pull(name, origin=str(store)).path.read_text() == name


def test_a_file_that_somebody_copied_here_is_taken_from_its_path(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "copied.pth").write_bytes(CONTENT)
    pulled = pull("droid", origin=str(tmp_path / "copied.pth"))
    assert (pulled.record.sha256, pulled.first_use) == (SHA256, True)
    assert pulled.path.read_bytes() == CONTENT
    assert (tmp_path / "copied.pth").exists()


def test_of_two_pulls_at_once_one_waits_for_the_other(web: Web, folder: Path) -> None:
    file, begun, waited = File(CONTENT), threading.Event(), threading.Event()

    def slow(request: BaseHTTPRequestHandler) -> None:
        begun.set()
        assert waited.wait(30)
        file(request)

    class Waiting(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if "waiting for it" in record.getMessage():
                waited.set()

    web.pages["/droid.pth"] = slow
    waiting = Waiting()
    logging.getLogger("services.weights.fetching").addHandler(waiting)
    try:
        with ThreadPoolExecutor(2) as pool:
            first = pool.submit(pull, "droid", origin=web.url("/droid.pth"))
            assert begun.wait(30)
            second = pool.submit(pull, "droid", origin=web.url("/droid.pth"))
            assert [first.result().fetched, second.result().fetched] == [True, False]
    finally:
        logging.getLogger("services.weights.fetching").removeHandler(waiting)
    assert len(file.ranges) == 1
    assert sorted(path.name for path in folder.iterdir()) == ["droid.pth", "droid.pth.json"]


def test_what_a_disk_refuses_is_one_sentence(
    web: Web, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    web.pages["/droid.pth"] = File(CONTENT)
    with monkeypatch.context() as full:
        full.setattr(fetching.shutil, "disk_usage", lambda path: SimpleNamespace(free=len(CONTENT) - 1))
        with pytest.raises(StorageError, match=r"no room for droid\.pth .* VIPE_WEIGHTS"):
            pull("droid", origin=web.url("/droid.pth"))
    assert list(folder.iterdir()) == []
    (tmp_path / "a_file").write_text("")
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path / "a_file" / "weights"))
    with pytest.raises(StorageRefused, match=r"cannot be used .* VIPE_WEIGHTS"):
        pull("droid", origin=web.url("/droid.pth"))


def test_without_a_network_the_way_around_it_is_named(web: Web, folder: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        with pytest.raises(HttpFailed, match=r"cannot be reached .* --from"):
            pull("droid", origin=f"http://127.0.0.1:{unused.getsockname()[1]}/droid.pth")
    assert list(folder.iterdir()) == []


def test_the_command_lists_pulls_verifies_and_mirrors(web: Web, folder: Path, tmp_path: Path) -> None:
    web.pages["/droid.pth"] = File(CONTENT)

    def vipectl(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["models", *words])
        return done.exit_code, done.output

    code, text = vipectl("list")
    assert code == 0
    (droid,) = (line for line in text.splitlines() if line.startswith("droid "))
    assert all(word in droid for word in ("pose_only", "BSD-3-Clause", "not published", "https://")), "a row is a line"
    assert "there are no weights in" in vipectl("verify")[1]
    code, text = vipectl("verify", "droid")
    assert code == 1
    assert "weights_missing" in text
    code, text = vipectl("pull", "droid", "--from", web.url("/droid.pth"))
    assert code == 0, text
    assert "trusted on first use" in text
    assert "BSD-3-Clause" in text
    assert vipectl("mirror", str(tmp_path / "mirror"))[1].strip() == f"{tmp_path}/mirror/droid.pth"
    assert json.loads((tmp_path / "mirror" / "droid.pth.json").read_text())["sha256"] == SHA256
    code, text = vipectl("verify")
    assert code == 0
    assert SHA256 in text
    path_of("droid").write_bytes(b"damaged")
    code, text = vipectl("verify")
    assert code == 1
    assert "weights_invalid" in text
