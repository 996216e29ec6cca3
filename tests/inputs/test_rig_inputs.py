"""A rig file of a job and the videos that it names: where they are, how they reach a worker, what is refused."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import pytest

from services.domain.errors import InputUnavailable, ServiceError
from services.domain.models import VideoRef, is_rig, video_key, view_key
from services.inputs.rigs import fetched_rig, video_uri
from services.inputs.rules import InputRules
from services.planner.listing import expand
from vipe_core.cameras.rig import read_rig
from vipe_core.errors import ConfigError

IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def rig_file(folder: Path, videos: dict[str, str | None], name: str = "car.rig.json") -> VideoRef:
    """A rig of views, each with its video; videos of plain names are there and hold the name of their view."""
    views: list[dict[str, Any]] = []
    for view, video in videos.items():
        views.append({"name": view, "rig_from_cam": IDENTITY} | ({} if video is None else {"video": video}))
        if video is not None and "/" not in video:
            (folder / video).write_text(view)
    path = folder / name
    path.write_text(json.dumps({"version": 1, "views": views}))
    return VideoRef(video_key(str(path)), str(path), path.stat().st_size)


def videos_of(rig: VideoRef, rules: InputRules, folder: Path) -> dict[str, str]:
    """What a worker reads of each view."""
    folder.mkdir(exist_ok=True)
    with fetched_rig(rig, rules, folder) as local:
        return {view.name: Path(view.video or "").read_text() for view in read_rig(local.path).views}


@pytest.mark.parametrize(
    ("uri", "rig"),
    [
        ("/data/rig.json", True),
        ("s3://bucket/a/Car.RIG.json", True),
        ("https://host/x.rig.json?token=1", True),
        ("s3://bucket/sets.tar!/7/rig.json#1536", True),
        ("/data/rig.mp4", False),
        ("/data/brig.json", False),
    ],
)
def test_a_rig_is_told_by_its_name(uri: str, rig: bool) -> None:
    assert is_rig(uri) is rig


@pytest.mark.parametrize(
    ("rig", "video", "uri"),
    [
        ("/data/a/rig.json", "left.mp4", "/data/a/left.mp4"),
        ("/data/a/rig.json", "./cams/../left.mp4", "/data/a/left.mp4"),
        ("/data/a/rig.json", "/other/left.mp4", "/other/left.mp4"),
        ("s3://bucket/a/rig.json", "cams/left.mp4", "s3://bucket/a/cams/left.mp4"),
        ("s3://bucket/a/rig.json", "s3://other/left.mp4", "s3://other/left.mp4"),
        ("https://host/a/rig.json?v=1", "left.mp4", "https://host/a/left.mp4"),
        ("s3://bucket/sets.tar!/7/rig.json#1536", "left.mp4", "s3://bucket/sets.tar!/7/left.mp4"),
    ],
)
def test_videos_lie_beside_their_rig_or_have_an_address(rig: str, video: str, uri: str) -> None:
    assert video_uri(rig, video) == uri


def test_a_worker_gets_every_view(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    rig = rig_file(folder, {"left": "l.mp4", "right": "r.mp4"})
    (found,) = expand(rig.uri)
    assert (found.uri, found.size_bytes) == (rig.uri, rig.size_bytes)
    for rules in (InputRules(), InputRules(roots=(folder,))):
        assert videos_of(rig, rules, tmp_path / "scratch") == {"left": "left", "right": "right"}
    with tarfile.open(folder / "sets.tar", "w") as tar:
        for name in ("l.mp4", "car.rig.json", "r.mp4"):
            tar.add(folder / name, f"7/{name}")
    inside = VideoRef("car", f"{folder}/sets.tar!/7/car.rig.json", 0)
    assert videos_of(inside, InputRules(), tmp_path / "scratch") == {"left": "left", "right": "right"}
    left = {path.name for path in (tmp_path / "scratch").iterdir()}
    assert left <= {"rig.json"}


@pytest.mark.parametrize(
    ("videos", "error", "says"),
    [
        ({"left": "l.mp4", "right": None}, ConfigError, "view right names no video"),
        ({"left": "l.mp4", "a b": "r.mp4"}, ConfigError, "letters, digits"),
        ({"left": "l.mp4", "right": "../r.mp4"}, InputUnavailable, "beside or below"),
        ({"left": "l.mp4", "right": "/etc/hostname"}, InputUnavailable, "outside of the directories"),
        ({"left": "l.mp4", "right": "cams/r.mp4"}, InputUnavailable, "r.mp4"),
    ],
)
def test_what_no_worker_can_get_is_said(
    tmp_path: Path, videos: dict[str, str | None], error: type[ServiceError], says: str
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    with pytest.raises(error, match=says):
        videos_of(rig_file(folder, videos), InputRules(roots=(folder,)), tmp_path / "scratch")


def test_keys_of_views_are_those_of_no_video() -> None:
    key = video_key("/data/car.rig.json")
    assert view_key(key, "left") == f"{key}_VIEW_left"
    assert view_key(key, "left").lower() != view_key(key, "left")
