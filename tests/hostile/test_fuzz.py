"""A bounded share of what `python -m benchmarks.fuzz` does: whatever the bytes, a result or a typed error."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.fuzz import fuzz
from benchmarks.hostile.mutation import mutated
from benchmarks.hostile.targets import TARGETS

# Chosen by what a case costs: about a second of one core each.
CASES = {
    "media": 80,
    "image": 50,
    "csv": 300,
    "jsonl": 300,
    "parquet": 2,
    "tar": 300,
    "exr": 130,
    "zip": 130,
    "npz": 130,
}


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_bytes(target: str) -> None:
    outcome = fuzz(target, seed=2, cases=CASES[target])
    assert outcome.findings == []
    assert outcome.cases == CASES[target]
    assert outcome.refused > 0


@pytest.mark.parametrize("target", sorted(set(TARGETS) - {"parquet"}))
def test_the_examples_are_understood(target: str) -> None:
    """Fuzzing of what is refused at the first byte would find nothing."""
    reader = TARGETS[target]
    reader.read(reader.seeds()[0])


@given(st.lists(st.binary(max_size=50), min_size=1, max_size=3), st.integers())
def test_damage_is_the_same_for_the_same_seed(seeds: list[bytes], number: int) -> None:
    if any(seeds):
        assert mutated(seeds, random.Random(number)) == mutated(seeds, random.Random(number))
