"""Running evaluations: rows, failures as rows, what is not run twice, and finished annotations scored."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from vipe_core.annotation import Annotation
from vipe_core.errors import MediaNotFound
from vipe_core.evaluation.datasets import find_sequences
from vipe_core.evaluation.results import load_paths
from vipe_core.evaluation.synthetic import SyntheticClip, tiny_clip
from vipe_core.formats import write_artifacts
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.evaluate import Measure, Task, dataset_tasks, run_tasks, video_tasks
from vipe_core.pipeline.presets import resolve
from vipe_core.slam.settings import EnergyTerms

MEASURE = Measure(resolve("classical"), matcher="sift")


def write_sequence(folder: Path, clip: SyntheticClip) -> None:
    (folder / "images").mkdir(parents=True)
    for k, rgb in enumerate(clip.rgb):
        assert cv2.imwrite(str(folder / "images" / f"{k:03d}.png"), rgb[..., ::-1])
    np.savez(
        folder / "gt.npz",
        cam_to_world=clip.world_from_cam,
        camera=clip.camera.model,
        intrinsics=np.array(clip.camera.params),
        width=clip.camera.width,
        height=clip.camera.height,
        depth=clip.depth.astype(np.float16)[:, 1::4, 1::4],
        dynamic=clip.dynamic[:, 1::4, 1::4],
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good sequence of ten frames, and one whose truth is damaged."""
    root = tmp_path_factory.mktemp("dataset")
    write_sequence(root / "orbit", tiny_clip("orbit", 10, 192, 144))
    (root / "damaged").mkdir()
    (root / "damaged" / "gt.npz").write_bytes(b"not a zip")
    return root


@pytest.fixture(scope="module")
def finished(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of rows of a run over `dataset`."""
    out = tmp_path_factory.mktemp("rows")
    run_tasks(tasks_of(dataset), out)
    return out


def tasks_of(dataset: Path, measure: Measure = MEASURE) -> list[Task]:
    return dataset_tasks(find_sequences("gt", dataset).sequences, measure)


def test_a_failure_is_a_row_and_what_is_done_is_not_run_again(
    dataset: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object, **kwargs: object) -> Annotation:
        raise AssertionError("a finished sequence was run again")

    monkeypatch.setattr(Annotator, "annotate", refuse)
    told: list[tuple[str, bool]] = []
    damaged, orbit = run_tasks(
        tasks_of(dataset), finished, report=lambda task, row, made: told.append((task.name, made))
    )
    assert told == [("orbit", False), ("damaged", True)]  # a failure is tried again
    assert damaged.error is not None
    assert damaged.error["code"] == "format_error"
    assert "damaged/gt.npz" in damaged.error["message"]
    assert orbit.error is None
    assert orbit.frames == 10
    assert orbit.reliable is not None
    assert orbit.figures["coverage"] == 1.0
    assert (orbit.figures["ate_percent"] or 100) < 3
    assert "rel_abs" not in orbit.figures
    paths = load_paths(finished, "orbit")
    assert paths is not None
    assert paths.estimate.shape == paths.reference.shape == (10, 4, 4)


def test_the_key_knows_what_the_figures_depend_on(dataset: Path) -> None:
    (first, second) = tasks_of(dataset)
    slam = dataclasses.replace(MEASURE.preset.slam, terms=EnergyTerms(motion_masks=False))
    changed = dataclasses.replace(MEASURE.preset, slam=slam)
    others = [
        second,
        *(
            dataclasses.replace(first, measure=measure)
            for measure in (
                dataclasses.replace(MEASURE, preset=changed),
                dataclasses.replace(MEASURE, depth=True),
                dataclasses.replace(MEASURE, alignment="metric"),
                dataclasses.replace(MEASURE, consistency=True),
            )
        ),
        *dataset_tasks(find_sequences("gt", dataset, max_frames=5).sequences, MEASURE)[:1],
    ]
    assert len({task.key for task in (first, *others)}) == 7
    assert tasks_of(dataset)[0].key == first.key


def test_finished_annotations_are_scored_without_the_engine(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    annotation = Annotator().annotate(dataset / "orbit" / "images", name="orbit")
    write_artifacts(annotation, tmp_path / "artifacts")
    monkeypatch.setattr(Annotator, "annotate", lambda *args, **kwargs: pytest.fail("the engine ran"))
    refs = [ref for ref in find_sequences("gt", dataset).sequences if ref.name == "orbit"]
    (row,) = run_tasks(dataset_tasks(refs, MEASURE, tmp_path / "artifacts"), tmp_path / "rows")
    assert row.error is None
    assert (row.figures["ate_percent"] or 100) < 3
    assert (row.figures["rel_abs"] or 100) < 0.2
    (row,) = run_tasks(dataset_tasks(refs, MEASURE, tmp_path / "nothing"), tmp_path / "rows")
    assert row.error is not None
    assert "it holds none" in row.error["message"]


def test_a_defect_in_one_sequence_does_not_end_the_others(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> Annotation:
        raise ZeroDivisionError("an unforeseen case\nwith a second line")

    monkeypatch.setattr(Annotator, "annotate", fail)
    rows = run_tasks(tasks_of(dataset), tmp_path)
    assert [row.error["code"] for row in rows if row.error] == ["format_error", "evaluation_failed"]
    assert rows[1].error is not None
    assert rows[1].error["message"] == "ZeroDivisionError: an unforeseen case"


@pytest.mark.long
def test_videos_without_truth_and_two_processes(dataset: Path, finished: Path, tmp_path: Path) -> None:
    """Both kinds of measure in processes of their own; the engine gives the same figures there."""
    measure = dataclasses.replace(MEASURE, consistency=True)
    (video,) = video_tasks(dataset / "orbit" / "images", measure, max_frames=8)
    _, again = tasks_of(dataset)
    row, same = run_tasks([video, again], tmp_path, jobs=2)
    assert row.error is None
    assert row.frames == 8
    for figure, bound in (("s_ate", 0.05), ("s_fov_deg", 15.0), ("sampson_median_px", 1.0)):
        value = row.figures[figure]
        assert value is not None
        assert 0 < value < bound
    paths = load_paths(tmp_path, video.stem)
    assert paths is not None
    assert paths.kind == "backward"
    (stored,) = run_tasks([again], finished)
    assert same.figures == stored.figures


def test_what_counts_as_a_video(tmp_path: Path) -> None:
    for name in ("b.mp4", "a.MOV", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "1.png").write_bytes(b"x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "A.mp4").write_bytes(b"x")
    tasks = video_tasks(tmp_path, MEASURE)
    assert [task.name for task in tasks] == ["A.mp4", "a.MOV", "b.mp4", "pictures"]
    assert [task.stem for task in tasks] == ["A", "a-2", "b", "pictures"]
    with pytest.raises(MediaNotFound):
        video_tasks(tmp_path / "empty", MEASURE)
