"""Sources of the kernels -> code for one GPU, with NVRTC through cuda-core.

Nothing but the driver, NVRTC (which comes with torch's CUDA wheels) and cuda-core is needed: no toolkit, no headers, no
host compiler. Compiled code is kept on disk under a key of source, options, architecture and compiler version;
cuda-core writes it atomically.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final, Literal

from vipe_core.ba import rules
from vipe_core.ba.cuda import context
from vipe_core.ba.problem import RobustKernel
from vipe_core.ba.robust import CODE

logger = logging.getLogger(__name__)

_COMMON = ("context.cu", "pixel.cu")
_SYSTEM = ("largest.cu", "reduce.cu", "factor.cu", "descent.cu")
_TILE = ("tile.cu",)

_SIZES = (
    *("TILE", "SLICE", "TILE_THREADS", "EDGE_FLOATS", "TWIST_FLOATS", "SIDE_BLOCKS", "SIDE"),
    *("FACTOR_THREADS", "WIDE_THREADS", "ASSEMBLE_BLOCKS", "CONTEXT_BYTES", "CONTROL_BYTES"),
)
_RULES = (
    *("MAX_LOG_FOCAL_STEP", "MIN_CURVATURE", "MAX_DAMPING", "ACCEPTED_FACTOR", "REJECTED_FACTOR"),
    *("NEGLIGIBLE_COST", "UNTRIED_SHARE", "TRUSTED_DAMPING", "NARROWING"),
)
SYSTEM_KERNELS = (
    *("begin", "widen", "transform", "largest", "fold", "turn", "assemble", "judge"),
    *("damp", "gather", "factorise", "substitute", "propose", "covariance", "finish"),
)
TILE_KERNELS = ("tile", "tile_large")
COMPONENTWISE: Final = "componentwise"
"""Stands for all kernels of residuals where they judge components: which one, a pass over the cells asks as it runs."""
# Numbered as `CODE` does, in whose order they are.
_ROBUST: tuple[RobustKernel | Literal["componentwise"], ...] = (*CODE, COMPONENTWISE)


@dataclass(frozen=True, slots=True)
class Specialisation:
    """What the pass over the cells is compiled for: camera, free intrinsics, the kernel of the residuals, whether
    several cameras have these intrinsics each for itself, and whether frames have points of their own, not a grid."""

    unified: bool
    focal: bool
    alpha: bool
    robust: RobustKernel | Literal["componentwise"]
    apart: bool = False
    points: bool = False

    @property
    def resident_blocks(self) -> dict[str, int]:
        """Blocks of threads of each kernel that a multiprocessor should hold: at most 65536 / 128 / blocks registers
        per thread."""
        tile, large = (3 if self.alpha else 4), 3
        if self.apart:
            tile = large = 2 if self.focal and self.alpha else 3
        # Where the cells of a frame end is one more thing to know.
        return dict(zip(TILE_KERNELS, (min(tile, 3), 2) if self.points else (tile, large), strict=True))

    def definition(self, suffix: str = "") -> str:
        """The two kernels of this specialisation; their names end in `suffix`."""
        flags = ", ".join(str(flag).lower() for flag in (self.unified, self.focal, self.alpha, self.apart, self.points))
        kernels = zip(self.resident_blocks.items(), ("false", "true"), strict=True)
        return "".join(
            f"DEFINE_TILE_KERNEL({name}{suffix}, {flags}, {_ROBUST.index(self.robust)}, {large}, {blocks})\n"
            for (name, blocks), large in kernels
        )


def specialisations() -> Iterable[Specialisation]:
    """All there are: alpha is an intrinsic of the unified camera only."""
    for robust in _ROBUST:
        for unified, focal, alpha in ((0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (1, 0, 1), (1, 1, 1)):
            for apart in (False, True) if focal or alpha else (False,):
                for points in (False, True):
                    yield Specialisation(bool(unified), bool(focal), bool(alpha), robust, apart, points)


def _read(names: Iterable[str]) -> str:
    folder = resources.files("vipe_core.ba.cuda") / "kernels"
    return "".join((folder / name).read_text() for name in names)


def system_source() -> str:
    """Everything but the pass over the cells."""
    return _constants() + _read(_COMMON + _SYSTEM)


def tile_source(chosen: Iterable[Specialisation], *, numbered: bool = False) -> str:
    """The pass over the cells; kernels of several specialisations are numbered to tell them apart."""
    definitions = (kind.definition(f"_{k}" if numbered else "") for k, kind in enumerate(chosen))
    return _constants() + _read(_COMMON + _TILE) + "".join(definitions)


def _constants() -> str:
    """What the kernels must not have another opinion of."""
    constants = {name: getattr(context, name) for name in _SIZES} | {name: getattr(rules, name) for name in _RULES}
    constants["MIN_ALPHA"], constants["MAX_ALPHA"] = rules.ALPHA_RANGE
    constants["SIGMA_DAMPINGS"] = ", ".join(map(str, rules.SIGMA_DAMPINGS))
    return "".join(f"#define {name} {value}\n" for name, value in constants.items())


def cache_folder() -> Path:
    """Where compiled kernels are kept."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "vipe_core" / "kernels"


def compile_kernels(source: str, architecture: str, *, cache: Path | None, log: Any = None) -> Any:
    """Compile for an architecture like `sm_90`; no GPU is needed.

    Args:
        cache: Folder of compiled code, or None to compile in any case; so does a folder that cannot be written to.
        log: Where the compiler's report on registers and memory goes, if anywhere; anything with `write`.

    Returns:
        The `cuda.core.ObjectCode` of a cubin.

    Raises:
        ImportError: cuda-core or cuda-bindings is not installed.
        Exception: Whatever cuda-core raises where NVRTC is missing or rejects the source.
    """
    from cuda.core import Program, ProgramOptions
    from cuda.core.utils import FileStreamProgramCache

    options = ProgramOptions(
        name="vipe_ba",
        std="c++17",
        arch=architecture,
        # Two units in the last place instead of a half; sums are single precision anyway.
        prec_div=False,
        prec_sqrt=False,
        ptxas_options=["-v"] if log is not None else None,
    )
    program = Program(source, "c++", options)
    try:
        if cache is not None:
            try:
                with FileStreamProgramCache(cache) as kept:
                    return program.compile("cubin", logs=log, cache=kept)
            except OSError as error:
                logger.warning("compiled kernels cannot be kept in %s: %s", cache, error)
        return program.compile("cubin", logs=log)
    finally:
        program.close()
