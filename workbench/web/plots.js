"use strict";
/* Pictures: SVG for places and the staircase, uPlot for series. */
const SVG = "http://www.w3.org/2000/svg";
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

const WIDEST = 1120; /* of all pictures */
/* Width of a picture in its own units: as wide as it will be drawn on a phone, so that its text stays readable. */
function pictureWidth(most) {
  app.drawn = pictureRoom();
  return Math.min(most, app.drawn);
}
function pictureRoom() {
  const most = railed() ? Infinity : WIDEST; /* beside the rails a card is as wide as there is room */
  return Math.max(280, Math.min(most, ($("main").clientWidth || innerWidth) - 70));
}

/* What a step did; a set of names stays a set. */
function stepName(step) {
  if (step.action === "start") return "start model";
  const names = step.names && step.names.length > 1 ? step.names.map(effectTitle).join(" or ") : effectTitle(step.label || step.title || "");
  return (step.action === "remove" ? "− " : "+ ") + names;
}

/* What a balance is a sum of: torques, or forces of a linear axis. */
const effort = () => (/^kind\s*=\s*"linear"/m.test(app.state.joint_text) ? "force" : "torque");
const vaf = (v) => digits(v, v > 99.9 ? 5 : 4);

/* What noise allows is drawn beside the residual; where it allows much, at a reversal, it must not flatten it. */
const noisy = (s) => s.name.startsWith("noise, ");
function reach(group, low, high) {
  const upper = group.filter(noisy).flatMap((s) => s.values).filter((v) => v > 0).sort((a, b) => a - b), usual = upper.length ? 1.3 * upper[upper.length >> 1] : 0;
  return [Math.min(low, -usual), Math.max(high, usual)];
}
const plotPoints = (width) => Math.max(200, Math.min(1600, Math.round(width)));

/* A series with min-max decimation on the server; a drag zooms and asks for the samples of the window.
   Zoomed in, a strip below shows the whole record and the window in it. `panels` names the series of each frame: their
   cursors are one. */
class SeriesPlot {
  constructor(host, fetcher, { title, local, panels, side } = {}) {
    this.host = host; this.fetcher = fetcher; this.title = title || ""; this.local = Boolean(local); this.panels = panels || null; this.side = side || "";
    this.range = null; this.asked = 0; this.plots = []; this.small = null; this.whole = null; this.marks = null; this.onCursor = null; this.low = false;
    this.main = h("div"); this.strip = h("div", { class: "strip", hidden: true });
    this.save = h("div", { class: "row under end", hidden: true }, saver(this.title || "series", () => this.svg(), () => this.csv())); /* there is nothing to save before the data came */
    host.replaceChildren(this.main, this.strip, this.save);
    this.observer = new ResizeObserver(() => {
      if (host.clientWidth) this.plots.forEach((p, k) => p.setSize({ width: host.clientWidth, height: this.height(k) }));
      if (this.small && host.clientWidth) { this.small.setSize({ width: host.clientWidth, height: this.flat() }); this.mark(); }
    });
    this.observer.observe(host);
  }
  get plot() { return this.plots[0] || null; }
  height(panel) {
    if (this.low) return 168 + 24 * panel; /* it stays in sight above the places */
    /* a panel is as high as the label of its axis is long, also on a phone */
    return this.panels ? 225 : this.host.clientWidth < 600 ? 270 : 300;
  }
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
    const palette = { measured: "--measured", model: "--after", residual: "--before", "noise, upper": "--soft", "noise, lower": "--soft" }, cycle = ["--after", "--before", "--good", "--measured", "--warn"];
    return { of: (s, k) => colour(palette[s.name] || cycle[k % cycle.length]), axis: { stroke: colour("--soft"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--grid") } } };
  }
  picked(u) { if (u.select.width > 3) this.show([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]).catch(fail); }
  /* The samples that a brush chose, and where a run begins. */
  shade(u) {
    const spans = this.marks ? this.marks() : [], begins = (this.data && this.data.runs) || [], context = u.ctx, css = getComputedStyle(document.documentElement);
    const records = (this.data && this.data.records) || [];
    if (!spans.length && !begins.length && records.length < 2) return;
    context.save();
    context.beginPath(); context.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height); context.clip();
    context.fillStyle = css.getPropertyValue("--band-2").trim();
    for (const [a, b] of spans) { const x = u.valToPos(a, "x", true); context.fillRect(x, u.bbox.top, Math.max(1, u.valToPos(b, "x", true) - x), u.bbox.height); }
    context.strokeStyle = css.getPropertyValue("--soft").trim(); context.setLineDash([3, 4]);
    for (const t of begins) { const x = u.valToPos(t, "x", true); context.beginPath(); context.moveTo(x, u.bbox.top); context.lineTo(x, u.bbox.top + u.bbox.height); context.stroke(); }
    context.setLineDash([]);
    context.fillStyle = css.getPropertyValue("--ink").trim();
    const px = devicePixelRatio || 1;
    context.font = `${11 * px}px system-ui, sans-serif`;
    this.recordsIn(u.scales.x.min, u.scales.x.max).forEach(([from, name, began]) => {
      const x = u.valToPos(from, "x", true), { top, height } = u.bbox;
      if (began) {
        context.beginPath(); context.moveTo(x, top); context.lineTo(x, top + height); context.stroke();
      }
      context.fillText(name, x + 4 * px, top + height - 5 * px);
    });
    context.restore();
  }
  /* The records in a window, where they lie end to end: from where each is seen, its name, and
     whether it begins there. */
  recordsIn(low, high) {
    const records = (this.data && this.data.records) || [];
    if (records.length < 2) return [];
    return records.map(([from, name], k) => [from, name, (records[k + 1] || [Infinity])[0]])
      .filter(([from, , to]) => from <= high && to > low)
      .map(([from, name]) => [Math.max(from, low), name, from >= low]);
  }
  redraw() { this.plots.forEach((p) => p.redraw(false)); }
  flat() { return this.low ? 56 : 74; } /* of the strip */
  /* The cursor at a sample, as if it was pointed at here; none: nowhere. */
  pointAt(index) {
    for (const u of this.plots) {
      const left = index == null ? -10 : u.valToPos(this.data.time[index], "x");
      u.setCursor({ left, top: index == null ? -10 : u.over.clientHeight / 2 });
    }
    this.stripAt(index == null ? null : this.data.time[index]);
  }
  /* The same moment in the whole record. */
  stripAt(t) {
    if (!this.small || this.strip.hidden) return;
    this.small.setCursor({ left: t == null ? -10 : this.small.valToPos(t, "x"), top: 5 });
  }
  /* What an axis shows, on which side, in which unit; where series of several names share it, the legend has their names. */
  axisLabel(data, group, u) {
    const here = group.filter((s) => s.unit === u), what = this.panels ? (group.includes(data.series[0]) ? effort() : here[0].name) : here.length === 1 ? here[0].name.replace(/_/g, " ") : "";
    return [[what, this.side || here[0].side].filter(Boolean).join(" "), unit(u) && `[${unit(u)}]`].filter(Boolean).join(" ");
  }
  draw(data) {
    const { of, axis } = this.colours();
    const small = this.low || this.host.clientWidth < 600;
    const letter = small ? { labelFont: "11px system-ui, sans-serif" } : {};
    this.data = data; this.save.hidden = false;
    this.plots.forEach((p) => p.destroy());
    const groups = this.panels ? this.panels.map((names) => data.series.filter((s) => names.includes(s.name))).filter((g) => g.length) : [data.series];
    this.plots = groups.map((group, panel) => {
      const units = [...new Set(group.map((s) => s.unit))], last = panel === groups.length - 1;
      const beside = group.some(noisy) ? Object.fromEntries(units.map((u) => [u, { range: (p, low, high) => uPlot.rangeNum(...reach(group, low ?? 0, high ?? 0), 0.1, true) }])) : {};
      const made = new uPlot({
        width: this.host.clientWidth || 800, height: this.height(panel), legend: { live: true }, padding: this.low ? [22, null, null, null] : undefined, cursor: { drag: { x: true, y: false, setScale: false }, sync: this.panels ? { key: "series", setSeries: false } : undefined },
        scales: { x: { time: false, range: this.range ? () => this.range : undefined }, ...beside },
        series: [{ label: "time [s]", value: (u, v) => digits(v, 6) }, ...group.map((s) => { const k = data.series.indexOf(s); return {
          label: s.name.replace(/_/g, " ") + (unit(s.unit) ? ` [${unit(s.unit)}]` : ""), stroke: of(s, k), width: data.time.length < 600 ? 1.5 : 1, scale: s.unit, auto: !noisy(s),
          dash: s.name === "model" ? [6, 3] : noisy(s) ? [2, 3] : k % 2 && s.name !== "residual" ? [8, 3] : undefined, value: (u, v) => digits(v, 4), points: { show: data.full && data.time.length < 200 && !this.local && !noisy(s) },
        }; })],
        axes: [{ ...axis, label: last ? "time [s]" : undefined, ...letter, labelSize: 20, size: last ? 40 : 24 }, ...units.map((u, k) => ({ ...axis, scale: u, side: k ? 1 : 3, label: this.axisLabel(data, group, u), ...letter, labelSize: 18, size: 58, grid: k ? { show: false } : axis.grid }))],
        hooks: { setSelect: [(u) => this.picked(u)], drawClear: [(u) => this.shade(u)], setCursor: [(u) => { if (this.onCursor) this.onCursor(u.cursor.left < 0 ? null : u.cursor.idx); }] },
      }, [data.time, ...group.map((s) => s.values)], this.main);
      made.over.addEventListener("dblclick", () => this.show(null).catch(fail));
      made.root.setAttribute("role", "img");
      made.root.setAttribute("aria-label", `${this.title || "Series"} over time${this.panels ? `: ${group.map((s) => s.name).join(" and ")}` : ""}, ${data.full ? "every sample" : "smallest and largest value per pixel"}`);
      return made;
    });
    this.host.dataset.points = String(data.time.length);
  }
  csv() {
    const d = this.data, cell = (v) => (v == null ? "" : String(v));
    return [["time [s]", ...d.series.map((s) => `${s.name}${s.unit ? ` [${s.unit}]` : ""}`)].join(","), ...d.time.map((t, i) => [t, ...d.series.map((s) => cell(s.values[i]))].join(","))].join("\n") + "\n";
  }
  /* What is drawn now as an svg, one frame a panel. */
  svg() {
    const W = 760, high = 230, L = 62, R = 12, T = 20, B = 34, ink = "#444444", { of } = this.colours();
    const groups = this.panels ? this.panels.map((names) => this.data.series.filter((s) => names.includes(s.name))).filter((g) => g.length) : [this.data.series], time = this.data.time, [x0, x1] = this.range || this.full;
    const out = svg("svg", { xmlns: SVG, viewBox: `0 0 ${W} ${high * groups.length}`, width: W, height: high * groups.length, "font-family": "system-ui, sans-serif" }, svg("rect", { width: "100%", height: "100%", fill: "#ffffff" }));
    groups.forEach((group, k) => {
      const seen = time.map((t, i) => i).filter((i) => time[i] >= x0 && time[i] <= x1), ys = group.filter((s) => !noisy(s)).flatMap((s) => seen.map((i) => s.values[i])).filter((v) => v != null), top = k * high + T, base = (k + 1) * high - B;
      let [y0, y1] = group.some(noisy) ? reach(group, Math.min(...ys), Math.max(...ys)) : [Math.min(...ys), Math.max(...ys)];
      if (!(y1 > y0)) { y0 -= 1; y1 += 1; }
      const X = (t) => L + ((t - x0) / (x1 - x0)) * (W - L - R), Y = (v) => base - ((v - y0) / (y1 - y0)) * (base - top), word = (x, y, text, anchor = "middle") => svg("text", { x, y, "text-anchor": anchor, "font-size": 11, fill: ink }, text);
      for (const t of ticks(y0, y1, 4)) out.append(svg("path", { d: `M${L} ${Y(t)}H${W - R}`, stroke: "#cccccc", fill: "none" }), word(L - 5, Y(t) + 4, digits(t), "end"));
      const begin = (t, dash) => svg("path", { d: `M${X(t)} ${top}V${base}`, stroke: ink, fill: "none", "stroke-dasharray": dash });
      for (const t of this.data.runs || []) if (t >= x0 && t <= x1) out.append(begin(t, "3 4"));
      for (const [t, name, began] of this.recordsIn(x0, x1)) {
        if (began) out.append(begin(t, "none"));
        out.append(word(X(t) + 4, base - 5, name, "start"));
      }
      for (const t of ticks(x0, x1, 8)) out.append(svg("path", { d: `M${X(t)} ${top}V${base}`, stroke: "#cccccc", fill: "none" }), word(X(t), base + 15, digits(t, 5)));
      group.forEach((s, n) => { let pen = "M"; const d = seen.map((i) => { if (s.values[i] == null) { pen = "M"; return ""; } const at = `${pen}${X(time[i]).toFixed(1)} ${Y(Math.min(y1, Math.max(y0, s.values[i]))).toFixed(1)}`; pen = "L"; return at; }).join(""); out.append(svg("path", { d, stroke: of(s, this.data.series.indexOf(s)), fill: "none", ...(noisy(s) ? { "stroke-dasharray": "2 3" } : {}) }), svg("text", { x: L + 150 * n, y: top - 6, "font-size": 11, fill: of(s, this.data.series.indexOf(s)) }, `${s.name.replace(/_/g, " ")}${unit(s.unit) ? ` [${unit(s.unit)}]` : ""}`)); });
      const across = (top + base) / 2, side = [...new Set(group.map((s) => s.unit))].map((u) => this.axisLabel(this.data, group, u)).join(", ");
      out.append(word((L + W - R) / 2, base + 29, "time [s]"), svg("text", { x: 12, y: across, transform: `rotate(-90 12 ${across})`, "text-anchor": "middle", "font-size": 11, fill: ink }, side));
    });
    return new XMLSerializer().serializeToString(out);
  }
  overview(all) {
    this.strip.hidden = !this.range;
    if (!this.range) return;
    if (!this.small) {
      const { of, axis } = this.colours(), drawn = all.series.filter((s) => !noisy(s)), scales = Object.fromEntries([...new Set(drawn.map((s) => s.unit))].map((u) => [u, {}]));
      this.small = new uPlot({
        width: this.host.clientWidth || 800, height: this.flat(), legend: { show: false }, cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false }, scales: { x: { time: false }, ...scales },
        series: [{}, ...drawn.map((s, k) => ({ stroke: of(s, k), width: 1, scale: s.unit, points: { show: false } }))],
        axes: [{ ...axis, size: 24 }, ...drawn.slice(0, 1).map((s) => ({ ...axis, scale: s.unit, size: 58, values: () => [] }))], hooks: { setSelect: [(u) => this.picked(u)] },
      }, [all.time, ...drawn.map((s) => s.values)], this.strip);
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
  destroy() { this.observer.disconnect(); this.plots.forEach((p) => p.destroy()); if (this.small) this.small.destroy(); }
}
