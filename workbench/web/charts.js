"use strict";
/* Charts that the server draws (workbench/show/chart.py): put on the page, with a cursor, a brush, and their files. */
const linked = { charts: [], marks: [], plot: null, pointed: null };

/* Save text or a blob under a name. */
function saveAs(content, name, kind) {
  const blob = content instanceof Blob ? content : new Blob([content], { type: kind });
  const link = h("a", { href: URL.createObjectURL(blob), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 5000);
}
const fileStem = (name) => name.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "") || "plot";

/* An svg of the page as a file of its own: the colours that it has here are written into it. */
function svgFile(node) {
  const copy = node.cloneNode(true), all = [node, ...node.querySelectorAll("*")], made = [copy, ...copy.querySelectorAll("*")];
  all.forEach((from, k) => {
    const css = getComputedStyle(from);
    for (const key of ["fill", "stroke", "stroke-width", "stroke-dasharray", "fill-opacity", "font-size", "font-weight"]) if (from.tagName !== "svg" && css.getPropertyValue(key)) made[k].setAttribute(key, css.getPropertyValue(key));
    made[k].removeAttribute("class");
  });
  copy.querySelectorAll("[data-live]").forEach((n) => n.remove());
  const [, , w, hgt] = (copy.getAttribute("viewBox") || "0 0 360 240").split(" ");
  copy.setAttribute("xmlns", SVG); copy.setAttribute("width", w); copy.setAttribute("height", hgt); copy.setAttribute("font-family", "system-ui, sans-serif");
  copy.prepend(svg("rect", { width: "100%", height: "100%", fill: getComputedStyle(document.documentElement).getPropertyValue("--card").trim() }));
  return new XMLSerializer().serializeToString(copy);
}

function pngOf(text, width, height, scale = 2) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => {
      const canvas = h("canvas", { width: String(width * scale), height: String(height * scale) });
      canvas.getContext("2d").drawImage(image, 0, 0, width * scale, height * scale);
      canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("the picture cannot be drawn"))), "image/png");
    };
    image.onerror = () => reject(new Error("the picture cannot be drawn"));
    image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  });
}

/* PNG, SVG and CSV of a plot: `picture` gives the svg text, `table` the CSV. */
function saver(name, picture, table) {
  const stem = fileStem(name), item = (kind, work) => h("button", { type: "button", class: "quiet", "aria-label": `Save ${name} as ${kind}`, onclick: () => Promise.resolve().then(work).catch(fail) }, kind);
  const size = (text) => { const box = text.match(/viewBox="0 0 ([\d.]+) ([\d.]+)"/); return [Number(box[1]), Number(box[2])]; };
  return h("details", { class: "save" }, h("summary", { "aria-label": `Save ${name}` }, "Save"), h("div", { class: "row" },
    item("PNG", async () => { const text = picture(); saveAs(await pngOf(text, ...size(text)), `${stem}.png`); }),
    item("SVG", () => saveAs(picture(), `${stem}.svg`, "image/svg+xml")),
    item("CSV", () => saveAs(table(), `${stem}.csv`, "text/csv"))));
}

/* The picture of the server as a node: read as XML, so that nothing in it can be more than a picture. */
function drawn(text) {
  const made = new DOMParser().parseFromString(text.replace("<svg ", `<svg xmlns="${SVG}" `), "image/svg+xml").documentElement;
  if (made.tagName !== "svg") throw new Error("the picture cannot be read");
  return document.importNode(made, true);
}

/* A chart with cursor and, over a signal of the records, a brush that marks its samples in the time plot. */
class ServedChart {
  constructor(spec, { name, axis, brush, most = "46rem" } = {}) {
    this.spec = spec; this.axis = axis; this.brush = brush; this.name = name; this.range = null;
    this.node = h("div", { class: "chart" });
    this.said = h("p", { class: "readout small soft" }, brush ? "Drag across it: the time plot marks these samples." : " ");
    this.put(spec);
    if (spec.frame) linked.charts.push(this);
  }
  put(spec) {
    this.spec = spec;
    const made = drawn(spec.svg), f = spec.frame;
    if (f) {
      this.area = svg("rect", { class: "s-brush", "data-live": "1", x: 0, y: f.top, width: 0, height: f.bottom - f.top });
      this.line = svg("path", { class: "s-cursor", "data-live": "1", d: "" });
      made.append(this.area, this.line);
      made.addEventListener("pointermove", (e) => this.move(e));
      made.addEventListener("pointerleave", () => { this.cursor(null); this.point(null); });
      if (this.brush) {
        made.addEventListener("pointerdown", (e) => { this.from = this.valueAt(e); made.setPointerCapture(e.pointerId); e.preventDefault(); });
        made.addEventListener("pointerup", (e) => { if (this.from == null) return; const to = this.valueAt(e), from = this.from; this.from = null; this.choose(Math.abs(this.X(to) - this.X(from)) < 4 ? null : [Math.min(from, to), Math.max(from, to)]); });
      }
    }
    this.picture = made;
    const ways = spec.dashed ? h("p", { class: "small soft ways" }, "Solid: forward; dashed: backward.") : null;
    const body = this.brush && f ? h("div", { class: "brushed", tabindex: "0", role: "group", "aria-label": `${this.name}: arrow keys choose a stretch that the time plot marks, Escape clears it`, onkeydown: (e) => this.key(e) }, made) : made;
    this.node.replaceChildren(...[body, ways].filter(Boolean), h("div", { class: "row between under" }, this.said, saver(this.name, () => svgFile(this.picture), () => this.spec.csv)));
  }
  X(v) { const f = this.spec.frame; return f.left + ((v - f.x[0]) / (f.x[1] - f.x[0])) * (f.right - f.left); }
  valueAt(e) {
    const f = this.spec.frame, box = this.picture.getBoundingClientRect(), at = ((e.clientX - box.left) / box.width) * f.width;
    return f.x[0] + (Math.min(f.right, Math.max(f.left, at)) - f.left) / (f.right - f.left) * (f.x[1] - f.x[0]);
  }
  cursor(v) {
    const f = this.spec.frame;
    this.line.setAttribute("d", v == null || v < f.x[0] || v > f.x[1] ? "" : `M${this.X(v)} ${f.top}V${f.bottom}`);
  }
  move(e) {
    const v = this.valueAt(e), f = this.spec.frame, box = this.picture.getBoundingClientRect(), up = ((e.clientY - box.top) / box.height) * f.height;
    this.cursor(v);
    this.point(v);
    if (this.from != null) this.shade([Math.min(this.from, v), Math.max(this.from, v)]);
    this.said.textContent = `${digits(v)} | ${digits(f.y[1] - ((up - f.top) / (f.bottom - f.top)) * (f.y[1] - f.y[0]))}`;
  }
  /* The other plots stand at the same moment: the one of the time plot's window whose value of this
     signal is nearest; where none is near, the one of the whole record, which the strip shows. */
  point(v) {
    const { plot } = linked;
    if (!this.axis || !plot || !plot.data) return;
    plot.pointAt(null);
    if (v == null) return;
    const seenIn = (data) => (this.axis === "time" ? data.time : data.along[this.axis] || []);
    const nearest = (data, [low, high]) => {
      const seen = seenIn(data);
      let best = -1;
      for (let k = 0; k < seen.length; k++) {
        if (seen[k] == null || data.time[k] < low || data.time[k] > high) continue;
        if (best < 0 || Math.abs(seen[k] - v) < Math.abs(seen[best] - v)) best = k;
      }
      return best;
    };
    const [low, high] = this.spec.frame.x, here = nearest(plot.data, plot.range || plot.full);
    const near = here >= 0 && Math.abs(seenIn(plot.data)[here] - v) < (high - low) / 50;
    linked.pointed = this;
    if (near) plot.pointAt(here);
    else cursorInCharts(plot.whole)(nearest(plot.whole, plot.full));
    if (!near) plot.stripAt(plot.whole.time[nearest(plot.whole, plot.full)]);
    linked.pointed = null;
  }
  shade(range) {
    const a = range ? this.X(range[0]) : 0, b = range ? this.X(range[1]) : 0;
    this.area.setAttribute("x", a); this.area.setAttribute("width", Math.max(0, b - a));
  }
  choose(range) {
    linked.charts.forEach((c) => c !== this && c.area && c.shade(null));
    this.range = range; this.shade(range);
    this.brush(range, this);
  }
  key(e) {
    const f = this.spec.frame, step = (f.x[1] - f.x[0]) / 12, move = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (e.key === "Escape" && this.range) { this.choose(null); return; }
    if (!move) return;
    e.preventDefault();
    const low = this.range ? Math.min(f.x[1] - step, Math.max(f.x[0], this.range[0] + move * step)) : f.x[0];
    this.choose([low, low + step]);
  }
}

const chartFigure = (caption, spec, options) => { const made = new ServedChart(spec, options); return h("figure", { class: `card place ${(options && options.kind) || ""}` }, h("figcaption", {}, caption), made.node); };

/* A brush on a place: its samples in the time plot of the view. */
function markInTime(axis) {
  return async (range, chart) => {
    if (!linked.plot) return;
    linked.marks = range ? await get(`/view/spans?axis=${axis}&low=${range[0]}&high=${range[1]}`) : [];
    const total = linked.marks.reduce((sum, [a, b]) => sum + b - a, 0);
    chart.said.textContent = range ? `${digits(range[0])} to ${digits(range[1])}: ${plural(linked.marks.length, "stretch", "stretches")}, ${digits(total)} s, marked in the time plot` : "Drag across it: the time plot marks these samples.";
    linked.plot.redraw();
  };
}

/* The cursor of the time plot in every chart over a signal. */
function cursorInCharts(data) {
  return (index) => linked.charts.forEach((c) => { if (c.axis && c.line && c !== linked.pointed) c.cursor(index == null ? null : c.axis === "time" ? data.time[index] : data.along && data.along[c.axis] ? data.along[c.axis][index] : null); });
}
const forgetCharts = () => { linked.charts = []; linked.marks = []; linked.plot = null; };

/* --- outcomes and words --------------------------------------------------------------------------------------- */

/* What the whole of a result is: what is left unexplained weighs more than what was found. */
function outcomeOf(d) {
  if (["unexplained", "not_identifiable"].includes(d.verdict)) return d.verdict;
  return d.outcome || "complete";
}
function outcomeCard(d, claim, folded) {
  const kind = outcomeOf(d), words = app.config.words.outcomes[kind] || { headline: d.headline, next: "" };
  const said = words.next && h("p", { class: "next" }, h("strong", {}, "Next: "), words.next);
  const next = said || null;
  const rest = folded && (folded.length || next) ? h("details", {}, h("summary", {}, "Why, and what next"), folded, next) : next;
  return h("section", { class: `card outcome ${kind}`, "aria-label": "Outcome" }, claim, rest);
}

/* A term with its meaning, from the one glossary. */
function term(word, shown) {
  const meaning = app.config.words.glossary[word];
  return meaning ? h("abbr", { title: meaning }, shown || word) : shown || word;
}
function glossaryCard() {
  return h("details", { class: "card", id: "glossary" }, h("summary", {}, "What the words mean"), h("dl", { class: "words" }, Object.entries(app.config.words.glossary).map(([k, v]) => [h("dt", {}, k), h("dd", {}, v)])));
}

/* --- laws through the residual -------------------------------------------------------------------------------- */

/* One picture beside the ranking: the law of the candidate that is pointed at. They are fetched ahead, so that pointing is at once. */
class LawPanel {
  constructor(labels, note = "line: what the law would take off it. Point at a candidate to see its law.") {
    this.kept = new Map(); this.shown = null; this.step = app.state.steps.at(-1).id; this.labels = labels;
    this.title = h("h2", {}, "The law through the residual");
    this.host = h("div", { "aria-live": "polite" }, h("p", { class: "soft small" }, "Drawing …"));
    this.node = h("aside", { class: "card law-panel", id: "law-panel" }, this.title, h("p", { class: "soft small" }, `◆ residual of the model as it stands; ${note}`), this.host);
    this.node.panel = this;
  }
  begin() { this.ahead(this.labels).catch(fail); }
  async ahead(labels) {
    for (const label of labels) { if (!this.node.isConnected) return; await this.fetch(label).catch(() => null); if (!this.shown) this.show(label); }
  }
  fetch(label) {
    if (!this.kept.has(label)) this.kept.set(label, get(`/view/law?label=${encodeURIComponent(label)}&step=${this.step}${this.wide()}`).then((made) => { if (!made.stale) this.kept.set(label, made); return made; }));
    return Promise.resolve(this.kept.get(label));
  }
  wide() { return this.host.clientWidth ? `&width=${this.host.clientWidth}` : ""; }
  show(label) {
    this.shown = label;
    const ready = this.kept.get(label), put = (made) => { if (this.shown === label && !made.stale) { this.host.replaceChildren(h("p", {}, h("strong", {}, made.title)), made.drawn === false ? h("p", { class: "note small", id: "no-line" }, NO_LINE) : "", new ServedChart(made.chart, { name: `${made.title} through the residual` }).node); this.node.dataset.label = label; } };
    if (ready && !ready.then) put(ready); else this.fetch(label).then(put).catch((e) => { if (this.shown === label) this.host.replaceChildren(h("p", { class: "small bad" }, e.message)); });
  }
}

/* What a list needs so that pointing at an item, or the focus on it, draws its law. */
const pointsAt = (label) => {
  const show = () => { const panel = lawPanel(); if (panel) panel.show(label); };
  return { "data-label": label, onpointerenter: show, onfocusin: show };
};
const NO_LINE = "No line: on all these rows together the learned curves take nothing off. They were learned where the joint moves steadily.";
const LEARNED_NOTE = "line: what the learned curves of this balance take off it together. Point at a curve to see it.";

/* --- any signal against any ----------------------------------------------------------------------------------- */

function againstCard(files) {
  const draft = app.drafts.against || (app.drafts.against = {}), file = files.find((f) => f.id === draft.file) || files[0];
  const channels = file.summary.channels.map((c) => c.name), titles = (list) => list.map((c) => [c, c.replace(/_/g, " ")]), host = h("div", {}), legend = h("p", { class: "small soft" });
  const torque = channels.find((c) => /torque|current/.test(c)), moving = channels.find((c) => /velocity/.test(c)) || channels.find((c) => /position/.test(c));
  const now = { x: channels.includes(draft.x) || draft.x === "time_in_run" ? draft.x : moving || channels[0], y: channels.includes(draft.y) ? draft.y : torque || channels[channels.length - 1], colour: channels.includes(draft.colour) ? draft.colour : "", other: files.some((f) => f.id === draft.other) ? draft.other : "" };
  /* What colours the points is a third signal of one record, across a signal. */
  const plain = () => now.other || now.x === "time_in_run";
  const allow = () => {
    const select = box.querySelector("#against-colour"), why = box.querySelector("#against-why");
    select.disabled = Boolean(plain());
    why.hidden = !plain();
  };
  const draw = async () => {
    const query = new URLSearchParams({ file: file.id, ...now, width: String(Math.round(pictureWidth(760))) });
    const made = await get(`/view/against?${query}`);
    host.replaceChildren(new ServedChart(made.chart, { name: `${now.y} against ${now.x}` }).node);
    legend.textContent = made.legend.join("; ");
  };
  const pick = (key, label, options) => h("label", { class: "small pick" }, label, h("select", { id: `against-${key}`, "aria-describedby": key === "colour" ? "against-why" : null, onchange: (e) => { draft[key] = e.target.value; if (key === "file") render(false); else { now[key] = e.target.value; allow(); draw().catch(fail); } } }, options.map(([v, t]) => h("option", { value: v, selected: v === (key === "file" ? file.id : now[key]) }, t))));
  const box = h("details", { class: "card", id: "against", open: Boolean(draft.open), ontoggle: (e) => { draft.open = e.target.open; if (e.target.open && !host.childNodes.length) draw().catch(fail); } }, h("summary", {}, "Any signal against any"),
    h("div", { class: "row" }, pick("file", "Record", files.map((f) => [f.id, f.name])), pick("x", "Across", [["time_in_run", "time, runs over each other"], ...titles(channels)]), pick("y", "Up", titles(channels)), pick("colour", "Coloured by", [["", "nothing"], ...titles(channels)]), pick("other", "Over it", [["", "no other record"], ...files.filter((f) => f.id !== file.id).map((f) => [f.id, f.name])])),
    h("p", { class: "small soft", id: "against-why" }, "Colour needs one record across a signal: over",
      " time, and with a second record, the colours tell the records apart."), host, legend);
  allow();
  return box;
}

/* Hold parameters at values, or let them free: the model as it stands is fitted again on a branch of its own. */
const held = (values) => act(async () => { await post("/joint", { hold: values, source: app.state.joint_source || "joint" }); await refresh(); }).then((done) => { if (done) run("fit", {}, "parameters"); });

/* Windows of a record that no fit takes: the one that is shown is left out, each can be taken back. */
function leftOut(file, plot) {
  const windows = file.left_out || [], put = (list) => act(async () => { await post(`/file/${file.id}`, { left_out: list }); await refresh(); });
  plot.marks = () => windows;
  const only = () => {
    if (!plot.range) {
      fail(new Error("drag across the plot first: what is shown is fitted, all else left out"));
      return;
    }
    const [low, high] = plot.full, [a, b] = plot.range;
    put([...windows, [low, a], [b, high]].filter(([from, to]) => to > from));
  };
  return h("div", { class: "row under", id: "left-out" },
    button("Fit only this window", only, { kind: "quiet", id: "fit-only" }),
    button("Leave out this window", () => { if (plot.range) put([...windows, plot.range]); else fail(new Error("drag across the plot first: the window that is shown is left out")); }, { kind: "quiet", id: "leave-out" }),
    windows.map(([a, b], k) => button(`Take back ${digits(a, 4)} to ${digits(b, 4)} s`, () => put(windows.filter((_, n) => n !== k)), { kind: "quiet", id: `take-back-${k}` })));
}

/* --- sliders -------------------------------------------------------------------------------------------------- */

/* The number typed into a field, or the sentence that says why it is none: empty is not 0, and bounds are bounds. */
function typedNumber(text, name, low, high) {
  const plain = text.trim().replace(",", ".").replace("−", "-"), value = Number(plain);
  if (!plain) return { problem: `${name} is empty: type a number, or press Back to the fit.` };
  if (!Number.isFinite(value)) return { problem: `${name}: “${text.trim()}” is not a number.` };
  if (low != null && value < low) return { problem: `${name} cannot be less than ${digits(low, 4)}.` };
  if (high != null && value > high) return { problem: `${name} cannot be more than ${digits(high, 4)}.` };
  return { value };
}

/* Every parameter as a slider: the held-out error and the residual follow; nothing is changed until it is said. */
function slidersCard(rows, error) {
  const asked = app.state.steps.at(-1).id, kept = app.drafts.slid && app.drafts.slid.step === asked ? app.drafts.slid : (app.drafts.slid = { step: asked, values: {}, load: {} }); /* colours that change draw the view anew: what was slid stands */
  const values = kept.values, figure = h("output", { class: "figure", id: "slider-error" }, `${digits(error)} %`), charts = h("div", { class: "grid" }), state = { turn: 0, loads: 0, busy: false, again: false }, step = app.state.steps.at(-1).id;
  const look = async () => {
    if (state.busy) { state.again = true; return; }
    state.busy = true;
    figure.setAttribute("aria-busy", "true");
    const began = performance.now(), turn = state.turn;
    try {
      const made = await get(`/view/what-if?values=${encodeURIComponent(JSON.stringify(values))}&step=${step}`);
      if (turn === state.turn && !made.stale) {
        figure.textContent = made.relative_error_percent == null ? "no number" : `${digits(made.relative_error_percent)} %`;
        charts.replaceChildren(...made.charts.map((c) => h("figure", { class: "place" }, h("figcaption", {}, `${c.balance} balance: with the sliders (◆), with the fit (■)`), new ServedChart(c.chart, { name: `${c.balance} residual with the sliders` }).node)));
        figure.dataset.milliseconds = String(Math.round(performance.now() - began));
      } /* else: the sliders went back to the fit meanwhile */
    } catch (e) { if (figure.isConnected) fail(e); } /* else: the fit that was asked is no more */
    state.busy = false;
    if (state.again && figure.isConnected) { state.again = false; look(); } else figure.removeAttribute("aria-busy");
  };
  const inputs = [], set = {};
  /* A mass on the link moves its inertia and its weight together. */
  const load = async () => { for (const k of ["mass", "distance"]) kept.load[k] = $(`payload-${k}`).value; const turn = state.turn, asked = (state.loads += 1); try { clearError(); const made = await get(`/view/payload?mass=${encodeURIComponent($("payload-mass").value)}&distance=${encodeURIComponent($("payload-distance").value)}`); if (turn !== state.turn || asked !== state.loads) return; /* what was asked later counts, in whichever order answers come */ for (const [k, v] of Object.entries(made.values)) if (set[k]) set[k](v); look(); } catch (e) { fail(e); } };
  const turning = !Object.values(rows).some((p) => p.unit === "kg");
  const payload = h("fieldset", { class: "known", id: "payload" }, h("legend", {}, "Another payload", h("span", { class: "small soft plain" }, " on the link; negative: taken off")), [["mass", "Mass [kg]"], ["distance", "From the joint's axis [m]"]].filter(([k]) => turning || k === "mass").map(([k, t]) => h("label", { class: "small pick", for: `payload-${k}` }, t, h("input", { id: `payload-${k}`, value: kept.load[k] || "0", inputmode: "decimal", autocomplete: "off", onchange: load }))), turning ? null : h("input", { type: "hidden", id: "payload-distance", value: "0" }));
  const row = ([name, p]) => {
    const size = Math.abs(p.value), spread = Math.max(3 * (p.stderr || 0), 0.5 * size, 1e-9), low = Math.max(p.low ?? -Infinity, p.value - spread), high = Math.min(p.high ?? Infinity, p.value + spread);
    const id = `slide-${name}`, short = (v) => String(Number(v.toPrecision(6)));
    const typed = h("input", { id: `value-${name}`, value: short(p.value), size: "8", inputmode: "decimal", autocomplete: "off", "aria-label": `Value of ${words(name)} [${unit(p.unit)}]`, "aria-describedby": `why-${name}`, onchange: () => { const v = read(); if (v != null) { values[name] = v; input.value = String(v); look(); } } });
    const why = h("p", { class: "small bad why", id: `why-${name}`, role: "alert", hidden: true });
    const read = () => { const { value, problem } = typedNumber(typed.value, words(name), p.low, p.high); why.textContent = problem || ""; why.hidden = !problem; typed.setAttribute("aria-invalid", String(Boolean(problem))); return problem ? null : value; };
    const hold = button(p.held ? "Release" : "Hold", () => { if (p.held) { held({ [name]: null }); return; } const v = read(); if (v != null) held({ [name]: v }); }, { kind: "quiet", id: `hold-${name}`, label: `${p.held ? "Release" : "Hold"} ${words(name)}` });
    const input = h("input", { type: "range", id, min: String(low), max: String(high), step: String((high - low) / 400), value: String(p.value), "aria-label": `${words(name)} [${unit(p.unit)}]`, oninput: (e) => { values[name] = Number(e.target.value); typed.value = short(values[name]); read(); look(); } });
    set[name] = (v) => { values[name] = v; input.min = String(Math.min(Number(input.min), v)); input.max = String(Math.max(Number(input.max), v)); input.step = "any"; input.value = String(v); typed.value = short(v); read(); };
    inputs.push(() => { input.value = String(p.value); typed.value = short(p.value); why.hidden = true; typed.removeAttribute("aria-invalid"); });
    return h("div", { class: "slide" }, h("label", { for: id, class: "small" }, words(name), h("span", { class: "soft plain" }, ` ${p.side} ${unit(p.unit) ? `[${unit(p.unit)}]` : ""}`), p.held ? h("span", { class: "tag" }, "held") : null), input, typed, hold, why);
  };
  const moved = Object.entries(rows).filter(([, p]) => !p.nuisance), lines = moved.map(row);
  if (Object.keys(values).length) { for (const [k, v] of Object.entries(values)) if (set[k]) set[k](v); later(() => look()); }
  const reset = () => { state.turn += 1; state.again = false; for (const k of Object.keys(values)) delete values[k]; kept.load = {}; inputs.forEach((f) => f()); payload.querySelectorAll("input").forEach((i) => { i.value = "0"; }); figure.textContent = `${digits(error)} %`; charts.replaceChildren(); };
  return h("section", { class: "card", id: "sliders" }, h("h2", {}, "What if?"), h("p", { class: "soft small" }, "Move a parameter: the held-out error and the residual follow at once. The fit stays as it is. Hold fixes a parameter at its value, typed or slid, and fits the model again as a new branch."), h("div", { class: "two" }, h("div", {}, lines, payload, button("Back to the fit", reset, { kind: "quiet", work: false, id: "slider-reset" })), h("div", {}, h("p", { class: "soft" }, "Held-out error"), figure, charts)));
}
