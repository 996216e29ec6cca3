"""What a chaos run came to: each fault, the work that it cost, and whether every video got what it deserves."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.chaos.faults import Injected
from services.domain.states import VideoStatus
from services.store.sql import SqlStore


@dataclass
class Verdict:
    state: str
    verified: str
    outcomes: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.problems


def account_for_lost_work(work: list[dict[str, Any]], faults: list[Injected]) -> None:
    """Give every attempt at a video that came to nothing, or was made again, to the fault that it belongs to."""
    happened = [fault for fault in faults if fault.happened]
    open_attempts: dict[int, dict[str, Any]] = {}
    ended: set[str] = set()
    lost: list[tuple[dict[str, Any], float, bool]] = []
    for line in work:
        before = open_attempts.pop(line["pid"], None)
        if line["event"] == "begin":
            if before is not None:
                lost.append((before, line["at"], False))
            open_attempts[line["pid"]] = line
        elif before is not None:
            if line["video"] in ended:
                lost.append((before, line["at"], True))
            ended.add(line["video"])
    lost += [(attempt, attempt["at"] + 1.0, False) for attempt in open_attempts.values()]
    for attempt, until, again in lost:
        if attempt["video"].startswith(("poison", "cut")):
            continue
        begin = attempt["at"]
        if again:
            candidates = [f for f in happened if f.at <= begin]
            fault = max(candidates, key=lambda f: f.at, default=None)
            seconds = until - begin
        else:
            of_agent = [f for f in happened if f.agent == attempt["agent"] and f.kind.working == "agent"]
            near = [f for f in of_agent if begin - 1.0 <= (f.noticed or f.at) and f.at <= begin + 60.0]
            fault = next((f for f in near if f.video == attempt["video"]), None) or min(
                near, key=lambda f: abs(f.at - begin), default=None
            )
            seconds = max(0.0, (fault.noticed or fault.at) - begin) if fault else 0.0
        if fault is not None:
            fault.lost_videos += 1
            fault.lost_s += seconds


def judge(store: SqlStore, job_id: str, faults: list[Injected], verified: tuple[int, str], names: list[str]) -> Verdict:
    """Complete, exactly once, and nobody blamed for what he did not do."""
    code, words = verified
    job = store.get_job(job_id)
    verdict = Verdict(job.state.value, words)
    if job.state.value != "succeeded_with_errors":
        verdict.problems.append(f"the job is {job.state.value}: {job.error_message}")
    if code != 0:
        verdict.problems.append(f"vipectl verify --deep: exit code {code}")
    guilty = {fault.video for fault in faults if fault.kind.name == "exception"}
    rows, after = [], None
    while True:
        page, after = store.list_videos(job_id, limit=1000, after=after)
        rows += page
        if after is None:
            break
    found = Counter(Path(row.ref.uri).stem for row in rows)
    if sorted(found.elements()) != sorted(names):
        verdict.problems.append("the videos of the job are not those that were submitted, each once")
    for row in rows:
        name = Path(row.ref.uri).stem
        verdict.outcomes[row.status.value] += 1
        result = row.result
        code_found = result.error_code if result else None
        message = result.error_message if result else ""
        if name.startswith("poison"):
            deaths = result.deaths if result else None
            right = row.status is VideoStatus.QUARANTINED and deaths is not None and len(deaths) >= 2
        elif name in guilty:
            right = row.status is VideoStatus.FAILED and code_found == "engine_failed"
        elif name == "cut":
            right = row.status is VideoStatus.FAILED and code_found == "media_corrupt"
        else:
            right = row.status is VideoStatus.SUCCEEDED
        if not right:
            verdict.problems.append(f"{name} is {row.status.value}: {code_found} {message}")
    verdict.problems += [f"{f.kind.name}: not overcome" for f in faults if f.happened and f.recovered is None]
    return verdict


def print_report(verdict: Verdict, faults: list[Injected], took_s: float) -> None:
    titles = ("injected", "detected", "recovered", "lost videos", "lost s")
    print(f"\n{'fault':22} agent " + " ".join(f"{title:>11}" for title in titles))
    first = min((f.at for f in faults if f.at), default=0.0)
    for fault in sorted(faults, key=lambda f: f.at or 1e12):
        if not fault.happened or (fault.kind.by_order and not fault.video and fault.kind.name != "bad-slot"):
            print(f"{fault.kind.name:22} {fault.agent:5} {'not: there was no work to break into':>36}")
            continue
        detected = "-" if fault.noticed is None else f"{max(0.0, fault.noticed - fault.at):.1f}"
        recovered = "NO" if fault.recovered is None else f"{fault.recovered - fault.at:.1f}"
        cells = (f"{fault.at - first:.1f}", detected, recovered, str(fault.lost_videos), f"{fault.lost_s:.1f}")
        print(f"{fault.kind.name:22} {fault.agent:5} " + " ".join(f"{cell:>11}" for cell in cells))
    print(f"\njob: {verdict.state} after {took_s:.0f} s; {dict(verdict.outcomes)}")
    print(f"verify: {verdict.verified}")
    for problem in verdict.problems:
        print(f"PROBLEM: {problem}")
    print("complete, exactly once, and everybody got what he deserves" if verdict.ok else "FAILED")
