"""What every specialisation of the CUDA kernels of bundle adjustment takes of a GPU: `python -m benchmarks.ba_kernels`.

Compiles with NVRTC as the engine does, for compute capabilities 8.0, 9.0 and 12.0, and reads the assembler's report:
registers, spilled bytes, stack, static shared memory, and the blocks of threads that a multiprocessor can hold by
registers. No GPU is needed. Fails where anything spills, where a multiprocessor cannot hold the blocks that a pass over
the cells is meant for, or where static shared memory is more than every GPU has.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from vipe_core.ba.cuda.compiler import Specialisation, compile_kernels, specialisations, system_source, tile_source
from vipe_core.ba.cuda.context import TILE_THREADS

ARCHITECTURES = ("sm_80", "sm_90", "sm_120")
_REGISTERS = 65536
_STATIC_SHARED_BYTES = 48 << 10
_MOST_REGISTERS = 255


@dataclass(frozen=True, slots=True)
class Usage:
    """Of one kernel, per thread: registers, spilled bytes, bytes of stack; and bytes of static shared memory."""

    registers: int
    spilled: int
    stack: int
    shared: int

    @property
    def resident_blocks(self) -> int:
        """Blocks of the pass over the cells that fit a multiprocessor's registers, allocated in eights."""
        return _REGISTERS // (-(-self.registers // 8) * 8 * TILE_THREADS)


def usage(source: str, architecture: str) -> dict[str, Usage]:
    """Compile, and what each kernel takes."""
    log = io.StringIO()
    compile_kernels(source, architecture, cache=None, log=log)
    found: dict[str, Usage] = {}
    for entry in log.getvalue().split("Compiling entry function '")[1:]:
        numbers = {
            name: sum(int(value) for value in re.findall(pattern, entry))
            for name, pattern in (
                ("registers", r"Used (\d+) registers"),
                ("spilled", r"(\d+) bytes spill"),
                ("stack", r"(\d+) bytes stack frame"),
                ("shared", r"(\d+) bytes smem"),
            )
        }
        found[entry[: entry.index("'")]] = Usage(**numbers)
    return found


def faults(name: str, used: Usage, kind: Specialisation | None = None) -> list[str]:
    """What is wrong with a kernel, of a specialisation where it is a pass over the cells."""
    found = [f"{used.spilled} bytes spilled"] if used.spilled else []
    if used.shared > _STATIC_SHARED_BYTES:
        found.append(f"{used.shared} bytes of static shared memory")
    if used.registers > _MOST_REGISTERS:
        found.append(f"{used.registers} registers")
    if kind is not None and used.resident_blocks < kind.resident_blocks[name]:
        found.append(f"{used.resident_blocks} blocks of threads, not {kind.resident_blocks[name]}")
    if kind is not None and used.stack:
        found.append(f"{used.stack} bytes of stack")
    return found


def rows(architecture: str) -> Iterable[tuple[str, Usage, list[str]]]:
    """Every kernel of every specialisation, each compiled by itself as the engine does; and what is wrong with it."""
    for name, used in usage(system_source(), architecture).items():
        yield name, used, faults(name, used)
    for kind in specialisations():
        camera = "unified" if kind.unified else "pinhole"
        free = "+".join(name for name, is_free in (("focal", kind.focal), ("alpha", kind.alpha)) if is_free) or "none"
        cameras = (" apart" if kind.apart else "") + (" points" if kind.points else "")
        for name, used in usage(tile_source([kind]), architecture).items():
            yield f"{name} {camera} {free}{cameras} {kind.robust}", used, faults(name, used, kind)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--arch", nargs="*", default=ARCHITECTURES, metavar="SM")
    arguments = parser.parse_args(argv)
    console, wrong = Console(width=120), []
    for architecture in arguments.arch:
        table = Table(title=architecture)
        for heading in ("kernel", "registers", "spilled B", "stack B", "shared B", "blocks/SM"):
            table.add_column(heading, justify="left" if heading == "kernel" else "right")
        for name, used, found in rows(architecture):
            wrong += [f"{architecture} {name}: {fault}" for fault in found]
            blocks = str(used.resident_blocks) if name.startswith("tile") else ""
            numbers = (used.registers, used.spilled, used.stack, used.shared)
            table.add_row(name, *map(str, numbers), blocks)
        console.print(table)
    console.print("\n".join(wrong) or "nothing spills, and every pass has the blocks it is meant for")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
