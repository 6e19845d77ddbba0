"use strict";
const data = (id) => { const e = document.getElementById(id); return e && JSON.parse(e.textContent); };
const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
const onTheme = (draw) => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

// Packed numbers: little-endian bytes in base64.
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const shorts = (text) => {
  const view = new DataView(bytes(text).buffer);
  return Uint16Array.from({ length: view.byteLength >> 1 }, (_, k) => view.getUint16(2 * k, true));
};
const floats = (text) => {
  const view = new DataView(bytes(text).buffer);
  return Float32Array.from({ length: view.byteLength >> 2 }, (_, k) => view.getFloat32(4 * k, true));
};

// A canvas of `ratio` height to width, sharp on any screen; returns [context, width, height] in CSS pixels.
const fit = (canvas, ratio) => {
  const width = canvas.clientWidth || 600, height = Math.round(width * ratio), scale = devicePixelRatio || 1;
  canvas.style.height = height + "px";
  canvas.width = Math.round(width * scale); canvas.height = Math.round(height * scale);
  const context = canvas.getContext("2d");
  context.scale(scale, scale);
  return [context, width, height];
};

// Orange (0) to blue (1), as in points.ply.
const byWeight = (w) => {
  const low = [230, 120, 20], high = [30, 100, 220];
  return `rgb(${low.map((v, k) => Math.round(v + (high[k] - v) * w)).join(",")})`;
};

// Draws at most once a frame, however many events ask for it.
const lazily = (draw) => {
  let asked = false;
  return () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; draw(); });
  };
};
