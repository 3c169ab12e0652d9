"""Simulated tracks: slow errors are centred and claimed without bias, and other noises have none."""

import numpy as np
import pytest

from tests.support import benchmark_modules


@pytest.fixture
def tracks(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("futures.simulated_tracks")


def test_slow_errors_are_centred_and_their_claimed_deviations_are_right_on_average(tracks):
    rng, times, ratios = np.random.default_rng(0), np.linspace(0, 0.75, 15), []
    for _ in range(500):
        errors, claimed = tracks.slow_errors(rng, times)
        assert np.abs(errors.mean(0)).max() < 1e-12
        ratios.append(np.log(np.array(claimed) / np.sqrt((errors**2).mean(0).reshape(2, 3).mean(1))))
    assert np.abs(np.mean(ratios)) < 0.1
    assert np.std(ratios) == pytest.approx(np.log(tracks.CLAIM), rel=0.1)


def test_only_slow_noise_adds_and_claims_slow_errors(tracks):
    plain, slow = (tracks.draw("steady", tracks.NOISES[name], 7) for name in ("low", "slow"))
    assert plain.claimed == (0, 0) and min(slow.claimed) > 0
    added = slow.places - plain.places
    assert np.abs(added.mean(0)).max() < 1e-12 < np.abs(added).max()
