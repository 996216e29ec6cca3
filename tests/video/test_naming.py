"""Sequence names: safe and unique, whatever the paths are called."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.video import sanitise_name, unique_names


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ("clip", "clip"),
        ("my clip (1)", "my-clip-1"),
        ("a.b.c", "a-b-c"),
        ("été", "t"),
        ("日本", "video"),
        ("", "video"),
        ("..", "video"),
        ("-rf", "rf"),
        ("A_b-1", "A_b-1"),
    ],
)
def test_examples(stem: str, name: str) -> None:
    assert sanitise_name(stem) == name


@given(st.text())
def test_names_are_safe_and_stable(stem: str) -> None:
    name = sanitise_name(stem)
    assert re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,119}", name)
    assert sanitise_name(name) == name


@given(
    st.lists(
        st.sampled_from(["x/a.mp4", "y/a.mp4", "z/a-2.mp4", "z/A.mov", "a b.mp4", "a-b.mp4", "q/a.mkv", "a-2-2.mp4"]),
        unique=True,
    )
)
def test_names_of_a_run_are_unique_and_keep_plain_names(paths: list[str]) -> None:
    names = unique_names(paths)
    assert list(names) == paths
    assert len({name.lower() for name in names.values()}) == len(paths)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", name) for name in names.values())
    assert names == unique_names(paths)


def test_suffixes_follow_the_given_order_and_spare_other_names() -> None:
    assert unique_names(["x/a.mp4", "y/a.mp4", "a-2.mp4", "z/a.mov"]) == {
        "x/a.mp4": "a",
        "y/a.mp4": "a-3",
        "a-2.mp4": "a-2",
        "z/a.mov": "a-4",
    }
