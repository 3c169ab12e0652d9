"""What all panels of the tab R5DGS have in common."""

from ..scene import loaded_scenes

TAB = "R5DGS"


class Sidebar:
    """A panel in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = TAB


class WithScene(Sidebar):
    """A panel that is shown once a scene is loaded."""

    @classmethod
    def poll(cls, context):
        return loaded_scenes.active_collection(context) is not None
