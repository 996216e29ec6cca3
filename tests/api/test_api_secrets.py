"""Keys, passwords and signed addresses go through all that can go wrong; then logs, answers and database are read."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import httpx
import pytest
from api_helpers import assert_problem, body
from api_service import ROOT, running

from services.domain.errors import StorageError, StoreUnavailable, code_and_message
from services.domain.redaction import redact
from services.store.sql import SqlStore, open_when_ready

BOOTSTRAP = "bootstrap-hunter2"
SIGNED = "https://bucket.example/clip.mp4?X-Amz-Credential=cred-hunter2&X-Amz-Signature=sig-hunter2"


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_nothing_secret_is_written_down(tmp_path: Path, log_format: str) -> None:
    database = tmp_path / "store.db"
    store = SqlStore(f"sqlite:///{database}")
    made, key = store.create_key("used")
    secret = key.rsplit("_", 1)[1]
    wrong_secret = "b" * 52
    wrong = f"vipe_{made.id}_{wrong_secret}"
    answers: list[httpx.Response] = []
    with tempfile.TemporaryFile("w+") as log:
        settings = (f"api_key={BOOTSTRAP}", "log_level=DEBUG", f"log_format={log_format}")
        with running(f"sqlite:///{database}", *settings, stderr=log) as service:
            for bearer in (BOOTSTRAP, key, wrong, "guess-hunter2"):
                headers = {"Authorization": f"Bearer {bearer}"}
                with httpx.Client(base_url=service.url, headers=headers, timeout=60) as http:
                    answers += [
                        http.get("/v1/jobs"),
                        http.get(f"/v1/jobs?api_key={key}&page_token=page-hunter2"),
                        http.get(f"/v1/jobs/{key}"),
                        http.get(f"/v1/keys/{key}"),
                        http.post(f"/v1/keys/{key}/revoke"),
                        http.post("/v1/jobs", json=body(inputs=[SIGNED])),
                        http.post("/v1/jobs", json=body(inputs=["ftp://user:ftp-hunter2@host/clip.mp4"])),
                        http.post("/v1/jobs", json=body(output="postgresql://vipe:db-hunter2@host/db")),
                        http.post("/v1/jobs", json=body(scale_from="password=scale-hunter2")),
                        http.post("/v1/jobs", json=body(), headers={"Idempotency-Key": "plain"}),
                        http.post("/v1/jobs", content=f'{{"token": "json-hunter2", {key}'.encode()),
                        http.get("/v1/nothing", headers={"X-Request-ID": "token=id-hunter2"}),
                    ]
        log.seek(0)
        logged = log.read()
    job = store.list_jobs(limit=1)[0][0]
    store.fail_job(job.id, "storage_error", f"GET {SIGNED} said 403")
    assert "403" in (store.get_job(job.id).error_message or "")
    store.close()
    assert "GET /v1/jobs" in logged
    assert {answer.status_code for answer in answers} >= {200, 202, 400, 401, 404, 422}
    kept = b"".join(file.read_bytes() for file in tmp_path.glob("store.db*"))
    for place, text in {
        "log": logged,
        "answers": "".join(f"{a.headers} {a.text}" for a in answers),
        "database": kept.decode("latin-1"),
    }.items():
        for hidden in (secret, wrong_secret, "hunter2"):
            assert hidden not in text, (place, text[max(0, text.find(hidden) - 200) :][:300])


def test_a_database_that_does_not_answer_does_not_tell_its_password(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(StoreUnavailable) as raised:
        open_when_ready("postgresql://vipe:hunter2@127.0.0.1:9/vipe", patience_s=1)
    assert "hunter2" not in str(raised.value) + caplog.text


@pytest.mark.parametrize("url", ["postgresql://vipe:hunter2@127.0.0.1:port/vipe", "x://a:hunter2@b"])
def test_the_address_of_no_database_does_not_tell_its_password(url: str, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "VIPE_DATA_DIR": str(tmp_path), "VIPE_DATABASE_URL": url}
    command = [sys.executable, "-m", "services.cli.main", "api"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode != 0
    assert "hunter2" not in done.stdout + done.stderr


def test_signed_addresses_are_refused_by_name(http: httpx.Client) -> None:
    problem = assert_problem(http.post("/v1/jobs", json=body(inputs=[SIGNED])), 422, "invalid_request")
    assert "credentials" in problem["errors"][0]["message"]


@pytest.mark.parametrize(
    "query", ["sig=s3cr3t", "Signature=s3cr3t&Expires=1", "X-Goog-Credential=s3cr3t", "token=s3cr3t"]
)
def test_signatures_of_several_stores(query: str) -> None:
    address = f"https://host/a/clip.mp4?{query}"
    assert "s3cr3t" not in redact(address)
    assert "s3cr3t" not in code_and_message(StorageError(f"could not read {address}"))[1]
    assert redact("https://host/design=2/clip.mp4?part=1") == "https://host/design=2/clip.mp4?part=1"
