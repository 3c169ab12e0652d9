"""Animated glTF files: their content by an own reader of glTF, and the way back to a scene."""

from __future__ import annotations

import dataclasses
import json
import re
import struct

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli import main
from r5dgs_core.formats import glb, glb_reader, registry
from r5dgs_core.motion import models, rotations
from r5dgs_core.playback import played_splats
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import cameras, scene_file, spherical_harmonics
from r5dgs_core.scene.scene import Residuals, Shading
from r5dgs_core.scene.units import Units
from tests.support import arms, player, scenes
from tests.support.command_line import complaint

EXTENSION = "KHR_gaussian_splatting"
TIMES = (0.0, 0.021, 0.1, 0.333, 0.61, scenes.T_MAX, 0.79, 0.97, 1.21)
OPTIONS = registry.Options((0.0,), until=1.3)
Y_UP = {"blender": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "colmap": np.diag([1, -1, -1]), "opengl": np.eye(3)}


class Gltf:
    """A file as glTF's text describes it; shares no code with the package."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
        assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
        self.tree = json.loads(data[20 : 20 + length])
        self.binary = data[28 + length :]

    def array(self, number):
        entry = self.tree["accessors"][number]
        view = self.tree["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
        kind = {5126: "<f4", 5121: "<u1"}[entry["componentType"]]
        values = np.frombuffer(self.binary, kind, entry["count"] * width, view["byteOffset"])
        return values.reshape(-1, width).astype(np.float64)

    def animated(self, node, path, t, mode):
        rest = np.array(self.tree["nodes"][node].get(path, [0, 0, 0] if path == "translation" else [0, 0, 0, 1]), float)
        for animation in self.tree.get("animations", []):
            for channel in animation["channels"] if animation["name"] == mode else []:
                if channel["target"] == {"node": node, "path": path}:
                    sampler = animation["samplers"][channel["sampler"]]
                    assert sampler["interpolation"] == "CUBICSPLINE"
                    return self.cubic(self.array(sampler["input"])[:, 0], self.array(sampler["output"]), t)
        return rest

    @staticmethod
    def cubic(times, output, t):
        assert times[0] >= 0 and (np.diff(times) > 0).all()
        t = min(max(t, times[0]), times[-1])
        k = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
        h = times[k + 1] - times[k]
        u = (t - times[k]) / h
        value, leave, arrive, later = output[3 * k + 1], output[3 * k + 2], output[3 * k + 3], output[3 * k + 4]
        a, b = 2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u
        return a * value + h * b * leave + (1 - a) * later + h * (u**3 - u**2) * arrive

    def matrix(self, node, t, mode):
        place, turn = (self.animated(node, path, t, mode) for path in ("translation", "rotation"))
        x, y, z, w = turn / np.linalg.norm(turn)
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= self.tree["nodes"][node].get("scale", [1, 1, 1])
        matrix[:3, 3] = place
        return matrix

    def extras(self, key):
        """Number and extras of the nodes whose extras have a key."""
        every = ((k, node.get("extras", {}).get("r5dgs", {})) for k, node in enumerate(self.tree["nodes"]))
        return [(k, own) for k, own in every if key in own]

    def nodes(self, t, mode="rigid"):
        """Number and world matrix of each node at a time since the start."""
        waiting = [(number, np.eye(4)) for number in self.tree["scenes"][0]["nodes"]]
        while waiting:
            number, above = waiting.pop()
            world = above @ self.matrix(number, t, mode)
            waiting += [(child, world) for child in self.tree["nodes"][number].get("children", [])]
            yield number, world

    def splats(self, t, mode="rigid"):
        """Object, group, world matrix and columns of each mesh at a time."""
        for number, world in self.nodes(t, mode):
            node = self.tree["nodes"][number]
            if "mesh" in node:
                (primitive,) = self.tree["meshes"][node["mesh"]]["primitives"]
                columns = {name: self.array(k) for name, k in primitive["attributes"].items()}
                own = node["extras"]["r5dgs"]
                yield own["object"], own["group"], world, columns


def written(scene, tmp_path, options=OPTIONS):
    (path,) = glb.export(scene, tmp_path / "scene.glb", options)
    return Gltf(path)


def bouncing():
    """A ball that falls and bounces past t_max, observed at its impact."""
    scene = scenes.make_scene(n=200, objects=1, shadows=False)
    rates = {"velocity": [0.3, 0, -1.0], "acceleration": [0, 0, -6.0], "bounce_time": 0.08, "restitution": 0.7}
    group = dataclasses.replace(scene.groups[1], model=models.MotionModel("bounce", **rates, radius=0.3))
    return dataclasses.replace(scene, groups=(scene.groups[0], group))


@pytest.mark.parametrize(
    "scene",
    [
        scenes.make_scene(n=400, objects=5, seed=3),
        scenes.make_scene(n=300, objects=2, sh_degree=3, world_convention="colmap"),
        scenes.make_scene(n=100, objects=0, world_convention="opengl", shading=False),
        arms.make_arm("hinge"),
        arms.make_arm("slider"),
        bouncing(),
    ],
    ids=["bodies", "harmonics", "static", "hinge", "slider", "bounce"],
)
def test_nodes_move_the_gaussians_as_playback_does(scene, tmp_path):
    found, shown = written(scene, tmp_path), Player(scene)
    up, extent = np.array(Y_UP[scene.world_convention]), scene.extent
    for t in TIMES:
        frame, seen = shown.frame(t), 0
        for object_id, group, world, columns in found.splats(t - scene.tracks.times[0]):
            rows = (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group)
            places = columns["POSITION"] @ world[:3, :3].T + world[:3, 3]
            np.testing.assert_allclose(places, frame.means[rows] @ up.T, atol=1e-5 * extent)
            axes = rotations.quats_to_rotmats(columns[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]])
            wanted = up @ rotations.quats_to_rotmats(frame.quats[rows].astype(float))
            np.testing.assert_allclose(world[:3, :3] @ axes, wanted, atol=2e-5)
            seen += len(places)
        assert seen == len(scene.gaussians.means)


def test_known_units_become_seconds_and_metres_and_are_read_back(tmp_path):
    scene = dataclasses.replace(scenes.make_scene(n=200, objects=2), units=Units(2.5, 0.4))
    found, t = written(scene, tmp_path), 0.97
    frame = Player(scene).frame(t)
    for object_id, group, world, columns in found.splats(2.5 * t):
        rows = (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group)
        places = columns["POSITION"] @ world[:3, :3].T + world[:3, 3]
        np.testing.assert_allclose(places, 0.4 * frame.means[rows] @ np.array(Y_UP["blender"]).T, atol=1e-5)
    again = glb_reader.read(tmp_path / "scene.glb")
    assert again.units == scene.units
    np.testing.assert_allclose(Player(again).frame(0.4).means, Player(scene).frame(0.4).means, atol=1e-5)


def test_the_velocity_jumps_at_t_max_and_at_an_impact(tmp_path):
    scene = bouncing()
    found = written(scene, tmp_path)
    (node,) = [
        k for k, n in enumerate(found.tree["nodes"]) if n.get("extras", {}).get("r5dgs", {}).get("role") == "body"
    ]
    h = 1e-4

    def speed(t):
        place = [found.animated(node, "translation", t + side * h - scene.tracks.times[0], "rigid") for side in (-1, 1)]
        return (place[1] - place[0]) / (2 * h)

    impact = scene.t_max + 0.08
    assert speed(impact - 2 * h)[2] < -1.2 and speed(impact + 2 * h)[2] > 0.8


def test_colours_are_those_of_t_max_and_harmonics_those_of_the_nodes_frame(tmp_path):
    scene = scenes.make_scene(n=300, objects=2, sh_degree=3)
    rest = np.random.default_rng(1).uniform(-0.2, 1.5, 300).astype(np.float32)
    scene = dataclasses.replace(scene, shading=Shading(scene.shading.vectors, scene.shading.light, rest))
    direction = np.array([0.6, -0.64, 0.48])
    frozen = Player(scene).frame(scene.t_max).shading_factor
    found, t = written(scene, tmp_path), 1.1
    turns = Player(scene).frame(t).group_quats
    for object_id, group, _, columns in found.splats(t):
        rows = (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group)
        names = [f"{EXTENSION}:SH_DEGREE_{n}_COEF_{k}" for n in range(4) for k in range(2 * n + 1)]
        sh = np.stack([columns[name] for name in names], axis=1)
        back = rotations.rotate(rotations.conjugate(turns[group]), direction)
        shown = spherical_harmonics.to_rgb(sh, back)
        turned = spherical_harmonics.rotate(scene.gaussians.sh[rows], turns[group])
        wanted = spherical_harmonics.to_rgb(turned, direction) * frozen[rows, None]
        np.testing.assert_allclose(shown, wanted, atol=1e-5)
    still = played_splats.at(Player(scene), scene.t_max)
    first = {(o, g): c for o, g, _, c in found.splats(0.0)}
    dc = np.concatenate([first[key][f"{EXTENSION}:SH_DEGREE_0_COEF_0"] for key in sorted(first)])
    np.testing.assert_allclose(dc, still.sh[:, 0], atol=1e-6)


def test_other_modes_of_rigid_motion_are_animations_of_their_names(tmp_path):
    scene = scenes.make_scene(n=200, objects=2)
    rates = np.random.default_rng(0).normal(size=(200, 12)).astype(np.float32)
    scene = scene.with_arrays(dynamics=rates)
    found = written(scene, tmp_path)
    names = [animation["name"] for animation in found.tree["animations"]]
    assert names[:2] == ["rigid", "rigid/representative"] and "rigid/kabsch" in names
    assert found.tree["scenes"][0]["extras"]["r5dgs"]["modes"] == names
    frame = Player(scene, "rigid/median").frame(1.0)
    for object_id, group, world, columns in found.splats(1.0, "rigid/median"):
        rows = (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == group)
        places = columns["POSITION"] @ world[:3, :3].T + world[:3, 3]
        np.testing.assert_allclose(places, frame.means[rows] @ np.array(Y_UP["blender"]).T, atol=1e-4)


def test_nodes_have_the_names_of_objects_each_once(tmp_path):
    scene = arms.make_arm("hinge")
    found = written(scene, tmp_path)
    names = [node["name"] for node in found.tree["nodes"]]
    assert len(set(names)) == len(names)
    by_group = {own["group"]: found.tree["nodes"][k] for k, own in found.extras("role")}
    name = next(item.name for item in scene.objects if item.id == 1)
    assert by_group[1]["name"] == f"{name} (part 1)" and by_group[2]["name"] == f"{name} (part 2)"
    child = found.tree["nodes"].index(by_group[2])
    assert child in by_group[1]["children"]


def test_captured_cameras_are_cameras(scene, tmp_path):
    found = written(scene, tmp_path)
    worlds = dict(found.nodes(0.0))
    for number, node in enumerate(found.tree["nodes"]):
        if "camera" in node:
            camera = scene.cameras[node["camera"]]
            lens = found.tree["cameras"][node["camera"]]["perspective"]
            assert np.tan(lens["yfov"] / 2) == pytest.approx(camera.height / camera.intrinsics[1, 1] / 2)
            wanted = np.array(Y_UP["blender"]) @ cameras.cam_world_to_opengl(camera.T_cam_world)[:3]
            np.testing.assert_allclose(worlds[number][:3], wanted, atol=1e-9)
    assert sum("camera" in node for node in found.tree["nodes"]) == len(scene.cameras)


def test_import_gives_the_scene_back(tmp_path, capsys):
    scene = arms.make_arm("hinge", n=400, objects=4, sh_degree=2)
    source = scene_file.write(scene, tmp_path / "a.r5dgs", precision="exact")
    assert main.main(["export", str(source), "--to", "glb", "--out", str(tmp_path / "a.glb")]) == 0
    said = capsys.readouterr().out
    assert "not kept: bending" in said and "lost here: identity encodings" in said
    assert main.main(["import", str(tmp_path / "a.glb"), "--out", str(tmp_path / "b.r5dgs")]) == 0
    again = scene_file.read(tmp_path / "b.r5dgs")
    arguments = ("import", tmp_path / "a.glb", "--out", source)
    assert "replace it with --overwrite" in complaint(capsys, *arguments)
    np.testing.assert_array_equal(scene_file.read(source).gaussians.means, scene.gaussians.means)
    assert main.main([*map(str, arguments), "--overwrite"]) == 0
    np.testing.assert_array_equal(scene_file.read(source).gaussians.means, again.gaussians.means)
    for name in ("name", "t_max", "frames_per_unit", "world_convention", "objects", "near_plane"):
        assert getattr(again, name) == getattr(scene, name), name
    assert [g.model.to_dict() for g in again.groups] == [g.model.to_dict() for g in scene.groups]
    np.testing.assert_array_equal(again.background_sh, scene.background_sh)
    one, two = Player(scene), Player(glb_reader.read(tmp_path / "a.glb"))
    for t in TIMES:
        a, b = one.frame(t), two.frame(t)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "shading_factor"):
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), atol=1e-5, err_msg=name)
        np.testing.assert_array_equal(b.object_ids, a.object_ids)
        np.testing.assert_array_equal(b.motion_ids, a.motion_ids)
    camera = zip(again.cameras, scene.cameras, strict=True)
    assert all(np.array_equal(a.T_cam_world, b.T_cam_world) and a.name == b.name for a, b in camera)


def test_an_origin_far_away_is_kept(tmp_path):
    scene = dataclasses.replace(scenes.make_scene(n=100), origin=np.array([5e6, 4e5, -3e4]))
    written(scene, tmp_path)
    np.testing.assert_array_equal(glb_reader.read(tmp_path / "scene.glb").origin, scene.origin)


def test_selected_objects_alone_are_written_and_read(scene, tmp_path, capsys):
    source = scene_file.write(scene, tmp_path / "a.r5dgs", precision="exact")
    arguments = ["export", str(source), "--to", "glb", "--out", str(tmp_path / "a.glb"), "--objects", "cup and toy car"]
    assert main.main(arguments) == 0
    again = glb_reader.read(tmp_path / "a.glb")
    assert set(again.gaussians.object_ids) == {1, 3} and again.groups[2].anchor_index == -1
    wanted = Player(scene).frame(1.1).means[np.isin(scene.gaussians.object_ids, [1, 3])]
    np.testing.assert_allclose(Player(again).frame(1.1).means, wanted, atol=1e-5)


def test_an_object_without_gaussians_is_refused_and_no_file_is_left(scene, tmp_path):
    with pytest.raises(errors.ConfigError, match="expected Gaussians to export"):
        written(scene, tmp_path, registry.Options((0.0,), object_ids=frozenset({77})))
    with pytest.raises(errors.SceneFileError, match="cannot be written"):
        list(glb.export(scene, tmp_path / "missing" / "a.glb", OPTIONS))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--time", "0.5"), "--until"),
        (("--frames", "1:3"), "--until"),
        (("--until", "0.1"), "from t_max on, which is 0.75"),
        (("--until", "nan"), "finite"),
    ],
)
def test_times_that_do_not_apply_are_named(scene, tmp_path, capsys, arguments, named):
    source = scene_file.write(scene, tmp_path / "a.r5dgs")
    given = ("export", source, "--to", "glb", "--out", tmp_path / "a.glb", *arguments)
    assert named in complaint(capsys, *given, status=2) and not (tmp_path / "a.glb").exists()
    assert "no motion" in complaint(capsys, "export", source, "--to", "ply", "--out", "a.ply", "--until", "1", status=2)


def test_losses_of_a_scene_are_named():
    scene = scenes.make_scene(n=100)
    rows = np.array([50, 51], np.int32)
    shape = (2, len(scene.tracks.times))
    zeros, turns = np.zeros((*shape, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (*shape, 1))
    offsets = zeros.copy()
    offsets[0, 0, 1] = 0.1 * scene.extent
    bent = dataclasses.replace(scene, residuals=Residuals(rows, offsets, turns, zeros))
    said = " ".join(glb.losses(bent.with_arrays(dynamics=np.zeros((100, 12), np.float32)), OPTIONS))
    for part in (
        "2 Gaussians bend, by up to 10 % of the extent",
        "modes hybrid, standard",
        "identity encodings",
        "colours other than",
        "sky",
    ):
        assert part in said
    plain = scenes.make_scene(n=100, shading=False, identities=False)
    plain = plain.with_arrays(background_sh=np.zeros((1, 3), np.float32))
    assert glb.losses(plain, OPTIONS) == []


def test_stored_words_keep_their_matches(tmp_path):
    scene = scenes.make_scene(n=100, objects=2)
    vectors = np.eye(4, dtype=np.float32)
    scene = dataclasses.replace(
        scene.with_arrays(embeddings=vectors[[3, 3, 0, 1]], vocabulary_embeddings=vectors[[0, 1, 2]]),
        vocabulary=("vessel", "fruit", "sofa"),
    )
    found = written(scene, tmp_path).tree["scenes"][0]["extras"]["r5dgs"]["words"]
    assert [word for word, _ in found] == ["vessel", "fruit", "sofa"]
    assert [[one[0] for one in answers] for _, answers in found] == [[1], [2], []]


def test_damaged_and_foreign_files_are_refused(scene, tmp_path, capsys):
    path = tmp_path / "scene.glb"
    list(glb.export(scene, path, OPTIONS))
    data = path.read_bytes()

    def refusal(changed):
        path.write_bytes(changed)
        with pytest.raises(errors.SceneFileError) as error:
            glb_reader.read(path)
        return str(error.value)

    assert "another kind" in refusal(b"ply\nformat ascii 1.0\nend_header\n")
    assert "truncated" in refusal(data[:-100])
    assert "expected a file of 'r5dgs export --to glb'" in refusal(data.replace(b'"r5dgs glb"', b'"r5dgs obj"'))
    assert "update R5DGS" in refusal(data.replace(b'"format_version":1', b'"format_version":9', 1))
    assert "CUBICSPLINE" in refusal(data.replace(b'"CUBICSPLINE"', b'"LINEAR"     '))
    larger = re.sub(rb'"count":(\d+),"type"', lambda found: b'"count":' + b"9" * len(found[1]) + b',"type"', data)
    assert "packed bytes" in refusal(larger)
    path.write_bytes(data)
    line = complaint(capsys, "import", path, "--out", tmp_path / "b.r5dgs", "--knots", "5", status=2)
    assert "--knots" in line
    assert "nothing" in complaint(capsys, "import", tmp_path / "no.glb", "--out", tmp_path / "b.r5dgs")


@pytest.mark.browser
def test_the_khronos_validator_finds_only_the_unknown_extension(tmp_path):
    made = [
        scenes.make_scene(n=300, objects=5, sh_degree=3),
        scenes.make_scene(n=90, objects=0, shading=False),
        arms.make_arm("hinge"),
        bouncing(),
    ]
    paths = []
    for number, scene in enumerate(made):
        paths += glb.export(scene, tmp_path / f"{number}.glb", OPTIONS)
    for report in player.validate(*paths):
        others = [
            issue
            for issue in report["messages"]
            if issue["code"] not in ("UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE")
            or EXTENSION not in issue["message"] + issue["pointer"]
        ]
        assert others == [] and len(report["messages"]) > 4


def test_absent_objects_have_no_size(tmp_path):
    scene = scenes.with_absence(dataclasses.replace(scenes.make_scene(), units=Units(2.0)), (-np.inf, 0.1), (0.3, 0.4))
    (path,) = glb.export(scene, tmp_path / "a.glb", OPTIONS)
    content = Gltf(path)
    (animation,) = content.tree["animations"]
    hidden = {}
    for channel in animation["channels"]:
        if channel["target"]["path"] == "scale":
            node, sampler = content.tree["nodes"][channel["target"]["node"]], animation["samplers"][channel["sampler"]]
            assert sampler["interpolation"] == "STEP" and "mesh" in node
            np.testing.assert_allclose(content.array(sampler["input"])[:, 0], 2 * np.array([0, 0.1, 0.3, 0.4]))
            np.testing.assert_array_equal(content.array(sampler["output"]), np.outer([0, 1, 0, 1], [1, 1, 1]))
            hidden[node["extras"]["r5dgs"]["group"]] = node
    assert set(hidden) == {1, 4}
    again = glb_reader.read(path)
    assert [group.absent for group in again.groups] == [group.absent for group in scene.groups]
    np.testing.assert_allclose(again.tracks.poses, scene.tracks.poses, atol=1e-5)


def test_a_still_object_that_enters_is_an_animation(tmp_path):
    scene = scenes.make_scene(objects=1)
    scene = scenes.with_absence(
        scene.with_arrays(track_poses=np.tile(scene.tracks.poses[:, -1:], (1, 13, 1))), (0.2, 0.3)
    )
    groups = tuple(dataclasses.replace(group, model=models.STATIC) for group in scene.groups)
    (path,) = glb.export(dataclasses.replace(scene, groups=groups), tmp_path / "a.glb", OPTIONS)
    (animation,) = Gltf(path).tree["animations"]
    assert {channel["target"]["path"] for channel in animation["channels"]} == {"scale"}
