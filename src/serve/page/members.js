// All members of an ensemble: where their values lie over time, and those that stand out, each a run of its own at a click.
const SPREADS = {
  distance: "Distance from member 0", place_distance: "Distance in space from member 0", axis_angle: "Angle of an axis", angular_velocity: "Angular velocity",
  energy_error: "Energy error", orthogonality_error: "Orthogonality error", momentum_drift: "Momentum drift",
};
// Of several bodies these are the largest of all.
const OF_EACH = ["distance", "place_distance", "axis_angle", "angular_velocity"];
const ORDERS = { largest: "Largest first", smallest: "Smallest first", failed: "Failed first", member: "By number" };
const ROWS = 10;

class Members {
  constructor(job) {
    [this.job, this.page, this.shown] = [job, 0, 0];
    const { dimension: n, bodies } = job.plan;
    const { place_distance, ...ofOne } = SPREADS;
    const options = names => Object.entries(names).map(([value, name]) => h("option", { value }, name));
    const again = () => { [this.page, this.shown] = [0, 0]; this.load(); };
    this.curve = h("select", { ariaLabel: "Quantity of the members", onchange: () => { this.axis.hidden = this.curve.value !== "axis_angle"; this.log.checked = ERRORS.includes(this.curve.value); again(); } }, options(bodies?.length ? SPREADS : ofOne));
    this.axis = h("select", { ariaLabel: "Axis", hidden: true, onchange: again }, Array.from({ length: n }, (_, k) => h("option", { value: k + 1 }, `axis ${k + 1}`)));
    this.axis.value = n;
    this.log = h("input", { type: "checkbox", onchange: () => this.draw() });
    this.order = h("select", { ariaLabel: "Order of the members", onchange: again }, options(ORDERS));
    this.plot = h("div", { className: "plot", tabIndex: 0, role: "img", onkeydown: event => this.key(event) });
    this.words = h("p", { className: "soft readout", ariaLive: "off" });
    this.body = h("tbody");
    this.largest = h("th", { className: "figure", scope: "col" });
    const turn = by => () => { this.page += by; this.shown = 0; this.load(); };
    this.before = h("button", { type: "button", className: "small", onclick: turn(-1) }, "Previous");
    this.after = h("button", { type: "button", className: "small", onclick: turn(1) }, "Next");
    this.pages = h("span", { className: "soft" });
    const head = name => h("th", { scope: "col" }, name);
    this.root = h("section", { className: "chart members", ariaLabel: "All members" }, h("h3", {}, "All members"),
      h("div", { className: "row" }, this.curve, this.axis, h("label", { className: "check" }, this.log, "Logarithmic")), this.plot, this.words,
      h("div", { className: "row" }, this.order, h("span", { className: "row push" }, this.before, this.pages, this.after)),
      h("div", { className: "table" }, h("table", {}, h("thead", {}, h("tr", {}, head("Member"), head("Outcome"), this.largest, h("th", { className: "figure", scope: "col" }, "at t in s"), head("Run alone"))), this.body)));
    this.sizes = new ResizeObserver(() => this.u?.setSize(this.size()));
    this.sizes.observe(this.plot);
    this.theme = () => this.root.isConnected && this.draw();
    night.addEventListener("change", this.theme);
  }

  size() { return { width: Math.max(200, this.plot.clientWidth), height: 260 }; }

  // Asks for what is looked at. What comes late is not shown.
  async load() {
    const turn = this.turn = (this.turn ?? 0) + 1;
    const asked = new URLSearchParams({ channel: this.curve.value, order: this.order.value, offset: this.page * ROWS, limit: ROWS, ...this.curve.value === "axis_angle" && { axis: this.axis.value } });
    const found = await readJson(`jobs/${this.job.id}/members?${asked}`).catch(error => error);
    await calm();
    if (turn !== this.turn) return;
    this.found = found.rows ? found : null;
    this.draw();
    this.fill();
  }

  draw() {
    const { found } = this;
    this.u?.destroy();
    this.u = null;
    this.plot.replaceChildren();
    if (!found?.time_s.length) {
      this.plot.append(h("p", { className: "soft none" }, found ? "No member has ended yet." : "The log does not hold this quantity for its members."));
      putProse(this.words, "");
      return;
    }
    const log = this.log.checked;
    const seen = values => log ? values.map(x => Math.abs(x) || null) : values;
    const hue = shade("--accent");
    const edge = { stroke: `${hue}70`, width: 1, points: { show: false } };
    const lines = found.quantiles.map(({ values }) => seen(values));
    const middle = (lines.length - 1) / 2;
    const bands = Array.from({ length: middle }, (_, k) => ({ series: [lines.length - k, k + 1], fill: `${hue}30` }));
    this.u = new uPlot({
      ...this.size(), legend: { show: false }, padding: [8, 26, 0, 0], bands: log && found.channel === "energy_error" ? [] : bands,
      series: [{}, ...lines.map((_, k) => k === middle ? { ...edge, stroke: hue, width: 2 } : edge), { stroke: shade("--velocity"), width: 2, points: { show: false } }],
      cursor: { y: false, drag: { x: false, y: false }, points: { show: false } },
      scales: { x: { time: false }, y: log ? { distr: 3 } : {} }, axes: axes(log),
      hooks: { setCursor: [u => this.read(u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null)] },
    }, [found.time_s, ...lines, this.line()], this.plot);
    this.plot.ariaLabel = `${SPREADS[found.channel]} of all members over time. Arrow keys read values.`;
    this.read(null);
  }

  // The values of the member that the table points at.
  line() {
    const values = this.found.rows[this.shown]?.values ?? [];
    return this.found.time_s.map((_, k) => values[k] === undefined ? null : this.log.checked ? Math.abs(values[k]) || null : values[k]);
  }

  // Shows the member of a row in the chart.
  point(row) {
    if (row === this.shown || !this.u) return;
    this.shown = row;
    [...this.body.children].forEach((node, k) => node.classList.toggle("shown", k === row));
    this.u.setCursor({ left: -10, top: -10 }, false);
    this.u.setData([...this.u.data.slice(0, -1), this.line()]);
    this.read(null);
  }

  read(t) {
    this.reading = t;
    const { found } = this;
    const unit = found.unit ? ` ${found.unit}` : "";
    const row = found.rows[this.shown];
    if (t === null) {
      const failed = Object.values(found.failed).reduce((sum, count) => sum + count, 0);
      putProse(this.words, `${SPREADS[found.channel]}${found.unit ? ` in ${found.unit}` : ""} of ${count(found.members)} members${this.job.plan.bodies?.length && OF_EACH.includes(found.channel) ? ", the largest of the bodies" : ""}${failed ? `, ${count(failed)} of them failed` : ""}: the bands hold all, nine tenths and half of them; the line in the middle is the median${row ? `, the other line is member ${row.member}` : ""}.`);
      return;
    }
    const k = latest(found.time_s, t);
    const [least, , quarter, median, most, , largest] = found.quantiles.map(({ values }) => figure(values[k]));
    putProse(this.words, `t = ${figure(found.time_s[k])} s: median ${median}, half of them ${quarter} … ${most}, all ${least} … ${largest}${unit}${row?.values[k] === undefined ? "" : `; member ${row.member} ${figure(row.values[k])}`}${found.count[k] < found.members ? `; ${count(found.count[k])} members reached this time` : ""}`);
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!this.u || !step || event.ctrlKey || event.metaKey || event.altKey) return;
    const times = this.found.time_s;
    const k = Math.max(0, Math.min(times.length - 1, (this.reading === null ? times.length >> 1 : latest(times, this.reading)) + step));
    this.read(times[k]);
    this.u.setCursor({ left: this.u.valToPos(times[k], "x"), top: 10 }, false);
    this.words.ariaLive = "polite";
    event.preventDefault();
  }

  fill() {
    const { found } = this;
    put(this.largest, found?.unit ? `Largest in ${found.unit}` : "Largest");
    const pages = Math.max(1, Math.ceil((found?.members ?? 0) / ROWS));
    put(this.pages, `${this.page + 1} of ${count(pages)}`);
    this.before.disabled = this.page === 0;
    this.after.disabled = this.page + 1 >= pages;
    this.body.replaceChildren(...(found?.rows ?? []).map((row, k) => h("tr", { className: k === this.shown ? "shown" : "", onpointerenter: () => this.point(k) },
      h("th", { scope: "row" }, String(row.member)),
      h("td", { className: row.outcome === "succeeded" ? "succeeded" : "failed" }, row.outcome === "succeeded" ? row.outcome : `${row.outcome} at step ${count(row.steps + 1)}`),
      h("td", { className: "figure" }, row.largest == null ? "" : figure(row.largest)),
      h("td", { className: "figure" }, row.largest_at_s == null ? "" : figure(row.largest_at_s)),
      h("td", {}, pressable("Run", () => this.alone(row.member), { ariaLabel: `Run member ${row.member} alone` })))));
    [...this.body.children].forEach((node, k) => node.addEventListener("focusin", () => this.point(k)));
  }

  // Opens a member as a run of its own: the same one, however often it is asked for.
  async alone(member) {
    try {
      const scenario = await (await call(`jobs/${this.job.id}/members/${member}.json`)).text();
      const job = await send("jobs", scenario, { "idempotency-key": `member ${member} of ${this.job.id}` });
      location.hash = `#/jobs/${job.id}`;
      await refresh();
    } catch (error) {
      putProse(this.words, `Member ${member} was not run: ${error.message}`);
      throw error;
    }
  }

  close() {
    this.turn = NaN;
    this.sizes.disconnect();
    night.removeEventListener("change", this.theme);
    this.u?.destroy();
    this.u = null;
  }
}
