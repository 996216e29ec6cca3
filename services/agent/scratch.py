"""The local folder of a shard in the making, and what survives of it when a worker or the agent dies.

    SCRATCH/<shard id>.<fence>/
        shard.json              what the artifacts were made from and by: adopted only if all of it is equal
        input/                  fetched inputs, one at a time
        staging/                artifacts of the running video; wiped before each video
        artifacts/              artifacts of finished videos: pose/ intrinsics/ depth/ rgb/ mask/
        results/<key>.json      written last, and atomically: the video is finished and its artifacts are complete
        tars/                   tars in the making

A folder belongs to one lease, so that a worker whose lease was lost never writes where its successor reads. The
successor on the same machine moves finished videos over instead of computing them again.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from pathlib import Path
from typing import Any

from services.domain.models import Lease, VideoResult
from services.domain.states import VideoStatus
from services.observability.metrics import package_version

logger = logging.getLogger(__name__)


class ShardScratch:
    """The folder of one lease.

    Args:
        root: The scratch folder of this node.
    """

    def __init__(self, root: Path, lease: Lease) -> None:
        self._root = root
        self._lease = lease
        self.path = root / f"{lease.shard_id}.{lease.fence:08d}"

    @property
    def artifacts(self) -> Path:
        return self.path / "artifacts"

    @property
    def tars(self) -> Path:
        return self.path / "tars"

    def open(self) -> tuple[VideoResult, ...]:
        """Create the folder, take over what earlier leases finished here, and return the finished videos."""
        for folder in ("input", "staging", "artifacts", "results", "tars"):
            (self.path / folder).mkdir(parents=True, exist_ok=True)
        _write_json(self.path / "shard.json", self._identity())
        for older in sorted(self._root.glob(f"{self._lease.shard_id}.*")):
            if older.name < self.path.name:
                self._adopt(older)
                shutil.rmtree(older, ignore_errors=True)
        return self.finished()

    def finished(self) -> tuple[VideoResult, ...]:
        """Videos of this lease whose artifacts are complete here, in plan order."""
        results = []
        for video in self._lease.videos:
            stored = _read_json(self._result_path(video.key))
            if stored is not None and all((self.artifacts / name).is_file() for name in stored["files"]):
                results.append(VideoResult.from_json(stored["result"]))
        return tuple(results)

    def input_path(self, key: str, suffix: str) -> Path:
        """Where the input of a video is fetched to. Other inputs are removed."""
        return self.input_folder() / f"{key}{suffix}"

    def input_folder(self) -> Path:
        """An empty folder for what one video is made from."""
        return self._emptied("input")

    def staging(self) -> Path:
        """An empty folder for the artifacts of one video."""
        return self._emptied("staging")

    def keep(self, result: VideoResult) -> None:
        """Move the staged artifacts of a video to the finished ones and record it."""
        staged = self.path / "staging"
        files = sorted(str(path.relative_to(staged)) for path in staged.rglob("*") if path.is_file())
        for name in files:
            target = self.artifacts / name
            target.parent.mkdir(parents=True, exist_ok=True)
            (staged / name).replace(target)
        _write_json(self._result_path(result.key), {"result": result.to_json(), "files": files})

    def discard(self) -> None:
        """Remove the folder, and those of earlier leases of the shard."""
        for folder in self._root.glob(f"{self._lease.shard_id}.*"):
            if folder.name <= self.path.name:
                shutil.rmtree(folder, ignore_errors=True)

    def _adopt(self, older: Path) -> None:
        if _read_json(older / "shard.json") != self._identity():
            return
        adopted = 0
        for video in self._lease.videos:
            stored = _read_json(older / "results" / f"{video.key}.json")
            if stored is None or self._result_path(video.key).exists():
                continue
            if stored["result"]["status"] != VideoStatus.SUCCEEDED.value:
                continue  # Cheap to find out again, and this attempt may be luckier.
            try:
                for name in stored["files"]:
                    (self.artifacts / name).parent.mkdir(parents=True, exist_ok=True)
                    (older / "artifacts" / name).replace(self.artifacts / name)
            except OSError:
                continue  # Incomplete, or its old owner is still alive and took it away: computed again.
            _write_json(self._result_path(video.key), stored)
            adopted += 1
        if adopted:
            logger.info("took over %d finished videos of %s from an earlier attempt", adopted, self._lease.shard_id)

    def _identity(self) -> dict[str, str]:
        return {
            "version": package_version(),
            "plan_hash": self._lease.plan_hash,
            "config_hash": self._lease.spec.config_hash,
        }

    def _result_path(self, key: str) -> Path:
        return self.path / "results" / f"{key}.json"

    def _emptied(self, name: str) -> Path:
        folder = self.path / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder


def sweep(root: Path, max_age_s: float) -> None:
    """Remove shard folders in which nothing was finished for `max_age_s`: their shards ended elsewhere."""
    if not root.is_dir():
        return
    for folder in root.iterdir():
        try:
            newest = max((folder / name).stat().st_mtime for name in ("", "results", "staging", "input", "tars"))
        except OSError:
            continue  # Not a shard folder, or somebody else removes it right now.
        if time.time() - newest > max_age_s:
            shutil.rmtree(folder, ignore_errors=True)
            logger.info("removed the leftovers of %s", folder.name)


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        data = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def _write_json(path: Path, data: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    with partial.open("w") as file:
        json.dump(data, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
