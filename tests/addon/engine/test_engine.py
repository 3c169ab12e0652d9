"""The engine R5DGS renders the same pictures as the core, with Blender's passes, films and borders."""

import importlib
import json
import os
import signal
import threading
import types

import numpy as np
import OpenImageIO
import pytest

from r5dgs_core.data import images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras, scene_file
from tests.support import layouts, motions, pictures, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix  # noqa: E402  (bpy brings it)

NOTHING = 1e10


@pytest.fixture
def scene(tmp_path):
    return scenes.make_scene(n=400, objects=3, sh_degree=2, seed=4, world_convention="colmap")


@pytest.fixture
def loaded(blender, scene, tmp_path, monkeypatch):
    """Scene with render engine, first camera and multilayer EXR output."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    collection = motions.load_again(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    camera = scene.cameras[0]
    data = blender.data.cameras.new("view")
    data.sensor_fit, data.lens = "HORIZONTAL", camera.intrinsics[0, 0] * data.sensor_width / camera.width
    view = blender.data.objects.new("view", data)
    blender.context.scene.collection.objects.link(view)
    world = np.array(collection.r5dgs.root.matrix_world, np.float64)
    view.matrix_world = Matrix((world @ cameras.cam_world_to_opengl(camera.T_cam_world)).tolist())
    blender.context.scene.camera = view
    blender.ops.r5dgs.use_engine()
    blender.ops.r5dgs.show_colors_as_trained()
    settings = blender.context.scene.render
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = camera.width, camera.height, 100
    settings.dither_intensity = 0.0
    return collection


def go_to(bpy, t):
    frame = 1 + 60 * t
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame % 1))


def render_png(bpy, folder, name="out"):
    """Image that Blender saves, with 8 bits per channel, divided by 255. [H, W, 3 or 4]"""
    settings = bpy.context.scene.render
    settings.filepath = str(folder / f"{name}.png")
    if hasattr(settings.image_settings, "media_type"):
        settings.image_settings.media_type = "IMAGE"
    settings.image_settings.file_format = "PNG"
    settings.image_settings.color_mode = "RGBA" if settings.film_transparent else "RGB"
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return images.read(settings.filepath)


def render_passes(bpy, folder):
    """Passes of a multilayer EXR by name. [H, W, channels] each"""
    compat = importlib.import_module("r5dgs.r5dgs_addon.compat")
    settings = bpy.context.scene.render
    settings.filepath = str(folder / "out.exr")
    if hasattr(settings.image_settings, "media_type"):
        settings.image_settings.media_type = "MULTI_LAYER_IMAGE"
    settings.image_settings.file_format, settings.image_settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    found = pictures.read_exr(settings.filepath)
    return types.SimpleNamespace(
        combined=np.stack([found[f"Combined.{c}"] for c in "RGBA"], -1),
        depth=found.get("Depth.Z"),
        index=found.get(f"{compat.OBJECT_INDEX}.X"),
        names={name.split(".")[0] for name in found},
        found=found,
    )


def metadata_of(path):
    """The header of an EXR."""
    return {one.name: one.value for one in OpenImageIO.ImageInput.open(str(path)).spec().extra_attribs}


def core(scene, t, background="scene", camera=None):
    """The core's own picture."""
    pose = scene_player.Player(scene).frame(t)
    return scene_renderer.render_frame(scene, pose, camera or scene.cameras[0], background=background)


def to_linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def assert_almost_all_close(actual, expected, atol):
    """Assert closeness except for a few pixels at the border of a Gaussian, which depend on rounding."""
    assert actual.shape == expected.shape
    assert (np.abs(actual - expected) > atol).mean() < 1e-3 and np.abs(actual - expected).max() < 0.02


def psnr(a, b):
    return -10 * np.log10(max(float(np.square(np.asarray(a, np.float64) - b).mean()), 1e-12))


@pytest.mark.parametrize("t", [0.0, 0.3334, 0.9071])
def test_a_rendered_picture_is_saved_with_the_cores_bytes(blender, loaded, scene, tmp_path, t):
    go_to(blender, t)
    expected = np.clip(core(scene, t).color, 0, 1)
    saved = render_png(blender, tmp_path)
    assert psnr(saved, expected) > 45
    assert np.abs(255 * saved - np.round(255 * expected)).max() <= 1.001


def test_the_passes_are_linear_colour_depth_along_the_axis_and_the_object_in_front(blender, loaded, scene, tmp_path):
    layer = blender.context.view_layer
    layer.use_pass_z = layer.use_pass_object_index = True
    loaded.all_objects["mug"].pass_index = 77
    go_to(blender, scene.t_max)
    passes = render_passes(blender, tmp_path)
    expected = core(scene, scene.t_max)
    color, alpha, depth = expected.color, expected.alpha, expected.depth
    assert_almost_all_close(passes.combined[..., :3], to_linear(color), 1e-3)
    assert (passes.combined[..., 3] == 1).all()
    solid = alpha > 0.5 + 1e-4
    assert_almost_all_close(passes.depth[solid], depth[solid], 1e-3)
    assert (passes.depth[alpha < 0.5 - 1e-4] == NOTHING).all() and solid.any() and not solid.all()
    names = {item.name: item.id for item in scene.objects}
    wanted = {77 if name == "mug" else max(number, 0) for name, number in names.items()}
    assert set(np.unique(passes.index)) <= wanted and 77 in passes.index
    loaded.all_objects["mug"].hide_render = True
    assert 77 not in render_passes(blender, tmp_path).index


def test_cryptomatte_shares_pixels_among_objects_by_name(blender, loaded, scene, tmp_path):
    cryptomatte = importlib.import_module("r5dgs_core.formats.cryptomatte")
    layer = blender.context.view_layer
    layer.use_pass_cryptomatte_object, layer.pass_cryptomatte_depth = True, 4
    go_to(blender, 0.3)
    passes = render_passes(blender, tmp_path)
    assert {name for name in passes.names if name.startswith("Crypto")} == {"CryptoObject00", "CryptoObject01"}
    ranks = [(f"CryptoObject0{k}.{name}", f"CryptoObject0{k}.{part}") for k in (0, 1) for name, part in ("rg", "ba")]
    mug = sum(np.where(passes.found[i] == cryptomatte.value_of("mug"), passes.found[c], 0) for i, c in ranks)
    pose = scene_player.Player(scene).frame(0.3)
    one_hot = ((scene.gaussians.object_ids == 1) & (scene.gaussians.motion_ids == 1)).astype(np.float32)[:, None]
    expected = scene_renderer.render_frame(scene, pose, scene.cameras[0], features=one_hot).features[..., 0]
    assert_almost_all_close(mug, expected, 1e-3)
    alpha = core(scene, 0.3).alpha
    assert np.abs(sum(passes.found[c] for _, c in ranks) - alpha).mean() < 0.01  # what four levels leave out
    header = metadata_of(tmp_path / "out.exr")
    (start,) = {key.rsplit("/", 1)[0] for key in header if key.startswith("cryptomatte/")}
    assert header[f"{start}/name"] == f"{layer.name}.CryptoObject"
    assert json.loads(header[f"{start}/manifest"])["mug"] == f"{cryptomatte.hash_of('mug'):08x}"


def test_disabled_passes_are_not_written(blender, loaded, tmp_path):
    assert render_passes(blender, tmp_path).names == {"Combined"}


def test_a_transparent_film_has_the_cores_alpha_and_straight_colours(blender, loaded, scene, tmp_path):
    go_to(blender, 0.4)
    blender.context.scene.render.film_transparent = True
    expected = core(scene, 0.4, background=None)
    alpha = expected.alpha
    straight = expected.color / np.maximum(alpha, 1e-6)[..., None]
    passes = render_passes(blender, tmp_path)
    assert_almost_all_close(passes.combined[..., 3], alpha, 1e-3)
    assert_almost_all_close(passes.combined[..., :3], alpha[..., None] * to_linear(straight), 1e-3)
    saved = render_png(blender, tmp_path)
    seen = alpha > 0.1
    assert psnr(saved[..., 3], alpha) > 45 and psnr(saved[seen][:, :3], np.clip(straight, 0, 1)[seen]) > 45


def test_without_sky_the_background_is_black(blender, loaded, scene, tmp_path):
    blender.context.scene.r5dgs_render.sky = False
    go_to(blender, 0.0)
    assert psnr(render_png(blender, tmp_path), np.clip(core(scene, 0.0, background=None).color, 0, 1)) > 45


@pytest.mark.parametrize("border", [(0.3, 0.8, 0.1, 0.6), (0.0, 0.5, 0.71, 1.0), (0.123, 0.777, 0.311, 0.899)])
def test_a_border_renders_a_part_of_the_whole_picture(blender, loaded, tmp_path, border):
    settings = blender.context.scene.render
    settings.resolution_x, settings.resolution_y = 97, 71
    whole = render_png(blender, tmp_path)
    settings.use_border = True
    settings.border_min_x, settings.border_max_x, settings.border_min_y, settings.border_max_y = border
    part = render_png(blender, tmp_path)
    settings.use_crop_to_border = True
    cut = render_png(blender, tmp_path)
    left, below = int(border[0] * 97), int(border[2] * 71)
    height, width = cut.shape[:2]
    rows = slice(71 - below - height, 71 - below)
    assert part.shape == whole.shape
    assert np.abs(255 * (part[rows, left : left + width] - whole[rows, left : left + width])).max() <= 1.001
    np.testing.assert_array_equal(cut, part[rows, left : left + width])
    outside = part.copy()
    outside[rows, left : left + width] = 0
    assert not outside.any()


def test_percentage_scales_the_picture(blender, loaded, scene, tmp_path):
    settings = blender.context.scene.render
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = 192, 144, 50
    go_to(blender, 0.2)
    assert psnr(render_png(blender, tmp_path), np.clip(core(scene, 0.2).color, 0, 1)) > 45


def test_each_view_layer_has_its_own_picture(blender, loaded, tmp_path):
    blender.context.view_layer.use_pass_z = True
    other = blender.context.scene.view_layers.new("nothing")
    other.use_pass_z = other.use_pass_object_index = other.use_pass_cryptomatte_object = True
    other.layer_collection.children[loaded.name].exclude = True
    render_passes(blender, tmp_path)
    layers = pictures.read_exr(tmp_path / "out.exr", parts=3)
    assert (layers["nothing.Depth.Z"] == NOTHING).all() and not layers["nothing.Combined.R"].any()
    assert layers["ViewLayer.Depth.Z"].min() < 10 and layers["ViewLayer.Combined.R"].any()
    assert {"nothing.CryptoObject02.a"} <= set(layers) and "ViewLayer.CryptoObject00.r" not in layers


def test_two_scenes_occlude_each_other_in_one_picture(blender, loaded, scene, tmp_path):
    other = scenes.make_scene(n=300, objects=1, sh_degree=0, seed=9, world_convention="colmap")
    blender.ops.r5dgs.load_scene(filepath=str(scene_file.write(other, tmp_path / "other.r5dgs")))
    blender.context.view_layer.use_pass_object_index = True
    second = next(c for c in blender.data.collections if c.r5dgs.is_scene and c != loaded)
    for obj in list(second.all_objects):  # a change may stop an iteration over them
        obj.pass_index = 50
    both = render_passes(blender, tmp_path).index
    for obj in list(loaded.all_objects):
        obj.hide_render = True
    alone = render_passes(blender, tmp_path).index
    assert set(np.unique(alone)) == {0, 50} and (alone[both == 50] == 50).mean() > 0.9
    assert ((alone == 50) & (both != 50)).any() and len(np.unique(both)) > 2


def test_an_animation_is_its_frames(blender, loaded, tmp_path):
    blend_scene = blender.context.scene
    blend_scene.frame_start, blend_scene.frame_end, blend_scene.frame_step = 2, 50, 24
    (tmp_path / "many").mkdir()
    blend_scene.render.filepath = str(tmp_path / "many") + "/"
    blend_scene.render.image_settings.file_format = "PNG"
    assert blender.ops.render.render(animation=True) == {"FINISHED"}
    written = sorted(path.name for path in (tmp_path / "many").iterdir())
    assert written == ["0002.png", "0026.png", "0050.png"]
    for name in written:
        blend_scene.frame_set(int(name[:4]))
        np.testing.assert_array_equal(images.read(tmp_path / "many" / name)[..., :3], render_png(blender, tmp_path))


def test_colour_management_that_changes_colours_is_named_and_corrected(blender, loaded):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    blend_scene = blender.context.scene
    view, settings = blend_scene.view_settings, blend_scene.r5dgs_render
    settings.as_trained = False
    assert color.objections(blend_scene) == []
    view.view_transform, view.exposure, view.gamma, view.use_curve_mapping = "AgX", 0.5, 1.2, True
    view.look = "AgX - Punchy"
    found = color.objections(blend_scene)
    assert found == ["view transform AgX", "look AgX - Punchy", "exposure 0.5", "gamma 1.2", "curves"]
    panels = importlib.import_module("r5dgs.r5dgs_addon.panels.render")
    said = layouts.draw(blender, *panels.CLASSES)
    assert ", ".join(found) in " ".join(said) and "r5dgs.show_colors_as_trained" in said and "use_pass_z" in said
    blender.ops.r5dgs.show_colors_as_trained()
    assert color.objections(blend_scene) == []
    assert "r5dgs.show_colors_as_trained" not in layouts.draw(blender, *panels.CLASSES)


@pytest.mark.default_cases("AgX-AgX - Medium High Contrast-1")
@pytest.mark.parametrize(
    ("view", "look", "exposure"),
    [("AgX", "None", 0), ("AgX", "AgX - Medium High Contrast", 1), ("Filmic", "None", -1.5), ("Standard", "None", 2)],
)
def test_other_view_transforms_are_inverted(blender, loaded, scene, tmp_path, view, look, exposure):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    settings = blender.context.scene.view_settings
    settings.view_transform, settings.exposure = view, exposure
    settings.look = look
    go_to(blender, 0.3)
    expected = np.clip(core(scene, 0.3).color, 0, 1)
    saved = render_png(blender, tmp_path)
    near = 255 * np.abs(saved - expected).max(axis=-1)
    reached = np.ptp(expected, axis=-1) < 0.3 if view == "AgX" else np.full(near.shape, True)
    assert reached.mean() > 0.2 and np.median(near[reached]) <= 1 and np.percentile(near[reached], 95) < 3
    assert color.objections(blender.context.scene) == []
    said = layouts.draw(blender, *importlib.import_module("r5dgs.r5dgs_addon.panels.render").CLASSES)
    assert f"{view} is inverted for Gaussians" in said and ("are paler" in "".join(said)) == (view == "AgX")
    blender.context.scene.r5dgs_render.as_trained = False
    assert np.abs(render_png(blender, tmp_path, "changed") - expected).mean() > 5 * np.abs(saved - expected).mean()


def test_using_the_engine_keeps_the_view_transform_and_reports_its_loss(blender, loaded, scene, tmp_path, capfd):
    loss = importlib.import_module("r5dgs.r5dgs_addon.color.inverse_loss")
    view, found = blender.context.scene.view_settings, {}
    for name in ("AgX", "Filmic", "Standard"):
        view.view_transform, view.exposure = name, 0.25 if name == "AgX" else 0.0
        blender.context.scene.render.engine = "CYCLES"
        capfd.readouterr()
        assert blender.ops.r5dgs.use_engine() == {"FINISHED"}
        assert (view.view_transform, blender.context.scene.render.engine) == (name, "R5DGS")
        assert view.exposure == (0.25 if name == "AgX" else 0.0)
        said, found[name] = capfd.readouterr().out, loss.measure(blender.context.scene)
        if name == "Standard":
            assert found[name] is None and said.strip() == "Info: Engine R5DGS"
            continue
        assert loss.note(found[name]) in said
        assert ("Warning" in said and "Show Colors as Trained" in said) == (found[name].psnr < loss.ENOUGH_DB)
        shown = layouts.draw(blender, blender.types.R5DGS_PT_render, blender.types.R5DGS_PT_preview)
        assert f"{name}: {loss.note(found[name])}" in " ".join(shown)
    assert found["AgX"].psnr < loss.ENOUGH_DB < 50 < found["Filmic"].psnr  # these random colours are saturated
    assert found["Filmic"].unreached < 0.01 < 0.05 < found["AgX"].unreached
    view.view_transform = "False Color"
    blender.ops.r5dgs.use_engine()
    assert "colors differ from the trained ones because of: view transform False Color" in capfd.readouterr().out


def test_the_loss_under_another_exposure_does_not_read_points_again(blender, loaded, monkeypatch):
    loss, reads = importlib.import_module("r5dgs.r5dgs_addon.color.inverse_loss"), []
    plain = loss._colors
    monkeypatch.setattr(loss, "_colors", lambda collections: reads.append(1) or plain(collections))
    loss.unregister()  # forgets what loading has measured
    view = blender.context.scene.view_settings
    view.view_transform = "AgX"
    for view.exposure in (0.5, 0.75, 1.0):
        assert loss.measure(blender.context.scene) is not None
    assert len(reads) == 1


def test_invertible_curves_are_inverted_and_others_reported(blender, loaded, scene, tmp_path):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    view = blender.context.scene.view_settings
    view.use_curve_mapping = True
    curve = view.curve_mapping.curves[3]
    curve.points.new(0.4, 0.55)
    view.curve_mapping.update()
    go_to(blender, 0.0)
    expected = np.clip(core(scene, 0.0).color, 0, 1)
    assert psnr(render_png(blender, tmp_path), expected) > 45 and color.objections(blender.context.scene) == []
    curve.points[1].location = (0.4, 0.3)  # another curve is another view
    view.curve_mapping.update()
    assert psnr(render_png(blender, tmp_path), expected) > 45
    view.use_curve_mapping, view.view_transform = False, "False Color"
    render_png(blender, tmp_path)
    assert color.objections(blender.context.scene) == ["view transform False Color"]


def test_an_output_with_its_own_view_transform_is_named(blender, loaded):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    blend_scene = blender.context.scene
    output = blend_scene.render.image_settings
    output.color_management, output.view_settings.view_transform = "OVERRIDE", "Filmic"
    assert color.objections(blend_scene) == ["the output's own color management"]
    blender.ops.r5dgs.show_colors_as_trained()
    assert color.objections(blend_scene) == []


def test_a_transparent_film_has_straight_colours_as_trained_under_agx(blender, loaded, scene, tmp_path):
    blender.context.scene.view_settings.view_transform = "AgX"
    blender.context.scene.render.film_transparent = True
    go_to(blender, 0.4)
    expected = core(scene, 0.4, background=None)
    alpha = expected.alpha
    straight = np.clip(expected.color / np.maximum(alpha, 1e-6)[..., None], 0, 1)
    saved = render_png(blender, tmp_path)
    pale = (alpha > 0.1) & (np.ptp(straight, axis=-1) < 0.3)
    assert psnr(saved[..., 3], alpha) > 45 and pale.sum() > 50
    assert np.median(255 * np.abs(saved[pale][:, :3] - straight[pale]).max(axis=-1)) <= 1


def inverse_of(bpy):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    return color.wait_for_inverse(bpy.context.scene, lambda: False)


def test_inverting_a_view_leaves_nothing_behind(blender, loaded):
    view_module = importlib.import_module("r5dgs.r5dgs_addon.color.view_transform")
    before = len(blender.data.scenes), len(blender.data.images)
    blender.context.scene.view_settings.view_transform = "Filmic"
    made = inverse_of(blender)
    assert (len(blender.data.scenes), len(blender.data.images)) == before
    blender.context.scene.view_settings.exposure = 1
    assert inverse_of(blender).grid is made.grid  # an exposure is a factor
    blender.context.scene.view_settings.exposure = 0
    assert view_module.cached_or_requested(blender.context.scene) is made


def test_a_view_is_inverted_without_a_window(blender, loaded, monkeypatch):
    """As in `blender -b FILE -a`, in which removing a new scene crashed Blender 4.2 and 4.3."""
    view_module = importlib.import_module("r5dgs.r5dgs_addon.color.view_transform")
    monkeypatch.setattr(view_module, "_inverses", {})
    blender.context.scene.view_settings.view_transform = "Filmic"
    with blender.context.temp_override(window=None):
        assert blender.context.window is None
        assert inverse_of(blender).error < 0.5
    assert len(blender.data.scenes) == 1


def test_a_view_that_cannot_be_sampled_is_named_and_still_rendered(blender, loaded, tmp_path, monkeypatch):
    color = importlib.import_module("r5dgs.r5dgs_addon.color.display_to_linear")
    view_module = importlib.import_module("r5dgs.r5dgs_addon.color.view_transform")
    blender.context.scene.view_settings.view_transform = "Filmic"
    tried, before = [], len(blender.data.scenes)

    def full(self, colors):
        tried.append(len(colors))
        raise RuntimeError("the disk is full")

    monkeypatch.setattr(view_module, "_inverses", {})
    monkeypatch.setattr(view_module._Sampler, "displayed", full)
    render_png(blender, tmp_path)
    render_png(blender, tmp_path)
    assert len(tried) == 1 and len(blender.data.scenes) == before
    assert color.objections(blender.context.scene) == ["view transform Filmic"]


def test_the_timer_computes_requested_view_inverses_once_edits_pause(blender, loaded, monkeypatch):
    view_module = importlib.import_module("r5dgs.r5dgs_addon.color.view_transform")
    settings = blender.context.scene.view_settings
    made, now = [], [100.0]
    monkeypatch.setattr(view_module, "_inverses", {})
    monkeypatch.setattr(view_module, "_make", made.append)
    monkeypatch.setattr(view_module.time, "monotonic", lambda: now[0])
    for gamma in (1.1, 1.2, 1.3):
        settings.gamma = gamma
        assert view_module.cached_or_requested(blender.context.scene) is None
        view_module.compute_due()
    assert made == []
    now[0] += 1
    view_module.compute_due()
    assert [one.gamma for one in made] == [settings.gamma]


@pytest.mark.parametrize("view", ["Standard", "Filmic"])
@pytest.mark.parametrize("space", ["Linear Rec.2020", "ACEScg"])
def test_other_working_spaces_show_the_same_bytes(blender, loaded, scene, tmp_path, space, view):
    if not hasattr(blender.data, "colorspace"):
        pytest.skip("this Blender has one scene-linear space only")
    blender.ops.wm.set_working_color_space(working_space=space, convert_colors=False)
    blender.context.scene.view_settings.view_transform = view
    go_to(blender, 0.0)
    assert psnr(render_png(blender, tmp_path), np.clip(core(scene, 0.0).color, 0, 1)) > 45


def test_a_failed_render_raises_an_error_and_writes_no_file(blender, loaded, tmp_path):
    (tmp_path / "scene.r5dgs").rename(tmp_path / "gone.r5dgs")
    with pytest.raises(RuntimeError, match="scene.r5dgs.*Scene File"):
        render_png(blender, tmp_path, "nothing")
    assert not (tmp_path / "nothing.png").exists()
    (tmp_path / "gone.r5dgs").rename(tmp_path / "scene.r5dgs")
    for collection in list(blender.data.collections):
        blender.data.collections.remove(collection)
    with pytest.raises(RuntimeError, match="File > Import"):
        render_png(blender, tmp_path, "nothing")
    assert not (tmp_path / "nothing.png").exists()


def test_rendering_with_a_panoramic_camera_raises(blender, loaded, tmp_path):
    blender.context.scene.camera.data.type = "PANO"
    with pytest.raises(RuntimeError, match="Perspective"):
        render_png(blender, tmp_path, "nothing")
    assert not (tmp_path / "nothing.png").exists()


class Engine:
    """Stub of the render engine whose user stops at once."""

    def __init__(self, module):
        self.said = []
        methods = {name: vars(module.R5DGS_RenderEngine)[name] for name in ("_ask", "_stopped", "_say", "_said")}
        stub = {"update_stats": lambda _, __, text: self.said.append(text), "test_break": lambda _: True}
        self.engine = type("Engine", (), {**methods, **stub})()


def test_a_render_is_stopped_while_the_worker_hangs_and_the_next_one_works(blender, loaded, tmp_path):
    engine = importlib.import_module("r5dgs.r5dgs_addon.engine.engine")
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    worker = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    stopped = Engine(engine)
    steps = picture.steps(picture.shown(blender.context.evaluated_depsgraph_get()))
    assert stopped.engine._ask(steps) is None and stopped.said
    assert not running.alive and not worker.busy()
    render_png(blender, tmp_path)


def test_a_worker_killed_during_a_render_is_reported_and_restarted(blender, loaded, tmp_path):
    running = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs").current()
    os.kill(running.pid, signal.SIGSTOP)  # so that the render waits
    killer = threading.Timer(0.5, os.kill, (running.pid, signal.SIGKILL))
    killer.start()
    with pytest.raises(RuntimeError, match="ended unexpectedly"):
        render_png(blender, tmp_path, "nothing")
    killer.join()
    assert not (tmp_path / "nothing.png").exists()
    render_png(blender, tmp_path)


def test_blenders_panels_for_all_engines_are_shown_and_restored(blender, extension):
    compat = importlib.import_module("r5dgs.r5dgs_addon.compat")
    panels = {panel.__name__ for panel in blender.types.Panel.__subclasses__()}
    assert {"RENDER_PT_format", "RENDER_PT_output", "DATA_PT_lens"} <= panels
    assert all("R5DGS" in panel.COMPAT_ENGINES for panel in compat.panels_of_all_engines())
    extension.unregister()
    try:
        left = [p for p in blender.types.Panel.__subclasses__() if "R5DGS" in getattr(p, "COMPAT_ENGINES", ())]
        assert [panel for panel in left if not panel.__module__.startswith("r5dgs.")] == []
        assert not hasattr(blender.types.Scene, "r5dgs_render")
    finally:
        extension.register()
