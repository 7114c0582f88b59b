"""A recording of a scene: hidden physics drawn, scaled and applied; noise added; folder written."""

from dataclasses import dataclass

import numpy as np

from . import (
    absorb,
    chain,
    files,
    noise,
    on_air,
    on_detection,
    on_lenses,
    on_mounts,
    on_ranges,
    on_sensors,
    on_targets,
    strange,
)
from .effect import EFFECTS, KINDS, choose
from .far import relay, station, stereo
from .near import board, wide
from .streams import stream

PLANS = (
    *("nearer", "farther", "roll", "tilt", "cycle", "reverse", "field", "restart", "longer"),
    "camera",
)
SCENES = {"board": board, "wide": wide, "station": station, "stereo": stereo, "relay": relay}
STAGES = (on_targets, on_air, on_mounts, on_lenses, on_sensors, on_detection, on_ranges, strange)
STRENGTH = (40.0, 40_000.0)
"""Smallest and largest sum of (change / sigma)^2 that sizes are drawn for."""
SEEN = (40.0, 1_000.0)
"""An effect of which less than this survives the adjustment is drawn again, by what survives."""
MOST = 25.0
"""Largest change (px) that a size may reach, unless it is fixed."""


@dataclass
class Hidden:
    """An effect at its place and of its size."""

    effect: object
    draft: object
    size: float
    strength: float
    visible: float

    def hooks(self):
        return self.draft.hooks(self.size)

    def told(self):
        """What the key says of it.

        `strength` is the sum of (change / sigma)^2 in the scene without a plan, `visible` what an
        adjustment would leave of it.
        """
        course = self.draft.course
        names = ("tau_s", "period_s", "t0_s")
        constants = {k: _number(v) for k, v in course.constants.items()}
        return {
            "effect": self.effect.key,
            "rows": list(self.effect.rows),
            "outside": self.effect.outside,
            "where": self.draft.where,
            "when": course.when,
            "t0_s": None if course.t0 is None else float(course.t0),
            "values": {p: float(a * self.size) for p, a in self.draft.ports.items()},
            "driver": course.driver,
            "size": float(self.size),
            "strength": self.strength,
            "visible": self.visible,
            "constants": {k: None for k in names} | constants,
        }


def _number(value):
    return [float(x) for x in value] if isinstance(value, list) else float(value)


@dataclass
class Made:
    """A finished recording: what is written, and the truth about it."""

    scene: object
    rows: object
    shots: object
    tables: dict
    truth: dict
    change: dict
    changes: list

    def write(self, folder):
        """Write recording.toml and the tables; nothing in them tells the answer."""
        files.write(folder, self.scene, self.tables)


def record(kind, seed, hidden=(), plan=None, size="normal"):
    """Record a scene.

    Args:
        kind: one of KINDS.
        seed: of everything that is drawn.
        hidden: keys of EFFECTS that are at work.
        plan: None or one of PLANS: the same world again under other conditions.
        size: "normal", or "large" (stations only).
    """
    for key in hidden:
        if kind not in EFFECTS[key].kinds:
            raise ValueError(f'"{key}" does not show in a "{kind}" scene')
    needs = "beam" if any(EFFECTS[k].place == "beam" for k in hidden) else (
        "finder" if any(EFFECTS[k].place == "finder" for k in hidden) else None
    )  # fmt: skip
    usual = _build(kind, seed, None, size, needs)
    scene = usual if plan is None else _build(kind, seed, plan, size, needs)
    if plan not in (None, "longer"):
        # On the next day; what is recorded for longer is the same once more, from the start.
        scene.began_s = float(usual.t[-1]) + 86_400.0
    places = stream(kind, seed, "missing" if plan is None else f"missing {plan}")
    usual_rows = chain.all_rows(usual)
    effects = _draw_all(usual, usual_rows, hidden)
    rows = usual_rows if scene is usual else chain.all_rows(scene)
    rows = rows.where(noise.keep(places, scene, rows))
    return _measure(scene, rows, effects, stream(kind, seed, f"noise {plan}"))


def _build(kind, seed, plan, size, needs):
    scene = SCENES[kind](seed, plan, size)
    if needs is None:
        scene.finders = scene.finders if scene.with_finder else []
    if needs == "beam":
        for finder in scene.finders:  # the beam meets a flat plate
            finder.marks = []
            scene.targets[finder.target].points[:, 2] = 0.0
    return scene


def _draw_all(scene, rows, hidden):
    """Place the effects and scale them; the sizes belong to the scene without a plan."""
    if not hidden:
        return []
    plain = chain.look(scene, rows)
    shots = chain.all_shots(scene)
    absorber = absorb.Absorber(scene, rows, shots, plain)
    return [_draw(scene, key, absorber) for key in hidden]


def _draw(scene, key, absorber):
    """Place an effect and scale it so that its change has a drawn strength.

    Where the engineer's unknowns would take up nearly all of it, what they leave is scaled instead.
    """
    effect = EFFECTS[key]
    rng = stream(scene.kind, scene.seed, f"hidden {key}")
    site = choose(scene, rng, effect.place)
    draft = effect.draw(site)
    aim = np.exp(rng.uniform(*np.log(STRENGTH)))
    seen = np.exp(rng.uniform(*np.log(SEEN)))
    low, high = (draft.low, draft.high) if draft.fixed else (draft.low / 3.0, draft.high * 3.0)
    size = np.sqrt(draft.low * draft.high)
    measure, wanted, power, before = absorber.strength, aim, 2.0, None
    for turn in range(6):
        change = absorber.change(draft.hooks(draft.sign * size))
        got = measure(change)
        if turn == 2 and (left := absorber.visible(change)) < min(SEEN[0], wanted):
            measure, wanted, got, before = absorber.visible, seen, left, None
        if not got > 0.0:
            raise ValueError(f'"{key}" changes nothing in this scene')
        most = size * MOST / max(np.abs(change["pixels"]).max(), 1e-9)
        if before is not None and abs(np.log(size / before[0])) > 0.02 and before[1] > 0.0:
            power = np.log(got / before[1]) / np.log(size / before[0])
        before = (size, got)
        power = float(np.clip(power, 1.5, 6.0))
        raised = size * (wanted / got) ** (1.0 / power)
        better = np.clip(raised, low, max(low, min(high, most)))
        done = abs(np.log(better / size)) < 0.05
        size = better
        if done and turn >= 2:
            break
    change = absorber.change(draft.hooks(draft.sign * size))
    size = float(draft.sign * size)
    return Hidden(effect, draft, size, absorber.strength(change), absorber.visible(change))


def _measure(scene, rows, effects, rng):
    plain = chain.look(scene, rows)
    shots = chain.all_shots(scene)
    bare = chain.distances(scene, shots)

    def changed(some):
        if not some:
            return {"pixels": np.zeros_like(plain.pixel), "ranges": np.zeros_like(bare)}
        hooks = tuple(h.hooks() for h in some)
        return {
            "pixels": chain.pixels(scene, rows, hooks, plain) - plain.pixel,
            "ranges": chain.distances(scene, shots, hooks) - bare,
        }

    changes = [changed([h]) for h in effects]
    change = changes[0] if len(effects) == 1 else changed(effects)
    error, declared, told = noise.make_noise(rng, scene, rows)
    measured = plain.pixel + change["pixels"] + error
    tables = {
        "observations": files.observations(scene, rows, measured, declared),
        "epochs": files.epochs(scene, rng),
        "drivers": files.drivers(scene, rng),
    }
    if len(bare):
        distance = bare + change["ranges"] + scene.sigma_m * rng.normal(size=len(bare))
        tables["ranges"] = files.ranges(scene, shots, distance)
    truth = {
        "kind": scene.kind,
        "seed": int(scene.seed),
        "plan": scene.plan,
        "size": scene.size,
        "noise": told,
        "hidden": [h.told() for h in effects],
    }
    return Made(scene, rows, shots, tables, truth, change, changes)


__all__ = ["EFFECTS", "KINDS", "PLANS", "STAGES", "Made", "record"]
