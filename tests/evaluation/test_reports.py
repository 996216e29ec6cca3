"""Reports and figures: the numbers that they show, the files they are, and what is stored between runs."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vipe_core.evaluation.consistency import SampsonErrors, ShuttleErrors
from vipe_core.evaluation.plots import plot_paths
from vipe_core.evaluation.report import (
    ABLATION,
    Heading,
    ablation_rows,
    columns,
    table_headings,
    table_rows,
    write_ablation,
    write_report,
)
from vipe_core.evaluation.results import Paths, SequenceResult, flat_figures, load_paths, load_result, save_result

HEADING = Heading("Accuracy on a test", ("Two sequences.",), {"preset": "classical"}, ("cm", 0.01))


def row(name: str, group: str, ate_m: float | None, **more: float) -> SequenceResult:
    figures: dict[str, float | None] = {"ate_m": ate_m, **more}
    return SequenceResult(name, group, "key", frames=10, figures=figures, reliable="yes", cpu_s=5.0)


FAILED = SequenceResult("broken", "Freiburg3", "key", error={"code": "media_corrupt", "message": "broken: no | video"})
ROWS = [row("a", "Freiburg1", 0.02, fov_deg=1.0), row("b", "Freiburg1", 0.04, fov_deg=2.0), FAILED]


def path(count: int) -> NDArray[np.float64]:
    poses = np.repeat(np.eye(4)[None], count, axis=0)
    angle = np.linspace(0, 3, count)
    poses[:, :3, 3] = np.stack([np.cos(angle), 0.1 * angle, np.sin(angle)], axis=1)
    poses[:, :3, :3] = Rotation.from_euler("y", angle[:, None]).as_matrix()
    return poses


def test_lengths_are_in_the_unit_of_the_paper() -> None:
    shown = columns(ROWS, ("cm", 0.01))
    assert [column.heading for column in shown] == ["ATE [cm]", "Focal [deg]"]
    assert table_rows(ROWS, shown)[0] == ["a", "10", "2", "1.00", "yes", "0.50"]


def test_means_are_of_groups_and_do_not_hide_failures() -> None:
    shown = columns(ROWS)
    rows = table_rows(ROWS, shown)
    assert all(len(cells) == len(table_headings(shown)) for cells in rows)
    assert rows[2][:2] == ["broken", "failed"]
    assert "media_corrupt" in rows[2]
    assert rows[3][:4] == ["mean of Freiburg1 (2)", "", "0.03", "1.50"]
    assert rows[4][0] == "mean of Freiburg3 (0/1)"
    assert rows[5][0] == "mean (2/3)"


def test_a_figure_that_means_nothing_is_a_dash_and_not_in_the_mean() -> None:
    results = [row("still", "all", None), row("moves", "all", 0.5)]
    rows = table_rows(results, columns(results))
    assert rows[0][2] == "-"
    assert rows[-1][2] == "0.5"


def test_the_report_is_markdown_and_json(tmp_path: Path) -> None:
    markdown, data = write_report(tmp_path, HEADING, ROWS, {"a": "figures/a.png"})
    text = markdown.read_text()
    assert text.startswith("# Accuracy on a test\n")
    assert "| a | 10 | 2 | 1.00 | yes | 0.50 |" in text
    assert "![a](figures/a.png)" in text
    assert "- broken: broken: no | video [media_corrupt]" in text
    document = json.loads(data.read_text())
    assert document["means"]["Freiburg1"]["ate_m"] == pytest.approx(0.03)
    assert document["rows"][2]["error"]["code"] == "media_corrupt"
    assert document["failed"] == 1


def test_the_ablation_compares_the_same_sequences(tmp_path: Path) -> None:
    """A variant that fails on a sequence takes it out of everybody's mean."""
    by_name = {name: [row("easy", "all", 0.01), row("hard", "all", 0.09)] for name in ABLATION}
    by_name["dense"][1] = SequenceResult("hard", "all", "key", error={"code": "engine_failed", "message": "x"})
    rows = ablation_rows(by_name, columns(by_name["all"]))
    assert [cells[:4] for cells in rows] == [
        ["x", "", "", ""],
        ["x", "", "x", ""],
        ["x", "x", "x", ""],
        ["x", "", "x", "x"],
        ["x", "x", "x", "x"],
    ]
    assert {cells[4] for cells in rows} == {"0.01"}
    markdown, data = write_ablation(tmp_path, HEADING, by_name)
    assert "Left out, as not every variant finished them: hard." in markdown.read_text()
    assert json.loads(data.read_text())["sequences"] == ["easy"]


def test_figures_hold_no_nan() -> None:
    figures = flat_figures(
        shuttle=ShuttleErrors(None, None, 0.1, 2.0), sampson=SampsonErrors(float("nan"), 0.5, 3, 100, "SIFT")
    )
    assert figures["s_ate"] is None
    assert figures["sampson_px"] is None
    assert figures["s_fov_deg"] == 2.0
    json.dumps(figures, allow_nan=False)


def test_rows_and_paths_survive_the_disk(tmp_path: Path) -> None:
    paths = Paths(path(5), path(5) + 0.01, "backward", np.arange(5) / 30)
    save_result(tmp_path, "a", ROWS[0], paths)
    save_result(tmp_path, "broken", FAILED, None)
    assert load_result(tmp_path, "a") == ROWS[0]
    assert load_result(tmp_path, "broken") == FAILED
    stored = load_paths(tmp_path, "a")
    assert stored is not None
    assert stored.kind == "backward"
    np.testing.assert_array_equal(stored.reference, paths.reference)
    assert load_paths(tmp_path, "broken") is None
    (tmp_path / "a.json").write_text("{")
    assert load_result(tmp_path, "a") is None


@pytest.mark.parametrize("still", [False, True])
def test_a_figure_is_drawn_and_is_the_same_each_time(tmp_path: Path, still: bool) -> None:
    truth = path(12)
    estimate = np.repeat(np.eye(4)[None], 12, axis=0) if still else truth.copy()
    if not still:
        estimate[:, :3, 3] = 2 * estimate[:, :3, 3] + np.random.default_rng(0).normal(0, 0.02, (12, 3))
    paths = Paths(estimate, truth, "truth", np.arange(12) / 10)
    first = plot_paths(paths, tmp_path / "figures" / "1.png", "clip")
    second = plot_paths(paths, tmp_path / "2.png", "clip")
    image = cv2.imread(str(first))
    assert image is not None
    assert image.shape[0] > 400
    assert image.std() > 5
    assert first.read_bytes() == second.read_bytes()
