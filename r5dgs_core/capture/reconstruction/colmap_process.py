"""Structure from motion in a process of its own, because pycolmap aborts on some errors.

    python -m r5dgs_core.capture.reconstruction.colmap_process JOB

JOB is a folder with `images/CAMERA/FRAME.png`, `masks/CAMERA/FRAME.png.png` (0: no features), `pairs.txt` and
`job.json`. The largest model is written to `JOB/sparse`, and the number of matches of each pair of images to
`JOB/matches.json`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

_FEATURES = 4096  # per image; the time of matching grows with the square
_SEED = 0


def main(folder: Path) -> None:
    """Extract, match and map the images of a job."""
    import pycolmap

    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(_SEED)
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    reader.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads = False, 1  # with more, the ids of images depend on the timing
    extraction.sift.max_num_features = _FEATURES
    extraction.sift.estimate_affine_shape = job["wide"]
    extraction.sift.peak_threshold = 0.004
    mode = pycolmap.CameraMode.SINGLE if job["shared"] else pycolmap.CameraMode.PER_FOLDER
    pycolmap.extract_features(
        database, folder / "images", camera_mode=mode, reader_options=reader, extraction_options=extraction
    )
    _set_lenses(database, job["lenses"])
    _match(database, folder, wide=job["wide"])
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.min_num_matches = 2, 12
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = _SEED
    options.num_threads = options.mapper.num_threads = 1
    options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 20, 12
    options.mapper.init_min_tri_angle = 4.0
    if job["lenses"]:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    (folder / "models").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, folder / "images", folder / "models", options=options)
    if models:
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        (folder / "sparse").mkdir(exist_ok=True)
        best.write_binary(str(folder / "sparse"))


def _set_lenses(database: Path, lenses: dict) -> None:
    """Replace the cameras of the database by known lenses, by folder of the images."""
    import pycolmap

    if not lenses:
        return
    with pycolmap.Database.open(database) as base:
        folders = {image.camera_id: image.name.rpartition("/")[0] for image in base.read_all_images()}
        for camera_id, folder in folders.items():
            known = lenses[folder]
            camera = pycolmap.Camera(
                camera_id=camera_id,
                model=known["model"],
                width=known["width"],
                height=known["height"],
                params=known["parameters"],
            )
            camera.has_prior_focal_length = True
            base.update_camera(camera)


def _match(database: Path, folder: Path, *, wide: bool) -> None:
    """Match the listed pairs, and write the number of inliers of each."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads, matching.guided_matching = False, 1, wide
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(folder / "pairs.txt")
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing, verification_options=verification
    )
    with pycolmap.Database.open(database) as base:
        names = {image.image_id: image.name for image in base.read_all_images()}
        inliers = []
        for pair, geometry in zip(*base.read_two_view_geometries(), strict=True):
            first, second = pair if isinstance(pair, tuple) else pycolmap.pair_id_to_image_pair(pair)
            inliers.append([names[first], names[second], len(geometry.inlier_matches)])
    (folder / "matches.json").write_text(json.dumps(inliers), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
