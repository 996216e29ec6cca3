"""Which things are followed, with a detector and a propagator that know the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from vipe_core.errors import ConfigError
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.priors.instances import Detection, FollowedInstances, composed
from vipe_core.priors.protocols import Instances
from vipe_core.video.source import Frame

WIDTH, HEIGHT = 96, 64
Box = tuple[int, int, int, int]
SETTINGS = InstanceSettings(phrases=("person", "car", "sky"), interval_s=0.4, margin_px=0)


class World:
    """Boxes of things by name in each frame; which picture is shown is written into its first pixel."""

    def __init__(self, things: Sequence[Mapping[str, Box]], phrases: Mapping[str, str]) -> None:
        self.things, self.phrases = things, phrases
        self.looks: list[int] = []
        self.followed: list[int] = []

    def frames(self, fps: float = 10.0) -> Iterator[Frame]:
        for index in range(len(self.things)):
            rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            rgb[0, 0, :2] = divmod(index, 256)
            yield Frame(index, index / fps, rgb)

    def detect(self, rgb: Any, phrases: Sequence[str], min_score: float) -> list[Detection]:
        index = shown(rgb)
        self.looks.append(index)
        return [
            Detection(tuple(map(float, box)), 0.9 - 0.1 * number, self.phrases[name])
            for number, (name, box) in enumerate(self.things[index].items())
            if self.phrases[name] in phrases
        ]

    def begin(self) -> KnownMotion:
        return KnownMotion(self)


class KnownMotion:
    """Follows the thing whose box was given."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._index = -1
        self._names: dict[int, str] = {}
        self._outlined: list[str] = []

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(self._names)

    def advance(self, rgb: Any) -> Tensor:
        self._index = shown(rgb)
        self._world.followed.append(len(self._names))
        return self._drawn([self._world.things[self._index].get(name) for name in self._names.values()])

    def outline(self, boxes_px: Any) -> Tensor:
        now = self._world.things[self._index]
        self._outlined = [next(n for n, box in now.items() if tuple(b) == box) for b in np.asarray(boxes_px)]
        return self._drawn([now[name] for name in self._outlined])

    def add(self, rows: Mapping[int, int]) -> None:
        self._names |= {number: self._outlined[row] for number, row in rows.items()}

    def forget(self, ids: Iterable[int]) -> None:
        for number in ids:
            del self._names[number]

    def _drawn(self, boxes: Sequence[Box | None]) -> Tensor:
        logits = torch.full((len(boxes), HEIGHT, WIDTH), -5.0)
        for one, box in zip(logits, boxes, strict=True):
            if box is not None:
                one[box[1] : box[3], box[0] : box[2]] = 5.0
        return logits


def shown(rgb: Any) -> int:
    """Number of a frame."""
    return 256 * int(rgb[0, 0, 0]) + int(rgb[0, 0, 1])


def run(world: World, settings: InstanceSettings = SETTINGS) -> list[Instances]:
    return list(FollowedInstances(world, world, settings, (1333, 800)).follow(world.frames()))


def moving(start: int, box: Box = (0, 10, 12, 30)) -> Box:
    return (box[0] + start, box[1], box[2] + start, box[3])


def test_a_thing_keeps_its_id_and_one_that_comes_later_gets_another() -> None:
    things = [{"ann": moving(2 * t), **({"bob": (70, 40, 90, 60)} if t >= 5 else {})} for t in range(12)]
    world = World(things, {"ann": "person", "bob": "car"})
    found = run(world)
    assert world.looks == [0, 4, 8]
    for t, instances in enumerate(found):
        x = 2 * t + 5
        assert instances.ids[20, x] == 2
        # It came into view between two looks.
        assert instances.ids[50, 80] == (3 if t >= 8 else 0)
    assert found[0].phrases == {2: "person"}
    assert found[-1].phrases == {2: "person", 3: "car"}


def test_nothing_found_is_an_empty_map_of_every_frame() -> None:
    found = run(World([{} for _ in range(6)], {}))
    assert len(found) == 6
    assert all(one.ids.shape == (HEIGHT, WIDTH) and not one.ids.any() and not one.phrases for one in found)


def test_the_same_thing_by_two_names_is_one() -> None:
    box = (10, 10, 40, 40)
    # Another detection of what is there, a little larger.
    world = World([{"car": box, "again": (9, 9, 41, 41)}] * 3, {"car": "car", "again": "person"})
    found = run(world)
    assert found[-1].phrases == {2: "car"}
    assert set(np.unique(found[-1].ids)) == {0, 2}


def test_specks_and_misunderstandings_are_left_out_but_the_sky_may_be_large() -> None:
    speck = World([{"speck": (5, 5, 6, 6)}] * 2, {"speck": "car"})
    assert not run(speck)[-1].ids.any()
    everything = World([{"all": (0, 0, 96, 50)}] * 2, {"all": "car"})
    assert not run(everything)[-1].ids.any()
    sky = World([{"sky": (0, 0, 96, 50), "ann": (10, 52, 20, 62)}] * 2, {"sky": "sky", "ann": "person"})
    assert run(sky)[-1].phrases == {2: "sky", 3: "person"}


def test_an_occlusion_is_outlived_and_what_stays_away_is_forgotten() -> None:
    box = (20, 20, 40, 40)
    seen = [t < 4 or 10 <= t < 14 for t in range(40)]
    world = World([{"ann": box} if there else {} for there in seen], {"ann": "person"})
    found = run(world)
    assert all(found[t].ids[30, 30] == 2 for t in (0, 3, 10, 13))
    # Three looks without it, at 16, 20 and 24.
    assert world.followed[24] == 1
    assert world.followed[25] == 0


def test_ids_run_out_and_those_of_forgotten_things_come_again() -> None:
    """Passers-by, each only once; one look per frame."""
    things = [{str(t): (20, 20, 40, 40)} if t % 2 == 0 else {} for t in range(520)]
    world = World(things, {str(t): "person" for t in range(520)})
    found = run(world, dataclasses.replace(SETTINGS, interval_s=0.05, patience=1))
    given = [int(one.ids[30, 30]) for one in found[::2]]
    assert given == [*range(2, 256), *range(2, 8)]
    assert max(world.followed) == 1


def test_masks_are_a_little_wider_than_things_and_grow_into_the_sky() -> None:
    world = World([{"ann": (30, 20, 50, 40), "sky": (0, 0, 96, 10)}], {"ann": "person", "sky": "sky"})
    found = run(world, dataclasses.replace(SETTINGS, margin_px=2))[0].ids
    assert (found == 2).sum() == 24 * 24
    assert (found == 3).sum() == 96 * 10
    near = World([{"ann": (30, 10, 50, 40), "sky": (0, 0, 96, 10)}], {"ann": "person", "sky": "sky"})
    assert run(near, dataclasses.replace(SETTINGS, margin_px=2))[0].ids[9, 40] == 2


def test_pixels_go_to_the_surest() -> None:
    logits = torch.tensor([[[1.0, 3.0]], [[2.0, -1.0]]])
    np.testing.assert_array_equal(composed(logits, (4, 9), (1, 2)), [[9, 4]])
    assert not composed(torch.zeros((0, 1, 1)), (), (3, 5)).any()


def test_a_gap_in_the_video_asks_for_one_look() -> None:
    world = World([{}] * 4, {})
    times = (0.0, 0.1, 100.0, 100.1)
    frames = (dataclasses.replace(f, timestamp_s=t) for f, t in zip(world.frames(), times, strict=True))
    list(FollowedInstances(world, world, SETTINGS, (1333, 800)).follow(frames))
    assert world.looks == [0, 2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"phrases": ()}, "at least one phrase"),
        ({"phrases": ("person. car",)}, "no phrase to look for"),
        ({"phrases": (" ",)}, "no phrase to look for"),
        ({"phrases": ("a\nb",)}, "no phrase to look for"),
        ({"phrases": ("x" * 65,)}, "no phrase to look for"),
        ({"phrases": ("car", "car")}, "not different"),
        ({"interval_s": 0.0}, "must be positive"),
        ({"interval_s": float("nan")}, "must be positive"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        InstanceSettings(**settings)


def test_pictures_are_given_at_the_size_of_the_detector() -> None:
    world = World([], {})
    masks = FollowedInstances(world, world, SETTINGS, (1333, 800))
    assert masks.input_size(1920, 1080) == (1333, 750)
    assert masks.input_size(1080, 1920) == (750, 1333)
    assert masks.input_size(640, 480) == (640, 480)
    assert masks.input_size(1600, 1200) == (1067, 800)
