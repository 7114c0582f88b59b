"""The independent world: recordings with known hidden physics, simulated without the models."""

from jaxvm.simulate.effects import HIDEABLE
from jaxvm.simulate.hidden import HiddenEffect, Truth
from jaxvm.simulate.world import simulate_deformation_scene
from jaxvm.simulate.write import SimulatedRecording

__all__ = [
    "HIDEABLE",
    "HiddenEffect",
    "SimulatedRecording",
    "Truth",
    "simulate_deformation_scene",
]
