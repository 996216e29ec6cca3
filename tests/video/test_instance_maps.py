"""Id maps on disk, and the view that leaves things out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vipe_core.video.instances import InstanceMaps


@settings(max_examples=20, deadline=None)
@given(st.lists(arrays(np.uint8, (6, 9)), min_size=1, max_size=5), st.data())
def test_maps_come_back_in_any_order(written: list[np.ndarray], data: st.DataObject) -> None:
    maps = InstanceMaps()
    for ids in written:
        maps.append(ids, {})
    for index in data.draw(st.permutations(range(len(written)))):
        np.testing.assert_array_equal(maps.ids(index, 9, 6), written[index])
    assert len(maps) == len(written)


def test_what_stands_still_is_in_the_map_but_may_be_used() -> None:
    maps = InstanceMaps(static=("sky",))
    ids = np.zeros((8, 12), np.uint8)
    ids[:2], ids[4, 5] = 7, 3
    maps.append(ids, {0: "background", 1: "moving", 3: "person", 7: "sky"})
    assert maps.moving(0, 12, 8).sum() == 1
    # A smaller picture may not use any pixel that shows a part of it, a larger one just those that do.
    np.testing.assert_array_equal(np.argwhere(maps.moving(0, 6, 4)), [[2, 2]])
    assert maps.moving(0, 24, 16).sum() == 4
    assert maps.ids(0, 24, 16)[8, 10] == 3


def test_frames_beyond_the_maps_hold_nothing() -> None:
    maps = InstanceMaps()
    maps.append(np.full((4, 4), 9, np.uint8), {9: "car"})
    assert not maps.ids(1, 4, 4).any()
    assert not maps.moving(1, 2, 2).any()
    with pytest.raises(ValueError, match=r"\(4, 4\)"):
        maps.append(np.zeros((4, 5), np.uint8), {})
