"""The folder of a recording: recording.toml and the tables, as an engineer would have written."""

from pathlib import Path

import numpy as np

from .rotation import vector


def write(folder, scene, tables):
    """Write recording.toml and the tables (name -> (header, columns)) into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recording.toml").write_text(description(scene), encoding="utf-8")
    for name, (header, columns) in tables.items():
        lines = [",".join(header)]
        lines += [",".join(row) for row in zip(*columns, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def description(scene):
    """recording.toml: what the engineer knows and leaves free."""
    up = ", ".join(f"{x:.1f}" for x in scene.up)
    lines = ["format = 1", "", "[noise]", f"pixel_px = {scene.sigma_px:.6g}"]
    lines += [f"range_m = {scene.sigma_m:.6g}", "", "[world]", f"up = [{up}]"]
    for station in scene.stations:
        lines += ["", f"[stations.{station.name}]", 'motion = "static"']
        lines += ['free = ["pose"]'] if station.free else [_pose(station), "free = []"]
    for camera in scene.cameras:
        lines += ["", f"[cameras.{camera.name}]"] + _camera(scene, camera)
    for target in scene.targets:
        lines += ["", f"[targets.{target.name}]"] + _target(target)
    for finder in scene.finders:
        lines += ["", f"[rangefinders.{finder.name}]"]
        lines += [f'station = "{scene.stations[finder.station].name}"', _pose(finder), "free = []"]
    for name, what, value, sigma in scene.priors:
        lines += ["", "[[priors]]", f'parameter = "cameras.{name}.{what}"']
        lines += [f"value = {_list(value)}", f"sigma = {_list(sigma)}"]
    return "\n".join(lines) + "\n"


def _camera(scene, camera):
    known = camera.known
    size = ", ".join(str(int(n)) for n in camera.size)
    lines = [f'station = "{scene.stations[camera.station].name}"', f"image_size = [{size}]"]
    lines += [f'lens = "{known["lens"]}"']
    held = "held" in known
    lines += [f"focal_px = {_list(known.get('focal_px', camera.focal))}"]
    lines += [f"centre_px = {_list(known.get('centre_px', camera.centre))}"]
    if held and known["lens"] != "pinhole":
        lines += [f"distortion = {_list(camera.brown)}"]
    free = ", ".join(f'"{name}"' for name in known.get("free", []))
    pose = known.get("pose", (camera.turn, camera.shift))
    lines += [_pose_of(*pose), f"free = [{free}]"]
    if scene.tells_power:
        again = [] if scene.restart_s is None else [f"{scene.restart_s:.1f}"]
        lines += [f"powered_on_s = [{', '.join([f'{camera.on_s:.1f}', *again])}]"]
    return lines


def _target(target):
    lines = [f'motion = "{"per-epoch" if target.moving else "static"}"']
    if target.grid:
        rows, columns, spacing = target.grid
        lines += [f"grid = {{rows = {rows}, columns = {columns}, spacing_m = {spacing}}}"]
    else:
        marks = zip(target.names, target.points, strict=True)
        inside = ", ".join(f"{name} = {_list(point)}" for name, point in marks)
        lines += [f"points = {{{inside}}}"]
    if target.free:
        return [*lines, 'free = ["pose"]']
    return [*lines, "free = []", _pose_of(target.turn[0], target.shift[0])]


def _pose(body):
    return _pose_of(body.turn, body.shift)


def _pose_of(turn, shift):
    return f"pose = {{turn_rad = {_list(vector(turn))}, shift_m = {_list(shift)}}}"


def _list(values):
    return "[" + ", ".join(f"{float(x):.12g}" if x % 1 else f"{x:.1f}" for x in values) + "]"


def observations(scene, rows, pixel, sigma):
    """Table of the observed marks."""
    cameras = [c.name for c in scene.cameras]
    names = [t.names for t in scene.targets]
    header = ["epoch", "camera", "target", "point", "u", "v"]
    columns = [
        [str(e) for e in rows.epoch],
        [cameras[c] for c in rows.camera],
        [scene.targets[g].name for g in rows.target],
        [names[g][p] for g, p in zip(rows.target, rows.point, strict=True)],
        [f"{x:.5f}" for x in pixel[:, 0]],
        [f"{x:.5f}" for x in pixel[:, 1]],
    ]
    if sigma is not None:
        header.append("sigma")
        columns.append([f"{x:.5f}" for x in sigma])
    return header, columns


def epochs(scene, rng):
    """Table of the epochs; with velocities where the target is fast."""
    header, columns = ["epoch", "t"], [[str(k) for k in range(len(scene.t))]]
    columns.append([f"{x:.6f}" for x in scene.t])
    if scene.path is not None:
        rates = scene.path.velocity(scene.t)
        rates = rates * (1.0 + 0.003 * rng.normal(size=rates.shape))
        name = scene.targets[0].name
        header += [f"{name}.{rate}" for rate in ("vx", "vy", "vz", "wx", "wy", "wz")]
        columns += [[f"{x:.6f}" for x in column] for column in rates.T]
    return header, columns


def drivers(scene, rng):
    """Table of the logged channels: sensors read at intervals, with noise and steps."""
    weather = scene.weather
    logs = weather.logs
    end = scene.t[-1]
    interval = min(logs["interval_s"], max(10.0, end / 60.0))
    if scene.path is not None:
        interval = min(interval, float(np.median(np.diff(scene.t))))
    t = np.arange(-2.0 * interval, end + 1.5 * interval, interval)
    header, columns = ["t"], [[f"{x:.3f}" for x in t]]

    def add(name, values, noise, step):
        reading = np.round((values + noise * rng.normal(size=len(t))) / step) * step
        header.append(name)
        columns.append([f"{x:.4f}" for x in reading])

    noise, step = logs["noise_K"], logs["step_K"]
    for name in weather.logged:
        if name == "body":
            for k, camera in enumerate(scene.cameras):
                values = np.interp(t, weather.time, weather.nodes[k, 1])
                add(f"body_{camera.name}_degC", values, noise, step)
        elif name == "ambient_degC":
            add(name, np.interp(t, weather.time, weather.air[name]), noise, step)
        else:
            small = {"gradient_K_per_m": 0.01, "irradiance_W_m2": 1.0}.get(name, 0.05)
            add(name, np.interp(t, weather.time, weather.air[name]), small, 0.1 * small)
    if np.ptp(scene.exposure) > 0.0:
        add("exposure_ms", 1e3 * np.interp(t, scene.t, scene.exposure), 0.0, 0.001)
    return header, columns


def ranges(scene, shots, distance):
    """Table of the distances."""
    target = [scene.targets[scene.finders[f].target] for f in shots.finder]
    points = [g.names[p] if p >= 0 else "" for g, p in zip(target, shots.point, strict=True)]
    header = ["epoch", "rangefinder", "target", "point", "range_m"]
    columns = [
        [str(e) for e in shots.epoch],
        [scene.finders[f].name for f in shots.finder],
        [g.name for g in target],
        points,
        [f"{x:.6f}" for x in distance],
    ]
    return header, columns
