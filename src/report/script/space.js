const space = () => {
  const parts = data("space-data");
  const canvas = document.getElementById("solid"), choice = document.getElementById("part");
  const COLOURS = 6;
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const along = (a, s, b) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const unit = (v, other) => { const n = Math.hypot(...v); return n > 1e-6 ? v.map((x) => x / n) : other; };
  const quantile = (values, share) => Float64Array.from(values).sort()[Math.floor((values.length - 1) * share)] || 0;

  // A part made ready: its points and cameras in axes right, down, forward of its mean camera, about what is looked at.
  const prepare = ([part, cameras, packedPoints, packedWeights]) => {
    const raw = floats(packedPoints), weights = bytes(packedWeights), count = weights.length;
    const mean = (row) => cameras.reduce((sum, [, , R]) => along(sum, 1 / cameras.length, R.slice(3 * row, 3 * row + 3)), [0, 0, 0]);
    const down = unit(mean(1), [0, 1, 0]);
    const level = (v) => along(v, -dot(v, down), down);
    const spare = Math.abs(down[0]) < 0.9 ? [1, 0, 0] : [0, 0, 1];
    const forward = unit(level(mean(2)), unit(level(spare), [0, 0, 1]));
    const axes = [cross(down, forward), down, forward];
    const turned = (v) => axes.map((axis) => dot(axis, v));
    const centres = cameras.map(([, C]) => turned(C)), points = new Float64Array(3 * count);
    for (let k = 0; k < count; k++) points.set(turned([raw[3 * k], raw[3 * k + 1], raw[3 * k + 2]]), 3 * k);
    // What is looked at: all cameras, and the points within Tukey's fences along each axis, as in the still plan, so that
    // neither stray ones nor a cluster far off shrink the rest.
    const low = [], high = [];
    for (let axis = 0; axis < 3; axis++) {
      const values = Float64Array.from({ length: count }, (_, k) => points[3 * k + axis]), own = centres.map((c) => c[axis]);
      const lower = quantile(values, 0.25), upper = quantile(values, 0.75), room = 1.5 * (upper - lower);
      const inside = values.filter((v) => v >= lower - room && v <= upper + room);
      low.push([...own, ...inside].reduce((a, b) => Math.min(a, b), Infinity));
      high.push([...own, ...inside].reduce((a, b) => Math.max(a, b), -Infinity));
    }
    const focus = low.map((v, k) => (v + high[k]) / 2);
    const radius = Math.hypot(...low.map((v, k) => high[k] - v)) / 2 || 1;
    for (let k = 0; k < 3 * count; k++) points[k] -= focus[k % 3];
    centres.forEach((c, k) => { centres[k] = along(c, -1, focus); });
    // Cameras as large as their distance along the path allows.
    const steps = centres.slice(1).map((c, k) => Math.hypot(...along(c, -1, centres[k])));
    const depth = Math.min(0.12 * radius, Math.max(0.03 * radius, 1.2 * quantile(steps, 0.5)));
    const frusta = cameras.map(([, , R, [left, right, top, bottom]], k) => {
      const rows = [0, 1, 2].map((row) => turned(R.slice(3 * row, 3 * row + 3)));
      return [[left, top], [right, top], [right, bottom], [left, bottom]].map(([x, y]) =>
        along(along(along(centres[k], depth * x, rows[0]), depth * y, rows[1]), depth, rows[2]));
    });
    return { part, names: cameras.map(([label]) => label), centres, frusta, points, weights, count, radius };
  };

  const START = { yaw: 0.5, pitch: 0.45, zoom: 1, moved: [0, 0] };
  let scene = null, look = null;
  const shades = Array.from({ length: 256 }, (_, w) => byWeight(w / 255));

  const draw = () => {
    const { points, weights, count, radius, centres, frusta, names, part } = scene;
    const [context, width, height] = fit(canvas, 0.6);
    const [cy, sy, cp, sp] = [Math.cos(look.yaw), Math.sin(look.yaw), Math.cos(look.pitch), Math.sin(look.pitch)];
    const unitPx = look.zoom * 0.62 * Math.min(width, height) / radius, reach = 3.5 * radius / Math.sqrt(look.zoom);
    // To the screen: a turn about the vertical, a tilt, and the perspective of an eye `reach` away; null behind the eye.
    const place = (x, y, z) => {
      const right = cy * x + sy * z, ahead = cy * z - sy * x, below = cp * y - sp * ahead, depth = cp * ahead + sp * y;
      const nearness = reach / (reach + depth);
      if (!(reach + depth > 0.05 * reach)) return null;
      return [width / 2 + look.moved[0] * width + right * unitPx * nearness, height / 2 + look.moved[1] * width + below * unitPx * nearness, depth];
    };
    const order = [];
    for (let k = 0; k < count; k++) {
      const at = place(points[3 * k], points[3 * k + 1], points[3 * k + 2]);
      if (at && at[0] > -5 && at[0] < width + 5 && at[1] > -5 && at[1] < height + 5) order.push([at, weights[k]]);
    }
    order.sort((a, b) => b[0][2] - a[0][2]);
    const size = (count < 500 ? 5 : count < 5000 ? 3 : 2) * Math.min(2, Math.max(1, Math.sqrt(look.zoom)));
    context.globalAlpha = 0.8;
    for (const [[x, y], weight] of order) {
      context.fillStyle = shades[weight];
      context.fillRect(x - size / 2, y - size / 2, size, size);
    }
    const line = (list) => {
      list.forEach((at, k) => at && (k && list[k - 1] ? context.lineTo(at[0], at[1]) : context.moveTo(at[0], at[1])));
    };
    const apexes = centres.map((c) => place(...c));
    context.strokeStyle = theme("p" + part % COLOURS);
    context.globalAlpha = 0.5; context.lineWidth = 1.5;
    context.beginPath(); line(apexes); context.stroke();
    context.globalAlpha = 1; context.lineWidth = 1;
    context.beginPath();
    frusta.forEach((corners, k) => {
      const rim = corners.map((corner) => place(...corner));
      line([...rim, rim[0]]);
      for (const corner of rim) line([apexes[k], corner]);
    });
    context.stroke();
    context.fillStyle = theme("ink"); context.font = "11px system-ui, sans-serif";
    // Some fifteen names, the first and the last among them.
    const every = Math.ceil(names.length / 15);
    names.forEach((name, k) => {
      if (apexes[k] && (k % every === 0 || k === names.length - 1)) context.fillText(name, apexes[k][0] + 6, apexes[k][1] - 6);
    });
  };
  const soon = lazily(draw);

  const turn = (x, y) => { look.yaw += x; look.pitch = Math.max(-1.55, Math.min(1.55, look.pitch + y)); soon(); };
  const move = (x, y) => { look.moved[0] += x; look.moved[1] += y; soon(); };
  const zoom = (by) => {
    const factor = Math.max(0.2, Math.min(60, look.zoom * by)) / look.zoom;
    look.zoom *= factor; look.moved = look.moved.map((v) => v * factor); soon();
  };
  const reset = () => { look = { ...START, moved: [0, 0] }; soon(); };
  const choose = () => { scene = prepare(parts[choice ? +choice.value : 0]); look = { ...START, moved: [0, 0] }; draw(); };

  // Pointers held down: one turns (or moves, with shift or another button), two move and pinch.
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  for (const ended of ["pointerup", "pointercancel"]) canvas.addEventListener(ended, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], by = [now[0] - before[0], now[1] - before[1]], width = canvas.clientWidth || 600;
    held.set(event.pointerId, now);
    if (held.size > 1) {
      const other = [...held].find(([id]) => id !== event.pointerId)[1];
      const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      move(by[0] / 2 / width, by[1] / 2 / width);
      zoom(gap(now) / gap(before));
    } else if (event.shiftKey || event.buttons > 1) move(by[0] / width, by[1] / width);
    else turn(-by[0] * 0.008, by[1] * 0.008);
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (arrow) event.shiftKey ? move(0.03 * arrow[0], 0.03 * arrow[1]) : turn(-0.08 * arrow[0], 0.08 * arrow[1]);
    else if (event.key === "+" || event.key === "=") zoom(1.15);
    else if (event.key === "-") zoom(1 / 1.15);
    else if (event.key === "0" || event.key === "Home") reset();
    else return;
    event.preventDefault();
  });
  if (choice) choice.addEventListener("change", choose);
  addEventListener("resize", soon); onTheme(draw); choose();
};

if (document.getElementById("tracks-data")) images();
if (document.getElementById("space-data")) space();
