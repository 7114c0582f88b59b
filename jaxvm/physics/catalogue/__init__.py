"""The catalogue: known physics by the name that an engineer uses.

An entry says where an effect enters (terms: ports and patterns), what may drive it, in which forms,
what kind of entity has it, how large it plausibly is, what it is mistaken for and what separates
it. Adding named physics is adding an entry; nothing else knows the names. The files follow the
chain. Several entries may stand for the same combination: their sizes decide which comes first.
"""

from jaxvm.physics.catalogue.detection import DETECTION
from jaxvm.physics.catalogue.entry import Entry
from jaxvm.physics.catalogue.lens import LENS
from jaxvm.physics.catalogue.medium import MEDIUM
from jaxvm.physics.catalogue.mount import MOUNT
from jaxvm.physics.catalogue.range import RANGE
from jaxvm.physics.catalogue.sensor import SENSOR
from jaxvm.physics.catalogue.target import TARGET
from jaxvm.physics.effects import Term

__all__ = ["BY_ID", "CATALOGUE", "Entry", "entries_for"]

CATALOGUE: tuple[Entry, ...] = (*TARGET, *MEDIUM, *MOUNT, *LENS, *SENSOR, *DETECTION, *RANGE)
"""All named physics, in the order of the chain."""

BY_ID: dict[str, Entry] = {entry.id: entry for entry in CATALOGUE}


def entries_for(
    terms: tuple[Term, ...], driver_kind: str, form: str, channel_kind: str = "quantity"
) -> tuple[Entry, ...]:
    """The entries that a combination of terms, kind of driver and form belongs to.

    `channel_kind` is the kind of a recorded channel, where `driver_kind` is "quantity": where
    entries name it, those that any recorded quantity may drive are not meant. Several entries are
    doubles that no recording of these cameras tells apart.
    """
    special = channel_kind if driver_kind == "quantity" else driver_kind
    known = [
        entry
        for entry in CATALOGUE
        if terms in entry.groups
        and form in entry.forms
        and (special in entry.drivers or driver_kind in entry.drivers)
    ]
    return tuple([entry for entry in known if special in entry.drivers] or known)
