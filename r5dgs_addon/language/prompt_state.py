"""State of prompts and isolation: settings, old prompts and what is hidden in the .blend, answers in the session."""

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
    """Some words: its `name`."""


class R5DGS_PG_match(bpy.types.PropertyGroup):
    """One answer to the last prompt; `name` is the object's name."""

    scene: StringProperty(name="Scene", description="Collection of the scene that has it")
    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects")
    score: FloatProperty(name="Score", description="How well it matches, at most 1")
    why: StringProperty(name="Why", description="What matched")


class R5DGS_PG_words_session(bpy.types.PropertyGroup):
    """The last prompt and its answers."""

    prompt: StringProperty(
        name="Prompt", description="Words for the objects to find, such as 'red mug'; Enter searches", update=_search
    )
    asked: StringProperty(name="Asked", description="The last prompt that was searched")
    matches: CollectionProperty(name="Matches", description="Answers to the last prompt", type=R5DGS_PG_match)
    meant: CollectionProperty(name="Meant", description="What the prompt may have meant", type=R5DGS_PG_text)
    notes: CollectionProperty(name="Notes", description="What else there is to say", type=R5DGS_PG_text)


class R5DGS_PG_hidden(bpy.types.PropertyGroup):
    """How one object was shown before others were isolated."""

    obj: PointerProperty(name="Object", description="The object", type=bpy.types.Object)
    hide: BoolProperty(name="Hidden", description="Whether it was hidden in the view layer")
    hide_render: BoolProperty(name="Hidden in Renders", description="Whether it was hidden in renders")


class R5DGS_PG_words(bpy.types.PropertyGroup):
    """What a Blender scene keeps of prompts and isolation."""

    threshold: FloatProperty(
        name="Threshold",
        description="Least score of a match",
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
        description="A click on Gaussians in a 3D view selects the anchor that moves them",
        default=True,
        options=set(),
    )
    history: CollectionProperty(name="History", description="Prompts that found something", type=R5DGS_PG_text)
    hidden: CollectionProperty(name="Hidden", description="What isolating has changed", type=R5DGS_PG_hidden)
    hidden_in: StringProperty(name="Hidden In", description="View layer in which objects are isolated")


CLASSES = (R5DGS_PG_text, R5DGS_PG_match, R5DGS_PG_words_session, R5DGS_PG_hidden, R5DGS_PG_words)


def register():
    """Register the groups and hang them on scenes and the window manager."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.r5dgs_words = PointerProperty(type=R5DGS_PG_words)
    bpy.types.WindowManager.r5dgs_words = PointerProperty(type=R5DGS_PG_words_session)


def unregister():
    """Undo `register`, and drop what was read from scene files and said by the encoder."""
    prompt.forget()
    phrase_embeddings.forget()
    del bpy.types.WindowManager.r5dgs_words
    del bpy.types.Scene.r5dgs_words
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
