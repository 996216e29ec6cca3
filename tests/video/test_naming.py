"""Sequence names: safe, whatever the paths are called."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.video import sanitise_name


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
