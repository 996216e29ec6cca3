"""A short schemathesis run; `openapi_fuzz.py` is the long one."""

from __future__ import annotations

from pathlib import Path

import pytest
from api_service import running
from openapi_fuzz import KEY, SETTINGS, fuzz


@pytest.mark.slow
@pytest.mark.parametrize("key", [KEY, pytest.param(None, marks=pytest.mark.long)])
def test_every_answer_is_one_that_the_document_names(tmp_path: Path, key: str | None) -> None:
    with running(f"sqlite:///{tmp_path}/fuzz.db", *SETTINGS) as service:
        done = fuzz(service.url, key, examples=2 if key else 1)
    assert done.returncode == 0, done.stdout + done.stderr
