"""Compensation frame by frame: causal, with bounded memory, equal to that of a whole recording."""

from collections import deque

import numpy as np
from jaxtyping import Float

from jaxvm.identify.compensate import moved
from jaxvm.identify.difference import Difference
from jaxvm.identify.inputs import Inputs, are_power
from jaxvm.identify.lags import Lags
from jaxvm.identify.model import CameraDrift
from jaxvm.recording.model import Camera


class Compensator:
    """Compensation of one camera.

    `read` takes the readings of the inputs as they come, `correct` the pixels of a frame at the
    time of the last reading. The first reading is taken for an equilibrium, as in `compensate`.
    """

    def __init__(self, camera: Camera, drift: CameraDrift):
        self.camera, self.drift = camera, drift
        dynamics = drift.dynamics
        lags = isinstance(dynamics, Lags)
        self._stream = _LagStream(dynamics) if lags else _StepStream(dynamics)
        self._ports: np.ndarray | None = None
        self.outside = False

    def read(self, time: float, values: dict[str, float]) -> None:
        """Readings of all inputs (by name) at a time (s); time since power-on in s.

        Raises:
            ValueError: an input is missing, or time does not go on.
        """
        dynamics = self.drift.dynamics
        missing = [name for name in dynamics.inputs if name not in values]
        if missing:
            raise ValueError(f'the reading at {time:g} s has no "{missing[0]}"; give all inputs')
        x = np.array([values[name] for name in dynamics.inputs], float)
        row = self._stream.step(time, x)
        if row is not None:
            self._ports = (row - dynamics.centre) @ dynamics.gain.T
        now = Inputs(dynamics.inputs, np.array([time]), x[:, None], np.array([0]))
        self.outside = bool(self.drift.outside(now)[0])

    def correct(
        self, pixel: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, " n"] | None = None
    ) -> Float[np.ndarray, "n 2"]:
        """Corrected pixels of a frame taken at the time of the last reading.

        Args:
            pixel: as measured (px).
            depth: distances (m) of the marks along the axis, for a model with shifts.

        Raises:
            ValueError: there was no reading yet, or distances are missing.
        """
        if depth is None and self.drift.has_shifts:
            raise ValueError("the model has shifts of the camera; give the distances of the marks")
        if self._ports is None:
            raise ValueError("there was no reading of the inputs yet; call read first")
        at = np.full(len(pixel), self.drift.depth_m) if depth is None else depth
        ports = np.repeat(self._ports[None], len(pixel), axis=0)
        return pixel - moved(self.camera, self.drift, pixel, at, ports)


class _LagStream:
    """Regressors of `Lags`, one reading after the other."""

    def __init__(self, model: Lags):
        self.model = model
        self.power = are_power(model.inputs)
        self.time = 0.0
        self.lagged: np.ndarray | None = None  # [order, inputs]
        self.now: np.ndarray | None = None
        self.past: deque[tuple[float, np.ndarray]] = deque()
        if model.delay < 0.0:
            raise ValueError(
                f"the model asks for inputs {-model.delay:.3g} s ahead; set the clock of the log "
                "right, and identify anew"
            )

    def step(self, time: float, x: np.ndarray) -> np.ndarray:
        m = self.model
        late = self._late(time, np.where(self.power, x, x - m.reference))
        now = np.where(self.power, x >= 0.0, late)
        if self.lagged is None:
            lagged = np.repeat(now[None].astype(float), m.structure.order, axis=0)
        else:
            assert self.now is not None
            dt = time - self.time
            if dt <= 0.0:
                raise ValueError(f"the reading at {time:g} s is not after that at {self.time:g} s")
            rest = -np.expm1(-dt / m.tau)[:, None]
            drive = rest * self.now + (now - self.now) * (1.0 - rest * m.tau[:, None] / dt)
            lagged = (1.0 - rest) * self.lagged + drive
        self.time, self.now, self.lagged = time, now.astype(float), lagged
        since = -np.expm1(-np.maximum(x, 0.0) / m.tau[:, None])
        shown = np.where(self.power, since, lagged)
        powers = [now.astype(float) ** k for k in range(1, m.structure.power + 1)]
        return np.concatenate([np.zeros(0), *powers, shown.ravel()])

    def _late(self, time: float, x: np.ndarray) -> np.ndarray:
        """Readings of `delay` ago; what is older is forgotten."""
        self.past.append((time, x))
        wanted = time - self.model.delay
        while len(self.past) > 1 and self.past[1][0] <= wanted:
            self.past.popleft()
        (t0, x0), (t1, x1) = self.past[0], self.past[min(1, len(self.past) - 1)]
        if wanted <= t0 or t1 == t0:
            return x0
        return x0 + (x1 - x0) * (wanted - t0) / (t1 - t0)


class _StepStream:
    """Regressors of `Difference`; readings come in its steps, and others are passed over."""

    def __init__(self, model: Difference):
        self.model = model
        self.power = are_power(model.inputs)
        self.start: float | None = None
        self.count = 0
        orders = model.structure
        self.inputs: deque[np.ndarray] = deque(maxlen=orders.nk + orders.nb)
        self.outputs: deque[np.ndarray] = deque(maxlen=max(orders.na, 1))

    def step(self, time: float, x: np.ndarray) -> np.ndarray | None:
        m, orders = self.model, self.model.structure
        if self.start is None:
            self.start = time
        if abs(time - self.start - self.count * m.step) > 0.01 * m.step:
            if time > self.start + (self.count + 0.01) * m.step:
                raise ValueError(
                    f"there was no reading at {self.start + self.count * m.step:g} s; the model "
                    f"needs one every {m.step:g} s"
                )
            return None
        self.count += 1
        u = np.where(self.power, x >= 0.0, x - m.reference).astype(float)
        while len(self.inputs) < self.inputs.maxlen:  # type: ignore[operator]
            self.inputs.append(u)
        self.inputs.append(u)
        late = np.array([self.inputs[-1 - orders.nk - k] for k in range(orders.nb)]).T.ravel()
        while len(self.outputs) < orders.na:
            self.outputs.append(late / (1.0 + m.a.sum()))
        past = [self.outputs[-1 - k] for k in range(orders.na)]
        self.outputs.append(late - sum(a * y for a, y in zip(m.a, past, strict=True)))
        return self.outputs[-1]
