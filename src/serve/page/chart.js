// A chart of one quantity over time, of one job or of several laid over each other: values under the pointer, zoom, and
// a line that follows the body.
const CURVES = {
  energy_error: "Energy error", orthogonality_error: "Orthogonality error", momentum_drift: "Momentum drift",
  angular_velocity: "Angular velocity", body_momentum: "Body momentum", spatial_momentum: "Spatial momentum",
  axis_angle: "Angles of the axes", step: "Step", axis_error: "Pointing error of the axis", roll_pitch_yaw: "Roll, pitch, yaw", relative_rate: "Rate relative to the frame",
  pointing_error: "Pointing error", control_command: "Commands", wheel_momenta: "Wheel momenta", wheel_speeds: "Wheel speeds",
};
// Those of channels that not every log has.
const CHANNELS = { step: "/pace", axis_error: "/pointing", roll_pitch_yaw: "/pointing", relative_rate: "/pointing",
  pointing_error: "/control", control_command: "/control", wheel_momenta: "/control", wheel_speeds: "/control" };
// Those of a scene of one body.
const OF_ONE = ["angular_velocity", "body_momentum", "axis_angle"];
const ERRORS = ["energy_error", "orthogonality_error", "momentum_drift"];
const PARTS = { axis_angle: k => `axis ${k + 1}`, roll_pitch_yaw: k => ["roll", "pitch", "yaw"][k],
  control_command: k => `command ${k + 1}`, wheel_momenta: k => `wheel ${k + 1}`, wheel_speeds: k => `wheel ${k + 1}` };
const HUES = { light: ["#00598c", "#b34700", "#00654a", "#8a3a78", "#6b5200", "#1c2024"], dark: ["#7cc4f2", "#ffa768", "#63d0ab", "#f0a3d8", "#e6cf6a", "#e8e6e1"] };
const night = matchMedia("(prefers-color-scheme: dark)");

// Reads the look of the axes of a chart in the theme of the page, and a colour of it.
const shade = name => getComputedStyle(document.body).getPropertyValue(name).trim();

// Of a logarithmic axis powers of ten, and between few of them 2 and 5 times each; uPlot's own do not end for values like 1e-23.
function decades(u, axis, least, most) {
  const [low, high] = [Math.floor(Math.log10(least)), Math.ceil(Math.log10(most))];
  const each = Math.max(1, Math.ceil((high - low) / 6)), steps = high - low < 3 ? [1, 2, 5] : [1];
  const all = [];
  for (let power = Math.ceil(low / each) * each; power <= high; power += each) for (const step of steps) all.push(Number(`${step}e${power}`));
  return all.filter(x => x >= least && x <= most);
}

// `log` is of a chart whose values are on a logarithmic axis.
function axes(log = false) {
  const axis = { stroke: shade("--soft"), grid: { stroke: shade("--line"), width: 1 }, ticks: { stroke: shade("--line"), width: 1 }, font: "12px system-ui" };
  const short = (u, values) => values.map(x => x == null ? "" : figure(x));
  return [{ ...axis, label: "t in s", labelSize: 18, labelFont: "12px system-ui", size: 34 }, { ...axis, values: short, size: 68, ...log && { splits: decades, filter: (u, splits) => splits } }];
}

// The last of ascending times at or before a time; the first if there is none.
function latest(times, t) {
  let [a, b] = [0, times.length - 1];
  while (a < b) { const m = (a + b + 1) >> 1; if (times[m] <= t) a = m; else b = m - 1; }
  return a;
}

class Chart {
  // `seek(t)` is called with the time that was clicked on.
  constructor(job, seek) {
    [this.jobs, this.seek, this.span, this.at] = [[job], seek, null, null];
    this.known = [];
    const option = ([value, name]) => h("option", { value }, name);
    this.curve = h("select", { ariaLabel: "Quantity", onchange: () => { this.log.checked = ERRORS.includes(this.curve.value); this.load(); } },
      Object.entries(CURVES).filter(([value]) => !CHANNELS[value] || job.plan?.channels.some(({ topic }) => topic === CHANNELS[value]))
        .filter(([value]) => !job.plan?.bodies?.length || !OF_ONE.includes(value)).map(option));
    this.log = h("input", { type: "checkbox", checked: true, onchange: () => this.draw() });
    this.more = h("select", { ariaLabel: "Compare with another job", onfocus: () => this.ask(), onpointerenter: () => this.ask(), onchange: () => this.add() });
    this.others = h("span", { className: "row" });
    this.legend = h("div", { className: "row legend" });
    this.words = h("p", { className: "soft readout", ariaLive: "off" });
    const press = (name, word, act) => h("button", { type: "button", className: "small", ariaLabel: name, title: name, onclick: act }, word);
    this.plot = h("div", { className: "plot", tabIndex: 0, role: "img", onkeydown: event => this.key(event) });
    this.root = h("section", { className: "chart", ariaLabel: "Chart" },
      h("div", { className: "row" }, this.curve, h("label", { className: "check" }, this.log, "Logarithmic"), this.more, this.others,
        h("span", { className: "row push" }, press("Zoom in", "+", () => this.zoom(0.5)), press("Zoom out", "−", () => this.zoom(2)),
          press("The whole run", "Whole", () => this.look(null)))),
      this.plot, this.legend, this.words);
    this.offer();
    this.ask();
    this.sizes = new ResizeObserver(() => this.u?.setSize(this.size()));
    this.sizes.observe(this.plot);
    this.theme = () => this.root.isConnected && this.draw();
    night.addEventListener("change", this.theme);
  }

  size() { return { width: Math.max(200, this.plot.clientWidth), height: 260 }; }

  // Jobs that can be laid over this one: the newest.
  async ask() {
    const found = await json("jobs?limit=100", { quiet: true }).catch(() => null);
    if (!found || String(found.jobs.map(job => job.id)) === String(this.known.map(job => job.id))) return;
    this.known = found.jobs;
    this.offer();
  }

  offer() {
    const free = this.known.filter(job => job.links.samples && this.jobs.every(shown => shown.id !== job.id));
    const chosen = [h("option", { value: "" }, "Compare with …"), ...free.map(job => h("option", { value: job.id }, `${job.name || "unnamed"}, ${when(job.created)}`))];
    this.more.replaceChildren(...chosen);
  }

  add() {
    const job = this.known.find(job => job.id === this.more.value);
    if (!job) return;
    this.jobs.push(job);
    this.chips();
  }

  chips() {
    this.others.replaceChildren(...this.jobs.slice(1).map(job => h("button", { type: "button", className: "small", ariaLabel: `Remove ${job.name} from the chart`,
      onclick: () => { this.jobs = this.jobs.filter(shown => shown !== job); this.chips(); } }, `${job.name} ×`)));
    this.offer();
    this.load();
  }

  // Asks for the points of what is looked at. What comes late is not shown.
  async load() {
    const turn = this.turn = (this.turn ?? 0) + 1;
    const channel = this.curve.value;
    const window = this.span ? `&from_s=${Math.max(0, this.span[0])}&to_s=${Math.max(0, this.span[1])}` : "";
    const found = await Promise.all(this.jobs.map(job => readJson(`jobs/${job.id}/samples?channel=${channel}&points=800${window}`).catch(error => error)));
    await calm();
    if (turn !== this.turn) return;
    this.found = found;
    this.draw();
  }

  // Anew, with the colours of the theme.
  draw() {
    const found = this.found ?? [];
    this.u?.destroy();
    this.u = null;
    this.plot.replaceChildren();
    const good = found.map((samples, k) => ({ samples, job: this.jobs[k] })).filter(({ samples }) => samples?.time_s?.length);
    if (!good.length) {
      this.plot.append(h("p", { className: "soft none" }, found.some(x => x.status === 404) ? "The log of this job does not hold this quantity." : "Nothing is logged yet."));
      putProse(this.words, "");
      this.legend.replaceChildren();
      return;
    }
    const hues = HUES[night.matches ? "dark" : "light"];
    const log = this.log.checked;
    const unit = good[0].samples.unit;
    const [series, tables, bands] = [[{}], [], []];
    this.lines = [];
    good.forEach(({ samples, job }, k) => {
      const lines = [];
      samples.low.forEach((low, part) => {
        const many = samples.low.length > 1;
        const name = [many ? (PARTS[samples.channel] ?? (k => samples.low.length === 3 ? "xyz"[k] : String(k + 1)))(part) : "", good.length > 1 ? job.name : ""].filter(Boolean).join(" · ") || CURVES[samples.channel];
        const stroke = hues[(good.length > 1 && !many ? k : part) % hues.length];
        const line = { label: name, stroke, width: 1.5, spanGaps: true, points: { show: samples.time_s.length < 40 }, dash: many ? [[], [9, 5], [2, 4]][(k || part) % 3] : [] };
        this.lines.push({ name, stroke, dashed: line.dash.length > 0, low, high: samples.high[part], time: samples.time_s, end: samples.end_s ?? samples.time_s.at(-1) });
        if (log) {
          lines.push(low.map((x, i) => Math.max(Math.abs(x), Math.abs(samples.high[part][i])) || null));
          series.push(line);
        } else {
          bands.push({ series: [series.length, series.length + 1], fill: `${stroke}40` });
          lines.push(samples.high[part], low);
          series.push(line, { ...line, label: "" });
        }
      });
      tables.push([samples.time_s, ...lines]);
    });
    this.u = new uPlot({
      ...this.size(), series, bands, legend: { show: false }, padding: [8, 26, 0, 0],
      cursor: { y: false, drag: { x: true, y: false, setScale: false }, points: { show: false } },
      scales: { x: { time: false, ...this.span && { range: this.span } }, y: log ? { distr: 3 } : {} },
      axes: axes(log),
      hooks: {
        setCursor: [u => this.read(u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null)],
        setSelect: [u => { if (u.select.width > 4) this.look([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]); }],
      },
    }, tables.length > 1 ? uPlot.join(tables) : tables[0], this.plot);
    this.line = h("div", { className: "now", hidden: true });
    this.u.over.append(this.line);
    this.u.over.ondblclick = () => this.look(null);
    this.u.over.onclick = event => { if (this.u.select.width <= 4) this.seek(Math.max(0, this.u.posToVal(event.offsetX, "x"))); };
    this.unit = unit;
    this.legend.replaceChildren(...this.lines.length < 2 ? [] : this.lines.map(({ name, stroke, dashed }) => {
      const entry = h("span", {}, `${dashed ? "┅" : "━"} ${name}`);
      entry.style.color = stroke;
      return entry;
    }));
    this.plot.ariaLabel = `${CURVES[this.curve.value]} over time. Arrow keys read values, + and - zoom, 0 shows the whole run.`;
    this.read(null);
    this.follow(this.at);
  }

  // Shows the values of the lines at a time; without one, the contents of the chart.
  read(t) {
    this.reading = t;
    if (t === null) {
      const each = Math.max(...this.found.map(x => x.each ?? 1));
      putProse(this.words, `${CURVES[this.curve.value]}${this.unit ? ` in ${this.unit}` : ""}${each > 1 ? `; each point spans up to ${count(each)} samples, from the smallest to the largest` : ""}. Point at the chart to read values, drag to zoom, click to move the body there.`);
      return;
    }
    const value = line => { const k = latest(line.time, t); const [low, high] = [line.low[k], line.high[k]]; if (t > line.end) return `${line.name} has ended`; return `${line.name} ${low === high ? figure(low) : `${figure(low)} … ${figure(high)}`}`; };
    putProse(this.words, `t = ${figure(t)} s: ${this.lines.map(value).join(", ")}${this.unit ? ` ${this.unit}` : ""}`);
  }

  // Shows a part of the time; all of it if there is none.
  look(span) {
    if (span) {
      const width = Math.max(span[1] - span[0], 1e-9);
      span = span[0] < 0 ? [0, width] : span;
    }
    this.span = span;
    return this.load();
  }

  zoom(by) {
    if (!this.u) return;
    const { min, max } = this.u.scales.x;
    const middle = this.reading ?? (min + max) / 2;
    const end = Math.max(...this.found.map(x => x.end_s ?? x.time_s?.at(-1) ?? 0));
    const span = [middle - (middle - min) * by, middle + (max - middle) * by];
    this.look(by > 1 && span[0] <= 0 && span[1] >= end ? null : [Math.max(0, span[0]), Math.min(end, span[1])]);
  }

  key(event) {
    const u = this.u;
    if (!u || event.ctrlKey || event.metaKey || event.altKey) return;
    const { min, max } = u.scales.x;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) this.read(Math.min(max, Math.max(min, (this.reading ?? (min + max) / 2) + step * (max - min) / 100)));
    else if (event.key === "+" || event.key === "=") this.zoom(0.5);
    else if (event.key === "-") this.zoom(2);
    else if (event.key === "0" || event.key === "Home") this.look(null);
    else if (event.key === "Enter" && this.reading !== null) this.seek(this.reading);
    else return;
    if (step) u.setCursor({ left: u.valToPos(this.reading, "x"), top: 10 }, false);
    // A user of the keyboard may use a screen reader.
    this.words.ariaLive = "polite";
    event.preventDefault();
  }

  // Puts the line where the body is.
  follow(t) {
    this.at = t;
    if (!this.u || t === null) return;
    const { min, max } = this.u.scales.x;
    this.line.hidden = !(t >= min && t <= max);
    this.line.style.transform = `translateX(${this.u.valToPos(t, "x")}px)`;
  }

  close() {
    this.turn = NaN;
    this.sizes.disconnect();
    night.removeEventListener("change", this.theme);
    this.u?.destroy();
    this.u = null;
  }
}
