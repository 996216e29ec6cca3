"""The metrics page: what is declared, what a committed video changes, and that the page parses."""

from __future__ import annotations

import math
import re
import urllib.request
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from services.agent.supervisor import VIDEO_TIMEOUT, WORKER_DIED
from services.domain.errors import InputUnavailable
from services.domain.models import VideoResult
from services.domain.states import VideoStatus
from services.observability.metrics import Metrics
from vipe_core import errors
from vipe_core.errors import VipeError

ROOT = Path(__file__).resolve().parents[2]


def _sample(metrics: Metrics, name: str, **labels: str) -> float | None:
    return metrics.registry.get_sample_value(name, labels)


def test_the_page_parses_and_every_metric_has_the_prefix_and_a_help_text() -> None:
    metrics = Metrics()
    families = list(text_string_to_metric_families(metrics.render().decode()))
    ours = [f for f in families if f.name.startswith("vipe_")]
    assert {"vipe_frames", "vipe_build_info", "vipe_lease_expired"} <= {f.name for f in ours}
    assert all(f.documentation for f in ours)
    assert all(f.name.startswith(("vipe_", "process_")) for f in families)


def test_a_state_that_the_store_stops_mentioning_falls_to_zero() -> None:
    metrics = Metrics()
    metrics.set_counts({"jobs": {"running": 2}, "shards": {"pending": 7}})
    assert _sample(metrics, "vipe_jobs", state="running") == 2
    metrics.set_counts({"jobs": {"succeeded": 2}, "shards": {}})
    assert _sample(metrics, "vipe_jobs", state="running") == 0
    assert _sample(metrics, "vipe_shards", state="pending") == 0


def test_a_settled_video_counts_once_by_outcome_and_error_code() -> None:
    metrics = Metrics()
    metrics.observe_video(
        VideoResult("a", "/a.mp4", VideoStatus.SUCCEEDED, 1, num_frames=40, timings_s={"decode": 2.0, "frontend": 3.0})
    )
    metrics.observe_video(VideoResult("b", "/b.mp4", VideoStatus.FAILED, 1, error_code="media_corrupt"))
    metrics.observe_video(VideoResult("c", "/c.mp4", VideoStatus.QUARANTINED, 1, error_code="worker_died"))
    assert _sample(metrics, "vipe_frames_total") == 40
    assert _sample(metrics, "vipe_videos_total", outcome="succeeded", error_class="") == 1
    assert _sample(metrics, "vipe_videos_total", outcome="failed", error_class="media_corrupt") == 1
    assert _sample(metrics, "vipe_videos_total", outcome="quarantined", error_class="worker_died") == 1
    assert _sample(metrics, "vipe_stage_duration_seconds_sum", stage="frontend") == 3.0


def test_the_first_of_a_kind_shows_as_an_increase() -> None:
    """Prometheus sees no increase in a series that begins at 1: every known one is on the page before it happens."""
    metrics = Metrics()
    codes = {kind.code for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, VipeError)}
    assert len(codes) > 12
    for code in codes | {VIDEO_TIMEOUT, InputUnavailable.code}:
        assert _sample(metrics, "vipe_videos_total", outcome="failed", error_class=code) == 0, code
    assert _sample(metrics, "vipe_videos_total", outcome="succeeded", error_class="") == 0
    assert _sample(metrics, "vipe_videos_total", outcome="quarantined", error_class=WORKER_DIED) == 0
    agent = "\n".join(path.read_text() for path in (ROOT / "services" / "agent").glob("*.py"))
    for reason in {VIDEO_TIMEOUT, *re.findall(r'actor_restarts\.labels\(reason="(\w+)"', agent)}:
        assert _sample(metrics, "vipe_actor_restarts_total", reason=reason) == 0, reason
    for result in re.findall(r'commit_conflicts\.labels\(result="(\w+)"', agent):
        assert _sample(metrics, "vipe_commit_conflicts_total", result=result) == 0, result


def test_a_store_that_is_down_leaves_no_stale_counts() -> None:
    metrics = Metrics()
    before = _sample(metrics, "vipe_store_up")
    assert before is not None
    assert math.isnan(before), "not known yet, and so no alarm"
    metrics.set_counts({"jobs": {"running": 2}, "shards": {}})
    assert _sample(metrics, "vipe_store_up") == 1
    metrics.store_is_down()
    assert _sample(metrics, "vipe_store_up") == 0
    assert _sample(metrics, "vipe_jobs", state="running") is None
    metrics.set_counts({"jobs": {"running": 3}, "shards": {}})
    assert _sample(metrics, "vipe_jobs", state="running") == 3


def test_two_instances_do_not_share_a_registry() -> None:
    first, second = Metrics(), Metrics()
    first.frames.inc(5)
    assert _sample(second, "vipe_frames_total") == 0


def test_a_stand_alone_agent_answers_over_http() -> None:
    metrics = Metrics()
    server, thread = metrics.serve(0)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/metrics", timeout=10) as answer:
            assert b"vipe_build_info" in answer.read()
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_every_declared_metric_is_emitted_by_the_service() -> None:
    """A metric that nothing writes is a lie on the dashboard."""
    services = ROOT / "services"
    declaration = services / "observability" / "metrics.py"
    handles = re.findall(r"self\.(\w+) = (?:Counter|Gauge|Histogram)\(", declaration.read_text())
    assert len(handles) > 10
    code = "\n".join(path.read_text() for path in services.rglob("*.py"))
    silent = [h for h in handles if not re.search(rf"\.{h}\.(labels|inc|set|observe)\(", code)]
    assert silent == []
