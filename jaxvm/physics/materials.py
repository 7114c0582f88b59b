"""Thermal expansion of materials: what a measured growth may be made of."""

MATERIALS: dict[str, tuple[float, float]] = {
    "aluminium": (22.0, 24.5),
    "brass": (18.0, 21.0),
    "copper": (16.4, 17.1),
    "stainless steel": (15.8, 17.5),
    "steel": (11.0, 13.0),
    "titanium": (8.4, 8.9),
    "glass": (8.0, 9.2),
    "borosilicate glass": (3.2, 4.0),
    "fused silica": (0.4, 0.6),
    "granite": (5.0, 8.0),
    "concrete": (9.0, 13.0),
    "Invar": (0.6, 2.0),
    "CFRP": (-1.0, 2.0),
    "PVC": (50.0, 80.0),
    "PMMA": (65.0, 80.0),
    "polycarbonate": (63.0, 70.0),
    "FR4": (14.0, 17.0),
    "plywood along the grain": (3.0, 7.0),
}
"""Linear expansion (ppm/K) about 20 degC: smallest and largest of the usual grades."""


def materials_for(value_ppm: float, std_ppm: float) -> list[str]:
    """Materials whose expansion agrees with a measured one (ppm/K) within two standard deviations.

    Nearest first: by the distance from the range of the material, then from its middle.
    """

    def distance(name: str) -> tuple[float, float]:
        low, high = MATERIALS[name]
        outside = max(low - value_ppm, value_ppm - high, 0.0)
        return outside, abs(value_ppm - 0.5 * (low + high))

    return sorted((m for m in MATERIALS if distance(m)[0] <= 2.0 * std_ppm), key=distance)


def length_of(growth: float, material: str) -> float:
    """Length (m) of a material that grows by `growth` (m/K)."""
    low, high = MATERIALS[material]
    return abs(growth) / (0.5e-6 * (low + high))
