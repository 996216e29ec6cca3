"""Every bad input of the table gets its code, in one clear line, and the page in docs/ says so."""

from __future__ import annotations

import re

import pytest

from benchmarks.bad_inputs import PAGE, Answer, try_all


@pytest.fixture(scope="module")
def answers() -> list[Answer]:
    return try_all()


def test_codes(answers: list[Answer]) -> None:
    assert [answer for answer in answers if answer.code != answer.expected] == []
    assert len(answers) >= 100


def test_messages(answers: list[Answer]) -> None:
    for answer in answers:
        assert answer.message.isprintable(), answer
        assert 20 < len(answer.message) < 400, answer
        assert not re.search(r"Traceback| at 0x|<class|hush", answer.message), answer


def test_the_page_is_current(answers: list[Answer]) -> None:
    rows = [line.split(" | ")[:3] for line in PAGE.read_text().splitlines() if line.startswith("| ")][1:]
    assert rows == [[f"| {a.kind}", a.what, f"`{a.code}`"] for a in answers]
