"""Small scenes of the independent simulator, as recordings."""

from jaxvm.recording import read_recording
from jaxvm.simulate import simulate_deformation_scene

SEED = 2


def recorded(hide, folder, seed=SEED):
    made = simulate_deformation_scene(hide, seed=seed, size="small")
    return made.truth, read_recording(made.write(folder / "recording"))


def true_value(truth, name: str) -> float:
    return next(value for key, (value, _) in truth.parameters.items() if key.startswith(name))
