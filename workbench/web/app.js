"use strict";
/* The page's state, its talk with the server, and what surrounds the views. */
const VIEWS = [["load", "Load"], ["model", "Model"], ["compare", "Compare"], ["diagnose", "Diagnose"], ["ledger", "Improve"], ["parameters", "Parameters"], ["replay", "Replay"], ["plan", "Plan"], ["export", "Export"]];
const $ = (id) => document.getElementById(id);
const app = { id: null, config: null, state: null, view: "load", source: null, plots: [], old: [], cleanup: [], then: null, sent: false, doing: [], acted: Promise.resolve(), drafts: {}, draftsOf: null, preview: null, first: null, sending: null, upload: null };

function h(tag, attributes, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes || {})) {
    if (value == null || value === false) continue;
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "value" || key === "checked" || key === "selected" || key === "disabled" || key === "open" || key === "hidden") node[key] = value;
    else node.setAttribute(key, value);
  }
  for (const child of children.flat(3)) if (child != null && child !== false) node.append(child);
  return node;
}

async function call(method, path, body, more) {
  const options = { method, headers: { "X-IRJ": "1", ...more } };
  if (body) { options.body = JSON.stringify(body); options.headers["Content-Type"] = "application/json"; }
  let answer;
  try { answer = await fetch(path, options); } catch (error) { throw Object.assign(new Error("the server does not answer; is it still running? What was done is kept in the session folder."), { away: true }); }
  if (!answer.ok) throw Object.assign(new Error((await answer.text()) || `error ${answer.status}`), { gone: answer.status === 404 && app.id && path.startsWith(base()) && !path.includes("/view/") ? app.id : null });
  const type = answer.headers.get("content-type") || "";
  return type.includes("json") ? answer.json() : answer.text();
}
/* Send a file: with progress, and so that Cancel stops it. */
function send(path, file, progress) {
  return new Promise((resolve, reject) => {
    const request = (app.sending = new XMLHttpRequest());
    request.open("PUT", path);
    request.setRequestHeader("X-IRJ", "1");
    request.upload.onprogress = (e) => { if (e.lengthComputable) progress(e.loaded / e.total); };
    request.onload = () => (request.status < 300 ? resolve(JSON.parse(request.responseText)) : reject(new Error(request.responseText || `error ${request.status}`)));
    request.onerror = () => reject(new Error(`${file.name}: the server took no more of it; is it still running, and is there space on its disk?`));
    request.onabort = () => reject(new Error(`${file.name}: cancelled; nothing was changed`));
    request.onloadend = () => { app.sending = null; };
    request.send(file);
  });
}
const base = () => `/api/session/${app.id}`;
const get = (path) => call("GET", base() + path);
const post = (path, body) => call("POST", base() + path, body || {});

function fail(error) {
  if (error.gone && error.gone === app.id) { missing().catch(fail); return; }
  $("error-text").textContent = error.message || String(error);
  $("error").hidden = false;
}
/* The server does not know the session on the screen: the one it was opened on has lost it, or another one has taken its place at this address. */
async function missing() {
  const id = app.id;
  let here = null;
  try { here = (await call("GET", "/api/config")).sessions; } catch (error) { /* another program, or none by now */ }
  if (app.id !== id) return;
  const again = button("Look again", () => act(() => comeBack(id)), { kind: "primary", work: false, id: "gone-again" });
  if (here === app.config.sessions) gone("This session is not there any more", "It was deleted in another tab or on the page of sessions, or its folder was taken away. The other sessions are as they were.");
  else if (here) gone("Another server answers here", "The server of this session was stopped, and another one, with sessions of its own, took its place at this address. Nothing of the session is lost: records and fits are in the folder of the first server. Start that one again, and open the address it prints; or look again, where it is back here.", again);
  else gone("This is no server of the workbench", "The server of this session was stopped, and what answers at its address now is another program. Nothing of the session is lost: start the server again, and open the address it prints; or look again, where it is back here.", again);
}
/* The news were refused: the session is looked for before anything is said of it. */
async function cutOff() {
  const id = app.id;
  try {
    const state = await get("");
    if (state.id === id) { adopt(state); setTimeout(() => { if (app.id === id) listen(); }, 3000); return; }
  } catch (error) { if (error.away) throw error; }
  if (app.id === id) await missing();
}
/* To a session whose server was another one for a while. */
async function comeBack(id) {
  await enter(id);
  app.view = null;
  open(app.state.steps.length ? "ledger" : "load");
}
/* The session on the screen is no more: said once, with the ways on. */
function gone(title, why, first) {
  if (app.source) app.source.close();
  app.id = app.state = app.source = app.then = app.waiting = app.upload = null;
  app.token = (app.token || 0) + 1;
  if (!first && remembered("irj-session")) remembered("irj-session", "");
  clearError(); surround();
  app.plots.forEach((p) => p.destroy());
  app.plots = [];
  const main = $("main");
  main.dataset.view = "gone"; main.dataset.revision = "";
  main.replaceChildren(...heading(title, why),
    h("div", { class: "row" }, first, button("See the sessions", () => open("home"), { kind: first ? "" : "primary", work: false, id: "gone-home" }), button("Start a new session", () => act(fresh), { work: false, id: "gone-fresh" })));
  document.title = `${title} – Joint workbench`;
  drawRails();
  main.focus({ preventScroll: true });
}
function clearError() { $("error").hidden = true; }

/* Ask the server for something. What is asked for while another answer is under way follows it, in order: a field that was changed would show what the server never heard of. The same work twice is once. Tells whether it was done. */
function act(work) {
  if (app.doing.includes(work)) return app.acted;
  app.doing.push(work);
  app.sent = true;
  return (app.acted = app.acted.then(async () => {
    clearError(); surround();
    try { await work(); return true; } catch (error) { fail(error); return false; } finally { app.doing.shift(); app.sent = app.doing.length > 0; surround(); goOn(); }
  }));
}

/* Start long work; `then` is the view to open when it came to its end. */
function run(action, body, then) {
  return act(async () => {
    app.then = null;
    const begun = await post("/run", { action, ...body });
    if (!app.state) return;
    if (then) app.then = { view: then, begun: begun.begun, revision: begun.revision };
    await refresh(); /* from now on the page knows that it runs, or, where it was short, that it has ended */
  });
}

/* A control works from the moment it is shown: what is asked for while other work runs is done when that has ended. A second click on the control whose work runs is no second request. */
function whenIdle(key, work) {
  return (event) => {
    if (!busy()) { app.acting = key; return work(event); }
    if (app.acting !== key) app.waiting = { key, work };
    surround();
  };
}
function goOn() {
  if (busy()) return;
  app.acting = null;
  const next = app.waiting;
  if (!next) return;
  app.waiting = null; app.acting = next.key;
  next.work();
}

function busy() { return Boolean(app.sent || app.upload || (app.state && app.state.job)); }

/* One question about the state at a time, so that an older answer cannot come after a newer one; who asks while one is under way gets the answer of the next. */
function refresh() {
  if (!app.asking) return (app.asking = get("").then(adopt).finally(() => { app.asking = null; }));
  const next = app.asked || (app.asked = app.asking.catch(() => null).then(() => { app.asked = null; return refresh(); }));
  return next;
}

/* Open the view that was asked for with the work, once that has ended: a state from before the work says nothing of it, however late it comes, nor does an error in it. */
function arrive(state) {
  const then = app.then;
  if (!then || state.job || (state.begun !== then.begun && state.revision <= then.revision)) return false;
  app.then = null;
  if (state.error) return false;
  if (typeof then.view === "function") then.view();
  else if (app.view !== then.view) { open(then.view); return true; }
  return false;
}

/* Told before what is known: numbers of one teller only can be compared, a restarted server counts anew. */
function older(news) { return Boolean(app.state) && news.teller === app.state.teller && news.said < app.state.said; }

function adopt(state) {
  if (state.id !== app.id || (app.state && state.id === app.state.id && state.revision < app.state.revision)) return;
  if (app.state && state.id === app.state.id && older(state)) Object.assign(state, { said: app.state.said, job: app.state.job }); /* what was told while the answer was under way is newer */
  const changed = !app.state || state.revision !== app.state.revision || state.id !== app.state.id;
  app.state = state;
  if (arrive(state)) { goOn(); return; }
  const told = [state.id, state.teller, state.begun, state.error].join(); /* how a job ended is said once: asked for again, it would stand over a newer refusal */
  if (state.error && app.endedAs !== told) fail(new Error(state.error));
  app.endedAs = told;
  surround();
  if (changed && !usable(state)[app.view]) open("load");
  else if (changed) render(false);
  goOn();
}

/* A tab that nobody looks at holds no connection: browsers give a host six, and the seventh tab would hang. */
function listen() {
  if (app.source) app.source.close();
  app.source = null;
  if (document.hidden) return;
  app.source = new EventSource(base() + "/events");
  app.source.onerror = (event) => { if (event.target.readyState === EventSource.CLOSED && event.target === app.source) cutOff().catch(fail); }; /* refused, not only out of reach */
  app.source.onmessage = (event) => {
    const news = JSON.parse(event.data);
    if (news.gone) { gone("This session was deleted", "It was deleted in another tab or on the page of sessions; its records and fits went with it. The other sessions are as they were."); return; }
    if (!app.state || older(news)) return;
    const ended = app.state.job && !news.job;
    app.state.job = news.job; app.state.said = news.said; app.state.teller = news.teller;
    surround();
    if (app.upload && !ended && !news.error) return; /* the answer to the upload brings the state */
    if (news.revision !== app.state.revision || ended || news.error) refresh().catch(fail);
  };
}

function usable(state) {
  const fitted = state.steps.length > 0, known = Boolean(state.joint_text);
  return { __proto__: null, home: true, load: true, model: true, compare: fitted, diagnose: fitted, ledger: fitted, parameters: fitted, replay: fitted, plan: known, export: known };
}

function surround() {
  const state = app.state;
  $("nav").closest("nav").hidden = !state; /* a page without a session has no steps */
  if (!state) { $("job").hidden = true; $("undo").disabled = $("redo").disabled = true; $("headline").dataset.text = ""; $("headline").replaceChildren(); return; }
  const fitted = state.steps.length > 0, ready = state.files.some((f) => ["ready", "checking"].includes(f.status));
  const can = usable(state);
  const done = { load: ready, model: Boolean(state.joint_text), compare: fitted, diagnose: Boolean(state.diagnosis), ledger: state.steps.length > 1, parameters: false, replay: false, plan: false, export: false };
  const list = $("nav");
  if (!list.children.length) VIEWS.forEach(([key, name], k) => list.append(h("li", {}, h("button", { type: "button", id: `nav-${key}`, onclick: () => open(key) }, h("span", { class: "count", "aria-hidden": "true" }, String(k + 1)), name))));
  for (const [key] of VIEWS) {
    const button = $(`nav-${key}`);
    button.disabled = !can[key];
    button.title = can[key] ? "" : key === "plan" || key === "export" ? "once the joint is described" : "after the first fit";
    button.className = done[key] ? "done" : "";
    if (key === app.view) button.setAttribute("aria-current", "page"); else button.removeAttribute("aria-current");
  }
  const last = state.steps[state.steps.length - 1];
  const headline = last ? `${digits(last.held_out.relative_error_percent)} %` : "";
  if ($("headline").dataset.text !== headline) { $("headline").dataset.text = headline; $("headline").replaceChildren(...(last ? ["held-out error ", h("strong", {}, headline)] : [])); }
  $("undo").disabled = busy() || !state.can.undo;
  $("redo").disabled = busy() || !state.can.redo;
  const job = app.upload || state.job;
  $("job").hidden = !job;
  if (job) {
    $("job-text").textContent = job.text + (app.waiting ? " …, then what you asked for" : " …"); $("cancel").disabled = Boolean(job.cancelled);
    if (job.share > 0) $("job-bar").value = job.share; else $("job-bar").removeAttribute("value");
  }
  document.querySelectorAll("[data-work]").forEach((b) => { if (busy()) b.setAttribute("aria-disabled", "true"); else b.removeAttribute("aria-disabled"); }); /* not "disabled", which would take the focus and the key with it */
}

/* Each view has its address: back and forward go between them. */
function open(view, { moved = true } = {}) {
  const main = $("main");
  if (moved && app.view === view && drawnNow(main)) { scrollTo(0, 0); main.focus({ preventScroll: true }); return; } /* a second click on a step does not close what was opened in it */
  const address = app.id ? `#session=${app.id}&view=${view}` : `#view=${view}`, same = location.hash === address || app.view === null;
  app.view = view;
  if (moved) try { if (same || !location.hash) history.replaceState(null, "", address); else history.pushState(null, "", address); } catch (error) { location.hash = address; }
  surround();
  showStep();
  render(true);
}
/* On a phone the steps are wider than the screen: the one that is open stands in its middle. */
function showStep() {
  const here = $(`nav-${app.view}`);
  if (here) here.closest(".steps").scrollLeft = here.offsetLeft - here.closest(".steps").clientWidth / 2 + here.offsetWidth / 2;
}

/* Where the focus is: by id, else by its place among the elements of its kind. */
function placeOf(node, root) { return { id: node.id, tag: node.tagName, place: [...root.querySelectorAll(node.tagName)].indexOf(node) }; }

/* Draw something anew: the focus stays on the same control and the caret in its place; where the view is another one, it has the focus. */
function keepingFocus(root, draw, moved) {
  const node = document.activeElement, focused = !moved && root.contains(node) ? placeOf(node, root) : null;
  const caret = focused && typeof node.selectionStart === "number" ? [node.selectionStart, node.selectionEnd] : null;
  draw();
  const same = moved ? root : focused && (focused.id ? $(focused.id) : root.querySelectorAll(focused.tag)[focused.place]);
  if (!same) return;
  same.focus({ preventScroll: true });
  if (caret && same === document.activeElement && typeof same.selectionStart === "number") same.setSelectionRange(...caret);
}

/* Whether the screen shows the view that is open, as the state has it; the list of sessions is asked for again. */
const drawnNow = (main) => Boolean(app.state) && app.view !== "home" && main.dataset.view === app.view && main.dataset.session === app.id && main.dataset.revision === String(app.state.revision);

/* Plots of a drawing that another one overtook: nobody sees them, and they get no data any more. */
function dropUnseen() {
  const unseen = app.plots.filter((p) => p.host && !p.host.isConnected);
  unseen.forEach((p) => p.destroy());
  app.plots = app.plots.filter((p) => !unseen.includes(p));
}

/* Draw the view again; the focus stays on the same control. */
function render(moved) {
  const where = moved ? 0 : scrollY;
  app.old.push(...app.plots); /* they stand until the new ones do: a plot would be blank for a moment */
  app.plots = [];
  const main = $("main");
  const token = (app.token = (app.token || 0) + 1);
  app.drawn = null; /* until a picture is drawn for the width there is */
  placeRails();
  delete main.dataset.view; /* what is on the screen is the old one until the new one is drawn */
  Promise.resolve(views[app.view](app.state)).then((nodes) => {
    if (token !== app.token) { if (main.dataset.view) dropUnseen(); return; }
    keepingFocus(main, () => { /* the focus of now, not of when the drawing began */
      main.replaceChildren(...[nodes].flat(3).filter(Boolean));
      app.old.splice(0).forEach((p) => p.destroy());
      main.dataset.view = app.view; main.dataset.session = app.id || ""; main.dataset.revision = app.state ? app.state.revision : "";
      document.title = `${(VIEWS.find((v) => v[0] === app.view) || ["", "Sessions"])[1]} – Joint workbench`;
      drawRails();
      surround();
      const after = app.after || [];
      app.after = [];
      after.forEach((f) => f());
      dropUnseen();
    }, moved);
    scrollTo(0, where);
  }).catch(fail);
}

/* Draw the preview; resolves when it is on the screen. */
async function showPreview(file, data) {
  if (!app.upload || app.view !== "load" || !app.state || app.state.files.length) return;
  app.preview = { file: file.name, data };
  render(false);
  const frame = () => new Promise((go) => requestAnimationFrame(go));
  await frame(); await frame();
}

async function upload(files) {
  clearError();
  const list = [...files].sort((a, b) => b.name.endsWith(".toml") - a.name.endsWith(".toml"));
  await app.acted; /* a session that is being opened is the one they are for */
  const id = app.id;
  for (const file of list) {
    if (app.id !== id) break; /* another one was opened meanwhile: these are not for it */
    if (file.size > app.config.max_upload) { fail(new Error(`${file.name}: ${Math.round(file.size / 1e6)} MB is over the limit of ${Math.round(app.config.max_upload / 1e6)} MB; cut it, save it as NPZ, or start with: irj app FILE`)); continue; }
    app.upload = { text: `sending ${file.name}`, share: 0 };
    surround();
    const share = (value) => { app.upload = { text: `${value < 1 ? "sending" : "reading"} ${file.name}`, share: value < 1 ? value : 0 }; surround(); };
    const look = !app.preview && app.view === "load" && !app.state.files.length && preview(file);
    if (look) await Promise.race([look.then((data) => data && showPreview(file, data)), new Promise((go) => setTimeout(go, 400))]); /* the sending would share the machine with it */
    const sent = send(`${base()}/files/${encodeURIComponent(file.name)}?points=${plotPoints(($("main").clientWidth || 800) - 40)}`, file, share);
    try {
      const made = await sent;
      app.first = made.plot && { file: made.id, revision: made.state.revision, data: made.plot };
      adopt(made.state);
    } catch (error) { fail(error); }
  }
  const had = app.preview;
  app.upload = null;
  app.preview = null;
  surround(); /* the bar goes at once, also where the server does not answer any more */
  await refresh().catch(fail);
  if (had && app.id === id && app.state && !app.state.files.length) render(false);
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "Light" : "Dark";
  $("theme").setAttribute("aria-label", name === "dark" ? "Use light colours" : "Use dark colours");
}

function remembered(key, value) {
  try { if (value === undefined) return localStorage.getItem(key); localStorage.setItem(key, value); } catch (error) { return null; }
  return value;
}

async function enter(id) {
  const was = { id: app.id, state: app.state, drafts: app.drafts, draftsOf: app.draftsOf };
  app.id = id; app.state = null;
  if (app.draftsOf !== id) Object.assign(app, { drafts: {}, draftsOf: id }); /* one that comes back is edited on */
  try { [app.state, app.config] = await Promise.all([get(""), call("GET", "/api/config")]); } catch (error) { /* the session that was open stays */
    Object.assign(app, was);
    throw error.gone ? new Error("the server here has no such session; see Sessions for those that it keeps") : error;
  }
  remembered("irj-session", id);
  listen();
}

async function fresh() {
  await enter((await call("POST", "/api/session")).id);
  open("load");
}

async function boot() {
  const dark = matchMedia("(prefers-color-scheme: dark)"), wished = () => remembered("irj-theme") || (dark.matches ? "dark" : "light");
  theme(wished());
  dark.addEventListener("change", () => { theme(wished()); render(false); });
  WIDE.addEventListener("change", () => { if (app.view) render(false); });
  let turned = null;
  addEventListener("resize", () => { clearTimeout(turned); turned = setTimeout(() => { showStep(); if (app.drawn && Math.abs(pictureRoom() / app.drawn - 1) > 0.1) render(false); }, 200); }); /* of a phone that was turned, pictures are drawn anew: their letters would shrink or be cut */
  $("theme").addEventListener("click", () => { const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark"; remembered("irj-theme", next); theme(next); render(false); });
  $("undo").addEventListener("click", () => run("undo"));
  $("redo").addEventListener("click", () => run("redo"));
  $("cancel").addEventListener("click", () => { app.waiting = null; if (app.sending) app.sending.abort(); else post("/cancel").catch(fail); });
  $("fresh").addEventListener("click", () => act(fresh));
  $("home").addEventListener("click", () => open("home"));
  $("error-close").addEventListener("click", clearError);
  document.addEventListener("visibilitychange", () => { if (app.id) { listen(); if (!document.hidden && app.state) refresh().catch(fail); } });
  addEventListener("dragover", (e) => { e.preventDefault(); document.querySelectorAll(".drop").forEach((d) => d.classList.add("over")); });
  addEventListener("dragleave", () => document.querySelectorAll(".drop").forEach((d) => d.classList.remove("over")));
  addEventListener("drop", (e) => { e.preventDefault(); if (e.dataTransfer && e.dataTransfer.files.length) { if (app.view !== "load") open("load"); upload(e.dataTransfer.files); } });
  addEventListener("popstate", () => {
    const asked = new URLSearchParams(location.hash.slice(1)), view = asked.get("view");
    if (asked.get("home")) { /* the printed address, pasted into an open tab */
      remembered("irj-home", asked.get("home"));
      const other = asked.get("session");
      if (other && other !== app.id) enter(other).then(() => open("load")).catch(fail); else { app.view = null; open("home"); }
      return;
    }
    if (!app.state && view !== "home" && !asked.get("session")) return;
    const shown = () => open(usable(app.state)[view] ? view : "load", { moved: false });
    if (asked.get("session") && asked.get("session") !== app.id) enter(asked.get("session")).then(shown).catch(fail); else if (view) shown();
  });
  addEventListener("keydown", (e) => {
    if (!(e.ctrlKey || e.metaKey) || e.altKey || e.target.matches("input:not([type=checkbox]):not([type=radio]), textarea")) return;
    const key = e.key.toLowerCase(), asked = key === "y" || (key === "z" && e.shiftKey) ? "redo" : key === "z" ? "undo" : null;
    if (asked && !$(asked).disabled) { e.preventDefault(); run(asked); }
  });
  await act(start); /* what is clicked meanwhile follows */
}

async function start() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const known = asked.get("session") || remembered("irj-session");
  if (asked.get("home")) remembered("irj-home", asked.get("home"));
  let lost = null;
  try { if (!known) throw new Error(); await enter(known); } catch (error) { if (asked.get("session")) lost = error; await enter((await call("POST", "/api/session")).id); }
  const wanted = asked.get("view");
  open((VIEWS.some(([key]) => key === wanted) && (app.state.steps.length || ["load", "model"].includes(wanted))) || wanted === "home" ? wanted : app.state.steps.length ? "ledger" : "load");
  if (lost) fail(new Error(`${lost.message}. This is a new session.`));
}
addEventListener("DOMContentLoaded", () => boot().catch(fail));
