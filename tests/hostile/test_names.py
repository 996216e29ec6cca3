"""Names from outside never become keys or paths as they are."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st

from services.domain.errors import StorageRefused
from services.domain.models import VideoRef, video_key
from services.planner.listing import Found
from services.planner.packing import SeenVideos, new_videos
from services.storage.keys import check_key
from vipe_core.video.naming import sanitise_name

KEY = re.compile(r"[a-z0-9_-]{1,80}")
NAMES = st.one_of(
    st.text(max_size=60),
    st.text(alphabet="./\\-_ \u202e\u200b\x00\n:aA\u0130\u0131\ufb01", max_size=30),
    st.sampled_from(["..", ".", "../../etc/passwd", "CON", "nul", "-rf", "~", "$(id)", "a" * 4000]),
    st.sampled_from(["a\u0301", "\u00e1", "K", "\u212a"]),
)  # fmt: skip


@given(NAMES)
@example("../../etc/passwd")
@example("\u202egpj.mp4")
def test_a_key_is_plain_whatever_the_name(name: str) -> None:
    for uri in (f"/videos/{name}.mp4", f"s3://bucket/{name}", f"https://host/{name}?x=/../{name}"):
        key = video_key(uri.encode("utf-8", "replace").decode())
        assert KEY.fullmatch(key)
        assert check_key(key) == key
        assert Path("/root", key).parent == Path("/root")
    assert re.fullmatch(r"[A-Za-z0-9_-]{1,120}", sanitise_name(name))


@given(st.lists(NAMES, max_size=12))
def test_different_addresses_get_different_keys(names: list[str]) -> None:
    """Also those that are equal once case or Unicode forms are folded."""
    uris = []
    for name in names:
        folded = (name, name.casefold(), unicodedata.normalize("NFC", name), unicodedata.normalize("NFKD", name))
        uris += [f"/v/{form}.mp4".encode("utf-8", "replace").decode() for form in folded]
    with SeenVideos() as seen:
        videos: list[VideoRef] = list(new_videos((Found(uri, 1) for uri in uris), seen))
    assert {video.uri for video in videos} == set(uris)
    assert len({video.key for video in videos}) == len({video.key.casefold() for video in videos}) == len(set(uris))


@given(NAMES)
def test_an_object_key_stays_below_its_root(name: str) -> None:
    try:
        key = check_key(name)
    except StorageRefused:
        return
    root = Path("/root/of/store")
    assert (root / key).is_relative_to(root)
    assert ".." not in key.split("/")
