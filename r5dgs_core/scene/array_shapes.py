"""Shape checks of a scene's arrays, against each other and the rest of the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from .. import errors, findings
from .array_types import EMBEDDINGS
from .lookup_table import LookupTable
from .scene import IDENTITY_DIM, MotionGroup, SceneObject

SH_BASES = (1, 4, 9, 16)
_PER_GAUSSIAN = ("quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids")  # besides means
_Shape = tuple[int | None, ...]  # None: any length


def check(
    shapes: Mapping[str, tuple[int, ...]],
    objects: Sequence[SceneObject],
    groups: Sequence[MotionGroup],
    vocabulary: Sequence[str],
    table: LookupTable | None,
    place: str,
    guard: findings.Guard = findings.STRICT,
) -> set[str]:
    """Raise `SceneFileError` if the shapes of a scene's arrays do not fit each other or the rest of the scene.

    Args:
        shapes: Shapes by name, including all required arrays; `findings.UNREAD` for unknown ones.
        objects, groups, vocabulary, table: Fields of `Scene`; ``table`` is `Scene.lookup`.
        place: File, for messages.
        guard: Context manager entered around each array.

    Returns:
        Names of the arrays whose shapes fit.
    """
    count = _gaussians(shapes)
    knots, residual_rows = (_length(shapes, name, rank=1) for name in ("track_times", "residual_rows"))
    classes = _number(guard, lambda: sum(item.id >= 0 for item in objects))
    bases = _bases(shapes, count, place, guard)
    expected: dict[str, _Shape] = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh": (count, bases.get("sh"), 3),
        "object_ids": (count,),
        "motion_ids": (count,),
        "track_times": (_length(shapes, "track_times"),),
        "track_poses": (_number(guard, lambda: len(groups)), knots, 7),
        "background_sh": (bases.get("background_sh"), 3),
        "identities": (count, IDENTITY_DIM),
        "classifier_weight": (classes, IDENTITY_DIM),
        "classifier_bias": (classes,),
        "residual_rows": (_length(shapes, "residual_rows"),),
        "residual_offsets": (residual_rows, knots, 3),
        "residual_quats": (residual_rows, knots, 4),
        "residual_log_scales": (residual_rows, knots, 3),
        "dynamics": (count, 12),
        "canonical_means": (count, 3),
        "shading": (count, 3),
        "shading_rest": (count,),
        "light_direction": (3,),
        "origin": (3,),
    }
    bad_harmonics = {"sh", "background_sh"} - set(bases)
    known = {name: shape for name, shape in shapes.items() if name in expected and name not in bad_harmonics}
    sound = _fitting({name: known[name] for name in expected if name in known}, expected, place, guard)
    words = _number(guard, lambda: len(vocabulary))
    return sound | check_embeddings(shapes, _number(guard, lambda: len(objects)), words, table, place, guard)


def _bases(
    shapes: Mapping[str, tuple[int, ...]], count: int | None, place: str, guard: findings.Guard
) -> dict[str, int]:
    """Number of bases of each array of harmonics whose shape is sound."""
    bases: dict[str, int] = {}
    for name, rank in (("sh", 3), ("background_sh", 2)):
        with guard():
            shape = shapes[name]
            if shape is not findings.UNREAD and (len(shape) != rank or shape[-2] not in SH_BASES):
                wanted = f"({count}, K, 3)" if name == "sh" else "(K, 3)"
                fail(place, name, f"{wanted} with K one of {SH_BASES}", shape)
            bases[name] = shape[-2]
    return bases


def check_embeddings(
    shapes: Mapping[str, tuple[int, ...]],
    objects: int | None,
    words: int | None,
    table: LookupTable | None,
    place: str,
    guard: findings.Guard = findings.STRICT,
) -> set[str]:
    """Raise `SceneFileError` if the shapes of stored embeddings do not fit each other or their table.

    Args:
        shapes: Shapes by name; only `EMBEDDINGS` are checked.
        objects: Number of objects, None if unknown.
        words: Number of words in the vocabulary, None if unknown.
        table: Encoder, thresholds and views of the embeddings.
        place: File, for messages.
        guard: Context manager entered around each array and rule.

    Returns:
        Names of the arrays whose shapes fit.
    """
    there = {name: shapes[name] for name in EMBEDDINGS if name in shapes}
    known = {name: shape for name, shape in there.items() if shape is not findings.UNREAD}
    lengths = {shape[-1] for shape in known.values() if shape}
    with guard():
        if table is not None:
            lengths.add(table.encoder.dimension)
            absent = [name for name in EMBEDDINGS if name not in there]
            if absent:
                fail(place, absent[0], "an array beside 'lookup'", "none")
        elif "canonical_embeddings" in there or "view_embeddings" in there:
            fail(place, "lookup", "an entry beside 'canonical_embeddings' and 'view_embeddings'", "none")
    with guard():
        if len(lengths) > 1:
            fail(place, "embeddings", "vectors of one length", sorted(lengths))
    views = known.get("view_embeddings", ())
    most = views[1] if len(views) > 1 else 0
    expected: dict[str, _Shape] = {
        "embeddings": (objects, None),
        "vocabulary_embeddings": (words, None),
        "canonical_embeddings": (_number(guard, lambda: 0 if table is None else len(table.canonical)), None),
        "view_embeddings": (objects, most, None),
    }
    sound = _fitting(known, expected, place, guard)
    with guard():
        if table is not None and objects is not None and "view_embeddings" in known:
            found = [len(own) for own in table.views]
            if len(found) != objects or any(own > most for own in found):
                fail(place, "lookup", f"{objects} objects of at most {most} views", found[:5])
    return sound


def _fitting(
    shapes: Mapping[str, tuple[int, ...]], expected: Mapping[str, _Shape], place: str, guard: findings.Guard
) -> set[str]:
    """Names of the known shapes that are as expected. Raises `SceneFileError` for the first mismatch."""
    sound = set()
    for name, shape in shapes.items():
        if shape is findings.UNREAD:
            continue
        with guard():
            wanted = expected[name]
            if len(shape) != len(wanted) or any(n is not None and n != m for n, m in zip(wanted, shape, strict=True)):
                fail(place, name, f"shape {wanted}", shape)
            sound.add(name)
    return sound


def _gaussians(shapes: Mapping[str, tuple[int, ...]]) -> int | None:
    """Number of Gaussians: the length of means, or if unknown, the most frequent length of the other arrays."""
    if shapes.get("means") is not findings.UNREAD:
        return _length(shapes, "means")
    rows = Counter(
        _length(shapes, name) for name in _PER_GAUSSIAN if shapes.get(name, findings.UNREAD) is not findings.UNREAD
    )
    return max(rows, key=rows.__getitem__, default=None)


def _length(shapes: Mapping[str, tuple[int, ...]], name: str, rank: int | None = None) -> int | None:
    """Number of rows of an array: 0 if it is missing, None if its shape is unknown or has another rank."""
    shape = shapes.get(name, (0,))
    return None if shape is findings.UNREAD or len(shape) != (rank or len(shape)) else next(iter(shape), 0)


def _number(guard: findings.Guard, count: Callable[[], int]) -> int | None:
    """Result of ``count``, or None if the items could not be read."""
    number = findings.attempt(guard, count)
    return None if number is findings.UNREAD else number


def fail(place: str, member: str, expected: str, found: object) -> NoReturn:
    """Raise `SceneFileError` for a member that is not as expected."""
    raise errors.SceneFileError(f"{place}: {member}: expected {expected}, found {found}")
