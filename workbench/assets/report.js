(function () {
  "use strict";
  var holder = document.getElementById("report-data");
  var area = document.getElementById("overlay");
  if (!holder || !area || !window.uPlot) { return; }
  var report = JSON.parse(holder.textContent);
  if (!report.overlays.length) { return; }
  var choice = document.getElementById("overlay-choice");
  var status = document.getElementById("overlay-status");
  var boxes = ["torque", "residual", "whole"].map(function (n) { return document.getElementById("overlay-" + n); });
  var charts = [];
  var entry = report.overlays[0];
  var range = entry.window.slice();
  var quiet = false;

  var side = ", referred to the link [";

  function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }
  function short(v) { return v === null || v === undefined || isNaN(v) ? "–" : Number(v.toPrecision(4)).toString().replace("-", "\u2212"); }
  function unit() { return entry.unit.replace(".", "\u00b7"); }
  function span() { var t = entry.data[0]; return [t[0], t[t.length - 1]]; }
  function inDetail() {
    return entry.detail && range[0] >= entry.window[0] - 1e-9 && range[1] <= entry.window[1] + 1e-9;
  }
  function pick(rows) { var d = inDetail() ? entry.detail : entry.data; return rows.map(function (i) { return d[i]; }); }
  function curve(label, stroke, dash, width) {
    return { label: label, stroke: colour(stroke), width: width || 1.5, dash: dash, points: { show: false },
      value: function (u, v) { return short(v); } };
  }
  function torqueRows() { return report.added ? [0, 1, 2, 3] : [0, 1, 3]; }
  function residualRows() { return report.added ? [0, 4, 5] : [0, 5]; }
  function axes(label) {
    var common = { stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 0.6 }, ticks: { stroke: colour("--line") },
      font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    return [Object.assign({ label: "time [s]", labelSize: 18, size: 34 }, common), Object.assign({ label: label, size: 58, labelSize: 18,
      values: function (u, v) { return v.map(short); } }, common)];
  }
  function time() { return { label: "time [s]", value: function (u, v) { return short(v); } }; }
  function options(box, height, series, label, extra) {
    return Object.assign({ width: Math.max(box.clientWidth, 200), height: height, series: series, axes: axes(label),
      scales: { x: { time: false } }, cursor: { sync: { key: "overlay" }, drag: { x: true, y: false } } }, extra || {});
  }
  function zoomed(u) {
    if (quiet || u.select.width < 4) { return; }
    var low = u.posToVal(u.select.left, "x"), high = u.posToVal(u.select.left + u.select.width, "x");
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    show(low, high);
  }
  function build() {
    charts.forEach(function (c) { c.destroy(); });
    boxes.forEach(function (b) { b.textContent = ""; });
    var start = report.added ? [curve("start model", "--before", [6, 4])] : [];
    var left = report.added ? [curve("residual, start model", "--before", [6, 4])] : [];
    var last = report.added ? "with the additions" : "model";
    var drag = { hooks: { setSelect: [zoomed] }, cursor: { sync: { key: "overlay" }, drag: { x: true, y: false, setScale: false } } };
    charts = [
      new uPlot(options(boxes[0], 260, [time(), curve("measured", "--ink", null, 2.2)].concat(start, [curve(last, "--after")]), entry.quantity + side + unit() + "]", drag),
        pick(torqueRows()), boxes[0]),
      new uPlot(options(boxes[1], 290, [time()].concat(left, [curve("residual, " + last, "--after")]), "residual" + side + unit() + "]", drag),
        pick(residualRows()), boxes[1]),
      new uPlot(options(boxes[2], 110, [time(), curve(report.added ? "residual, start model" : "residual", report.added ? "--before" : "--after", null, 1)],
        "", { legend: { show: false }, cursor: { drag: { x: true, y: false, setScale: false } },
          hooks: { setSelect: [function (u) { if (quiet || u.select.width < 4) { return; }
            show(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")); }] } }),
        [entry.data[0], entry.data[4]], boxes[2])
    ];
    show(range[0], range[1]);
    requestAnimationFrame(function () { show(range[0], range[1]); });
  }
  function rms(rows, low, high) {
    var t = rows[0], y = rows[1], sum = 0, n = 0;
    for (var i = 0; i < t.length; i++) { if (t[i] >= low && t[i] <= high) { sum += y[i] * y[i]; n += 1; } }
    return n ? Math.sqrt(sum / n) : NaN;
  }
  function show(low, high) {
    var whole = span();
    var least = (whole[1] - whole[0]) / 5000;
    if (high - low < least) { high = low + least; }
    range = [Math.max(low, whole[0]), Math.min(high, whole[1])];
    quiet = true;
    charts[0].setData(pick(torqueRows()), false);
    charts[1].setData(pick(residualRows()), false);
    charts[0].setScale("x", { min: range[0], max: range[1] });
    charts[1].setScale("x", { min: range[0], max: range[1] });
    var a = charts[2].valToPos(range[0], "x"), b = charts[2].valToPos(range[1], "x");
    charts[2].setSelect({ left: a, top: 0, width: Math.max(b - a, 1), height: charts[2].over.clientHeight }, false);
    quiet = false;
    say();
  }
  function say() {
    var exact = entry.shown === entry.rows || inDetail();
    var text = short(range[0]) + " s to " + short(range[1]) + " s. ";
    if (exact) {
      text += "Residual (RMS) in this window: " + (report.added ? short(rms(pick([0, 4]), range[0], range[1])) + " " + unit() + " with the start model, " : "") +
        short(rms(pick([0, 5]), range[0], range[1])) + " " + unit() + (report.added ? " with the additions." : ".");
    } else {
      text += "The largest and smallest values of each stretch are drawn (" + entry.shown + " of " + entry.rows + " rows).";
    }
    status.textContent = text;
  }
  function act(what) {
    var whole = span(), size = range[1] - range[0], middle = (range[0] + range[1]) / 2;
    if (what === "worst") { show(entry.window[0], entry.window[1]); }
    if (what === "all") { show(whole[0], whole[1]); }
    if (what === "in") { show(middle - size / 4, middle + size / 4); }
    if (what === "out") { show(middle - size, middle + size); }
    if (what === "left") { var l = Math.max(whole[0], range[0] - size / 2); show(l, l + size); }
    if (what === "right") { var r = Math.min(whole[1], range[1] + size / 2); show(r - size, r); }
  }
  document.querySelectorAll("button[data-do]").forEach(function (b) {
    b.addEventListener("click", function () { act(b.getAttribute("data-do")); });
  });
  var keys = { ArrowLeft: "left", ArrowRight: "right", "+": "in", "=": "in", "-": "out", Home: "all", End: "worst" };
  area.addEventListener("keydown", function (e) {
    if (keys[e.key]) { e.preventDefault(); act(keys[e.key]); }
  });
  choice.addEventListener("change", function () {
    entry = report.overlays[Number(choice.value)];
    range = entry.window.slice();
    build();
  });
  if (window.matchMedia) { window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", build); }
  var width = 0;
  new ResizeObserver(function () { requestAnimationFrame(fit); }).observe(area);
  function fit() {
    if (Math.abs(area.clientWidth - width) > 2) {
      width = area.clientWidth;
      charts.forEach(function (c, i) { c.setSize({ width: Math.max(boxes[i].clientWidth, 200), height: c.height }); });
      show(range[0], range[1]);
    }
  }
  build();
  width = area.clientWidth;
})();
