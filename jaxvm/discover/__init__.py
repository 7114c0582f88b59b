"""From mismatch to physics: score every hypothesis, name it, model it, prove it on held-out data."""
