import numpy as np
import pytest

from r5dgs_core.motion.levenberg_marquardt import solve, solve_all

RNG = np.random.default_rng(0)
TIMES = np.linspace(0.0, 1.0, 24)
SOFT = 0.02**2  # twice the noise, squared


class Counted:
    """Residual function that counts its calls and parameter vectors."""

    def __init__(self, function):
        self.function, self.sizes = function, []

    def __call__(self, x):
        self.sizes.append(len(x))
        return self.function(x)


def line(values):
    """Residuals of the line x_0 + x_1 t against observed values [S] or points [S, D]."""
    columns = np.stack([np.ones_like(TIMES), TIMES], axis=-1)
    values = values.reshape(len(TIMES), -1)
    return lambda x: (
        np.einsum("sk,bkd->bsd", columns, x.reshape(len(x), 2, -1)) - values  # one line per component
    )


def test_a_linear_problem_gives_the_weighted_estimate_and_its_normal_matrix():
    a, y = RNG.normal(size=(9, 2, 4)), RNG.normal(size=(9, 2))
    weights, precision = RNG.uniform(0.2, 3, 9), np.array([0.0, 0.5, 2.0, 0.0])
    found = solve(lambda x: np.einsum("sdp,bp->bsd", a, x) - y, np.zeros(4), weights=weights, precision=precision)
    normal = np.einsum("s,sdp,sdq->pq", weights, a, a) + np.diag(precision**2)
    expected = np.linalg.solve(normal, np.einsum("s,sdp,sd->p", weights, a, y))
    np.testing.assert_allclose(found.x, expected, atol=1e-4)
    np.testing.assert_allclose(found.normal, normal, rtol=1e-6)
    np.testing.assert_allclose(found.residuals, a @ found.x - y, atol=1e-12)
    assert (found.robust == 1).all()
    assert found.cost == pytest.approx(
        (weights * (found.residuals**2).sum(-1)).sum() + ((precision * found.x) ** 2).sum()
    )


def test_the_curved_valley_of_rosenbrock_is_followed_to_its_end():
    def residuals(x):
        return np.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], axis=-1)[:, None]

    np.testing.assert_allclose(solve(residuals, np.array([-1.2, 1.0])).x, [1, 1], atol=1e-6)


def test_convergence_near_an_exact_solution_is_faster_than_linear():
    def residuals(x):
        return np.stack([np.exp(x[:, :1]) * TIMES - 2 * TIMES, (x[:, 1:] ** 3 - 8) * np.ones_like(TIMES)], axis=-1)

    errors = [
        np.abs(solve(residuals, np.array([0.0, 3.0]), steps=steps).x - [np.log(2), 2]).max() for steps in range(12)
    ]
    assert errors[0] == 1.0
    assert errors[-1] < 1e-9
    fast = [after / before for before, after in zip(errors[2:], errors[3:], strict=False) if before > 1e-9]
    assert min(fast) < 1e-2


def test_columns_of_very_different_scale_are_fitted_alike():
    scales = np.array([1e6, 1.0, 1e-4])
    basis = np.stack([np.ones_like(TIMES), TIMES, TIMES**2], axis=-1) * scales
    truth = np.array([0.3, -1.0, 2.0])
    found = solve(lambda x: ((x - truth) @ basis.T)[..., None], np.zeros(3))
    np.testing.assert_allclose(found.x, truth, atol=1e-6)


def test_undetermined_parameters_stay_and_the_others_are_fitted():
    found = solve(lambda x: ((x[:, :1] + x[:, 1:2]) * TIMES - 3 * TIMES)[..., None], np.array([1.0, 0.5, 7.0]))
    assert found.x[:2].sum() == pytest.approx(3, abs=1e-6)
    assert found.x[:2] == pytest.approx([1.75, 1.25], abs=1e-3)  # the smallest change
    assert found.x[2] == 7.0


def test_a_prior_decides_what_the_observations_leave_open():
    found = solve(
        lambda x: ((x[:, :1] + x[:, 1:]) * TIMES - 3 * TIMES)[..., None],
        np.array([4.0, 0.5]),
        precision=np.array([1e-3, 2e-3]),
    )
    assert found.x == pytest.approx([2.4, 0.6], abs=2e-3)  # minimises x^2 + 4 y^2


def test_outliers_hardly_move_a_robust_fit():
    values = 1 + 2 * TIMES + 0.01 * RNG.normal(size=len(TIMES))
    spoiled = [2, 9, 17, 23]
    values[spoiled] += [3.0, -2.0, 5.0, 4.0]
    robust, plain = (solve(line(values), np.zeros(2), softness=softness) for softness in (SOFT, np.inf))
    assert np.abs(robust.x - [1, 2]).max() < 0.02
    assert np.abs(plain.x - [1, 2]).max() > 0.3
    assert robust.robust[spoiled].max() < 1e-3
    assert np.delete(robust.robust, spoiled).min() > 0.2
    np.testing.assert_allclose(robust.normal[0, 0], robust.robust.sum(), rtol=1e-6)


def test_an_observation_is_an_outlier_as_a_whole():
    points = np.stack([1 + 2 * TIMES, 3 - TIMES], axis=-1) + 0.01 * RNG.normal(size=(len(TIMES), 2))
    points[5, 0] += 2.0
    found = solve(line(points), np.zeros(4), softness=2 * SOFT)
    assert found.robust.shape == (len(TIMES),)
    assert found.robust[5] < 1e-3
    np.testing.assert_allclose(found.x, [1, 3, 2, -1], atol=0.02)


def test_many_starts_are_solved_independently():
    """Each start has values of its own, and they need different numbers of steps."""
    values = 1 + np.arange(5)[:, None] * TIMES + 0.01 * RNG.normal(size=(5, len(TIMES)))
    values[3, 7] += 2.0
    starts = RNG.normal(size=(5, 2)) * np.array([[0], [1], [5], [20], [1]])

    def residuals(x, rows):
        return (x[..., :1] + np.sinh(x[..., 1:]) * TIMES - values[rows, None])[..., None]

    together = solve_all(residuals, starts, softness=SOFT)
    for k in range(5):
        alone = solve(lambda x, k=k: residuals(x[None], np.array([k]))[0], starts[k], softness=SOFT)
        np.testing.assert_allclose(together.x[k], alone.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(together.row(k).normal, alone.normal, rtol=1e-9)
    assert together.robust[3, 7] < 1e-2


def test_a_start_ends_once_the_gain_is_negligible():
    counted = Counted(line(1 + 2 * TIMES + 0.1 * RNG.normal(size=len(TIMES))))
    solve(counted, np.array([1.0, 2.0]), enough=1e6)
    assert len(counted.sizes) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_steps_to_residuals_that_are_not_finite_are_refused(bad):
    """The first full step of ln(x) = ln(0.1) from x = 3 leads to x < 0, and its neighbours must be finite as well."""
    tried = []

    def residuals(x):
        tried.append(x[0, 0])
        inside = x[:, 0] > 0.05
        values = np.where(inside, np.log(np.where(inside, x[:, 0], 1.0) / 0.1), bad)
        return values[:, None, None]

    found = solve(residuals, np.array([3.0]))
    assert min(tried) < 0
    assert found.x[0] == pytest.approx(0.1, abs=1e-8)
    assert np.isfinite(found.normal).all()


def test_a_point_whose_neighbours_are_not_finite_is_refused():
    def residuals(x):
        return np.where(x[:, 0] < 1e-9, x[:, 0] - 1e-10, np.nan)[:, None, None]

    start = np.array([-1.0])
    found = solve(residuals, start)
    assert start[0] < found.x[0] < -1e-7
    assert np.isfinite(found.normal).all()


def test_each_step_costs_one_call():
    counted = Counted(lambda x: np.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], axis=-1)[:, None])
    solve(counted, np.array([-1.2, 1.0]), steps=7)
    assert counted.sizes == [3] * 8


def test_no_step_gives_the_start_and_an_exact_start_takes_no_step():
    values = 1 + 2 * TIMES
    assert solve(line(values), np.array([5.0, 5.0]), steps=0).x.tolist() == [5.0, 5.0]
    counted = Counted(line(values))
    assert solve(counted, np.array([1.0, 2.0]), softness=SOFT).x.tolist() == [1.0, 2.0]
    assert len(counted.sizes) == 1
