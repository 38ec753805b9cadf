"use strict";
/* One function per view: from the state to the nodes of the main region. */
const later = (f) => { (app.after = app.after || []).push(f); };
const button = (text, onclick, { kind = "", id, off, work = true, label, key } = {}) => h("button", { type: "button", class: kind, id, onclick: work ? whenIdle(key || id || label || text, onclick) : onclick, "aria-label": label, "data-work": work ? "1" : null, "data-off": off ? "1" : null, disabled: Boolean(off) }, text);
const sentence = (text, end = ".") => text.charAt(0).toUpperCase() + text.slice(1) + (text.endsWith(end) ? "" : end);
const plural = (n, one, many) => `${n.toLocaleString("en")} ${n === 1 ? one : many || one + "s"}`;
const effectTitle = (label) => { const [key, at] = label.split("#")[0].split("@"), e = app.config.effects.find((x) => x.key === key); return (e ? e.title : key.replace(/_/g, " ")) + (at ? ` (${at.replace(/_/g, " ")})` : ""); };
/* Channels and keys of the joint file as a person says them: their names stand in what the check says, column names in quotes stay. What a file has under [columns], the page has behind a button. */
const JOINT_KEYS = ["gear_ratio", "motor_constant", "torque_per_current", "torque_per_voltage"];
const plainly = (text) => text.replace(/(?<!['"\w])[a-z]+(?:_[a-z]+)+(?!['"\w])/g, (name) => (app.config.channels.includes(name) || JOINT_KEYS.includes(name) ? name.replace(/_/g, " ") : name)).replace(/in \[columns\]/g, "under Columns on the Load page");
/* What the diagnosis asks for, where the page has fields for it. */
const askedFor = (why, where) => why.replace(/give (.*) in \[known\]/, (_, what) => `give ${what.replace(/_/g, " ")} ${where}`);
const SEVERITY = { refuse: ["bad", "refused"], repair: ["warn", "repaired"], warn: ["warn", "check"], ok: ["good", "fine"] };

function heading(title, lead) { return [h("h1", {}, title), lead && h("p", { class: "lead" }, lead)]; }

function plotControls(plot, extra) {
  return h("div", { class: "row" }, extra, button("Zoom in", () => plot.move(0.5), { kind: "quiet", work: false }), button("Zoom out", () => plot.move(2), { kind: "quiet", work: false }),
    button("◀", () => plot.move(1, -0.5), { kind: "quiet", work: false, label: "Earlier" }), button("▶", () => plot.move(1, 0.5), { kind: "quiet", work: false, label: "Later" }),
    button("Whole record", () => plot.show(null), { kind: "quiet", work: false }));
}

const views = {
  load(state) {
    const input = h("input", { type: "file", multiple: "", id: "files", "aria-label": "Measurement files and joint file", onchange: (e) => upload(e.target.files) });
    const drop = h("div", { class: "drop" }, h("h2", {}, "Drop measurement files here"), h("p", { class: "soft" }, "CSV, MAT, NPZ, HDF5, Parquet, MDF, ROS bag; a joint file (TOML) too. They stay on this machine."), input);
    if (!state.files.length && app.preview) return [heading("Records"), previewCard()];
    if (!state.files.length) return [
      heading("Which physics is your joint model missing?", "Load records of a joint, fit a model, see where it fails, add the missing effect and watch the error fall."),
      h("div", { class: "first" }, drop, h("div", { class: "card" }, h("h2", {}, "No data at hand?"), h("p", {}, "The demo is a simulated harmonic-drive joint whose model lacks one effect. Find it in four clicks."),
        button("Try the demo", () => act(async () => { await post("/demo"); await refresh(); }), { kind: "primary", id: "demo" }))),
    ];
    const ready = state.files.filter((f) => ["ready", "checking"].includes(f.status));
    const next = state.joint_text
      ? button("Fit the start model", () => run("fit", {}, "compare"), { kind: "primary", id: "fit", off: !ready.length })
      : button("Next: describe the joint", () => open("model"), { kind: "primary", id: "to-model", work: false });
    return [
      h("div", { class: "row between head" }, h("div", {}, heading("Records")), next),
      state.joint_text ? h("p", { class: "soft" }, "Joint: ", h("strong", {}, jointLine(state)), " ", h("button", { type: "button", class: "quiet", onclick: () => open("model") }, "Change")) : h("p", { class: "soft" }, "No joint described yet: gear ratio, motor constant and start model come next."),
      state.files.map(fileCard), ready.length ? seriesCard(ready) : null, ready.length ? againstCard(ready) : null, drop, state.fits && !railed() ? treeCard(state) : null,
    ];
  },

  async model(state) {
    const { text, form, known } = await get("/view/joint"), seen = state.files.find((f) => f.kind);
    if (!form.kind && seen) form.kind = seen.kind;
    const own = (m) => app.config.models[m] || [];
    const side = (k) => { /* the units of the drive, for a rotary or a linear axis */
      const force = k === "linear";
      return { torque_per_current: `${force ? "Force" : "Torque"} per current [${force ? "N/A" : "N·m/A"}], on the link side`, torque_per_voltage: `${force ? "Force" : "Torque"} per volt [${force ? "N/V" : "N·m/V"}], on the link side` };
    };
    const relabel = (k) => Object.entries(side(k)).forEach(([id, text]) => { document.querySelector(`label[for=${id}]`).textContent = text; });
    const field = (id, label, value, hint, more) => h("div", { class: "field" }, h("label", { for: id }, label), h("input", { id, value: value == null ? "" : String(value), "aria-describedby": `${id}-hint`, autocomplete: "off", ...more }), h("span", { class: "small soft", id: `${id}-hint` }, hint));
    const select = h("select", { id: "model" }, Object.keys(app.config.models).map((m) => h("option", { value: m, selected: (form.model || "hd1") === m }, MODEL_TITLES[m] ? `${m}: ${MODEL_TITLES[m]}` : m)));
    const start = app.config.start, common = start.offered;
    const chosen = new Set(form.effects || (text ? [] : start.effects));
    const box = (key, title) => h("label", { class: "check" }, h("input", { type: "checkbox", name: "effect", value: key, checked: chosen.has(key) }), title);
    const others = app.config.effects.filter((e) => !common.includes(e.key)), exact = [...chosen].filter((c) => !app.config.effects.some((e) => e.key === c));
    const read = () => ({
      name: $("name").value, kind: document.querySelector("[name=kind]:checked").value, gear_ratio: $("gear_ratio").value, motor_constant: $("motor_constant").value,
      torque_per_current: $("torque_per_current").value, torque_per_voltage: $("torque_per_voltage").value, model: $("model").value,
      effects: [...document.querySelectorAll("[name=effect]:checked")].map((c) => c.value), known: knownAll(node),
    });
    const draft = jointDraft(text), moved = draft.text !== text && !draft.saving;
    const unfolded = others.some((e) => chosen.has(e.key) || `effect=${e.key}` in draft.typed);
    let edited = !text || fieldsTyped(draft).length > 0;
    const both = bothEdited(draft), askBoth = () => { both.hidden = !fieldsTyped(draft).length || $("joint-text").value === text; };
    const save = async () => {
      if (!both.hidden) throw new Error("the fields and the joint file were both edited; say above the button which of the two is saved");
      await saveJoint(draft, $("joint-text").value !== text ? { text: $("joint-text").value, source: state.joint_source || "joint" } : edited ? read() : null);
    };
    const node = h("form", { oninput: (e) => { if (e.target.id !== "joint-text") edited = true; }, onsubmit: (e) => e.preventDefault() },
      h("div", { class: "two" }, h("div", { class: "card" }, h("h2", {}, "The joint"),
        field("name", "Name", form.name || "joint", "As it appears in the report."),
        h("fieldset", {}, h("legend", {}, "Kind"), h("div", { class: "row" }, ["rotary", "linear"].map((k) => h("label", { class: "check" }, h("input", { type: "radio", name: "kind", value: k, id: `kind-${k}`, onchange: () => relabel(k), checked: (form.kind || "rotary") === k }), k)))),
        field("gear_ratio", "Gear ratio", form.gear_ratio ?? "", "Motor angle over link angle, with its sign: −160 where the link turns the other way. 1 where everything is measured on one side.", { inputmode: "decimal" }),
        h("fieldset", {}, h("legend", {}, "Drive: one of these, none where the torque itself is recorded"),
          field("motor_constant", "Motor constant [N·m/A], on the motor shaft", form.motor_constant, "From the motor's data sheet.", { inputmode: "decimal" }),
          field("torque_per_current", side(form.kind).torque_per_current, form.torque_per_current, "Motor constant times gear ratio.", { inputmode: "decimal" }),
          field("torque_per_voltage", side(form.kind).torque_per_voltage, form.torque_per_voltage, "Where only a voltage or a controller output is recorded.", { inputmode: "decimal" }))),
      h("div", { class: "card" }, h("h2", {}, "The start model"), h("div", { class: "field" }, h("label", { for: "model" }, "Model"), select, h("span", { class: "small soft" }, "Start simple: the diagnosis says what is missing.")),
        h("fieldset", {}, h("legend", {}, "Effects in it from the start"), h("div", { class: "checks" }, common.map((k) => box(k, effectTitle(k))), exact.map((k) => box(k, effectTitle(k)))),
          h("details", { open: unfolded }, h("summary", {}, `All others (${others.length})`), h("div", { class: "checks" }, others.map((e) => box(e.key, e.title))))),
        h("details", { open: "joint-text" in draft.typed }, h("summary", {}, "As joint file (TOML), with known values and column map"), h("label", { for: "joint-text" }, "Joint file"), h("textarea", { id: "joint-text", spellcheck: "false", value: text })))),
      knownCard(known, draft.added), both,
      h("div", { class: "row" }, button("Save and fit", () => act(save).then((done) => { if (done) run("fit", {}, "compare"); }), { kind: "primary", id: "save-fit", off: !state.files.some((f) => ["ready", "checking", "columns"].includes(f.status)) }),
        button("Save", () => act(save), { id: "save" })));
    keepTyped(node, draft.typed);
    node.addEventListener("input", askBoth);
    node.addEventListener("input", () => storeDraft(draft));
    later(() => { askBoth(); storeDraft(draft); });
    const kind = node.querySelector("[name=kind]:checked").value;
    later(() => relabel(kind));
    return [heading("Model", "What is known about the joint, and the model to start from. Everything else has a start value and bounds derived from the records."), moved ? movedJoint(draft, text) : null, node];
  },

  async compare(state) {
    const found = await get(`/view/compare?${widthsAsked()}`);
    const last = state.steps[state.steps.length - 1];
    const balances = Object.keys(found.error.balances), host = h("div", { class: "plot" });
    const draft = app.drafts.compare || (app.drafts.compare = {});
    let balance = balances.includes(draft.balance) ? draft.balance : found.worst.balance;
    forgetCharts();
    const plot = new SeriesPlot(host, (range, points) => get(`/view/balance?balance=${balance}&points=${points}${range ? `&from=${range[0]}&to=${range[1]}` : ""}`), { title: `Measured ${effort()}, model and residual`, panels: [["measured", "model"], ["residual", "noise, upper", "noise, lower"]], side: "at the link" });
    plot.marks = () => linked.marks; linked.plot = plot; plot.low = railed();
    plot.onCursor = (index) => plot.data && cursorInCharts(plot.data)(index);
    app.plots.push(plot);
    later(() => plot.show([found.worst.low, found.worst.high]).catch(fail));
    const pick = h("select", { id: "balance", "aria-label": "Balance in the time plot", onchange: (e) => { balance = draft.balance = e.target.value; plot.forget(); plot.show(plot.range).catch(fail); } }, balances.map((b) => h("option", { value: b, selected: b === balance }, `${b} balance`)));
    const strong = found.places.filter((p) => p.tells), shown = strong.length ? strong : found.places.slice(0, 1), rest = found.places.filter((p) => !shown.includes(p));
    const figure = (p) => chartFigure([`${p.balance} balance against ${p.title}`, h("span", {}, p.tells ? `explains ${digits(p.share_percent, 2)} % of the residual's variance on blocks it was not drawn from` : "no dependence beyond chance")], p.chart, { name: `${p.balance} residual against ${p.title}`, axis: p.axis, brush: markInTime(p.axis) });
    const curves = await get(`/view/as-such?${widthsAsked()}`);
    const inTime = h("section", { class: railed() ? "card in-time" : "card gap" }, h("h2", {}, "In time, at the worst two seconds"), h("p", { class: "soft small" }, "Drag to zoom: up close every row is drawn. The strip below shows the whole record: drag across it to look elsewhere. Dotted: what noise alone keeps the residual within, 95 times in 100; where a joint turns back or creeps it allows more."),
        plotControls(plot, [pick, button("Worst window", () => plot.show([found.worst.low, found.worst.high]), { kind: "quiet", work: false })]), host);
    if (railed()) later(() => { /* all above the plot scrolls away, the plot itself stays */
      const top = (node) => node.getBoundingClientRect().top;
      inTime.style.setProperty("--head", `${Math.round(top(host) - top(inTime) - 6)}px`);
    });
    return [
      h("div", { class: "row between head" }, h("div", {}, heading("Where does the model fail?")), button("What is missing? Diagnose", () => run("diagnose", {}, "diagnose"), { kind: "primary", id: "diagnose" })),
      state.note ? h("p", { class: "note small" }, sentence(state.note)) : null,
      h("div", { class: "tiles" }, h("div", { class: "card" }, h("p", { class: "soft" }, "Held-out error"), h("div", { class: "figure", id: "held-out-error" }, `${digits(found.error.relative_error_percent)} %`), h("p", { class: "small soft" }, `of the measured ${effort()} is not explained, on records the fit did not see (${found.records.join(", ")}). On the fit's own: ${digits(last.train.relative_error_percent)} %.`)),
        balances.map((b) => { const e = found.error.balances[b]; return h("div", { class: "card" }, h("p", { class: "soft" }, `${b} balance`), h("div", { class: "figure" }, digits(e.ratio), h("small", {}, " ", term("÷ noise", "× noise"))), h("p", { class: "small soft" }, `residual ${digits(e.rms)} ${unit(e.unit)} rms; noise alone would leave ${digits(e.floor)}. ${e.ratio < 1.5 ? "Down to the noise." : "There is something left."}`)); })),
      railed() ? inTime : null, /* it stays in sight while a place below it is brushed */
      h("h2", { class: "gap" }, strong.length ? "Places where the residual is not chance" : "No place stands out"),
      strong.length ? h("p", { class: "soft" }, `Line: mean residual; shade: 95 % band. The ${strong[0].balance} balance fails most clearly against ${strong[0].title}.`) : h("p", { class: "soft" }, nowhere(found)),
      h("div", { class: "grid" }, shown.map(figure)),
      h("details", {}, h("summary", {}, `Other places (${rest.length})`), h("div", { class: "grid" }, rest.map(figure))),
      curves.length ? h("section", { class: "gap", id: "as-such" }, h("h2", {}, "Curves as such"), h("p", { class: "soft" }, "◆ as measured, with a band of 95 %; line: as the model has it."), h("div", { class: "grid" }, curves.map((c) => chartFigure([c.title, h("span", {}, `${c.balance} balance`)], c.chart, { name: `${c.title}, ${c.balance} balance` })))) : null,
      patternCard(found.pattern),
      railed() ? null : inTime,
    ];
  },

  async diagnose(state) {
    const d = state.diagnosis, asks = d && d.not_testable.some((n) => n.asks && n.asks.length), { known } = asks ? await get("/view/joint") : { known: [] };
    const again = button(d ? "Diagnose again" : "Diagnose", () => run("diagnose", {}, "diagnose"), { kind: d ? "" : "primary", id: "diagnose" });
    if (!d) return [h("div", { class: "row between head" }, h("div", {}, heading("What is missing?", "Every effect of the library is tried in every place of the current model, and judged on blocks and records it was not fitted to.")), again)];
    const { clear, faint } = rankedCards(d), curves = d.learned || [], wide = railed();
    const panel = lawsOf(d).length ? new LawPanel(lawsOf(d), noteOf(d)) : null;
    if (panel) later(() => panel.begin());
    const learned = curves.length ? h("div", { class: "card", id: "learned" }, h("h2", {}, "Curves without a name"), curveList(curves)) : null;
    return [
      h("div", { class: "row between head" }, h("div", {}, heading("What is missing?")), again),
      claimCard(d),
      d.warnings.map((w) => h("p", { class: "note small" }, sentence(plainly(w)))),
      wide ? [panel && panel.node, learned] : [ /* the ranking stands at the right then */
        clear ? h("div", { class: "two ranking" }, clear, panel.node) : null,
        learned ? h("div", { class: "two ranking" }, learned, clear ? null : panel.node) : null, faint],
      d.refused && d.refused.length ? h("details", { class: "card", id: "refused" }, h("summary", {}, `Why not another? (${d.refused.length})`), h("ul", {}, d.refused.map((r) => h("li", {}, h("strong", {}, effectTitle(r.effect)), `: ${r.why.startsWith("with ") ? "" : "it "}${r.why.replace(/(?<=[ e])-(?=\d)/g, "−")}.`)))) : null,
      d.not_testable.length ? h("details", { class: "card" }, h("summary", {}, `Not testable with these records (${d.not_testable.length})`), h("ul", {}, d.not_testable.map((n) => h("li", {}, h("strong", {}, n.title), `: ${plainly(n.asks && n.asks.length ? askedFor(n.why, "here") : n.why)}.`, n.asks && n.asks.length ? knownAsk(n, known) : null)))) : null,
      glossaryCard(),
    ];
  },

  async ledger(state) {
    const [library, stairs] = await Promise.all([get("/view/library"), get(`/view/staircase?width=${Math.round(pictureWidth(560))}&whole=${columnWidths().whole}`)]), steps = state.steps, last = steps[steps.length - 1], before = steps.length > 1 ? steps[state.improvement ? 0 : steps.length - 2] : null; /* the whole loop is told from its start */
    const now = last.held_out.relative_error_percent, was = before && before.held_out.relative_error_percent;
    const story = state.improvement, inside = last.effects.filter((e) => e !== app.config.hold) /* found in each record: nobody added it, nobody can take it out */;
    const needed = new Set(library.filter((e) => e.needed).map((e) => e.label)); /* others build on them */
    const add = h("select", { id: "add-label", "aria-label": "Effect to add", onchange: (e) => { app.drafts.add = e.target.value; } }, library.filter((e) => !e.inside).map((e) => h("option", { value: e.label, selected: e.label === app.drafts.add }, `${e.title} (${e.place.replace(/_/g, " ")})`)));
    return [
      h("div", { class: "row between head" }, h("div", {}, heading(before ? (now < was ? `The error falls from ${digits(was)} to ${digits(now)} %` : `The error is ${digits(now)} %, from ${digits(was)} %`) : `The error is ${digits(now)} %`, "Each step is fitted to the training records and judged on records the fit did not see.")),
        h("div", { class: "row" }, button(steps.length > 1 ? "What else is missing?" : "What is missing? Diagnose", () => run("diagnose", {}, "diagnose"), { kind: "primary", id: "diagnose" }), button("Take it home", () => open("export"), { work: false, id: "to-export" }))),
      state.note && last.exact ? h("p", { class: "note small" }, sentence(state.note)) : null,
      !last.settled ? h("p", { class: "note", id: "first-look", role: "status" }, "First look: two steps from the diagnosis. The whole fit follows by itself …") : null,
      !last.exact ? h("p", { class: "note" }, `${sentence(state.note || "fitted and judged on a part of the samples")} `, button("Confirm on every sample", () => run("confirm"), { kind: "quiet", id: "confirm" })) : null,
      story ? h("p", { class: `note outcome ${outcomeOf(story)}`, id: "verdict" }, h("strong", {}, sentence(story.headline || story.verdict.replace(/_/g, " ")) + " "), sentence(story.reason)) : null,
      story && story.printed ? foundCard(story) : null,
      h("div", { class: "two" }, h("figure", { class: "card", id: "staircase" }, h("figcaption", {}, "The falling staircase", h("span", {}, "dotted: ", term("noise floor"))), new ServedChart(stairs.stairs, { name: "The falling staircase" }).node),
        h("div", { class: "card" }, h("h2", {}, "In the model now"), h("ul", { class: "plain" }, inside.map((e) => h("li", {}, h("div", { class: "row between" }, effectTitle(e), button("Remove", () => run("remove", { label: e }), { kind: "quiet", label: `Remove ${effectTitle(e)}`, off: needed.has(e) })))))),
      ),
      stairs.told ? h("div", { class: "grid" }, chartFigure([`The place that told: ${stairs.told.name}`, h("span", {}, `${stairs.told.balance} balance, before (◆) and after (■); line: what it explains`)], stairs.told.chart, { name: "The place that told", kind: "told" })) : null,
      h("div", { class: "card scroll", tabindex: "0", role: "region", "aria-label": "Ledger" }, h("table", { class: "stack" }, h("caption", {}, "Ledger"), h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Step"), h("th", { scope: "col", class: "num" }, "Held-out error"), h("th", { scope: "col", class: "num" }, term("fit", "Fit")), h("th", { scope: "col", class: "num" }, term("VAF")), Object.keys(last.held_out.balances).map((b) => h("th", { scope: "col", class: "num" }, [`${b} `, term("÷ noise")])))),
        h("tbody", {}, steps.map((s, k) => h("tr", { class: k === steps.length - 1 ? "now" : null }, h("td", {}, stepName(s)), h("td", { class: "num", "data-label": "Held-out error" }, `${digits(s.held_out.relative_error_percent)} %`), h("td", { class: "num", "data-label": "Fit" }, `${digits(s.held_out.fit_percent)} %`), h("td", { class: "num", "data-label": "VAF" }, `${vaf(s.held_out.vaf_percent)} %`), Object.keys(last.held_out.balances).map((b) => h("td", { class: "num", "data-label": `${b} ÷ noise` }, s.held_out.balances[b] ? digits(s.held_out.balances[b].ratio) : "–"))))))),
      railed() ? null : treeCard(state),
      lawCard(state),
      h("div", { class: "card" }, h("h2", {}, "By hand"), h("div", { class: "row" }, add, button("Add", () => run("add", { label: $("add-label").value }), { id: "add-by-hand", label: "Add the chosen effect" }), button("Run the whole loop", () => run("improve", {}, "ledger"), { id: "improve" })), h("p", { class: "small soft" }, "The whole loop diagnoses and adds until nothing is left to name; it starts from the start model again.")),
    ];
  },

  async parameters(state) {
    const table = await get("/view/parameters"), error = state.steps[state.steps.length - 1].held_out.relative_error_percent, rows = Object.entries(table).filter(([, p]) => !p.nuisance);
    const enough = (p) => (p.stderr > 0 && p.value ? Math.min(9, Math.max(2, 2 + Math.floor(Math.log10(Math.abs(p.value))) - Math.floor(Math.log10(p.stderr)))) : 4);
    const band = (p) => p.stderr == null ? "–" : `${digits(p.value - 1.96 * p.stderr, enough(p))} … ${digits(p.value + 1.96 * p.stderr, enough(p))}`;
    const flags = (p) => [p.held && h("span", { class: "tag" }, "held"), p.at_bound && h("span", { class: "tag warn" }, "at its bound"), p.identifiable === false && h("span", { class: "tag warn" }, "not identified"), p.correlation && Math.abs(p.correlation.value) > 0.95 && h("span", { class: "tag warn" }, `tied to ${words(p.correlation.with)}`)].filter(Boolean);
    return [heading("Parameters", "Standard errors come from the scatter between windows of time that overlap. All values are referred to the link."),
      h("div", { class: "card scroll", tabindex: "0", role: "region", "aria-label": "Table of parameters" }, h("table", { class: "stack" }, h("thead", {}, h("tr", {}, ["Parameter", "Value", "± std. error", "95 % band", "Unit", "Side", "Flags"].map((t, k) => h("th", { scope: "col", class: k > 0 && k < 4 ? "num" : null }, t)))),
        h("tbody", {}, rows.map(([name, p]) => h("tr", {}, h("td", {}, words(name), h("div", { class: "small soft" }, p.meaning)), h("td", { class: "num", "data-label": "Value" }, digits(p.value, 5)), h("td", { class: "num", "data-label": "± std. error" }, digits(p.stderr, 2)), h("td", { class: "num", "data-label": "95 % band" }, band(p)), h("td", { "data-label": "Unit" }, unit(p.unit) || "–"), h("td", { "data-label": "Side" }, p.side), h("td", { "data-label": "Flags" }, h("div", { class: "row" }, flags(p).length ? flags(p) : h("span", { class: "soft" }, "–")))))))),
      besideCard(state),
      slidersCard(table, error)];
  },

  async export(state) {
    const { code } = await get("/view/code"), fitted = state.steps.length > 0, story = state.improvement;
    const without = story && story.without && story.exact === state.steps.at(-1)?.exact ? ` It is ${story.without}.` : "";
    const link = (name, text, note) => h("div", { class: "card" }, h("h2", {}, text), h("p", { class: "soft" }, note), h("a", { class: "button primary", href: `${base()}/view/${name}`, download: "", id: `get-${name.replace(".", "-")}` }, "Download"));
    const made = (action, name, text, note, on, { fields, body } = {}) => h("div", { class: "card" }, h("h2", {}, sentence(text, "")), h("p", { class: "soft" }, note), on ? fields : null, on ? button(`Make the ${text}`, () => run(action, body || {}, () => { const a = h("a", { href: `${base()}/view/${name}`, download: "" }); document.body.append(a); a.click(); a.remove(); }), { kind: "primary", id: `make-${action}`, off: !fitted }) : h("p", { class: "small" }, "Not available in this installation."));
    const paper = app.drafts.report || (app.drafts.report = { author: "", notes: "" });
    const said = (key, more) => ({ id: `report-${key}`, value: paper[key], ...more,
      oninput: (e) => { paper[key] = e.target.value; } });
    const hint = "for the first page, as what was changed before";
    const about = h("div", { class: "field" },
      h("label", { for: "report-author" }, "Author"), h("input", said("author", { autocomplete: "name" })),
      h("label", { for: "report-notes" }, "Notes"),
      h("textarea", said("notes", { class: "short", rows: "3", placeholder: hint })));
    const copied = h("span", { class: "small good", role: "status" });
    return [heading("Take it home"), h("div", { class: "grid" },
      link("joint.toml", "Joint file", fitted ? "The joint with its fitted values, standard errors and provenance. It is a joint file again." + without : "The joint as it was described; nothing is fitted yet."),
      made("report", "report.html", "report", "One HTML file that opens offline: verdict, staircase, places before and after, parameters.", app.config.report, { fields: about, body: paper }),
      made("plant", "plant.fmu", "FMU of the joint", "The fitted joint as a simulation unit (FMI 2.0) for other tools; needs a C compiler on this machine.", app.config.fmu),
      made("estimator", "estimator.fmu", "FMU of the estimator", "The online estimator with this joint's values; it carries its Python along.", app.config.fmu)),
      h("section", { class: "card" }, h("h2", {}, "Copy as code"), h("p", { class: "soft" }, "Python that does this session again, with the same errors. Run it in the folder of the measurement files."), h("div", { class: "row" }, button("Copy", () => navigator.clipboard.writeText(code).then(() => { copied.textContent = "copied"; }, () => { copied.textContent = "not allowed; select the text instead"; }), { work: false, id: "copy" }), h("a", { class: "button", href: `${base()}/view/session.py`, download: "" }, "Download"), copied), h("pre", { tabindex: "0", "aria-label": "Python code" }, h("code", {}, code)))];
  },
};

/* What the diagnosis names, with its reason; in short the rest is folded. */
function claimCard(d, short) {
  const claim = d.claim, reason = h("p", { id: "reason" }, sentence(d.reason || ""));
  const rest = [
    claim ? h("p", {}, claim.effects.length > 1 ? `These records cannot tell the ${claim.effects.length} apart.${claim.separate_by ? ` ${sentence(claim.separate_by, "")} would.` : ""}` : `The ${claim.balance} balance says so: with it the held-out residual there falls by ${digits(claim.held_out_drop_percent, 2)} %${claim.kernel_s ? ` in rows of ${digits(claim.kernel_s, 2)} s, whose noise is lower` : ""}.`) : null,
    claim && claim.confidence ? h("p", { class: "small soft", id: "confidence" }, `By the likelihoods of whole fits: ${Object.entries(claim.confidence).map(([k, p]) => `${p > 0.99 ? "over 99" : p < 0.01 ? "under 1" : Math.round(100 * p)} % ${effectTitle(k)}`).join(", ")}.`) : null];
  const name = h("p", { class: "figure", id: "claim" }, claim ? claim.effects.map(effectTitle).join(" or ") : sentence(d.headline || "Nothing is named"));
  return outcomeCard(d, short ? [name, reason] : [name, ...rest, reason], short && rest.filter(Boolean));
}

/* The ranking as two cards: what stands out, and what cannot be told from chance. */
const namedIn = (d) => (r) => Boolean(d.claim) && d.claim.label === r.label; /* a whole fit may name what its trial hardly shows: it stands first, where the sentence above says so */
const clearOf = (d) => { const named = namedIn(d); return [...d.ranking.filter(named), ...d.ranking.filter((r) => r.significant && !named(r))]; };
const lawsOf = (d) => [...clearOf(d), ...(d.learned || [])].map((r) => r.label);
const noteOf = (d) => (clearOf(d).length ? undefined : LEARNED_NOTE);
function rankedCards(d) {
  const named = namedIn(d), clear = clearOf(d), faint = d.ranking.filter((r) => !r.significant && !named(r));
  const fallOf = (r) => (named(r) ? d.claim.held_out_drop_percent : r.held_out_drop_percent) || 0, most = Math.max(1, ...d.ranking.map(fallOf)); /* what is claimed was fitted wholly: its figure is the one in the sentence, too */
  const row = (r, k) => {
    const bar = h("i"), drop = fallOf(r), key = named(r);
    requestAnimationFrame(() => { bar.style.width = `${Math.max(0, (100 * drop) / most)}%`; });
    return h("li", { class: `candidate${r.significant || key ? "" : " dim"}`, ...pointsAt(r.label) }, h("span", { class: "rank" }, String(k + 1)),
      h("div", {}, h("h3", {}, r.title, " ", h("span", { class: "place" }, `· ${r.place.replace(/_/g, " ")}`)), h("p", { class: "small" }, `Without it ${r.absence}.`),
        h("p", { class: "small soft" }, `${digits(r.contribution)} ${unit(d.unit)} rms in the ${r.balance} balance; p ${r.p_value < 1e-4 ? "< 0.0001" : "= " + digits(r.p_value, 2)}; evidence ${digits(r.gain_nats)} (gain in log-likelihood).${r.confusable_with.length ? ` Often confused with ${r.confusable_with.map(effectTitle).join(", ")}.` : ""}`)),
      h("div", { class: "effect-size" }, h("p", { class: "small" }, drop > 0 ? ["residual ", h("span", { class: "num" }, `−${digits(drop, 2)} %`)] : "no fall"), h("span", { class: "bar", "aria-hidden": "true" }, bar)),
      h("div", { class: "act" }, button("Add", () => run("add", { label: r.label }, "ledger"), { kind: key ? "primary" : "", id: `add-${r.label.replace(/[@#]/g, "-")}`, label: `Add ${r.title}, ${r.place.replace(/_/g, " ")}` })));
  };
  return {
    clear: clear.length ? h("div", { class: "card ranks" }, h("h2", {}, "Ranked effects"), h("p", { class: "soft small" }, "The bar is the fall of the residual on held-out records if the effect is added to the model as it stands. Falls do not add up: add one, then diagnose again."), h("ol", { class: "ranked" }, clear.map(row))) : null,
    faint: faint.length ? h("details", { class: "card" }, h("summary", {}, h("h2", {}, `Not to be told from chance, or too small (${faint.length})`)), h("ol", { class: "ranked" }, faint.map((r, k) => row(r, k + clear.length)))) : null,
  };
}

/* The result of the whole loop: its learned curves, each drawn through the residual when it is pointed at, and every line as the terminal prints it. */
function foundCard(story) {
  const curves = story.learned || [], panel = curves.length ? new LawPanel(curves.map((c) => c.label), LEARNED_NOTE) : null;
  if (panel) later(() => panel.begin());
  const list = h("section", { class: "card", id: "found" }, panel ? [h("h2", {}, "Curves without a name"), curveList(curves)] : h("h2", {}, "The whole loop"),
    h("details", {}, h("summary", {}, "As irj improve prints it"), h("pre", { id: "printed", tabindex: "0", "aria-label": "As irj improve prints it" }, story.printed)));
  return panel ? h("div", { class: "two ranking" }, list, panel.node) : list;
}
const curveList = (curves) => h("ul", {}, curves.map((c) => h("li", { class: "points", tabindex: "0", ...pointsAt(c.label) }, c.sentence.replace(` (${c.label})`, ""), " ", button("Make it a law", () => pickLaw(c.label), { kind: "quiet", id: `law-of-${c.label.replace(/[@#]/g, "-")}`, label: `Make a law of the curve: ${effectTitle(c.label)}` }))));

/* What no place shows: noise, or something that hangs on no measured signal. A balance over its noise is said. */
function nowhere(found) {
  const over = Object.entries(found.error.balances).filter(([, e]) => e.ratio > found.pattern.limit).map(([b]) => b);
  return over.length ? `The ${over.join(" and ")} balance is over its noise, but none of the measured signals explains it: what is missing depends on something that was not measured, or comes and goes.` : "Every balance is at its noise, and no signal explains what is left.";
}

const MODEL_TITLES = {
  hd1: "rigid", hd2: "rigid, with the transmission's losses", hd3: "elastic, with structural damping", hd4: "elastic, with kinematic error",
  irj1a: "rigid, with gravity", irj1b: "rigid, with gravity and Coulomb friction", irj2a: "elastic with cubic stiffness", irj2b: "elastic with cubic stiffness and friction", irj_ts: "elastic, full friction of the test stand",
};

function jointLine(state) {
  const name = (state.joint_text.match(/name\s*=\s*"([^"]*)"/) || [])[1], model = (state.joint_text.match(/^model\s*=\s*"([^"]*)"/m) || [])[1];
  return [name, model && `model ${model}`].filter(Boolean).join(", ");
}

function fileCard(f) {
  const shown = ["ready", "checking"].includes(f.status);
  const s = f.summary || {}, bad = f.findings.filter((x) => x.severity !== "ok"), fine = f.findings.filter((x) => x.severity === "ok");
  const role = h("select", { id: `role-${f.id}`, "aria-label": `Role of ${f.name}`, onchange: (e) => act(async () => { await post(`/file/${f.id}`, { role: e.target.value }); await refresh(); }) }, [["train", "Fit"], ["held_out", "Held out"]].map(([v, t]) => h("option", { value: v, selected: f.role === v }, t)));
  return h("section", { class: "card", "aria-label": f.name }, h("div", { class: "row between" },
    h("div", {}, h("h2", {}, f.name), shown ? h("p", { class: "soft small" }, `${plural(s.samples, "sample")}, ${digits(s.duration, 4)} s, every ${digits(1000 * s.dt, 3)} ms${s.segments > 1 ? `, ${s.segments} stretches` : ""}. ${f.role_reason.charAt(0).toUpperCase()}${f.role_reason.slice(1)}.`) : null),
    h("div", { class: "row" }, shown ? role : null, f.status === "columns" ? null : button("Columns", () => { app.drafts[`columns-${f.id}`] = !app.drafts[`columns-${f.id}`]; app.drafts[`map-${f.id}`] = { request: { now: true }, typed: {} }; render(false); }, { kind: "quiet", work: false, id: `columns-${f.id}`, label: `Columns of ${f.name}` }), button("Remove", () => act(async () => { await call("DELETE", `${base()}/file/${f.id}`); await refresh(); }), { kind: "quiet", label: `Remove ${f.name}` }))),
    f.status === "refused" ? h("p", { class: "bad" }, plainly(f.message)) : null,
    f.status === "checking" ? h("p", { class: "small soft", role: "status" }, "Going through the check gate …") : null,
    f.status === "columns" ? columnMap(f) : null,
    bad.length ? h("ul", { class: "findings" }, bad.map((x) => h("li", {}, h("span", { class: `tag ${SEVERITY[x.severity][0]}` }, SEVERITY[x.severity][1]), " ", plainly(x.message)))) : null,
    f.status !== "columns" && app.drafts[`columns-${f.id}`] ? columnMap(f) : null,
    f.status === "ready" ? h("details", {}, h("summary", {}, bad.length ? `Checked: ${fine.length} fine; columns` : "Checked, nothing to repair; columns"), h("ul", { class: "findings" }, s.columns.map((c) => h("li", {}, plainly(c))), s.notes.map((n) => h("li", {}, plainly(n))), fine.map((x) => h("li", {}, plainly(x.message))))) : null);
}

function seriesCard(files) {
  const draft = app.drafts.series || (app.drafts.series = {});
  const file = files.find((f) => f.id === draft.file) || files[0], channels = file.summary.channels.map((c) => c.name);
  const channel = channels.includes(draft.channel) ? draft.channel : channels[0], host = h("div", { class: "plot" });
  const sent = () => app.first && app.first.revision === app.state.revision && app.first.file === file.id && app.first.data.series[0].name === channel && app.first.data;
  const plot = new SeriesPlot(host, (range, points) => (!range && sent() && Promise.resolve(sent())) || get(`/view/series?file=${file.id}&channels=${channel}&points=${points}${range ? `&from=${range[0]}&to=${range[1]}` : ""}`), { title: `${channel} of ${file.name}` });
  app.plots.push(plot);
  const first = draft.range || null;
  draft.range = null; /* it was asked for once */
  later(() => plot.show(first).catch(fail));
  const pick = (id, label, options, chosen, key) => h("select", { id, "aria-label": label, onchange: (e) => { draft[key] = e.target.value; render(false); } }, options.map(([v, t]) => h("option", { value: v, selected: v === chosen }, t)));
  return h("section", { class: "card", id: "look" }, h("h2", {}, "Look at the records"), plotControls(plot, [pick("series-file", "Record", files.map((f) => [f.id, f.name]), file.id, "file"), pick("series-channel", "Channel", channels.map((c) => [c, c.replace(/_/g, " ")]), channel, "channel")]), host, leftOut(file, plot));
}
