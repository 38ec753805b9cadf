"use strict";
/* A first picture of a file by the browser itself, while the server still takes the file in. NPZ is read as it is, of a
   CSV some stretches; other formats wait for the server. Raw columns, as they stand in the file: no map, no unit, no check. */
const PREVIEW_BYTES = 256e6, PREVIEW_BUCKETS = 600, PREVIEW_STRETCHES = 240, PREVIEW_STRETCH = 3000;

async function preview(file) {
  try {
    const made = /\.npz$/i.test(file.name) ? await previewNpz(file) : /\.(csv|txt|tsv)$/i.test(file.name) ? await previewCsv(file) : null;
    return made && made.time.length > 2 ? made : null;
  } catch (error) { return null; }
}

const isTime = (name) => /^(time|t)(_|\b|$)/i.test(name);

/* Smallest and largest value of each bucket, so that no spike is lost; `time` gives the stamp of a sample. */
function smallestAndLargest(time, values) {
  const n = values.length, step = Math.max(1, Math.ceil(n / PREVIEW_BUCKETS)), stamps = [], drawn = [];
  for (let a = 0; a < n; a += step) {
    const b = Math.min(n, a + step);
    let low = Infinity, high = -Infinity;
    for (let i = a; i < b; i++) { const v = values[i]; if (v < low) low = v; if (v > high) high = v; }
    if (low > high) continue;
    const at = time(a), half = time(Math.min(n - 1, a + (step >> 1)));
    const falls = values[a] > values[b - 1];
    stamps.push(at); drawn.push(falls ? high : low);
    if (step > 1 && half > at) { stamps.push(half); drawn.push(falls ? low : high); }
  }
  return { time: stamps, values: drawn };
}

async function previewNpz(file) {
  const members = await zipMembers(file), names = members.map((m) => m.name.replace(/\.npy$/, ""));
  const stamp = names.findIndex(isTime), channel = names.findIndex((name, k) => k !== stamp && /current|torque|position|velocity/i.test(name));
  if (channel < 0) return null;
  const [values, time] = await Promise.all([npyArray(file, members[channel]), stamp < 0 ? { length: null, at: (k) => k } : npyTime(file, members[stamp])]);
  if (!values || !time || (time.length !== null && time.length !== values.length)) return null;
  const made = smallestAndLargest(time.at, values);
  return { name: names[channel], timed: stamp >= 0, time: made.time, series: [{ name: names[channel], unit: "", values: made.values }], full: false };
}

async function zipMembers(file) {
  const from = Math.max(0, file.size - 66000), raw = await file.slice(from).arrayBuffer(), tail = new DataView(raw);
  let end = tail.byteLength - 22;
  while (end >= 0 && tail.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) return [];
  const first = tail.getUint32(end + 16, true), size = tail.getUint32(end + 12, true);
  if (first === 0xffffffff || size > 1e6) return [];
  const list = new DataView(first >= from ? raw.slice(first - from, first - from + size) : await file.slice(first, first + size).arrayBuffer()), out = [];
  for (let p = 0; p + 46 <= list.byteLength && list.getUint32(p, true) === 0x02014b50;) {
    const name = list.getUint16(p + 28, true), extra = list.getUint16(p + 30, true), comment = list.getUint16(p + 32, true);
    out.push({ name: new TextDecoder().decode(new Uint8Array(list.buffer, list.byteOffset + p + 46, name)), method: list.getUint16(p + 10, true), packed: list.getUint32(p + 20, true), size: list.getUint32(p + 24, true), at: list.getUint32(p + 42, true) });
    p += 46 + name + extra + comment;
  }
  return out;
}

/* Time as {length, at(sample)}: three samples of it where it runs evenly, else all of it. */
async function npyTime(file, member) {
  const all = async () => { const values = await npyArray(file, member); return values && { length: values.length, at: (k) => values[k] }; };
  if (member.method !== 0 || tooLong(member)) return all();
  const raw = await file.slice(member.at, member.at + 2000).arrayBuffer(), from = bodyOf(raw), made = npyHead(raw.slice(from));
  if (!made || made.kind !== "f8") return all();
  const begin = member.at + from + made.at, at = async (k) => new DataView(await file.slice(begin + 8 * k, begin + 8 * k + 8).arrayBuffer()).getFloat64(0, true);
  const n = made.count, [a, b, c] = await Promise.all([at(0), at((n - 1) >> 1), at(n - 1)]), step = (c - a) / (n - 1);
  return step > 0 && Math.abs(b - a - step * ((n - 1) >> 1)) <= step ? { length: n, at: (k) => a + step * k } : all();
}

const tooLong = (member) => member.size > PREVIEW_BYTES || member.packed === 0xffffffff || member.at === 0xffffffff;
/* Where the bytes of a member begin, after its local header. */
function bodyOf(raw) { const head = new DataView(raw); return 30 + head.getUint16(26, true) + head.getUint16(28, true); }

function npyHead(raw) {
  const view = new DataView(raw), long = view.getUint8(6) > 1, head = long ? 12 : 10, size = long ? view.getUint32(8, true) : view.getUint16(8, true);
  if (head + size > raw.byteLength) return null;
  const text = new TextDecoder("latin1").decode(new Uint8Array(raw, head, size)), kind = (text.match(/'descr': '<(f4|f8)'/) || [])[1], shape = text.match(/'shape': \((\d+),\)/);
  return kind && shape ? { kind, count: Number(shape[1]), at: head + size } : null;
}

async function npyArray(file, member) {
  if (tooLong(member)) return null;
  const whole = await file.slice(member.at, Math.min(file.size, member.at + member.packed + 2000)).arrayBuffer(), begin = bodyOf(whole), end = begin + member.packed;
  let raw = whole, from = begin;
  if (member.method === 8) { raw = await new Response(new Blob([new Uint8Array(whole, begin, member.packed)]).stream().pipeThrough(new DecompressionStream("deflate-raw"))).arrayBuffer(); from = 0; }
  else if (member.method !== 0 || whole.byteLength < end) return null;
  const made = npyHead(raw.slice(from, from + 2000));
  if (!made) return null;
  const at = from + made.at, kind = made.kind === "f8" ? Float64Array : Float32Array, aligned = at % 8 === 0;
  return new kind(aligned ? raw : raw.slice(at), aligned ? at : 0, made.count);
}

async function previewCsv(file) {
  const head = await file.slice(0, 20000).text(), lines = head.split(/\r?\n/), first = lines.findIndex((l) => /[A-Za-z_]/.test(l) && /[,;\t]/.test(l));
  if (first < 0 || file.size < 2000) return null;
  const mark = [",", ";", "\t"].find((m) => lines[first].includes(m)), names = lines[first].split(mark).map((n) => n.trim().replace(/^"|"$/g, ""));
  if (mark === ";" && /\d,\d/.test(lines[first + 1] || "")) return null;
  const stamp = names.findIndex(isTime), channel = names.findIndex((n, k) => k !== stamp && /current|torque|position|velocity/i.test(n)), time = [], values = [];
  if (stamp < 0 || channel < 0) return null;
  const begin = head.indexOf(lines[first]) + lines[first].length, whole = file.size <= PREVIEW_STRETCHES * PREVIEW_STRETCH, stretches = whole ? [file.slice(begin)] : Array.from({ length: PREVIEW_STRETCHES }, (_, k) => { const a = Math.floor(begin + (k * (file.size - begin - PREVIEW_STRETCH)) / (PREVIEW_STRETCHES - 1)); return file.slice(a, a + PREVIEW_STRETCH); });
  for (const text of await Promise.all(stretches.map((s) => s.text()))) {
    const rows = text.split(/\r?\n/);
    for (const row of whole ? rows : rows.slice(1, -1)) {
      const cells = row.split(mark), t = Number(cells[stamp]), v = Number(cells[channel]);
      if (cells.length === names.length && Number.isFinite(t) && Number.isFinite(v) && !(t <= time[time.length - 1])) { time.push(t); values.push(v); }
    }
  }
  const made = smallestAndLargest((k) => time[k], values);
  return { name: names[channel], timed: true, time: made.time, series: [{ name: names[channel], unit: "", values: made.values }], full: false };
}

function previewCard() {
  const { file, data } = app.preview, host = h("div", { class: "plot" });
  const plot = new SeriesPlot(host, () => Promise.resolve(data), { title: `Preview of ${file}`, local: true, quiet: true });
  app.plots.push(plot);
  later(() => plot.show(null).catch(fail));
  return h("section", { class: "card", id: "preview" }, h("h2", {}, `Preview of ${file}`), h("p", { class: "soft small" }, `Column ${data.name} as it stands in the file${data.timed ? "" : ", over the sample number"}. The server still reads and checks it.`), host);
}
