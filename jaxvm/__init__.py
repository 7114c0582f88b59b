"""jaxvm (JAX videometrics): measure with networks of cameras, and find the physics a model left out.

Double precision is switched on when the package is imported: photogrammetric normal equations
need it.
"""

import jax

jax.config.update("jax_enable_x64", True)

__version__ = "0.1.0"
