"""What an entry of the catalogue says, and the groups of terms that many entries share."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxvm.physics.effects import Term
from jaxvm.physics.forms import FORMS

Terms = tuple[Term, ...]


@dataclass(frozen=True)
class Entry:
    """One named effect.

    Attributes:
        id: stable key.
        physics: the finding in words.
        rows: numbers of the rows of PHYSICS.md that this entry is the right answer for; none where
            it goes beyond them.
        groups: alternatives of terms that share one amplitude vector; the first is the fullest.
        drivers: kinds of time-like drivers: "constant", "time", "power-on", a kind of recorded
            channel (`jaxvm.physics.drivers.CHANNEL_UNITS`: "temperature", ...), or "quantity", any
            recorded channel.
        forms: forms that the course may take, with any of the drivers.
        entity: what has it: "camera", "station", "target", "view" (a target as one camera sees
            it), "face" (the same, of targets that several stations see), "mark" or "rangefinder".
        plausible: smallest and largest size that is met in practice, in the unit of the first port
            (per unit of the driver where it has one).
        mistaken_for: what looks alike.
        separate_by: the recording that tells them apart.
        explanation: two sentences for an engineer.
    """

    id: str
    physics: str
    rows: tuple[int, ...]
    groups: tuple[Terms, ...]
    drivers: tuple[str, ...]
    forms: tuple[str, ...]
    entity: str
    plausible: tuple[float, float]
    mistaken_for: str
    separate_by: str
    explanation: str

    def takes(self, kinds: tuple[str, ...], form: str) -> bool:
        """Whether a driver of any of these kinds may drive it in a form.

        What jumps may jump again, and what follows may count from a reference of its own.
        """
        known = {form, FORMS[form].single, _FROM_ELSEWHERE.get(form, form)} & {*self.forms}
        return bool(known) and any(kind in self.drivers for kind in kinds)


_FROM_ELSEWHERE = {"affine": "linear", "affine lag": "lag"}
"""Forms with a reference of their own, and what they are when that is the mean."""

HYSTERESIS = ("hysteresis", "hysteresis with state")
THERMAL = ("linear", "lag", "lag with state", "delay", "two lags")
"""Forms of what follows a quantity, at once or late."""

CHANGING = ("rate", "transient", "transient with state")
"""Forms of what follows the rate of a quantity, at once or late."""

WARMING_UP = ("onset", "fading", "two decays")
"""Forms of what settles after power-on: calibrated cold, or calibrated warm and recorded cold."""

SETTLING = ("linear", "proportional", "onset", "creep", "ramp", "settling")
"""Forms of what moves slowly one way."""

ALWAYS = ("constant",)
"""Driver and form of what does not change."""


def plain(*ports: str) -> Terms:
    """Ports that act on all observations alike."""
    return tuple(Term(port) for port in ports)


def axes(*prefixes: str) -> tuple[Terms, ...]:
    """Vector ports: all three components together, the two across z, then each alone."""
    groups: tuple[Terms, ...] = ()
    for prefix in prefixes:
        names = [f"{prefix}_{axis}" for axis in "xyz"]
        groups += (plain(*names), plain(*names[:2]), *map(plain, names))
    return groups


def pair(a: str, b: str) -> tuple[Terms, ...]:
    """Two ports together, then each alone."""
    return (plain(a, b), plain(a), plain(b))


def alternatives(*terms: Term) -> tuple[Terms, ...]:
    """Patterned terms together, then each alone."""
    return (terms, *((term,) for term in terms))


EACH = ("mark", "epoch")
"""Observation-like drivers that count what has an amount of its own."""


def each(driver: str, *ports: str, numbers: Sequence[int] = (0,)) -> Terms:
    """Ports that every mark of a target, or every epoch, has for itself.

    The catalogue says what is meant with the first one; a recording has as many as it has
    (`signature`).
    """
    own = (Term(port, driver, "bump", (float(k), 0.25), 1.5) for port in ports for k in numbers)
    return tuple(own)


def signature(terms: Terms) -> Terms:
    """Terms as the catalogue writes them: of marks that have something each, the first one."""
    driver = terms[0].driver
    if driver not in EACH:
        return terms
    return each(driver, *dict.fromkeys(term.port for term in terms))
