"use strict";
/* The import: every column with its shape and range, what it may be and why, and what would be odd about the joint then.
   The guess is shown; it is used when the user confirms it, and the map can be changed later. */
const SHAPE_NS = "http://www.w3.org/2000/svg";
function shapeOf(column) {
  const svg = document.createElementNS(SHAPE_NS, "svg"), span = column.high - column.low || 1, y = (v) => (22 - (20 * (v - column.low)) / span).toFixed(1), n = column.spark.length;
  svg.setAttribute("viewBox", "0 0 96 24"); svg.setAttribute("class", "spark"); svg.setAttribute("aria-hidden", "true");
  const line = document.createElementNS(SHAPE_NS, "polyline");
  line.setAttribute("points", column.spark.flatMap(([low, high], k) => { const x = (96 * (k + 0.5)) / n; return [`${(x - 0.4).toFixed(1)},${y(low)}`, `${(x + 0.4).toFixed(1)},${y(high)}`]; }).join(" "));
  svg.append(line);
  return svg;
}

function columnMap(f) {
  const key = `map-${f.id}`, opened = `columns-${f.id}`;
  const draft = app.drafts[key] || (app.drafts[key] = { request: {}, typed: {} }), { typed } = draft;
  const body = draft.body || (draft.body = h("div", {}, h("p", { class: "soft small", role: "status" }, "Looking at the columns …"))); /* the view drawn anew shows the same one, with what is typed in it */
  /* What was `sent` with it is in the answer; what was typed since, or is half a formula yet, is not and stays. */
  const ask = (request, sent = {}) => post(`/look/${f.id}`, request).then((found) => {
    for (const id of Object.keys(sent)) if (typed[id] === sent[id]) delete typed[id];
    draft.request = request;
    keepingFocus(body, () => draw(found, request));
  }).catch((error) => said(error.message));
  const said = (text) => { const node = body.querySelector(".import-problem"); if (node) { node.textContent = text; node.hidden = !text; } else body.replaceChildren(h("p", { class: "bad import-problem" }, text)); };

  function draw(found, request) {
    const mapped = Object.fromEntries(found.proposed.filter((p) => p.column).map((p) => [p.column, p])), made = found.proposed.filter((p) => !p.column), about = (channel) => [...found.questions, ...found.findings.map((x) => ({ channel: x.channel, text: x.message }))].filter((q) => q.channel === channel && channel);
    const channels = (id, chosen, label) => h("select", { id, "aria-label": label, onchange: again }, h("option", { value: "" }, "not used"), app.config.channels.map((c) => h("option", { value: c, selected: c === chosen }, c.replace(/_/g, " "))));
    const box = (id, value, label, size) => h("input", { id, value, size: size || "7", placeholder: label.split(" of ")[0], "aria-label": label, autocomplete: "off", onchange: again });
    const si = (p) => (p && p.si ? h("div", { class: "small soft si" }, `= ${digits(p.si[0], 4)} … ${digits(p.si[1], 4)} ${unit(p.si[2])}`) : null);
    const asks = (text) => sentence(plainly(text), text.endsWith("?") ? "?" : "."), odd = (p) => (p ? about(p.channel).map((q) => h("p", { class: "odd small" }, asks(q.text))) : []);
    const rows = found.columns.map((c, k) => {
      const p = mapped[c.name], id = `${key}-${k}`, name = c.name;
      const parts = { channel: channels(`${id}-channel`, p && p.channel, `Channel of column ${name}`), unit: box(`${id}-unit`, (p && p.unit) || c.unit || "", `Unit of column ${name}`), scale: box(`${id}-scale`, p && p.scale ? String(p.scale) : "", `Scale of column ${name}`), counts: box(`${id}-counts`, p && p.counts_per_turn ? String(p.counts_per_turn) : "", `Counts/turn of column ${name}`, "9"), sign: h("select", { id: `${id}-sign`, "aria-label": `Sign of column ${name}`, onchange: again }, h("option", { value: "1" }, "+"), h("option", { value: "-1", selected: p && p.sign === -1 }, "−")) };
      const range = c.low == null ? h("span", { class: "soft" }, "no numbers") : [h("div", { class: "small" }, `${digits(c.low, 4)} … ${digits(c.high, 4)}${p && p.unit ? ` ${unit(p.unit)}` : ""}`), si(p), c.lost > 0 ? h("div", { class: "small warn" }, `${digits(100 * c.lost, 2)} % without a number`) : null];
      return { name, parts, node: h("tr", { class: p ? null : "unused" }, h("td", {}, h("strong", {}, name)), h("td", { class: "shape" }, c.spark.length ? shapeOf(c) : null), h("td", {}, range), h("td", {}, parts.channel), h("td", {}, h("div", { class: "row tight" }, parts.unit, parts.sign, parts.scale, parts.counts)), h("td", { class: "small soft why" }, p ? p.reason : "not used")), more: odd(p) };
    });
    const extra = [...made, {}].map((p) => {
      const id = `${key}-made-${p.channel || "new"}`, step = p.step != null;
      const parts = { channel: channels(`${id}-channel`, p.channel, "Channel of the formula"), formula: box(`${id}-formula`, p.formula || (step ? String(p.step) : ""), "Formula of columns, or the step of the time", "28"), unit: box(`${id}-unit`, p.unit || "", "Unit of the formula") };
      return { parts, had: p.channel, node: h("tr", {}, h("td", { colspan: "2" }, h("strong", {}, p.channel ? "formula" : "add a formula")), h("td", {}, parts.formula, si(p)), h("td", {}, parts.channel), h("td", {}, parts.unit), h("td", { class: "small soft why" }, p.channel ? "" : "as q1 - deflection; for time: a number, the step between rows")), more: odd(p.channel ? p : null) };
    });
    const kind = h("select", { id: `${key}-kind`, "aria-label": "Kind of the axis", disabled: Boolean(app.state.joint_text), onchange: again }, ["rotary", "linear"].map((v) => h("option", { value: v, selected: v === found.kind }, `${v} axis`)));
    const joint = found.joints.length ? h("select", { id: `${key}-joint`, "aria-label": "Joint", onchange: (e) => ask({ number: Number(e.target.value) }, sent()) }, found.joints.map((n) => h("option", { value: String(n), selected: n === found.number }, `joint ${n}`)), h("option", { value: "-1", selected: !found.joints.includes(found.number) }, "all columns are one joint")) : null;
    function read() {
      const columns = {};
      for (const { name, parts } of rows) if (parts.channel.value) columns[parts.channel.value] = { column: name, unit: parts.unit.value.trim(), scale: parts.scale.value.trim(), sign: Number(parts.sign.value), counts_per_turn: parts.counts.value.trim() };
      for (const { parts } of extra) if (parts.channel.value && parts.formula.value.trim()) { const text = parts.formula.value.trim(), step = parts.channel.value === "time" && Number(text) > 0; columns[parts.channel.value] = step ? { step: Number(text), unit: parts.unit.value.trim() || "s" } : { formula: text, unit: parts.unit.value.trim() }; }
      return columns;
    }
    /* A formula is asked about once it has its channel, too; without one it is taken away, where it had one. */
    const isHalf = ({ parts, had }) => (parts.channel.value ? !parts.formula.value.trim() : !had);
    const sent = () => { const open = new Set(extra.filter(isHalf).flatMap((r) => Object.values(r.parts).map((c) => c.id))); return Object.fromEntries(Object.entries(typed).filter(([id]) => !open.has(id))); };
    function again(event) {
      if (extra.some((r) => isHalf(r) && r.node.contains(event.target))) return;
      const columns = read(); if (Object.keys(columns).length) ask({ columns, kind: kind.value, number: found.number }, sent());
    }
    const confirm = () => {
      app.drafts[opened] = false; /* now: who opens it again before the answer has come is right */
      return act(async () => {
        const answer = await post(`/file/${f.id}`, { columns: read(), kind: app.state.joint_text ? "" : kind.value, all: true });
        const taken = answer.status === "ready" || answer.status === "checking";
        await refresh();
        if (!taken) throw new Error(answer.message);
        render(false);
      }).then((done) => { if (!done) app.drafts[opened] = true; });
    };
    const whole = [...found.questions, ...found.findings.map((x) => ({ channel: x.channel, text: x.message }))].filter((q) => !q.channel || !found.proposed.some((p) => p.channel === q.channel));
    const form = h("div", { class: "import" }, h("div", { class: "row" }, joint, kind, h("span", { class: "soft small" }, `${plural(found.rows, "row")}. Check the guess by what it says of the joint, then use it.`)),
      ...whole.map((q) => h("p", { class: "odd" }, asks(q.text))), h("p", { class: "bad import-problem", hidden: !found.problem }, plainly(found.problem)),
      h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": `Columns of ${f.name}` }, h("table", { class: "map-table" }, h("thead", {}, h("tr", {}, ["Column", "Shape", "Range", "Channel", "Unit, sign, scale, counts/turn", "Why"].map((t) => h("th", { scope: "col" }, t)))), h("tbody", {}, [...rows, ...extra].map((r) => [r.node, r.more.length ? h("tr", { class: "odd-row" }, h("td", { colspan: "6" }, r.more)) : null])))),
      h("div", { class: "row gap" }, button(found.same > 1 ? `Use for all ${found.same} files with these columns` : "Use these columns", confirm, { kind: "primary", id: `use-${f.id}`, key: `use-${f.id}-${JSON.stringify(request)}` }), f.status === "columns" ? null : button("Close", () => { app.drafts[opened] = false; render(false); }, { kind: "quiet", work: false })));
    keepTyped(form, typed);
    body.replaceChildren(form);
  }
  const host = h("div");
  later(() => host.append(body)); /* not before the old view goes: it would take the focus out of it */
  ask(draft.request);
  return host;
}
