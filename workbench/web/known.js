"use strict";
/* What is known of a parameter, as fields: on the Model page all of them, on the Diagnose page those that an effect asks for. */
const KNOWN_SIDES = [["link", "link side"], ["motor", "motor shaft"]];
const KNOWN_KEYS = ["value", "low", "high", "unit", "side"];

/* One field of one parameter; `say` is read aloud with it. */
function knownField(id, label, row, key) {
  const given = row.given[key];
  const say = `${label} of ${words(row.name)}`;
  const control = key === "side"
    ? h("select", { id, "aria-label": say }, [...KNOWN_SIDES, ...(given && !KNOWN_SIDES.some(([v]) => v === given) ? [[given, given]] : [])].map(([v, t]) => h("option", { value: v, selected: v === (given || "link") }, t)))
    : h("input", { id, value: given == null ? (key === "unit" ? row.unit : "") : String(given), autocomplete: "off", inputmode: key === "unit" ? "text" : "decimal", "aria-label": say });
  return h("label", { class: "small pick", for: id }, label, control);
}

const KNOWN_LABELS = { value: "Value", low: "or at least", high: "and at most", unit: "Unit", side: "Stated for" };

function knownRow(row, prefix, keys = KNOWN_KEYS) {
  return h("fieldset", { class: "known", "data-name": row.name }, h("legend", {}, words(row.name), h("span", { class: "small soft plain" }, ` ${row.meaning}`)), keys.map((k) => knownField(`${prefix}-${row.name}-${k}`, KNOWN_LABELS[k], row, k)));
}

/* The fields of one row as they stand; a side that nobody chose is not written. */
function knownTyped(node) {
  const out = {};
  for (const key of KNOWN_KEYS) {
    const control = node.querySelector(`[id$="-${key}"]`);
    if (control && !(key === "side" && control.value === "link")) out[key] = control.value;
  }
  return out;
}
const knownAll = (root) => Object.fromEntries([...root.querySelectorAll("fieldset.known")].map((n) => [n.dataset.name, knownTyped(n)]));

/* The card of the Model page: what is given stands there, a parameter is added by its name. `added` keeps the names for when the page is drawn anew. */
function knownCard(rows, added) {
  if (!rows.length) return null;
  const given = rows.filter((r) => Object.keys(r.given).length || added.includes(r.name)), others = rows.filter((r) => !given.includes(r));
  const list = h("div", {}, given.map((r) => knownRow(r, "known")));
  const pick = h("select", { id: "known-pick", "aria-label": "Parameter that is known" }, others.map((r) => h("option", { value: r.name }, words(r.name))));
  const add = button("Give it", () => {
    const row = others.find((r) => r.name === pick.value);
    if (!row) return;
    added.push(row.name);
    storeDraft(app.drafts.joint);
    list.append(knownRow(row, "known"));
    pick.querySelector(`option[value="${row.name}"]`).remove();
    $(`known-${row.name}-value`).focus();
  }, { work: false, id: "known-add" });
  return h("section", { class: "card", id: "known" }, h("h2", {}, "What is known"), h("p", { class: "soft small" }, "From a catalogue, CAD or a scale. A value is kept as it stands; bounds let the fit move between them. Empty fields take it back."), list,
    others.length ? h("div", { class: "row" }, pick, add) : null);
}

/* What was typed and chosen in a form and is not sent yet: it stands there again when the view is drawn anew, as long as what the form is about is the same. */
function keepTyped(form, typed) {
  const keyOf = (c) => (c.type === "radio" ? c.name : c.id || `${c.name}=${c.value}`);
  form.addEventListener("input", (e) => { typed[keyOf(e.target)] = e.target.type === "checkbox" ? e.target.checked : e.target.value; });
  for (const c of form.querySelectorAll("input, select, textarea")) {
    const value = typed[keyOf(c)];
    if (value === undefined) continue;
    if (c.type === "checkbox") c.checked = value;
    else if (c.type === "radio") c.checked = c.value === value;
    else if (c.tagName !== "SELECT" || [...c.options].some((o) => o.value === value)) c.value = value;
  }
}

/* The fields of the joint that were typed or chosen and are not saved yet. */
const fieldsTyped = (draft) => Object.keys(draft.typed).filter((key) => key !== "joint-text" && key !== "known-pick");

/* What is edited on the Model page: on which text it began, what was typed, which known parameters were added. It stays until it is saved or given up, also where the joint becomes another one meanwhile. */
function jointDraft(text) {
  const draft = app.drafts.joint || (app.drafts.joint = storedDraft());
  if (draft && (draft.text === text || draft.saving || draft.added.length || "joint-text" in draft.typed || fieldsTyped(draft).length)) return draft;
  return (app.drafts.joint = { text, typed: {}, added: [], saving: false });
}

/* It also stays where the page is loaded anew, in this tab. */
const draftKey = () => `irj-joint-${app.id}`;
function storedDraft() {
  try {
    const found = JSON.parse(sessionStorage.getItem(draftKey()) || "null");
    return found && { ...found, saving: false };
  } catch (error) { return null; }
}
function storeDraft({ text, typed, added }) {
  const nothing = !added.length && !Object.keys(typed).length;
  try {
    if (nothing) sessionStorage.removeItem(draftKey());
    else sessionStorage.setItem(draftKey(), JSON.stringify({ text, typed, added }));
  } catch (error) { /* a browser that keeps nothing: it stays until the page goes */ }
}

/* Another tab, another page or a joint file changed the joint while it was edited here: nothing is saved over it, and nothing typed goes, until it is said which counts. */
function movedJoint(draft, text) {
  const taken = (drop) => {
    if (drop) delete app.drafts.joint; else draft.text = text;
    if (drop) storeDraft({ typed: {}, added: [] });
    clearError(); render(false);
  };
  return h("section", { class: "note", id: "joint-moved", role: "status" },
    h("p", {}, h("strong", {}, "The joint was changed elsewhere"), " since you began to edit it: in another tab, on another page or by a joint file. What you typed still stands below and is not saved."),
    h("details", {}, h("summary", {}, "The joint as it is now"), h("pre", { tabindex: "0", "aria-label": "The joint as it is now" }, text)),
    h("div", { class: "row" }, button("Take the joint as it is now", () => taken(true), { work: false, id: "joint-take" }), button("Keep editing", () => taken(false), { work: false, id: "joint-keep" })),
    h("p", { class: "small soft" }, "joint-text" in draft.typed ? "Where you keep editing and save, your joint file replaces that one as a whole." : "Where you keep editing and save, your fields replace those of that joint; the others stay as they are now."));
}

/* The fields say the whole joint, and so does the joint file: where both were edited only one of them can be saved, and nothing is until it is said which. */
function bothEdited(draft) {
  const keep = (text) => {
    if (text) draft.added.length = 0;
    for (const key of text ? fieldsTyped(draft) : ["joint-text"]) delete draft.typed[key];
    clearError(); render(false);
  };
  return h("section", { class: "note", id: "joint-both", role: "status", hidden: true },
    h("p", {}, h("strong", {}, "The fields and the joint file were both edited"), ", and each of them is the whole joint. One of the two is saved; what was edited in the other goes."),
    h("div", { class: "row" }, button("Keep the fields", () => keep(false), { work: false, id: "both-fields" }), button("Keep the joint file", () => keep(true), { work: false, id: "both-text" })));
}

/* Save the joint, or nothing; what was typed while the answer was under way stays. The server refuses it where the joint is not the one any more that was edited. */
async function saveJoint(draft, body) {
  if (!body) { await refresh(); return; }
  const sent = { ...draft.typed };
  draft.saving = true;
  try {
    const made = await post("/joint", { ...body, was: draft.text });
    draft.text = made.text; draft.added.length = 0;
    for (const key of Object.keys(sent)) if (draft.typed[key] === sent[key]) delete draft.typed[key];
  } finally {
    draft.saving = false;
    await refresh();
    if (app.view === "model") render(false); /* it may have been drawn before the answer came */
  }
}

/* Under an effect that needs a known parameter: its fields, and the fit with it. The model as it stands is fitted again on a branch of its own. */
function knownAsk(item, rows) {
  const asked = item.asks.map((name) => rows.find((r) => r.name === name)).filter(Boolean), prefix = `ask-${item.effect}`;
  if (!asked.length) return null;
  const drafts = app.drafts.asked || (app.drafts.asked = {}), typed = drafts[item.effect] || (drafts[item.effect] = {});
  const host = h("div", {}, knownRow(asked.find((r) => r.name === typed[`${prefix}-which`]) || asked[0], prefix, ["value", "unit", "side"]));
  const which = asked.length < 2 ? null : h("select", { id: `${prefix}-which`, "aria-label": `Which is known, for ${item.title}`, onchange: (e) => host.replaceChildren(knownRow(asked.find((r) => r.name === e.target.value), prefix, ["value", "unit", "side"])) }, asked.map((r) => h("option", { value: r.name }, words(r.name))));
  const give = () => {
    const given = knownAll(host), [[name, entry]] = Object.entries(given);
    const { problem } = typedNumber(entry.value, words(name), null, null);
    if (problem) { fail(new Error(problem)); $(`${prefix}-${name}-value`).focus(); return; }
    act(async () => { await post("/joint", { hold: given, source: app.state.joint_source || "joint" }); delete drafts[item.effect]; await refresh(); }).then((done) => { if (done) run("fit", {}, "diagnose"); });
  };
  const node = h("div", { class: "asked" }, which, host, button("Give it and fit again", give, { id: `${prefix}-give`, label: `Give it and fit again, for ${item.title}` }));
  keepTyped(node, typed);
  return node;
}
