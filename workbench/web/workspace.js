"use strict";
/* The workspace of a wide screen: records and fits at the left, candidates at the right, the view
   that is open between them. A narrow screen has the same cards in the views themselves. */
const WIDE = matchMedia("(min-width: 1100px)");
const rails = { left: "", right: "", tree: null, panel: null };
const hasRecords = (s) => Boolean(s) && (s.files.length > 0 || s.fits > 0 || s.steps.length > 0);

/* Whether the cards at the sides are out of the views: asked while a view is drawn. */
const railed = () => WIDE.matches && app.view !== "home" && hasRecords(app.state);

/* What a picture may take: the width of a card in a grid of the view, and of a card by itself. */
function columnWidths() {
  const room = (app.drawn = pictureRoom()) + 30, least = railed() ? 306 : 346;
  const count = Math.max(1, Math.floor((room + 16) / least));
  return { width: Math.floor((room - 16 * (count - 1)) / count - 38), whole: room - 38 };
}
const widthsAsked = () => new URLSearchParams(columnWidths());

/* --- left: records, their runs, fits ---------------------------------------------------------- */

/* A record, or a run of it, in the plot of the Load page. */
function lookAt(file, range) {
  app.drafts.series = { ...app.drafts.series, file, range };
  const seen = () => { if ($("look")) $("look").scrollIntoView({ block: "center" }); };
  later(() => requestAnimationFrame(seen));
  if (app.view === "load") render(false); else open("load");
}
const ROLES = { train: "fit", held_out: "held out" };
function recordLine(f) {
  const shown = ["ready", "checking"].includes(f.status), s = f.summary || {}, runs = s.runs || [];
  const said = shown ? `${ROLES[f.role]}, ${digits(s.duration, 4)} s` : f.status === "columns"
    ? "its columns are asked" : "refused";
  const bad = f.findings.filter((x) => x.severity === "warn").length;
  const run = ([a, b], k) => h("li", {}, button(`${k + 1}`, () => lookAt(f.id, [a, b]), {
    kind: "quiet", work: false, id: `run-${f.id}-${k}`,
    label: `Run ${k + 1} of ${f.name}, ${digits(a, 4)} to ${digits(b, 4)} s` }));
  return h("li", { class: "record" },
    shown ? button(f.name, () => lookAt(f.id, null), { kind: "quiet", work: false,
      id: `record-${f.id}`, label: `Look at ${f.name}` }) : h("span", {}, f.name),
    h("p", { class: "small soft" }, said,
      bad ? h("span", { class: "warn" }, `, ${bad} to check`) : null),
    runs.length ? h("div", { class: "row runs" }, h("span", { class: "small soft" }, "runs"),
      h("ol", { class: "row" }, runs.map(run))) : null);
}

function drawLeft(state) {
  const host = $("rail-left"), key = railed() ? `${state.id} ${state.revision}` : "";
  if (rails.left === key) return;
  const fresh = rails.left.split(" ")[0] !== key.split(" ")[0];
  rails.left = key;
  if (!key) { rails.tree = null; host.replaceChildren(); return; }
  if (fresh) rails.tree = null;
  const records = h("section", { class: "card", id: "records" }, h("h2", {}, "Records"),
    h("ul", { class: "plain" }, state.files.map(recordLine)));
  keepingFocus(host, () => {
    if (rails.tree) host.firstElementChild.replaceWith(records);
    else host.replaceChildren(records);
    const fits = state.fits > 0 || state.steps.length > 0;
    if (fits && !rails.tree) host.append(rails.tree = treeCard(state));
    else if (fits) rails.tree.look();
    else if (rails.tree) { rails.tree.remove(); rails.tree = null; }
  });
}

/* --- right: verdict and candidates ------------------------------------------------------------ */

/* The one panel with the law that is pointed at: of the view, else of the rail. */
const lawPanel = () => { const node = $("law-panel"); return node && node.panel; };

function rightCards(state) {
  const d = state.diagnosis, inView = app.view === "diagnose";
  const story = app.view === "ledger" ? null : state.improvement; /* that page says it itself */
  if (!d) return [story && outcomeCard(story, [
    h("p", { class: "figure" }, sentence(story.headline || story.verdict.replace(/_/g, " "))),
    h("p", {}, sentence(story.reason))], []),
  h("section", { class: "card" }, h("h2", {}, "Candidates"),
    h("p", { class: "soft small" },
      "Diagnose tries every effect of the library in this model; what it ranks stands here."),
    ["compare", "ledger", "diagnose"].includes(app.view) ? null
      : button("Diagnose", () => run("diagnose", {}, "diagnose"), { id: "rail-diagnose" }))];
  const { clear, faint } = rankedCards(d), own = rails.panel && rails.panel.node;
  return [inView ? null : claimCard(d, true), own, clear, faint];
}

function drawRight(state) {
  const host = $("rail-right"), fitted = railed() && state.steps.length > 0;
  const held = fitted ? $("main").querySelector("#law-panel") : null;
  const part = !fitted || state.diagnosis ? app.view === "diagnose" : app.view;
  const key = fitted ? [state.id, state.revision, part, Boolean(held)].join(" ") : "";
  if (rails.right === key) return;
  rails.right = key;
  const d = fitted && state.diagnosis, labels = d ? lawsOf(d) : [];
  rails.panel = d && !held && labels.length ? new LawPanel(labels, "") : null;
  keepingFocus(host, () => host.replaceChildren(...(key ? rightCards(state).filter(Boolean) : [])));
  if (rails.panel) rails.panel.begin();
}

/* Before the view is drawn: its pictures are made for the room that it has beside the rails. */
function placeRails() {
  const left = railed(), right = left && app.state.steps.length > 0;
  $("space").dataset.rails = left ? (right ? "both" : "left") : "";
  $("rail-left").hidden = !left;
  $("rail-right").hidden = !right;
}
function drawRails() {
  placeRails();
  drawLeft(app.state);
  drawRight(app.state);
}
