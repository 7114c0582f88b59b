"use strict";
// Viewer of a network: a canvas, flat arrays, and nothing allocated from frame to frame.
(() => {
  const d = JSON.parse(document.getElementById("network").textContent);
  const canvas = document.getElementById("view"), tip = document.getElementById("tip");
  const by = (id) => document.getElementById(id);
  const ctx = canvas.getContext("2d");
  const n = d.names.length, m = d.a.length, FAR = 3.2;
  const position = Float64Array.from(d.position), ellipsoid = Float64Array.from(d.ellipsoid);
  const a = Int32Array.from(d.a), b = Int32Array.from(d.b);
  const sx = new Float64Array(n), sy = new Float64Array(n), sz = new Float64Array(n), near = new Float64Array(n);
  const traces = d.traces.of.map((t) => Float64Array.from(t.points));
  const BRIDGE = 1, SIGHT = 2, REJECTED = 4;

  // Classes of edges: 0 weak, 1 to 4 by redundancy, 5 rejected. Drawn class by class.
  const CLASSES = ["weak", "r1", "r2", "r3", "r4", "gone"];
  const kindOf = Uint8Array.from(d.redundancy, (r, k) =>
    d.flags[k] & REJECTED ? 5 : d.flags[k] & BRIDGE || r < 0.1 ? 0 : r < 0.3 ? 1 : r < 0.5 ? 2 : r < 0.7 ? 3 : 4);
  const order = Array.from({ length: m }, (_, k) => k).sort((i, j) => rank(kindOf[i]) - rank(kindOf[j]));
  function rank(c) { return c === 0 ? 6 : c === 5 ? 7 : 5 - c; }
  const edgeOrder = Int32Array.from(order);
  for (const item of document.querySelectorAll("#legend [data-class]"))
    if (!kindOf.includes(+item.dataset.class)) item.hidden = true, item.style.display = "none";

  // Labels: held bodies, ends of weak edges, the worst known, then the others evenly.
  const weight = new Float64Array(n);
  for (let k = 0; k < m; k++) if (kindOf[k] === 0 || kindOf[k] === 5) { weight[a[k]] += 1; weight[b[k]] += 1; }
  const worst = Math.max(1e-300, ...d.sigma_m);
  const labelled = Int32Array.from(Array.from({ length: n }, (_, i) => i).sort((i, j) => importance(j) - importance(i)));
  function importance(i) {
    return (d.held[i] ? 100 : 0) + Math.min(weight[i], 3) + 2 * d.sigma_m[i] / worst + ((i * 0.61803398875) % 1);
  }
  const width = new Float64Array(n), CELL = 8;
  const largest = new Float64Array(n);
  for (let i = 0; i < n; i++) for (let k = 0; k < 3; k++)
    largest[i] = Math.max(largest[i], Math.hypot(ellipsoid[9 * i + 3 * k], ellipsoid[9 * i + 3 * k + 1], ellipsoid[9 * i + 3 * k + 2]));
  // Of many ellipsoids the largest and an even choice.
  const MOST = 350;
  const withEllipsoid = Int32Array.from((n <= MOST ? Array.from({ length: n }, (_, i) => i)
    : Array.from({ length: n }, (_, i) => i).sort((i, j) => largest[j] - largest[i]).filter((_, k) => k < 40 || k % Math.ceil(n / (MOST - 40)) === 0))
    .filter((i) => largest[i] > 0));

  let colour = {}, taken = new Uint8Array(1), columns = 1, rowsOfCells = 1, W = 1, H = 1;
  const R = new Float64Array(9), turn = { c: 1, s: 0 };
  let zoom = 1, panX = 0, panY = 0, fit = 1, factor = d.scale, hoverNode = -1, hoverEdge = -1, cycle = -1, pinned = -1;
  let queued = false, moving = false, settle = 0;

  function theme() {
    const style = getComputedStyle(document.documentElement);
    colour = {};
    for (const name of [...CLASSES, "node", "ell", "label", "mark", "soft", "ink", "panel", "c4"])
      colour[name] = style.getPropertyValue("--" + name).trim();
    draw();
  }
  function resize() {
    const ratio = window.devicePixelRatio || 1;
    W = canvas.clientWidth; H = canvas.clientHeight;
    canvas.width = Math.round(W * ratio); canvas.height = Math.round(H * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    columns = Math.ceil(W / CELL) + 1; rowsOfCells = Math.ceil(H / CELL) + 1;
    taken = new Uint8Array(columns * rowsOfCells);
    ctx.font = "12px system-ui,sans-serif";
    for (let i = 0; i < n; i++) width[i] = ctx.measureText(d.names[i]).width;
    fitted(); draw();
  }
  function reset() {
    for (let k = 0; k < 9; k++) R[k] = d.axes[Math.floor(k / 3)][k % 3];
    zoom = 1; panX = 0; panY = 0;
    fitted(); draw();
  }
  // Scale and shift at which the first view fills the canvas.
  function fitted() {
    if (!n) return;
    const keep = [zoom, panX, panY];
    zoom = 1; panX = panY = 0; fit = 1;
    let spanX = 1e-12, spanY = 1e-12;
    fit = 0.42 * Math.min(W, H) / d.size * 2;
    for (let pass = 0; pass < 2; pass++) {
      project();
      let x0 = Infinity, x1 = -Infinity, y0 = Infinity, y1 = -Infinity;
      for (let i = 0; i < n; i++) {
        x0 = Math.min(x0, sx[i]); x1 = Math.max(x1, sx[i]); y0 = Math.min(y0, sy[i]); y1 = Math.max(y1, sy[i]);
      }
      spanX = Math.max(x1 - x0, 1e-9); spanY = Math.max(y1 - y0, 1e-9);
      if (pass === 0) fit *= n > 1 ? Math.min((W - Math.min(150, 0.3 * W)) / spanX, (H - 110) / spanY) : 1;
      else { home.x = W / 2 - (x0 + x1) / 2; home.y = H / 2 - (y0 + y1) / 2 - 8; }
      if (pass === 0) home.x = home.y = 0;
    }
    [zoom, panX, panY] = keep;
  }
  const home = { x: 0, y: 0 };

  function project() {
    const f = fit * zoom, depth = FAR * d.size, cx = W / 2 + panX + home.x * zoom, cy = H / 2 + panY + home.y * zoom;
    for (let i = 0; i < n; i++) {
      const x = position[3 * i], y = position[3 * i + 1], z = position[3 * i + 2];
      const out = R[6] * x + R[7] * y + R[8] * z, s = f * depth / (depth - out);
      sx[i] = cx + s * (R[0] * x + R[1] * y + R[2] * z);
      sy[i] = cy - s * (R[3] * x + R[4] * y + R[5] * z);
      sz[i] = out; near[i] = s;
    }
  }

  function draw() { if (!queued) { queued = true; requestAnimationFrame(frame); } }
  function frame() {
    queued = false;
    project();
    ctx.clearRect(0, 0, W, H);
    if (by("edges").checked) edges();
    mounts();
    courses();
    if (by("ellipsoids").checked) ellipsoids();
    highlight();
    nodes();
    if (by("labels").checked) labels();
    bar();
  }
  function stroke(c) { ctx.strokeStyle = colour[c]; ctx.stroke(); }
  function line(k) { ctx.moveTo(sx[a[k]], sy[a[k]]); ctx.lineTo(sx[b[k]], sy[b[k]]); }

  function edges() {
    const busy = m > 1500;
    ctx.lineJoin = "round";
    for (let start = 0; start < m;) {
      const c = kindOf[edgeOrder[start]];
      ctx.beginPath();
      let k = start;
      for (; k < m && kindOf[edgeOrder[k]] === c; k++) line(edgeOrder[k]);
      start = k;
      const dashed = c === 0;
      ctx.lineWidth = c === 5 ? 2.5 : dashed ? 2 : busy ? 0.8 : 1.4;
      ctx.globalAlpha = c === 5 || dashed ? 1 : cycle >= 0 ? 0.35 : busy ? 0.55 : 0.85;
      if (dashed) ctx.setLineDash(DASH);
      stroke(CLASSES[c]);
      if (dashed) ctx.setLineDash(SOLID);
    }
    ctx.globalAlpha = 1;
  }
  const DASH = [6, 4], DOTS = [2, 3], SOLID = [];
  function mounts() {
    if (!d.mounts.length) return;
    ctx.beginPath();
    for (let k = 0; k < d.mounts.length; k++) {
      const i = d.mounts[k][0], j = d.mounts[k][1];
      ctx.moveTo(sx[i], sy[i]); ctx.lineTo(sx[j], sy[j]);
    }
    ctx.lineWidth = 1; ctx.setLineDash(DOTS); stroke("soft"); ctx.setLineDash(SOLID);
  }
  function courses() {
    if (!traces.length) return;
    const f = fit * zoom, depth = FAR * d.size, cx = W / 2 + panX + home.x * zoom, cy = H / 2 + panY + home.y * zoom;
    ctx.beginPath();
    for (let t = 0; t < traces.length; t++) {
      const p = traces[t];
      for (let i = 0; i < p.length; i += 3) {
        const s = f * depth / (depth - R[6] * p[i] - R[7] * p[i + 1] - R[8] * p[i + 2]);
        const x = cx + s * (R[0] * p[i] + R[1] * p[i + 1] + R[2] * p[i + 2]);
        const y = cy - s * (R[3] * p[i] + R[4] * p[i + 1] + R[5] * p[i + 2]);
        if (i === 0) ctx.moveTo(x, y); else ctx.lineTo(x, y);
      }
    }
    ctx.lineWidth = 1.4; stroke("c4");
  }
  // A great ellipse has two conjugate radii u, v on the screen; its own axes follow from them.
  function greatEllipse(x, y, ux, uy, vx, vy) {
    const e = (ux + vy) / 2, f = (ux - vy) / 2, g = (uy + vx) / 2, h = (uy - vx) / 2;
    const q = Math.hypot(e, h), r = Math.hypot(f, g);
    const a1 = Math.atan2(g, f), a2 = Math.atan2(h, e), tilt = (a2 + a1) / 2;
    ctx.moveTo(x + (q + r) * Math.cos(tilt), y + (q + r) * Math.sin(tilt));
    ctx.ellipse(x, y, q + r, Math.abs(q - r), tilt, 0, 2 * Math.PI);
  }
  function ellipsoids() {
    ctx.beginPath();
    const most = moving && withEllipsoid.length > 150 ? 150 : withEllipsoid.length;
    for (let k = 0; k < most; k++) {
      const i = withEllipsoid[k], s = near[i] * factor, o = 9 * i;
      if (largest[i] * s < 1.5 || sx[i] < -200 || sx[i] > W + 200 || sy[i] < -200 || sy[i] > H + 200) continue;
      const e = ellipsoid;
      const x0 = s * (R[0] * e[o] + R[1] * e[o + 1] + R[2] * e[o + 2]), y0 = -s * (R[3] * e[o] + R[4] * e[o + 1] + R[5] * e[o + 2]);
      const x1 = s * (R[0] * e[o + 3] + R[1] * e[o + 4] + R[2] * e[o + 5]), y1 = -s * (R[3] * e[o + 3] + R[4] * e[o + 4] + R[5] * e[o + 5]);
      const x2 = s * (R[0] * e[o + 6] + R[1] * e[o + 7] + R[2] * e[o + 8]), y2 = -s * (R[3] * e[o + 6] + R[4] * e[o + 7] + R[5] * e[o + 8]);
      greatEllipse(sx[i], sy[i], x0, y0, x1, y1);
      greatEllipse(sx[i], sy[i], x1, y1, x2, y2);
      greatEllipse(sx[i], sy[i], x2, y2, x0, y0);
    }
    ctx.lineWidth = 0.9; ctx.globalAlpha = n > MOST ? 0.5 : 0.75; stroke("ell"); ctx.globalAlpha = 1;
  }
  function highlight() {
    const shown = cycle >= 0 ? cycle : pinned;
    if (shown >= 0) {
      ctx.beginPath();
      const own = d.cycles[shown];
      for (let k = 0; k < own.length; k++) line(own[k]);
      ctx.lineWidth = 4; ctx.lineCap = "round"; stroke("mark"); ctx.lineCap = "butt";
    }
    if (hoverEdge >= 0) { ctx.beginPath(); line(hoverEdge); ctx.lineWidth = 4; ctx.globalAlpha = 0.7; stroke("ink"); ctx.globalAlpha = 1; }
  }
  function mark(i, r) {
    const x = sx[i], y = sy[i], kind = d.kinds[i];
    if (d.held[i]) ctx.rect(x - r, y - r, 2 * r, 2 * r);
    else if (kind === "target") { ctx.moveTo(x, y - r); ctx.lineTo(x + r, y); ctx.lineTo(x, y + r); ctx.lineTo(x - r, y); ctx.closePath(); }
    else if (kind === "camera") { ctx.moveTo(x, y - r); ctx.lineTo(x + r, y + r); ctx.lineTo(x - r, y + r); ctx.closePath(); }
    else { ctx.moveTo(x + r, y); ctx.arc(x, y, r, 0, 2 * Math.PI); }
  }
  function nodes() {
    const r = n > 1000 ? 1.1 : n > 300 ? 2 : 3.5;
    ctx.beginPath();
    for (let i = 0; i < n; i++) if (!d.held[i]) mark(i, d.kinds[i] === "station" ? r : r * 1.35);
    ctx.fillStyle = colour.node; ctx.fill();
    ctx.beginPath();
    for (let i = 0; i < n; i++) if (d.held[i]) mark(i, Math.max(r * 1.4, 5));
    ctx.fillStyle = colour.mark; ctx.fill();
    ctx.lineWidth = 1.2; stroke("panel");
    if (hoverNode >= 0) { ctx.beginPath(); ctx.arc(sx[hoverNode], sy[hoverNode], 8, 0, 2 * Math.PI); ctx.lineWidth = 2; stroke("mark"); }
  }
  function labels() {
    taken.fill(0);
    const most = n <= 60 ? n : moving ? 20 : 34;
    ctx.font = "12px system-ui,sans-serif"; ctx.textBaseline = "middle"; ctx.lineJoin = "round";
    ctx.lineWidth = 3; ctx.strokeStyle = colour.panel; ctx.fillStyle = colour.label;
    let drawn = 0;
    for (let k = 0; k < n && drawn < most; k++) {
      const i = labelled[k], y = sy[i] - 9;
      let x = sx[i] + 7;
      if (sx[i] < 0 || sx[i] > W || y < 8 || y > H - 34) continue;
      if (x + width[i] > W - 2) x = sx[i] - 7 - width[i];
      if (x < 0) continue;
      const c0 = Math.max(0, Math.floor(x / CELL)), c1 = Math.min(columns - 1, Math.floor((x + width[i] + 4) / CELL));
      const r0 = Math.max(0, Math.floor((y - 8) / CELL)), r1 = Math.min(rowsOfCells - 1, Math.floor((y + 8) / CELL));
      let free = true;
      for (let r = r0; free && r <= r1; r++) for (let c = c0; c <= c1; c++) if (taken[r * columns + c]) { free = false; break; }
      if (!free) continue;
      for (let r = r0; r <= r1; r++) for (let c = c0; c <= c1; c++) taken[r * columns + c] = 1;
      ctx.strokeText(d.names[i], x, y); ctx.fillText(d.names[i], x, y);
      drawn++;
    }
  }
  // A bar of a round length at the network's middle, and what it is for the ellipsoids.
  let barText = "", barStep = 0, barFactor = 0, barOn = false;
  function bar() {
    const f = fit * zoom;
    if (!(f > 0) || !n) return;
    const wanted = 90 / f, power = Math.pow(10, Math.floor(Math.log10(wanted)));
    const step = wanted >= 5 * power ? 5 * power : wanted >= 2 * power ? 2 * power : power, pixels = step * f;
    const on = by("ellipsoids").checked && withEllipsoid.length > 0;
    if (step !== barStep || factor !== barFactor || on !== barOn) {
      barStep = step; barFactor = factor; barOn = on;
      barText = size(step) + (on ? ", ellipsoids " + size(step / factor) : "");
    }
    ctx.beginPath(); ctx.moveTo(14, H - 20); ctx.lineTo(14, H - 14); ctx.lineTo(14 + pixels, H - 14); ctx.lineTo(14 + pixels, H - 20);
    ctx.lineWidth = 1.5; stroke("soft");
    ctx.font = "12px system-ui,sans-serif"; ctx.textBaseline = "middle"; ctx.fillStyle = colour.soft;
    ctx.lineWidth = 3; ctx.strokeStyle = colour.panel;
    ctx.strokeText(barText, 22 + pixels, H - 16); ctx.fillText(barText, 22 + pixels, H - 16);
  }

  function scaled(value, units) {
    for (const [unit, name] of units) if (Math.abs(value) >= 0.9995 * unit || unit === units[units.length - 1][0])
      return (value === 0 ? "0" : digits(value / unit)) + " " + name;
  }
  function digits(v) { const s = Math.abs(v) >= 1000 ? Math.round(v).toLocaleString("en") : String(+v.toPrecision(3)); return s; }
  const size = (v) => scaled(v, [[1, "m"], [1e-3, "mm"], [1e-6, "µm"], [1e-9, "nm"]]);
  const angle = (v) => scaled(v, [[1, "rad"], [1e-3, "mrad"], [1e-6, "µrad"], [1e-9, "nrad"]]);

  // What the pointer is at.
  function find(x, y) {
    hoverNode = hoverEdge = -1;
    let best = 121;
    for (let i = 0; i < n; i++) {
      const q = (sx[i] - x) ** 2 + (sy[i] - y) ** 2 - (d.held[i] ? 20 : 0);
      if (q < best) { best = q; hoverNode = i; }
    }
    if (hoverNode >= 0 || !by("edges").checked) return;
    best = 36;
    for (let k = 0; k < m; k++) {
      const x0 = sx[a[k]], y0 = sy[a[k]], ex = sx[b[k]] - x0, ey = sy[b[k]] - y0;
      const t = Math.max(0, Math.min(1, ((x - x0) * ex + (y - y0) * ey) / (ex * ex + ey * ey || 1)));
      const q = (x0 + t * ex - x) ** 2 + (y0 + t * ey - y) ** 2;
      if (q < best) { best = q; hoverEdge = k; }
    }
  }
  function say(x, y) {
    let title = "", lines = [];
    if (hoverNode >= 0) {
      const i = hoverNode;
      title = `${d.kinds[i]} ${d.names[i]}`;
      if (d.held[i]) lines.push("held");
      else lines.push(`σ position ${size(d.sigma_m[i])}, σ turn ${angle(d.sigma_rad[i])}` + (d.epoch[i] === null ? "" : ` (epoch ${d.epoch[i]})`));
      if (d.distance[i] !== null && !d.held[i]) lines.push(`${d.distance[i]} edge${d.distance[i] === 1 ? "" : "s"} to a held body`);
    } else if (hoverEdge >= 0) {
      const k = hoverEdge;
      title = d.edge_names[k] + (d.count[k] > 1 ? ` and ${d.count[k] - 1} more` : "");
      lines.push(`${d.names[a[k]]} – ${d.names[b[k]]}`);
      if (d.flags[k] & REJECTED) lines.push("rejected");
      else {
        lines.push(`measured σ: shift ${size(d.edge_sigma_m[k])}, turn ${angle(d.edge_sigma_rad[k])}` + (d.count[k] > 1 ? " (the best)" : ""));
        lines.push(d.flags[k] & BRIDGE ? "in no cycle: nothing checks it" : `redundancy ${digits(d.redundancy[k])}`);
      }
    }
    tip.hidden = !title;
    if (!title) return;
    tip.replaceChildren();
    const head = document.createElement("b");
    head.textContent = title;
    tip.append(head);
    for (const text of lines) { tip.append(document.createElement("br")); tip.append(text); }
    tip.style.left = Math.max(4, Math.min(x + 14, W - tip.offsetWidth - 6)) + "px";
    tip.style.top = (y + 18 + tip.offsetHeight > H ? Math.max(4, y - tip.offsetHeight - 10) : y + 18) + "px";
  }

  // R <- rotation about the screen's right (by p) and up (by q) . R
  function rotate(p, q) {
    turn.c = Math.cos(p); turn.s = Math.sin(p);
    for (let k = 0; k < 3; k++) {
      const u = R[3 + k], w = R[6 + k];
      R[3 + k] = turn.c * u - turn.s * w; R[6 + k] = turn.s * u + turn.c * w;
    }
    turn.c = Math.cos(q); turn.s = Math.sin(q);
    for (let k = 0; k < 3; k++) {
      const u = R[k], w = R[6 + k];
      R[k] = turn.c * u + turn.s * w; R[6 + k] = turn.c * w - turn.s * u;
    }
    draw();
  }
  function zoomAt(x, y, by) {
    const to = Math.max(0.05, Math.min(500, zoom * by)), f = to / zoom;
    panX = (x - W / 2) - f * (x - W / 2 - panX); panY = (y - H / 2) - f * (y - H / 2 - panY);
    zoom = to; draw();
  }
  function busy() { moving = true; clearTimeout(settle); settle = setTimeout(() => { moving = false; draw(); }, 160); }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.offsetX, y: e.offsetY });
    canvas.focus({ preventScroll: true });
    tip.hidden = true; hoverNode = hoverEdge = -1;
  });
  canvas.addEventListener("pointermove", (e) => {
    const old = fingers.get(e.pointerId);
    if (!old) { find(e.offsetX, e.offsetY); say(e.offsetX, e.offsetY); draw(); return; }
    const dx = e.offsetX - old.x, dy = e.offsetY - old.y;
    busy();
    if (fingers.size === 2) {
      let other = null;
      for (const [id, f] of fingers) if (id !== e.pointerId) other = f;
      const before = Math.hypot(old.x - other.x, old.y - other.y), after = Math.hypot(e.offsetX - other.x, e.offsetY - other.y);
      panX += dx / 2; panY += dy / 2;
      zoomAt((e.offsetX + other.x) / 2, (e.offsetY + other.y) / 2, before > 5 ? after / before : 1);
    } else if (e.shiftKey || e.buttons & 6) { panX += dx; panY += dy; draw(); }
    else rotate(dy * 0.008, dx * 0.008);
    old.x = e.offsetX; old.y = e.offsetY;
  });
  const lift = (e) => { fingers.delete(e.pointerId); };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; hoverNode = hoverEdge = -1; draw(); });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault(); busy();
    zoomAt(e.offsetX, e.offsetY, Math.exp(-e.deltaY * (e.deltaMode === 1 ? 0.05 : 0.0015)));
  }, { passive: false });
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("keydown", (e) => {
    const step = 0.12, pan = e.shiftKey ? 24 : 0;
    switch (e.key) {
      case "ArrowLeft": if (pan) { panX -= pan; draw(); } else rotate(0, -step); break;
      case "ArrowRight": if (pan) { panX += pan; draw(); } else rotate(0, step); break;
      case "ArrowUp": if (pan) { panY -= pan; draw(); } else rotate(-step, 0); break;
      case "ArrowDown": if (pan) { panY += pan; draw(); } else rotate(step, 0); break;
      case "+": case "=": zoomAt(W / 2, H / 2, 1.2); break;
      case "-": zoomAt(W / 2, H / 2, 1 / 1.2); break;
      case "0": case "Home": reset(); break;
      default: return;
    }
    e.preventDefault();
  });
  by("reset").addEventListener("click", reset);
  for (const id of ["ellipsoids", "labels", "edges"]) by(id).addEventListener("change", draw);
  function rescale() {
    const wanted = d.scale * Math.pow(10, +by("scale").value), power = Math.pow(10, Math.floor(Math.log10(wanted)) - 1);
    factor = Math.round(wanted / power) * power;
    by("factor").textContent = factor >= 1e6 || factor < 0.01 ? factor.toExponential(1) : digits(factor);
    draw();
  }
  by("scale").addEventListener("input", rescale);

  for (const row of document.querySelectorAll("tr[data-cycle]")) {
    const k = +row.dataset.cycle, show = () => { cycle = k; draw(); }, hide = () => { cycle = pinned; draw(); };
    const pin = () => {
      pinned = pinned === k ? -1 : k; cycle = pinned;
      for (const other of document.querySelectorAll("tr.pinned")) other.classList.remove("pinned");
      if (pinned >= 0) row.classList.add("pinned");
      draw();
    };
    row.addEventListener("pointerenter", show); row.addEventListener("pointerleave", hide);
    row.addEventListener("focus", show); row.addEventListener("blur", hide);
    row.addEventListener("click", pin);
    row.addEventListener("keydown", (e) => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); pin(); } });
  }
  new ResizeObserver(resize).observe(canvas);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", theme);
  theme(); resize(); reset(); rescale();
})();
