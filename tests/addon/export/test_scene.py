"""Load, edit, save, load again: the same objects in the same places at every time, and the same bits otherwise."""

import dataclasses
import importlib

import numpy as np
import pytest

from r5dgs_core.motion import models
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix, Quaternion  # noqa: E402  (bpy brings it)

TIMES = (0.0, 0.13, 0.35, 0.75, 0.85, 1.0)
MATRIX = Matrix.Translation((0.3, -0.2, 0.4)) @ Quaternion((0.6, 0.3, -0.5, 0.4)).normalized().to_matrix().to_4x4()


@pytest.fixture
def scene(tmp_path):
    made = scenes.make_scene(n=300, objects=3, sh_degree=2, seed=4, world_convention="colmap")
    return scene_file.read(scene_file.write(made, tmp_path / "scene.r5dgs"))


@pytest.fixture
def loaded(blender, scene, tmp_path):
    return motions.load_again(blender, tmp_path / "scene.r5dgs")


def save(bpy, path):
    assert bpy.ops.r5dgs.export_scene(filepath=str(path)) == {"FINISHED"}
    return scene_file.read(path)


def cloud(collection, name):
    return next(o for o in collection.all_objects if o.name == name and o.r5dgs.role == "CLOUD")


def places(bpy, collection, times=TIMES):
    """Positions of all Gaussians at each time in Blender, sorted by object and position at t_max."""
    result = []
    for t in times:
        frame = 1 + 60 * t
        bpy.context.scene.frame_set(int(frame + 1e-9), subframe=float((frame + 1e-9) % 1))
        graph, parts = bpy.context.evaluated_depsgraph_get(), {}
        for obj in sorted(collection.all_objects, key=lambda o: o.r5dgs.start):
            if obj.r5dgs.role != "CLOUD":
                continue
            points = np.empty(3 * len(obj.data.points), np.float32)
            obj.data.attributes["position"].data.foreach_get("vector", points)
            matrix = np.array(obj.evaluated_get(graph).matrix_world)
            key = obj.r5dgs.object_id, obj.r5dgs.motion_id
            parts.setdefault(key, []).append(points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
        result.append({key: np.concatenate(value) for key, value in parts.items()})
    return result


def by_object(shown):
    """Sorted coordinates of each object, whatever clouds it has."""
    result = {}
    for (object_id, _), points in shown.items():
        result.setdefault(object_id, []).append(points)
    return {object_id: np.sort(np.concatenate(parts), axis=0) for object_id, parts in result.items()}


def assert_same_motion(bpy, before, after, tolerance):
    for t, old, new in zip(TIMES, places(bpy, before), places(bpy, after), strict=True):
        old, new = by_object(old), by_object(new)
        assert set(old) == set(new)
        for object_id in old:
            np.testing.assert_allclose(new[object_id], old[object_id], atol=tolerance, err_msg=f"{object_id} at {t}")


@pytest.mark.parametrize("key_tolerance", [3e-6, 1e-3])
def test_an_unedited_scene_is_the_same_file(blender, tmp_path, key_tolerance):
    made = scenes.make_scene(n=300, objects=5, sh_degree=1, seed=7, world_convention="opengl")
    scene_file.write(made, tmp_path / "scene.r5dgs")
    motions.load(blender, tmp_path / "scene.r5dgs", key_tolerance=key_tolerance)
    blender.context.scene.frame_set(17, subframe=0.25)
    save(blender, tmp_path / "again.r5dgs")
    assert (tmp_path / "again.r5dgs").read_bytes() == (tmp_path / "scene.r5dgs").read_bytes()
    assert (blender.context.scene.frame_current, blender.context.scene.frame_subframe) == (17, 0.25)


def test_exported_scene_keeps_transforms_of_clouds_anchors_and_parents(blender, scene, loaded, tmp_path):
    cloud(loaded, "mug").matrix_local = MATRIX @ Matrix.Scale(1.6, 4)
    handle = blender.data.objects.new("handle", None)
    handle.matrix_world = MATRIX.inverted() @ Matrix.Scale(0.5, 4)
    blender.context.scene.collection.objects.link(handle)
    anchor = cloud(loaded, "red apple").parent
    root = anchor.parent
    anchor.parent = handle
    handle.parent = root
    blender.context.view_layer.update()
    saved = save(blender, tmp_path / "b.r5dgs")
    assert [group.model.kind for group in saved.groups] == [group.model.kind for group in scene.groups]
    np.testing.assert_array_equal(saved.tracks.poses[1], scene.tracks.poses[1])
    assert_same_motion(blender, loaded, motions.load(blender, tmp_path / "b.r5dgs"), 3e-5 * scene.extent)


def test_edited_curves_survive_export(blender, scene, loaded, tmp_path):
    anchor = cloud(loaded, "red apple").parent
    for frame, place in ((1, (2, 0, 0)), (20, (2, 1, 0)), (46, (0, 0, 1.0))):
        anchor.location = place
        anchor.keyframe_insert("location", frame=frame)
    saved = save(blender, tmp_path / "b.r5dgs")
    changed = [g for g in range(len(scene.groups)) if (saved.tracks.poses[g] != scene.tracks.poses[g]).any()]
    assert changed == [2]
    again = motions.load(blender, tmp_path / "b.r5dgs")
    for k, t in enumerate(scene.tracks.times):
        frame = 1 + 60 * t
        blender.context.scene.frame_set(int(frame), subframe=float(frame % 1))
        old, new = (cloud(c, name).matrix_world for c, name in ((loaded, "red apple"), (again, "red apple.001")))
        bind = np.array(old) @ np.linalg.inv(bind_of(blender, loaded, "red apple"))
        found = np.array(new) @ np.linalg.inv(bind_of(blender, again, "red apple.001"))
        blender.context.scene.frame_set(int(frame), subframe=float(frame % 1))
        np.testing.assert_allclose(found, bind, atol=3e-5 * scene.extent, err_msg=str(k))


def bind_of(bpy, collection, name):
    frame, subframe = bpy.context.scene.frame_current, bpy.context.scene.frame_subframe
    bpy.context.scene.frame_set(46)
    result = np.array(cloud(collection, name).matrix_world)
    bpy.context.scene.frame_set(frame, subframe=subframe)
    return result


def test_edited_physics_become_the_model_of_the_new_file(blender, scene, loaded, tmp_path):
    physics = importlib.import_module("r5dgs.r5dgs_addon.motion.physics")
    extrapolate = importlib.import_module("r5dgs.r5dgs_addon.motion.extrapolate")
    anchor = cloud(loaded, "red apple").parent
    physics.set_fields(anchor.r5dgs_motion, models.MotionModel("translation", velocity=(0.2, 0.4, 1.0)))
    extrapolate.re_extrapolate([anchor])
    saved = save(blender, tmp_path / "b.r5dgs")
    model = saved.groups[2].model
    assert model.kind == "translation" and model.velocity == pytest.approx((0.2, 0.4, 1.0))
    np.testing.assert_array_equal(saved.tracks.poses, scene.tracks.poses)
    assert_same_motion(blender, loaded, motions.load(blender, tmp_path / "b.r5dgs"), 3e-5 * scene.extent)


EDITS = {
    "drag": {"velocity": (1.5, 0.5, 0), "acceleration": (0, 0, -2), "angular_velocity": (0, 3, 1), "damping": 4.0},
    "friction": {"velocity": (0.8, 0.4, 0), "angular_velocity": (2, 0, 1), "stop_time": 0.13},
    "precession": {"angular_velocity": (0, 1, 9), "precession": (0, 0, 4), "center_offset": (0.1, 0, -0.2)},
    "bounce": {
        "velocity": (0.4, 0.1, 0.3),
        "acceleration": (0, 0, -15),
        "angular_velocity": (1, 2, 0),
        "bounce_time": 0.0637,
        "restitution": 0.7,
    },
    "two_oscillations": {
        "velocity": (0.5, 0, 0),
        "acceleration": (0, 0, 2),
        "angular_velocity": (1, 0, 0),
        "angular_acceleration": (0, 2, 0),
        "frequency": 9.0,
        "second_velocity": (0, 0.7, 0),
        "second_acceleration": (1, 0, 0),
        "second_angular_velocity": (0, 0, 2),
        "second_angular_acceleration": (0, 5, 0),
        "second_frequency": 15.0,
    },
}


@pytest.mark.parametrize("kind", EDITS)
@pytest.mark.parametrize("size", [1.0, 1.5])
def test_an_edited_motion_of_any_kind_plays_in_the_new_file_as_in_blender(blender, scene, loaded, tmp_path, kind, size):
    anchor = cloud(loaded, "mug").parent
    state, units = anchor.r5dgs_motion, motions.addon("motion.motion_fields")
    if size != 1:
        handle = blender.data.objects.new("handle", None)
        handle.matrix_world = MATRIX @ Matrix.Scale(size, 4)
        blender.context.scene.collection.objects.link(handle)
        handle.parent, anchor.parent = anchor.parent, handle
        blender.context.view_layer.update()
    motions.choose(blender, anchor)
    state.kind, state.frequency = kind, 0.0
    state.acceleration = state.angular_acceleration = state.angular_velocity = (0, 0, 0)
    for name, value in EDITS[kind].items():
        vector = name in units.VECTORS
        power = models.FIELDS[name].per_time
        factor = units.units_per_second(state) ** power
        turns = 2 * np.pi if name.endswith("frequency") else 1.0
        setattr(state, name, np.array(value) * factor if vector else value * factor / turns)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    saved = save(blender, tmp_path / "b.r5dgs")
    model = saved.groups[1].model
    assert model.kind == kind and set(models.KINDS[kind].fields) == set(EDITS[kind])
    assert saved.groups[1].history.band is None
    for name in set(EDITS[kind]) & set(models.SCALARS):
        assert getattr(model, name) == pytest.approx(EDITS[kind][name], rel=1e-5)
    kinks = scenes.T_MAX + models.kinks(model, 0.25)
    for t in (*np.linspace(scenes.T_MAX, 1, 17), *(kinks[:5] - 0.002), *(kinks[:5] + 0.002)):
        frame = 1 + 60 * min(t, 1.0)
        blender.context.scene.frame_set(int(frame), subframe=float(frame % 1))
        shown = motions.all_points(blender, loaded, len(scene.gaussians.means))
        played = scene_player.Player(saved).frame(min(t, 1.0)).means.astype(np.float64)
        played = played @ cameras.WORLD_TO_BLENDER[saved.world_convention].T
        for rows in (scene.gaussians.motion_ids == 1, scene.gaussians.motion_ids == 2):
            np.testing.assert_allclose(played[rows], shown[rows], atol=3e-5 * scene.extent, err_msg=str(t))


def test_names_colours_and_deletions_are_kept(blender, scene, loaded, tmp_path):
    cloud(loaded, "toy car").r5dgs_look.tint = (0.5, 1, 1)
    next(child for child in loaded.children if child.name == "red apple").name = "tomato"
    for obj in [o for o in loaded.all_objects if o.r5dgs.object_id == 1]:
        blender.data.objects.remove(obj)
    entry = next(e for e in loaded.r5dgs.table if e.object_id == 2)
    entry.aliases.add().name = "vegetable"
    saved = save(blender, tmp_path / "b.r5dgs")
    assert [item.id for item in saved.objects] == [-1, 0, 2, 3]
    assert saved.object(2).name == "tomato" and "vegetable" in saved.object(2).aliases
    colour = 0.5 + 0.28209479177387814 * scene.gaussians.sh[scene.gaussians.object_ids == 3, 0]
    found = 0.5 + 0.28209479177387814 * saved.gaussians.sh[saved.gaussians.object_ids == 3, 0]
    np.testing.assert_allclose(found, colour * (0.5, 1, 1), atol=2e-3)  # harmonics are stored in half precision


def test_a_duplicate_becomes_a_separate_object(blender, scene, loaded, tmp_path):
    blender.ops.object.select_all(action="DESELECT")
    anchor = cloud(loaded, "mug").parent
    anchor.select_set(True)
    blender.context.view_layer.objects.active = anchor
    assert blender.ops.r5dgs.duplicate_object() == {"FINISHED"}
    saved = save(blender, tmp_path / "b.r5dgs")
    assert len(saved.objects) == len(scene.objects) + 1
    copy = saved.objects[-1]
    assert copy.count == scene.object(1).count and copy.name not in {item.name for item in scene.objects}
    for t in TIMES:
        means = scene_player.Player(saved).frame(t).means
        shift = means[saved.gaussians.object_ids == copy.id] - means[saved.gaussians.object_ids == 1]
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=5e-5)


def test_hidden_objects_stay_in_the_file(blender, scene, loaded, tmp_path):
    cloud(loaded, "mug").hide_set(True)
    assert len(save(blender, tmp_path / "b.r5dgs").gaussians.means) == len(scene.gaussians.means)


def test_the_file_that_a_scene_plays_from_is_not_replaced(blender, loaded, tmp_path):
    before = (tmp_path / "scene.r5dgs").read_bytes()
    with pytest.raises(RuntimeError, match="another name"):
        blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "scene.r5dgs"))
    assert (tmp_path / "scene.r5dgs").read_bytes() == before


def test_export_without_the_scene_file_raises(blender, loaded, tmp_path):
    (tmp_path / "scene.r5dgs").rename(tmp_path / "elsewhere.r5dgs")
    with pytest.raises(RuntimeError, match="Scene File"):
        blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "b.r5dgs"))
    assert not (tmp_path / "b.r5dgs").exists()


def test_stopping_leaves_no_file_and_restores_the_frame(blender, loaded, tmp_path):
    module = importlib.import_module("r5dgs.r5dgs_addon.export.scene")
    blender.context.scene.frame_set(9)
    steps = module.steps(blender.context, loaded, tmp_path / "b.r5dgs")
    for _ in range(5):
        next(steps)
    steps.close()
    assert blender.context.scene.frame_current == 9
    assert [path.name for path in tmp_path.iterdir()] == ["scene.r5dgs"]


def test_export_reports_a_moved_root(blender, loaded, tmp_path, capsys):
    loaded.r5dgs.root.location = (1, 0, 0)
    blender.context.view_layer.update()
    save(blender, tmp_path / "b.r5dgs")
    assert "root was moved" in capsys.readouterr().out
    assert (tmp_path / "b.r5dgs").read_bytes() == (tmp_path / "scene.r5dgs").read_bytes()


def test_residuals_survive(blender, scene, tmp_path):
    rows, knots = np.array([120, 260], np.int32), len(scene.tracks.times)
    offsets = np.full((2, knots, 3), 0.05, np.float32) * np.linspace(1, 0, knots)[None, :, None].astype(np.float32)
    bent = scene.with_arrays(
        residual_rows=rows,
        residual_offsets=offsets,
        residual_log_scales=0 * offsets,
        residual_quats=np.tile(np.float32([1, 0, 0, 0]), (2, knots, 1)),
    )
    scene_file.write(bent, tmp_path / "bent.r5dgs")
    motions.load(blender, tmp_path / "bent.r5dgs")
    save(blender, tmp_path / "again.r5dgs")
    assert (tmp_path / "again.r5dgs").read_bytes() == (tmp_path / "bent.r5dgs").read_bytes()


def test_a_motion_copied_from_another_object_survives_export(blender, scene, loaded, tmp_path):
    mug, car = cloud(loaded, "mug").parent, cloud(loaded, "toy car").parent
    blender.ops.object.select_all(action="DESELECT")
    for anchor in (car, mug):
        anchor.select_set(True)
    blender.context.view_layer.objects.active = mug
    assert blender.ops.r5dgs.replace_motion() == {"FINISHED"}
    saved = save(blender, tmp_path / "b.r5dgs")
    assert saved.groups[3].model.kind == scene.groups[1].model.kind
    assert_same_motion(blender, loaded, motions.load(blender, tmp_path / "b.r5dgs"), 3e-5 * scene.extent)


@pytest.mark.parametrize("observed", [1, 4], ids=["still scene", "scene that begins late"])
def test_export_reports_motion_before_the_first_observed_time(blender, scene, tmp_path, capfd, observed):
    late = scene.with_arrays(track_times=scene.tracks.times[-observed:], track_poses=scene.tracks.poses[:, -observed:])
    if observed == 1:
        still = [dataclasses.replace(group, model=models.STATIC) for group in late.groups]
        late = dataclasses.replace(late, groups=tuple(still))
    collection = motions.load(blender, scene_file.write(late, tmp_path / "late.r5dgs"))
    first = blender.context.scene.frame_start
    assert first > 20
    blender.context.scene.frame_start = 1
    save(blender, tmp_path / "a.r5dgs")
    assert "first observed time" not in capfd.readouterr().out
    anchor = cloud(collection, "mug").parent
    blender.context.scene.frame_set(first)
    place = anchor.location.copy()
    for frame, x in ((5, 1.0), (20, 0.0)):
        anchor.location = (place[0] + x, place[1], place[2])
        anchor.keyframe_insert("location", frame=frame)
    anchor.location = place
    anchor.keyframe_insert("location", frame=first)
    save(blender, tmp_path / "b.r5dgs")
    said = capfd.readouterr().out
    assert f"mug: motion before frame {1 + 60 * late.tracks.times[0]:.4g}, the first observed time" in said
    assert "red apple" not in said


@pytest.mark.parametrize("scale", [(0.0, 0.0, 0.0), (1e-8, 1.0, 1.0)])
def test_objects_flattened_to_invisibility_are_not_exported(blender, loaded, scale, tmp_path):
    cloud(loaded, "mug").scale = scale
    visible = importlib.import_module("r5dgs.r5dgs_addon.engine.visible_clouds")
    _, seen = visible.instances(blender.context.evaluated_depsgraph_get())
    assert "mug" not in {one.object.name for one in seen}
    assert "mug" not in {item.name for item in save(blender, tmp_path / "b.r5dgs").objects}
