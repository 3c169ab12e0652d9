"""The registry of encoders, and one that the developer's page adds."""

import numpy as np

from r5dgs_core.language.encoders import encoder_base, registry
from tests.support import pages


def test_the_developers_page_adds_an_encoder(tmp_path, monkeypatch):
    pages.load("Encoder", "r5dgs_core.language.encoders.letter_encoder", monkeypatch)
    monkeypatch.setattr(registry, "MODULES", [*registry.MODULES, "letter_encoder"])
    (tmp_path / "letters.json").write_text('{"letters": "aeiou"}')
    found = registry.open_encoder(tmp_path)
    assert found.card.dimension == 5 and not found.card.sees
    apple, orange = encoder_base.embed_phrases(found, ["an apple", "orange"])
    np.testing.assert_allclose(apple, [2**-0.5, 2**-0.5, 0, 0, 0], atol=1e-6)
    assert 0 < apple @ orange < 1
