"""Meshes of glTF files are placed so that viewers that sort whole meshes draw the background first."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.formats import draw_order, glb, glb_reader, registry, scene_nodes
from tests.support import scenes

ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)


@pytest.fixture(scope="module")
def scene():
    made = scenes.make_scene(n=400, objects=4, sh_degree=1, world_convention="colmap")
    return dataclasses.replace(made, cameras=tuple(scenes.orbit_camera(angle) for angle in ANGLES))


def places(scene):
    """Origin of each piece's mesh in the world at t_max, and the piece."""
    pieces = scene_nodes.pieces(scene, None)
    origins = draw_order.origins(scene, pieces)
    return [(scene.groups[one.group].home + origin, one) for one, origin in zip(pieces, origins, strict=True)]


@pytest.mark.parametrize("number", range(len(ANGLES)))
def test_the_background_comes_first_then_shadows_then_objects(scene, number):
    forward = scene.cameras[number].forward
    depths = {"ground": [], "shadows": [], "objects": []}
    for place, piece in places(scene):
        role = scene.groups[piece.group].role
        kind = "shadows" if role == "shadow" else "objects" if piece.object_id > 0 else "ground"
        depths[kind].append(float(place @ forward))
    assert min(depths["ground"]) > max(depths["shadows"]) and min(depths["shadows"]) > max(depths["objects"])
    assert all(depths.values())


def test_a_resting_object_is_drawn_by_its_own_place(scene):
    rows = scene.gaussians.object_ids == 2
    resting = scene.with_arrays(motion_ids=np.where(rows, 0, scene.gaussians.motion_ids).astype(np.int32))
    ((place, _),) = [found for found in places(resting) if found[1].object_id == 2]
    np.testing.assert_allclose(place, np.median(scene.gaussians.means[rows], axis=0), atol=1e-6)


@pytest.mark.parametrize(
    "views", [(), tuple(scenes.looking_camera((0, 0, 0), d, 1.0, 8, 8) for d in ((1, 0, 0), (-1, 0, 0)))]
)
def test_without_a_common_direction_nothing_is_moved(scene, views):
    around = dataclasses.replace(scene, cameras=views)
    for place, piece in places(around):
        np.testing.assert_array_equal(place, scene.groups[piece.group].home)


def test_the_file_plays_and_is_read_as_before(scene, tmp_path):
    (path,) = glb.export(scene, tmp_path / "scene.glb", registry.Options((0.0,)))
    again = glb_reader.read(path)
    order = np.lexsort((scene.gaussians.motion_ids, scene.gaussians.object_ids))
    np.testing.assert_allclose(again.gaussians.means, scene.gaussians.means[order], atol=1e-6 * scene.extent)


@pytest.mark.parametrize("wrong", [3, [0, 1], ["a", 0, 0], [True, 0, 0]])
def test_a_damaged_place_is_named(scene, tmp_path, monkeypatch, wrong):
    build = glb.build

    def damaged(*arguments):
        content, arrays = build(*arguments)
        node = next(node for node in content["nodes"] if "mesh" in node and "translation" in node)
        node["translation"] = wrong
        return content, arrays

    monkeypatch.setattr(glb, "build", damaged)
    (path,) = glb.export(scene, tmp_path / "scene.glb", registry.Options((0.0,)))
    with pytest.raises(errors.SceneFileError, match="translation: expected three numbers"):
        glb_reader.read(path)
