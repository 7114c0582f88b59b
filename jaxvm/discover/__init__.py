"""From mismatch to physics: score every hypothesis, name it, model it, prove it on held-out."""

from jaxvm.discover.diagnose import Diagnosis, Finding, diagnose

__all__ = ["Diagnosis", "Finding", "diagnose"]
