"""A rig in a job: one unit of work, whose views become samples of the data set together or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from agent_rig import Rig

from services.agent.jobs import JobKeeper
from services.commit.reconcile import committed_records
from services.dataset import iterate, read_one, unpack, verify
from services.domain.models import CommitRecord, JobSpec
from services.domain.states import JobState
from services.planner import plan_next
from services.storage import open_store
from vipe_core.cameras.rig import read_rig


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Rig]:
    made = Rig.make(tmp_path)
    yield made
    made.store.close()


def submit(agent: Rig, scripts: dict[str, str], **options: object) -> str:
    """A job of a rig with a view for each script, and of one video more."""
    folder = agent.root / "inputs"
    folder.mkdir()
    views = []
    for number, (name, script) in enumerate(scripts.items()):
        (folder / f"{name}.txt").write_text(script)
        mount = np.eye(4)
        mount[0, 3] = 0.1 * number
        views.append({"name": name, "video": f"{name}.txt", "rig_from_cam": mount.tolist()})
    (folder / "car.rig.json").write_text(json.dumps({"version": 1, "metric": True, "views": views}))
    (folder / "walk.mp4").write_text("frames=3")
    (folder / "list.csv").write_text(f"uri,key\n{folder}/car.rig.json,car\n{folder}/walk.mp4,walk\n")
    spec = JobSpec((str(folder / "list.csv"),), str(agent.root / "out"), attributes=("pose", "intrinsics"), **options)
    job, _ = agent.store.create_job(spec)
    assert plan_next(agent.store, "planner")
    return job.id


def work(agent: Rig, job: str) -> JobState:
    while agent.store.uncommitted_shards(job):
        assert agent.supervisor.work(agent.lease()).kind == "committed"
    JobKeeper(agent.store, agent.committer, agent.config, agent.metrics).step()
    return agent.store.get_job(job).state


def test_the_views_of_a_rig_are_samples(agent: Rig) -> None:
    job = submit(agent, {"left": "frames=5", "right": "frames=5"})
    assert work(agent, job) is JobState.SUCCEEDED
    output = open_store(str(agent.root / "out"))
    report = verify(output, deep=True)
    assert report.ok, report.problems
    assert (report.totals.videos, report.totals.succeeded, report.totals.frames) == (2, 2, 13)
    rows = {row.ref.key: row.result for row in agent.store.list_videos(job)[0]}
    assert rows["car"] is not None
    assert rows["car"].num_frames == 10

    samples = {sample.key: sample for sample in iterate(output)}
    assert sorted(samples) == ["car_VIEW_left", "car_VIEW_right", "walk"]
    right = samples["car_VIEW_right"]
    assert (right.row["rig"], right.row["view"], right.num_frames) == ("car", "right", 5)
    assert samples["walk"].row["rig"] is None
    one = read_one(output, "car_VIEW_right")
    np.testing.assert_array_equal(one.world_from_cam, right.world_from_cam)
    unpack(output, agent.root / "unpacked")
    found = read_rig(agent.root / "unpacked/vipe/car_VIEW_right_rig.json")
    assert [view.name for view in found.views] == ["left", "right"]
    assert found.views[1].rig_from_cam[0, 3] == pytest.approx(0.1)
    assert not (agent.root / "unpacked/vipe/walk_rig.json").exists()


def test_one_bad_view_fails_its_rig_and_nothing_else(agent: Rig) -> None:
    job = submit(agent, {"left": "frames=5", "right": "error"})
    assert work(agent, job) is JobState.SUCCEEDED_WITH_ERRORS
    output = open_store(str(agent.root / "out"))
    assert verify(output, deep=True).ok
    assert [sample.key for sample in iterate(output)] == ["walk"]
    rows = {row.ref.key: row.result for row in agent.store.list_videos(job)[0]}
    assert rows["car"] is not None
    assert rows["car"].error_code == "media_corrupt"


def test_a_calibration_is_not_for_rigs(agent: Rig) -> None:
    pinhole = {"version": 1, "model": "pinhole", "width": 16, "height": 12, "fx": 14, "fy": 14, "cx": 8, "cy": 6}
    job = submit(agent, {"left": "frames=5", "right": "frames=5"}, calibration=pinhole)
    work(agent, job)
    rows = {row.ref.key: row.result for row in agent.store.list_videos(job)[0]}
    assert rows["car"] is not None
    assert rows["car"].error_code == "invalid_config"


def test_a_record_with_views_survives_its_bytes(agent: Rig) -> None:
    job = submit(agent, {"left": "frames=5", "right": "frames=5"})
    work(agent, job)
    records = list(committed_records(open_store(str(agent.root / "out")), job))
    assert [CommitRecord.from_bytes(record.to_bytes()) for record in records] == records
    assert sum(video.views is not None for record in records for video in record.videos) == 1
