"""A planned rig as a local rig file beside the videos of its views, for as long as a worker needs them.

An input whose name is `rig.json` or ends in `.rig.json` is a rig: one unit of work with all its views. Every view names
its video: a path beside or below the rig file, in the same folder, bucket, site or tar, or an address of its own, to
which the rules of inputs apply as to any other.
"""

from __future__ import annotations

import json
import posixpath
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urljoin

from services.domain.errors import InputUnavailable
from services.domain.models import VideoRef
from services.inputs.fetching import Fetched, fetched
from services.inputs.rules import WEB_SCHEMES, InputRules
from services.inputs.tars import Member, as_member
from services.storage.observer import StorageObserver
from vipe_core.errors import ConfigError

if TYPE_CHECKING:
    from vipe_core.cameras.rig import Rig

LOCAL_NAME = "rig.json"
# They become a part of the keys of samples.
_VIEW_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


@contextmanager
def fetched_rig(
    rig: VideoRef,
    rules: InputRules,
    folder: Path,
    *,
    s3_endpoint_url: str | None = None,
    observer: StorageObserver | None = None,
) -> Iterator[Fetched]:
    """Make a rig and its videos readable; the path is that of a rig file that names local videos.

    Args:
        folder: An empty one of the worker's own.

    Raises:
        ConfigError: Not a rig file; or a view has no video, or a name that no key can have.
        InputUnavailable, InputTooLarge, AddressRefused, HttpFailed, StorageError: As `fetched`, of the file or a video.
    """
    started = time.perf_counter()
    seconds = 0.0

    def place(name: str) -> Callable[[str], Path]:
        return lambda suffix: folder / f"{name}{suffix}"

    with ExitStack() as stack:

        def get(video: VideoRef, name: str) -> Path:
            nonlocal seconds
            local = stack.enter_context(
                fetched(video, rules, place(name), s3_endpoint_url=s3_endpoint_url, observer=observer)
            )
            seconds += local.seconds
            return local.path

        known = _read(get(rig, "given"), rig.uri)
        views = []
        for view in known.views:
            assert view.video is not None
            video = VideoRef(f"{rig.key}-{view.name}", video_uri(rig.uri, view.video), 0)
            views.append(replace(view, video=str(get(video, f"view-{view.name}"))))
        path = folder / LOCAL_NAME
        path.write_text(json.dumps(known.with_views(views).to_json()), encoding="utf-8")
        yield Fetched(path, round(time.perf_counter() - started, 4) if seconds else 0.0)


def video_uri(rig: str, video: str) -> str:
    """Address of a video that a rig file names.

    Raises:
        InputUnavailable: A path that leads out of the folder of the rig file.
    """
    if video.startswith(("s3://", "/", *WEB_SCHEMES)):
        return video
    inside = posixpath.normpath(video)
    if inside.startswith("../") or inside in ("..", "."):
        raise InputUnavailable(f"{rig} names the video {video!r}, which does not lie beside or below it")
    if (member := as_member(rig)) is not None:
        return Member(member.tar, posixpath.join(posixpath.dirname(member.name), inside)).uri
    if rig.startswith(WEB_SCHEMES):
        return urljoin(rig.partition("?")[0], inside)
    return posixpath.join(posixpath.dirname(rig), inside)


def _read(path: Path, uri: str) -> Rig:
    from vipe_core.cameras.rig import read_rig

    known = read_rig(path, uri)
    for view in known.views:
        if view.video is None:
            raise ConfigError(f"{uri}: view {view.name} names no video")
        if not _VIEW_NAME.fullmatch(view.name):
            raise ConfigError(f"{uri}: in a job, views are named by letters, digits, _ and -; not {view.name!r}")
    return known
