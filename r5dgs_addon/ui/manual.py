"""Pages of the user manual for the panels and buttons of the extension.

The manual is installed with the extension, so that links work offline and match the installed version.
"""

from pathlib import Path

import bpy

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "user"
PAGES = {  # operators described on each page; the others are described on the first
    "blender": (),
    "motion": (
        *("re_extrapolate", "reset_motion", "simplify_keys", "replace_motion", "duplicate_object", "delete_object"),
        *("retime", "extrapolate_until", "show_confidence", "exact_mode", "pivot_to_cursor"),
    ),
    "contact": ("predict_contacts", "switch_contacts"),
    "clean_up": (
        *("select_floaters", "select_gaussians", "lasso_gaussians", "brush_gaussians", "add_crop_box"),
        *("delete_gaussians", "assign_gaussians"),
    ),
    "rendering": (
        *("preview", "live_preview", "use_engine", "show_colors_as_trained", "merge_with_meshes", "stop_merging"),
        *("add_shadows", "viewport_render"),
    ),
    "export": ("export_ply", "export_format", "export_scene", "export_masks", "export_cameras"),
    "capture": ("capture_dataset",),
    "install": ("check_worker",),
}


def address(page: str) -> str:
    """Return the address of a page for a browser.

    Args:
        page: Key of `PAGES`.
    """
    return (FOLDER / f"{page}.md").as_uri()


def links() -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return addresses for *Online Manual* in Blender's context menus of buttons."""
    found = [(f"bpy.ops.r5dgs.{name}*", f"{page}.md") for page, names in PAGES.items() for name in names]
    found += [("bpy.types.r5dgs_pg_clean_up*", "clean_up.md"), ("bpy.types.r5dgs_pg_render*", "rendering.md")]
    found.append(("bpy.types.r5dgs_pg_contact*", "contact.md"))
    found += [(f"bpy.types.r5dgs_pg_{name}*", "motion.md") for name in ("motion", "pivot", "exact")]
    found += [
        ("bpy.types.r5dgs_ap_preferences*", "install.md"),
        ("bpy.types.r5dgs_*", "blender.md"),
        ("bpy.ops.r5dgs.*", "blender.md"),
    ]
    return FOLDER.as_uri() + "/", tuple(found)


def register():
    """Add the links."""
    bpy.utils.register_manual_map(links)


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_manual_map(links)
