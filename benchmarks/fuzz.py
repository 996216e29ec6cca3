"""Damaged bytes for everything that reads bytes from outside: `python -m benchmarks.fuzz --minutes 30`.

Every case is made by code from its number, so that a finding is repeated by `--target T --seed S --first N --cases 1`.
A reader must return or raise a typed error, within its time and memory. The cases run in a child: one that dies or
hangs is a finding, except where the product itself runs the reader in a process of its own; then it is counted.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.hostile.mutation import mutated
from benchmarks.hostile.targets import TARGETS

_CASE_CPU_S = 20
_MEMORY_BYTES = 3 << 30
_ROOT = Path(__file__).resolve().parents[1]


@dataclass(slots=True)
class Outcome:
    """What became of the cases of one target.

    Attributes:
        findings: (number of the case, what went wrong).
        contained: Cases that killed the child of a reader which has one in the product, too.
    """

    target: str
    cases: int = 0
    read: int = 0
    refused: int = 0
    contained: list[int] = field(default_factory=list)
    findings: list[tuple[int, str]] = field(default_factory=list)


def fuzz(target: str, seed: int, cases: int, first: int = 0) -> Outcome:
    """Run the cases [first, first + cases) of a target."""
    outcome = Outcome(target)
    position, end = first, first + cases
    while position < end:
        command = [sys.executable, "-m", "benchmarks.fuzz", "--worker", "--target", target, "--seed", str(seed)]
        child = subprocess.Popen(
            [*command, "--first", str(position), "--cases", str(end - position)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=_ROOT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 20)},
        )
        assert child.stdout is not None
        for line in child.stdout:
            number, verdict = json.loads(line)
            position = number + 1
            outcome.cases += 1
            if verdict == "read":
                outcome.read += 1
            elif verdict == "refused":
                outcome.refused += 1
            else:
                outcome.findings.append((number, verdict))
        status = child.wait()
        if status == 0:
            break
        if position == first and status > 0:
            raise RuntimeError(f"the child for {target} does not start (status {status})")
        outcome.cases += 1
        if TARGETS[target].crashes_are_contained:
            outcome.contained.append(position)
        else:
            how = signal.Signals(-status).name if status < 0 else f"status {status}"
            outcome.findings.append((position, f"the process died ({how})"))
        position += 1
    return outcome


def _work(target: str, seed: int, first: int, cases: int) -> None:
    """The child: one line per case."""
    from services.domain.errors import ServiceError
    from vipe_core.errors import VipeError

    reader = TARGETS[target]
    seeds = reader.seeds()
    # Native libraries print; what they print is not part of the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in range(first, first + cases):
        data = mutated(seeds, random.Random(f"{target}:{seed}:{number}"))
        signal.setitimer(signal.ITIMER_PROF, _CASE_CPU_S)
        try:
            reader.read(data)
            verdict = "read"
        except (VipeError, ServiceError) as error:
            text = str(error)
            fine = text.isprintable() and 10 < len(text) < 1000
            verdict = "refused" if fine else f"the message of {type(error).__name__} is no clear line: {text!a}"
        except Exception as error:
            verdict = f"{type(error).__name__}: {error}"[:300]
        signal.setitimer(signal.ITIMER_PROF, 0)
        answers.write(json.dumps([number, verdict]) + "\n")
        answers.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--target", choices=sorted(TARGETS), help="one reader; all if left out")
    parser.add_argument("--minutes", type=float, default=5.0, help="how long, all readers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, help="so many cases of each reader, instead of a time")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        _work(args.target, args.seed, args.first, args.cases)
        return
    names = [args.target] if args.target else list(TARGETS)
    until = time.monotonic() + 60 * args.minutes
    first, found = args.first, 0
    while True:
        for name in names:
            outcome = fuzz(name, args.seed, args.cases or 500, first)
            found += len(outcome.findings)
            counts = f"{outcome.read} read, {outcome.refused} refused, {len(outcome.contained)} contained"
            print(f"{name:8} from {first:6}: {counts}", flush=True)
            for number, what in outcome.findings:
                print(f"  --target {name} --seed {args.seed} --first {number} --cases 1: {what}", flush=True)
        first += 500
        if args.cases or time.monotonic() > until:
            break
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
