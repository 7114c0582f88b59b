"""The catalogue: known physics by the name that an engineer uses.

An entry says where an effect enters (terms: ports and patterns), what may drive it, in which forms,
what kind of entity has it, how large it plausibly is, what it is mistaken for and what separates
it. Adding named physics is adding an entry; nothing else knows the names. The files follow the
chain. Several entries may stand for the same combination: their sizes decide which comes first.
"""

from jaxvm.physics.catalogue.detection import DETECTION
from jaxvm.physics.catalogue.entry import Entry, signature
from jaxvm.physics.catalogue.lens import LENS
from jaxvm.physics.catalogue.medium import MEDIUM
from jaxvm.physics.catalogue.mount import MOUNT
from jaxvm.physics.catalogue.range import RANGE
from jaxvm.physics.catalogue.sensor import SENSOR
from jaxvm.physics.catalogue.target import TARGET
from jaxvm.physics.effects import Term

__all__ = ["BY_ID", "CATALOGUE", "Entry", "entries_for", "entries_of"]

CATALOGUE: tuple[Entry, ...] = (*TARGET, *MEDIUM, *MOUNT, *LENS, *SENSOR, *DETECTION, *RANGE)
"""All named physics, in the order of the chain."""

BY_ID: dict[str, Entry] = {entry.id: entry for entry in CATALOGUE}

_BY_TERMS: dict[tuple[tuple[Term, ...], str], list[Entry]] = {}
for _entry in CATALOGUE:
    for _terms in dict.fromkeys(_entry.groups):
        _BY_TERMS.setdefault((_terms, _entry.entity), []).append(_entry)


def entries_of(terms: tuple[Term, ...], entity: str) -> tuple[Entry, ...]:
    """The entries that a combination of terms of one kind of entity belongs to."""
    return tuple(_BY_TERMS.get((signature(terms), entity), ()))


def entries_for(
    terms: tuple[Term, ...], entity: str, driver_kinds: tuple[str, ...], form: str
) -> tuple[Entry, ...]:
    """The entries that a combination of terms, kind of driver and form belongs to.

    `driver_kinds` are the kinds of the driver, general ones first: ("quantity", "temperature",
    "neighbour"). Where entries name a special kind, those that any recorded quantity may drive are
    not meant. Several entries are doubles that no recording of these cameras tells apart.
    """
    known = [entry for entry in entries_of(terms, entity) if entry.takes(driver_kinds, form)]
    special = [kind for kind in driver_kinds if kind != "quantity"] or driver_kinds
    return tuple([e for e in known if any(kind in e.drivers for kind in special)] or known)
