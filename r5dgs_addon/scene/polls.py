"""Mixins with poll methods for operators."""

from bpy.props import IntProperty, StringProperty

from . import captured_cameras, loaded_scenes, object_names, selection


class NeedsScene:
    """Mixin for operators that need a loaded scene in the active Blender scene."""

    @classmethod
    def poll(cls, context):
        if loaded_scenes.active_collection(context) is None:
            cls.poll_message_set(selection.NO_SCENE)
            return False
        return True


class NeedsCamera(NeedsScene):
    """Mixin for operators that view loaded scenes through the active camera."""

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("Add a camera to the scene first")
            return False
        return True


class NeedsCapturedCameras(NeedsScene):
    """Mixin for operators on the captured cameras of the loaded scene."""

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if not captured_cameras.all_of(loaded_scenes.active_collection(context)):
            cls.poll_message_set("The scene has no captured cameras: load its file again with 'Captured Cameras'")
            return False
        return True


class Selects:
    """Mixin for operators that select or hide objects of loaded scenes."""

    @classmethod
    def poll(cls, context):
        reason = selection.why_unavailable(context)
        if reason:
            cls.poll_message_set(reason)
        return not reason


class OfObject(NeedsScene):
    """Mixin for operators on one object of the table: the active one, unless properties name another."""

    scene: StringProperty(name="Scene", description="Collection of the object's scene", options={"SKIP_SAVE"})
    object_id: IntProperty(
        name="Object Id",
        description="Another object than the active one",
        default=object_names.NOBODY,
        options={"SKIP_SAVE"},
    )

    def found(self, context):
        """Collection of the object's scene and the object's id, or None."""
        return selection.find(context, self.scene, self.object_id)
