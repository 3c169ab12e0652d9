"""State of prompts and isolation: settings, history and hidden objects in the .blend, results in the session."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ...r5dgs_core.search import object_search
from . import phrase_embeddings, prompt


def _search(session: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    if session.prompt.strip() != session.asked:
        prompt.ask(context, session.prompt)


def _search_again(_: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    session = context.window_manager.r5dgs_words
    if session.asked:
        prompt.ask(context, session.asked)


class R5DGS_PG_text(bpy.types.PropertyGroup):
    """Text item; the text is its `name`."""


class R5DGS_PG_match(bpy.types.PropertyGroup):
    """Match of the last prompt; `name` is the object's name."""

    scene: StringProperty(name="Scene", description="Collection of the object's scene")
    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects")
    score: FloatProperty(name="Score", description="Similarity to the prompt, at most 1")
    why: StringProperty(name="Why", description="Reason for the match")


class R5DGS_PG_words_session(bpy.types.PropertyGroup):
    """Last prompt and its result."""

    prompt: StringProperty(
        name="Prompt", description="Words for the objects to find, such as 'red mug'; Enter searches", update=_search
    )
    asked: StringProperty(name="Asked", description="Last prompt that was searched")
    matches: CollectionProperty(name="Matches", description="Matches of the last prompt", type=R5DGS_PG_match)
    meant: CollectionProperty(name="Meant", description="Suggestions for a prompt without matches", type=R5DGS_PG_text)
    notes: CollectionProperty(name="Notes", description="Messages about the last search", type=R5DGS_PG_text)


class R5DGS_PG_hidden(bpy.types.PropertyGroup):
    """Visibility of an object before isolation."""

    obj: PointerProperty(name="Object", description="The object", type=bpy.types.Object)
    hide: BoolProperty(name="Hidden", description="The object was hidden in the view layer")
    hide_render: BoolProperty(name="Hidden in Renders", description="The object was hidden in renders")


class R5DGS_PG_words(bpy.types.PropertyGroup):
    """Prompt and isolation settings of a Blender scene."""

    threshold: FloatProperty(
        name="Threshold",
        description="Minimum score of a match",
        default=object_search.THRESHOLD,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=_search_again,
        options=set(),
    )
    all_scenes: BoolProperty(
        name="All Scenes",
        description="Search all loaded scenes instead of the active one",
        update=_search_again,
        options=set(),
    )
    click_selects_anchor: BoolProperty(
        name="Click Selects Anchor",
        description="Select the anchor when clicking its Gaussians in a 3D view",
        default=True,
        options=set(),
    )
    history: CollectionProperty(name="History", description="Earlier prompts with matches", type=R5DGS_PG_text)
    hidden: CollectionProperty(name="Hidden", description="Visibility changed by isolation", type=R5DGS_PG_hidden)
    hidden_in: StringProperty(name="Hidden In", description="View layer in which objects are isolated")


CLASSES = (R5DGS_PG_text, R5DGS_PG_match, R5DGS_PG_words_session, R5DGS_PG_hidden, R5DGS_PG_words)


def register():
    """Register the property groups on scenes and the window manager."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.r5dgs_words = PointerProperty(type=R5DGS_PG_words)
    bpy.types.WindowManager.r5dgs_words = PointerProperty(type=R5DGS_PG_words_session)


def unregister():
    """Undo `register` and clear the caches."""
    prompt.forget()
    phrase_embeddings.forget()
    del bpy.types.WindowManager.r5dgs_words
    del bpy.types.Scene.r5dgs_words
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
