"""What a synthetic scene is made of: boxes, spheres and rooms with materials, a light and a sky.

The world has z up and metres. Everything is a frozen value, so that a scene can be compared, hashed through its `repr`
and rendered again bit by bit. Time enters only through `Motion`: a closed formula of seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import ConfigError

Vec3 = tuple[float, float, float]
PrimitiveKind = Literal["box", "sphere", "room"]
Pattern = Literal[
    "plaster", "tiles", "bricks", "planks", "wallpaper", "poster", "books", "rug", "foliage", "marble", "ball", "facade"
]

# The order is the number that the texture kernel switches on.
PATTERNS: tuple[Pattern, ...] = (
    "plaster",
    "tiles",
    "bricks",
    "planks",
    "wallpaper",
    "poster",
    "books",
    "rug",
    "foliage",
    "marble",
    "ball",
    "facade",
)
_KINDS: tuple[PrimitiveKind, ...] = ("box", "sphere", "room")


@dataclass(frozen=True, slots=True)
class Material:
    """A procedural surface. Lengths are metres on the surface, so texture sticks to it exactly.

    Attributes:
        pattern: Which of the patterns of `texture.py`.
        colours: Three colours, 0..1: what each pattern does with them is said there.
        period: Size of the pattern's cell, metres.
        grain: Strength of the noise that every pattern is multiplied with; 0 is perfectly clean.
        grain_size: Cell of the coarsest noise octave, metres; each further octave halves it, down to the pixel.
        seed: Selects the random numbers of this material.
    """

    pattern: Pattern
    colours: tuple[Vec3, Vec3, Vec3]
    period: float = 0.5
    grain: float = 0.35
    grain_size: float = 0.4
    seed: int = 0

    def row(self) -> list[float]:
        """Thirteen numbers for the texture kernel."""
        flat = [channel for colour in self.colours for channel in colour]
        return [float(PATTERNS.index(self.pattern)), self.period, self.grain, self.grain_size, float(self.seed), *flat]


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a moving primitive is at t: centre + velocity t + swing sin(2 pi (t / period_s + phase)), turned by spin.

    Attributes:
        velocity: Metres per second.
        swing: Amplitude of the oscillation, metres.
        period_s: Period of the oscillation.
        phase: Phase of the oscillation in turns.
        spin_rad_s: Turning rate around the world's z axis.
    """

    velocity: Vec3 = (0.0, 0.0, 0.0)
    swing: Vec3 = (0.0, 0.0, 0.0)
    period_s: float = 1.0
    phase: float = 0.0
    spin_rad_s: float = 0.0

    def offset(self, time_s: float) -> NDArray[np.float64]:
        wave = math.sin(2 * math.pi * (time_s / self.period_s + self.phase))
        return np.array(self.velocity) * time_s + np.array(self.swing) * wave


@dataclass(frozen=True, slots=True)
class Primitive:
    """A solid. Boxes are seen from outside, rooms from inside.

    Attributes:
        centre: World position of the centre, metres.
        half: Half extents along the local axes; a sphere takes its radius from the first.
        materials: One material, or six for the faces -x, +x, -y, +y, -z, +z.
        yaw_deg, pitch_deg: Rotation of the local frame: about the local y axis first, then about the world's z axis.
        motion: Given for a moving primitive: its pixels are flagged `dynamic`, and it casts no shadow, so that the
            look of everything static never changes.
    """

    kind: PrimitiveKind
    centre: Vec3
    half: Vec3
    materials: tuple[Material, ...]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    motion: Motion | None = None

    def __post_init__(self) -> None:
        if len(self.materials) not in (1, 6):
            raise ConfigError(f"a primitive takes 1 or 6 materials, got {len(self.materials)}")
        if min(self.half) <= 0:
            raise ConfigError(f"half extents must be positive, got {self.half!r}")


@dataclass(frozen=True, slots=True)
class Light:
    """One lamp (`position` a point in metres) or the sun (`is_sun`: `position` is the direction towards it)."""

    position: Vec3
    is_sun: bool = False
    ambient: float = 0.5
    diffuse: float = 0.6


@dataclass(frozen=True, slots=True)
class Scene:
    """Primitives, a light, and the colours of the sky at the horizon, at the zenith and of its clouds."""

    primitives: tuple[Primitive, ...]
    light: Light
    sky: tuple[Vec3, Vec3, Vec3] = ((0.80, 0.86, 0.93), (0.36, 0.56, 0.86), (1.0, 1.0, 1.0))

    def with_primitives(self, *more: Primitive) -> Scene:
        return replace(self, primitives=(*self.primitives, *more))


def box(
    centre: Vec3, size: Vec3, *materials: Material, yaw_deg: float = 0.0, motion: Motion | None = None
) -> Primitive:
    """A box by its full `size`."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Primitive("box", centre, half, materials, yaw_deg, motion=motion)


def sphere(
    centre: Vec3, radius: float, material: Material, pitch_deg: float = 0.0, motion: Motion | None = None
) -> Primitive:
    return Primitive("sphere", centre, (radius, radius, radius), (material,), pitch_deg=pitch_deg, motion=motion)


def room(low: Vec3, high: Vec3, *materials: Material) -> Primitive:
    """The inside of an axis-aligned box between two corners."""
    centre = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
    half = tuple((b - a) / 2 for a, b in zip(low, high, strict=True))
    return Primitive("room", (centre[0], centre[1], centre[2]), (half[0], half[1], half[2]), materials)


@dataclass(frozen=True, slots=True)
class PackedScene:
    """A scene at one moment, as the arrays that the kernels read; P primitives, M distinct materials.

    Attributes:
        kind: (P,) int64, 0 box, 1 sphere, 2 room.
        centre: (P, 3) float64 world.
        local_from_world: (P, 3, 3) float64 rotations.
        half: (P, 3) float64.
        bound: (P,) float64 radius of the bounding sphere.
        dynamic: (P,) bool.
        face_material: (P, 6) int64 rows of `materials`.
        materials: (M, 14) float64.
    """

    kind: NDArray[np.int64]
    centre: NDArray[np.float64]
    local_from_world: NDArray[np.float64]
    half: NDArray[np.float64]
    bound: NDArray[np.float64]
    dynamic: NDArray[np.bool_]
    face_material: NDArray[np.int64]
    materials: NDArray[np.float64]


def pack(scene: Scene, time_s: float) -> PackedScene:
    """The arrays of `scene` at `time_s`."""
    primitives = scene.primitives
    table: dict[Material, int] = {}
    faces = np.zeros((len(primitives), 6), np.int64)
    centre = np.zeros((len(primitives), 3))
    rotation = np.zeros((len(primitives), 3, 3))
    half = np.array([p.half for p in primitives], dtype=np.float64).reshape(-1, 3)
    for i, primitive in enumerate(primitives):
        materials = primitive.materials if len(primitive.materials) == 6 else primitive.materials * 6
        faces[i] = [table.setdefault(m, len(table)) for m in materials]
        centre[i] = primitive.centre
        yaw = math.radians(primitive.yaw_deg)
        if primitive.motion is not None:
            centre[i] += primitive.motion.offset(time_s)
            yaw += primitive.motion.spin_rad_s * time_s
        rotation[i] = _world_from_local(yaw, math.radians(primitive.pitch_deg)).T
    kind = np.array([_KINDS.index(p.kind) for p in primitives], dtype=np.int64)
    bound = np.where(kind == 1, half[:, 0], np.linalg.norm(half, axis=1))
    dynamic = np.array([p.motion is not None for p in primitives], dtype=np.bool_)
    rows = np.array([m.row() for m in table], dtype=np.float64)
    return PackedScene(kind, centre, np.ascontiguousarray(rotation), half, bound, dynamic, faces, rows)


def _world_from_local(yaw: float, pitch: float) -> NDArray[np.float64]:
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    world_from_local: NDArray[np.float64] = about_z @ about_y
    return world_from_local
