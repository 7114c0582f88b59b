"""One course for all terms: what outer products lose, against scipy; what a lag's state costs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from jaxvm.discover.courses import Course
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.one_course import lost_by_one_course
from jaxvm.discover.select import evidence, price_of_columns
from jaxvm.physics.effects import Scope, Term
from jaxvm.physics.forms import FORMS

SHIFT = (Term("structure.shift_x"), Term("structure.shift_y"))
LAGS = Hypothesis(
    Group(SHIFT, "target"),
    Course("ambient_degC", "lag with state", (2000.0,)),
    Scope(target=("plate",)),
    (),
)


def _spread(rng, n: int) -> np.ndarray:
    root = rng.normal(size=(n, 2 * n))
    return root @ root.T


@pytest.mark.parametrize("terms, bases", [(2, 2), (3, 2), (2, 3)])
@pytest.mark.parametrize("seed", range(5))
def test_no_outer_product_loses_less(terms, bases, seed):
    rng = np.random.default_rng(seed)
    spread, amplitudes = _spread(rng, terms * bases), 5.0 * rng.normal(size=terms * bases)
    inverse = np.linalg.inv(spread)

    def lost(flat):
        off = amplitudes - np.ravel(np.outer(flat[:terms], flat[terms:]))
        return off @ inverse @ off

    peer = min(minimize(lost, rng.normal(size=terms + bases)).fun for _ in range(30))
    # Terms and bases in units of their own: nothing but the unit changes.
    units = np.ravel(np.outer(10.0 ** rng.uniform(-6, 2, terms), 10.0 ** rng.uniform(-3, 3, bases)))
    got = lost_by_one_course(units * amplitudes, np.outer(units, units) * spread, bases)
    assert got == pytest.approx(peer, rel=1e-3)


def test_noise_loses_as_many_as_there_are_unknowns_less():
    """From products with noise as much as chi-square of (terms - 1) (bases - 1) freedoms."""
    rng = np.random.default_rng(1)
    spread = _spread(rng, 6)
    clean = np.ravel(np.outer([30.0, -50.0, 20.0], [40.0, 90.0]))
    drawn = clean + rng.multivariate_normal(np.zeros(6), spread, size=400)
    lost = [lost_by_one_course(a, spread, 2) for a in drawn]
    assert np.mean(lost) == pytest.approx(2.0, abs=5.0 * 2.0 / np.sqrt(400))
    assert lost_by_one_course(clean, spread, 2) < 1e-9


@pytest.mark.parametrize("spread", [np.ones((4, 4)), np.diag([1.0, 1.0, 0.0, 1.0]),
                                    np.diag([1.0, 1.0, np.nan, 1.0])])  # fmt: skip
def test_what_is_not_determined_saves_nothing(spread):
    along = np.array([6.0, 12.0, 3.0, 6.0])
    assert lost_by_one_course(along, spread, 2) == np.inf
    assert price_of_columns(LAGS, along, 300.0, 1000, spread) == pytest.approx(4.0 * np.log(1000))


def test_a_state_of_its_own_is_one_unknown():
    n, drop = 10_000, 300.0
    spread = np.diag([1.0, 1.0, 4.0, 4.0])
    along, apart = np.array([6.0, 12.0, 3.0, 6.0]), np.array([6.0, 12.0, 12.0, -24.0])
    fewer = price_of_columns(LAGS, along, drop, n, spread)
    assert fewer == pytest.approx(3.0 * np.log(n))
    assert price_of_columns(LAGS, along, drop, n) == pytest.approx(4.0 * np.log(n))
    assert price_of_columns(LAGS, apart, drop, n, spread) == pytest.approx(4.0 * np.log(n))
    # What the residuals scatter more, amplitudes that are apart mean less.
    wide = price_of_columns(LAGS, apart, drop, n, 400.0 * spread)
    assert fewer < wide < 4.0 * np.log(n)
    gained = [evidence(LAGS, drop, along, 2.0, n, known) for known in (None, 2.0 * spread)]
    assert gained[1] - gained[0] == pytest.approx(np.log(n))


def test_what_goes_round_follows_no_one_course():
    sways = replace(LAGS, course=Course("time", "periodic", (60.0,)))
    assert not FORMS["periodic"].one_course
    along = np.array([6.0, 12.0, 3.0, 6.0])
    assert price_of_columns(sways, along, 300.0, 1000, np.eye(4)) == pytest.approx(
        4.0 * np.log(1000)
    )
