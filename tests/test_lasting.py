"""What a lasting change does to a camera in the end, in numbers and in words."""

import numpy as np

from jaxvm.identify.difference import Difference, Orders
from jaxvm.identify.lags import Lags, Structure
from jaxvm.identify.model import CameraDrift, Trained
from jaxvm.physics.drivers import POWER_ON
from jaxvm.report.words import lasting_drift

POWER = POWER_ON + "left"
NAMES = ("body_left_degC", "humidity_pct", POWER)


def drift(dynamics):
    trained = {"body_left_degC": Trained(20.0, 30.0), "humidity_pct": Trained(40.0, 60.0)}
    trained |= {POWER: Trained(0.0, 7200.0)}
    ports = ("sensor.focal", "mount.turn_x")
    return CameraDrift("left", ports, (), dynamics, 2.0, trained, 0.01, 0.2)


def lags(gain, sigma):
    none = np.zeros(0)
    return Lags(Structure(2, 0), NAMES, np.zeros(3), np.array([300.0, 900.0]), 0.0, gain,
                np.zeros(6), none, 0.0, sigma)  # fmt: skip


def test_what_lasts_is_told_where_it_is_clear_the_largest_first():
    gain = np.zeros((2, 6))
    # Of two time constants: 50 + 22 ppm/K; humidity by 4 ppm/%, but at two deviations.
    gain[0] = [50e-6, 4e-6, 0.0, 22e-6, 0.0, 0.0]
    gain[1] = [2e-6, 0.0, -30e-6, 0.0, 0.0, 0.0]
    sigma = np.array([[3e-7, 2e-6, 1.0, 4e-7, 0.0, 1.0], [2e-7, 1.0, 2e-6, 0.0, 1.0, 2e-6]])
    focal, turn = lasting_drift(drift(lags(gain, sigma)))
    assert focal == "sensor.focal 72.00 ± 0.50 ppm/K of body_left_degC"
    # 30 µrad by power, 20 µrad by the ten kelvin of the training.
    assert turn == (
        "mount.turn_x -30.0 ± 2.8 µrad after time since power-on of left, "
        "2.00 ± 0.20 µrad/K of body_left_degC"
    )


def test_nothing_clear_is_no_line():
    assert lasting_drift(drift(lags(np.full((2, 6), 1e-6), np.full((2, 6), 1e-6)))) == []


def test_a_difference_equation_settles_where_its_words_say():
    """The end of a step of one kelvin, run for long."""
    a, gain = np.array([-0.9]), np.array([[3e-6, 1e-6], [0.0, 0.0]])
    found = Difference(Orders("ARX", 1, 2), NAMES[:1], np.zeros(1), 60.0, a, gain, np.zeros(2),
                       np.array([[3e-7, 4e-7], [1.0, 1.0]]))  # fmt: skip
    y = 0.0
    for _ in range(500):
        y = 0.9 * y + 4e-6
    assert np.isclose(found.stationary()[0, 0], y)
    assert lasting_drift(drift(found)) == ["sensor.focal 40.0 ± 5.0 ppm/K of body_left_degC"]
