"""What Blender shows as Gaussians for others: the clouds of a frame, carried to where they are, in the axes wanted."""

from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ..r5dgs_core import errors
from ..r5dgs_core.scene import cameras, carried, ply, scene_file
from ..r5dgs_core.scene.scene import Scene
from . import export_running, look, objects, picture
from .export_running import Outcome, Step, Steps

AXES = (
    ("BLENDER", "Blender World", "As Blender shows it: z up"),
    ("FILE", "Scene File", "The world of the .r5dgs file, in which its cameras and data set are"),
    ("COLMAP", "COLMAP (Y Down)", "Blender's world turned to x right, y down, z forward, as many viewers expect"),
    ("OPENGL", "OpenGL (Y Up)", "Blender's world turned to x right, y up, z backward"),
)
WHICH = (
    ("SELECTED", "Selected", "Selected objects, and the clouds of selected anchors and roots"),
    ("VISIBLE", "All Visible", "Everything that can be seen in this view layer"),
)


@dataclass
class Sources:
    """Where the Gaussians of clouds come from; scene files are read once.

    Attributes:
        notes: What has to be said about it, each once.
    """

    notes: list[str] = field(default_factory=list)
    _scenes: dict[int, Scene | None] = field(default_factory=dict)

    def scene(self, collection: bpy.types.Collection | None) -> Scene | None:
        """The scene file of a loaded scene, or None where it is gone or damaged."""
        if collection is None:
            return None
        if collection.session_uid not in self._scenes:
            try:
                self._scenes[collection.session_uid] = scene_file.read(picture.scene_path(collection))
            except errors.R5dgsError as error:
                self._scenes[collection.session_uid] = None
                self.note(f"Taken from the points in Blender, without shading: {error}")
        return self._scenes[collection.session_uid]

    def note(self, text: str) -> None:
        """Remember what has to be said in the end."""
        if text not in self.notes:
            self.notes.append(text)


def clouds(context: bpy.types.Context, which: str) -> list[bpy.types.Object]:
    """The clouds to export, of `WHICH`, in the order of their scenes; hidden ones are left out at each frame."""
    found = [obj for obj in context.view_layer.objects if obj.r5dgs.role == "CLOUD" and obj.type == "POINTCLOUD"]
    if which == "SELECTED":
        selected = set(context.selected_objects)
        selected |= {
            child for obj in selected if obj.r5dgs.role in ("ANCHOR", "ROOT") for child in obj.children_recursive
        }
        found = [obj for obj in found if obj in selected]
    return sorted(found, key=lambda obj: (obj.r5dgs.start, obj.name))


def scene_of(obj: bpy.types.Object) -> bpy.types.Collection | None:
    """The loaded scene that an object belongs to."""
    for collection in objects.scene_collections():
        if obj.name in collection.all_objects and collection.all_objects[obj.name] == obj:
            return collection
    return None


def world_to(axes: str, collection: bpy.types.Collection | None, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """The map from Blender's world to the axes wanted, of `AXES`. [4, 4]"""
    result = np.eye(4)
    if axes == "FILE":
        root = None if collection is None else collection.r5dgs.root
        if root is not None:
            result = np.linalg.inv(np.array(root.evaluated_get(depsgraph).matrix_world, np.float64))
    elif axes != "BLENDER":
        result[:3, :3] = cameras.WORLD_TO_BLENDER[axes.lower()].T
    return result


def splats_of(
    context: bpy.types.Context, chosen: list[bpy.types.Object], axes: str, sources: Sources
) -> tuple[ply.Splats, list[str]]:
    """The Gaussians of clouds as they are at the current frame.

    Args:
        context: Its scene has the frame; what its view layer hides is left out.
        chosen: Clouds.
        axes: Of `AXES`.
        sources: Where they come from, and what has to be said.

    Returns:
        The Gaussians, and the names of the clouds that are in them.
    """
    depsgraph = context.evaluated_depsgraph_get()
    parts, names = [], []
    for obj in chosen:
        if not obj.visible_get(view_layer=context.view_layer):
            continue
        collection = scene_of(obj)
        matrix = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
        if np.linalg.matrix_rank(matrix[:3, :3], tol=1e-9) < 3:
            sources.note(f"{obj.name}: left out where it is scaled to nothing")
            continue
        parts.append(_splats(obj, world_to(axes, collection, depsgraph) @ matrix, sources, collection))
        names.append(obj.name)
        if parts[-1].sh.shape[1] > 1 and not carried.is_similarity(matrix[:3, :3]):
            sources.note(f"{obj.name}: scaled unevenly; how its colours change with the direction is a best fit")
    return carried.join(parts), names


def _splats(
    obj: bpy.types.Object, matrix: np.ndarray, sources: Sources, collection: bpy.types.Collection | None
) -> ply.Splats:
    scene, state = sources.scene(collection), obj.r5dgs
    if scene is not None and state.start + state.count <= len(scene.means):
        if len(obj.data.points) == state.count:
            return carried.place(scene, state.start, state.count, matrix, look.tint(obj))
        sources.note(f"{obj.name}: taken from its points in Blender, as some were added or removed; without shading")
    return carried.carry(from_points(obj.data, state.object_id), matrix, look.tint(obj))


def from_points(cloud: bpy.types.PointCloud, object_id: int) -> ply.Splats:
    """Gaussians out of the attributes that `clouds.fill` writes.

    Raises:
        SceneFileError: The points are no Gaussians.
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
    return ply.Splats(
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
    """Write clouds as 3DGS PLY, one file for each frame.

    Args:
        context: Its scene has the frames.
        path: The file; those of a range get the frame's number behind the name.
        which: Of `WHICH`.
        axes: Of `AXES`.
        plain: Leave identities and ids out.
        every: The scene's frame range instead of the current frame.
        step: Frames from one file to the next.

    Raises:
        ConfigError: Nothing is chosen.
        SceneFileError: A file cannot be written, or points are no Gaussians.
    """
    chosen, sources, scene = clouds(context, which), Sources(), context.scene
    if not chosen:
        wanted = "a selected object of a loaded scene" if which == "SELECTED" else "a loaded scene with objects"
        raise errors.ConfigError(f"export: expected {wanted}, found none; select objects or load a scene first")
    frames, counts = export_running.frames_of(scene, every, step), []
    with export_running.frame_kept(scene):
        for number, frame in enumerate(frames):
            target = export_running.numbered(path, frame) if every else path
            yield Step(number, len(frames), target.name)
            export_running.go_to(scene, frame)
            splats, names = splats_of(context, chosen, axes, sources)
            if not names and not every:
                raise errors.ConfigError("export: expected something visible, found all of it hidden; show it first")
            ply.write(splats, target, plain=plain)
            counts.append(len(splats.means))
    files = f"{len(frames)} files" if every else path.name
    return Outcome(f"{files}: {max(counts)} Gaussians of {len(chosen)} clouds", sources.notes)
