import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core import errors
from r5dgs_core.playback import scene_info
from r5dgs_core.scene import scene_file, scene_json
from r5dgs_core.scene.lookup_table import EmbeddingSource, EncoderCard, LookupTable
from r5dgs_core.scene.stored_embeddings import StoredEmbeddings
from r5dgs_core.search import embedding_search, object_search
from tests.support.scenes import make_scene

CARD = EncoderCard("text", "tiny", "ab" * 32, 4, ("{}", "a photo of a {}"))
cosines = st.floats(-1, 1)


def unit(*values):
    vector = np.array(values, float)
    return vector / np.linalg.norm(vector)


def around(cosine, axis=0):
    """A unit vector with this cosine to an axis."""
    vector = np.zeros(4)
    vector[axis], vector[(axis + 1) % 4] = cosine, np.sqrt(1 - min(cosine * cosine, 1))
    return vector


def table_of(rows, thresholds, *, margin=2.0, pooling="mean", views=None):
    """Meanings of objects 1, 2, ... with an embedding each; the canonical phrase is the last axis."""
    rows = np.asarray(rows, float)
    own = [((EmbeddingSource("said", t),) if t is not None else ()) for t in thresholds] if views is None else views[0]
    stored = rows[:, None] if views is None else views[1]
    table = LookupTable(CARD, ("object",), tuple(own), tuple(thresholds), margin, pooling)
    ids = tuple(range(1, len(rows) + 1))
    return StoredEmbeddings(ids, rows, ("sphere",), np.eye(4)[:1], table, np.eye(4)[3:], stored)


@given(cosines, st.lists(cosines, min_size=1, max_size=5), st.floats(1, 50))
def test_relevancy_is_the_least_of_the_pairs(cosine, canonical, scale):
    pairs = [np.exp(scale * cosine) / (np.exp(scale * cosine) + np.exp(scale * other)) for other in canonical]
    assert embedding_search.relevancy(cosine, np.array(canonical), scale) == pytest.approx(min(pairs), abs=1e-9)


@pytest.mark.filterwarnings("error")
def test_relevancy_is_a_number_at_any_scale():
    assert embedding_search.relevancy(-1.0, np.array([1.0]), 1000.0) < 1e-300
    assert embedding_search.relevancy(1.0, np.array([-1.0]), 1000.0) == 1.0


@given(cosines, st.floats(-0.9, 0.9), st.booleans())
def test_a_score_passes_exactly_where_the_cosine_reaches_the_threshold(cosine, threshold, canonical):
    known = table_of([around(cosine)], [threshold])
    if not canonical:
        known = dataclasses.replace(known, canonical_embeddings=np.zeros((0, 4)))
    (one,) = embedding_search.ask(known, np.eye(4)[0])
    assert one.cosine == pytest.approx(cosine) and 0 <= one.score <= 0.95
    if abs(cosine - threshold) > 1e-6:
        assert (one.score >= embedding_search.PASS) == (cosine > threshold)


@given(cosines, st.floats(0.01, 0.5))
def test_scores_do_not_depend_on_the_spread_of_an_encoders_cosines(cosine, threshold):
    """An encoder whose cosines are twice as close has thresholds and a margin that are so, too."""
    wide = table_of([around(cosine)], [threshold], margin=0.4)
    close = table_of([around(cosine / 2)], [threshold / 2], margin=0.2)
    (one,), (other,) = (embedding_search.ask(each, np.eye(4)[0]) for each in (wide, close))
    assert one.score == pytest.approx(other.score, abs=1e-9)


@given(st.lists(st.floats(0, 0.99), min_size=2, max_size=6), st.floats(0.01, 0.9))
def test_scores_of_one_threshold_are_in_the_order_of_cosines(found, threshold):
    answers = embedding_search.ask(table_of([around(c) for c in found], [threshold] * len(found)), np.eye(4)[0])
    assert [one.score for one in answers] == sorted((one.score for one in answers), reverse=True)
    assert all(a.cosine >= b.cosine - 1e-4 for a, b in itertools.pairwise(answers) if a.score > b.score)


def test_several_objects_match_but_none_far_below_the_best():
    known = table_of([around(0.9), around(0.85), around(0.6), around(0.2)], [0.5] * 4, margin=0.2)
    scores = {one.object_id: one.score for one in embedding_search.ask(known, np.eye(4)[0])}
    assert {object_id for object_id, score in scores.items() if score >= embedding_search.PASS} == {1, 2}
    wide = dataclasses.replace(known, table=dataclasses.replace(known.table, margin=0.4))
    assert sum(one.score >= embedding_search.PASS for one in embedding_search.ask(wide, np.eye(4)[0])) == 3


def test_scores_below_thresholds_fail_and_objects_without_embedding_are_skipped():
    known = table_of([around(0.4), np.zeros(4), around(0.45)], [0.5, None, 0.5])
    answers = embedding_search.ask(known, np.eye(4)[0])
    assert [one.object_id for one in answers] == [3, 1] and all(one.score < embedding_search.PASS for one in answers)
    assert embedding_search.ask(table_of(np.zeros((0, 4)), []), np.eye(4)[0]) == []


def test_the_best_view_or_the_mean_of_the_views_decides():
    views = ((EmbeddingSource("mug", 0.5), EmbeddingSource("a blue mug", 0.5)),)
    stored = np.stack([around(0.9), around(0.1)])[None]
    mean = unit(*stored[0].mean(0))
    best = table_of([mean], [0.5], pooling="max", views=(views, stored))
    assert embedding_search.ask(best, np.eye(4)[0])[0].cosine == pytest.approx(0.9)
    other = dataclasses.replace(best, table=dataclasses.replace(best.table, pooling="mean"))
    assert embedding_search.ask(other, np.eye(4)[0])[0].cosine == pytest.approx(mean[0])


def test_a_phrase_with_a_name_is_not_searched_by_meaning():
    known = table_of([around(0.9), around(0.95)], [0.5, 0.5])
    labels = [object_search.Label(1, "ball"), object_search.Label(2, "globe")]
    assert [m.object_id for m in object_search.search_labels(labels, "spheres", embeddings=known)] == [2, 1]
    named = [object_search.Label(1, "ball", ("sphere",)), object_search.Label(2, "globe")]
    assert [m.object_id for m in object_search.search_labels(named, "sphere", embeddings=known)] == [1]
    both = object_search.search_labels(labels, "ball and a sphere", embeddings=known)
    assert [(m.object_id, m.cosine is None) for m in both] == [(1, True), (2, False)]


def test_a_known_word_is_neither_a_typo_nor_a_prefix_of_another():
    labels = [object_search.Label(1, "cart"), object_search.Label(2, "racecar")]
    assert {m.object_id for m in object_search.search_labels(labels, "car")} == {1, 2}
    known = dataclasses.replace(table_of([around(0.1), around(0.1)], [0.5, 0.5]), vocabulary=("car",))
    assert [m.object_id for m in object_search.search_labels(labels, "car", embeddings=known)] == [2]
    fitting = table_of([around(0.9), around(0.1)], [0.5, 0.5])
    fitting = dataclasses.replace(fitting, vocabulary=("car",))
    assert {m.object_id for m in object_search.search_labels(labels, "car", embeddings=fitting)} == {1, 2}


def test_the_encoder_embeds_only_words_that_are_neither_names_nor_stored():
    known = table_of([around(0.9), around(0.3)], [0.5, 0.5])
    labels = [object_search.Label(1, "ball"), object_search.Label(2, "desk")]
    asked = []

    def embed(phrase):
        asked.append(phrase)
        return np.eye(4)[0]

    found = object_search.search_labels(labels, "desk, sphere and something to throw", embeddings=known, embed=embed)
    assert asked == ["something to throw"] and [m.object_id for m in found] == [2, 1]
    (meant,) = object_search.search_labels(labels, "something to throw", embeddings=known, embed=embed)
    assert "something to throw" in meant.why and meant.relevancy > 0.9 and meant.cosine == pytest.approx(0.9)
    assert object_search.unknown(labels, "desk, sphere and something to throw", known) == ["something to throw"]
    assert object_search.unknown(labels, "desk and sphere", None) == ["sphere"]


def test_words_of_a_vocabulary_are_normalised_like_prompts():
    words = ("salt and pepper", "cutting boards", "The Mug")
    assert (
        object_search.vocabulary_row(words, ["cutting", "board"]) == 1
        and object_search.vocabulary_row(words, ["mug"]) == 2
    )
    assert object_search.vocabulary_row(words, ["salt"]) is None


@pytest.fixture
def rich():
    """A scene with a lookup table: two views of each object, none of the background and the unassigned."""
    scene, rng = make_scene(n=200, objects=3), np.random.default_rng(0)
    vectors = rng.normal(size=(len(scene.objects), 2, 4)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    bare = [item.id <= 0 for item in scene.objects]
    vectors[bare] = 0
    views = tuple(
        ()
        if empty
        else (EmbeddingSource("obs0", 0.2, 0.1, (1, 2, 30.5, 40)), EmbeddingSource("obs1", 0.3, 0.7, (0, 0, 9, 9)))
        for empty in bare
    )
    card = dataclasses.replace(CARD, kind="clip", scale=12.5)
    table = LookupTable(card, ("object",), views, tuple(None if e else 0.25 for e in bare), 0.1, "mean")
    mean = vectors.mean(1)
    norms = np.linalg.norm(mean, axis=-1, keepdims=True)
    return dataclasses.replace(
        scene.with_arrays(
            embeddings=np.divide(mean, norms, out=np.zeros_like(mean), where=norms > 0),
            vocabulary_embeddings=np.eye(4, dtype=np.float32)[:2],
            canonical_embeddings=np.eye(4, dtype=np.float32)[3:],
            view_embeddings=vectors,
        ),
        vocabulary=("mug", "fruit"),
        lookup=table,
    )


def test_a_file_keeps_the_table(rich, tmp_path):
    path = scene_file.write(rich, tmp_path / "rich.r5dgs")
    back = scene_file.read(path)
    assert back.lookup == rich.lookup
    for name in ("embeddings", "view_embeddings", "canonical_embeddings", "vocabulary_embeddings"):
        np.testing.assert_array_equal(getattr(back, name), getattr(rich, name))
    light = scene_file.read_embeddings(path)
    assert light.table == rich.lookup
    np.testing.assert_array_equal(light.view_embeddings, rich.view_embeddings)
    assert scene_info.info(back)["lookup"] == "clip tiny"
    assert scene_file.write(back, tmp_path / "again.r5dgs").read_bytes() == path.read_bytes()


def test_a_file_without_a_table_does_not_change(tmp_path):
    path = scene_file.write(make_scene(n=60, objects=1), tmp_path / "plain.r5dgs")
    assert scene_file.read(path).lookup is None and b'"lookup"' not in scene_json.dump(scene_file.read(path), {})
    assert scene_info.info(scene_file.read(path))["lookup"] is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"canonical_embeddings": None}, "canonical_embeddings: expected an array beside 'lookup'"),
        ({"view_embeddings": np.zeros((1, 2, 4), np.float32)}, "view_embeddings: expected shape"),
        ({"embeddings": np.zeros((5, 3), np.float32)}, "vectors of one length"),
        ({"lookup": None}, "lookup: expected an entry beside"),
        ({"vocabulary": ("mug",)}, "vocabulary_embeddings: expected shape"),
        ({"canonical_embeddings": np.full((1, 4), np.nan, np.float32)}, "canonical_embeddings: expected finite"),
    ],
)
def test_parts_that_do_not_fit_are_refused(rich, tmp_path, change, message):
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.write(dataclasses.replace(rich, **change), tmp_path / "broken.r5dgs")
    assert not (tmp_path / "broken.r5dgs").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thresholds": (None, None, float("nan"), 0.1, 0.1)}, "expected thresholds, margin and scale up to"),
        ({"views": ((),) * 2}, "5 objects of at most 2 views"),
        ({"encoder": dataclasses.replace(CARD, templates=("a photo",))}, "templates with '{}'"),
        ({"encoder": dataclasses.replace(CARD, dimension=5)}, "vectors of one length"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(rich, tmp_path, change, message):
    broken = dataclasses.replace(rich, lookup=dataclasses.replace(rich.lookup, **change))
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.write(broken, tmp_path / "broken.r5dgs")


def test_rows_of_a_table_are_chosen_like_those_of_objects(rich):
    chosen = rich.lookup.select([3, 2, 3])
    assert chosen.views == (rich.lookup.views[3], rich.lookup.views[2], rich.lookup.views[3])
    assert chosen.thresholds == (0.25, 0.25, 0.25) and chosen.encoder == rich.lookup.encoder


def test_the_precision_of_a_file_is_read_from_it(rich, tmp_path):
    for precision in ("exact", "compact", "quantised"):
        path = scene_file.write(rich, tmp_path / f"{precision}.r5dgs", precision=precision)
        assert scene_file.precision_of(path) == precision
    assert scene_file.precision_of(scene_file.write(rich, path)) == "compact"
    with pytest.raises(ValueError, match="expected one of exact, compact, quantised, got 'lossy'"):
        scene_file.write(rich, path, precision="lossy")
