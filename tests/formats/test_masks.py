"""Masks on disk: ViPE's zip of instance ids, with the phrases beside it."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from artifact_samples import make_annotation
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats import MaskZipReader, MaskZipWriter, read_artifacts, write_artifacts


@settings(max_examples=20, deadline=None)
@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 3), st.integers(1, 40), st.integers(1, 40))))
def test_ids_round_trip_and_the_same_masks_have_the_same_bytes(
    tmp_path_factory: pytest.TempPathFactory, masks: NDArray[Any]
) -> None:
    folder = tmp_path_factory.mktemp("masks")
    for name in ("a.zip", "b.zip"):
        with MaskZipWriter(folder / name) as writer:
            for mask in masks:
                writer.append(mask)
    assert (folder / "a.zip").read_bytes() == (folder / "b.zip").read_bytes()
    with MaskZipReader(folder / "a.zip") as reader:
        np.testing.assert_array_equal(np.stack(list(reader)), masks)
        with pytest.raises(IndexError):
            reader.read(len(masks))


def test_an_annotation_has_a_mask_for_every_frame_and_phrases(tmp_path: Path) -> None:
    paths = write_artifacts(make_annotation(), tmp_path)
    assert paths.mask is not None
    assert paths.mask_txt is not None
    assert paths.mask_txt.read_text() == "0: background\n1: moving\n"
    artifacts = read_artifacts(tmp_path, "clip")
    assert artifacts.has_mask
    with artifacts.open_mask() as masks:
        for mask, frame in zip(masks, make_annotation().dense(), strict=True):
            np.testing.assert_array_equal(mask, frame.mask)
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics"))
    assert not read_artifacts(tmp_path, "clip").has_mask


def test_what_is_no_archive_of_masks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such archive of masks"):
        MaskZipReader(tmp_path / "none.zip")
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(FormatError, match="not a readable zip"):
        MaskZipReader(tmp_path / "text.zip")
    with zipfile.ZipFile(tmp_path / "gap.zip", "w") as archive:
        archive.writestr("00001.png", b"")
    with pytest.raises(FormatError, match="masks are missing"):
        MaskZipReader(tmp_path / "gap.zip")
    with zipfile.ZipFile(tmp_path / "noise.zip", "w") as archive:
        archive.writestr("00000.png", b"no picture")
    with MaskZipReader(tmp_path / "noise.zip") as reader, pytest.raises(FormatError, match="8-bit"):
        reader.read(0)
