"""Visible splats of a view layer, and their Gaussians on the graphics card.

Blender's handlers may run in a render thread, which must not touch the data of a viewport. They only queue the changes;
these are applied when a viewport is drawn.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import bpy
import numpy as np

from ...r5dgs_core.playback import affine_transform
from ...r5dgs_core.scene import diffuse_shading
from .. import compat
from ..engine import visible_clouds
from ..scene import evaluated_points, loaded_scenes, viewport_display
from . import gaussian_table
from . import splat_renderer as renderer

Slot = tuple[int, int, int]  # key of a cloud in a table: object, instancer, index among its instances
LayerKey = tuple[int, str]


@dataclass(frozen=True)
class VisibleSplats:
    """Visible splats of a viewport.

    Attributes:
        table: Their Gaussians.
        groups: The visible groups.
        sky: Coefficients of the sky, [K, 3], or None; of the first scene shown as splats.
        world: Map from that scene's world to Blender's. [4, 4]
    """

    table: renderer.SplatTable
    groups: tuple[renderer.Group, ...]
    sky: np.ndarray | None
    world: np.ndarray


@dataclass
class _Layer:
    """Gaussians that a view layer shows: points by `session_uid` of the object, and the table with its slots.

    Points of one view layer may differ from those of another. Those of ``changed`` objects have to be read again.
    """

    clouds: dict[int, gaussian_table.CloudData] = field(default_factory=dict)
    table: tuple[tuple[Slot, ...], renderer.SplatTable] | None = None
    changed: set[int] = field(default_factory=set)

    def drop(self, uids: set[int]) -> None:
        """Forget the points of objects."""
        if self.table is not None and any(slot[0] in uids for slot in self.table[0]):
            self.table = None
        for uid in uids & self.clouds.keys():
            del self.clouds[uid]
        self.changed -= uids

    def update(self, uid: int, found: gaussian_table.CloudData) -> None:
        """Store the points of an object. If only their geometry changed, the table is kept."""
        known = self.clouds.get(uid)
        self.clouds[uid] = found
        self.changed.discard(uid)
        if self.table is None or known is None:
            return
        slots, table = self.table
        if found.look is known.look and len(found.geometry.positions) == len(known.geometry.positions):
            for number in (number for number, slot in enumerate(slots) if slot[0] == uid):
                table.move(number, found.geometry)
        else:
            self.table = None


_layers: dict[LayerKey, _Layer] = {}
_changes: deque[frozenset[int] | None] = deque(maxlen=1000)  # appending is atomic; if full, some may be lost


def queue_change(uids: Iterable[int]) -> None:
    """Queue objects or point clouds whose points changed, by `session_uid`. Any thread may call this."""
    _changes.append(frozenset(uids))


def queue_reload() -> None:
    """Request that all points are read again. Any thread may call this."""
    _changes.append(None)


def catch_up() -> set[int] | None:
    """Apply the queued changes, and drop the data of unused view layers and deleted objects.

    Returns:
        The queued objects and data, by `session_uid`; None if everything may have changed.
    """
    if not _changes:
        return set()
    changed: set[int] = set()
    everything = len(_changes) == _changes.maxlen
    while _changes:
        uids = _changes.popleft()
        everything |= uids is None
        changed |= uids or set()
    if everything:
        _layers.clear()
    windows = bpy.context.window_manager.windows
    current = {layer_key(window.scene, window.view_layer) for window in windows}
    alive = {obj.session_uid for obj in bpy.data.objects}
    for key in list(_layers):
        if current and key not in current:
            del _layers[key]
        else:
            _layers[key].drop(_layers[key].clouds.keys() - alive)
            _layers[key].changed |= changed & _layers[key].clouds.keys()
    return None if everything else changed


def forget() -> None:
    """Release all tables."""
    _layers.clear()
    _changes.clear()


def layer_key(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> LayerKey:
    """Key of a view layer, the same for evaluated scenes."""
    return scene.session_uid, view_layer.name


def shown(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> VisibleSplats | None:
    """Return the visible splats of the loaded scenes with display *Splats*, or None if there are none.

    Point clouds that Blender itself draws as Gaussian splats are left out.

    Args:
        depsgraph: Evaluated depsgraph.
        space: 3D view whose local view is respected.

    Raises:
        ConfigError: There are more Gaussians than the graphics card's textures hold.
    """
    scenes, clouds = visible_clouds.instances(depsgraph, space, edits=False)
    clouds = [one for one in clouds if one.seen and one.collection.r5dgs.display == viewport_display.SPLATS]
    clouds = [one for one in clouds if not compat.is_gaussian_splat(one.object.data)]
    layer = _layers.setdefault(layer_key(depsgraph.scene, depsgraph.view_layer), _Layer())
    for uid, obj in {one.object.session_uid: one.object for one in clouds}.items():
        if uid not in layer.clouds or uid in layer.changed:
            evaluated = evaluated_points.evaluated(obj, depsgraph)
            layer.update(uid, gaussian_table.read(evaluated, obj.color, layer.clouds.get(uid)))
    if not clouds:
        return None
    slots = _slots(clouds)
    if layer.table is None or not set(slots) <= set(layer.table[0]):
        layer.table = None  # released before the new one is made
        layer.table = slots, renderer.SplatTable(gaussian_table.pack([layer.clouds[uid] for uid, *_ in slots]))
    numbers = {slot: number for number, slot in enumerate(layer.table[0])}
    groups = _groups([numbers[slot] for slot in slots], clouds)
    present = {one.collection for one in clouds}
    first = next(scene for scene in scenes if scene in present)
    return VisibleSplats(layer.table[1], groups, _sky(first), visible_clouds.world_of(first, depsgraph))


def _slots(clouds: list[visible_clouds.VisibleCloud]) -> tuple[Slot, ...]:
    found: list[Slot] = []
    numbers: dict[tuple[int, int], int] = {}
    for one in clouds:
        key = (one.object.session_uid, 0 if one.parent is None else one.parent.session_uid)
        numbers[key] = numbers.get(key, -1) + 1
        found.append((*key, numbers[key]))
    return tuple(found)


def _groups(numbers: list[int], clouds: list[visible_clouds.VisibleCloud]) -> tuple[renderer.Group, ...]:
    """Groups of visible clouds; the turns of all are found at once."""
    linear = np.array([one.matrix[:3, :3] for one in clouds] + [one.world[:3, :3] for one in clouds], np.float64)
    rotations, found = affine_transform.nearest_rotation(linear), []
    turns = np.swapaxes(rotations[len(clouds) :], -1, -2) @ rotations[: len(clouds)]
    for number, cloud, turn in zip(numbers, clouds, turns, strict=True):
        light, lit = loaded_scenes.light(cloud.collection), {}
        if light is not None:
            lit = {"light_change": tuple(diffuse_shading.light_change(light, turn)), "light": tuple(light)}
        found.append(renderer.Group(number, cloud.matrix, cloud.tint, holdout=cloud.holdout, **lit))
    return tuple(found)


def _sky(collection: bpy.types.Collection) -> np.ndarray | None:
    """Coefficients of a loaded scene's sky, or None for scenes of older versions. [K, 3]"""
    values = np.array(collection.get(loaded_scenes.SKY, ()), np.float32)
    return values.reshape(-1, 3) if values.size in (3, 12, 27, 48) else None
