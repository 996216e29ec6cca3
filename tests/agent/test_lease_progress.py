"""What tells an operator that work goes on, hours before a long shard is committed."""

from __future__ import annotations

from pathlib import Path

from agent_rig import Rig

from services.agent.messages import SlotProgress
from services.domain.models import VideoResult
from services.domain.states import VideoStatus


def test_renewals_publish_how_far_the_work_is(tmp_path: Path) -> None:
    rig = Rig.make(tmp_path)
    rig.job({"a": "frames=3", "b": "frames=3"})
    live = rig.lease()
    done = VideoResult("a", "/a.mp4", VideoStatus.SUCCEEDED, 1, num_frames=3)
    live.follow((done,), lambda: SlotProgress(frames_done=2))
    rig.book.renew()
    assert rig.metric("vipe_frames_in_progress") == 5
    rig.book.drop(live)
    rig.book.renew()
    assert rig.metric("vipe_frames_in_progress") == 0
