"use strict";
(() => {
  const data = (id) => { const e = document.getElementById(id); return e && JSON.parse(e.textContent); };
  const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const onTheme = (draw) => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

  // A canvas of `ratio` height to width, sharp on any screen; returns [context, width, height] in CSS pixels.
  const fit = (canvas, ratio) => {
    const width = canvas.clientWidth, height = Math.round(width * ratio), scale = devicePixelRatio || 1;
    canvas.style.height = height + "px";
    canvas.width = width * scale; canvas.height = height * scale;
    const context = canvas.getContext("2d");
    context.scale(scale, scale);
    return [context, width, height];
  };

  // Orange (0) to blue (1), as in points.ply.
  const byWeight = (w) => {
    const low = [230, 120, 20], high = [30, 100, 220];
    return `rgb(${low.map((v, k) => Math.round(v + (high[k] - v) * w)).join(",")})`;
  };

  const images = () => {
    const { views, tracks } = data("tracks-data");
    const canvas = document.getElementById("image"), hover = document.getElementById("hover");
    const [view, colour, outliers, flow] = ["view", "colour", "outliers", "flow"].map((id) => document.getElementById(id));
    views.forEach(([label, registered], k) => view.add(new Option(label + (registered ? "" : " (not registered)"), k)));
    // Begin with the view that has the most inliers within its image.
    const counts = views.map(() => 0);
    for (const [, , , points] of tracks) for (let k = 0; k < points.length; k += 4) {
      const [, , x0, y0, x1, y1] = views[points[k]], [x, y] = [points[k + 1], points[k + 2]];
      if (points[k + 3] && x >= x0 && x <= x1 && y >= y0 && y <= y1) counts[points[k]] += 1;
    }
    view.value = counts.indexOf(Math.max(...counts));
    const legend = hover.textContent;
    let drawn = [];
    const draw = () => {
      const chosen = +view.value, [, , x0, y0, x1, y1] = views[chosen];
      // Synthetic points may lie outside the image: what shows is the image and the inliers, up to an image beyond it.
      const shown = [x0, y0, x1, y1], [w, h] = [x1 - x0, y1 - y0];
      for (const [, , , points] of tracks) for (let k = 0; k < points.length; k += 4) if (points[k] === chosen && points[k + 3]) {
        const [x, y] = [points[k + 1], points[k + 2]];
        shown[0] = Math.max(x0 - w, Math.min(shown[0], x)); shown[1] = Math.max(y0 - h, Math.min(shown[1], y));
        shown[2] = Math.min(x1 + w, Math.max(shown[2], x)); shown[3] = Math.min(y1 + h, Math.max(shown[3], y));
      }
      const [across, down] = [shown[2] - shown[0] || 1, shown[3] - shown[1] || 1];
      const [context, width, height] = fit(canvas, Math.min(0.7, Math.max(0.4, down / across)));
      const margin = 14, scale = Math.min((width - 2 * margin) / across, (height - 2 * margin) / down);
      const place = (x, y) => [
        width / 2 + (x - (shown[0] + shown[2]) / 2) * scale, height / 2 + (y - (shown[1] + shown[3]) / 2) * scale];
      const [inside, outside, bad] = [theme("in"), theme("out"), theme("bad")];
      context.strokeStyle = theme("edge");
      context.strokeRect(...place(x0, y0), (x1 - x0) * scale, (y1 - y0) * scale);
      drawn = [];
      for (const kind of [0, 1]) for (const track of tracks) {
        const [, weight, inlier, points] = track;
        if (inlier !== kind || (!inlier && !outliers.checked)) continue;
        for (let k = 0; k < points.length; k += 4) {
          if (points[k] !== chosen) continue;
          const at = place(points[k + 1], points[k + 2]), kept = points[k + 3];
          const paint = colour.value === "weight" ? byWeight(weight) : inlier ? (kept ? inside : bad) : outside;
          context.strokeStyle = context.fillStyle = paint;
          if (flow.checked && k + 4 < points.length) {
            context.globalAlpha = inlier ? 0.6 : 0.18;
            context.beginPath(); context.moveTo(...at); context.lineTo(...place(points[k + 5], points[k + 6])); context.stroke();
          }
          context.globalAlpha = inlier ? 1 : 0.7;
          context.beginPath();
          if (inlier && !kept) {
            context.moveTo(at[0] - 4, at[1] - 4); context.lineTo(at[0] + 4, at[1] + 4);
            context.moveTo(at[0] - 4, at[1] + 4); context.lineTo(at[0] + 4, at[1] - 4); context.stroke();
          } else { context.arc(...at, inlier ? 3.2 : 2, 0, 7); context.fill(); }
          drawn.push([at, track, kept]);
        }
      }
      context.globalAlpha = 1;
    };
    canvas.addEventListener("pointermove", (event) => {
      let best = 100, text = legend;
      for (const [[x, y], [label, weight, inlier], kept] of drawn) {
        const distance = (x - event.offsetX) ** 2 + (y - event.offsetY) ** 2;
        if (distance < best) {
          best = distance;
          text = `Track ${label}: ${inlier ? "inlier" : "outlier"}, weight ${weight}` + (inlier && !kept ? ", this observation left out" : "");
        }
      }
      hover.textContent = text;
    });
    for (const control of [view, colour, outliers, flow]) control.addEventListener("change", draw);
    addEventListener("resize", draw); onTheme(draw); draw();
  };

  const space = () => {
    const { cameras, points } = data("space-data");
    const canvas = document.getElementById("solid");
    const turn = (R, v) => [0, 1, 2].map((i) => R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2]);
    const back = (R, v) => [0, 1, 2].map((i) => R[i] * v[0] + R[3 + i] * v[1] + R[6 + i] * v[2]);
    const centres = cameras.map(([, , R, t]) => back(R, t.map((v) => -v)));
    const median = (values) => values.sort((a, b) => a - b)[values.length >> 1] || 0;
    const focus = [0, 1, 2].map((k) => median(points.concat(centres).map((p) => p[k])));
    const far = (p) => Math.hypot(...[0, 1, 2].map((k) => p[k] - focus[k]));
    // Nine tenths of the points set the scale, so that a stray one does not shrink the rest.
    const reach = points.map(far).sort((a, b) => a - b)[Math.floor(points.length * 0.9)] || 0;
    const radius = Math.max(reach, ...centres.map(far), 1e-9);
    // World corners of a small image plane in front of each camera.
    const frusta = cameras.map(([, K, R, , w, h], k) => [[0, 0], [w, 0], [w, h], [0, h]].map(([x, y]) => {
      const d = 0.12 * radius, ray = [d * (x - K[2]) / K[0], d * (y - K[5]) / K[4], d];
      return back(R, ray).map((v, i) => v + centres[k][i]);
    }));
    let yaw = 0.6, pitch = -0.35, zoom = 1;
    const draw = () => {
      const [context, width, height] = fit(canvas, 0.6);
      const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
      const R = [cy, 0, sy, sp * sy, cp, -sp * cy, -cp * sy, sp, cp * cy];
      const scale = zoom * 0.55 * Math.min(width, height) / radius;
      const place = (p) => {
        const [x, y, z] = turn(R, [0, 1, 2].map((k) => p[k] - focus[k]));
        const nearness = 1 / Math.max(0.2, 1 + 0.25 * z / radius);
        return [width / 2 + x * scale * nearness, height / 2 + y * scale * nearness, z];
      };
      context.globalAlpha = 0.85;
      const depth = points.map((p) => [place(p), p[3]]).sort((a, b) => b[0][2] - a[0][2]);
      for (const [[x, y], weight] of depth) {
        context.fillStyle = byWeight(weight);
        context.fillRect(x - 1.5, y - 1.5, 3, 3);
      }
      context.globalAlpha = 1;
      context.strokeStyle = theme("ink"); context.fillStyle = theme("mute"); context.font = "11px system-ui, sans-serif";
      frusta.forEach((corners, k) => {
        const apex = place(centres[k]), rim = corners.map(place);
        context.beginPath();
        rim.forEach((corner, i) => {
          const next = rim[(i + 1) % 4];
          context.moveTo(apex[0], apex[1]); context.lineTo(corner[0], corner[1]); context.lineTo(next[0], next[1]);
        });
        context.stroke();
        if (cameras.length <= 40) context.fillText(cameras[k][0], apex[0] + 5, apex[1] - 5);
      });
    };
    let held = null;
    canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => { held = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      yaw += (event.clientX - held[0]) * 0.008;
      pitch = Math.max(-1.5, Math.min(1.5, pitch - (event.clientY - held[1]) * 0.008));
      held = [event.clientX, event.clientY];
      draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom = Math.max(0.2, Math.min(20, zoom * Math.exp(-event.deltaY * 0.001)));
      draw();
    }, { passive: false });
    addEventListener("resize", draw); onTheme(draw); draw();
  };

  if (document.getElementById("tracks-data")) images();
  if (document.getElementById("space-data")) space();
})();
