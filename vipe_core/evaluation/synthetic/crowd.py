"""Scenes full of people: one of three places, a camera path and a crowd, all drawn from a seed.

A person is a torso, a head and two legs that swing, so nobody is one rigid body. People walk across, pace up and down,
come towards the camera or keep its company; they are added until the share of moving pixels reaches what the seed asks
for, between 20 and 40 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.evaluation.synthetic.paths import arc, handheld, look_at, through
from vipe_core.evaluation.synthetic.render import render_frames
from vipe_core.evaluation.synthetic.scene import (
    Light,
    Material,
    Motion,
    Pattern,
    Primitive,
    Scene,
    Vec3,
    box,
    room,
    sphere,
)
from vipe_core.evaluation.synthetic.scenes import courtyard_scene, room_scene

CROWD_FPS = 24.0
MIN_MOVING, MAX_MOVING = 0.2, 0.4

_PREVIEW = (48, 36)
_PREVIEW_STEP = 8
_MAX_PEOPLE = 60
# Nobody comes nearer to the lens than this, metres.
_MIN_DISTANCE_M = 1.0
_CLOTHES: tuple[Pattern, ...] = (
    "tiles",
    "bricks",
    "wallpaper",
    "poster",
    "books",
    "rug",
    "marble",
    "planks",
    "plaster",
)


@dataclass(frozen=True, slots=True)
class Crowd:
    """A scene with its camera and path; see `Sample` for the fields."""

    scene: Scene
    camera: Camera
    world_from_cam: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Place:
    """A static scene, the box that people stay in (low, high), and where cameras stand and look."""

    scene: Scene
    low: Vec3
    high: Vec3
    eye: Vec3
    target: Vec3


def crowd(seed: int, num_frames: int = 96) -> Crowd:
    """The scene of a seed: the place goes by the seed modulo three, the camera path modulo four."""
    rng = np.random.default_rng((20, seed))
    place = (_hall, _parlour, _street)[seed % 3](rng)
    fov_deg = float(rng.uniform(48, 70))
    poses = handheld(_path(seed % 4, place, num_frames, rng), shift_m=0.008, angle_deg=0.4, seed=seed)
    camera = Camera.pinhole_from_fov(fov_deg, 480, 360)
    wanted = float(rng.uniform(MIN_MOVING + 0.04, MAX_MOVING - 0.1))
    scene = place.scene
    for _ in range(_MAX_PEOPLE):
        person = _person(place, poses, rng)
        if person is None:
            continue
        grown = scene.with_primitives(*person)
        share = moving_share(grown, camera, poses)
        if share <= MAX_MOVING - 0.02:
            scene = grown
            if share >= wanted:
                break
    return Crowd(scene, camera, poses)


def moving_share(scene: Scene, camera: Camera, world_from_cam: NDArray[np.float64]) -> float:
    """Share of the pixels of the whole clip that move, from a small and sparse rendering."""
    small = camera.resized(*_PREVIEW)
    frames = render_frames(scene, small, world_from_cam[::_PREVIEW_STEP], fps=CROWD_FPS / _PREVIEW_STEP)
    return float(np.mean([frame.dynamic.mean() for frame in frames]))


def _path(kind: int, place: _Place, num: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """world_from_cam (num, 4, 4): sideways, an arc round the target, forward, or a winding walk."""
    eye, target = np.array(place.eye), np.array(place.target)
    ahead = target - eye
    distance = float(np.linalg.norm(ahead))
    ahead = ahead / distance
    right = np.cross(ahead, np.array([0.0, 0.0, 1.0]))
    reach = float(rng.uniform(1.4, 2.2)) * (1 if rng.random() < 0.5 else -1)
    if kind == 0:
        stop = eye + reach * right
        line = through(
            [_vec(eye - 0.5 * reach * right), _vec(0.5 * (eye + stop)), _vec(stop - 0.5 * reach * right)], num
        )
        return look_at(line, target + 0.5 * reach * right * np.linspace(-1, 1, num)[:, None])
    if kind == 1:
        start = math.degrees(math.atan2(-ahead[1], -ahead[0]))
        half = math.degrees(0.5 * abs(reach) / distance)
        sign = math.copysign(1, reach)
        return look_at(
            arc((*_vec(target)[:2], float(eye[2])), distance, start - sign * half, start + sign * half, num), target
        )
    if kind == 2:
        line = through(
            [_vec(eye), _vec(eye + 0.5 * abs(reach) * ahead + 0.08 * right), _vec(eye + abs(reach) * ahead)], num
        )
        return look_at(line, target + 2 * ahead)
    bends = [
        eye,
        eye + 0.4 * reach * right + 0.3 * ahead,
        eye + 0.6 * reach * right + 0.8 * ahead,
        eye + reach * right + ahead,
    ]
    gaze = [target, target + 0.6 * right * reach, target + 0.2 * right * reach]
    return look_at(through([_vec(p) for p in bends], num), through([_vec(p) for p in gaze], num))


def _person(place: _Place, poses: NDArray[np.float64], rng: np.random.Generator) -> tuple[Primitive, ...] | None:
    """Somebody who is in front of the camera at some moment; None where that is in a wall or in the lens."""
    count = len(poses)
    time_s = np.arange(count) / CROWD_FPS
    met = int(rng.integers(0, count))
    depth = float(rng.uniform(1.5, 3.2))
    side = float(rng.uniform(-0.35, 0.35)) * depth
    cam = poses[met]
    ahead, right = cam[:3, 2] * (1, 1, 0), cam[:3, 0] * (1, 1, 0)
    spot = cam[:3, 3] + depth * ahead + side * right
    speed = float(rng.uniform(0.35, 1.4))
    manner = int(rng.integers(0, 4))
    across = right * (1 if rng.random() < 0.5 else -1)
    heading = (across, across, -ahead, across)[manner] + rng.normal(0, 0.25, 3) * (1, 1, 0)
    heading = heading / np.linalg.norm(heading)
    velocity, swing, period_s = speed * heading, np.zeros(3), 1.0
    if manner == 1:  # paces up and down
        period_s = float(rng.uniform(2.0, 4.5))
        velocity, swing = np.zeros(3), 0.5 * min(speed, 1.0) * heading
    elif manner == 3:  # keeps the camera company
        mean = (poses[-1, :3, 3] - poses[0, :3, 3]) * (1, 1, 0) / time_s[-1]
        velocity = mean + 0.35 * speed * heading
    phase = float(rng.random())
    base = Motion(_vec(velocity), _vec(swing), period_s, phase)
    start = spot - base.offset(float(time_s[met]))
    walked = np.array([start + base.offset(float(t)) for t in time_s])
    inside = ((walked[:, :2] > np.array(place.low[:2])) & (walked[:, :2] < np.array(place.high[:2]))).all()
    if not inside or np.linalg.norm((walked - poses[:, :3, 3])[:, :2], axis=1).min() < _MIN_DISTANCE_M:
        return None
    floor = place.low[2]
    height = float(rng.uniform(1.45, 1.95))
    yaw = math.degrees(math.atan2(heading[1], heading[0]))
    step_s = float(rng.uniform(0.8, 1.3))

    def limb(side_m: float, beat: float) -> Primitive:
        # A leg swings along the heading on top of the walk; one that paces keeps its swing and only shifts.
        motion = Motion(base.velocity, _vec(0.14 * heading), step_s, beat) if manner != 1 else base
        offset = side_m * np.array([-heading[1], heading[0], 0.0])
        at = start + offset
        return box(
            (at[0], at[1], floor + 0.24 * height), (0.17, 0.15, 0.48 * height), trousers, yaw_deg=yaw, motion=motion
        )

    coat, trousers, skin = _cloth(rng), _cloth(rng), _cloth(rng)
    girth = float(rng.uniform(0.42, 0.7))
    return (
        box((start[0], start[1], floor + 0.66 * height), (0.32, girth, 0.40 * height), coat, yaw_deg=yaw, motion=base),
        sphere((start[0], start[1], floor + 0.86 * height + 0.09), 0.15, skin, motion=base),
        limb(0.12, 0.0),
        limb(-0.12, 0.5),
    )


def _cloth(rng: np.random.Generator) -> Material:
    """Anything from a plain coat to a loud pattern."""
    colours = tuple(_vec(rng.uniform(0.08, 0.95, 3)) for _ in range(3))
    pattern = _CLOTHES[int(rng.integers(0, len(_CLOTHES)))]
    period, grain = float(rng.uniform(0.06, 0.22)), float(rng.uniform(0.1, 0.35))
    return Material(pattern, (colours[0], colours[1], colours[2]), period, grain, 0.1, int(rng.integers(0, 10_000)))


def _parlour(rng: np.random.Generator) -> _Place:
    start = ((4.9, 0.9, 1.45), (1.2, 1.0, 1.45))[int(rng.integers(0, 2))]
    return _Place(room_scene(), (0.3, 0.5, 0.0), (5.7, 4.4, 2.7), start, (3.0, 3.4, 1.1))


def _street(rng: np.random.Generator) -> _Place:
    eye = (float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-3.0, 1.0)), 1.65)
    return _Place(courtyard_scene(), (-4.0, -6.0, 0.0), (4.0, 16.0, 9.0), eye, (eye[0] * 0.3, eye[1] + 9.0, 1.6))


def _hall(rng: np.random.Generator) -> _Place:
    """A large bare room: plain walls with a few pictures and shelves, so that most of the texture walks about."""

    def tone(low: float, high: float) -> Vec3:
        return _vec(np.clip(rng.uniform(low, high) + rng.normal(0, 0.04, 3), 0.02, 0.98))

    def plaster() -> Material:
        colour = tone(0.5, 0.8)
        return Material("plaster", (colour, colour, colour), 1.0, 0.12, 0.7, int(rng.integers(0, 10_000)))

    tiles = Material("tiles", (tone(0.45, 0.6), tone(0.4, 0.55), tone(0.25, 0.35)), 0.5, 0.2, 0.3, 3)
    above = Material("tiles", (tone(0.8, 0.9), tone(0.78, 0.86), tone(0.5, 0.6)), 0.9, 0.08, 0.3, 4)
    solids = [room((0.0, 0.0, 0.0), (8.0, 7.0, 3.0), plaster(), plaster(), plaster(), plaster(), tiles, above)]
    for x in np.arange(0.9, 7.5, 1.15):
        canvas = _cloth(rng)
        width, height = float(rng.uniform(0.4, 0.8)), float(rng.uniform(0.35, 0.8))
        solids.append(box((float(x), 6.98, float(rng.uniform(1.4, 2.1))), (width, 0.04, height), canvas))
    for y in (4.2, 5.6):
        for x in (0.02, 7.98):
            solids.append(box((x, y, float(rng.uniform(1.3, 2.0))), (0.04, 0.7, 0.6), _cloth(rng)))
    books = Material("books", (tone(0.2, 0.5), tone(0.3, 0.7), tone(0.5, 0.8)), 0.07, 0.2, 0.05, 5)
    for x in (float(rng.uniform(0.8, 3.0)), float(rng.uniform(5.0, 7.2))):
        solids.append(box((x, 6.75, 0.95), (0.9, 0.4, 1.9), books))
    solids.append(box((float(rng.uniform(0.6, 1.2)), 5.0, 0.5), (0.8, 0.8, 1.0), _cloth(rng), yaw_deg=20.0))
    scene = Scene(tuple(solids), Light((4.0, 3.0, 2.8), ambient=0.7, diffuse=0.45))
    return _Place(scene, (0.5, 0.5, 0.0), (7.5, 6.3, 3.0), (4.0, 1.1, 1.5), (4.0, 6.0, 1.3))


def _vec(values: NDArray[np.float64]) -> Vec3:
    return float(values[0]), float(values[1]), float(values[2])
