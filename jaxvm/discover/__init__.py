"""From mismatch to physics: score every hypothesis, name it, model it, prove it on held-out."""

from jaxvm.discover.diagnose import diagnose
from jaxvm.discover.diagnosis import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
