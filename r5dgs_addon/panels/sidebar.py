"""Base classes of the panels in the *R5DGS* tab."""

from ..scene import loaded_scenes

TAB = "R5DGS"


class Sidebar:
    """Panel in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = TAB
    manual = ""  # page of the manual, opened by a button in the header

    def draw_header_preset(self, context):
        if self.manual:
            self.layout.operator("r5dgs.open_manual", text="", icon="HELP", emboss=False).page = self.manual


class WithScene(Sidebar):
    """Panel that is shown only if a scene is loaded."""

    @classmethod
    def poll(cls, context):
        return loaded_scenes.active_collection(context) is not None
