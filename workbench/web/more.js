"use strict";
/* Physics or sensor, online replay, planning: the views beside the loop. */
const seconds = (v) => `${digits(v, 3)} s`;
const words = (name) => name.replace(/#\d+/g, "").replace(/_delay_0$/, "_delay").replace(/_/g, " "); /* the estimator has one delay of the drive, of the one record it is fed */
const field = (id, label, value, hint, more) => h("div", { class: "field" }, h("label", { for: id }, label), h("input", { id, value: value == null ? "" : String(value), "aria-describedby": `${id}-hint`, autocomplete: "off", inputmode: "decimal", ...more }), h("span", { class: "small soft", id: `${id}-hint` }, hint));
const choice = (id, label, options, chosen, hint, onchange, size = "") => h("div", { class: `field ${size}` }, h("label", { for: id }, label), h("select", { id, onchange, "aria-describedby": hint ? `${id}-hint` : null }, options.map(([v, t]) => h("option", { value: v, selected: v === chosen }, t))), hint && h("span", { class: "small soft", id: `${id}-hint` }, hint));

/* A picture with Save under it, as under every plot. */
function kept(name, picture, table) {
  const save = saver(name, () => svgFile(picture), table);
  return [picture, h("div", { class: "row under end" }, save)];
}
const csvCell = (v) => {
  const text = v == null ? "" : String(v);
  return /[",\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
};
const csvLine = (row) => row.map(csvCell).join(",") + "\n";
const csvOf = (head, rows) => [head, ...rows].map(csvLine).join("");
function timelineCsv(r) {
  const score = (name, i) => (r.score[name] || [])[i];
  return csvOf(["time [s]", ...r.readings.map((n) => `${n}, share of the limit`), "replaced"],
    r.time.map((t, i) => [t, ...r.readings.map((n) => score(n, i)), r.failed[i].join(" ")]));
}

/* --- physics or sensor ---------------------------------------------------------------------------------------- */

/* Each balance on one log axis: where it stood at the start, where it stands now, and the band that is noise. */
function patternPlot(p) {
  const W = pictureWidth(pictureRoom() < 760 ? 760 : 470), L = 96, R = 62, T = 22, row = 40, B = 40, H = T + row * p.balances.length + B;
  const all = p.balances.flatMap((b) => [b.now, b.start]).filter((v) => v > 0), low = Math.min(0.5, ...all) * 0.9, high = Math.max(6, ...all) * 1.25;
  const X = (v) => L + (Math.log(Math.max(v, low) / low) / Math.log(high / low)) * (W - L - R);
  const said = p.balances.map((b) => `${b.name} ${digits(b.now)} times the noise`).join(", ");
  const out = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": `Residual of each balance over its noise: ${said}; over ${p.limit} counts as failing` });
  out.append(svg("rect", { class: "s-calm", x: L, y: T, width: X(p.limit) - L, height: H - T - B }));
  out.append(svg("text", { x: (L + X(p.limit)) / 2, y: T - 8, "text-anchor": "middle" }, "noise"));
  for (const t of [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].filter((v) => v >= low && v <= high)) out.append(svg("path", { class: t === 1 ? "s-zero" : "s-grid", d: `M${X(t)} ${T}V${H - B}` }), svg("text", { x: X(t), y: H - B + 15, "text-anchor": "middle" }, String(t)));
  p.balances.forEach((b, k) => {
    const y = T + row * (k + 0.5), over = b.now > p.limit;
    out.append(svg("text", { class: "strong", x: L - 10, y: y + 4, "text-anchor": "end" }, b.name));
    if (b.start != null && Math.abs(X(b.start) - X(b.now)) > 5) out.append(svg("path", { class: "s-move", d: `M${X(b.start)} ${y}H${X(b.now)}` }), svg("circle", { class: "s-was", cx: X(b.start), cy: y, r: 5 }));
    out.append(over ? svg("path", { class: "s-over", d: `M${X(b.now)} ${y - 8}l8 8l-8 8l-8 -8Z` }) : svg("circle", { class: "s-dot", cx: X(b.now), cy: y, r: 6 }));
    out.append(svg("text", { class: "strong", x: W - 4, y: y + 4, "text-anchor": "end" }, `${digits(b.now)} ×`));
  });
  out.append(svg("text", { x: (L + W - R) / 2, y: H - 6, "text-anchor": "middle" }, "residual ÷ measurement noise"));
  return out;
}

function patternCard(p) {
  const names = p.balances.map((b) => b.name), fails = (b) => p.hit.includes(b), shared = p.readings.find((r) => r.shared);
  const moved = p.balances.some((b) => b.start != null && Math.abs(b.start - b.now) > 0.02 * b.now);
  return h("section", { class: "card", id: "pattern" }, h("h2", {}, "Physics or sensor?"), h("p", {}, p.sentence), h("div", { class: "two even" },
    h("figure", {}, kept("Physics or sensor", patternPlot(p), () => csvOf(["balance", "residual ÷ noise", "at the start"], p.balances.map((b) => [b.name, b.now, b.start]))), h("p", { class: "small soft" }, `◆ over the noise, ● at it${moved ? ", ○ at the start" : ""}. Those with structure left are averaged over ${digits(p.kernel_ms)} ms.`)),
    h("div", {}, h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Readings and balances" }, h("table", { class: "matrix" }, h("caption", {}, "Which reading enters which balance"), h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Reading"), names.map((b) => h("th", { scope: "col", class: fails(b) ? "hit" : null }, b, fails(b) ? h("span", { class: "hidden" }, ", over the noise") : null)))),
      h("tbody", {}, p.readings.map((r) => h("tr", { class: r.shared ? "now" : null }, h("th", { scope: "row" }, r.name), names.map((b) => h("td", { class: fails(b) ? "hit" : null }, r.balances.includes(b) ? [h("span", { "aria-hidden": "true" }, "●"), h("span", { class: "hidden" }, "enters")] : h("span", { class: "hidden" }, "–")))))))),
      h("p", { class: "small soft" }, p.balances.length === 1 ? "With one balance only, physics and sensor look alike. A link encoder or a torque sensor beside it would tell them apart." : shared ? `The ${shared.name} is the one reading that all failing balances share, and no other: look at that sensor first.` : p.hit.length === 1 ? "A sensor that reads wrong spoils every balance it enters. Here one balance fails alone, so physics on that side is more likely." : p.hit.length ? "No single reading is shared by just these balances: more than one thing is missing, or physics on both sides." : "A sensor that reads wrong would lift every balance that it enters."))));
}

/* --- online replay ------------------------------------------------------------------------------------------- */

/* One lane per reading: how close its residuals are to their limits, and when it was declared failed. */
function timeline(r) {
  const lanes = r.readings, W = pictureWidth(WIDEST), L = W < 500 ? 106 : 118, R = 14, T = 26, row = 34, B = 38, H = T + row * lanes.length + B;
  const X = (t) => L + (t / r.end) * (W - L - R), marks = r.verdicts.filter((v) => v.about.length);
  const label = r.detector ? (marks.length ? `Fault timeline: ${marks.map((m) => `${words(m.about.join(", "))} at ${seconds(m.time)}`).join("; ")}` : "Fault timeline: no reading was doubted") : "Fault timeline: the detector did not run";
  const out = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": label });
  for (const t of ticks(0, r.end, W < 500 ? 4 : 10)) out.append(svg("path", { class: "s-grid", d: `M${X(t)} ${T}V${H - B}` }), svg("text", { x: X(t), y: H - B + 16, "text-anchor": "middle" }, digits(t)));
  out.append(svg("rect", { class: "s-wait", x: L, y: T, width: Math.max(0, X(r.warm) - L), height: H - T - B }));
  if (X(r.warm) - L > 150) out.append(svg("text", { x: (L + X(r.warm)) / 2, y: T - 8, "text-anchor": "middle" }, "parameters warm up"));
  lanes.forEach((name, k) => {
    const top = T + row * k + 4, base = top + row - 8, score = r.score[name] || [];
    out.append(svg("text", { class: "strong", x: L - 8, y: base - 8, "text-anchor": "end" }, name), svg("path", { class: "s-grid", d: `M${L} ${base}H${W - R}` }));
    if (r.detector && score.length) {
      const Y = (v) => base - Math.min(1, v || 0) * (row - 10), points = r.time.map((t, i) => `${X(t)} ${Y(score[i])}`).join("L");
      out.append(svg("path", { class: "s-fill", d: `M${X(r.time[0])} ${base}L${points}L${X(r.time[r.time.length - 1])} ${base}Z` }));
    }
    const step = r.time.length > 1 ? r.time[1] - r.time[0] : 0;
    for (let i = 0; i < r.time.length; i++) {
      if (!r.failed[i].includes(name)) continue;
      let j = i;
      while (j + 1 < r.time.length && r.failed[j + 1].includes(name)) j++;
      const from = marks.filter((m) => words(m.about[0]) === name.replace("motor current", "current") && m.time <= r.time[i]).map((m) => m.time).pop(), a = X(from == null ? r.time[i] : Math.max(from, r.time[i] - step)), b = Math.max(a + 3, X(r.time[j]));
      out.append(svg("rect", { class: "s-fail", x: a, y: top, width: b - a, height: row - 8 }));
      if (b - a > 60) out.append(svg("text", { class: "on-fail", x: a + 6, y: base - 8 }, "replaced"));
      i = j;
    }
  });
  const fault = r.verdicts.filter((v) => !v.text.startsWith("The start-up")), crowded = [];
  fault.forEach((v) => {
    const x = X(v.time);
    out.append(svg("path", { class: "s-event", d: `M${x} ${T - 4}V${H - B}` }));
    if (crowded.every((c) => Math.abs(c - x) > 54)) { crowded.push(x); out.append(svg("text", { class: "strong", x, y: T - 9, "text-anchor": x > W - 60 ? "end" : "middle" }, seconds(v.time))); }
  });
  out.append(svg("text", { x: (L + W - R) / 2, y: H - 4, "text-anchor": "middle" }, "time since the begin of the replay [s]"));
  return out;
}

/* A parameter as it was followed, beside the value of the fit. */
function followed(name, p, time, end, stderr) {
  /* on a phone two stand beside one another */
  const W = pictureWidth(WIDEST) < 480 ? 150 : 250, H = 100, R = 6, T = 8, B = 20, known = p.history.filter((v) => v != null);
  const reach = [...known, p.fitted].filter((v) => v != null);
  let [y0, y1] = [Math.min(...reach), Math.max(...reach)];
  const least = 0.05 * Math.max(Math.abs(p.fitted ?? y1), 1e-12);
  if (y1 - y0 < least) { const c = (y0 + y1) / 2; y0 = c - least / 2; y1 = c + least / 2; }
  const marks = ticks(y0, y1, 3).map((t) => [t, digits(t)]);
  const L = 9 + 6.5 * Math.max(3, ...marks.map(([, text]) => text.length)); /* the axis has its room */
  const X = (t) => L + (t / end) * (W - L - R), Y = (v) => T + ((y1 - v) / (y1 - y0)) * (H - T - B);
  /* zero within its error: a share of it says nothing */
  const error = 1.96 * Math.max(stderr || 0, p.sigma || 0);
  const none = p.fitted != null && Math.abs(p.fitted) <= error;
  const change = p.fitted && !none ? (100 * (p.value - p.fitted)) / Math.abs(p.fitted) : null;
  const said = `${words(name)}: ${digits(p.value, 4)} ${unit(p.unit)}${change == null ? "" : `, ${digits(change, 2)} percent from the fit`}`;
  const out = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": said });
  for (const [t, text] of marks) {
    out.append(svg("path", { class: "s-grid", d: `M${L} ${Y(t)}H${W - R}` }),
      svg("text", { x: L - 4, y: Y(t) + 4, "text-anchor": "end" }, text));
  }
  if (p.fitted != null) out.append(svg("path", { class: "s-ref", d: `M${L} ${Y(p.fitted)}H${W - R}` }));
  out.append(svg("path", { class: "s-thin", d: "M" + time.map((t, i) => [t, p.history[i]]).filter(([, v]) => v != null).map(([t, v]) => `${X(t)} ${Y(v)}`).join("L") }));
  out.append(svg("text", { x: L, y: H - 5 }, "0"), svg("text", { x: W - R, y: H - 5, "text-anchor": "end" }, seconds(end)));
  return h("figure", { class: "spark" }, h("figcaption", {}, words(name), h("span", {}, `${digits(p.value, 4)} ± ${digits(p.sigma, 2)} ${unit(p.unit)}${change == null ? "" : ` · ${change >= 0 ? "+" : ""}${digits(change, 2)} % from the fit`}${none ? " · zero within its error in the fit" : ""}`)),
    kept(`${words(name)} as it was followed`, out,
      () => csvOf(["time [s]", `${words(name)} [${p.unit}]`, "of the fit"],
        time.map((t, i) => [t, p.history[i], p.fitted]))));
}

views.replay = async (state) => {
  const { last, sensors, faults, seconds: length, sources } = await get("/view/replay"), following = Boolean(state.job && state.job.action === "follow"), files = state.files.filter((f) => f.status === "ready"), draft = app.drafts.replay || (app.drafts.replay = {});
  const usual = files.find((f) => f.role === "held_out") || files[0], file = files.find((f) => f.id === draft.file) || usual, kind = draft.kind || "none";
  const keep = (key) => (e) => { draft[key] = e.target.value; if (key === "kind" || key === "file") render(false); };
  const go = () => run("replay", { file: $("replay-file").value, first: $("replay-from").value, seconds: $("replay-length").value, kind: $("replay-kind").value, sensor: $("replay-sensor") ? $("replay-sensor").value : sensors[3], at: $("replay-at") ? $("replay-at").value : "" });
  if (following) later(() => setTimeout(() => { if (app.view === "replay" && app.state && app.state.job && app.state.job.action === "follow" && $("main").dataset.view === "replay") render(false); }, 1000)); /* what came since is drawn every second, until the job ends */
  const live = sources.length ? h("section", { class: "card", id: "live" }, h("h2", {}, "Live"), h("p", { class: "soft small" }, "A file that a logger is writing, or a stream of its lines: the estimator follows it as it comes, until nothing came for ten seconds."), h("div", { class: "row" },
    following ? button("Stop following", () => post("/stop").catch(fail), { work: false, id: "follow-stop" }) : [h("select", { id: "follow-file", "aria-label": "File or stream to follow", onchange: (e) => { draft.source = e.target.value; } }, sources.map((s) => h("option", { value: s, selected: s === draft.source }, s.split(/[\\/]/).pop()))), button("Follow", () => run("follow", { source: $("follow-file").value }).then(() => render(false)), { id: "follow" })])) : null;
  const form = following ? null : h("form", { class: "card", onsubmit: (e) => { e.preventDefault(); }, oninput: (e) => { const k = { "replay-from": "first", "replay-length": "seconds", "replay-at": "at" }[e.target.id]; if (k) draft[k] = e.target.value; } },
    h("div", { class: "fields" },
      choice("replay-file", "Record", files.map((f) => [f.id, f.name]), file.id, `${seconds(file.summary.duration)} long`, keep("file")),
      field("replay-from", "From [s]", draft.first ?? 0, "after its begin"), field("replay-length", "Length [s]", draft.seconds ?? Math.min(length, Math.ceil(file.summary.duration)), "the first 7 s warm up"),
      choice("replay-kind", "Try a fault", faults.map((k) => [k, k === "none" ? "none, as recorded" : k]), kind, "put into the readings on purpose", keep("kind")),
      kind === "none" ? null : choice("replay-sensor", "In the sensor", sensors.map((s) => [s, s]), draft.sensor || sensors[3], "", keep("sensor")),
      kind === "none" ? null : field("replay-at", "From then on [s]", draft.at ?? "", "empty: at 60 %")),
    button("Replay", go, { kind: "primary", id: "replay" }));
  const head = heading("Online replay", "The estimator that the FMU carries, fed sample by sample: it starts from the fitted joint and follows its parameters. Sensors are judged as by irj track: about a second after the first sign. The FMU's own detector takes milliseconds and errs more often.");
  if (!last.time) return [head, live, form];
  const table = await get("/view/parameters").catch(() => ({}));
  const stale = last.effects.join() !== state.steps[state.steps.length - 1].effects.join();
  const marks = last.verdicts.filter((v) => v.about.length), host = h("div", { class: "plot" });
  later(() => { const plot = new SeriesPlot(host, () => Promise.resolve({ time: last.time, full: true, series: Object.entries(last.ratio).map(([b, v]) => ({ name: b, unit: "× floor", values: v })) }), { title: "Residual over floor of each balance", local: true, side: "residual" }); app.plots.push(plot); plot.show(null).catch(fail); });
  const verdict = last.standing ? last.standing.replace(/\.$/, "") : !last.detector ? "Sensor faults were not looked for" : marks.length ? `${words(marks[0].about.join(" or "))}: ${marks[0].text.charAt(0).toLowerCase()}${marks[0].text.slice(1)}` : "No reading was doubted";
  return [head, live, form, stale ? h("p", { class: "note" }, "This replay belongs to an earlier model; replay again.") : null,
    h("section", { class: "card", id: "timeline" }, h("h2", {}, "Fault timeline"), h("p", {}, h("strong", { id: "standing" }, sentence(verdict)), ` ${last.record}, ${seconds(last.end)}${last.live ? " so far" : ""}.`), last.note ? h("p", { class: "note small" }, last.note) : null, last.no_detector ? h("p", { class: "note small" }, `${last.no_detector.charAt(0).toUpperCase()}${last.no_detector.slice(1)}.`) : null,
      kept("Fault timeline", timeline(last), () => timelineCsv(last)), h("p", { class: "small soft" }, "Shade: largest residual that holds the reading, as a share of its limit (full height: at the limit). Bar: declared failed and replaced by the estimate."),
      last.verdicts.length > 1 || marks.length ? h("details", { open: last.verdicts.length < 5 }, h("summary", {}, `What it said (${last.verdicts.length})`), h("ul", { class: "findings" }, last.verdicts.map((v) => h("li", {}, h("strong", {}, seconds(v.time)), " ", v.about.length ? `${words(v.about.join(", "))}: ` : "", v.text, v.time - v.first > 1e-3 ? ` First sign at ${seconds(v.first)}.` : "")))) : null),
    h("section", { class: "card" }, h("h2", {}, "Residual over floor"), h("p", { class: "soft small" }, "1 × means that only noise is left. It is the mean over the last two seconds."), host),
    h("section", { class: "card" }, h("h2", {}, "Parameters as they were followed"), h("p", { class: "soft small" }, "Line: the online estimate; dashed: the value of the fit."), h("div", { class: "sparks" }, Object.entries(last.parameters).map(([n, p]) => followed(n, p, last.time, last.end, (table[n] || {}).stderr))))];
};

/* --- planning ------------------------------------------------------------------------------------------------ */

/* Every motion that was tried: speed across, period down, in the cell the worst standard deviation. */
function triedTable(tried) {
  const text = (t) => (t.broken.length ? "breaks " + t.broken.join(", ") : t.unknown ? `${t.unknown} unknown` : `${digits(t.worst, 2)} %`);
  const speeds = [...new Set(tried.map((t) => Math.round(t.speed * 10) / 10))].sort((a, b) => a - b), at = (rows, v) => rows.find((t) => Math.abs(t.speed - v) < 0.06);
  const line = (name, rows) => h("tr", {}, h("th", { scope: "row" }, name), speeds.map((v) => { const t = at(rows, v); return h("td", { class: `num${t && t.best ? " best" : ""}${t && t.broken.length ? " soft" : ""}` }, t ? [text(t), t.best ? h("span", { class: "hidden" }, ", the best") : null] : "–"); }));
  const periods = [...new Set(tried.filter((t) => t.period).map((t) => t.period))].sort((a, b) => a - b);
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Motions that were tried" }, h("table", {}, h("caption", {}, "Worst ± to expect, by motion"), h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Motion"), speeds.map((v) => h("th", { scope: "col", class: "num" }, `${digits(v)}°/s`)))),
    h("tbody", {}, line("triangle", tried.filter((t) => t.family === "triangular")), periods.map((p) => line(`sine, ${digits(p, 2)} s`, tried.filter((t) => t.period === p))))));
}

function deviationTable(rows) {
  const most = Math.max(...rows.map((d) => Math.min(d.percent ?? 100, 100)), 1);
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "What the motion makes identifiable" }, h("table", { class: "stack" }, h("caption", {}, "What it makes identifiable"), h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Parameter"), h("th", { scope: "col", class: "num" }, "± to expect"), h("th", { scope: "col" }, "Identifiable?"))),
    h("tbody", {}, rows.map((d) => h("tr", {}, h("th", { scope: "row" }, words(d.name), h("div", { class: "small soft plain" }, d.meaning)), h("td", { class: "num", "data-label": "± to expect" }, d.percent == null ? "–" : `${digits(d.percent, 2)} %`, h("span", { class: "bar thin", "aria-hidden": "true" }, later2(h("i"), `${(100 * Math.min(d.percent ?? 100, most)) / most}%`))), h("td", { "data-label": "Identifiable?" }, h("span", { class: `tag ${d.good ? "good" : "warn"}` }, d.percent == null ? "not by this motion" : d.good ? "yes" : "poorly")))))));
}
const later2 = (bar, width) => { later(() => { bar.style.width = width; }); return bar; };

views.plan = async (state) => {
  const { last, open: asked, limits } = await get("/view/plan"), draft = app.drafts.plan || (app.drafts.plan = {}), inside = state.steps.length ? state.steps[state.steps.length - 1].effects : [];
  const ranked = state.diagnosis ? state.diagnosis.ranking.map((r) => r.label) : [], labels = app.config.effects.flatMap((e) => e.places.map((p) => (e.places.length > 1 ? `${e.key}@${p}` : e.key))).filter((l) => !inside.includes(l)).sort((a, b) => (ranked.indexOf(a) + 1 || 99) - (ranked.indexOf(b) + 1 || 99));
  const go = () => run("plan", { position: $("plan-position").value, speed: $("plan-speed").value, torque: $("plan-torque").value, label: $("plan-label").value });
  const now = last.limits || limits;
  const groups = [["set", "Cannot be told apart"], ["untested", "Cannot be shown by these records"], ["warning", "Weak spots of the records"]].map(([k, t]) => [t, asked.filter((o) => o.kind === k)]).filter(([, rows]) => rows.length);
  const item = (o) => h("li", {}, h("strong", {}, o.title), `: ${plainly(askedFor(o.text, "under What is known on the Model page"))}.`, o.run ? h("span", { class: "soft" }, ` What would show it: ${o.run}.`) : null);
  const form = h("form", { class: "card", onsubmit: (e) => e.preventDefault(), oninput: (e) => { draft[e.target.id] = e.target.value; } }, h("h2", {}, "What the joint may do"), h("div", { class: "fields" },
    field("plan-position", "Range ± [°]", draft["plan-position"] ?? now.position, "of the link"), field("plan-speed", "Speed [°/s]", draft["plan-speed"] ?? now.speed, "of the link"), field("plan-torque", "Drive torque [N·m]", draft["plan-torque"] ?? now.torque, "on the link side"),
    choice("plan-label", "Must also show", [["", "only what is in the model"], ...labels.map((l) => [l, effectTitle(l)])], draft["plan-label"] ?? last.label ?? "", "an effect to look for", null, "long")), button("Plan a motion", go, { kind: "primary", id: "plan" }));
  const head = [heading("Plan the next experiment", "What the records leave open, and a motion that answers it: the fitted joint is simulated along the reference motions, and the one that pins the parameters best within your limits is kept."),
    h("section", { class: "card" }, h("h2", {}, "What these records leave open"), groups.length ? groups.map(([t, rows], k) => h("details", { open: k === 0 && rows.length < 6 }, h("summary", {}, `${t} (${rows.length})`), h("ul", { class: "findings" }, rows.map(item)))) : h("p", { class: "soft" }, state.left_open && state.left_open.warnings ? "Nothing that the diagnosis could name." : "Diagnose first: it says what cannot be told apart and what is not testable.")), form];
  if (!last.motion) return head;
  const host = h("div", { class: "plot" });
  later(() => { const plot = new SeriesPlot(host, () => Promise.resolve(last.motion), { title: "Reference motion", local: true, side: "of the link" }); app.plots.push(plot); plot.show(null).catch(fail); });
  const p = last.parameters, said = [`${digits((180 / Math.PI) * p.speed)}°/s`, p.period && `period ${seconds(p.period)}`, seconds(last.duration) + " long"].filter(Boolean).join(", "), missed = last.deviations.filter((d) => !d.good).length;
  return [...head, h("section", { class: "card", id: "best-motion" }, h("div", { class: "row between" }, h("div", {}, h("h2", {}, "The best motion"), h("p", {}, h("strong", {}, `${last.family === "sinusoidal" ? "Sinusoidal" : "Triangular"}, ${said}`), `: ${missed ? `${last.deviations.length - missed} of ${last.deviations.length} parameters` : `all ${last.deviations.length} parameters`} to better than 10 %.`)), h("a", { class: "button primary", href: `${base()}/view/motion.csv`, download: "", id: "get-motion" }, "Download as CSV")),
    last.note ? h("p", { class: "note small" }, last.note) : null, host, h("p", { class: "small soft" }, "Reference for the link: time, position, velocity and acceleration, link-referred, at 1 kHz.")),
    h("div", { class: "two even" }, h("div", { class: "card" }, deviationTable(last.deviations)), h("div", { class: "card" }, triedTable(last.tried)))];
};
