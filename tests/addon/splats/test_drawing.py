"""Splats drawn by the graphics card against the core's pictures, without a window.

A render engine with `bl_use_gpu_context` may draw in background mode; everywhere else `gpu` refuses.
"""

import dataclasses
import weakref

import numpy as np
import pytest

from r5dgs_core import api, errors
from r5dgs_core.motion import rotations
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("numba", reason="numba is not installed in this Python, which draws the core's pictures here")

SIZE = (160, 120)
AT_LEAST_DB = 60.0


@pytest.fixture
def on_card(blender):
    """Calls a function of the depsgraph with the graphics card's context, and forgets all tables and shaders."""
    state, found = motions.addon("splats.viewport_splats")._state, []

    class Engine(blender.types.RenderEngine):
        bl_idname, bl_label, bl_use_gpu_context = "R5DGS_TEST_SPLATS", "Splats", True

        def render(self, depsgraph):
            try:
                found.append((wanted.pop()(depsgraph), None))
            except BaseException as error:
                found.append((None, error))
            finally:
                state.forget()  # this context ends with the render

    blender.utils.register_class(Engine)
    wanted, scene = [], blender.context.scene

    def call(function):
        scene.render.engine = Engine.bl_idname
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *SIZE, 100
        wanted.append(function)
        blender.ops.render.render()
        value, error = found.pop()
        if error is not None:
            raise error
        return value

    yield call
    blender.utils.unregister_class(Engine)  # otherwise some versions crash or hang at exit


def picture_of(depsgraph):
    """The visible splats from the active camera: premultiplied colors, and coverage without holes. [H, W, 4]"""
    renderer = motions.addon("splats.splat_renderer")
    found = motions.addon("splats.visible_splats").shown(depsgraph)
    if found is None:
        return np.zeros((SIZE[1], SIZE[0], 4))
    camera, buffer = depsgraph.scene.camera.evaluated_get(depsgraph), renderer.SplatBuffer()
    view = renderer.ViewMatrices(
        np.linalg.inv(np.array(camera.matrix_world, np.float64)),
        np.array(camera.calc_matrix_camera(depsgraph, x=SIZE[0], y=SIZE[1]), np.float64),
        *SIZE,
    )
    buffer.draw(found.table, found.groups, view)
    values = pixels(buffer._picture)
    if buffer._holes is not None:
        values[..., 3] -= pixels(buffer._holes)[..., 0]
    return values


def pixels(target):
    """Pixels of a buffer, top row first. [H, W, 4]"""
    import gpu

    with target.bind():
        values = gpu.state.active_framebuffer_get().read_color(0, 0, *SIZE, 4, 0, "FLOAT")
    values.dimensions = SIZE[0] * SIZE[1] * 4
    return np.array(values, np.float32).reshape(SIZE[1], SIZE[0], 4)[::-1]


@pytest.fixture
def drawn(on_card):
    """Draws the visible splats from the active camera, see `picture_of`."""
    return lambda: on_card(picture_of)


def expected(blender, scene, t):
    """The core's picture over black from Blender's active camera. [H, W, 3]"""
    view_cameras = motions.addon("engine.view_cameras")
    depsgraph = blender.context.evaluated_depsgraph_get()
    view = view_cameras.of_camera(depsgraph, lambda: np.zeros((0, 3)))
    black = scene.background_sh.copy() * 0
    black[0] = -0.5 / 0.28209479177387814
    return api.picture(dataclasses.replace(scene, background_sh=black), t, view.camera)


def psnr(a, b):
    return -10 * np.log10(np.square(a - b).mean())


@pytest.mark.parametrize("degree, shading", [(0, False), (1, True), (2, False), (3, True)])
def test_pictures_equal_the_cores_at_any_time(blender, drawn, tmp_path, degree, shading):
    scene = scenes.make_scene(n=400, objects=3, sh_degree=degree, shading=shading)
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    blender.ops.object.select_all(action="SELECT")
    collection = motions.load(blender, path)
    stored = scene_file.read(path)
    for t in (0.2, scenes.T_MAX, 0.9):
        motions.go_to(blender, collection, t)
        found = drawn()
        assert found[..., 3].max() > 0.5
        assert psnr(np.clip(found[..., :3], 0, 1), expected(blender, stored, t)) > AT_LEAST_DB


@pytest.fixture
def bending(blender, tmp_path):
    """A loaded scene with an object that bends, and its content."""
    scene = scenes.make_scene(n=400, objects=3, sh_degree=1)
    rows, times = np.flatnonzero(scene.gaussians.object_ids == 1), scene.tracks.times
    shape, draw = (len(rows), len(times)), np.random.default_rng(0)
    quats = draw.normal(scale=0.2, size=(*shape, 4)) + [1.0, 0, 0, 0]
    offsets, growths = draw.normal(scale=0.1, size=(*shape, 3)), draw.normal(scale=0.2, size=(*shape, 3))
    quats[:, -1], offsets[:, -1], growths[:, -1] = (1, 0, 0, 0), 0, 0
    scene = scene.with_arrays(
        residual_rows=rows.astype(np.int32),
        residual_offsets=offsets.astype(np.float32),
        residual_quats=rotations.normalize(quats).astype(np.float32),
        residual_log_scales=growths.astype(np.float32),
    )
    path = scene_file.write(scene, tmp_path / "bending.r5dgs")
    collection = motions.load(blender, path)
    assert collection.r5dgs_exact.enabled
    return collection, scene_file.read(path)


def test_what_bends_is_drawn_as_the_core_draws_it(blender, drawn, bending):
    collection, stored = bending
    for t in (0.2, 0.35, scenes.T_MAX, 0.9):
        motions.go_to(blender, collection, t)
        assert psnr(np.clip(drawn()[..., :3], 0, 1), expected(blender, stored, t)) > AT_LEAST_DB


def test_a_table_follows_what_bends_without_being_made_again(blender, on_card, bending):
    visible, table_module = motions.addon("splats.visible_splats"), motions.addon("splats.gaussian_table")
    collection, _ = bending

    def read(t, known=None):
        motions.go_to(blender, collection, t)
        evaluated = bent.evaluated_get(blender.context.evaluated_depsgraph_get())
        return table_module.read(evaluated.data, bent.color, known)

    bent = next(cloud for cloud in motions.clouds(collection) if "r5dgs_exact_written" in cloud.data)
    first = read(0.2)
    assert read(0.35, first).look is first.look

    def follow(depsgraph):
        pictures = [picture_of(depsgraph)]
        (layer,) = visible._layers.values()
        table, look = layer.table, layer.clouds[bent.session_uid].look
        layer.update(bent.session_uid, table_module.CloudData(first.geometry, look))
        assert layer.table is table and max(table[1].versions) == 1
        pictures.append(picture_of(depsgraph))
        layer.update(bent.session_uid, first)  # with another look
        assert layer.table is None
        return [*pictures, picture_of(depsgraph)]

    before, found, made_again = on_card(follow)
    assert psnr(before, found) < 50
    np.testing.assert_allclose(found, made_again, atol=1e-6)


def moved(bpy, mug):
    mug.parent.rotation_quaternion, mug.parent.scale = (0.8, 0.3, 0.5, 0.1), (1.5, 0.7, 1.0)


def tinted(bpy, mug):
    mug.r5dgs_look.tint = (0.3, 1.2, 0.8)


def hidden(bpy, mug):
    mug.hide_viewport = mug.hide_render = True


def edited(bpy, mug):
    values = np.empty(3 * len(mug.data.points), np.float32)
    mug.data.attributes["scale"].data.foreach_get("vector", values)
    mug.data.attributes["scale"].data.foreach_set("vector", 2 * values)
    mug.data.update_tag()


def deleted_by_nodes(bpy, mug):
    tree = bpy.data.node_groups.new("half", "GeometryNodeTree")
    for in_out in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=in_out, socket_type="NodeSocketGeometry")
    entry, leave = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    delete, random = tree.nodes.new("GeometryNodeDeleteGeometry"), tree.nodes.new("FunctionNodeRandomValue")
    random.data_type = "BOOLEAN"
    tree.links.new(entry.outputs[0], delete.inputs["Geometry"])
    tree.links.new(next(out for out in random.outputs if out.enabled), delete.inputs["Selection"])
    tree.links.new(delete.outputs[0], leave.inputs[0])
    mug.modifiers.new("half", "NODES").node_group = tree


def instanced(bpy, mug):
    instancer = bpy.data.objects.new("instancer", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", mug.users_collection[0]
    instancer.location = (0.5, 0.4, 0.3)
    bpy.context.scene.collection.objects.link(instancer)


def parallel(bpy, mug):
    bpy.context.scene.camera.data.type = "ORTHO"
    bpy.context.scene.camera.data.ortho_scale = 5


def held_out(bpy, mug):
    mug.is_holdout = True


@pytest.mark.parametrize(
    "change",
    [held_out, moved, tinted, hidden, edited, deleted_by_nodes, instanced, parallel],
    ids=lambda one: one.__name__,
)
def test_edits_are_drawn_as_the_worker_draws_them(blender, drawn, tmp_path, change):
    scene = scenes.make_scene(n=400, objects=3, sh_degree=1)
    collection = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    motions.go_to(blender, collection, 0.3)
    before = drawn()
    change(blender, max(motions.clouds(collection), key=lambda cloud: (cloud.r5dgs.object_id == 1, cloud.r5dgs.count)))
    request = motions.addon("engine.render_request")
    found = drawn()
    depsgraph = blender.context.evaluated_depsgraph_get()
    arrays = request.render(request.shown(depsgraph), ("alpha",), sky=False)[1]
    assert psnr(before, found) < 50  # the change is seen
    assert psnr(np.clip(found[..., :3], 0, 1), np.clip(arrays["color"], 0, 1)) > AT_LEAST_DB
    assert psnr(found[..., 3], arrays["alpha"]) > AT_LEAST_DB


def test_scenes_with_another_display_are_left_out(blender, drawn, tmp_path):
    collection = motions.load(blender, scene_file.write(scenes.make_scene(n=100), tmp_path / "scene.r5dgs"))
    assert drawn().any()
    blender.ops.r5dgs.set_display(display="POINTS")
    assert not drawn().any() and collection.r5dgs.display == "POINTS"


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
def test_a_transform_without_a_picture_hides_only_its_object(blender, drawn, tmp_path, value):
    scene = scenes.make_scene(n=400, objects=3, sh_degree=1)
    collection = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    mug = next(cloud for cloud in motions.clouds(collection) if cloud.r5dgs.object_id == 1)
    mug.hide_render = True
    wanted = drawn()
    mug.hide_render, mug.location.x = False, value
    np.testing.assert_allclose(drawn(), wanted, atol=1e-6)


def test_the_sky_is_that_of_the_first_scene_shown_as_splats(blender, on_card, tmp_path):
    for number in range(2):
        scene = scenes.make_scene(n=100)
        scene = dataclasses.replace(scene, background_sh=np.full_like(scene.background_sh, number))
        motions.load(blender, scene_file.write(scene, tmp_path / f"{number}.r5dgs"))
    shown = motions.addon("splats.visible_splats").shown
    first, second = blender.context.scene.collection.children[-2:]
    assert (on_card(shown).sky == 0).all()
    motions.addon("scene.viewport_display").show(first, "POINTS")
    assert (on_card(shown).sky == 1).all()


def test_one_shader_draws_tables_of_any_length(blender, on_card, tmp_path, monkeypatch):
    shaders, renderer = motions.addon("splats.shaders"), motions.addon("splats.splat_renderer")
    scene = scenes.make_scene(n=400, objects=3, sh_degree=2)
    motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))

    def grow(depsgraph):
        wanted = picture_of(depsgraph)
        packed = motions.addon("splats.gaussian_table").pack
        data = next(iter(motions.addon("splats.visible_splats")._layers.values())).clouds.values()
        tables = [renderer.SplatTable(packed([*data] * count)) for count in (2, 50)]
        assert tables[0].shader is tables[1].shader
        assert renderer._shader.cache_info().misses == 1
        return wanted

    wanted = on_card(grow)
    monkeypatch.setattr(shaders, "width", lambda: 128)  # several rows of every texture
    np.testing.assert_array_equal(on_card(picture_of), wanted)
    monkeypatch.setattr(shaders, "width", lambda: 16)
    with pytest.raises(errors.ConfigError, match="400 Gaussians .* expected at most 32 as splats"):
        on_card(picture_of)


def test_a_table_on_the_graphics_card_does_not_keep_the_looks_in_memory(blender, on_card, tmp_path):
    renderer, tables = motions.addon("splats.splat_renderer"), motions.addon("splats.gaussian_table")
    motions.load(blender, scene_file.write(scenes.make_scene(n=100, sh_degree=2), tmp_path / "scene.r5dgs"))

    def keeps_looks(depsgraph):
        picture_of(depsgraph)
        data = next(iter(motions.addon("splats.visible_splats")._layers.values())).clouds.values()
        packed = tables.pack([*data])
        looks, table = weakref.ref(packed.looks), renderer.SplatTable(packed)
        del packed
        return table.starts[-1] == 100, looks() is not None

    assert on_card(keeps_looks) == (True, False)


def test_nearer_than_the_clip_start_of_the_camera_is_nothing(blender, drawn, tmp_path):
    motions.load(blender, scene_file.write(scenes.make_scene(n=200), tmp_path / "scene.r5dgs"))
    assert drawn().any()
    blender.context.scene.camera.data.clip_start = 900
    assert not drawn().any()


@pytest.mark.parametrize("kind", ["mesh", "curve", "instance", "modified"])
def test_the_depth_of_surfaces_is_that_of_a_ray(blender, on_card, kind):
    mesh_depth, renderer = motions.addon("splats.mesh_depth"), motions.addon("splats.splat_renderer")
    scene, cube = blender.context.scene, blender.data.objects["Cube"]
    if kind == "curve":
        blender.data.objects.remove(cube)
        blender.ops.curve.primitive_bezier_circle_add()
        blender.context.object.data.dimensions, blender.context.object.data.fill_mode = "2D", "BOTH"
    elif kind == "instance":
        held = blender.data.collections.new("held")
        for home in cube.users_collection:
            home.objects.unlink(cube)
        held.objects.link(cube)
        instancer = blender.data.objects.new("instancer", None)
        instancer.instance_type, instancer.instance_collection = "COLLECTION", held
        instancer.location = (0.3, 0.2, 0.1)
        scene.collection.objects.link(instancer)
    elif kind == "modified":
        cube.modifiers.new("round", "SUBSURF").levels = cube.modifiers["round"].render_levels = 2
    blender.context.view_layer.update()

    def draw(depsgraph):
        camera, drawn = depsgraph.scene.camera.evaluated_get(depsgraph), mesh_depth.MeshDepth()
        view = renderer.ViewMatrices(
            np.linalg.inv(np.array(camera.matrix_world, np.float64)),
            np.array(camera.calc_matrix_camera(depsgraph, x=SIZE[0], y=SIZE[1]), np.float64),
            *SIZE,
        )
        found = drawn.find(depsgraph, None)
        assert found == drawn.find(depsgraph, None) and found
        drawn.draw(view)
        values, p = pixels(drawn._picture)[..., 0], view.projection
        mesh_depth.forget()
        return np.where(values < 1, p[2, 3] / (2 * values - 1 + p[2, 2]), np.inf)

    depth, camera = on_card(draw), scene.camera.matrix_world
    if kind == "curve":  # rays hit no curves
        assert depth[60, 80] == pytest.approx(camera.translation.length, rel=0.03) and np.isinf(depth[5, 5])
        return
    for row, column in ((60, 80), (50, 84), (66, 75), (5, 5)):
        frame = [camera @ corner for corner in scene.camera.data.view_frame(scene=scene)]  # right top first
        x, y = (column + 0.5) / SIZE[0], (row + 0.5) / SIZE[1]
        target = frame[3] + (frame[0] - frame[3]) * x + (frame[2] - frame[3]) * y
        origin, ahead = camera.translation, camera.to_3x3() @ frame[0].__class__((0, 0, -1))
        graph = blender.context.evaluated_depsgraph_get()
        hit, place, *_ = scene.ray_cast(graph, origin, (target - origin).normalized())
        wanted = (place - origin).dot(ahead) if hit else np.inf
        assert depth[row, column] == pytest.approx(wanted, rel=2e-3)


def nodes_without_attributes(bpy, mug):
    """Replace a cloud's points by a row of new ones."""
    tree = bpy.data.node_groups.new("row", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    line, points, leave = (
        tree.nodes.new(kind) for kind in ("GeometryNodeMeshLine", "GeometryNodeMeshToPoints", "NodeGroupOutput")
    )
    line.inputs["Count"].default_value = 40
    line.inputs["Offset"].default_value = (0.02, 0, 0)
    tree.links.new(line.outputs[0], points.inputs[0])
    tree.links.new(points.outputs[0], leave.inputs[0])
    mug.modifiers.new("row", "NODES").node_group = tree


def test_points_without_attributes_are_seen_in_the_color_of_their_object(blender, drawn, tmp_path):
    scene = scenes.make_scene(n=400, objects=3)
    collection = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    mug = next(cloud for cloud in motions.clouds(collection) if cloud.r5dgs.object_id == 1)
    for cloud in motions.clouds(collection):
        cloud.hide_render = cloud != mug
    mug.color = (0.0, 1.0, 0.0, 0.9)
    nodes_without_attributes(blender, mug)
    found = drawn()
    assert found[..., 3].max() > 0.5
    np.testing.assert_allclose(found[..., 1], found[..., 3], atol=1e-3)
    assert found[..., 0].max() < 1e-3 and found[..., 2].max() < 1e-3


@pytest.mark.parametrize("link", [False, True], ids=["appended", "linked"])
@pytest.mark.parametrize("instanced", [False, True], ids=["itself", "instanced"])
def test_scenes_of_another_file_are_drawn(blender, drawn, tmp_path, link, instanced):
    scene = scenes.make_scene(n=400, objects=3, sh_degree=1)
    collection = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    name, camera = collection.name, blender.context.scene.camera.matrix_world.copy()
    wanted, blend = drawn(), str(tmp_path / "library.blend")
    blender.data.libraries.write(blend, {collection})
    blender.context.view_layer.layer_collection.children[name].exclude = True
    assert not drawn().any()
    with blender.data.libraries.load(blend, link=link) as (_, brought):
        brought.collections = [name]
    target = blender.context.scene.collection
    if instanced:
        instancer = blender.data.objects.new("instancer", None)
        instancer.instance_type, instancer.instance_collection = "COLLECTION", brought.collections[0]
        target.objects.link(instancer)
    else:
        target.children.link(brought.collections[0])
    assert blender.context.scene.camera.matrix_world == camera
    assert wanted.any()
    np.testing.assert_allclose(drawn(), wanted, atol=1e-4)
