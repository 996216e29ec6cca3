"""One step of a COLMAP run, in a process of its own, so that it can be timed and killed: see `benchmarks.peers.colmap`.

    python -m benchmarks.peers.colmap_steps REQUEST.json

The request: `step` (`features` or the name of a mapper), `images` (folder), `names` (files in order), `work` (folder
that holds database.db), `out` (npz to write), `threads`, `seed`.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def main(argv: Sequence[str] | None = None) -> int:
    (path,) = sys.argv[1:] if argv is None else argv
    request: dict[str, Any] = json.loads(Path(path).read_text())
    if request["step"] == "features":
        _features(request)
    else:
        _map(request)
    return 0


def _features(request: dict[str, Any]) -> None:
    """SIFT features with one shared SIMPLE_RADIAL camera of unknown focal length, and sequential matching."""
    import pycolmap

    pycolmap.set_random_seed(request["seed"])
    database = Path(request["work"]) / "database.db"
    database.unlink(missing_ok=True)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = request["threads"]
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = request["threads"]
    pairing = pycolmap.SequentialPairingOptions()
    pairing.num_threads = request["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    pycolmap.extract_features(
        database,
        request["images"],
        request["names"],
        pycolmap.CameraMode.SINGLE,
        reader,
        extraction,
        pycolmap.Device.cpu,
    )
    pycolmap.match_sequential(database, matching, pairing, verification, pycolmap.Device.cpu)


def _map(request: dict[str, Any]) -> None:
    """The largest model of a mapper: `index` (M,) into the names, `world_from_cam` (M, 4, 4), `params` f cx cy k."""
    import pycolmap

    pycolmap.set_random_seed(request["seed"])
    work = Path(request["work"])
    threads, seed = request["threads"], request["seed"]
    database = work / "database.db"
    output = work / request["step"]
    output.mkdir(exist_ok=True)
    if request["step"] == "incremental":
        incremental = pycolmap.IncrementalPipelineOptions()
        incremental.num_threads = incremental.mapper.num_threads = threads
        incremental.random_seed = incremental.mapper.random_seed = incremental.triangulation.random_seed = seed
        models = pycolmap.incremental_mapping(database, request["images"], output, incremental)
    else:
        # The global mapper wants a focal length to begin with; this is COLMAP's own way to find one. It rewrites the
        # database, which the other mapper needs as it is.
        shutil.copyfile(database, calibrated := output / "calibrated.db")
        database = calibrated
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = seed
        pycolmap.calibrate_view_graph(database, calibration)
        options = pycolmap.GlobalPipelineOptions()
        mapper = options.mapper
        options.num_threads = mapper.num_threads = threads
        mapper.bundle_adjustment.ceres.solver_options.num_threads = threads
        options.random_seed = mapper.random_seed = seed
        mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = seed
        mapper.retriangulation.random_seed = seed
        mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
        models = pycolmap.global_mapping(database, request["images"], output, options)
    position = {name: index for index, name in enumerate(request["names"])}
    best = max(models.values(), key=lambda model: int(model.num_reg_images()), default=None)
    index, poses, params = [], [], np.zeros(4)
    if best is not None:
        for image_id in best.reg_image_ids():
            image = best.image(image_id)
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().inverse().matrix()
            index.append(position[image.name])
            poses.append(pose)
            params = np.asarray(best.camera(image.camera_id).params, dtype=np.float64)
    order = np.argsort(index).astype(np.int64)
    np.savez(
        request["out"],
        index=np.array(index, dtype=np.int64)[order],
        world_from_cam=np.array(poses, dtype=np.float64).reshape(-1, 4, 4)[order],
        params=params,
    )


if __name__ == "__main__":
    raise SystemExit(main())
