"""Exports of scenes with simulated contacts: MuJoCo models repeat the simulation, other files hold playback."""

import dataclasses
import itertools
from xml.etree import ElementTree

import numpy as np
import pytest

from r5dgs_core.bake import contact
from r5dgs_core.contact import scene_future, scene_world
from r5dgs_core.formats import mjcf, registry, rigid_bodies
from r5dgs_core.motion import rotations
from r5dgs_core.scene.units import Units
from r5dgs_core.shapes import directions
from tests.support import contact_scenes

T_MAX = contact_scenes.TIMES[-1]
OPTIONS = registry.Options((T_MAX,))


def simulated_boxes(**changes):
    """A box that falls and one whose foot was pressed flat, with rows of a simulation that starts off playback."""
    boxes = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting(2.0))
    model = dataclasses.replace(boxes.groups[1].model, offset_displacement=[0.1, 0, 0], offset_rotvec=[0, 0.2, 0])
    numbers = {"normal": [0, 0, 1], "height": 0.0, "solref": [-1e4, -50.0], "solreffriction": [-1e4, -90.0]}
    numbers |= {"timestep": 2e-3, "flat_foot": False} | changes
    rows = [
        {"name": "contact", "object_id": number, "friction": 0.2, "simulation": {**numbers, **own}}
        for number, own in ((1, {}), (2, {"flat_foot": True}))
    ]
    groups = (boxes.groups[0], dataclasses.replace(boxes.groups[1], model=model), boxes.groups[2])
    return dataclasses.replace(boxes, groups=groups, needs=tuple(rows))


def without_simulation(scene):
    return dataclasses.replace(scene, needs=tuple({**row, "simulation": None} for row in scene.needs))


@pytest.mark.parametrize("t", [0.3, T_MAX, 0.7])
def test_bodies_have_the_shapes_and_states_of_their_simulation_only_from_t_max_on(t):
    scene, differences = simulated_boxes(), []
    bodies = rigid_bodies.of(scene, t, OPTIONS, as_simulated=True)
    for found, played in zip(bodies, rigid_bodies.of(scene, t, OPTIONS), strict=True):
        own, plain = (one.position + rotations.rotate(one.quat, one.solid.vertices) for one in (found, played))
        differences.append(float(np.abs(np.sort(own, axis=0)[[0, -1]] - np.sort(plain, axis=0)[[0, -1]]).max()))
    assert max(differences) == 0 if t < T_MAX else min(differences) > 0.005
    assert [body.contacts is None for body in bodies] == [False, t < T_MAX]


@pytest.mark.parametrize("kind", ["hulls", "urdf"])
def test_hulls_and_urdf_hold_playback_and_no_simulation(kind, tmp_path):
    simulated, made, files = simulated_boxes(), registry.get(kind), []
    for name, scene in (("a", simulated), ("b", without_simulation(simulated))):
        (tmp_path / name).mkdir()
        paths = made.write(scene, tmp_path / name / f"boxes{made.suffix}", registry.Options((T_MAX,)))
        files.append({path.name: path.read_bytes() for path in paths})
    assert files[0] == files[1]


UNSOUND = [
    {"normal": [0, 0, 0]},
    {"normal": [[0], [0], [1], [0]]},
    {"normal": [0, 0, 10**400]},
    {"timestep": float("nan")},
    {"timestep": 0.0},
    {"height": float("inf")},
    {"solref": [0.02, 1.0]},
    {"solreffriction": [-1e4, float("nan")]},
]


@pytest.mark.parametrize("changes", UNSOUND)
def test_rows_that_mujoco_cannot_simulate_are_ignored(changes, tmp_path):
    scene, files = simulated_boxes(**changes), []
    for name, made in (("a", scene), ("b", without_simulation(scene))):
        (path,) = mjcf.export(made, tmp_path / f"{name}.xml", OPTIONS)
        files.append(path.read_text())
    assert files[0] == files[1] and "solref" not in files[0]


def test_the_ground_of_a_body_has_a_name_of_its_own(tmp_path):
    scene = simulated_boxes()
    names = {1: "ground of box 2", 2: "box 2"}
    items = tuple(dataclasses.replace(item, name=names.get(item.id, item.name)) for item in scene.objects)
    (path,) = mjcf.export(dataclasses.replace(scene, objects=items), tmp_path / "a.xml", OPTIONS)
    geometries = [geom.get("name") for geom in ElementTree.parse(path).findall("worldbody//geom")]
    assert len(geometries) == len({*geometries}) == 5 and {"ground of box 2", "ground of box 2 2"} < {*geometries}


def bouncing_ball():
    """A ball in free fall, as a motion and a hull."""
    model, place = contact_scenes.falling()
    scene = contact_scenes.scene((model, place))
    ball = place + 0.5 * contact_scenes.SIZE * directions.sphere(64)
    return dataclasses.replace(scene, hulls=(dataclasses.replace(scene.hulls[0], vertices=ball),))


def sliding_pair():
    """A box that slides into one that rests."""
    return contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.8))


def above_a_table(made):
    """The body of a scene above a static object, which is part of the background's motion."""
    both = contact_scenes.scene((made.groups[1].model, made.groups[1].pivot), contact_scenes.resting(0.1))
    table = contact_scenes.with_hull(both, 2, [0.1, 0.2, 0.05], [1.6, 1.0, 0.3]).hulls[1]
    return dataclasses.replace(both, hulls=(made.hulls[0], dataclasses.replace(table, motion_id=0)))


def falling_box():
    return contact_scenes.scene(contact_scenes.falling())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "until"),
    [
        (falling_box, 0.45),  # a tumbling box amplifies rounding errors at each impact
        (bouncing_ball, 1.0),
        (sliding_pair, 0.35),  # the sliding box rattles, which amplifies them, too
        (lambda: above_a_table(falling_box()), 0.35),
        (lambda: above_a_table(bouncing_ball()), 1.0),
    ],
    ids=["box", "ball", "pair", "box and table", "ball and table"],
)
def test_mujoco_replays_the_simulated_contacts_of_the_file(make, until, tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    scene = dataclasses.replace(make(), units=Units(seconds_per_unit=0.7, meters_per_unit=1.2))  # g = 4.0
    found = scene_future.predict(scene, scene_world.Wishes(samples=1, materials={1: (None, 0.6)}))
    expected, fixed = found.recording, [shape.fixed for shape in found.world.world.bodies]
    bodies = [(number, body) for number, body in enumerate(found.world.bodies) if not fixed[number]]
    assert {body.name for _, body in bodies} == found.taken.keys()
    assert any(touch.change and {*touch.bodies} >= ({0, 1} if any(fixed) else {0}) for touch in expected.touches)
    assert expected.touches[0].time < 0.8 * until
    scene = dataclasses.replace(scene, groups=found.groups, needs=contact.needs((), found))
    (path,) = mjcf.export(scene, tmp_path / "a.xml", registry.Options((scene.t_max,)))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    assert model.opt.timestep == pytest.approx(0.7 * np.diff(expected.times)[0], rel=1e-9)
    steps = np.linspace(0, np.searchsorted(expected.times, until), 16).astype(int)
    for before, row in itertools.pairwise(steps):
        mujoco.mj_step(model, data, row - before)
        for number, body in bodies:
            place = data.qpos[model.jnt_qposadr[model.joint(body.name).id] :][:3] / 1.2
            apart = np.linalg.norm(place - expected.places[row, number])
            assert apart < 1e-3 * contact_scenes.SIZE, (body.name, expected.times[row])
