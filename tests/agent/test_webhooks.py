"""Events leave signed, come again until they are taken, and go nowhere they must not."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from ipaddress import ip_network
from pathlib import Path

import pytest
from pydantic import SecretStr

from services.agent.webhooks import WebhookSender
from services.client.webhooks import ForgedWebhook, verify_webhook
from services.domain.control import JobControl
from services.domain.models import JobSpec
from services.domain.signatures import sign
from services.network import NetworkPolicy
from services.observability.metrics import Metrics
from services.store.sql import SqlStore

SECRET = "a secret of some length"


@dataclass
class Receiver:
    """Takes webhooks on loopback; answers with the statuses it is given, then with 204."""

    url: str = ""
    statuses: list[int] = field(default_factory=list)
    got: list[tuple[dict[str, str], bytes]] = field(default_factory=list)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            made.got.append((dict(self.headers), body))
            self.send_response(made.statuses.pop(0) if made.statuses else 204)
            self.send_header("Location", "http://127.0.0.1:9/elsewhere")
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    made.url = f"http://127.0.0.1:{server.server_port}/hook"
    yield made
    server.shutdown()
    server.server_close()
    thread.join()


@dataclass
class Sending:
    store: SqlStore
    metrics: Metrics

    def job(self, url: str, secret: str = "ours") -> str:
        control = JobControl(webhook_url=url, webhook_secret=secret)
        return self.store.create_job(JobSpec(("/in",), f"/out/{url}"), control=control)[0].id

    def send(self, *networks: str) -> int:
        policy = NetworkPolicy(("*:*",), tuple(ip_network(n) for n in networks), ("https", "http"))
        sender = WebhookSender(self.store, {"default/ours": SecretStr(SECRET)}, policy, self.metrics)
        with ThreadPoolExecutor(1) as threads:
            return sender.send_due(threads)

    def count(self, result: str) -> float:
        return self.metrics.registry.get_sample_value("vipe_webhook_deliveries_total", {"result": result}) or 0.0


@pytest.fixture
def sending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Sending]:
    monkeypatch.setattr("services.agent.webhooks._jittered_s", lambda failures: 0.0)
    store = SqlStore(f"sqlite:///{tmp_path}/vipe.db")
    yield Sending(store, Metrics())
    store.close()


def test_an_event_arrives_signed_and_once(sending: Sending, receiver: Receiver) -> None:
    job_id = sending.job(receiver.url)
    assert sending.send("127.0.0.0/8") == 1
    assert sending.send("127.0.0.0/8") == 0
    ((headers, body),) = receiver.got
    message = verify_webhook(body, headers["Vipe-Signature"], SECRET)
    assert (message["job_id"], message["kind"], message["id"]) == (job_id, "job.queued", headers["Vipe-Event-Id"])
    assert headers["Content-Type"] == "application/json"
    assert sending.count("delivered") == 1


@pytest.mark.parametrize("status", [500, 404, 302, 429])
def test_what_is_not_taken_comes_again_with_the_same_id(sending: Sending, receiver: Receiver, status: int) -> None:
    receiver.statuses = [status]
    sending.job(receiver.url)
    sending.send("127.0.0.0/8")
    sending.send("127.0.0.0/8")
    (first, again) = receiver.got
    assert first[1] == again[1]
    assert first[0]["Vipe-Event-Id"] == again[0]["Vipe-Event-Id"]
    assert (sending.count("failed"), sending.count("delivered")) == (1, 1)


def test_a_private_address_is_contacted_only_where_it_is_allowed(sending: Sending, receiver: Receiver) -> None:
    sending.job(receiver.url)
    sending.send()
    assert receiver.got == []
    assert sending.count("failed") == 1
    sending.send("127.0.0.0/8")
    assert len(receiver.got) == 1


def test_without_its_secret_nothing_is_sent(sending: Sending, receiver: Receiver) -> None:
    sending.job(receiver.url, secret="gone")
    sending.send("127.0.0.0/8")
    assert receiver.got == []
    assert sending.store.undelivered() == 1


def test_after_many_attempts_it_is_given_up(
    sending: Sending, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.agent.webhooks._MAX_ATTEMPTS", 3)
    receiver.statuses = [500] * 9
    job_id = sending.job(receiver.url)
    for _ in range(5):
        sending.send("127.0.0.0/8")
    assert len(receiver.got) == 3
    assert sending.count("abandoned") == 1
    assert sending.store.events(job_id)[-1].kind == "webhook.abandoned"


class TestVerification:
    BODY = json.dumps({"id": "evt_1"}).encode()

    def test_the_secret_the_body_and_the_time_count(self) -> None:
        header = sign(self.BODY, SECRET, 1000)
        assert verify_webhook(self.BODY, header, SECRET, now_s=1100) == {"id": "evt_1"}
        for body, given, secret, now_s in (
            (self.BODY + b" ", header, SECRET, 1100),
            (self.BODY, header, SECRET + "x", 1100),
            (self.BODY, header, SECRET, 1400),
            (self.BODY, header, SECRET, 600),
            (self.BODY, header.replace("t=1000", "t=1001"), SECRET, 1100),
        ):
            with pytest.raises(ForgedWebhook):
                verify_webhook(body, given, secret, now_s=now_s)

    @pytest.mark.parametrize("header", ["", "t=,v1=", "v1=00", "t=1000", "t=x,v1=y", "t=²,v1=é", "t=1" + "0" * 99])
    def test_what_is_no_signature(self, header: str) -> None:
        with pytest.raises(ForgedWebhook):
            verify_webhook(self.BODY, header, SECRET, now_s=1000)
