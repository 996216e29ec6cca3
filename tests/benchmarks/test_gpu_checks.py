"""The GPU's checks on a machine without one, and the benchmark they run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from benchmarks import gpu_checks
from benchmarks.ba import Size, problem_of, work
from benchmarks.gpu_checks import Outcome, Section


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("arguments", [[], ["--check", "graph"]])
def test_without_a_gpu_nothing_is_claimed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu_checks.main(arguments) == 2
    assert "No GPU" in capsys.readouterr().out


def test_the_sections_are_checks_that_there_are_and_fit_ten_minutes() -> None:
    groups = gpu_checks.sections(Path("vipe"), None)
    assert sum(max(section.limit_s for section in group) for group in groups) <= 600
    commands = [section.command for group in groups for section in group]
    named = {command[command.index("--check") + 1] for command in commands if "--check" in command}
    assert named | {"small-solves"} == set(gpu_checks.CHECKS)


def _run(code: str, folder: Path, limit_s: float = 30.0, left_s: float = 30.0) -> Outcome:
    section = Section("a section", [sys.executable, "-u", "-c", code], limit_s)
    (found,) = gpu_checks.run([[section]], left_s, folder)
    return found


def test_a_section_survives_what_it_runs(tmp_path: Path) -> None:
    passed = _run("print('fine')", tmp_path)
    assert (passed.outcome, passed.said) == ("passed", "fine")
    failed = _run("print('so far'); raise SystemError('why')", tmp_path)
    assert failed.outcome == "failed (1)"
    assert failed.said.endswith("SystemError: why")
    # What it leaves behind neither holds it up nor goes on beside the next section; what it said so far is kept.
    late = _run("import os, time; print('begun'); os.fork(); time.sleep(60)", tmp_path, limit_s=1.0)
    assert (late.outcome, late.said) == ("out of time", "begun")
    assert late.seconds < 30
    assert (tmp_path / "a_section.txt").read_text() == "begun\n"
    assert _run("print('fine')", tmp_path, left_s=-1.0).outcome == "no time left"
    lines = (tmp_path / "summary.txt").read_text().splitlines()
    assert [line.split()[2] for line in lines] == ["passed", "failed", "out", "no"]


def test_a_section_that_cannot_be_started_costs_no_other(tmp_path: Path) -> None:
    sections = [Section("gone", [str(tmp_path / "no such tool")], 9.0), Section("there", ["true"], 9.0)]
    outcomes = gpu_checks.run([sections[:1], sections[1:]], 30.0, tmp_path)
    assert [outcome.outcome for outcome in outcomes] == ["not started", "passed"]
    assert "no such tool" in outcomes[0].said


def test_the_summary_is_short_and_comes_last() -> None:
    outcomes = [Outcome(f"section {k}", "failed (1)", 1.0, "x" * 9000 + f"end {k}", 5000) for k in range(12)]
    text = gpu_checks.summary("a GPU", outcomes)
    assert len(text) < 12000
    assert text.splitlines()[-12:][0].split()[:3] == ["section", "0", "failed"]
    assert "end 11" in text


def test_a_graph_has_the_edges_that_its_size_says() -> None:
    size = Size.parse("25x120")
    problem, state = problem_of(size, torch.device("cpu"))
    edges = problem.edges
    assert size == Size(25, 120, focal=False)
    assert len({*zip(edges.source.tolist(), edges.target.tolist(), strict=True)}) == 120
    assert (edges.source != edges.target).all()
    assert (edges.weight > 0).any(-1).double().mean() > 0.9
    # Study's table: 80, 70 and 33 Mflop over the cells, 7.1 MB.
    least = work(size, torch.full((25,), 120 / 25))
    assert least.assembly / 1e6 == pytest.approx(80 + 70, rel=0.02)
    assert least.depths / 1e6 == pytest.approx(33, rel=0.02)
    assert least.bytes / 1e6 == pytest.approx(7.1, rel=0.01)
    assert state.inverse_depth.dtype == torch.float32
