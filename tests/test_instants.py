"""When something happened: intervals that hold the truth, whatever the epochs leave open."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.courses import Course, gaps
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.instants import at_best_instants, instants_of, with_spread
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.report.words import when
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import effect_deviations

N_EPOCHS = 30
TERMS = (Term("target.point_x"), Term("target.point_y"))
MARK = Scope(target=("board",), point=("1/1",))
GROUP = Group(TERMS, "mark", (0, 7), "board")


def slipped(instant, size, form="step", *constants):
    return Effect("it slips", TERMS, "time", form, (instant, *constants), 0.0, MARK, (size, -size))


@pytest.fixture(scope="module")
def board():
    """A board whose poses and camera are known: only the slip of a mark is sought."""
    known = board_recording(n_epochs=N_EPOCHS, free=frozenset())
    poses = known.truth["carrier_from_target"]
    (plate,) = known.recording.model.targets
    plate = replace(plate, pose=poses, free=frozenset())
    return known, known.with_model(targets=(plate,))


def fitted(board, truth, start, seed=0, unseen=()):
    """Adjustment of a slip to drawn pixels, its weights, and what a finding tells of it."""
    known, recording = board
    obs, rng = recording.observations, np.random.default_rng(seed)
    exact = known.true_scene(recording).with_effects((truth,), (8, 4))
    pixel = predicted(exact)
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    drawn = replace(recording, observations=replace(obs, pixel=pixel))
    scene = known.true_scene(drawn).with_effects((start,), (8, 4))
    lost = np.isin(obs.epoch, unseen) & (obs.point == 7)
    weights = tuple(np.where(lost[rows], 0.0, 1.0) for rows in scene.tables)
    final = adjust(scene, weights=weights, check=False)
    (stds,) = effect_deviations(final)
    (effect,) = final.scene.fitted_effects()
    course = Course(effect.driver, effect.form, effect.constants)
    hypothesis = Hypothesis(GROUP, course, MARK, ())
    return final, weights, Told(hypothesis, effect, tuple(stds))


@dataclass(frozen=True)
class Told:
    """Of a finding, what its instant needs."""

    hypothesis: Hypothesis
    final_effect: Effect
    final_stds: tuple[float, ...]
    noise: float = 1.0


def instant_of(final, found, instants):
    """Instant and its standard deviation as they are reported."""
    (effect,) = final.scene.fitted_effects()
    stds = (*found.final_stds, 0.0)[: effect.n_columns + len(effect.constants)]
    shown = with_spread(replace(found, final_effect=effect, final_stds=stds), instants)
    return effect.constants[0], shown.final_stds[effect.n_columns]


def test_intervals_of_weak_slips_hold_the_truth(board):
    middles = gaps("time", board[0].true_scene().network.channels)
    truth, z, narrow = float(middles[12]), [], 0
    for seed in range(40):
        final, weights, found = fitted(
            board, slipped(truth, 6e-5), slipped(float(middles[13]), 6e-5), seed
        )
        final, (instants,) = at_best_instants(final, [found], 0, weights)
        value, std = instant_of(final, found, instants)
        assert value == instants[0].best
        z.append((value - truth) / std)
        narrow += abs(value - truth) > 1.645 * instants[0].gap(value) / 3.5
    inside = np.sum(np.abs(z) <= 1.645)
    # 90 % of 40, within three standard deviations; half a gap alone would not do.
    assert inside >= 30, z
    assert narrow > 10
    assert np.std(z) > 0.5, z


def test_a_mark_that_was_not_seen_leaves_the_instant_open(board):
    middles = gaps("time", board[0].true_scene().network.channels)
    strong = 3e-3
    seen = fitted(board, slipped(float(middles[12]), strong), slipped(float(middles[12]), strong))
    unseen = fitted(
        board,
        slipped(float(middles[12]), strong),
        slipped(float(middles[12]), strong),
        unseen=range(10, 19),  # gap 12 lies between epochs 14 and 15
    )
    stds = []
    for final, weights, found in (seen, unseen):
        instants = instants_of(final, 0, found, weights)
        stds.append(instant_of(final, found, instants)[1])
    gap = float(np.median(np.diff(middles)))
    # A uniform distribution over one gap, and over ten of them.
    assert stds[0] == pytest.approx(gap / np.sqrt(12.0), rel=1e-3)
    assert stds[1] == pytest.approx(10.0 * gap / np.sqrt(12.0), rel=0.1)


def test_a_start_that_is_refined_keeps_the_tangent_inside_its_gap(board):
    middles = gaps("time", board[0].true_scene().network.channels)
    gap = float(np.median(np.diff(middles)))
    truth = slipped(float(middles[12]), 5e-3, "settling", 4.0 * gap)
    final, weights, found = fitted(board, truth, truth)
    instants = instants_of(final, 0, found, weights)
    value, std = instant_of(final, found, instants)
    assert std == found.final_stds[2] < gap
    assert abs(value - float(middles[12])) < 4.0 * std
    weak = slipped(float(middles[12]), 6e-5, "settling", 4.0 * gap)
    final, weights, found = fitted(board, weak, weak)
    _, std = instant_of(final, found, instants_of(final, 0, found, weights))
    assert std > 2.0 * gap


def test_of_several_jumps_each_goes_where_all_epochs_want_it(board):
    middles = gaps("time", board[0].true_scene().network.channels)
    gap = float(np.median(np.diff(middles)))
    truth = Effect("", TERMS, "time", "3 jumps", tuple(middles[[4, 12, 20]]), 0.0, MARK)
    sizes = (2e-3, -2e-4, 1e-3, -1e-3, 1e-4, 2e-3)  # x at each, then y at each
    start = replace(truth, constants=tuple(middles[[5, 13, 20]]), amplitudes=6 * (1e-4,))
    final, weights, found = fitted(board, replace(truth, amplitudes=sizes), start)
    final, (instants,) = at_best_instants(final, [found], 0, weights)
    (effect,) = final.scene.fitted_effects()
    shown = with_spread(
        replace(found, final_effect=effect, final_stds=(*found.final_stds, 0.0, 0.0, 0.0)[:9]),
        instants,
    )
    stds = np.array(shown.final_stds[6:])
    assert effect.constants[0] == middles[4]
    assert effect.constants[2] == middles[20]
    # What is strong is known to its gap, the weak one is not.
    np.testing.assert_allclose(stds[[0, 2]], gap / np.sqrt(12.0), rtol=1e-3)
    assert stds[1] > 1.5 * stds[0]
    assert abs(effect.constants[1] - middles[12]) < 3.0 * stds[1]
    assert "suddenly, 3 times in time (instant" in when(effect)


def test_what_has_no_instant_is_left_alone(board):
    steady = Effect("it sits wrongly", TERMS, "constant", "constant", (), 0.0, MARK, (1e-3, 0.0))
    final, weights, found = fitted(board, steady, steady)
    assert instants_of(final, 0, found, weights) == ()
    assert with_spread(found, ()) == found


def test_words_tell_how_sure_an_instant_is():
    step = slipped(894.0, 1e-3)
    assert "instant 14.9 min" in when(step)
    assert "instant 14.9 ± 1.0 min" in when(step, (1e-5, 1e-5, 61.0))
    settling = slipped(894.0, 1e-3, "settling", 300.0)
    assert "instant" not in when(settling, (1e-5, 1e-5, 61.0))
    assert "start 14.9 ± 1.0 min, time constant 5 min" in when(settling, (1e-5, 1e-5, 61.0))
