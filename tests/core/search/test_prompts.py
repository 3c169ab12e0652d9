"""Prompts with operators: everything, nothing and exclusions."""

import dataclasses

import pytest

from r5dgs_core import errors
from r5dgs_core.cli.commands import query as query_command
from r5dgs_core.language import query
from r5dgs_core.scene import scene_file
from r5dgs_core.search import object_search, prompts
from tests.support.scenes import make_scene

MUG, APPLE, CAR, LEMON, BLOCK, GLOBE = range(1, 7)
ALL = {MUG, APPLE, CAR, LEMON, BLOCK, GLOBE}


@pytest.fixture(scope="module")
def scene():
    return make_scene(objects=6)


def found(scene, text):
    return {match.object_id for match in query.find(scene, text)}


@pytest.mark.parametrize(
    "text", ["all", "everything", "All objects", "every object", "all of them", "all the things", "anything", "the all"]
)
def test_everything_is_all_objects_without_the_background(scene, text):
    matches = query.find(scene, text)
    assert [match.object_id for match in matches] == sorted(ALL)
    assert {match.score for match in matches} == {1.0} and {match.why for match in matches} == {"all"}


@pytest.mark.parametrize(
    "text", ["nothing", "none", "None of them", "no objects", "not everything", "everything but all"]
)
def test_nothing_is_no_object(scene, text):
    assert found(scene, text) == set() and object_search.is_nothing(object_search.labels_of(scene), text)


@pytest.mark.parametrize(
    ("text", "left_out"),
    [
        ("not the mug", {MUG}),
        ("everything but the mug", {MUG}),
        ("all but the mug", {MUG}),
        ("all objects except the cup", {MUG}),
        ("everything except for the mug and the toy car", {MUG, CAR}),
        ("everything other than mug, lemon", {MUG, LEMON}),
        ("anything apart from fruit", {APPLE, LEMON}),
        ("without the mug", {MUG}),
        ("everything minus the globe", {GLOBE}),
        ("NOT the mug and not the globe", {MUG, GLOBE}),
        ("all but not the mug", {MUG}),
        ("everything but nothing", set()),
        ("not the background", set()),
    ],
)
def test_exclusions_remove_only_the_excluded_objects(scene, text, left_out):
    assert found(scene, text) == ALL - left_out


@pytest.mark.parametrize("text", ["mug", "cup", "fruit", "red apple", "glob", "wooden blocks", "lemon and globe"])
def test_not_is_the_complement_among_the_objects(scene, text):
    assert found(scene, f"not {text}") == found(scene, f"everything but {text}") == ALL - found(scene, text)
    assert {match.why for match in query.find(scene, f"not {text}")} == {"all others"}


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        ("fruit but not the lemon", {APPLE}),
        ("fruit, not the lemon", {APPLE}),
        ("fruit and mug except the apple", {LEMON, MUG}),
        ("all fruit but the lemon", {APPLE}),
        ("all fruit", {APPLE, LEMON}),
        ("nothing but the mug", {MUG}),
        ("everything and the background", {0, *ALL}),
        ("mug and nothing", {MUG}),
    ],
)
def test_exclusions_apply_to_the_preceding_words(scene, text, ids):
    assert found(scene, text) == ids


@pytest.mark.parametrize(
    "text", ["not the vaze", "everything but the vaze", "mug but not the vaze", "not mug and vaze"]
)
def test_excluding_an_unknown_object_raises(scene, text):
    with pytest.raises(errors.ConfigError, match="excludes an unknown object: nothing matches '.*vaze'"):
        query.find(scene, text)


def test_the_error_for_an_unknown_exclusion_suggests_similar_names(scene):
    with pytest.raises(errors.ConfigError, match="did you mean 'mug'"):
        object_search.search(scene, "everything except the bug")


@pytest.mark.parametrize("text", ["not", "everything but", "all except for ", "without"])
def test_an_incomplete_prompt_raises(scene, text):
    with pytest.raises(errors.UsageError, match="nothing to exclude after"):
        query.find(scene, text)


@pytest.mark.parametrize(
    "name", ["all", "Everything", "Not", "nothing", "not the mug", "everything but the mug", "But"]
)
def test_an_object_named_like_an_operator_is_found_by_its_name(scene, name):
    objects = tuple(dataclasses.replace(item, name=name) if item.id == LEMON else item for item in scene.objects)
    named = dataclasses.replace(scene, objects=objects)
    for text in (name, name.upper(), f" {name} "):
        best = query.find(named, text)[0]
        assert (best.object_id, best.score) == (LEMON, 1.0)
    for word in ("not", "everything but"):
        assert found(named, f"{word} {name}") == ALL - found(named, name)


def test_operators_inside_names_exclude_nothing():
    labels = [
        object_search.Label(1, "butter"),
        object_search.Label(2, "knot"),
        object_search.Label(3, "mug without handle"),
    ]
    for label in labels:
        assert [match.object_id for match in object_search.search_labels(labels, label.name)] == [label.object_id]
    phrase = ("a mug without a handle", ["mug", "without", "handle"])
    assert prompts.parse("a mug without a handle") == prompts.Prompt(wanted=(phrase,))


def test_unknown_excluded_phrases_are_embedded_by_the_encoder(scene):
    labels = object_search.labels_of(scene)
    assert object_search.unknown(labels, "everything but sour things", None) == ["sour things"]
    assert object_search.not_excluded(labels, "everything but sour things and mug") == ["sour things"]
    assert object_search.unanswered(labels, "mug and zeppelin but not the car") == ["zeppelin"]


def test_the_command_reports_a_prompt_that_selects_no_object(scene, tmp_path, capsys):
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    assert query_command.run_query(path, "none") == []
    assert "'none' selects no objects" in capsys.readouterr().out
    assert len(query_command.run_query(path, "not the mug")) == len(ALL) - 1
