"""Export of the visible Gaussians of a frame, transformed to their place in the requested axes."""

from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.editing import point_edits
from ...r5dgs_core.formats import ply, registry
from ...r5dgs_core.playback import affine_transform
from ...r5dgs_core.playback.residuals import Residuals
from ...r5dgs_core.scene import cameras, scene_file
from ...r5dgs_core.scene.scene import Scene
from ...r5dgs_core.scene.splats import Splats
from ..engine import render_request, visible_clouds
from ..scene import evaluated_points, loaded_scenes, object_tint
from ..ui import plural
from ..ui.stepwise_operator import Outcome, Step, Steps
from . import frame_range

AXES = (
    ("BLENDER", "Blender World", "As Blender shows it: z up"),
    ("FILE", "Scene File", "The world of the .r5dgs file, in which its cameras and data set are"),
    ("COLMAP", "COLMAP (Y Down)", "Blender's world turned to x right, y down, z forward, as many viewers expect"),
    ("OPENGL", "OpenGL (Y Up)", "Blender's world turned to x right, y up, z backward"),
)
WHICH = (
    ("SELECTED", "Selected", "Selected objects, and the clouds of selected anchors and roots"),
    ("VISIBLE", "All Visible", "All clouds that are visible in this view layer"),
)


@dataclass
class Sources:
    """Sources of the exported Gaussians. Each scene file is read once.

    Attributes:
        notes: Messages for the user, without duplicates.
        origins: Origins that the positions of the scenes are relative to.
    """

    notes: list[str] = field(default_factory=list)
    origins: set[tuple[float, ...]] = field(default_factory=set)
    _scenes: dict[int, Scene | None] = field(default_factory=dict)
    _bending: dict[int, Residuals] = field(default_factory=dict)

    def scene(self, collection: bpy.types.Collection | None) -> Scene | None:
        """Scene file of a loaded scene, or None if it is missing or damaged."""
        if collection is None:
            return None
        if collection.session_uid not in self._scenes:
            try:
                self._scenes[collection.session_uid] = scene_file.read(render_request.scene_path(collection))
            except errors.R5dgsError as error:
                self._scenes[collection.session_uid] = None
                self.note(f"Taken from the points in Blender, without shading: {error}")
        return self._scenes[collection.session_uid]

    def bending(self, collection: bpy.types.Collection) -> Residuals:
        """Per-Gaussian residual motion of a loaded scene, whose file must exist."""
        known = self._bending.get(collection.session_uid)
        if known is None:
            scene = self.scene(collection)
            assert scene is not None
            known = self._bending[collection.session_uid] = Residuals(scene)
        return known

    def note(self, text: str) -> None:
        """Add a message for the user."""
        if text not in self.notes:
            self.notes.append(text)


def chosen(context: bpy.types.Context, which: str) -> set[bpy.types.Object] | None:
    """Selected objects and their descendants, or None for all; ``which`` is a key of `WHICH`."""
    if which == "VISIBLE":
        return None
    selected = set(context.selected_objects)
    return selected | {child for obj in selected for child in obj.children_recursive}


def shown(depsgraph: bpy.types.Depsgraph, wanted: set[bpy.types.Object] | None) -> list[visible_clouds.VisibleCloud]:
    """Visible point clouds and instances that are wanted; ``wanted`` is the result of `chosen`."""
    found = visible_clouds.instances(depsgraph)[1]
    return [one for one in found if wanted is None or one.object in wanted or one.parent in wanted]


def nothing_shown(wanted: set[bpy.types.Object] | None) -> errors.ConfigError:
    """Error of an export for which `shown` finds nothing."""
    selected = "" if wanted is None else ", selected"
    return errors.ConfigError(
        f"export: expected a visible object of a loaded scene{selected}, found none; select or show one first"
    )


def world_to(axes: str, world: np.ndarray) -> np.ndarray:
    """Transform from Blender's world to the requested axes.

    Args:
        axes: Key of `AXES`.
        world: Transform from the scene's own world to Blender's. [4, 4]

    Returns:
        The transform. [4, 4]
    """
    if axes == "FILE":
        return np.linalg.inv(world)
    result = np.eye(4)
    if axes != "BLENDER":
        result[:3, :3] = cameras.WORLD_TO_BLENDER[axes.lower()].T
    return result


def splats_of(
    context: bpy.types.Context, wanted: set[bpy.types.Object] | None, axes: str, sources: Sources
) -> tuple[Splats, list[str]]:
    """Gaussians that Blender shows at the current frame.

    Args:
        context: Context with the current frame; objects hidden in its view layer are skipped.
        wanted: Result of `chosen`.
        axes: Key of `AXES`.
        sources: Source scenes; receives messages for the user.

    Returns:
        Gaussians, and the names of their point clouds.
    """
    depsgraph = context.evaluated_depsgraph_get()
    parts, names = [], []
    for one in shown(depsgraph, wanted):
        scene, turn = sources.scene(one.collection), world_to(axes, one.world)
        sources.origins.add(tuple(loaded_scenes.origin(one.collection).tolist()))
        matrix, names = turn @ one.matrix, [*names, one.object.name]
        for note in evaluated_points.of(one.object, depsgraph, one.collection.r5dgs.gaussians).notes:
            sources.note(note)
        if scene is not None and one.object.r5dgs.start + one.object.r5dgs.count <= len(scene.gaussians.means):
            parts.append(_placed(scene, one, matrix, turn, sources))
        else:
            points = from_points(evaluated_points.evaluated(one.object, depsgraph), one.object.r5dgs.object_id)
            parts.append(affine_transform.transform(points, matrix, np.array(one.tint)))
        if parts[-1].sh.shape[1] > 1 and not affine_transform.is_similarity(matrix[:3, :3]):
            sources.note(f"{names[-1]}: scaled non-uniformly; its view-dependent colors are a best fit")
    return affine_transform.join(parts), names


def _placed(
    scene: Scene, one: visible_clouds.VisibleCloud, matrix: np.ndarray, turn: np.ndarray, sources: Sources
) -> Splats:
    """Gaussians of a visible point cloud, read from its scene file. matrix, turn [4, 4]"""
    start, count, bending = one.start, one.count, None
    if one.edit is not None:
        whole = scene
        scene, place = point_edits.apply(scene, one.edit.points)
        start, count, matrix = place.start, place.count, matrix @ place.matrix
        bending = None if scene is whole else Residuals(scene)
    bend = None
    if one.t is not None:
        bend = affine_transform.bend_of(bending or sources.bending(one.collection), one.t, start, count)
    tint = None if one.tint == object_tint.NONE else np.array(one.tint)
    return affine_transform.place(scene, start, count, matrix, world=turn @ one.world, tint=tint, bend=bend)


def from_points(cloud: bpy.types.PointCloud, object_id: int) -> Splats:
    """Convert the attributes written by `point_clouds.fill` to Gaussians.

    Raises:
        SceneFileError: An attribute is missing.
    """
    count = len(cloud.points)

    def values(name: str, field_name: str, width: int) -> np.ndarray:
        attribute = cloud.attributes.get(name)
        if attribute is None or len(attribute.data) != count:
            raise errors.SceneFileError(
                f"{cloud.name}: expected points with the attribute '{name}', found none; load the scene again"
            )
        found = np.empty(count * width, np.float32)
        attribute.data.foreach_get(field_name, found)
        return found.reshape(count, width)

    base = values("radiance:base", "color", 4)
    rest, k = [], 0
    while cloud.attributes.get(f"radiance:sh_{k}") is not None:
        rest.append(values(f"radiance:sh_{k}", "vector", 3))
        k += 1
    opacities = np.clip(base[:, 3].astype(np.float64), 1e-7, 1 - 1e-7)
    return Splats(
        means=values("position", "vector", 3),
        quats=values("rotation", "value", 4),
        log_scales=np.log(np.maximum(values("scale", "vector", 3), 1e-30)),
        opacity_logits=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh=np.ascontiguousarray(np.stack([base[:, :3], *rest], axis=1)),
        object_ids=np.full(count, object_id, np.int32),
    )


def ply_steps(
    context: bpy.types.Context, path: Path, which: str, *, axes: str, plain: bool, every: bool, step: int = 1
) -> Steps:
    """Write point clouds as 3DGS PLY, one file per frame.

    Args:
        context: Context with the scene's frames.
        path: Output file; in a range, the frame number is appended to its name.
        which: Key of `WHICH`.
        axes: Key of `AXES`.
        plain: True to omit identities and object ids.
        every: True for the scene's frame range, False for the current frame.
        step: Number of frames from one file to the next.

    Raises:
        ConfigError: Nothing to export is visible at the current frame.
        SceneFileError: A file cannot be written, or points lack Gaussian attributes.
    """
    wanted, sources, scene = chosen(context, which), Sources(), context.scene
    frames, most, clouds = frame_range.frames_of(scene, every, step), 0, set()
    with frame_range.frame_kept(scene):
        for number, frame in enumerate(frames):
            target = registry.numbered(path, frame) if every else path
            yield Step(number, len(frames), target.name)
            frame_range.go_to(scene, frame)
            splats, names = splats_of(context, wanted, axes, sources)
            if not names and not every:
                raise nothing_shown(wanted)
            ply.write(splats, target, plain=plain, origin=_shared_origin(sources) if axes == "FILE" else None)
            most, clouds = max(most, len(splats.means)), clouds | set(names)
    for origin in sorted(sources.origins):
        if any(origin):
            sources.note(
                relative_note(np.array(origin), "PLY files hold 32-bit numbers, which would lose detail there")
            )
    if not clouds:
        sources.note("No frame shows anything to export; the files are empty")
    files = plural.of(len(frames), "file") if every else path.name
    return Outcome(f"{files}: {plural.of(most, 'Gaussian')} of {plural.of(len(clouds), 'cloud')}", sources.notes)


def relative_note(origin: np.ndarray, more: str) -> str:
    """Message that exported positions are relative to the origin of a scene. [3]"""
    return f"Positions are relative to {loaded_scenes.origin_text(origin)} of the data set's world; {more}"


def _shared_origin(sources: Sources) -> np.ndarray | None:
    """Common origin of all exported scenes, or None if they differ."""
    return np.array(next(iter(sources.origins))) if len(sources.origins) == 1 else None
