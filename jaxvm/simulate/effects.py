"""The effects that the deformation scene can hide."""

from jaxvm.simulate.hidden import HiddenEffect
from jaxvm.simulate.hidden_cameras import CAMERA_EFFECTS
from jaxvm.simulate.hidden_mounts import MOUNT_EFFECTS
from jaxvm.simulate.hidden_plates import PLATE_EFFECTS
from jaxvm.simulate.hidden_surroundings import SURROUNDING_EFFECTS

HIDEABLE: dict[str, HiddenEffect] = {
    effect.key: effect
    for effect in (*PLATE_EFFECTS, *MOUNT_EFFECTS, *CAMERA_EFFECTS, *SURROUNDING_EFFECTS)
}
"""The effects that `simulate_deformation_scene` can hide, by key."""
