"""Add Shadows: meshes darken the Gaussians and Gaussians the meshes, where light is blocked, and nowhere else."""

import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from r5dgs_core.shapes import object_hulls
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
FRAME = 46  # t_max
FLOOR, BODY = 2500, 500


def cube_on_floor():
    """A scene with a gray floor of flat Gaussians, and a cube of Gaussians that floats at x = 1."""
    scene = scenes.make_scene(FLOOR + BODY, 1, unassigned=0, shadows=False, shading=False, identities=False)
    rng = np.random.default_rng(1)
    means, log_scales = np.zeros((FLOOR + BODY, 3)), np.full((FLOOR + BODY, 3), math.log(0.06))
    means[:FLOOR, :2] = np.stack(np.meshgrid(*2 * [np.linspace(-2, 2, 50)]), -1).reshape(-1, 2)
    log_scales[:FLOOR, 2] = math.log(0.004)
    means[FLOOR:] = rng.uniform(-0.25, 0.25, (BODY, 3)) + [1.0, 0, 0.8]
    ids = np.repeat([0, 1], [FLOOR, BODY]).astype(np.int32)
    gaussians = dataclasses.replace(
        scene.gaussians,
        means=means.astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (len(means), 1)),
        opacity_logits=np.full(len(means), 4.0, np.float32),
        sh=np.zeros((len(means), 1, 3), np.float32),
        object_ids=ids,
        motion_ids=ids,
    )
    table = [dataclasses.replace(o, start=FLOOR * o.id, count=(FLOOR, BODY)[o.id]) for o in scene.objects]
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], anchor_index=FLOOR))
    return dataclasses.replace(scene, gaussians=gaussians, objects=tuple(table), groups=groups)


@pytest.fixture
def scene(blender, tmp_path, monkeypatch):
    """The floor and cube, a ball of a mesh beside the cube, a card of a mesh below it, and a sun above, merged."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    for obj in list(blender.data.objects):
        blender.data.objects.remove(obj)
    blender.context.scene.world = None
    motions.load(blender, scene_file.write(cube_on_floor(), tmp_path / "cube.r5dgs"))
    blender.ops.mesh.primitive_uv_sphere_add(radius=0.3, location=(-1, 0, 0.8))
    blender.ops.mesh.primitive_plane_add(size=1.4, location=(1, 0, 0.15))
    blender.context.object.name = "card"
    blender.ops.object.light_add(type="SUN")
    blender.context.object.data.energy = 3.0
    blender.ops.object.camera_add(location=(0, -4.5, 4.5), rotation=(math.radians(48), 0, 0))
    scene = blender.context.scene
    scene.camera = blender.context.object
    scene.timeline_markers.clear()
    scene.frame_set(FRAME)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage, render.dither_intensity = 160, 120, 100, 0
    scene.view_settings.view_transform = "Standard"
    merge(blender)
    return scene


def merge(blender):
    assert blender.ops.r5dgs.merge_with_meshes() == {"FINISHED"}
    meshes = blender.context.scene.r5dgs_render.meshes
    meshes.cycles.samples, meshes.cycles.use_denoising = 32, False


def picture(blender, path):
    scene = blender.context.scene
    scene.render.filepath, scene.render.image_settings.file_format = str(path), "PNG"
    assert blender.ops.render.render(write_still=True) == {"FINISHED"}
    return images.read(path)[..., :3].mean(-1)


def pixel(scene, place):
    """Pixel of a point of Blender's world: column, row."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    x, y, _ = world_to_camera_view(scene, scene.camera, Vector(place))
    return int(x * scene.render.resolution_x), int((1 - y) * scene.render.resolution_y)


def patch(image, scene, place):
    """Mean of 5 x 5 pixels around a point of Blender's world."""
    x, y = pixel(scene, place)
    return image[y - 2 : y + 3, x - 2 : x + 3].mean()


def test_meshes_and_gaussians_cast_shadows_on_each_other(blender, scene, tmp_path):
    without = picture(blender, tmp_path / "without.png")
    assert blender.ops.r5dgs.add_shadows() == {"FINISHED"}
    found = picture(blender, tmp_path / "shadows.png")
    below_ball, below_cube = (-1, -0.1, 0), (1, -0.2, 0.15)
    assert patch(found, scene, below_ball) < 0.4 * patch(without, scene, below_ball)
    assert patch(found, scene, below_cube) < 0.5 * patch(without, scene, below_cube)
    for lit in ((-1, -0.8, 0), (0, 0, 0), (0.0, -1.2, 0), (1, -0.55, 0.15)):
        assert patch(found, scene, lit) == pytest.approx(patch(without, scene, lit), abs=0.03)


def test_shadows_follow_the_motion_of_objects(blender, scene, tmp_path):
    cube = next(obj for obj in blender.data.objects if obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id == 1)
    blender.ops.r5dgs.add_shadows()
    proxies = next(one for one in blender.data.collections if one.name.startswith("R5DGS Merge Shadows"))
    hull = next(obj for obj in proxies.objects if obj.parent == cube)
    assert 4 <= len(hull.data.vertices) <= 64
    meshes = scene.r5dgs_render.meshes
    for frame in (FRAME, FRAME + 20):
        scene.frame_set(frame)
        meshes.frame_set(frame)
        moved = np.array(hull.evaluated_get(meshes.view_layers[0].depsgraph).matrix_world)
        middle = np.mean([moved @ [*vertex.co, 1] for vertex in hull.data.vertices], 0)[:3]
        np.testing.assert_allclose(middle, motions.points(blender, cube).mean(0), atol=0.05)


def traces(blender):
    tree = motions.addon("compat").compositor(blender.context.scene)
    kinds = ("scenes", "collections", "objects", "meshes", "node_groups")
    return [sorted(one.name for one in getattr(blender.data, kind)) for kind in kinds] + [
        sorted(node.name for node in tree.nodes)
    ]


def test_stop_merging_undo_and_a_second_call_leave_nothing_behind(blender, scene):
    blender.ops.ed.undo_push(message="merged")
    before = traces(blender)
    blender.ops.r5dgs.add_shadows()
    blender.ops.ed.undo_push(message="shadows")
    after = traces(blender)
    assert after != before
    blender.ops.ed.undo()
    assert traces(blender) == before
    blender.ops.ed.redo()
    assert traces(blender) == after
    assert blender.ops.r5dgs.add_shadows() == {"FINISHED"}
    assert traces(blender) == after
    merge(blender)
    assert traces(blender) == before
    blender.ops.r5dgs.add_shadows()
    blender.ops.r5dgs.stop_merging()
    assert not [name for names in traces(blender) for name in names if "R5DGS Merge" in name or "proxy" in name]
    assert not blender.ops.r5dgs.add_shadows.poll()


@pytest.mark.slow
def test_shadows_survive_saving(blender, scene, tmp_path):
    blender.ops.r5dgs.add_shadows()
    before = picture(blender, tmp_path / "before.png")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shadows.blend"))
    blender.ops.wm.read_homefile(app_template="")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "shadows.blend"))
    np.testing.assert_array_equal(picture(blender, tmp_path / "after.png"), before)


def test_a_moving_camera_adds_surfaces_along_its_path(blender, scene):
    def surfaces():
        blender.ops.r5dgs.add_shadows()
        proxies = next(one for one in blender.data.collections if one.name.startswith("R5DGS Merge Shadows"))
        return sum(obj.parent is None for obj in proxies.objects)

    assert surfaces() == 1
    scene.camera.keyframe_insert("location", frame=scene.frame_start)
    scene.camera.location.x += 3
    scene.camera.keyframe_insert("location", frame=scene.frame_end)
    assert surfaces() > 2 and scene.frame_current == FRAME


def test_eevee_has_no_shadow_catcher(blender, scene):
    blender.ops.r5dgs.merge_with_meshes(engine=motions.addon("compat").EEVEE)
    assert not blender.ops.r5dgs.add_shadows.poll()


@pytest.mark.parametrize("stored", [True, False])
def test_each_body_has_one_hull_and_shadows_and_fringes_have_none(blender, tmp_path, stored):
    mixed = scenes.make_scene(n=900)
    motions_of, mug = mixed.gaussians.motion_ids.copy(), mixed.object(1)
    rows = np.arange(mug.start, mug.start + 60)
    motions_of[rows] = np.repeat([0, 2, 4], 20)
    rows = np.arange(mug.start, mug.start + mug.count)
    motions_of[rows] = np.sort(motions_of[rows])
    mixed = mixed.with_arrays(motion_ids=motions_of)
    if stored:
        mixed = dataclasses.replace(mixed, hulls=object_hulls.of(mixed))
    motions.load(blender, scene_file.write(mixed, tmp_path / "mixed.r5dgs"))
    blender.ops.r5dgs.merge_with_meshes()
    visible, shadows = motions.addon("engine.visible_clouds"), motions.addon("engine.mesh_shadows")
    _, clouds = visible.instances(blender.context.evaluated_depsgraph_get())
    assert {"mug still", "mug with red apple", "mug with mug shadow"} < {cloud.object.name for cloud in clouds}
    proxies = shadows.add(blender.context.scene, clouds, (), ())
    assert {proxy.parent.name for proxy in proxies.objects} == {"mug", "red apple", "toy car"}
    near = 1e-3 if stored else 0.1  # Blender encloses ellipsoids, baking has silhouettes
    for proxy in proxies.objects:
        hull = {h.object_id: h.vertices for h in object_hulls.of(mixed)}[proxy.parent.r5dgs.object_id]
        found = np.array([vertex.co for vertex in proxy.data.vertices])
        np.testing.assert_allclose(found.min(0), hull.min(0), atol=near)
        np.testing.assert_allclose(found.max(0), hull.max(0), atol=near)
