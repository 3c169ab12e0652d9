"""Hulls, MuJoCo models and URDF: read back by trimesh and MuJoCo, which replays free flight."""

import dataclasses
import itertools
from xml.etree import ElementTree

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.formats import ground, hulls, mjcf, registry, rigid_bodies, urdf
from r5dgs_core.motion import rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import cameras
from r5dgs_core.scene.units import Units
from r5dgs_core.shapes import object_hulls, solid
from tests.support import contact_scenes, scenes, solid_gaussians

MODEL = MotionModel(
    "ballistic_spin", velocity=[0.5, 0.2, 1.0], acceleration=[0, 0, -3.0], angular_velocity=[0.4, -1.0, 2.0]
)
OPTIONS = registry.Options((scenes.T_MAX,))


@pytest.fixture(scope="module")
def thrown():
    """A ball that was thrown, as the only object."""
    scene = scenes.make_scene(n=900, objects=1, shadows=False)
    ball = scene.object(1)
    means = scene.gaussians.means.copy()
    radius, center = 0.2, scene.groups[1].pivot
    means[ball.start : ball.start + ball.count] = solid_gaussians.ball(radius, ball.count, center)[0]
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], model=MODEL))
    scene = dataclasses.replace(scene.with_arrays(means=means), groups=groups)
    return dataclasses.replace(scene, hulls=object_hulls.of(scene))


def turned(scene, world):
    """The scene as measured in another world."""
    turn = cameras.WORLD_TO_BLENDER[world].T
    groups = tuple(
        dataclasses.replace(group, pivot=turn @ group.pivot, model=group.model.transformed(turn, 1.0))
        for group in scene.groups
    )
    own = tuple(dataclasses.replace(hull, vertices=hull.vertices @ turn.T) for hull in scene.hulls)
    poses = scene.tracks.poses.copy()
    poses[..., 1:4], poses[..., 4:] = poses[..., 1:4] @ turn.T, poses[..., 4:] @ turn.T
    tracks = dataclasses.replace(scene.tracks, poses=poses)
    return dataclasses.replace(scene, world_convention=world, groups=groups, hulls=own, tracks=tracks)


def posed(scene, t):
    """Vertices of the hulls at a time, world."""
    quats, moves = Player(scene).group_poses(t)
    for hull in scene.hulls:
        pivot, g = scene.groups[hull.motion_id].pivot, hull.motion_id
        yield pivot + rotations.rotate(quats[g], hull.vertices - pivot) + moves[g]


def extremes(points):
    return np.array([points.min(0), points.max(0)])


@pytest.mark.parametrize("t", [0.2, scenes.T_MAX, 1.1])
def test_trimesh_reads_the_hulls_at_a_time_in_metres(tmp_path, t):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed; it comes with the extra 'test'")
    scene = dataclasses.replace(scenes.make_scene(n=900), units=Units(meters_per_unit=2.0))
    scene = dataclasses.replace(scene, hulls=object_hulls.of(scene))
    (path,) = hulls.export(scene, tmp_path / "a.glb", registry.Options((t,)))
    loaded = trimesh.load_scene(path)
    assert set(loaded.geometry) == {"mug", "red apple", "toy car"}
    for name, expected in zip(("mug", "red apple", "toy car"), posed(scene, t), strict=True):
        node, geometry = loaded.graph[name]
        mesh = loaded.geometry[geometry].copy().apply_transform(node)
        assert mesh.is_watertight and mesh.is_convex
        found = np.asarray(mesh.vertices) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        np.testing.assert_allclose(extremes(found), 2 * extremes(expected), atol=1e-5)
        assert mesh.volume == pytest.approx(8 * solid.of(expected).volume, rel=1e-4)


@pytest.mark.parametrize("world", ["blender", "colmap"])
@pytest.mark.parametrize("units", [Units(), Units(seconds_per_unit=2.0, meters_per_unit=0.5)])
def test_mujoco_continues_the_flight_as_playback_does(thrown, tmp_path, world, units):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    scene = dataclasses.replace(turned(thrown, world), units=units)
    (path,) = mjcf.export(scene, tmp_path / "a.xml", OPTIONS)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    seconds, meters = units.seconds_per_unit or 1.0, units.meters_per_unit or 1.0
    turn = cameras.WORLD_TO_BLENDER[world]
    size = meters * solid.of(scene.hulls[0].vertices).size
    corners = meters * (scene.hulls[0].vertices - scene.groups[1].pivot) @ turn.T
    for later in (0.0, 0.2, 0.6):
        while data.time < seconds * later - 1e-9:
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        (expected,) = posed(scene, scenes.T_MAX + data.time / seconds)
        found = data.xpos[1] + corners @ data.xmat[1].reshape(3, 3).T
        error = np.abs(data.xpos[1] - meters * (expected.mean(0) - _offset(scene, data.time / seconds)) @ turn.T).max()
        assert error < 1e-3 * size
        np.testing.assert_allclose(found, meters * expected @ turn.T, atol=0.02 * size)  # no perfect ball precesses


def _offset(scene, span):
    """Mean of the vertices of the hull relative to the pivot, a time after t_max."""
    quat = rotations.rotvecs_to_quats(scene.groups[1].model.angular_velocity * span)
    return rotations.rotate(quat, scene.hulls[0].vertices.mean(0) - scene.groups[1].pivot)


def test_a_body_off_the_centre_has_the_velocity_of_its_centre_of_mass(tmp_path):
    scene = scenes.make_scene(n=900, objects=4)
    bodies = rigid_bodies.of(scene, scenes.T_MAX, OPTIONS)
    for body, hull in zip(bodies, object_hulls.of(scene), strict=True):
        group = scene.groups[hull.motion_id]
        steady = dataclasses.replace(group.model, offset_rotvec=np.zeros(3), offset_displacement=np.zeros(3))
        calm = dataclasses.replace(
            scene,
            groups=tuple(dataclasses.replace(one, model=steady) if one is group else one for one in scene.groups),
        )
        step, places = 1e-4, []
        for t in (scenes.T_MAX, scenes.T_MAX + step):
            quats, moves = Player(calm).group_poses(t)
            arm = rotations.rotate(quats[group.id], body.position - group.pivot)
            places.append(group.pivot + arm + moves[group.id])
        np.testing.assert_allclose(body.velocity, (places[1] - places[0]) / step, atol=1e-3)


def test_mujoco_reads_urdf_with_the_same_bodies(thrown, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    scene = dataclasses.replace(scenes.make_scene(n=900), units=Units(meters_per_unit=2.0))
    options = registry.Options((0.3,))
    bodies = rigid_bodies.of(scene, 0.3, options)
    paths = list(urdf.export(scene, tmp_path / "a.urdf", options))
    assert paths == urdf.FORMAT.paths(tmp_path / "a.urdf", options, scene)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    model = mujoco.MjModel.from_xml_path(str(paths[-1]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.nq == 7 * sum(body.moves for body in bodies) == 21
    for body in bodies:
        row = model.body(body.name).id
        np.testing.assert_allclose(data.xipos[row], body.position, atol=1e-6)
        np.testing.assert_allclose(data.xmat[row].reshape(3, 3), rotations.quats_to_rotmats(body.quat), atol=1e-6)
        assert model.body_mass[row] == pytest.approx(body.mass)
        moments = np.linalg.eigvalsh(body.inertia)
        np.testing.assert_allclose(np.sort(model.body_inertia[row]), moments, rtol=1e-5)
    np.testing.assert_allclose(model.opt.gravity, rigid_bodies.gravity(scene), atol=1e-9)


@pytest.mark.parametrize("angles", [*itertools.product([0.0, 0.7, -2.5], [0.3, np.pi / 2, -np.pi / 2], [0.0, 1.9])])
def test_roll_pitch_and_yaw_are_those_of_urdf(angles):
    turns = [rotations.rotvecs_to_quats(angle * np.eye(3)[axis]) for axis, angle in enumerate(angles)]
    quat = rotations.multiply(turns[2], rotations.multiply(turns[1], turns[0]))
    again = [rotations.rotvecs_to_quats(a * np.eye(3)[axis]) for axis, a in enumerate(urdf._roll_pitch_yaw(quat))]
    back = rotations.multiply(again[2], rotations.multiply(again[1], again[0]))
    assert rotations.angle_between(quat, back) < 1e-6


def test_gravity_has_the_units_and_axes_of_the_file_and_is_zero_if_unknown(thrown):
    scene = dataclasses.replace(turned(thrown, "colmap"), units=Units(seconds_per_unit=2.0, meters_per_unit=0.5))
    np.testing.assert_allclose(rigid_bodies.gravity(scene), MODEL.acceleration * 0.5 / 2.0**2, atol=1e-9)
    still = dataclasses.replace(
        thrown, groups=tuple(dataclasses.replace(one, model=MotionModel()) for one in thrown.groups)
    )
    assert not rigid_bodies.gravity(still).any()
    assert any("gravity is unknown" in line for line in mjcf.FORMAT.losses(still, OPTIONS))


def test_objects_without_a_hull_are_named_and_refused_if_no_other_is_left():
    scene = scenes.make_scene(n=900)
    logits = np.where(scene.gaussians.object_ids == 2, -8, scene.gaussians.opacity_logits).astype(np.float32)
    faint = scene.with_arrays(opacity_logits=logits)
    assert {body.name for body in rigid_bodies.of(faint, 0.3, OPTIONS)} == {"mug", "toy car"}
    assert "objects without a hull: red apple" in hulls.FORMAT.losses(faint, OPTIONS)
    with pytest.raises(errors.ConfigError, match="expected objects with enough Gaussians for a hull, found none"):
        rigid_bodies.of(faint, 0.3, registry.Options((0.3,), object_ids=frozenset({2})))


def test_objects_with_a_flat_hull_are_left_out_and_named():
    scene = scenes.make_scene(n=900)
    flat, *others = object_hulls.of(scene)
    flat = dataclasses.replace(flat, vertices=flat.vertices * [1, 1, 0])
    made = dataclasses.replace(scene, hulls=(flat, *others))
    assert {body.name for body in rigid_bodies.of(made, 0.3, OPTIONS)} == {"red apple", "toy car"}
    assert hulls.FORMAT.losses(made, OPTIONS) == ["objects with a flat hull: mug"]


def test_an_object_named_world_gets_another_name(thrown):
    items = tuple(dataclasses.replace(item, name="world") if item.id == 1 else item for item in thrown.objects)
    (body,) = rigid_bodies.of(dataclasses.replace(thrown, objects=items), 0.3, OPTIONS)
    assert body.name == "world 2"


def test_urdf_has_a_file_for_each_frame_and_meshes_for_all(thrown, tmp_path):
    options = registry.Options((0.3, 0.5), (19, 31))
    paths = list(urdf.export(thrown, tmp_path / "a.urdf", options))
    assert [path.name for path in paths] == ["a_0_mug.obj", "a_0019.urdf", "a_0031.urdf"]
    assert paths == urdf.FORMAT.paths(tmp_path / "a.urdf", options, thrown)
    (body,) = rigid_bodies.of(thrown, 0.5, options)
    origin = ElementTree.parse(paths[2]).find("joint/origin")
    np.testing.assert_allclose([float(part) for part in origin.get("xyz").split()], body.position, rtol=1e-9)


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_a_thrown_box_lands_on_the_ground_under_the_one_that_rests(tmp_path, kind):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    boxes = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting(2.0))
    boxes = dataclasses.replace(boxes, units=Units(meters_per_unit=2.0))
    *_, path = registry.get(kind).write(boxes, tmp_path / f"a{registry.get(kind).suffix}", registry.Options((0.6,)))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    if kind == "mjcf":
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, int(3 / model.opt.timestep))
    half = contact_scenes.SIZE  # of 0.4 units of 2 m each
    height = data.xpos[model.body("box 1").id][2]
    assert 0.9 * half < height < 1.8 * half and np.abs(data.qvel).max() < 0.05
    assert ground.LOSS in registry.get(kind).losses(boxes, OPTIONS)


def test_the_files_have_the_friction_and_restitution_that_contacts_were_simulated_with(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    boxes = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting(2.0))
    row = {"object": "mug", "object_id": boxes.objects[1].id, "name": "contact", "decision": "on"}  # box 1, renamed
    row |= {"friction": 0.17, "restitution": 0.62}
    boxes = dataclasses.replace(boxes, needs=(row,))
    (path,) = mjcf.export(boxes, tmp_path / "a.xml", registry.Options((0.6,)))
    model = mujoco.MjModel.from_xml_path(str(path))
    frictions = {model.geom(k).name: model.geom_friction[k, 0] for k in range(model.ngeom)}
    assert frictions == {rigid_bodies.GROUND: 0.0, "box 1": 0.17, "box 2": rigid_bodies.FRICTION}
    *_, path = urdf.export(boxes, tmp_path / "a.urdf", registry.Options((0.6,)))
    links = {link.get("name"): link.find("contact") for link in ElementTree.parse(path).findall("link")}
    first, second = ({one.tag: float(one.get("value")) for one in links[name] or ()} for name in ("box 1", "box 2"))
    assert first == {"lateral_friction": 0.17, "restitution": 0.62}
    assert second == {"lateral_friction": rigid_bodies.FRICTION}


def test_the_ground_is_below_all_observed_places_and_missing_if_nothing_rests(thrown):
    resting, flying = contact_scenes.resting(2.0), contact_scenes.falling(height=0.1)
    scene = contact_scenes.scene(flying, resting)
    assert ground.height(scene, scene.hulls[1:]) == pytest.approx(0.0, abs=1e-9)
    lowest = min(float(corners[:, 2].min()) for corners in posed(scene, scene.t_max))
    assert ground.height(scene, scene.hulls) == pytest.approx(lowest) and lowest < -0.05
    assert ground.height(thrown, thrown.hulls) is None and ground.MISSING in mjcf.FORMAT.losses(thrown, OPTIONS)


def test_objects_that_never_move_are_fixed_unless_they_stand_on_the_ground():
    boxes = [contact_scenes.falling(), contact_scenes.resting(1.0), contact_scenes.resting(2.0)]
    lamp = contact_scenes.with_hull(contact_scenes.scene(*boxes), 3, [2.0, 0.2, 1.5], [0.4, 0.4, 0.4])
    assert [body.moves for body in rigid_bodies.of(lamp, lamp.t_max, OPTIONS)] == [True, True, False]
