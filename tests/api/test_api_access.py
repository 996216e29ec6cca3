"""Who may do what: keys, scopes, tenants, limits, and what is written down about it, over real HTTP."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from api_helpers import assert_problem, body, finish, plan, submit
from api_service import Service, running

from services.client import ApiError, Client
from services.domain.access import ALL_SCOPES, Scope
from services.store.sql import SqlStore

BOOTSTRAP = "the-first-key"


@dataclass
class World:
    """A service with two tenants and a key of each kind."""

    service: Service
    store: SqlStore

    def http(self, key: str | None) -> httpx.Client:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        return httpx.Client(base_url=self.service.url, headers=headers, timeout=60)

    def key(self, tenant: str, *scopes: Scope) -> str:
        return self.store.create_key("test", tenant=tenant, scopes=frozenset(scopes) or ALL_SCOPES)[1]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    database = f"sqlite:///{tmp_path_factory.mktemp('access')}/store.db"
    with running(database, f"api_key={BOOTSTRAP}", "rate_limit_per_s=1000", "rate_limit_burst=2000") as service:
        store = SqlStore(database)
        yield World(service, store)
        store.close()


class TestTenants:
    def test_no_route_shows_or_changes_what_belongs_to_another_tenant(self, world: World) -> None:
        """Every route of the document, so that a new one cannot forget the tenant."""
        with world.http(world.key("owner")) as owner, world.http(world.key("stranger")) as stranger:
            job_id = submit(owner)
            plan(world.store, job_id)
            key_id = owner.post("/v1/keys", json={"name": "x", "scopes": ["jobs:read"]}).json()["id"]
            before = owner.get(f"/v1/jobs/{job_id}").json()
            document = owner.get("/openapi.json").json()
            ids = {"job_id": job_id, "key_id": key_id, "key": "s0v0", "shard_id": f"{job_id}-000000"}
            walked = 0
            # Lists first: the trail of a tenant's own actions tells what it has tried to reach.
            for path, operations in sorted(document["paths"].items(), key=lambda item: "{" in item[0]):
                if not path.startswith("/v1/"):
                    continue
                names = re.findall(r"{(\w+)}", path)
                assert set(names) <= set(ids), f"{path}: give this test an id of something that the owner has"
                for method, operation in operations.items():
                    accept = {"Accept": "text/event-stream"} if path.endswith("/events") else {}
                    json = {} if "requestBody" in operation else None
                    answer = stranger.request(method, path.format(**ids), headers=accept, json=json)
                    where = (method, path, answer.text)
                    if names:
                        # An empty body may be refused before anything is looked up; then it must be refused as such.
                        assert answer.status_code == 404 or (json == {} and answer.status_code == 422), where
                    assert before["spec"]["output"] not in answer.text, where
                    if not names:
                        assert job_id not in answer.text, where
                        assert key_id not in answer.text, where
                    walked += 1
            assert walked >= 11
            after = owner.get(f"/v1/jobs/{job_id}").json()
            assert after == before
            assert owner.get(f"/v1/keys/{key_id}").json()["revoked_at"] is None
            assert [job["id"] for job in owner.get("/v1/jobs").json()["items"]] == [job_id]
            token = owner.get("/v1/jobs", params={"limit": 1}).json()["next_page_token"]
            assert token is None
            finish(world.store, job_id)

    def test_idempotency_keys_are_the_tenants(self, world: World) -> None:
        with world.http(world.key("one")) as one, world.http(world.key("two")) as two:
            key = {"Idempotency-Key": "shared"}
            first, second = (http.post("/v1/jobs", json=body(), headers=key) for http in (one, two))
            assert (first.status_code, second.status_code) == (202, 202)
            assert first.json()["id"] != second.json()["id"]
            assert (first.json()["tenant"], second.json()["tenant"]) == ("one", "two")

    def test_the_owner_of_an_output_is_not_told_to_others(self, world: World) -> None:
        with world.http(world.key("one")) as one, world.http(world.key("two")) as two:
            wanted = body()
            job_id = one.post("/v1/jobs", json=wanted).json()["id"]
            assert job_id not in assert_problem(two.post("/v1/jobs", json=wanted), 409, "output_in_use")["detail"]


class TestScopes:
    def test_every_route_names_a_scope_and_asks_for_it(self, world: World) -> None:
        keys = {scope: world.key("scopes", scope) for scope in Scope}
        with world.http(BOOTSTRAP) as http:
            document = http.get("/openapi.json").json()
        clients = {scope: world.http(key) for scope, key in keys.items()}
        for path, operations in document["paths"].items():
            if not path.startswith("/v1/"):
                continue
            for method, operation in operations.items():
                (scheme,) = operation["security"]
                (needed,) = next(iter(scheme.values()))
                for scope, client in clients.items():
                    json = {} if "requestBody" in operation else None
                    answer = client.request(method, re.sub(r"{\w+}", "aaaa", path), json=json)
                    if scope in (needed, Scope.ADMIN):
                        assert answer.status_code != 403, (method, path, scope)
                    else:
                        assert_problem(answer, 403, "forbidden")
        for client in clients.values():
            client.close()


class TestKeys:
    def test_made_used_and_revoked_over_the_api(self, world: World) -> None:
        with world.http(BOOTSTRAP) as admin:
            wanted = {"name": "nightly", "scopes": ["jobs:read"], "expires_in_s": 3600}
            made = admin.post("/v1/keys", json=wanted)
            assert made.status_code == 201
            key = made.json().pop("key")
            shown = admin.get(made.headers["location"])
            assert shown.json() == {name: value for name, value in made.json().items() if name != "key"}
            assert key not in admin.get("/v1/keys").text
            with world.http(key) as http:
                assert http.get("/v1/jobs").status_code == 200
                assert_problem(http.post("/v1/jobs", json=body()), 403, "forbidden")
                used = admin.get(made.headers["location"]).json()["last_used_at"]
                assert used is not None
                revoked = admin.post(f"{made.headers['location']}/revoke")
                assert (revoked.status_code, revoked.json()["revoked_at"] is not None) == (200, True)
                assert_problem(http.get("/v1/jobs"), 401, "unauthorized")
            assert admin.post(f"{made.headers['location']}/revoke").json() == revoked.json()

    def test_a_revocation_elsewhere_holds_within_the_time_that_is_promised(self, world: World) -> None:
        made, key = world.store.create_key("x", tenant="elsewhere")
        with world.http(key) as http:
            job_id = submit(http)
            followed = threading.Event()
            ended = threading.Event()

            def follow() -> None:
                with http.stream("GET", f"/v1/jobs/{job_id}/events", headers={"Accept": "text/event-stream"}) as stream:
                    for _ in stream.iter_lines():
                        followed.set()
                ended.set()

            follower = threading.Thread(target=follow)
            follower.start()
            assert followed.wait(30)
            world.store.revoke_key(made.id)
            deadline = time.monotonic() + 60
            while http.get("/v1/jobs").status_code == 200:
                assert time.monotonic() < deadline
                time.sleep(0.5)
            assert_problem(http.get("/v1/jobs"), 401, "unauthorized")
            assert ended.wait(60), "a stream that is open ends too"
            follower.join()

    @pytest.mark.parametrize(
        "wrong",
        [
            None,
            "Bearer",
            "Basic dGhlLWZpcnN0LWtleTo=",
            f"bearer {BOOTSTRAP}x",
            f"Token {BOOTSTRAP}",
            "Bearer vipe_aaaaaaaaaaaa_" + "a" * 52,
            "Bearer ÿÿ",
        ],
    )
    def test_wrong_keys(self, world: World, wrong: str | None) -> None:
        with world.http(None) as http:
            headers = {} if wrong is None else {"Authorization": wrong.encode("latin-1")}
            answer = http.get("/v1/jobs", headers=headers)
            detail = assert_problem(answer, 401, "unauthorized")["detail"]
            assert answer.headers["www-authenticate"] == "Bearer"
            assert "***" not in detail, "advice is not taken for a secret"

    def test_a_stranger_learns_nothing_from_bodies_paths_and_methods(self, world: World) -> None:
        with world.http(None) as http:
            headers = {"Content-Type": "application/json"}
            for answer in (
                http.post("/v1/jobs", content=b"{", headers=headers),
                http.delete("/v1/jobs"),
                http.get("/v1/nothing"),
                http.get("/v1"),
            ):
                assert_problem(answer, 401, "unauthorized")

    @pytest.mark.parametrize(
        "changes", [{"name": ""}, {"name": "a\x00"}, {"scopes": []}, {"scopes": ["all"]}, {"expires_in_s": 0}, {"x": 1}]
    )
    def test_keys_that_cannot_be(self, world: World, changes: dict[str, Any]) -> None:
        with world.http(BOOTSTRAP) as admin:
            answer = admin.post("/v1/keys", json={"name": "x", "scopes": ["admin"], **changes})
            assert_problem(answer, 422, "invalid_request")
            assert_problem(admin.get("/v1/keys/aaaa"), 404, "key_not_found")

    def test_on_loopback_without_a_setting_a_wrong_key_is_still_wrong(self, http: httpx.Client) -> None:
        assert http.get("/v1/jobs").status_code == 200
        wrong = {"Authorization": "Bearer vipe_aaaaaaaaaaaa_" + "a" * 52}
        assert_problem(http.get("/v1/jobs", headers=wrong), 401, "unauthorized")


class TestAudit:
    def test_what_was_changed_is_written_down(self, world: World) -> None:
        key = world.key("audited")
        key_id = key.split("_")[1]
        with world.http(key) as http:
            job_id = submit(http)
            http.get(f"/v1/jobs/{job_id}")
            http.post(f"/v1/jobs/{job_id}/cancel", headers={"X-Request-ID": "mine"})
            http.post("/v1/jobs/job_nope/cancel")
            http.post("/v1/jobs", json={"inputs": ["/secret-input"]})
            events = http.get("/v1/audit").json()["items"]
            told = [(e["action"], e["object"], e["status"], e["code"]) for e in reversed(events)]
            assert told == [
                ("POST /v1/jobs", f"/v1/jobs/{job_id}", 202, None),
                ("POST /v1/jobs/{job_id}/cancel", f"/v1/jobs/{job_id}/cancel", 202, None),
                ("POST /v1/jobs/{job_id}/cancel", "/v1/jobs/job_nope/cancel", 404, "job_not_found"),
                ("POST /v1/jobs", "/v1/jobs", 422, "invalid_request"),
            ]
            assert {(e["tenant"], e["key_id"], e["address"], e["count"]) for e in events} == {
                ("audited", key_id, "127.0.0.1", 1)
            }
            assert events[2]["request_id"] == "mine"
            page = http.get("/v1/audit", params={"limit": 3}).json()
            rest = http.get("/v1/audit", params={"limit": 3, "page_token": page["next_page_token"]}).json()
            assert page["items"] + rest["items"] == events

    def test_strangers_cannot_fill_the_database(self, tmp_path: Path) -> None:
        with running(f"sqlite:///{tmp_path}/store.db", f"api_key={BOOTSTRAP}") as service:
            store = SqlStore(service.database_url)
            claimed, right = store.create_key("x", tenant="a")
            with httpx.Client(base_url=service.url, timeout=60) as http:
                wrong = [f"vipe_{claimed.id}_" + "a" * 52, *(f"guess-{i}" for i in range(200))]
                answers = [http.get("/v1/jobs", headers={"Authorization": f"Bearer {key}"}) for key in wrong]
                codes = [answer.status_code for answer in answers]
                assert set(codes) == {401, 429}
                assert codes.count(401) < 40
                assert int(answers[-1].headers["retry-after"]) >= 1
                for key in (BOOTSTRAP, right):
                    header = {"Authorization": f"Bearer {key}"}
                    answer = http.get("/v1/jobs", headers=header)
                    assert answer.status_code == (200 if key == BOOTSTRAP else 429), "what is not known yet has to wait"
            assert [e.entry.status for e in store.audit("a")[0]] == [401], "of the tenant whose key was claimed"
            assert len(store.audit("default")[0]) == 1
            service.process.terminate()
            service.process.wait(timeout=60)
            events = store.audit("default")[0]
            assert sum(e.entry.count for e in events) == codes.count(401) - 1, "the end of the process tells the rest"
            assert len(events) == 2
            store.close()


class TestLimits:
    def test_too_many_requests(self, tmp_path: Path) -> None:
        limits = ("rate_limit_per_s=0.1", "rate_limit_burst=5", "allow_anonymous=false", f"api_key={BOOTSTRAP}")
        with running(f"sqlite:///{tmp_path}/store.db", *limits) as service:
            store = SqlStore(service.database_url)
            _, other = store.create_key("x")
            store.close()
            with httpx.Client(
                base_url=service.url, timeout=60, headers={"Authorization": f"Bearer {BOOTSTRAP}"}
            ) as http:
                answers = [http.get("/v1/jobs") for _ in range(8)]
                assert [a.status_code for a in answers[:5]] == [200] * 5
                problem = assert_problem(answers[-1], 429, "rate_limited")
                assert problem["detail"]
                assert 1 <= int(answers[-1].headers["retry-after"]) <= 10
                assert http.get("/healthz").status_code == 200
                assert http.get("/v1/jobs", headers={"Authorization": f"Bearer {other}"}).status_code == 200
            with Client(service.url, api_key=BOOTSTRAP) as patient:
                assert patient.jobs() == [], "the client waits as it is told"

    def test_too_many_streams(self, tmp_path: Path) -> None:
        headers = {"Accept": "text/event-stream"}
        with (
            running(f"sqlite:///{tmp_path}/store.db", "max_streams_per_key=2") as service,
            httpx.Client(base_url=service.url, timeout=60) as http,
        ):
            events = f"/v1/jobs/{submit(http)}/events"
            with contextlib.ExitStack() as opened:
                for _ in range(2):
                    assert opened.enter_context(http.stream("GET", events, headers=headers)).status_code == 200
                third = http.get(events, headers=headers)
                assert_problem(third, 429, "too_many_streams")
                assert third.headers["retry-after"]
            deadline = time.monotonic() + 30
            while True:  # those that ended do not count
                with http.stream("GET", events, headers=headers) as answer:
                    if answer.status_code == 200:
                        break
                assert time.monotonic() < deadline

    def test_a_body_that_trickles(self, tmp_path: Path) -> None:
        with running(f"sqlite:///{tmp_path}/store.db", "receive_timeout_s=1") as service:
            host, port = service.url.removeprefix("http://").split(":")
            kind = "Content-Type: application/json\r\nContent-Length: 99"
            head = f"POST /v1/jobs HTTP/1.1\r\nHost: {host}\r\n{kind}\r\n\r\n"
            with socket.create_connection((host, int(port)), timeout=60) as slow:
                slow.sendall(head.encode() + b"{")
                answer = slow.makefile("rb").read().decode()
            assert answer.startswith("HTTP/1.1 408")
            assert "body_too_slow" in answer

    def test_headers_that_trickle(self, tmp_path: Path) -> None:
        with running(f"sqlite:///{tmp_path}/store.db", "receive_timeout_s=1") as service:
            host, port = service.url.removeprefix("http://").split(":")
            for begun in (b"", b"GET /healthz HTTP/1.1\r\nHost: loc"):
                with socket.create_connection((host, int(port)), timeout=60) as slow:
                    slow.sendall(begun)
                    assert slow.recv(1000) == b"", "closed"
            with httpx.Client(base_url=service.url, timeout=60) as kept, kept.stream("GET", "/healthz") as first:
                connection = first.extensions["network_stream"]
                first.read()
                for _ in range(3):
                    time.sleep(0.7)
                    with kept.stream("GET", "/healthz") as again:
                        assert again.extensions["network_stream"] is connection, "a connection in use is kept"
                        again.read()


class TestBrowsers:
    def test_headers_of_every_answer(self, world: World) -> None:
        with world.http(BOOTSTRAP) as http:
            for path in ("/healthz", "/v1/jobs", "/v1/jobs/x", "/nothing", "/metrics", "/docs"):
                headers = http.get(path).headers
                assert headers["x-content-type-options"] == "nosniff"
                assert headers["x-frame-options"] == "DENY"
                assert "frame-ancestors 'none'" in headers["content-security-policy"]
                assert headers["cache-control"] == "no-store"
                assert headers["referrer-policy"] == "no-referrer"
                assert "access-control-allow-origin" not in headers
                assert "server" not in headers

    def test_pages_of_others(self, http: httpx.Client, service: Service) -> None:
        for origin in ("https://evil.example", "null", "http://localhost.evil.example"):
            answer = http.post("/v1/jobs", json=body(), headers={"Origin": origin})
            assert_problem(answer, 403, "origin_not_allowed")
            assert "access-control-allow-origin" not in http.get("/v1/jobs", headers={"Origin": origin}).headers
        assert http.post("/v1/jobs", json=body(), headers={"Origin": service.url}).status_code == 202

    def test_pages_that_are_allowed(self, tmp_path: Path) -> None:
        allowed = 'cors_origins=["https://viewer.example"]'
        with (
            running(f"sqlite:///{tmp_path}/store.db", allowed, f"api_key={BOOTSTRAP}") as service,
            httpx.Client(base_url=service.url, timeout=60) as http,
        ):
            ask = {
                "Access-Control-Request-Method": "POST",
                "Access-Control-Request-Headers": "authorization,content-type",
            }
            yes = http.options("/v1/jobs", headers={"Origin": "https://viewer.example", **ask})
            assert (yes.status_code, yes.headers["access-control-allow-origin"]) == (200, "https://viewer.example")
            no = http.options("/v1/jobs", headers={"Origin": "https://evil.example", **ask})
            assert "access-control-allow-origin" not in no.headers
            key = {"Authorization": f"Bearer {BOOTSTRAP}", "Origin": "https://viewer.example"}
            created = http.post("/v1/jobs", json=body(), headers=key)
            assert created.status_code == 202
            assert "Location" in created.headers["access-control-expose-headers"]

    def test_names_of_the_service(self, tmp_path: Path) -> None:
        allowed = 'allowed_hosts=["vipe.example", "*.cluster.local"]'
        with (
            running(f"sqlite:///{tmp_path}/store.db", allowed, f"api_key={BOOTSTRAP}") as service,
            httpx.Client(base_url=service.url, timeout=60, headers={"Authorization": f"Bearer {BOOTSTRAP}"}) as http,
        ):
            for host in ("vipe.example", "VIPE.example:443", "api.cluster.local"):
                assert http.get("/v1/jobs", headers={"Host": host}).status_code == 200
            for host in ("evil.example", "cluster.local.evil.example", "127.0.0.1"):
                assert_problem(http.get("/v1/jobs", headers={"Host": host}), 400, "unknown_host")


def test_the_client_waits_for_its_own_request(world: World) -> None:
    """A request that is sent again while the first one is worked on ends as one job."""
    made: list[dict[str, Any]] = []
    wanted = body()

    def submit_again() -> None:
        with Client(world.service.url, api_key=BOOTSTRAP) as client:
            made.append(client.submit(wanted, idempotency_key="at-once"))

    threads = [threading.Thread(target=submit_again) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 4
    assert made.count(made[0]) == 4, "all got the first answer"
    with Client(world.service.url, api_key=BOOTSTRAP) as client, pytest.raises(ApiError) as refused:
        client.submit(body(), idempotency_key="at-once")
    assert refused.value.code == "idempotency_conflict"
