"""Jobs over real HTTP."""

from __future__ import annotations

from datetime import datetime

import httpx
import pytest
from api_helpers import assert_problem, body, claim, finish, plan, submit

from services.api import paging
from services.domain.models import JobSpec, LeaseProgress
from services.store.sql import SqlStore

LENS = {"version": 1, "model": "pinhole", "width": 640, "height": 480, "fx": 500, "fy": 505, "cx": 340, "cy": 240}


class TestCreate:
    def test_it_is_accepted_with_its_place(self, http: httpx.Client) -> None:
        wanted = body(
            inputs=["/a/", "s3://bucket/prefix/", "/clip.mp4"],
            output="s3://bucket/out/",
            preset="classical",
            camera="pinhole",
            attributes=["depth", "pose"],
            shard_max_videos=3,
            shard_max_input_bytes=1000,
            name="Nächte",
            scale_from="height=1.6",
            phrases=["red car"],
            detection_interval_s=0.5,
            metric_depth="hf.depth_pro",
        )
        answer = http.post("/v1/jobs", json=wanted)
        assert answer.status_code == 202
        job = answer.json()
        assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
        assert "idempotent-replayed" not in answer.headers
        assert job["state"] == "queued"
        expected = {**wanted, "output": "s3://bucket/out", "attributes": ["pose", "intrinsics", "depth"]}
        expected |= {"calibration": None, "tracks": None}
        assert job["spec"] == expected
        assert job["progress"]["frames_expected"] is None
        assert http.get(answer.headers["location"]).json() == job

    def test_a_calibration_goes_along_in_one_form(self, http: httpx.Client) -> None:
        spec = http.post("/v1/jobs", json=body(calibration={**LENS, "pixel_centre": "integer"})).json()["spec"]
        assert spec["calibration"] == {**LENS, "cx": 340.5, "cy": 240.5, "use": "fixed"}
        assert JobSpec.from_json(spec).config_hash != JobSpec.from_json({**spec, "calibration": None}).config_hash
        for wrong in (
            {"calibration": {**LENS, "fx": -1}},
            {"calibration": LENS, "camera": "mei"},
            {"calibration": LENS, "preset": "panorama"},
        ):
            assert http.post("/v1/jobs", json=body(**wrong)).status_code == 422

    def test_attributes_of_a_request_and_of_the_domain_agree(self, http: httpx.Client) -> None:
        job = http.post("/v1/jobs", json=body()).json()
        assert tuple(job["spec"]["attributes"]) == JobSpec(("/in",), "/out").attributes
        assert "mask" in job["spec"]["attributes"]
        assert "confidence" not in job["spec"]["attributes"]
        asked = http.post("/v1/jobs", json=body(attributes=["confidence"])).json()
        assert asked["spec"]["attributes"] == ["pose", "intrinsics", "confidence"]

    def test_times_are_rfc_3339_in_utc(self, http: httpx.Client) -> None:
        job = http.get(f"/v1/jobs/{submit(http)}").json()
        assert job["created_at"].endswith("Z")
        assert datetime.fromisoformat(job["created_at"]).utcoffset() is not None
        assert job["finished_at"] is None

    def test_idempotency(self, http: httpx.Client) -> None:
        wanted = body()
        headers = {"Idempotency-Key": "one"}
        first = http.post("/v1/jobs", json=wanted, headers=headers)
        again = http.post("/v1/jobs", json=wanted, headers=headers)
        assert again.status_code == 202
        assert again.headers["idempotent-replayed"] == "true"
        assert again.headers["location"] == first.headers["location"]
        assert again.json()["id"] == first.json()["id"]
        assert_problem(http.post("/v1/jobs", json=body(), headers=headers), 422, "idempotency_conflict")
        assert_problem(http.post("/v1/jobs", json=wanted), 409, "output_in_use")
        long = {"Idempotency-Key": "x" * 256}
        assert_problem(http.post("/v1/jobs", json=body(), headers=long), 422, "invalid_request")

    def test_an_invalid_request_uses_no_key(self, http: httpx.Client) -> None:
        headers = {"Idempotency-Key": "two"}
        assert_problem(http.post("/v1/jobs", json={"inputs": []}, headers=headers), 422, "invalid_request")
        assert http.post("/v1/jobs", json=body(), headers=headers).status_code == 202

    @pytest.mark.parametrize(
        ("changes", "field"),
        [
            ({"inputs": []}, "body.inputs"),
            ({"inputs": "/videos"}, "body.inputs"),
            ({"inputs": ["videos"]}, "body.inputs.0"),
            ({"inputs": ["/ok", "ftp://host/clip.mp4"]}, "body.inputs.1"),
            ({"inputs": ["/ok", "http://user:secret@host/clip.mp4"]}, "body.inputs.1"),
            ({"output": "https://host/out"}, "body"),
            ({"inputs": ["s3://Bucket/x"]}, "body.inputs.0"),
            ({"inputs": ["s3://"]}, "body.inputs.0"),
            ({"inputs": ["/a/../../etc"]}, "body.inputs.0"),
            ({"inputs": ["/a\n"]}, "body.inputs.0"),
            ({"inputs": ["/" + "x" * 3000]}, "body.inputs.0"),
            ({"inputs": ["/a"] * 1001}, "body.inputs"),
            ({"output": "relative"}, "body.output"),
            ({"output": "/"}, "body"),
            ({"output": "/videos/"}, "body"),
            ({"output": 7}, "body.output"),
            ({"preset": "magic"}, "body.preset"),
            ({"camera": "periscope"}, "body.camera"),
            ({"attributes": ["pose", "sound"]}, "body.attributes.1"),
            ({"shard_max_videos": 0}, "body.shard_max_videos"),
            ({"shard_max_videos": "3"}, "body.shard_max_videos"),
            ({"shard_max_input_bytes": True}, "body.shard_max_input_bytes"),
            ({"name": "x" * 201}, "body.name"),
            ({"scale_from": "height"}, "body.scale_from"),
            ({"scale_from": "height=-1"}, "body.scale_from"),
            ({"metric_depth": "magic"}, "body.metric_depth"),
            ({"tracks": "magic"}, "body.tracks"),
            ({"preset": "classical", "tracks": "classical.corners"}, "body"),
            ({"detection_interval_s": 0}, "body.detection_interval_s"),
            ({"phrases": ["x" * 65]}, "body.phrases.0"),
            ({"preset": "vipe_fast", "camera": "equirect"}, "body"),
            ({"preset": "pose_only", "attributes": ["pose", "depth"]}, "body"),
            ({"preset": "panorama", "metric_depth": "hf.depth_pro"}, "body"),
            ({"preset": "panorama", "calibration": LENS}, "body"),
            ({"unknown": 1}, "body.unknown"),
        ],
    )
    def test_what_is_wrong_is_named(self, http: httpx.Client, changes: dict[str, object], field: str) -> None:
        problem = assert_problem(http.post("/v1/jobs", json=body(**changes)), 422, "invalid_request")
        assert [e["field"] for e in problem["errors"]] == [field]
        assert field in problem["detail"]

    def test_a_web_server_that_is_not_allowed(self, http: httpx.Client) -> None:
        answer = http.post("/v1/jobs", json=body(inputs=["https://host/clip.mp4"]))
        assert "allowed: none" in assert_problem(answer, 422, "address_refused")["detail"]

    def test_a_preset_without_depth_writes_none(self, http: httpx.Client) -> None:
        spec = http.post("/v1/jobs", json=body(preset="pose_only")).json()["spec"]
        assert spec["attributes"] == ["pose", "intrinsics", "rgb", "mask"]

    def test_a_preset_that_is_not_offered_names_those_that_are(self, http: httpx.Client) -> None:
        problem = assert_problem(http.post("/v1/jobs", json=body(preset="magic")), 422, "invalid_request")
        assert "classical" in problem["errors"][0]["message"]

    def test_a_body_that_is_no_json(self, http: httpx.Client) -> None:
        headers = {"Content-Type": "application/json"}
        assert_problem(http.post("/v1/jobs", content=b"{", headers=headers), 400, "invalid_json")
        assert_problem(http.post("/v1/jobs", content=b"\xff\xfe", headers=headers), 400, "invalid_json")
        assert_problem(http.post("/v1/jobs", content=b"", headers=headers), 422, "invalid_request")
        assert_problem(http.post("/v1/jobs", content=b"[]", headers=headers), 422, "invalid_request")
        assert_problem(http.post("/v1/jobs", data={"inputs": "/a"}), 415, "unsupported_media_type")
        assert_problem(http.post("/v1/jobs", content=b"{}"), 415, "unsupported_media_type")

    def test_text_that_is_no_unicode(self, http: httpx.Client) -> None:
        headers = {"Content-Type": "application/json"}
        for text in (
            '{"inputs": ["/a"], "output": "/b", "name": "\\ud800"}',
            '{"\\ud800": 1}',
            '{"inputs": ["/\\ud800"]}',
        ):
            assert_problem(http.post("/v1/jobs", content=text.encode(), headers=headers), 422, "invalid_request")

    def test_a_body_that_is_too_large(self, http: httpx.Client) -> None:
        headers = {"Content-Type": "application/json"}
        big = b" " * (1 << 20) + b"{}"
        assert_problem(http.post("/v1/jobs", content=big, headers=headers), 413, "body_too_large")
        chunks = (big[i : i + 65536] for i in range(0, len(big), 65536))  # without a Content-Length
        assert_problem(http.post("/v1/jobs", content=chunks, headers=headers), 413, "body_too_large")


class TestRead:
    def test_pages_of_jobs(self, http: httpx.Client) -> None:
        ids = [submit(http) for _ in range(3)]
        page = http.get("/v1/jobs", params={"limit": 2}).json()
        assert [job["id"] for job in page["items"]] == [ids[2], ids[1]]
        page = http.get("/v1/jobs", params={"limit": 2, "page_token": page["next_page_token"]}).json()
        assert page["items"][0]["id"] == ids[0]
        http.post(f"/v1/jobs/{ids[1]}/cancel")
        cancelled = http.get("/v1/jobs", params={"state": "cancelled"}).json()
        assert ids[1] in {job["id"] for job in cancelled["items"]}
        assert {job["state"] for job in cancelled["items"]} == {"cancelled"}

    def test_progress_and_results(self, http: httpx.Client, store: SqlStore) -> None:
        job_id = submit(http)
        plan(store, job_id, shards=2, videos_each=2)
        leases = claim(store, job_id)
        store.renew(
            "agent", [LeaseProgress(leases[0].fence, leases[0].shard_id, "s0v0", "slam", 1, 30, 100)], ttl_s=600
        )
        job = http.get(f"/v1/jobs/{job_id}").json()
        assert (job["state"], job["planned"]) == ("running", True)
        progress = job["progress"]
        assert (progress["frames_done"], progress["frames_expected"], progress["videos_done"]) == (30, 200, 1)
        assert progress["frames_per_s"] > 0
        assert progress["eta_s"] > 0
        shards = http.get(f"/v1/jobs/{job_id}/shards").json()["items"]
        assert [(s["ordinal"], s["state"], s["holder"]) for s in shards] == [
            (0, "leased", "agent"),
            (1, "leased", "agent"),
        ]

        for lease in leases:
            store.release(lease.shard_id, lease.fence, "for the helper")
        finish(store, job_id, "s1v0")
        job = http.get(f"/v1/jobs/{job_id}").json()
        assert job["state"] == "succeeded_with_errors"
        assert (job["progress"]["videos_succeeded"], job["progress"]["videos_failed"]) == (3, 1)

        first = http.get(f"/v1/jobs/{job_id}/videos", params={"limit": 3}).json()
        rest = http.get(f"/v1/jobs/{job_id}/videos", params={"limit": 3, "page_token": first["next_page_token"]}).json()
        assert [v["key"] for v in first["items"] + rest["items"]] == ["s0v0", "s0v1", "s1v0", "s1v1"]
        assert rest["next_page_token"] is None
        good = first["items"][0]
        assert (good["status"], good["num_frames"], good["camera_params"]) == ("succeeded", 7, [500, 500, 320, 240])
        assert good["quality"] == {"reliable": "yes", "reasons": []}
        for params in ({"status": "failed"}, {"error_code": "media_corrupt"}):
            (bad,) = http.get(f"/v1/jobs/{job_id}/videos", params=params).json()["items"]
            assert (bad["key"], bad["error_message"]) == ("s1v0", "/videos/s1v0.mp4 is broken")
            assert bad["num_frames"] is None
        assert http.get(f"/v1/jobs/{job_id}/videos", params={"error_code": "other"}).json()["items"] == []

    @pytest.mark.parametrize("path", ["", "/videos", "/shards", "/events"])
    def test_a_job_that_is_not_there(self, http: httpx.Client, path: str) -> None:
        problem = assert_problem(http.get(f"/v1/jobs/job_nope{path}"), 404, "job_not_found")
        assert "job_nope" in problem["detail"]

    @pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs/{}/videos", "/v1/jobs/{}/shards", "/v1/jobs/{}/events"])
    def test_page_tokens_and_limits(self, http: httpx.Client, path: str) -> None:
        target = path.format(submit(http))
        headers = {"Accept": "application/json"}
        elsewhere = "WyJlbHNld2hlcmUiLCAiMSJd"  # ["elsewhere", "1"]
        name = "jobs" if path == "/v1/jobs" else f"{path.rsplit('/', 1)[1]} of {target.split('/')[3]}"
        unstorable = [paging.token(cursor, of=name) for cursor in ("\ud800", "7\udfff", "a\x00b")]
        for token in ("garbage", "", "ÿ", elsewhere, "bnVsbA", *unstorable):
            answer = http.get(target, params={"page_token": token}, headers=headers)
            assert_problem(answer, 400, "invalid_page_token")
        for limit in ("0", "1001", "many"):
            answer = http.get(target, params={"limit": limit}, headers=headers)
            assert assert_problem(answer, 422, "invalid_request")["errors"][0]["field"] == "query.limit"

    @pytest.mark.parametrize("path", ["", "/videos", "/shards", "/events"])
    def test_an_id_that_no_database_can_hold(self, http: httpx.Client, path: str) -> None:
        assert_problem(http.get(f"/v1/jobs/job_%00{path}"), 404, "job_not_found")
        assert_problem(http.get(f"/v1/jobs/job_%ED%A0%80{path}"), 404, "job_not_found")

    def test_an_error_code_that_cannot_be(self, http: httpx.Client) -> None:
        answer = http.get(f"/v1/jobs/{submit(http)}/videos?error_code=a%00b")
        assert assert_problem(answer, 422, "invalid_request")["errors"][0]["field"] == "query.error_code"

    def test_unknown_states(self, http: httpx.Client) -> None:
        assert_problem(http.get("/v1/jobs", params={"state": "bored"}), 422, "invalid_request")
        job_id = submit(http)
        assert_problem(http.get(f"/v1/jobs/{job_id}/videos", params={"status": "bored"}), 422, "invalid_request")


class TestCancel:
    def test_cancel(self, http: httpx.Client, store: SqlStore) -> None:
        job_id = submit(http)
        plan(store, job_id)
        (lease, _) = claim(store, job_id)
        answer = http.post(f"/v1/jobs/{job_id}/cancel")
        assert (answer.status_code, answer.json()["state"]) == (202, "cancelling")
        for each in claim(store, job_id):
            store.release(each.shard_id, each.fence, "x")
        store.release(lease.shard_id, lease.fence, "x")
        second = next(s for s in store.list_shards(job_id)[0] if s.state == "leased")
        store.release(second.id, 1, "x")
        assert http.get(f"/v1/jobs/{job_id}").json()["state"] == "cancelled"
        assert_problem(http.post(f"/v1/jobs/{job_id}/cancel"), 409, "job_not_cancellable")
        assert_problem(http.post("/v1/jobs/job_nope/cancel"), 404, "job_not_found")
