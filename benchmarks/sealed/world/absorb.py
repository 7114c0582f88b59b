"""How much of a change would survive an adjustment that lets the engineer's unknowns move.

The change is projected off the derivatives (by differences through the world itself) of poses of
each epoch, static poses, and lenses that are free. The lens's derivatives are powers of the ray's
angle, which stand for any of the engineer's distortion models.
"""

import numpy as np

from . import acts, chain, courses

TURN, SHIFT = 1e-5, 1e-5


class Absorber:
    """Projection for one scene and its rows; whitened by the nominal noise."""

    def __init__(self, scene, rows, shots, plain):
        self.scene, self.rows, self.shots, self.plain = scene, rows, shots, plain
        self.bare = chain.distances(scene, shots)
        moving = [k for k, target in enumerate(scene.targets) if target.moving]
        self.place = moving[0]
        loose = np.stack([self._column(h) for h in self._pose(acts.turn_target, acts.shift_target,
                          self.place)], axis=1)  # fmt: skip
        shared = [self._column(hooks) for hooks in self._shared()]
        self.shared = np.stack(shared, axis=1) if shared else np.zeros((len(loose), 0))
        pixel_epoch = np.where(rows.target == self.place, rows.epoch, -1)
        epoch = np.concatenate([np.repeat(pixel_epoch, 2), shots.epoch])
        order = np.argsort(epoch, kind="stable")
        starts = np.searchsorted(epoch[order], np.arange(len(scene.t) + 1))
        self.parts = []
        for a, b in zip(starts[:-1], starts[1:], strict=True):
            if b > a:
                mine = order[a:b]
                self.parts.append((mine, np.linalg.svd(_unit(loose[mine]), full_matrices=False)[0]))
        held = self._off_epochs(self.shared)
        self.held = np.zeros((len(loose), 0))
        if held.shape[1]:
            basis, size, _ = np.linalg.svd(_unit(held), full_matrices=False)
            self.held = basis[:, size > 1e-7 * size[0]]

    def visible(self, change):
        """Sum of squares (in sigmas) of a change that no unknown can take up."""
        left = self._off_epochs(self._white(change["pixels"], change["ranges"])[:, None])[:, 0]
        left = left - self.held @ (self.held.T @ left)
        return float(left @ left)

    def strength(self, change):
        """Sum of squares (in sigmas) of the whole change."""
        return float(np.sum(self._white(change["pixels"], change["ranges"]) ** 2))

    def _white(self, pixels, ranges):
        parts = [pixels.ravel() / self.scene.sigma_px, ranges / self.scene.sigma_m]
        return np.concatenate(parts)

    def change(self, hooks):
        """What hooks change in the rows and shots of this scene."""
        moved = chain.pixels(self.scene, self.rows, (hooks,), self.plain) - self.plain.pixel
        reach = chain.distances(self.scene, self.shots, (hooks,)) - self.bare
        return {"pixels": moved, "ranges": reach}

    def _column(self, hooks):
        return self._white(*self.change(hooks).values())

    def _off_epochs(self, columns):
        out = columns.copy()
        for mine, basis in self.parts:
            out[mine] -= basis @ (basis.T @ columns[mine])
        return out

    def _pose(self, turn, shift, place):
        always = courses.constant()
        for act, size in ((turn, TURN), (shift, SHIFT)):
            for axis in np.eye(3):
                yield act(place, axis, always)(size)

    def _shared(self):
        scene, always = self.scene, courses.constant()
        for k, target in enumerate(scene.targets):
            if target.free and not target.moving:
                yield from self._pose(acts.turn_target, acts.shift_target, k)
        for k, station in enumerate(scene.stations):
            if station.free:
                yield from self._pose(acts.turn_station, _shift_station, k)
        for k, camera in enumerate(scene.cameras):
            free = camera.known.get("free", [])
            if "focal" in free:
                for axis in np.eye(2):
                    yield acts.on_image([k], lambda v, xy, a=axis: xy * a, always)(1e-5)
                    yield acts.principal_point([k], axis, always)(0.01)
            if "distortion" in free:
                count = 4 if scene.kind == "wide" else 3
                for power in range(1, count + 1):
                    yield acts.radial([k], always, 2 * power)(1e-4)
                if camera.known["lens"] != "fisheye":
                    for way in np.eye(2):
                        yield acts.decentring([k], way, always)(1e-4)


def _shift_station(place, axis, course):
    return acts._pose("station", lambda v: v.station() == place, 1, axis, course)


def _unit(columns):
    """Columns of unit length (those of length zero stay)."""
    size = np.linalg.norm(columns, axis=0)
    return columns / np.where(size > 0.0, size, 1.0)
