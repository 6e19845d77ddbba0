const images = () => {
  const { views, labels, numbers, limit, ...packed } = data("tracks-data");
  const tracks = shorts(packed.tracks), observations = shorts(packed.observations);
  const INLIER = 0x8000, OTHER_POINT = 0x4000, UNKNOWN = 0x3fff;
  const element = (id) => document.getElementById(id);
  const canvas = element("image"), hover = element("hover"), legend = element("legend");
  const [view, colour, outliers, flow] = ["view", "colour", "outliers", "flow"].map(element);
  const hint = hover.textContent;
  const frame = (k) => views[k].slice(3, 7);

  // Observations as objects would be slow to make: each is its position in `observations`, listed by view.
  const ofView = views.map(() => []), trackOf = new Uint32Array(observations.length / 4);
  for (let track = 0, k = 0; track < tracks.length / 2; track++) {
    for (let n = 0; n < tracks[2 * track]; n++, k++) { trackOf[k] = track; ofView[observations[4 * k]].push(k); }
  }
  const pixel = (k) => {
    const [x0, y0, x1, y1] = frame(observations[4 * k]);
    return [2 * x0 - x1 + 3 * (x1 - x0) * observations[4 * k + 1] / 65535, 2 * y0 - y1 + 3 * (y1 - y0) * observations[4 * k + 2] / 65535];
  };
  const kept = (k) => (observations[4 * k + 3] & INLIER) !== 0;
  const other = (k) => (observations[4 * k + 3] & OTHER_POINT) !== 0;
  const residual = (k) => {
    const code = observations[4 * k + 3] & UNKNOWN;
    return code === UNKNOWN ? null : Math.expm1(code / 1000) / 100;
  };
  const name = (track) => labels ? labels[track] : `no. ${numbers[track]}`;
  const weight = (track) => (tracks[2 * track + 1] & 0x7fff) / 1000;
  const inlier = (track) => (tracks[2 * track + 1] & INLIER) !== 0;

  // The next observation of the same point: accepted ones follow accepted ones, those of another point each other. What
  // was left out of an inlier track shows no point that the track has elsewhere.
  const shows = (k) => kept(k) ? "point" : other(k) ? "other" : inlier(trackOf[k]) ? null : "outlier";
  const following = (k) => {
    const point = shows(k);
    for (let next = k + 1; point !== null && next < trackOf.length && trackOf[next] === trackOf[k]; next++) {
      if (shows(next) === point) return next;
    }
    return null;
  };

  views.forEach(([label, registered], k) => view.add(new Option(label + (registered ? "" : " (not registered)"), k)));
  // Begin with the view that has the most inliers.
  view.value = views.reduce((best, entry, k) => entry[8] > views[best][8] ? k : best, 0);

  const figures = () => {
    const [, registered, part, , , , , all, inliers, mean, rms, worst, others] = views[+view.value];
    const several = views.some((entry) => entry[2] > 0);
    element("view-figures").textContent = `${inliers} of ${all} observations are inliers` +
      (others ? `, ${others} show another point of their track` : "") + (mean === null ? "" : `; residual ${mean} px on average, ${rms} px RMS`) + (registered ? "" : "; not registered") +
      (registered && several ? `; part ${part}` : "");
    const table = element("worst");
    table.replaceChildren();
    const row = (kind, cells) => {
      const tr = table.insertRow();
      for (const text of cells) { const cell = document.createElement(kind); cell.textContent = text; tr.append(cell); }
    };
    if (worst.length) row("th", ["track of the largest residuals among the inliers", "residual (px)"]);
    for (const entry of worst) row("td", entry);
    const ring = views.some((entry) => entry[12]) ? " Green ring: it shows another point that its track joins." : "";
    legend.textContent = {
      inlier: "Blue disc: inlier. Orange cross: outlier track. Red cross: an observation left out of an inlier track." + ring,
      weight: "From orange (weight 0) to blue (weight 1). Crosses are wrong observations." + ring,
      residual: `From blue (0 px) to orange (${limit.toPrecision(3)} px and more); grey: not judged. Crosses are wrong observations.` + ring,
    }[colour.value];
  };

  let drawn = [];
  const draw = () => {
    const chosen = +view.value, [x0, y0, x1, y1] = frame(chosen);
    // Synthetic points may lie outside the image: what shows is the image and the inliers, up to an image beyond it.
    const shown = [x0, y0, x1, y1], [w, h] = [x1 - x0, y1 - y0];
    for (const k of ofView[chosen]) if (kept(k)) {
      const [x, y] = pixel(k);
      shown[0] = Math.max(x0 - w, Math.min(shown[0], x)); shown[1] = Math.max(y0 - h, Math.min(shown[1], y));
      shown[2] = Math.min(x1 + w, Math.max(shown[2], x)); shown[3] = Math.min(y1 + h, Math.max(shown[3], y));
    }
    const [across, down] = [shown[2] - shown[0] || 1, shown[3] - shown[1] || 1];
    const [context, width, height] = fit(canvas, Math.min(0.7, Math.max(0.4, down / across)));
    const margin = 14, scale = Math.min((width - 2 * margin) / across, (height - 2 * margin) / down);
    const place = ([x, y]) => [
      width / 2 + (x - (shown[0] + shown[2]) / 2) * scale, height / 2 + (y - (shown[1] + shown[3]) / 2) * scale];
    const [inside, outside, bad, mute, third] = ["in", "out", "bad", "mute", "third"].map(theme);
    const paint = (k, track) => {
      if (other(k)) return third;
      if (colour.value === "weight") return byWeight(weight(track));
      if (colour.value === "residual") return residual(k) === null ? mute : byWeight(1 - Math.min(1, residual(k) / limit));
      return inlier(track) ? (kept(k) ? inside : bad) : outside;
    };
    context.strokeStyle = theme("edge");
    context.strokeRect(...place([x0, y0]), w * scale, h * scale);
    drawn = [];
    // Wrong ones first, so that they hide no right one.
    for (const right of [false, true]) for (const k of ofView[chosen]) {
      const track = trackOf[k];
      if (kept(k) !== right || (!inlier(track) && !outliers.checked)) continue;
      const at = place(pixel(k));
      context.strokeStyle = context.fillStyle = paint(k, track);
      const next = flow.checked ? following(k) : null;
      if (next !== null) {
        context.globalAlpha = right ? 0.6 : 0.18;
        context.beginPath(); context.moveTo(...at); context.lineTo(...place(pixel(next))); context.stroke();
      }
      context.globalAlpha = right ? 1 : 0.7;
      context.beginPath();
      if (right) { context.arc(...at, 3.2, 0, 7); context.fill(); }
      else if (other(k)) { context.arc(...at, 3.2, 0, 7); context.stroke(); }
      else {
        const arm = inlier(track) ? 4 : 2.5;
        context.moveTo(at[0] - arm, at[1] - arm); context.lineTo(at[0] + arm, at[1] + arm);
        context.moveTo(at[0] - arm, at[1] + arm); context.lineTo(at[0] + arm, at[1] - arm); context.stroke();
      }
      drawn.push([at, k]);
    }
    context.globalAlpha = 1;
  };
  const update = () => { hover.textContent = hint; figures(); draw(); };
  const step = (by) => { view.value = Math.max(0, Math.min(views.length - 1, +view.value + by)); update(); };

  canvas.addEventListener("pointermove", (event) => {
    let best = 100, text = hint;
    for (const [[x, y], k] of drawn) {
      const distance = (x - event.offsetX) ** 2 + (y - event.offsetY) ** 2;
      if (distance >= best) continue;
      best = distance;
      const track = trackOf[k], px = residual(k);
      text = `Track ${name(track)}: ${inlier(track) ? "inlier" : "outlier"}, weight ${weight(track)}` +
        (other(k) ? ", this observation shows another point" : inlier(track) && !kept(k) ? ", this observation left out" : "") + (px === null ? "" : `, residual ${px.toPrecision(3)} px`);
    }
    hover.textContent = text;
  });
  canvas.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 }[event.key];
    if (by) { event.preventDefault(); step(by); }
  });
  element("previous").addEventListener("click", () => step(-1));
  element("next").addEventListener("click", () => step(1));
  for (const control of [view, colour, outliers, flow]) control.addEventListener("change", update);
  addEventListener("resize", lazily(draw)); onTheme(draw); update();
};
