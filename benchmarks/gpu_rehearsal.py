"""The GPU's checks where there is no GPU, before the one day there is one: `python -m benchmarks.gpu_rehearsal`.

    python -m benchmarks.gpu_rehearsal [SECTION ...] [--vipe FOLDER] [--output FOLDER]

Every section of `benchmarks.gpu_checks` runs as it will there, in processes of its own, each of which claims a GPU as
it starts (`claimed_gpu`), with kernels on the tests' emulators (g++). Problems are tiny and times mean nothing: what is
looked for is what would end a section. compute-sanitizer, DROID's extension and what nvidia-vipe compiles are not
there. Takes half an hour on one core, most of it to compile kernels and for networks of public sizes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks import gpu_checks
from benchmarks.ba import Size, problem_of
from benchmarks.gpu_checks import Section
from benchmarks.networks import ADAPTERS
from vipe_core.ba import Problem, State

_CLAIM = Path(__file__).parent / "claimed_gpu" / "everywhere"
_LIMIT_S = 900.0
_TOTAL_S = 3600.0
_RUNS = 2
# Of the shapes of `correct`, those of more edges than an emulator can do in a minute.
_MOST_EDGES = 80
# More layers than a CPU has patience for.
_LARGE_NETWORKS = ("depth_pro",)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="SECTION")
    parser.add_argument("--vipe", type=Path, metavar="FOLDER")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="what every section says is left there")
    parser.add_argument("--check", choices=gpu_checks.CHECKS, help="this check only, made small, in this process")
    arguments = parser.parse_args(argv)
    if arguments.check:
        with _made_small():
            print(gpu_checks.CHECKS[arguments.check]())
        return 0
    groups = [
        [_small(section) for section in group if not arguments.names or section.name in arguments.names]
        for group in gpu_checks.sections(arguments.vipe, None)
    ]
    os.environ["PYTHONPATH"] = os.pathsep.join([str(_CLAIM), str(Path.cwd()), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory(prefix="vipe-rehearsal-") as folder:
        where = arguments.output or Path(folder)
        outcomes = gpu_checks.run([group for group in groups if group], _TOTAL_S, where, beside=False)
    print(gpu_checks.summary("a claimed GPU", outcomes))
    return int(not all(outcome.passed for outcome in outcomes))


def _small(section: Section) -> Section:
    """The same with little to do."""
    command = [word.replace("benchmarks.gpu_checks", "benchmarks.gpu_rehearsal") for word in section.command]
    command += {
        "adapters": [name for name in ADAPTERS if name not in _LARGE_NETWORKS],
        "ba": ["--sizes", "4x8", "--repeats", "1"],
        "pipeline": ["--videos", "1", "2", "--frames", "20", "--size", "64x48", "--every", "2", "--short"],
    }.get(section.name, [])
    return replace(section, command=command, limit_s=_LIMIT_S)


@contextmanager
def _made_small() -> Iterator[None]:
    """Smaller problems for the checks of this process."""
    shapes = [one for one in gpu_checks._shapes() if len(one[0].edges.source) <= _MOST_EDGES]

    def small(size: Size, device: torch.device) -> tuple[Problem, State]:
        return problem_of(Size(4, 8, size.focal), device)

    with (
        patch.object(gpu_checks, "problem_of", small),
        patch.object(gpu_checks, "_RUNS", _RUNS),
        patch.object(gpu_checks, "_shapes", lambda: shapes),
    ):
        yield


if __name__ == "__main__":
    sys.exit(main())
