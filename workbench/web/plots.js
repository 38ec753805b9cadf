"use strict";
/* Pictures: SVG for places and the staircase, uPlot for series. */
const SVG = "http://www.w3.org/2000/svg";
const NAMES = {
  motor_velocity: "velocity", motor_angle: "motor angle within a turn", motor_position: "position", link_position: "link position",
  load: "load", torsion: "torsion", temperature: "warming", time: "time",
};

function svg(tag, attributes, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
  for (const child of children.flat()) if (child != null) node.append(child);
  return node;
}

function digits(value, count = 3) {
  if (value == null || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-3) return value.toExponential(count - 1).replace("e+", "e").replace("-", "−");
  return Number(value.toPrecision(count)).toString().replace("-", "−");
}

function unit(text) {
  return (text || "").replace(/\./g, "·").replace(/(rad|m|s)([23])/g, (_, a, b) => a + (b === "2" ? "²" : "³")).replace(/^1$/, "");
}

function ticks(low, high, most = 5) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const raw = span / most, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999) || 10 * power;
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * span; k++) out.push(Number((k * step).toPrecision(12)));
  return out;
}

/* Width of a picture in its own units: as wide as it will be drawn on a phone, so that its text stays readable. */
function pictureWidth(most) {
  return Math.max(280, Math.min(most, document.documentElement.clientWidth - 70));
}

/* One place: mean residual with its 95 % band, one curve or one per direction of motion. */
function placePlot(place) {
  const legend = place.branches.length > 1 ? 16 : 0, W = pictureWidth(420), H = 250 + legend, L = 58, R = 14, T = 12 + legend, B = 44;
  const xs = place.branches.flatMap((b) => b.centre), ys = place.branches.flatMap((b) => [...b.low, ...b.high, ...b.mean]).filter((v) => v != null);
  let [x0, x1] = [Math.min(...xs), Math.max(...xs)], [y0, y1] = [Math.min(0, ...ys), Math.max(0, ...ys)];
  const means = place.branches.flatMap((b) => b.mean), top = Math.max(...means.map(Math.abs)) * 2.2 || 1;
  y0 = Math.max(y0, -top); y1 = Math.min(y1, top);
  if (x1 === x0) x1 = x0 + 1;
  if (y1 === y0) y1 = y0 + 1;
  const X = (v) => L + ((v - x0) / (x1 - x0)) * (W - L - R), Y = (v) => T + ((y1 - Math.min(y1, Math.max(y0, v))) / (y1 - y0)) * (H - T - B);
  const worst = place.branches.flatMap((b) => b.mean.map((m, i) => [m, b.centre[i]])).reduce((a, b) => (Math.abs(b[0]) > Math.abs(a[0]) ? b : a), [0, 0]);
  const label = `Mean residual of the ${place.balance} balance against ${place.title}; largest ${digits(worst[0])} ${unit(place.residual_unit)} at ${digits(worst[1])} ${unit(place.unit)}`;
  const out = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": label });
  for (const t of ticks(y0, y1, 4)) out.append(svg("path", { class: t === 0 ? "s-zero" : "s-grid", d: `M${L} ${Y(t)}H${W - R}` }), svg("text", { x: L - 6, y: Y(t) + 4, "text-anchor": "end" }, digits(t)));
  for (const t of ticks(x0, x1, 5)) out.append(svg("path", { class: "s-grid", d: `M${X(t)} ${T}V${H - B}` }), svg("text", { x: X(t), y: H - B + 16, "text-anchor": "middle" }, digits(t)));
  place.branches.forEach((b, k) => {
    const runs = b.centre.reduce((all, c, i) => { if (b.low[i] == null) all.push([]); else all[all.length - 1].push(i); return all; }, [[]]).filter((run) => run.length > 1);
    for (const run of runs) {
      const d = run.map((i) => `${X(b.centre[i])} ${Y(b.high[i])}`).join("L") + "L" + run.slice().reverse().map((i) => `${X(b.centre[i])} ${Y(b.low[i])}`).join("L");
      out.append(svg("path", { class: k ? "s-band-2" : "s-band", d: `M${d}Z` }));
    }
    out.append(svg("path", { class: k ? "s-line-2" : "s-line", d: "M" + b.centre.map((c, i) => `${X(c)} ${Y(b.mean[i])}`).join("L") }));
    b.centre.forEach((c, i) => out.append(k ? svg("rect", { class: "s-dot-2", x: X(c) - 2, y: Y(b.mean[i]) - 2, width: 4, height: 4 }) : svg("circle", { class: "s-dot", cx: X(c), cy: Y(b.mean[i]), r: 2.2 })));
    if (place.branches.length > 1) out.append(svg("text", { class: "strong", x: W - R - 120 * (1 - k), y: 14, "text-anchor": "end" }, (k ? "▪ - - " : "● — ") + b.direction));
  });
  out.append(svg("text", { x: (L + W - R) / 2, y: H - 8, "text-anchor": "middle" }, `${place.title}${unit(place.unit) ? ` [${unit(place.unit)}]` : ""}`));
  out.append(svg("text", { x: 14, y: (T + H - B) / 2, transform: `rotate(-90 14 ${(T + H - B) / 2})`, "text-anchor": "middle" }, `mean residual [${unit(place.residual_unit)}]`));
  return out;
}

/* The falling staircase: held-out error after each step. */
function staircase(steps) {
  const W = pictureWidth(640), H = 270, L = 54, R = 16, T = 26, B = 46, n = steps.length;
  const errors = steps.map((s) => s.held_out.relative_error_percent), top = Math.max(...errors) * 1.12 || 1, w = (W - L - R) / Math.max(n, 2);
  const Y = (v) => T + (1 - v / top) * (H - T - B), X = (k) => L + k * w;
  const out = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "Error on held-out records: " + steps.map((s, k) => `${stepName(s)} ${digits(errors[k])} percent`).join(", ") });
  for (const t of ticks(0, top, 4)) out.append(svg("path", { class: t === 0 ? "s-zero" : "s-grid", d: `M${L} ${Y(t)}H${W - R}` }), svg("text", { x: L - 6, y: Y(t) + 4, "text-anchor": "end" }, digits(t)));
  let d = "";
  errors.forEach((e, k) => { d += `${k ? "L" : "M"}${X(k)} ${Y(e)}L${X(k + 1)} ${Y(e)}`; });
  out.append(svg("path", { class: "s-fill", d: `${d}L${X(n)} ${Y(0)}L${X(0)} ${Y(0)}Z` }), svg("path", { class: "s-stair", d }));
  errors.forEach((e, k) => {
    out.append(svg("text", { class: "strong", x: X(k) + w / 2, y: Y(e) - 7, "text-anchor": "middle" }, `${digits(e)} %`));
    const name = stepName(steps[k]), room = Math.max(8, Math.floor(w / 6.2));
    out.append(svg("text", { x: X(k) + w / 2, y: H - B + 17, "text-anchor": "middle" }, name.length > room ? name.slice(0, room - 1) + "…" : name, svg("title", {}, name)));
  });
  out.append(svg("text", { x: 4, y: 12 }, `held-out error, % of the measured ${effort()}`));
  return out;
}

function stepName(step) {
  if (step.action === "start") return "start model";
  const place = step.label && step.label.includes("@") ? ` (${step.label.split("@")[1].replace(/_/g, " ")})` : "";
  return (step.action === "remove" ? "− " : "+ ") + (step.title || step.label || "") + place;
}

/* What a balance is a sum of: torques, or forces of a linear axis. */
const effort = () => (/^kind\s*=\s*"linear"/m.test(app.state.joint_text) ? "force" : "torque");
const vaf = (v) => digits(v, v > 99.9 ? 5 : 4);

const plotPoints = (width) => Math.max(200, Math.min(1600, Math.round(width)));

/* A series with min-max decimation on the server; a drag zooms and asks for the samples of the window.
   Zoomed in, a strip below shows the whole record and the window in it. */
class SeriesPlot {
  constructor(host, fetcher, { title, local } = {}) {
    this.host = host; this.fetcher = fetcher; this.title = title || ""; this.local = Boolean(local); this.range = null; this.asked = 0; this.plot = null; this.small = null; this.whole = null;
    this.main = h("div"); this.strip = h("div", { class: "strip", hidden: true });
    host.replaceChildren(this.main, this.strip);
    this.observer = new ResizeObserver(() => {
      if (this.plot && host.clientWidth) this.plot.setSize({ width: host.clientWidth, height: this.height() });
      if (this.small && host.clientWidth) { this.small.setSize({ width: host.clientWidth, height: 74 }); this.mark(); }
    });
    this.observer.observe(host);
  }
  height() { return this.host.clientWidth < 600 ? 220 : 300; }
  forget() { this.whole = null; if (this.small) { this.small.destroy(); this.small = null; } }
  async show(range) {
    this.range = range || null;
    const mine = ++this.asked, points = plotPoints(this.host.clientWidth || 800);
    const whole = this.whole || this.fetcher(null, points);
    const [all, data] = await Promise.all([whole, this.range && !this.local ? this.fetcher(this.range, points) : whole]);
    if (mine !== this.asked || !this.host.isConnected) return;
    this.whole = all;
    this.full = [all.time[0], all.time[all.time.length - 1]];
    this.draw(data);
    this.overview(all);
  }
  colours() {
    const css = getComputedStyle(document.documentElement), colour = (name) => css.getPropertyValue(name).trim();
    const palette = { measured: "--measured", model: "--after", residual: "--before" }, cycle = ["--after", "--before", "--good", "--measured", "--warn"];
    return { of: (s, k) => colour(palette[s.name] || cycle[k % cycle.length]), axis: { stroke: colour("--soft"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--grid") } } };
  }
  picked(u) { if (u.select.width > 3) this.show([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]).catch(fail); }
  draw(data) {
    const { of, axis } = this.colours(), units = [...new Set(data.series.map((s) => s.unit))];
    if (this.plot) this.plot.destroy();
    const options = {
      width: this.host.clientWidth || 800, height: this.height(), legend: { live: true }, cursor: { drag: { x: true, y: false, setScale: false } },
      scales: { x: { time: false, range: this.range ? () => this.range : undefined } },
      series: [{ label: "time [s]", value: (u, v) => digits(v, 6) }, ...data.series.map((s, k) => ({
        label: s.name.replace(/_/g, " ") + (unit(s.unit) ? ` [${unit(s.unit)}]` : ""), stroke: of(s, k), width: data.time.length < 600 ? 1.5 : 1, scale: s.unit,
        dash: s.name === "model" ? [6, 3] : k % 2 && s.name !== "residual" ? [8, 3] : undefined, value: (u, v) => digits(v, 4), points: { show: data.full && data.time.length < 200 && !this.local },
      }))],
      axes: [{ ...axis, label: "time [s]", labelSize: 20, size: 40 }, ...units.map((u, k) => ({ ...axis, scale: u, side: k ? 1 : 3, label: unit(u), labelSize: 18, size: 58, grid: k ? { show: false } : axis.grid }))],
      hooks: { setSelect: [(u) => this.picked(u)] },
    };
    this.plot = new uPlot(options, [data.time, ...data.series.map((s) => s.values)], this.main);
    this.host.dataset.points = String(data.time.length);
    this.plot.over.addEventListener("dblclick", () => this.show(null).catch(fail));
    this.plot.root.setAttribute("role", "img");
    this.plot.root.setAttribute("aria-label", `${this.title || "Series"} over time, ${data.full ? "every sample" : "smallest and largest value per pixel"}`);
  }
  overview(all) {
    this.strip.hidden = !this.range;
    if (!this.range) return;
    if (!this.small) {
      const { of, axis } = this.colours(), scales = Object.fromEntries([...new Set(all.series.map((s) => s.unit))].map((u) => [u, {}]));
      this.small = new uPlot({
        width: this.host.clientWidth || 800, height: 74, legend: { show: false }, cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false }, scales: { x: { time: false }, ...scales },
        series: [{}, ...all.series.map((s, k) => ({ stroke: of(s, k), width: 1, scale: s.unit, points: { show: false } }))],
        axes: [{ ...axis, size: 24 }, ...all.series.slice(0, 1).map((s) => ({ ...axis, scale: s.unit, size: 58, values: () => [] }))], hooks: { setSelect: [(u) => this.picked(u)] },
      }, [all.time, ...all.series.map((s) => s.values)], this.strip);
      this.small.root.setAttribute("role", "img");
      this.small.root.setAttribute("aria-label", "The whole record; the shaded part is shown above");
    }
    this.mark();
  }
  mark() {
    if (!this.small || !this.range) return;
    const left = this.small.valToPos(this.range[0], "x"), right = this.small.valToPos(this.range[1], "x");
    this.small.setSelect({ left, top: 0, width: Math.max(2, right - left), height: this.small.over.clientHeight }, false);
  }
  move(factor, shift = 0) {
    const [a, b] = this.range || this.full || [0, 1], c = (a + b) / 2 + shift * (b - a), half = ((b - a) * factor) / 2;
    const low = Math.max(this.full[0], c - half), high = Math.min(this.full[1], c + half);
    this.show(high - low >= (this.full[1] - this.full[0]) * 0.999 ? null : [low, high]).catch(fail);
  }
  destroy() { this.observer.disconnect(); if (this.plot) this.plot.destroy(); if (this.small) this.small.destroy(); }
}
