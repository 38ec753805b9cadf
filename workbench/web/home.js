"use strict";
/* The sessions of this user: named, searched, opened, deleted. The key of the list came with the address that `irj app` printed. */
const homeCall = (method, path) => call(method, path, null, { "X-IRJ-Home": remembered("irj-home") || "" });
const sized = (bytes) => (bytes >= 1e9 ? `${digits(bytes / 1e9, 2)} GB` : `${digits(Math.max(bytes / 1e6, 0.1), 2)} MB`);

/* The falling error as a small staircase. */
function stairs(errors) {
  const known = errors.filter((e) => e != null), top = Math.max(...known, 1e-9), svg = document.createElementNS(SHAPE_NS, "svg"), line = document.createElementNS(SHAPE_NS, "polyline");
  svg.setAttribute("viewBox", "0 0 96 24"); svg.setAttribute("class", "spark"); svg.setAttribute("aria-hidden", "true");
  line.setAttribute("points", known.flatMap((e, k) => [(96 * k) / known.length, (96 * (k + 1)) / known.length].map((x) => `${x.toFixed(1)},${(22 - (20 * e) / top).toFixed(1)}`)).join(" "));
  svg.append(line);
  return svg;
}

/* Without its key the list is not asked for: what to do is said, and the key can be given here. */
function keyCard(said) {
  const give = (e) => { e.preventDefault(); const text = $("home-key").value.trim(), key = new URLSearchParams(text.slice(text.indexOf("#") + 1)).get("home") || text; if (key) { remembered("irj-home", key); render(false); } };
  return [heading("Sessions", said), h("form", { class: "card", id: "need-key", onsubmit: give }, h("p", {}, "Open the address that ", h("code", {}, "irj app"), " printed in its terminal: it ends in ", h("code", {}, "#home="), " and a key. Or paste that address here:"), h("div", { class: "row" }, h("input", { id: "home-key", size: "48", "aria-label": "The address that irj app printed", autocomplete: "off", spellcheck: "false" }), h("button", { type: "submit", class: "primary" }, "Show the sessions")))];
}

views.home = async () => {
  let found;
  if (!remembered("irj-home")) return keyCard("The list of sessions is for whoever started the server, so that it needs a key.");
  try { found = await homeCall("GET", "/api/home"); } catch (error) { return keyCard(`The list is not shown: ${error.message}.`); }
  const draft = app.drafts.home || (app.drafts.home = { search: "", sure: null }), list = h("div", { class: "sessions" });
  const called = (s) => s.name || s.joint || (s.files[0] ? s.files[0].replace(/\.[^.]*$/, "") : "session");
  const go = (id) => act(async () => { await enter(id); open(app.state.steps.length ? "ledger" : "load"); });
  const remove = (s) => act(async () => { await homeCall("DELETE", `/api/home/${s.id}`); draft.sure = null; if (s.id === app.id) await enter((await call("POST", "/api/session")).id); render(false); });
  const rename = (s, name) => act(async () => { await call("POST", `/api/session/${s.id}/tree`, { session: name }); s.name = name; draw(); });
  const card = (s) => {
    const last = s.errors[s.errors.length - 1];
    return h("section", { class: "card session", "aria-label": called(s) }, h("div", { class: "row between" }, h("div", {}, h("h2", {}, called(s), " ", s.id === app.id ? h("span", { class: "tag" }, "open") : null),
      h("p", { class: "small soft" }, s.problem || [s.files.join(", ") || "no record", plural(s.fits, "fit"), sized(s.size), s.changed ? new Date(1000 * s.changed).toLocaleString() : ""].filter(Boolean).join(" · ")), s.effects && s.effects.length ? h("p", { class: "small" }, s.effects.join(", ")) : null),
      last != null ? h("div", { class: "thumb" }, stairs(s.errors), h("span", { class: "small" }, `${digits(last)} %`)) : null),
      h("div", { class: "row" }, s.problem ? null : button("Open", () => go(s.id), { label: `Open ${called(s)}`, id: `open-${s.id}` }), s.problem ? null : h("input", { value: s.name, placeholder: "Name", "aria-label": `Name of ${called(s)}`, onchange: (e) => rename(s, e.target.value) }),
        draft.sure === s.id ? [h("span", { class: "bad" }, "Its records and fits go with it."), button("Delete for good", () => remove(s), { label: `Delete ${called(s)} for good` }), button("Keep", () => { draft.sure = null; draw(); }, { kind: "quiet", work: false, label: `Keep ${called(s)}` })] : button("Delete", () => { draft.sure = s.id; draw(); }, { kind: "quiet", work: false, label: `Delete ${called(s)}` })));
  };
  function draw() {
    const words = draft.search.toLowerCase().split(/\s+/).filter(Boolean), text = (s) => [called(s), s.joint, ...s.files, ...(s.effects || [])].join(" ").toLowerCase();
    const shown = found.sessions.filter((s) => words.every((w) => text(s).includes(w)));
    list.replaceChildren(...(shown.length ? shown.map(card) : [h("p", { class: "soft" }, found.sessions.length ? "No session has these words." : "No session holds anything yet.")]));
    surround();
  }
  draw();
  return [h("div", { class: "row between head" }, h("div", {}, heading("Sessions")), h("input", { type: "search", id: "search", placeholder: "Search", "aria-label": "Search sessions", value: draft.search, oninput: (e) => { draft.search = e.target.value; draw(); } })),
    h("p", { class: "soft small", id: "quota" }, `${plural(found.sessions.length, "session")}, ${sized(found.used)} of ${sized(found.quota)} on the disk.`), list];
};
