"use strict";
/* The tree of fits: every fit that was made, by the input it was made from; opened, named, noted, held against another. */
const stepTitle = (s) => s.remark.name || (s.action === "start" ? "Start model" : `${s.action === "remove" ? "−" : "+"} ${(s.names || []).length > 1 ? s.names.map(effectTitle).join(" or ") : s.title || s.label}`); /* a set stays a set */

/* Branches of one input as one tree: paths that begin alike share their beginning. */
function treeOf(branches) {
  const groups = [];
  for (const b of branches) {
    let group = groups.find((g) => g.input === b.input && g.steps && b.steps.length && g.root.children[0] && g.root.children[0].step.id === b.steps[0].id);
    if (!group) { group = { input: b.input, change: b.change, branch: b, root: { children: [] }, steps: b.steps.length, current: false }; groups.push(group); }
    group.current = group.current || b.current;
    let node = group.root;
    b.steps.forEach((step, k) => {
      let next = node.children.find((c) => c.step.id === step.id);
      if (!next) { next = { step, branch: b, children: [], now: false, on: false }; node.children.push(next); }
      if (b.current && !step.undone) { next.on = true; next.now = k === b.steps.length - 1 || b.steps[k + 1].undone; next.branch = b; }
      node = next;
    });
  }
  return groups;
}

function treeCard(state) {
  const draft = app.drafts.tree || (app.drafts.tree = { chosen: [], noting: null });
  const body = h("div", { class: "tree" }), card = h("section", { class: "card", id: "tree", "aria-label": "Tree of fits" }, h("h2", {}, "Tree of fits"), h("p", { class: "small soft" }, "Every fit is kept. A changed record or joint begins a branch; nothing is deleted."), body);
  const go = (branch, step) => act(async () => { await post("/tree", { open: branch, step }); await refresh(); });
  const write = (of, change) => act(async () => { await post("/tree", { of, ...change }); draft.noting = draft.note = null; await refresh(); if (rails.tree === card) card.look(); else render(false); /* it may have been drawn before the answer came */ });
  const draw = (branches) => {
    const node = (n) => {
      const s = n.step, id = `fit-${s.id}`, noting = draft.noting === s.id, note = { name: s.remark.name || "", text: s.remark.note || "", ...(noting ? draft.note : null) };
      const tick = h("input", { type: "checkbox", id: `${id}-compare`, "aria-label": `Compare ${stepTitle(s)}, ${digits(s.error)} %`, checked: draft.chosen.includes(s.id), onchange: (e) => { draft.chosen = [...draft.chosen.filter((x) => x !== s.id), ...(e.target.checked ? [s.id] : [])].slice(-2); draw(branches); } });
      return h("li", {}, h("div", { class: `fit${n.now ? " now" : n.on ? " on" : ""}`, id }, tick, h("span", { class: "fit-name" }, stepTitle(s)), h("span", { class: "num" }, `${digits(s.error)} %`), s.diagnosed ? h("span", { class: "tag good" }, "diagnosed") : null,
        n.now ? h("span", { class: "tag" }, "now") : button("Open", () => go(n.branch.id, s.id), { kind: "quiet", id: `${id}-open`, label: `Open ${stepTitle(s)}, ${digits(s.error)} %` }),
        button(s.remark.note || s.remark.name ? "Edit note" : "Name, note", () => { draft.noting = noting ? null : s.id; draft.note = null; draw(branches); }, { kind: "quiet", work: false, id: `${id}-note`, label: `${s.remark.note || s.remark.name ? "Edit note" : "Name, note"} of ${stepTitle(s)}` })),
        noting ? h("form", { class: "row", oninput: () => { draft.note = { name: $(`${id}-name`).value, text: $(`${id}-text`).value }; }, onsubmit: (e) => { e.preventDefault(); write(s.id, { name: $(`${id}-name`).value, note: $(`${id}-text`).value }); } }, h("input", { id: `${id}-name`, "aria-label": "Name", placeholder: "Name", value: note.name }), h("input", { id: `${id}-text`, size: "48", "aria-label": "Note", placeholder: "Note", value: note.text }), h("button", { type: "submit" }, "Keep")) : s.remark.note ? h("p", { class: "small soft note-text" }, s.remark.note) : null,
        n.children.length ? h("ul", {}, n.children.map(node)) : null);
    };
    const groups = treeOf(branches).map((g) => h("div", { class: "input" }, h("p", { class: "small" }, h("strong", {}, g.change || "First input"), h("span", { class: "soft" }, ` · ${g.input || "no record"}`)),
      g.root.children.length ? h("ul", {}, g.root.children.map(node)) : h("div", { class: g.current ? "fit now" : "fit" }, h("span", { class: "soft" }, "not fitted yet"), g.current ? h("span", { class: "tag" }, "now") : button("Open", () => go(g.branch.id, ""), { kind: "quiet", label: `Open ${g.change || "this input"}` }))));
    const both = draft.chosen.length === 2, held = h("div", { id: "held-against" });
    body.replaceChildren(...groups, h("div", { class: "row" }, button("Compare the two", () => get(`/view/fits?a=${draft.chosen[0]}&b=${draft.chosen[1]}`).then((found) => held.replaceChildren(fitsTable(found))).catch(fail), { work: false, id: "compare-fits", off: !both })), held);
  };
  let asked = 0; /* an older answer does not come over a newer one */
  card.look = () => {
    const mine = (asked += 1), put = (found) => keepingFocus(body, () => draw(found.branches));
    return get("/view/tree").then((found) => { if (mine === asked) put(found); }).catch(fail);
  };
  card.look();
  return card;
}

/* The parameters of two steps of the ledger beside one another: what the last one changed, until others are chosen. */
function besideCard(state) {
  if (state.steps.length < 2) return null;
  const held = h("div", { id: "beside" }), last = state.steps.length - 1, of = state.steps.map((s) => s.id).join(), kept = app.drafts.beside && app.drafts.beside.of === of ? app.drafts.beside.chosen : []; /* another step asks for the newest pair again */
  const choice = (id, name, chosen) => h("label", { for: id }, `${name} `, h("select", { id, onchange: show }, state.steps.map((s, k) => h("option", { value: s.id, selected: k === chosen }, `${k + 1}: ${stepTitle({ ...s, remark: (state.remarks || {})[s.id] || {} })}`))));
  const at = (k, usual) => { const place = state.steps.findIndex((s) => s.id === kept[k]); return place < 0 ? usual : place; };
  const first = choice("beside-first", "Step", at(0, last - 1)), second = choice("beside-second", "beside", at(1, last)), value = (label) => label.querySelector("select").value;
  function show() {
    const asked = [value(first), value(second)];
    app.drafts.beside = { of, chosen: asked };
    get(`/view/fits?a=${asked[0]}&b=${asked[1]}`).then((found) => { if (asked[0] === value(first) && asked[1] === value(second)) held.replaceChildren(fitsTable(found)); }).catch(fail);
  }
  show();
  return h("section", { class: "card" }, h("h2", {}, "Two steps beside one another"), h("p", { class: "soft small" }, "The values that differ in four digits; – where a step has no such parameter."), h("div", { class: "row" }, first, second), held);
}

function fitsTable(found) {
  const [a, b] = found.steps, shown = (v) => (v == null ? "–" : digits(v, 4)), changed = found.values.filter((v) => shown(v.first) !== shown(v.second)), cell = (v, of) => h("td", { class: "num", "data-label": stepTitle(of) }, shown(v));
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Two fits compared" }, h("table", { class: "stack" }, h("caption", {}, "Two fits side by side"), h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Parameter"), h("th", { scope: "col", class: "num" }, stepTitle(a)), h("th", { scope: "col", class: "num" }, stepTitle(b)))),
    h("tbody", {}, h("tr", { class: "now" }, h("th", { scope: "row" }, "Held-out error [%]"), cell(a.error, a), cell(b.error, b)), h("tr", {}, h("th", { scope: "row" }, "Only in it"), found.only.map((o, k) => h("td", { class: "num wraps", "data-label": stepTitle(found.steps[k]) }, o.length ? o.map(effectTitle).join(", ") : "–"))),
      changed.map((v) => h("tr", {}, h("th", { scope: "row" }, words(v.name)), cell(v.first, a), cell(v.second, b))))));
}

/* The law in one line that is nearest to a learned curve, put where a law is typed: it is tried as one's own. */
const pickLaw = (label) => act(async () => {
  const made = await get(`/view/shape?label=${encodeURIComponent(label)}`);
  app.drafts.law = { law: made.law, on: made.on, parameters: made.parameters, said: `Nearest to the curve in one line: it follows ${digits(made.share, 3)} % of it.` };
  later(() => requestAnimationFrame(() => { if ($("law-law")) $("law-law").focus(); }));
  if (app.view === "ledger") render(false); else open("ledger");
});
/* A law of one's own: typed in one line, fitted at once to what the model leaves, kept in the joint file. */
function lawCard(state) {
  const draft = app.drafts.law || (app.drafts.law = { law: "", on: "motor", parameters: "" });
  const field = (key, label, placeholder, size) => h("input", { id: `law-${key}`, value: draft[key], placeholder, size, "aria-label": label, autocomplete: "off", spellcheck: "false", oninput: (e) => { draft[key] = e.target.value; delete draft.said; } });
  const linear = effort() === "force"; /* the units of the axis */
  const place = h("select", { id: "law-on", "aria-label": "Where it acts", onchange: (e) => { draft.on = e.target.value; } }, app.config.places.map((p) => h("option", { value: p, selected: p === draft.on }, words(p))));
  const row = (t) => h("li", {}, h("div", { class: "row between" }, h("span", {}, h("code", {}, t.law), ` on ${t.on.replace(/_/g, " ")}: the held-out error ${t.after < t.before ? "falls" : "goes"} from ${digits(t.before)} to `, h("strong", {}, `${digits(t.after)} %`)),
    button("Add", () => run("add", { label: t.label }, "ledger"), { kind: t.after < t.before ? "primary" : "", id: `add-${t.label}`, label: `Add ${t.law}` })));
  return h("form", { class: "card", id: "own-law", onsubmit: (e) => { e.preventDefault(); $("try-law").click(); } }, h("h2", {}, "A law of your own"), h("div", { class: "row" }, field("law", "Law", "c*tanh(v/w)", "28"), place, field("parameters", "Parameters with ranges and units", linear ? "c=0..10 N, w=0.01..1 m/s" : "c=0..10 N.m, w=0.01..1 rad/s", "34"),
    button("Try it", () => run("law", { ...draft }), { id: "try-law" })), draft.said ? h("p", { class: "small", id: "law-said" }, draft.said) : null, h("p", { class: "small soft" }, `Signals: q, v, a (${linear ? "position" : "angle"}, speed, acceleration of the place), twist, T, t; name your parameters otherwise. It is fitted at once to what the model leaves, and stays in the joint file.`),
    state.laws.length ? h("ul", { class: "plain", id: "tried-laws" }, state.laws.map(row)) : null);
}
