"""What several operators have in common."""

from bpy.props import IntProperty, StringProperty

from . import loaded_scenes, object_names, selection


class NeedsScene:
    """An operator that needs a loaded scene in the open Blender scene."""

    @classmethod
    def poll(cls, context):
        if loaded_scenes.active_collection(context) is None:
            cls.poll_message_set(selection.NO_SCENE)
            return False
        return True


class NeedsCamera(NeedsScene):
    """An operator that looks at loaded scenes through the active camera."""

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("Add a camera to the scene first")
            return False
        return True


class Selects:
    """An operator that selects or hides objects of loaded scenes."""

    @classmethod
    def poll(cls, context):
        obstacle = selection.obstacle(context)
        if obstacle:
            cls.poll_message_set(obstacle)
        return not obstacle


class OfObject(NeedsScene):
    """An operator on one object of the table: the active one, unless another is named."""

    scene: StringProperty(name="Scene", description="Collection of the object's scene", options={"SKIP_SAVE"})
    object_id: IntProperty(
        name="Object Id",
        description="Another object than the active one",
        default=object_names.NOBODY,
        options={"SKIP_SAVE"},
    )

    def found(self, context):
        """The collection of its scene and its id, or None."""
        return selection.find(context, self.scene, self.object_id)
