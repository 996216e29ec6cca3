"""Damage to bytes, the same for the same seed."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence

_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF)


def mutated(seeds: Sequence[bytes], chance: random.Random) -> bytes:
    """One of the seeds with one to eight kinds of damage."""
    seeds = [seed for seed in seeds if seed]
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.choice((1, 1, 1, 2, 3, 5, 8))):
        if not data:
            data = bytearray(chance.choice(seeds))
        chance.choice(_DAMAGE)(data, seeds, chance)
    return bytes(data)


def _flip(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    for _i in range(chance.randint(1, 8)):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def _number(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    """Overwrite with a number on which lengths and counts turn over."""
    code = chance.choice("BHIQ")
    raw = struct.pack(chance.choice("<>") + code, chance.choice(_NUMBERS) & (256 ** struct.calcsize(code) - 1))
    at = chance.randrange(len(data))
    data[at : at + len(raw)] = raw


def _text_number(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    at = chance.randrange(len(data))
    text = chance.choice((b"-1", b"99999999999999999999", b"77777777777", b"NaN", b"\x80\0\0\0\xff\xff\xff\xff", b"\0"))
    data[at : at + len(text)] = text


def _cut(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    del data[chance.randrange(len(data)) :]


def _remove(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    at = chance.randrange(len(data))
    del data[at : at + chance.choice((1, 2, 4, 16, 256, 512))]


def _repeat(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    at = chance.randrange(len(data))
    part = data[at : at + chance.choice((4, 16, 64, 512))]
    data[at:at] = part * chance.choice((1, 2, 30))


def _splice(data: bytearray, seeds: Sequence[bytes], chance: random.Random) -> None:
    other = chance.choice(seeds)
    if other:
        at = chance.randrange(len(other))
        data[chance.randrange(len(data)) :] = other[at : at + 4096]


def _noise(data: bytearray, _: Sequence[bytes], chance: random.Random) -> None:
    at = chance.randrange(len(data))
    data[at : at + 16] = chance.randbytes(16)


_DAMAGE: tuple[Callable[[bytearray, Sequence[bytes], random.Random], None], ...] = (
    _flip,
    _flip,
    _number,
    _number,
    _text_number,
    _cut,
    _remove,
    _repeat,
    _splice,
    _noise,
)
