"""The GPU's checks on a machine without one, and the benchmark they run."""

from __future__ import annotations

import pytest
import torch

from benchmarks import gpu_checks
from benchmarks.ba import Size, problem_of, work


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("arguments", [[], ["--check", "graph"]])
def test_without_a_gpu_nothing_is_claimed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu_checks.main(arguments) == 2
    assert "No GPU" in capsys.readouterr().out


def test_the_sections_stay_below_ten_minutes() -> None:
    sections = gpu_checks._sections(None)
    assert sum(limit for _, _, limit in sections) < 600
    named = [command[command.index("--check") + 1] for _, command, _ in sections if "--check" in command]
    assert set(named) <= set(gpu_checks.CHECKS)


def test_a_graph_has_the_edges_that_its_size_says() -> None:
    size = Size.parse("25x120")
    problem, state = problem_of(size, torch.device("cpu"))
    edges = problem.edges
    assert size == Size(25, 120, focal=False)
    assert len({*zip(edges.source.tolist(), edges.target.tolist(), strict=True)}) == 120
    assert (edges.source != edges.target).all()
    assert (edges.weight > 0).any(-1).double().mean() > 0.9
    # Study's table: 80, 70 and 33 Mflop over the cells, 7.1 MB.
    degrees = torch.full((25,), 120 / 25)
    single, _, moved = work(size, degrees)
    assert single / 1e6 == pytest.approx(80 + 70 + 33, rel=0.02)
    assert moved / 1e6 == pytest.approx(7.1, rel=0.01)
    assert state.inverse_depth.dtype == torch.float32
