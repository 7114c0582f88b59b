"""Image formation of a round mark: blur, pixels, noise floor, steps, threshold, centroid."""

from functools import lru_cache

import numpy as np
from scipy.special import erf

PHASES = 32


@lru_cache(maxsize=64)
def locking(radius, blur, threshold, bits, fill=1.0):
    """Bias (px) of the centroid over the sub-pixel phase in one axis, by rendering.

    A disc of a radius (px), blurred by a Gaussian (px), is sampled by pixels that integrate over
    a share `fill` of their width, quantised to so many bits, cut at a share of its peak, and its
    centre of gravity taken. The other axis is averaged over its phases.
    """
    reach = int(np.ceil(radius + 4.0 * blur)) + 2
    at = np.arange(-reach, reach + 1)
    fine = np.arange(-radius + radius / 24, radius, radius / 12)
    half = np.sqrt(radius**2 - fine**2)
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    bias = np.zeros(PHASES)
    for k, phase in enumerate(phases):
        off = []
        for other in (-0.35, -0.1, 0.15, 0.4):
            image = np.zeros((len(at), len(at)))
            for y, h in zip(fine, half, strict=True):  # the disc as thin strips along x
                strip = _strip(at - phase, h, blur, fill)
                line = _line(at - other - y, blur, fill)
                image += np.outer(line, strip)
            image = image / image.max() * 0.85 + 0.05
            image = np.round(image * 2**bits) / 2**bits
            weight = np.clip(image - threshold * image.max(), 0.0, None)
            off.append(np.sum(weight * at[None, :]) / np.sum(weight) - phase)
        bias[k] = np.mean(off)
    return phases, bias


def _strip(x, half, blur, fill):
    """Light in pixels at x of a strip from -half to half."""
    return _ramp(x + half, blur, fill) - _ramp(x - half, blur, fill)


def _ramp(x, blur, fill):
    """Light in pixels of a blurred edge at 0 (integral of the error function over the pixel)."""
    a, b = (x - 0.5 * fill) / blur, (x + 0.5 * fill) / blur
    return blur * (_erf_integral(b) - _erf_integral(a)) / fill


def _erf_integral(z):
    return 0.5 * (z * (1.0 + erf(z / np.sqrt(2.0)))) + np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)


def _line(x, blur, fill):
    return erf((x + 0.5 * fill) / blur / np.sqrt(2.0)) - erf((x - 0.5 * fill) / blur / np.sqrt(2.0))


def at_phase(curve, coordinate):
    """Bias (px) of coordinates (px) by a periodic curve over the sub-pixel phase."""
    phases, bias = curve
    phase = coordinate - np.round(coordinate)
    return np.interp(phase, phases, bias, period=1.0)


def two_pixel(amplitude, coordinate, phase):
    """Bias with a period of two pixels, as colour filters leave it."""
    return amplitude * np.sin(np.pi * coordinate + phase)
