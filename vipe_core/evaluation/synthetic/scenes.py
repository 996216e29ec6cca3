"""The scenes: a furnished room and a courtyard. Metres, z up."""

from __future__ import annotations

from vipe_core.evaluation.synthetic.scene import Light, Material, Motion, Primitive, Scene, Vec3, box, room, sphere

_WHITE: Vec3 = (0.93, 0.91, 0.87)
_DARK: Vec3 = (0.16, 0.13, 0.12)


def _plain(colour: Vec3, grain: float = 0.3, size: float = 0.3, seed: int = 0) -> Material:
    return Material("plaster", (colour, colour, colour), 1.0, grain, size, seed)


def _oak(period: float = 0.14, seed: int = 0) -> Material:
    return Material("planks", ((0.72, 0.52, 0.33), (0.50, 0.33, 0.19), (0.20, 0.12, 0.07)), period, 0.22, 0.25, seed)


def _poster(a: Vec3, b: Vec3, c: Vec3, period: float, seed: int) -> Material:
    return Material("poster", (a, b, c), period, 0.16, 0.1, seed)


def room_scene() -> Scene:
    """A living room, 6 x 5 x 2.7 m, corners (0, 0, 0) and (6, 5, 2.7): bookcase, table, sofa, rug, pictures, plants."""
    paper = Material("wallpaper", ((0.80, 0.84, 0.78), (0.71, 0.78, 0.72), (0.83, 0.66, 0.40)), 0.36, 0.16, 0.16, 1)
    bricks = Material("bricks", ((0.70, 0.36, 0.26), (0.52, 0.25, 0.19), (0.78, 0.73, 0.66)), 0.26, 0.32, 0.12, 2)
    teal = _plain((0.36, 0.56, 0.60), 0.18, 0.16, 3)
    cream = _plain((0.90, 0.84, 0.72), 0.16, 0.16, 4)
    ceiling = Material("tiles", (_WHITE, (0.89, 0.87, 0.83), (0.66, 0.64, 0.61)), 0.75, 0.09, 0.2, 5)
    floor = Material("planks", ((0.66, 0.47, 0.30), (0.46, 0.30, 0.18), (0.16, 0.10, 0.06)), 0.16, 0.22, 0.3, 6)
    solids: list[Primitive] = [room((0.0, 0.0, 0.0), (6.0, 5.0, 2.7), teal, bricks, cream, paper, floor, ceiling)]
    solids += _bookcase() + _table() + _sofa()

    rug = Material("rug", ((0.63, 0.17, 0.17), (0.86, 0.72, 0.50), (0.15, 0.22, 0.38)), 0.30, 0.25, 0.06, 7)
    solids.append(box((3.0, 2.45, 0.01), (2.9, 2.1, 0.02), rug))
    frame = _plain(_DARK, 0.15, 0.1)
    red, blue, sand = (0.80, 0.25, 0.20), (0.14, 0.30, 0.52), (0.93, 0.83, 0.62)
    pictures = (
        # (centre x, z, width, height) on the wall y = 5, then on x = 6 and x = 0 with y in place of x
        ((1.30, 4.98, 1.65), (0.90, 0.04, 1.10), _poster(sand, blue, red, 0.225, 11)),
        (
            (4.75, 4.98, 1.70),
            (1.20, 0.04, 0.80),
            _poster((0.92, 0.90, 0.84), (0.12, 0.44, 0.42), (0.95, 0.66, 0.2), 0.2, 12),
        ),
        (
            (5.98, 3.60, 1.65),
            (0.04, 0.80, 1.00),
            _poster((0.18, 0.20, 0.30), (0.90, 0.86, 0.74), (0.86, 0.45, 0.25), 0.2, 13),
        ),
        (
            (0.02, 1.20, 1.60),
            (0.04, 1.30, 0.90),
            _poster((0.94, 0.9, 0.8), (0.32, 0.22, 0.42), (0.85, 0.55, 0.3), 0.22, 14),
        ),
    )
    for centre, size, canvas in pictures:
        border: Vec3 = (size[0] + 0.1 * (size[0] > 0.1), size[1] + 0.1 * (size[1] > 0.1), size[2] + 0.1)
        solids.append(box(centre, border, frame))
        inward = tuple(c + 0.015 * ((c < 0.1) - (c > h - 0.1)) for c, h in zip(centre, (6.0, 5.0, 9.0), strict=True))
        solids.append(box((inward[0], inward[1], inward[2]), size, canvas))

    # The wall y = 0: a window with a view, curtains and a sideboard below.
    view = Material("facade", ((0.80, 0.70, 0.56), (0.34, 0.46, 0.60), (0.93, 0.92, 0.90)), 0.20, 0.2, 0.1, 15)
    cloth = Material("wallpaper", ((0.62, 0.28, 0.26), (0.48, 0.19, 0.20), (0.86, 0.66, 0.42)), 0.12, 0.3, 0.05, 16)
    solids += [
        box((3.1, 0.01, 1.55), (1.8, 0.06, 1.3), _plain((0.95, 0.94, 0.92), 0.1, 0.1)),
        box((3.1, 0.03, 1.55), (1.64, 0.06, 1.14), view),
        box((2.0, 0.08, 1.45), (0.42, 0.12, 1.9), cloth),
        box((4.2, 0.08, 1.45), (0.42, 0.12, 1.9), cloth),
        box((3.1, 0.27, 0.32), (1.9, 0.46, 0.64), _oak(0.21, 3)),
    ]
    leaves = Material("foliage", ((0.10, 0.20, 0.08), (0.26, 0.46, 0.16), (0.60, 0.70, 0.30)), 0.22, 0.35, 0.1, 17)
    pot = Material("tiles", ((0.76, 0.45, 0.30), (0.70, 0.40, 0.27), (0.50, 0.28, 0.18)), 0.11, 0.2, 0.1, 18)
    globe = Material("marble", ((0.15, 0.34, 0.55), (0.30, 0.55, 0.62), (0.88, 0.80, 0.55)), 0.20, 0.2, 0.1, 19)
    solids += [
        box((5.45, 4.45, 0.22), (0.46, 0.46, 0.44), pot, yaw_deg=25.0),
        sphere((5.45, 4.45, 0.86), 0.46, leaves),
        sphere((5.25, 4.30, 1.28), 0.30, leaves),
        box((0.60, 0.55, 0.30), (0.60, 0.60, 0.60), _oak(0.12, 4), yaw_deg=20.0),
        sphere((0.60, 0.55, 0.84), 0.24, globe),
    ]
    return Scene(tuple(solids), Light((2.6, 2.2, 2.5), ambient=0.66, diffuse=0.50))


def _bookcase() -> list[Primitive]:
    books = Material("books", ((0.62, 0.24, 0.18), (0.18, 0.34, 0.46), (0.86, 0.72, 0.44)), 0.062, 0.18, 0.05, 21)
    wood = _oak(0.12, 1)
    solids = [box((3.0, 4.80, 1.02), (1.36, 0.36, 2.04), wood)]
    solids += [box((3.0, 4.612, 0.26 + 0.48 * k), (1.26, 0.04, 0.434), books) for k in range(4)]
    vase = Material("marble", ((0.85, 0.84, 0.80), (0.62, 0.68, 0.72), (0.20, 0.30, 0.46)), 0.10, 0.15, 0.05, 22)
    solids += [
        sphere((2.66, 4.78, 2.17), 0.13, vase),
        box((3.25, 4.78, 2.15), (0.4, 0.24, 0.22), _oak(0.06, 8), yaw_deg=8.0),
    ]
    return solids


def _table() -> list[Primitive]:
    """A low table in the middle of the rug with things on it: what an orbit turns around."""
    wood = _oak(0.10, 2)
    solids = [box((3.0, 2.45, 0.44), (1.25, 0.80, 0.06), wood, yaw_deg=12.0)]
    for sx, sy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        solids.append(
            box((3.0 + 0.5 * sx - 0.07 * sy, 2.45 + 0.3 * sy + 0.11 * sx, 0.21), (0.07, 0.07, 0.41), wood, yaw_deg=12.0)
        )
    cube = _poster((0.92, 0.86, 0.70), (0.16, 0.36, 0.50), (0.82, 0.32, 0.22), 0.10, 31)
    fruit = Material("marble", ((0.86, 0.42, 0.12), (0.94, 0.62, 0.20), (0.70, 0.22, 0.10)), 0.08, 0.25, 0.04, 32)
    stone = Material("marble", ((0.30, 0.48, 0.44), (0.48, 0.66, 0.56), (0.92, 0.90, 0.82)), 0.14, 0.2, 0.06, 33)
    cover = _poster((0.80, 0.76, 0.66), (0.35, 0.20, 0.28), (0.90, 0.70, 0.35), 0.14, 34)
    solids += [
        box((2.68, 2.50, 0.57), (0.20, 0.20, 0.20), cube, yaw_deg=33.0),
        box(
            (2.70, 2.49, 0.73),
            (0.12, 0.12, 0.12),
            _poster((0.20, 0.42, 0.36), _WHITE, (0.9, 0.6, 0.2), 0.06, 35),
            yaw_deg=8.0,
        ),
        sphere((3.04, 2.58, 0.60), 0.13, stone),
        sphere((3.26, 2.36, 0.535), 0.065, fruit),
        sphere((3.37, 2.45, 0.53), 0.060, fruit),
        box((3.06, 2.27, 0.49), (0.34, 0.24, 0.04), cover, yaw_deg=-18.0),
        box((3.05, 2.27, 0.525), (0.28, 0.20, 0.03), _poster(_WHITE, (0.2, 0.5, 0.6), _DARK, 0.09, 36), yaw_deg=-4.0),
    ]
    return solids


def _sofa() -> list[Primitive]:
    fabric = Material("tiles", ((0.23, 0.33, 0.47), (0.28, 0.40, 0.55), (0.74, 0.70, 0.62)), 0.11, 0.3, 0.05, 41)
    pillow = Material("rug", ((0.88, 0.62, 0.22), (0.92, 0.84, 0.66), (0.50, 0.24, 0.18)), 0.11, 0.2, 0.05, 42)
    return [
        box((0.52, 3.15, 0.22), (0.86, 1.90, 0.40), fabric),
        box((0.20, 3.15, 0.60), (0.26, 1.90, 0.44), fabric),
        box((0.52, 2.12, 0.36), (0.86, 0.18, 0.62), fabric),
        box((0.52, 4.18, 0.36), (0.86, 0.18, 0.62), fabric),
        box((0.52, 2.55, 0.58), (0.16, 0.42, 0.36), pillow, yaw_deg=14.0),
        box((0.52, 3.75, 0.58), (0.16, 0.42, 0.36), pillow, yaw_deg=-16.0),
    ]


def moving_ball_scene() -> Scene:
    """The room with a spinning ball that sweeps through the air between camera and table, and a parcel that slides."""
    ball = Material("ball", ((0.90, 0.28, 0.18), (0.95, 0.90, 0.80), (0.14, 0.34, 0.58)), 0.2, 0.25, 0.12, 51)
    parcel = Material("tiles", ((0.78, 0.62, 0.42), (0.70, 0.54, 0.35), (0.32, 0.20, 0.12)), 0.16, 0.3, 0.08, 52)
    return room_scene().with_primitives(
        sphere(
            (3.30, 1.75, 1.02),
            0.31,
            ball,
            18.0,
            Motion(swing=(1.05, 0.25, 0.0), period_s=4.2, phase=0.55, spin_rad_s=-2.4),
        ),
        box((4.75, 3.30, 0.22), (0.5, 0.42, 0.42), parcel, motion=Motion(swing=(0.0, 0.8, 0.0), period_s=3.4)),
    )


def courtyard_scene() -> Scene:
    """A street that opens into a courtyard, along +y: paving, house fronts, trees, crates, lamp posts, sky."""
    paving = Material("tiles", ((0.68, 0.64, 0.58), (0.60, 0.57, 0.53), (0.34, 0.31, 0.29)), 0.55, 0.30, 0.3, 61)
    walk = Material("bricks", ((0.60, 0.40, 0.33), (0.50, 0.33, 0.28), (0.62, 0.58, 0.54)), 0.40, 0.30, 0.3, 62)
    solids: list[Primitive] = [
        box((0.0, 20.0, -0.5), (60.0, 80.0, 1.0), paving),
        box((-3.6, 14.0, 0.06), (2.0, 44.0, 0.12), walk),
        box((3.6, 14.0, 0.06), (2.0, 44.0, 0.12), walk),
    ]
    walls: tuple[tuple[Vec3, Vec3], ...] = (
        ((0.86, 0.70, 0.46), (0.30, 0.40, 0.52)),
        ((0.72, 0.40, 0.32), (0.26, 0.34, 0.44)),
        ((0.80, 0.78, 0.72), (0.32, 0.42, 0.50)),
        ((0.56, 0.64, 0.62), (0.28, 0.36, 0.46)),
        ((0.88, 0.78, 0.62), (0.34, 0.42, 0.50)),
        ((0.66, 0.50, 0.44), (0.26, 0.34, 0.42)),
    )
    roof = Material("bricks", ((0.48, 0.24, 0.19), (0.38, 0.19, 0.16), (0.24, 0.13, 0.11)), 0.5, 0.3, 0.5, 63)
    plinth = Material("bricks", ((0.52, 0.50, 0.47), (0.44, 0.42, 0.40), (0.30, 0.29, 0.28)), 0.7, 0.35, 0.4, 64)
    fronts = (
        (-1, 1.0, 7.6, 6.4),
        (-1, 9.0, 7.0, 8.2),
        (-1, 17.0, 8.0, 5.6),
        (1, 0.0, 8.0, 7.2),
        (1, 8.2, 7.4, 5.8),
        (1, 17.4, 8.6, 7.6),
    )
    for k, (side, y, length, height) in enumerate(fronts):
        wall, glass = walls[k]
        front = Material("facade", (wall, glass, (0.93, 0.91, 0.87)), (1.5, 1.7, 1.35)[k % 3], 0.22, 0.3, 70 + k)
        x = side * (6.6 + 0.25 * (k % 2))
        solids.append(box((x, y, height / 2), (4.0, length, height), front))
        solids.append(box((x, y, height + 0.15), (4.4, length + 0.3, 0.3), roof))
        solids.append(box((x, y, 0.4), (4.16, length, 0.8), plinth))
    end = Material("facade", ((0.84, 0.66, 0.56), (0.30, 0.40, 0.52), (0.95, 0.93, 0.88)), 2.0, 0.22, 0.3, 80)
    solids += [
        box((0.0, 30.0, 4.2), (16.0, 4.0, 8.4), end),
        box((0.0, 30.0, 8.6), (16.6, 4.6, 0.4), roof),
        box(
            (0.0, 27.95, 1.5),
            (2.4, 0.3, 3.0),
            Material("planks", ((0.50, 0.32, 0.20), (0.36, 0.22, 0.14), _DARK), 0.3, 0.25, 0.2, 81),
        ),
    ]
    leaves = Material("foliage", ((0.09, 0.18, 0.07), (0.26, 0.44, 0.14), (0.62, 0.70, 0.28)), 0.55, 0.4, 0.2, 82)
    bark = Material("planks", ((0.38, 0.28, 0.20), (0.28, 0.20, 0.15), (0.14, 0.10, 0.08)), 0.07, 0.4, 0.1, 83)
    for x, y, size in ((-3.5, 6.0, 0.95), (3.6, 10.5, 1.1), (-3.5, 15.0, 1.1), (3.5, 20.5, 1.0)):
        solids.append(box((x, y, 0.95), (0.24, 0.24, 1.9), bark))
        solids += [
            sphere((x, y, 1.9 + size), size, leaves),
            sphere((x + 0.35, y - 0.3, 1.8 + 0.6 * size), 0.62 * size, leaves),
        ]
    crate = Material("planks", ((0.68, 0.52, 0.34), (0.52, 0.38, 0.24), (0.22, 0.14, 0.09)), 0.15, 0.3, 0.15, 84)
    metal = _plain((0.20, 0.24, 0.26), 0.3, 0.1, 85)
    kiosk = Material("wallpaper", ((0.86, 0.30, 0.24), (0.94, 0.90, 0.82), (0.96, 0.78, 0.30)), 0.40, 0.2, 0.2, 86)
    solids += [
        box((3.3, 5.0, 0.47), (0.7, 0.7, 0.7), crate, yaw_deg=15.0),
        box((3.5, 5.9, 0.52), (0.8, 0.8, 0.8), crate, yaw_deg=-20.0),
        box((3.42, 5.5, 1.15), (0.5, 0.5, 0.5), crate, yaw_deg=40.0),
        box((-3.5, 10.4, 1.2), (1.5, 1.6, 2.2), kiosk),
        box((-3.4, 10.4, 2.38), (1.9, 2.0, 0.16), roof),
        box((1.2, 14.5, 0.35), (2.0, 2.0, 0.7), plinth, yaw_deg=45.0),
        sphere(
            (1.2, 14.5, 1.35),
            0.68,
            Material("marble", ((0.55, 0.53, 0.50), (0.70, 0.68, 0.64), (0.30, 0.29, 0.28)), 0.5, 0.3, 0.2, 87),
        ),
    ]
    for x, y in ((-2.5, 8.0), (2.5, 12.6), (-2.5, 18.0)):
        solids += [
            box((x, y, 1.6), (0.09, 0.09, 3.2), metal),
            sphere((x, y, 3.3), 0.2, _plain((0.98, 0.94, 0.80), 0.1, 0.1)),
        ]
    return Scene(tuple(solids), Light((-0.5, -0.45, 0.8), is_sun=True, ambient=0.66, diffuse=0.56))
