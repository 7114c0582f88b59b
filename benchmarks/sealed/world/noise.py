"""Measurement noise of five kinds, and rows that are missing."""

import numpy as np

TYPES = ("white", "declared", "undeclared", "correlated", "outliers")


def make_noise(rng, scene, rows):
    """Noise (px) [n, 2], sigma to declare per row (or None) and a description for the key."""
    n = len(rows)
    kind = "white" if rng.random() < 0.5 else str(rng.choice(TYPES[1:]))
    sigma = np.full(n, scene.sigma_px)
    declared = None
    told = {"type": kind, "sigma_px": scene.sigma_px}
    if kind == "declared":
        factor = np.exp(rng.uniform(-0.4, 0.4, len(scene.cameras)))[rows.camera]
        marks = max(len(t.points) for t in scene.targets)
        factor = factor * np.exp(rng.uniform(-0.3, 0.3, marks))[rows.point]
        declared = sigma = np.round(sigma * factor, 5)
    if kind == "undeclared":
        if len(scene.cameras) > 1:
            factor = rng.uniform(1.0, 1.5, len(scene.cameras))
            factor[rng.integers(len(factor))] = 1.0
            sigma = sigma * factor[rows.camera]
        else:
            factor = rng.uniform(1.0, 1.5, len(scene.t))
            sigma = sigma * factor[rows.epoch]
        told["factor"] = float(factor.max())
    noise = sigma[:, None] * rng.normal(size=(n, 2))
    if kind == "correlated":
        share = rng.uniform(0.1, 0.5)
        memory = rng.uniform(1.0, 5.0)
        image = share * rng.uniform(0.0, 0.08)
        noise *= np.sqrt(1.0 - share - image)
        noise += scene.sigma_px * np.sqrt(share) * _each_mark(rng, scene, rows, memory)
        noise += scene.sigma_px * np.sqrt(image) * _each_image(rng, scene, rows, memory)
        told |= {"share": share, "image_share": image, "memory_epochs": memory}
    if kind == "outliers":
        share = rng.uniform(0.0005, 0.005)
        wrong = rng.random(n) < share
        way = rng.uniform(0.0, 2.0 * np.pi, wrong.sum())
        far = rng.uniform(5.0, 50.0, wrong.sum())
        noise[wrong] += far[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
        told |= {"outliers": int(wrong.sum())}
    return noise, declared, told


def _chain(rng, count, width, memory):
    """Unit first-order autoregression [count, width]."""
    a = np.exp(-1.0 / memory)
    out = rng.normal(size=(count, width))
    for k in range(1, count):
        out[k] = a * out[k - 1] + np.sqrt(1.0 - a * a) * out[k]
    return out


def _each_mark(rng, scene, rows, memory):
    marks = max(len(t.points) for t in scene.targets)
    place = (rows.camera * len(scene.targets) + rows.target) * marks + rows.point
    width = len(scene.cameras) * len(scene.targets) * marks
    course = _chain(rng, len(scene.t), 2 * width, memory).reshape(len(scene.t), width, 2)
    return course[rows.epoch, place]


def _each_image(rng, scene, rows, memory):
    course = _chain(rng, len(scene.t), 2 * len(scene.cameras), memory)
    return course.reshape(len(scene.t), -1, 2)[rows.epoch, rows.camera]


def keep(rng, scene, rows):
    """Mask of the rows that are not missing: single marks and whole views, in some recordings."""
    kept = np.ones(len(rows), bool)
    if rng.random() < 0.5:
        kept &= rng.random(len(rows)) >= rng.uniform(0.005, 0.04)
    if rng.random() < 0.4:
        views = (len(scene.t), len(scene.cameras), len(scene.targets))
        gone = rng.random(views) < rng.uniform(0.005, 0.03)
        kept &= ~gone[rows.epoch, rows.camera, rows.target]
    place = np.ravel_multi_index(
        (rows.epoch, rows.camera, rows.target),
        (len(scene.t), len(scene.cameras), len(scene.targets)),
    )
    return kept & (np.bincount(place[kept], minlength=place.max() + 1)[place] >= 6)
