"""The factor on a standard deviation: right for any size, near the wanted share from few stretches, never absurd."""

import dataclasses

import numpy as np
import pytest

from halfwidth.vehicle import widening
from halfwidth.vehicle.widening import factor_for, inflation, quantile, tail_of

LEVEL, Z = 0.9, 1.6448536


def one(length, *groups):
    return widening.Tested(length, 9, 0.1, 0.2, 0.95, 1.0, asked=groups)


def test_without_a_test_there_is_a_floor():
    np.testing.assert_allclose(inflation([], 5.0, np.array([1.0, 2.0]), LEVEL), widening.UNTESTED)


def test_many_stretches_are_believed_and_few_make_it_wide():
    many, few = (inflation([one(10.0, (1.0, 2.0, n))], 10.0, np.ones(1), LEVEL)[0] for n in (1e5, 4.0))
    assert many == pytest.approx(2.0, rel=0.01)
    assert 2.0 < few < 4.0


def test_the_size_of_the_error_counts_and_the_length_less():
    found = [one(5.0, (0.2, 1.0, 200.0), (2.0, 3.0, 200.0)), one(40.0, (0.3, 1.1, 50.0), (5.0, 3.2, 50.0))]
    small, large = inflation(found, 10.0, np.array([0.2, 3.0]), LEVEL)
    assert small == pytest.approx(1.05, rel=0.1)
    assert large == pytest.approx(3.1, rel=0.1)
    near, far = inflation(found, 300.0, np.array([5.0, 500.0]), LEVEL)
    assert 2.0 < far < 6.0
    assert near == pytest.approx(3.2, rel=0.3)


def test_what_is_stated_to_be_less_sure_is_not_shown_as_surer():
    sd = np.array([3.0, 0.1, 1.0, 0.5])
    half = inflation([one(5.0, (0.5, 4.0, 300.0), (3.0, 0.3, 300.0))], 5.0, sd, LEVEL, least=0.0) * sd
    assert (np.diff(half[np.argsort(sd)]) >= 0).all()


def test_no_narrower_than_asked_for():
    found = [one(5.0, (1.0, 0.01, 500.0))]
    assert inflation(found, 5.0, np.ones(1), LEVEL)[0] == 1.0
    assert widening.LEAST <= inflation(found, 5.0, np.ones(1), LEVEL, least=0.0)[0] < 0.2


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("n", [3, 8, 40])
def test_the_next_stretch_lies_inside_as_often_as_promised(n, level):
    rng = np.random.default_rng(n)
    z, inside = widening._z(level), []
    for _ in range(2000):
        scale = np.exp(rng.normal(0, 0.5))
        hidden = [np.abs(rng.standard_normal(4)) * scale / z for _ in range(n)]
        inside.append(abs(rng.standard_normal()) * scale <= z * factor_for(hidden, 10.0, level, 1e6))
    assert -0.02 < np.mean(inside) - level < 0.08 * (1 if n < 8 else 0.6)


def test_a_quantile_of_few_errors_is_enlarged_and_of_many_is_their_own():
    rng = np.random.default_rng(1)
    errors = np.abs(rng.standard_normal(20_000))
    assert quantile(errors, np.ones(errors.size), LEVEL, errors.size) == pytest.approx(Z, rel=0.03)
    few = [quantile(errors[k : k + 2], np.ones(2), LEVEL, 2) for k in range(0, 4000, 2)]
    assert np.median(few) == pytest.approx(Z, rel=0.1)
    assert quantile(np.zeros(3), np.ones(3), LEVEL, 3) == 0.0


def test_a_trend_with_the_length_goes_on_up_to_twice_what_was_tested():
    found = [one(length, (0.3, 0.5 * (length / 5.0) ** 0.4, 300.0)) for length in (5.0, 10.0, 20.0, 40.0)]
    at = [inflation(found, length, np.array([0.3]), LEVEL, least=0.0)[0] for length in (40.0, 60.0, 80.0, 1000.0)]
    assert at[0] < at[1] < at[2]
    assert at[2] == pytest.approx(0.5 * 16**0.4, rel=0.1)
    assert at[3] == pytest.approx(at[2])


def test_a_quantile_among_few_hard_places_is_less_sure():
    rng = np.random.default_rng(2)
    alike = [np.abs(rng.standard_normal(50)) for _ in range(200)]
    hard = [one * (8.0 if k % 8 == 0 else 1.0) for k, one in enumerate(alike)]
    assert tail_of(alike, LEVEL) == pytest.approx(1.0, abs=0.15)
    assert tail_of(hard, LEVEL) > 2.5
    assert tail_of([np.zeros(3)], LEVEL) == 1.0
    sure, unsure = (
        inflation([dataclasses.replace(one(10.0, (1.0, 1.0, 12.0)), tail=tail)], 10.0, np.ones(1), LEVEL, least=0.0)[0]
        for tail in (1.0, 3.0)
    )
    assert 1.0 < sure < unsure < 2.0


@pytest.mark.parametrize("level", [0.8, 0.9, 0.99])
@pytest.mark.parametrize("variance", [0.01, 0.1, 0.5])
def test_an_interval_whose_size_is_unsure_holds_as_often_as_wanted(variance, level):
    rng = np.random.default_rng(3)
    half = widening._z(level) * widening._widened(level, np.array([variance]))[0]
    held = np.abs(rng.standard_normal(200_000)) <= half * np.exp(np.sqrt(variance) * rng.standard_normal(200_000))
    assert held.mean() == pytest.approx(level, abs=0.003)
