import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core import errors
from r5dgs_core.scene import stored_embeddings
from r5dgs_core.search import english, object_search, prompts, spelling
from tests.support.scenes import make_scene

MUG, APPLE, CAR, LEMON, BLOCK, GLOBE = range(1, 7)


@pytest.fixture(scope="module")
def scene():
    return make_scene(objects=6)


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        ("mug", [MUG]),
        ("Mugs", [MUG]),
        ("the cup", [MUG]),
        ("coffee mug", [MUG]),
        ("red apple", [APPLE]),
        ("apple, red", [APPLE]),
        ("apple red", [APPLE]),
        ("apples", [APPLE]),
        ("aple", [APPLE]),
        ("aplpe", [APPLE]),
        ("toy", [CAR]),
        ("toycar", [CAR]),
        ("glob", [GLOBE]),
        ("wood", [BLOCK]),
        ("wooden blocks", [BLOCK]),
        ("fruit", [APPLE, LEMON]),
        ("mug and lemon", [MUG, LEMON]),
        ("lemons, globe & cup", [LEMON, GLOBE, MUG]),
        ("background", [0]),
    ],
)
def test_words_find_their_objects_best_first(scene, text, ids):
    assert [match.object_id for match in object_search.search(scene, text)] == ids


@pytest.mark.parametrize(
    "text", ["giraffe", "cat", "table", "cupboard", "carpet", "mug handle", "", "  ", "the", "?!", "unassigned"]
)
def test_a_missing_object_has_no_match(scene, text):
    assert object_search.search(scene, text) == []


def test_an_exact_name_scores_one_and_better_answers_score_more(scene):
    def score(text, object_id):
        return next(m.score for m in object_search.search(scene, text) if m.object_id == object_id)

    assert score("red apple", APPLE) == 1.0
    assert score("red apple", APPLE) > score("apple", APPLE) > score("aple", APPLE) >= object_search.THRESHOLD
    assert score("cup", MUG) < score("mug", MUG)
    assert score("coffee mug", MUG) < score("mug", MUG)


def test_matches_give_their_reason(scene):
    (match,) = object_search.search(scene, "cups")
    assert match.why == "alias 'cup'"
    (match,) = object_search.search(scene, "aple")
    assert "'red apple'" in match.why
    assert "'aple'" in match.why


def test_the_threshold_is_set_by_the_caller(scene):
    assert object_search.search(scene, "aple", threshold=0.95) == []
    assert object_search.search(scene, "coffee mug", threshold=0.95) == []


def test_an_exact_name_precedes_a_longer_one():
    labels = [object_search.Label(1, "red car"), object_search.Label(2, "car"), object_search.Label(3, "carafe")]
    assert [m.object_id for m in object_search.search_labels(labels, "car")] == [2, 1, 3]


def test_words_may_have_accents_and_other_scripts():
    labels = [object_search.Label(1, "Café"), object_search.Label(2, "кружка"), object_search.Label(3, "杯子")]
    assert [m.object_id for m in object_search.search_labels(labels, "cafe")] == [1]
    assert [m.object_id for m in object_search.search_labels(labels, "Кружка")] == [2]
    assert [m.object_id for m in object_search.search_labels(labels, "杯子")] == [3]


@pytest.mark.parametrize(
    ("plural", "singular"),
    [
        ("mugs", "mug"),
        ("boxes", "box"),
        ("berries", "berry"),
        ("glass", "glass"),
        ("dishes", "dish"),
        ("knives", "knife"),
        ("bookshelves", "bookshelf"),
        ("gloves", "glove"),
        ("olives", "olive"),
        ("cactus", "cactus"),
    ],
)
def test_plurals_become_singular(plural, singular):
    assert english.singular(plural) == singular


@pytest.mark.parametrize("name", ["salt and pepper", "R/C car", "mug, chipped", "the mug", "two mugs"])
def test_a_name_that_looks_like_several_phrases_is_found_as_a_whole(name):
    others = ["pepper mill", "car", "mug", "lemon"]
    labels = [object_search.Label(1, name), *(object_search.Label(2 + k, other) for k, other in enumerate(others))]
    first = object_search.search_labels(labels, name.upper())[0]
    assert (first.object_id, first.score) == (1, 1.0)
    assert object_search.unanswered(labels, name) == object_search.unknown(labels, name, None) == []
    assert {match.object_id for match in object_search.search_labels(labels, "car and lemon")} >= {3, 5}


NOUNS = {
    "cookie": "cookies", "movie": "movies", "pie": "pies", "tie": "ties", "cherry": "cherries", "key": "keys",
    "tray": "trays", "cache": "caches", "torch": "torches", "niche": "niches", "dish": "dishes", "size": "sizes",
    "maze": "mazes", "quiz": "quizzes", "box": "boxes", "axe": "axes", "glass": "glasses", "mattress": "mattresses",
    "fuse": "fuses", "bus": "buses", "cactus": "cactuses", "house": "houses", "mouse": "mice", "vase": "vases",
    "rose": "roses", "lens": "lenses", "gas": "gases", "iris": "irises", "canvas": "canvases", "glove": "gloves",
    "wave": "waves", "leaf": "leaves", "loaf": "loaves", "scarf": "scarves", "knife": "knives", "potato":
    "potatoes", "shoe": "shoes", "foot": "feet", "child": "children", "person": "people",
}  # fmt: skip


@pytest.mark.parametrize(("one", "many"), NOUNS.items())
def test_a_noun_and_its_plural_are_one_word(one, many):
    for name, said in ((one, many), (many, one), (many, many)):
        assert [match.score for match in object_search.search_labels([object_search.Label(1, name)], said)] == [1.0]


def test_stored_embeddings_answer_words_that_no_name_has(scene):
    count = len(scene.objects)
    axes = np.eye(count + 2, dtype=np.float32)
    row = next(i for i, item in enumerate(scene.objects) if item.id == LEMON)
    near = 0.8 * axes[row] + 0.6 * axes[count]
    rich = dataclasses.replace(
        scene.with_arrays(embeddings=axes[:count], vocabulary_embeddings=np.stack([near, axes[count + 1]])),
        vocabulary=("sour thing", "zeppelin"),
    )
    (match,) = object_search.search(rich, "sour things")
    assert match.object_id == LEMON
    assert "meaning" in match.why
    assert object_search.search(rich, "zeppelin") == []
    assert object_search.search(scene, "sour things") == []


def test_the_message_without_matches_lists_the_objects(scene):
    labels = [object_search.Label(item.id, item.name) for item in scene.objects if item.id > 0]
    said = object_search.explain_nothing(labels, " giraffe ")
    assert said.startswith("nothing matches 'giraffe'")
    assert "mug" in said


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("bug", ["mug"]),
        ("aplle tree", ["red apple"]),
        ("cap", ["cup"]),
        ("muug cpu", ["mug"]),
        ("zzz", []),
        ("hippo", []),
        ("no", []),
    ],
)
def test_phrases_without_match_suggest_similar_names_and_aliases(scene, text, meant):
    labels = [object_search.Label(item.id, item.name, item.aliases) for item in scene.objects if item.id > 0]
    assert object_search.suggest(labels, text)[: len(meant) or None] == meant
    if meant:
        assert object_search.search_labels(labels, meant[0])
        assert f"did you mean {meant[0]!r}" in object_search.explain_nothing(labels, text)


def test_suggestions_are_limited_and_sorted_by_similarity():
    labels = [
        object_search.Label(1, "handle"),
        object_search.Label(2, "candle"),
        object_search.Label(3, "sandal"),
        object_search.Label(4, "rock"),
    ]
    assert object_search.suggest(labels, "candel", count=2) == ["candle", "handle"]
    assert object_search.suggest([], "candel") == [] and object_search.suggest(labels, " ?") == []


@pytest.mark.parametrize("text", ["the red fruit", "fruit", "putting", "cupboard", "cuttlefish", "hoard game"])
def test_words_that_merely_share_letters_are_not_suggested(text):
    names = ("cutting board", "cup", "candle")
    labels = [object_search.Label(i, name) for i, name in enumerate(names)]
    near = {"putting": ["cutting board"], "hoard game": ["cutting board"]}
    assert object_search.suggest(labels, text) == near.get(text, [])
    said = object_search.explain_nothing(labels, text)
    assert ("did you mean" in said) == (text in near) and ("the scene has" in said) == (text not in near)


def edit_distance(a, b):
    return spelling.edit_distance(a, b, most=99)


@given(st.text("abc", max_size=8), st.text("abc", max_size=8), st.integers(0, 8))
def test_typos_are_counted_up_to_a_limit(a, b, most):
    assert spelling.edit_distance(a, b, most) == min(edit_distance(a, b), most + 1)


@pytest.mark.parametrize("text", ["mug " * 300, "x" * 1001, " " * 500_000, "mug, " * 100_000])
def test_a_prompt_that_is_too_long_is_refused_before_names_are_compared(scene, text, monkeypatch):
    monkeypatch.setattr(object_search, "_match", None)
    with pytest.raises(errors.ConfigError, match=rf"a prompt of {len(text)} letters: expected at most 1000"):
        object_search.search(scene, text)


def test_a_prompt_as_long_as_allowed_finds_what_it_names(scene):
    text = ("mug" + " " * 400 + ", lemon").ljust(prompts.MAX_LETTERS)
    assert [match.object_id for match in object_search.search(scene, text)] == [MUG, LEMON]


def test_long_words_are_compared_letter_by_letter_in_a_narrow_band(monkeypatch):
    class Letters(str):
        looked_at = 0

        def __getitem__(self, place):
            Letters.looked_at += 1
            return str.__getitem__(self, place)

    name = Letters("ab" * 5000)
    assert spelling.edit_distance(name[:-1], name, 3) == 1
    assert Letters.looked_at < 60 * len(name)  # and not its square


@given(st.text("abc", max_size=6), st.text("abc", max_size=6), st.text("abc", max_size=6))
def test_edit_distance_counts_typos(a, b, c):
    distance = edit_distance(a, b)
    assert distance == edit_distance(b, a) and (distance == 0) == (a == b)
    assert abs(len(a) - len(b)) <= distance <= max(len(a), len(b))
    assert edit_distance(c + a, c + b) <= distance
    assert edit_distance(a, a[:1] + c + a[1:]) <= len(c)


def test_each_typo_counts_one():
    for word in ("aple", "appple", "apble", "appel"):
        assert edit_distance(word, "apple") == 1
    assert edit_distance("elppa", "apple") == 4 and edit_distance("", "mug") == 3


def test_two_objects_of_a_kind_are_two_matches():
    labels = [
        object_search.Label(1, "red chair"),
        object_search.Label(2, "table"),
        object_search.Label(3, "blue chair"),
    ]
    assert [m.object_id for m in object_search.search_labels(labels, "the two chairs")] == [1, 3]
    assert [m.object_id for m in object_search.search_labels(labels, "both of the chairs")] == [1, 3]


def test_phrases_without_match_are_listed():
    labels = [object_search.Label(1, "mug"), object_search.Label(2, "lemon")]
    assert object_search.unanswered(labels, "two spoons, lemon and elephant") == ["two spoons", "elephant"]
    assert object_search.unanswered(labels, "mugs and lemons") == []
    assert object_search.unanswered(labels, "mugs", threshold=1.0) == []


def test_numbers_are_ignored_unless_they_are_part_of_a_name():
    labels = [
        object_search.Label(1, "mug one"),
        object_search.Label(2, "mug two"),
        object_search.Label(3, "two towers"),
    ]
    assert object_search.phrases_of("the two fruits and some mugs") == [["fruit"], ["mug"]]
    assert [m.object_id for m in object_search.search_labels(labels, "mug two")][0] == 2
    assert [m.object_id for m in object_search.search_labels(labels, "two towers")] == [3]
    assert [m.object_id for m in object_search.search_labels(labels, "two mugs")] == [1, 2]


def test_embeddings_match_after_labels_were_renamed():
    embeddings = stored_embeddings.StoredEmbeddings((1, 2), np.eye(2), ("sphere",), np.array([[1.0, 0.0]]))
    labels = [object_search.Label(1, "planet"), object_search.Label(2, "desk")]
    assert [m.object_id for m in object_search.search_labels(labels, "spheres", embeddings=embeddings)] == [1]
    assert object_search.search_labels(labels[1:], "spheres", embeddings=embeddings) == []
    assert object_search.search_labels(labels, "spheres", 0.96, embeddings) == []
