"""Depth of field and motion blur of renders: optics, sampling, and means of sharp renders."""

import dataclasses
import importlib
import math

import numpy as np
import pytest

from r5dgs_core.color import srgb
from r5dgs_core.data import images
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, pictures, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

SIZE = 48


@pytest.fixture
def blur(extension):
    return importlib.import_module("r5dgs.r5dgs_addon.engine.blur_samples")


@pytest.fixture
def view(loaded, blender):
    """Camera of the captured views, in focus at the first object; small renders without dither."""
    scene = blender.context.scene
    blender.ops.r5dgs.use_engine()
    blender.ops.r5dgs.show_colors_as_trained()
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage, scene.render.dither_intensity = 100, 0.0
    scene.r5dgs_render.samples = 4
    scene.frame_set(20)
    return scene.camera


def render(bpy, folder, name):
    """Scene-linear image that F12 saves. [H, W, 3]"""
    settings = bpy.context.scene.render
    settings.filepath = str(folder / f"{name}.png")
    settings.image_settings.file_format, settings.image_settings.color_depth = "PNG", "16"
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return srgb.to_linear(images.read(settings.filepath)[..., :3])


def test_samples_cover_lens_and_shutter_evenly(blur):
    found = blur.samples(64)
    points, times = np.array([one.point for one in found]), np.array([one.time for one in found])
    np.testing.assert_allclose(np.sort(times), (np.arange(64) + 0.5) / 64)
    np.testing.assert_allclose(np.sort((points**2).sum(-1)), (np.arange(64) + 0.5) / 64)
    assert np.abs(points.mean(0)).max() < 0.03
    assert np.abs(np.corrcoef(np.column_stack([points, times]).T)[2, :2]).max() < 0.1


@pytest.mark.parametrize("parallel", (False, True))
def test_blur_is_the_circle_of_confusion_of_a_thin_lens(blur, parallel):
    views = importlib.import_module("r5dgs.r5dgs_addon.engine.view_cameras")
    camera = scenes.camera_from_field_of_view(np.eye(4), math.radians(40), 64, 64)
    focus, radius, distance = 5.0, 0.2, 1e4 if parallel else 0.0
    pixels_per_unit = 10.0
    if parallel:
        matrix, intrinsics = camera.T_cam_world.copy(), camera.intrinsics.copy()
        matrix[2, 3] += distance
        intrinsics[[0, 1], [0, 1]] = pixels_per_unit * distance
        camera = cameras.Camera(64, 64, intrinsics, matrix)
    lens = blur.Lens(np.array([radius, radius]), focus, 0, 0.0)
    points = np.array([[0.3, 0.1, -depth] for depth in (2.0, focus, 20.0)])
    sharp = cameras.project(camera, points)[0]
    view = blur.through_lens(views.ViewCamera(camera, distance), lens, np.array([0.6, 0.8]))
    moved = cameras.project(view.camera, points)[0] - sharp
    depths = -points[:, 2]
    if parallel:
        expected = pixels_per_unit * radius * (depths - focus) / focus
    else:
        expected = camera.intrinsics[0, 0] * radius * (1 / focus - 1 / depths)
    np.testing.assert_allclose(moved, expected[:, None] * [0.6, -0.8], rtol=3e-3 if parallel else 1e-9, atol=1e-9)


def test_blades_make_a_polygon(blur):
    views = importlib.import_module("r5dgs.r5dgs_addon.engine.view_cameras")
    camera = scenes.camera_from_field_of_view(np.eye(4), math.radians(40), 64, 64)
    lens = blur.Lens(np.ones(2), 1.0, 6, 0.3)
    rim = [np.array([math.cos(a), math.sin(a)]) for a in np.linspace(0, 2 * math.pi, 200)]
    found = np.array([blur.through_lens(views.ViewCamera(camera), lens, point).camera.center[:2] for point in rim])
    center, corners = camera.center[:2], np.linspace(0, 2 * math.pi, 7)[:-1]
    middles = np.column_stack([np.cos(corners + math.pi / 6 + 0.3), np.sin(corners + math.pi / 6 + 0.3)])
    reach = ((found - center) @ middles.T).max(1)
    np.testing.assert_allclose(reach, math.cos(math.pi / 6), rtol=1e-9)


@pytest.mark.parametrize("position, times", (("START", (20, 24)), ("CENTER", (18, 22)), ("END", (16, 20))))
def test_motion_blur_is_the_mean_of_images_over_the_shutter_time(blender, view, tmp_path, position, times):
    scene = blender.context.scene
    scene.render.motion_blur_shutter, scene.render.motion_blur_position = 4.0, position
    expected = []
    for number in range(4):
        frame = times[0] + 4 * (number + 0.5) / 4
        scene.frame_set(math.floor(frame), subframe=frame % 1)
        expected.append(render(blender, tmp_path, "sharp"))
    scene.frame_set(20)
    still = render(blender, tmp_path, "still")
    scene.render.use_motion_blur = True
    blurred = render(blender, tmp_path, "blurred")
    assert scene.frame_current == 20 and scene.frame_subframe == 0
    np.testing.assert_allclose(blurred, np.mean(expected, 0), atol=2e-4)
    assert np.abs(blurred - still).max() > 0.02


def test_depth_of_field_blurs_by_the_aperture_and_keeps_the_plane_in_focus(blender, view, mug, tmp_path):
    sharp = render(blender, tmp_path, "sharp")
    dof = view.data.dof
    dof.use_dof, dof.focus_object, dof.aperture_fstop = True, mug, 1e4
    np.testing.assert_allclose(render(blender, tmp_path, "pinhole"), sharp, atol=2e-3)
    dof.aperture_fstop, blender.context.scene.r5dgs_render.samples = view.data.lens * 1e-3 / 0.8, 16
    blurred = render(blender, tmp_path, "blurred")
    assert np.abs(np.diff(blurred, axis=0)).mean() < 0.8 * np.abs(np.diff(sharp, axis=0)).mean()


def test_passes_of_data_are_sharp(blender, view, tmp_path):
    scene = blender.context.scene
    scene.view_layers[0].use_pass_z = True
    settings = scene.render
    found = []
    for used in (False, True):
        view.data.dof.use_dof = settings.use_motion_blur = used
        view.data.dof.aperture_fstop, settings.motion_blur_shutter = 0.01, 4.0
        settings.filepath = str(tmp_path / f"{used}.exr")
        if hasattr(settings.image_settings, "media_type"):  # Blender 5
            settings.image_settings.media_type = "MULTI_LAYER_IMAGE"
        settings.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        assert blender.ops.render.render(write_still=True) == {"FINISHED"}
        found.append(pictures.read_exr(settings.filepath))
    np.testing.assert_array_equal(found[0]["Depth.Z"], found[1]["Depth.Z"])
    assert np.abs(found[0]["Combined.R"] - found[1]["Combined.R"]).max() > 0.01


@pytest.fixture
def dots(blender, tmp_path):
    """Three white Gaussians at different depths, left to right, and a mesh of each; both follow an empty."""
    places = np.array([[-0.8, 3.0, 0.0], [0.0, 5.0, 0.2], [2.4, 9.0, 0.0]])
    scene = scenes.make_scene(3, 0, unassigned=0, shadows=False, shading=False, identities=False)
    gaussians = dataclasses.replace(
        scene.gaussians,
        means=places.astype(np.float32),
        log_scales=np.full((3, 3), math.log(0.03), np.float32),
        opacity_logits=np.full(3, 4.0, np.float32),
        sh=np.full((3, 1, 3), 1.7, np.float32),
    )
    scene = dataclasses.replace(scene, gaussians=gaussians)
    root = motions.load(blender, scene_file.write(scene, tmp_path / "dots.r5dgs")).r5dgs.root
    blender.data.objects.remove(blender.data.objects["Cube"])  # the camera would be inside
    material = blender.data.materials.new("white")
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Emission Color"].default_value, shader.inputs["Emission Strength"].default_value = (1, 1, 1, 1), 1.0
    for place in places:
        blender.ops.mesh.primitive_uv_sphere_add(radius=0.06, location=place)
        blender.context.object.data.materials.append(material)
        blender.context.object.parent = root
    data = blender.data.cameras.new("eye")
    eye = blender.data.objects.new("eye", data)
    eye.rotation_euler.x = math.pi / 2
    blender.context.scene.collection.objects.link(eye)
    context = blender.context.scene
    context.camera, context.world = eye, None
    context.render.resolution_x, context.render.resolution_y, context.render.resolution_percentage = 144, 96, 100
    context.view_settings.view_transform, context.render.dither_intensity = "Standard", 0.0
    return root


def extents(image):
    """Standard deviations of the light in the left, middle and right third of an image, in x and y, pixels. [3, 2]"""
    found = []
    for part in np.split(image.mean(-1), 3, axis=1):
        weights = part / part.sum()
        places = np.stack(np.meshgrid(np.arange(part.shape[1]), np.arange(part.shape[0])), -1)
        mean = (weights[..., None] * places).sum((0, 1))
        found.append(np.sqrt((weights[..., None] * (places - mean) ** 2).sum((0, 1))))
    return np.array(found)


def start_moving(root):
    """Move the dots to the right with constant velocity, and choose a frame between the keys."""
    scene = root.users_scene[0]
    scene.r5dgs_render.sky, scene.r5dgs_render.samples = False, 64
    for frame, place in ((0, -0.3), (10, 0.3)):
        root.location.x = place
        root.keyframe_insert("location", frame=frame)
    for curve in motions.curves(root).values():
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    scene.frame_set(5)


def use_blur(scene, kind):
    """Switch on the blur by "lens" or "shutter", or none."""
    dof = scene.camera.data.dof
    dof.use_dof, scene.render.use_motion_blur = kind == "lens", kind == "shutter"
    dof.focus_distance, dof.aperture_fstop, scene.render.motion_blur_shutter = 5.0, 0.05, 8.0


def added(kind, sharp, blurred):
    """Extents of the blur alone, pixels."""
    width = 4.0 if kind == "lens" else math.sqrt(12)  # of a disk and of a line, in standard deviations
    return width * np.sqrt(np.maximum(blurred**2 - sharp**2, 0))


@pytest.mark.heavy
@pytest.mark.default_cases("shutter")
@pytest.mark.parametrize("kind", ("lens", "shutter"))
def test_blur_is_as_wide_as_in_cycles(blender, dots, tmp_path, kind):
    scene, found = blender.context.scene, {}
    scene.cycles.samples, scene.cycles.use_denoising = 64, False
    scene.cycles.pixel_filter_type, scene.cycles.device = "BOX", "CPU"
    start_moving(dots)
    for engine in ("R5DGS", "CYCLES"):
        scene.render.engine = engine
        for name in ("sharp", "blurred"):
            use_blur(scene, kind if name == "blurred" else "")
            found[engine, name] = extents(render(blender, tmp_path, f"{engine}_{name}"))
    ours, cycles = (added(kind, found[engine, "sharp"], found[engine, "blurred"]) for engine in ("R5DGS", "CYCLES"))
    assert cycles[0].max() > 8
    np.testing.assert_allclose(ours, cycles, atol=1.0)


@pytest.mark.heavy
@pytest.mark.default_cases("shutter")
@pytest.mark.parametrize("kind", ("lens", "shutter"))
def test_meshes_and_gaussians_of_a_merged_picture_are_blurred_alike(blender, dots, tmp_path, kind):
    scene = blender.context.scene
    for mesh in (child for child in dots.children if child.type == "MESH"):
        mesh.location.z += 0.36 * mesh.location.y  # 72 px above its dot
    scene.camera.data.shift_y, scene.render.resolution_y = 0.25, 160
    start_moving(dots)
    assert blender.ops.r5dgs.merge_with_meshes() == {"FINISHED"}
    meshes = scene.r5dgs_render.meshes
    meshes.cycles.samples, meshes.cycles.use_denoising = 64, False
    meshes.cycles.pixel_filter_type, meshes.cycles.device = "BOX", "CPU"
    found = {}
    for name in ("sharp", "blurred"):
        use_blur(scene, kind if name == "blurred" else "")
        image = render(blender, tmp_path, name)
        found[name] = [extents(half) for half in (image[:80], image[80:])]
    of_meshes, of_gaussians = (added(kind, *pair) for pair in zip(found["sharp"], found["blurred"], strict=True))
    assert of_meshes[0].max() > 8
    np.testing.assert_allclose(of_gaussians, of_meshes, atol=1.0)
