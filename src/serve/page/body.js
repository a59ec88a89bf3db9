"use strict";
// The bodies in space: faces, balls, arrows and lines, painted from far to near. Lengths in the log's units are scaled to
// pixels here and nowhere else.
class Stage {
  constructor(template) {
    this.root = template.content.firstElementChild.cloneNode(true);
    const find = name => this.root.querySelector(`.${name}`);
    [this.stage, this.ink] = ["stage", "ink"].map(find);
    [this.play, this.seek, this.time, this.rate, this.caption] = ["play", "seek", "time", "rate", "caption"].map(find);
    this.drawn = Object.fromEntries([...this.root.querySelectorAll(".drawn input")].map(box => [box.value, box]));
    [this.azimuth, this.elevation, this.zoom] = [-0.6, 0.35, 1];
    [this.parts, this.lines, this.labels] = [[], [], []];
    // The times of the samples, and what each body does then; of several bodies the number of the one that is followed.
    [this.times, this.tracks, this.followed] = [[], [], null];
    // The time that is shown, and seconds of it in a second.
    [this.t, this.speed, this.end, this.busy, this.playing] = [0, 1, 0, false, false];
    this.play.onclick = () => this.run(!this.playing);
    this.seek.oninput = () => this.jump(Number(this.seek.value));
    this.rate.onchange = () => { this.setSpeed(Number(this.rate.value)); this.jump(this.t); };
    this.root.querySelector(".drawn").onchange = () => this.show();
    this.which = find("which");
    this.which.onchange = () => { this.choose(this.which.value); this.show(); };
    for (const [name, by] of [["nearer", 1.25], ["farther", 0.8]]) find(name).onclick = () => this.magnify(by);
    this.watchPointers();
    this.stage.onkeydown = event => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (turn) this.look(...turn);
      else if (event.key === " ") this.run(!this.playing);
      else if (event.key === "+" || event.key === "=") this.magnify(1.25);
      else if (event.key === "-") this.magnify(0.8);
      else if (event.key === "0") this.magnify(1 / this.zoom);
      else return;
      event.preventDefault();
    };
    this.sizes = new ResizeObserver(() => this.show());
    this.sizes.observe(this.stage);
    // What is scrolled out of sight is not painted.
    this.inSight = true;
    this.sight = new IntersectionObserver(seen => { this.inSight = seen.at(-1).isIntersecting; this.show(); });
    this.sight.observe(this.stage);
  }

  // One finger or the mouse turns the view, two fingers or the wheel bring it nearer.
  watchPointers() {
    const fingers = new Map();
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    this.stage.onpointerdown = event => {
      if (event.target.closest("button")) return;
      this.stage.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    };
    this.stage.onpointermove = event => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const far = fingers.size === 2 ? apart() : 0;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 2) this.magnify(apart() / Math.max(1, far));
      else if (fingers.size === 1) this.look((before[0] - event.clientX) * 0.01, (event.clientY - before[1]) * 0.01);
    };
    this.stage.onpointerup = this.stage.onpointercancel = event => fingers.delete(event.pointerId);
    this.stage.addEventListener("wheel", event => {
      event.preventDefault();
      this.magnify(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.03 : 0.0015)));
    }, { passive: false });
  }

  // `load(from_s, every_s)` gives attitudes from a time on; `scene` is that of the scenario, for labels, for lines and for
  // what moves.
  async open(load, scene) {
    this.load = load;
    await this.fetch(0);
    if (this.times.length === 0) return false;
    this.setOut(scene);
    this.draw(this.first.scene);
    if (this.several) this.nameAll(scene); else this.name(scene);
    this.choosePace();
    this.choose("");
    await this.go(0);
    this.run(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    return true;
  }

  // The largest length of a quantity, of one body or of all.
  most(quantity, tracks) { return Math.max(0, ...tracks.flatMap(track => track[quantity].map(v => Math.hypot(...v)))); }

  // Real time, unless a body turns too fast to see, or too slowly to see it turn.
  choosePace() {
    this.spin = this.most("angular_velocity", this.tracks);
    const turns = this.spin / (2 * Math.PI);
    const nice = [1, 2, 5].flatMap(x => [x, 10 * x, 100 * x, 1e3 * x, 1e4 * x, 1e5 * x]).sort((a, b) => a - b);
    const slow = turns > 1 ? nice.find(x => x >= turns) ?? 1e6 : 1;
    const fast = turns > 0 && turns < 1 / 120 ? nice.findLast(x => x * turns <= 1 / 15) ?? 1 : 1;
    this.chosen = fast / slow;
    // At the fastest the whole run takes 20 s.
    const whole = Number((this.end / 20).toPrecision(2));
    const speeds = [...new Set([0.01, 0.1, 0.25, 0.5, 1, 2, 4, 10, 100, 1e3, 1e4, 1e5, 1e6].filter(x => x <= 4 || x < whole)
      .concat(this.chosen, this.chosen / 2, this.chosen / 4, this.chosen * 2, this.chosen * 4, whole > 1 ? whole : 1))].sort((a, b) => a - b);
    const word = speed => speed === 1 ? "1 (real time)" : speed < 1 ? `1/${figure(1 / speed)}` : figure(speed);
    this.rate.replaceChildren(...speeds.map(speed => h("option", { value: speed }, speed === whole && whole > 1 ? `${word(speed)} (all in 20 s)` : word(speed))));
    this.setSpeed(this.chosen);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.rate.value = speed;
    const turns = this.spin / (2 * Math.PI);
    const often = turns >= 1 ? `${this.tracks.length > 1 ? "the fastest body" : "it"} turns up to ${figure(Number(turns.toPrecision(2)))} times a second` : `one turn takes ${span(1 / turns)} or more`;
    const why = this.spin > 0 ? `: ${often}` : "";
    put(this.root.querySelector(".pace"), speed === 1 ? `Real time${why}.` : speed < 1 ? `${figure(1 / speed)} times slower than real time${why}.` : `${figure(speed)} times faster than real time${why}.`);
  }

  // Attitudes as dense as the screen shows them.
  every() { return this.speed / 60; }

  async fetch(from) {
    if (this.busy) return;
    this.busy = true;
    try {
      const stretch = await this.load(from, this.first ? this.every() : 0);
      this.first ??= stretch;
      this.end = stretch.end_s ?? stretch.time_s.at(-1) ?? 0;
      this.seek.max = this.end || 1;
      const found = stretch.bodies?.length ? stretch.bodies : [{ ...stretch, name: "body" }];
      if (!this.tracks.length) this.tracks = found.map(({ name, position }) => ({ name, ...Object.fromEntries(Object.keys(LISTS).filter(list => position || !LISTS[list]).map(list => [list, []])) }));
      const last = this.times.at(-1) ?? -1;
      const fresh = stretch.time_s.findIndex(t => t > last);
      this.done = fresh < 0;
      const old = Math.max(0, this.index() - 600);
      const take = (kept, given) => { if (fresh >= 0) kept.push(...given.slice(fresh)); kept.splice(0, old); };
      take(this.times, stretch.time_s);
      this.tracks.forEach((track, k) => this.lists(track).forEach(list => take(track[list], found[k][list])));
    } finally { this.busy = false; }
  }

  // What is kept of each sample of a body.
  lists(track) { return Object.keys(LISTS).filter(list => track[list]); }

  // The last sample at or before the time that is shown.
  index() {
    const { times } = this;
    let [low, high] = [0, times.length - 1];
    while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= this.t) low = middle; else high = middle - 1; }
    return Math.max(0, low);
  }

  // Jumps to a time.
  async go(time) {
    if (this.busy) { this.wanted = time; return; }
    this.times.length = 0;
    this.tracks.forEach(track => this.lists(track).forEach(list => { track[list].length = 0; }));
    this.t = time;
    // The samples before it are the trail; of many bodies an answer holds few.
    const { time_s } = this.first;
    const before = this.several ? Math.min(200, time_s.length >> 1) : 200;
    const each = (time_s.at(-1) - time_s[0]) / Math.max(1, time_s.length - 1);
    await this.fetch(Math.max(0, time - before * Math.max(each, this.every())));
    this.show();
    if (this.wanted !== undefined) { const wanted = this.wanted; this.wanted = undefined; await this.go(wanted); }
  }

  // The same for a press: what cannot be read, or is not wanted any more, stops the player.
  jump(time) { this.go(time).catch(() => this.run(false)); }

  run(on) {
    this.playing = on;
    this.play.textContent = on ? "Pause" : "Play";
    // A paused view shows a sample of the log.
    if (!on) { this.t = this.times[this.index()] ?? this.t; this.show(); return; }
    let before;
    const run = this.turn = {};
    const tick = now => {
      if (run !== this.turn || !this.playing || !this.root.isConnected) return;
      const { times } = this;
      const last = times.at(-1) ?? 0;
      if (!this.busy) this.t = Math.min(this.t + Math.min(now - (before ?? now), 2000) * 1e-3 * this.speed, last);
      before = now;
      if (times.length - this.index() < 120 && !this.done && !this.busy) this.fetch(last).catch(() => this.run(false));
      if (this.t >= last && this.done && !this.busy) this.jump(0);
      this.show();
      // The next picture comes after this one is on the screen.
      requestAnimationFrame(after => {
        const rest = resting(after - now);
        if (rest > 0) setTimeout(() => requestAnimationFrame(tick), rest); else tick(after);
      });
    };
    requestAnimationFrame(tick);
  }

  // Of several bodies: their masses, what holds them in space, and the names to choose from.
  setOut({ bodies = [], joints = [], potential = [] }) {
    const n = Math.round(Math.sqrt(this.tracks[0].attitude[0].length));
    this.several = Boolean(this.tracks[0].position);
    this.drawn.trail.nextSibling.textContent = this.several ? "Paths" : "Trail of the third axis";
    this.which.closest("label").hidden = !this.several;
    if (n !== 3) this.caption.textContent = this.several ? `SO(${n}): the first axes and places of the bodies.` : `SO(${n}): the first axes of the body, projected onto the first directions of space.`;
    if (!this.several) return;
    this.which.replaceChildren(h("option", { value: "" }, "All bodies"), ...this.tracks.map(({ name }, k) => h("option", { value: k }, name)));
    const masses = this.tracks.map(({ name }) => bodies.find(body => body.name === name)?.mass ?? 0);
    const held = joints.filter(({ between }) => between.includes("space")).map(({ between, points }) => points[between.indexOf("space")])
      .concat(potential.map(({ position }) => position), bodies.map(({ pivot }) => pivot)).filter(Boolean).map(three);
    // What nothing holds is seen from its centre of mass, which goes its way; the rest from the middle of where it is.
    const whole = masses.reduce((sum, mass) => sum + mass, 0);
    if (whole > 0 && !held.length) this.middle = places => [0, 1, 2].map(i => places.reduce((sum, x, k) => sum + masses[k] * x[i], 0) / whole);
    else {
      const all = held.concat(this.tracks.flatMap(({ position }) => position.map(three)));
      const middle = [0, 1, 2].map(i => { const at = all.map(x => x[i]); return at.reduce((a, b) => Math.min(a, b)) / 2 + at.reduce((a, b) => Math.max(a, b)) / 2; });
      this.middle = () => middle;
    }
    this.held = held;
    const levers = name => joints.flatMap(({ between, points }) => points.filter((_, k) => between[k] === name)).map(three);
    // Lines: of a joint to the centres of its bodies, and springs.
    const line = (frames, points, coil, text) => this.lines.push({ frames, points: points.map(three), coil, text });
    for (const { between, points } of joints) between.forEach((name, k) => { if (name !== "space") line([name, name], [[0, 0, 0], points[k]]); });
    for (const { kind, between, body, points, body_point, position, direction, stiffness } of potential) {
      if (kind === "spring") line(between ?? [body, "space"], points ?? [body_point, position], true, `spring ${figure(stiffness)} N/m`);
      // What stands in space, as in the log of one body: yellow directions, grey points.
      if (direction) this.parts.push({ frame: "space", color: [0.93, 0.75, 0.15, 1], points: [[0, 0, 0], three(direction)], thick: 0.03 });
    }
    for (const at of held) this.parts.push({ frame: "space", color: [0.45, 0.45, 0.45, 1], points: [at], radius: 1 });
    this.levers = levers;
  }

  // Shapes as they stand in their frames; for bodies that have none, a cube of the first three axes.
  draw(scene) {
    const n = Math.round(Math.sqrt(this.tracks[0].attitude[0].length));
    const axis = (turn, color) => ({ position: [0, 0, 0], orientation: turn, size: [1, 0.03, 0.03], color });
    const h = Math.SQRT1_2;
    const plain = frame => ({ frame, balls: [], boxes: [
      { position: [0, 0, 0], orientation: [1, 0, 0, 0], size: [1, 1, n > 2 ? 1 : 0.1], color: [0.62, 0.66, 0.72, 0.7] }],
      arrows: [axis([1, 0, 0, 0], [1, 0, 0, 1]), axis([h, 0, 0, h], [0, 1, 0, 1]), axis([h, 0, -h, 0], [0, 0, 1, 1])] });
    for (const box of Object.values(this.drawn)) box.closest("label").hidden = n !== 3 && !(this.several && ["trail", "labels"].includes(box.value));
    const reach = shape => Math.hypot(...shape.position) + 0.5 * Math.hypot(...shape.size);
    const farthest = ({ boxes, balls, arrows }) => Math.max(0, ...boxes.map(reach), ...balls.map(reach), ...arrows.map(a => a.size[0]));
    if (this.several) {
      scene = scene.filter(({ frame }) => frame !== "space");
      // Without a shape, a body is drawn as far as its joints, or as a part of the whole.
      const away = Math.max(0, ...this.tracks.map(({ position: [at] }) => Math.hypot(...three(at).map((x, i) => x - this.middle(this.tracks.map(track => three(track.position[0])))[i]))));
      this.reaches = new Map(this.tracks.map(({ name }) => {
        const drawing = scene.find(({ frame }) => frame === name);
        return [name, (drawing && farthest(drawing)) || Math.max(0, ...this.levers(name).map(at => Math.hypot(...at))) || 0.2 * away || 1];
      }));
      const grown = (drawing, by) => Object.fromEntries(Object.entries(drawing).map(([kind, shapes]) => [kind, kind === "frame" ? shapes :
        shapes.map(shape => ({ ...shape, size: shape.size.map(x => x * by) }))]));
      scene = scene.concat(this.tracks.filter(({ name }) => !scene.some(({ frame }) => frame === name)).map(({ name }) => grown(plain(name), this.reaches.get(name))));
      this.far = 0;
      this.times.forEach((_, k) => this.fit(this.tracks.map(({ position }) => three(position[k]))));
    } else {
      if (!scene.length) scene = [plain("body")];
      this.scale = 108 / Math.max(1e-9, ...scene.map(farthest));
    }
    for (const { frame, boxes, balls, arrows } of scene) {
      for (const box of boxes) this.parts.push(...faces(box).map(face => ({ frame, color: box.color, ...face })));
      for (const { position, size, color } of balls) this.parts.push({ frame, color, points: [position], radius: size[0] / 2 });
      for (const { position, orientation, size: [length, thick], color } of arrows) {
        const along = rotation(orientation).map(row => row[0] * length);
        this.parts.push({ frame, color, points: [position, position.map((x, i) => x + along[i])], thick });
      }
    }
    this.parts.push(...this.lines);
  }

  // Keeps all of several bodies in sight, and what holds them: the view only ever widens.
  fit(places) {
    const middle = this.middle(places);
    const away = x => Math.hypot(...x.map((y, i) => y - middle[i]));
    this.far = Math.max(this.far, ...this.held.map(away), ...places.map((x, k) => away(x) + this.reaches.get(this.tracks[k].name)));
    const all = 0.42 * (Math.min(this.stage.clientWidth, this.stage.clientHeight) || 350) / this.far;
    this.scale = this.followed === null ? all : Math.max(all, 70 / this.reaches.get(this.tracks[this.followed].name));
  }

  // Follows one of several bodies, by its number; without one all are looked at.
  choose(number) {
    this.followed = this.several && number !== "" ? Number(number) : null;
    const followed = [this.tracks[this.followed ?? 0]];
    [this.fastest, this.largest] = ["angular_velocity", "body_momentum"].map(quantity => this.most(quantity, followed));
    if (this.several) {
      for (const name of ["velocity", "momentum"]) this.drawn[name].closest("label").hidden = this.followed === null || this.tracks[0].attitude[0]?.length !== 9;
    }
  }

  look(right, up) {
    this.azimuth += right;
    this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + up));
    this.show();
  }

  magnify(by) {
    const [least, most] = this.several ? [1e-3, 1e3] : [0.2, 12];
    this.zoom = Math.max(least, Math.min(most, this.zoom * by));
    this.show();
  }

  // Labels the axes and points of the body, and what acts on them. Drawings count in a length of their own.
  name({ potential = [], driven = [] }) {
    this.moving = driven.filter(({ path }) => path);
    const acting = [...potential.map(term => ({ term })), ...driven];
    const farthest = points => Math.max(0, ...points.map(at => Math.hypot(...at)));
    const drawn = farthest(this.parts.filter(part => part.frame === "body" && part.radius !== undefined).map(part => part.points[0]));
    this.unit = drawn > 0 ? farthest(acting.map(({ term }) => term.body_point ?? [0])) / drawn : 1;
    const add = (frame, at, text) => {
      if (!at || at.length !== 3) return;
      const same = this.labels.find(label => label.frame === frame && label.at.every((x, i) => Math.abs(x - at[i]) < 1e-9));
      if (!same) this.labels.push({ frame, at, texts: [text] });
      else if (!same.texts.includes(text)) same.texts.push(text);
    };
    const signed = x => `${x < 0 ? "−" : "+"}${figure(Math.abs(x))}`;
    for (const { term, path } of acting) {
      const { kind, weight, strength, stiffness, body_point, position, direction } = term;
      const source = path && `source/${this.moving.findIndex(one => one.term === term)}`;
      const here = body_point?.map(x => x / this.unit);
      const there = text => source ? add(source, [0, 0, 0], text) : add("space", position?.map(x => x / this.unit), text);
      const tip = text => source ? add(source, [1.5, 0, 0], text) : add("space", direction?.map(x => 1.5 * x / Math.hypot(...direction)), text);
      // The force on the point is against the direction.
      if (kind === "uniform") { add("body", here, `weight ${figure(weight)} N`); tip(weight < 0 ? "down" : "up"); }
      if (kind === "point_source") { add("body", here, `charge ${signed(strength)}`); there("source"); }
      if (kind === "spring") { add("body", here, `spring ${figure(stiffness)} N/m`); there("anchor"); }
      if (kind === "gravity_gradient") tip("vertical");
    }
    // A free body, and one in orbit, turns about its centre of mass; nothing holds it there.
    if (acting.some(({ term }) => term.body_point)) add("space", [0, 0, 0], "fixed point");
    ["x", "y", "z"].forEach((name, k) => add("body", [0, 1, 2].map(i => i === k ? 1.38 : 0), name));
  }

  // Labels several bodies, and what acts on them.
  nameAll({ potential = [] }) {
    const add = (frame, at, text) => {
      const same = this.labels.find(label => label.frame === frame && label.at.every((x, i) => x === at[i]));
      if (!same) this.labels.push({ frame, at, texts: [text] });
      else if (!same.texts.includes(text)) same.texts.push(text);
    };
    for (const { name } of this.tracks) add(name, [0, 0, 0], name);
    for (const { kind, body, weight, body_point, direction, position, strength } of potential) {
      if (!body || body_point?.length > 3) continue;
      if (kind === "uniform") {
        add(body, three(body_point), `weight ${figure(weight)} N`);
        this.labels.push({ tip: unit(three(direction)), texts: [weight < 0 ? "down" : "up"] });
      }
      if (kind === "point_source") { add(body, three(body_point), `charge ${figure(strength)}`); add("space", three(position), "source"); }
      if (kind === "spring") add("space", three(position), "anchor");
    }
    this.labels = this.labels.filter(({ tip }, k) => !tip || this.labels.findIndex(label => String(label.tip) === String(tip)) === k);
    for (const { frames, points, text } of this.lines) if (text) this.labels.push({ frames, points, texts: [text] });
  }

  // Where a point of a frame is in space at the time that is shown, and in it the bodies. A frame of something that moves
  // has it at its origin, or its direction along its first axis.
  place(frame, at, poses) {
    const pose = poses.get?.(frame);
    if (pose) return times(pose.g, at).map((x, i) => x + pose.x[i]);
    const mover = this.moving?.[Number(/^source\/(\d+)$/.exec(frame)?.[1])];
    if (!mover) return at;
    const now = along(mover, this.t);
    return mover.term.position ? at.map((x, i) => x + now[i] / this.unit) : now.map(x => x / Math.hypot(...now) * at[0]);
  }

  // The attitudes and places of all bodies at the time that is shown, by their frames.
  poses(k) {
    return new Map(this.tracks.map(track => [track.name, { g: this.now(k, track), x: this.where(k, track) }]));
  }

  // The place of a body: between two samples on the cubic curve that has their places and velocities.
  where(k, { position, velocity }) {
    if (!position) return [0, 0, 0];
    const x = three(position[k]);
    const [dt, since] = [this.times[k + 1] - this.times[k], this.t - this.times[k]];
    if (!(since > 0) || !(dt > 0)) return x;
    const [s, y, v, w] = [since / dt, three(position[k + 1]), three(velocity[k]), three(velocity[k + 1])];
    return x.map((a, i) => a + s * (dt * v[i] + s * (3 * (y[i] - a) - dt * (2 * v[i] + w[i]) + s * (2 * (a - y[i]) + dt * (v[i] + w[i])))));
  }

  // The attitude at the time that is shown: between two samples turned about one axis, as far as the velocity says.
  now(k, { attitude, angular_velocity: velocity } = this.tracks[this.followed ?? 0]) {
    const square = flat => {
      const n = Math.round(Math.sqrt(flat.length));
      return [0, 1, 2].map(i => [0, 1, 2].map(j => i < n && j < n ? flat[i * n + j] : Number(i === j)));
    };
    const g = square(attitude[k]);
    const [dt, since] = [this.times[k + 1] - this.times[k], this.t - this.times[k]];
    if (attitude[k].length !== 9 || !(since > 0) || !(dt > 0)) return g;
    const next = square(attitude[k + 1]);
    const r = [0, 1, 2].map(i => [0, 1, 2].map(j => g[0][i] * next[0][j] + g[1][i] * next[1][j] + g[2][i] * next[2][j]));
    const twice = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]];
    const sine = Math.hypot(...twice);
    if (sine < 1e-9) return g;
    const axis = twice.map(x => x / sine);
    const angle = Math.atan2(sine, r[0][0] + r[1][1] + r[2][2] - 1);
    const expected = velocity[k]?.length === 3 ? (velocity[k][0] * axis[0] + velocity[k][1] * axis[1] + velocity[k][2] * axis[2]) * dt : angle;
    const whole = angle + 2 * Math.PI * Math.round((expected - angle) / (2 * Math.PI));
    const half = 0.5 * whole * since / dt;
    const turn = rotation([Math.cos(half), ...axis.map(x => x * Math.sin(half))]);
    return g.map(row => [0, 1, 2].map(j => row[0] * turn[0][j] + row[1] * turn[1][j] + row[2] * turn[2][j]));
  }

  // Puts everything where it is at the time `t`.
  show() {
    const k = this.index();
    if (this.times[k] === undefined || !this.scale) return;
    const poses = this.poses(k);
    this.g = poses.get(this.tracks[this.followed ?? 0].name).g;
    if (this.several) this.fit([...poses.values()].map(pose => pose.x));
    if (this.inSight) this.paint(this.camera(poses), poses, k);
    const shown = this.times[k + 1] === undefined ? this.times[k] : Math.max(this.t, this.times[k]);
    put(this.time, `t = ${clock(shown)}`);
    if (document.activeElement !== this.seek) this.seek.value = shown;
    this.onframe?.(shown);
  }

  // What several bodies are looked at from: the one that is followed, or their middle.
  centre(places) { return !this.several ? [0, 0, 0] : this.followed === null ? this.middle(places) : places[this.followed]; }

  // From space to the eye, and onto the screen.
  camera(poses) {
    const [width, height] = [this.stage.clientWidth, this.stage.clientHeight];
    const [sa, ca, se, ce] = [Math.sin(this.azimuth), Math.cos(this.azimuth), Math.sin(this.elevation), Math.cos(this.elevation)];
    // Right, down and towards the eye, as CSS counts; z of space is up.
    const view = [[ca, sa, 0], [-sa * se, ca * se, -ce], [sa * ce, -ca * ce, se]];
    const centre = this.centre([...poses.values()].map(pose => pose.x));
    const seen = at => times(view, at.map((x, i) => x - centre[i])).map(x => x * this.scale * this.zoom);
    const near = z => EYE / Math.max(50, EYE - z);
    const onto = ([x, y, z]) => [width / 2 + x * near(z), height / 2 + y * near(z)];
    return { width, height, centre, seen, near, onto, spot: at => onto(seen(at)) };
  }

  // Paints the scene, and on top of it the trail of the third axis or the paths, the arrows and the labels.
  paint({ width, height, centre, seen, near, onto, spot }, poses, k) {
    const dense = devicePixelRatio || 1;
    if (this.ink.width !== Math.round(width * dense) || this.ink.height !== Math.round(height * dense)) {
      [this.ink.width, this.ink.height] = [Math.round(width * dense), Math.round(height * dense)];
    }
    const pen = this.ink.getContext("2d");
    const style = getComputedStyle(this.stage);
    const shade = name => style.getPropertyValue(name).trim();
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, width, height);
    const pointed = ([x, y], [ex, ey], color, thick) => {
      const [length, angle, head] = [Math.hypot(ex - x, ey - y), Math.atan2(ey - y, ex - x), 3.2 * thick + 1.5];
      pen.strokeStyle = pen.fillStyle = color;
      pen.lineWidth = thick;
      pen.save();
      pen.translate(x, y);
      pen.rotate(angle);
      pen.beginPath();
      pen.moveTo(0, 0);
      pen.lineTo(Math.max(0, length - head), 0);
      pen.stroke();
      pen.beginPath();
      pen.moveTo(length, 0);
      pen.lineTo(length - head, 0.45 * head);
      pen.lineTo(length - head, -0.45 * head);
      pen.fill();
      pen.restore();
    };
    // Of several bodies, one that is too small to be seen is drawn larger; directions are as long as the whole is wide.
    const small = frame => this.several && this.reaches.has(frame) ? Math.max(1, 8 / (this.reaches.get(frame) * this.scale * this.zoom)) : 1;
    const grow = new Map(this.tracks.map(({ name }) => [name, small(name)]));
    const larger = [...grow].filter(([, by]) => by > 1.05).map(([name, by]) => `${name} ${figure(Number(by.toPrecision(2)))} times`);
    if (this.several && this.tracks[0].attitude[k].length === 9) put(this.caption, larger.length ? `Drawn larger than to scale, to be seen: ${larger.join(", ")}.` : "");
    const set = (frame, at, by) => this.place(frame, by > 1 ? at.map(x => x * by) : at, poses);
    const parts = this.parts.flatMap(part => {
      const by = part.radius === undefined || this.several ? grow.get(part.frame) ?? 1 : 1;
      let placed;
      if (part.frames) placed = part.points.map((at, i) => this.place(part.frames[i], at, poses));
      else if (this.several && part.frame === "space" && part.thick !== undefined) {
        const [foot, tip] = part.points, along = unit(tip.map((x, i) => x - foot[i]));
        placed = [centre, centre.map((x, i) => x + along[i] * 125 / this.scale)];
      // Axes of bodies that are small on the screen would hide them.
      } else if (this.several && part.thick !== undefined && this.reaches.get(part.frame) * this.scale * this.zoom < 26) return [];
      else placed = part.points.map(at => set(part.frame, at, by));
      const points = placed.map(seen);
      return { ...part, points, by, depth: points.reduce((sum, at) => sum + at[2], 0) / points.length };
    });
    for (const { frame, frames, points, color: [r, g, b, a] = [0, 0, 0, 1], radius, thick, coil, by, tone = 1 } of parts.sort((a, b) => a.depth - b.depth)) {
      const lit = light => `rgb(${[r, g, b].map(x => Math.round(255 * Math.min(1, x * light))).join(" ")} / ${a})`;
      pen.beginPath();
      if (frames) {
        pen.strokeStyle = shade(coil ? "--accent" : "--soft");
        pen.lineWidth = coil ? 1.5 : 3;
        const [[x, y], [ex, ey]] = points.map(onto), long = Math.hypot(ex - x, ey - y) || 1;
        pen.moveTo(x, y);
        // A spring is a line to and fro.
        for (let i = 1; coil && i < 24; i += 1) {
          const [part, side] = [0.1 + 0.8 * i / 24, i % 2 ? 4 : -4];
          pen.lineTo(x + part * (ex - x) - side * (ey - y) / long, y + part * (ey - y) + side * (ex - x) / long);
        }
        pen.lineTo(ex, ey);
        pen.stroke();
      } else if (radius !== undefined) {
        const drawn = radius * by * this.scale * this.zoom * near(points[0][2]);
        // What stands in space next to several bodies is a point.
        pen.arc(...onto(points[0]), this.several ? frame === "space" ? 4 : Math.max(2, Math.min(5, drawn)) : Math.max(1, drawn), 0, 7);
        pen.fillStyle = lit(1);
        pen.fill();
      } else if (thick !== undefined) {
        pointed(onto(points[0]), onto(points[1]), lit(1), this.several ? 2 : Math.max(2, Math.min(6, thick * this.scale * this.zoom)));
      } else {
        const [u, v] = [1, 2].map(i => points[i].map((x, j) => x - points[0][j]));
        const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        // Light from above, from the left, from behind the eye.
        const facing = Math.abs(-0.35 * normal[0] - 0.6 * normal[1] + 0.72 * normal[2]) / Math.max(1e-9, Math.hypot(...normal));
        points.map(onto).forEach(([x, y]) => pen.lineTo(x, y));
        pen.closePath();
        pen.fillStyle = lit(tone * (0.72 + 0.4 * facing));
        pen.fill();
      }
    }
    const main = this.tracks[this.followed ?? 0], { g, x } = poses.get(main.name);
    const { attitude, angular_velocity: velocity, body_momentum: momentum } = main;
    const n = Math.round(Math.sqrt(attitude[k].length));
    const reach = 118 / this.scale;
    const ahead = at => at.map((y, i) => y + x[i]);
    // In pieces that fade: a stroke for each sample would take most of the time.
    const trail = tips => {
      const spots = tips.map(spot), each = Math.max(1, Math.ceil(spots.length / 12));
      for (let from = 0; from + 1 < spots.length; from += each) {
        pen.globalAlpha = 0.15 + 0.85 * Math.min(1, (from + each) / spots.length);
        pen.beginPath();
        spots.slice(from, from + each + 1).forEach(at => pen.lineTo(...at));
        pen.stroke();
      }
      pen.globalAlpha = 1;
      return spots.at(-1);
    };
    pen.strokeStyle = pen.fillStyle = shade("--trail");
    pen.lineWidth = 2;
    const begin = Math.max(0, k - 300);
    if (this.drawn.trail.checked && this.several) {
      // As seen from what is looked at, which may move itself.
      const before = this.times.slice(begin, k + 1).map((_, i) => {
        const places = this.tracks.map(({ position }) => three(position[begin + i])), from = this.centre(places);
        return places.map(place => place.map((y, j) => y - from[j] + centre[j]));
      });
      pen.lineWidth = 1.5;
      this.tracks.forEach(({ name }, body) => trail([...before.map(places => places[body]), poses.get(name).x]));
    } else if (this.drawn.trail.checked && n === 3) {
      const tips = attitude.slice(begin, k + 1).map(flat => [flat[2] * reach, flat[5] * reach, flat[8] * reach]);
      const end = trail([...tips, g.map(row => row[2] * reach)]);
      pen.beginPath();
      pen.arc(...end, 3.5, 0, 7);
      pen.fill();
    }
    const words = [];
    const arrow = (vector, longest, color, word) => {
      if (this.several && this.followed === null) return;
      if (!(vector?.length === 3) || !(longest > 0) || !(Math.hypot(...vector) > 1e-6 * longest)) return;
      const end = spot(ahead(times(g, vector).map(x => x / longest * (this.several ? 90 / this.scale : reach * 1.15))));
      pointed(spot(x), end, shade(color), 3);
      words.push([word, ...end, shade(color)]);
    };
    if (this.drawn.velocity.checked) arrow(velocity[k], this.fastest, "--velocity", "ω");
    if (this.drawn.momentum.checked && n === 3) arrow(momentum[k], this.largest, "--momentum", "L");
    if (this.drawn.labels.checked && (n === 3 || this.several)) {
      for (const { frame, at, tip, frames, points, texts } of this.labels) {
        const end = tip ? centre.map((y, i) => y + tip[i] * 125 / this.scale) : frames
          ? points.map((at, i) => this.place(frames[i], at, poses)).reduce((a, b) => a.map((y, i) => (y + b[i]) / 2)) : set(frame, at, grow.get(frame) ?? 1);
        const [left, top] = spot(end);
        // What is out of sight of the body that is followed has no label at the edge.
        if (!this.several || (left > 0 && left < width && top > 0 && top < height)) words.push([texts.join(", "), left, top, shade("--ink")]);
      }
    }
    pen.font = "600 13px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.lineJoin = "round";
    const boxes = [];
    for (const [word, x, y, color] of words) {
      const wide = pen.measureText(word).width;
      // Next to its point, where nothing is written yet.
      const inside = ([left, top]) => [Math.max(4, Math.min(left, width - wide - 4)), Math.max(10, Math.min(top, height - 10))];
      const free = ([left, top]) => boxes.every(([l, t, w]) => Math.abs(t - top) >= 15 || left >= l + w || l >= left + wide);
      const places = [0, 16, -16, 32, -32].flatMap(down => [[x + 8, y + down], [x - 8 - wide, y + down]]).map(inside);
      const [left, top] = places.find(free) ?? places[0];
      boxes.push([left, top, wide]);
      if (Math.abs(top - y) > 20) {
        pen.lineWidth = 1;
        pen.strokeStyle = color;
        pen.beginPath();
        pen.moveTo(x, y);
        pen.lineTo(left < x ? left + wide : left, top);
        pen.stroke();
      }
      pen.lineWidth = 4;
      pen.strokeStyle = shade("--stage");
      pen.strokeText(word, left, top);
      pen.fillStyle = color;
      pen.fillText(word, left, top);
    }
  }

  close() {
    this.run(false);
    this.sizes.disconnect();
    this.sight.disconnect();
  }
}

// The direction or position of a term that moves, at a time.
function along({ term, path }, t) {
  const start = term.position ?? term.direction;
  const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
  const unit = v => v.map(x => x / Math.hypot(...v));
  const beside = (v, u) => unit(v.map((x, i) => x - dot(v, u) * u[i]));
  const mix = (a, u, b, v) => u.map((x, i) => a * x + b * v[i]);
  if (path.turning) {
    const { from, towards, rate_rad_s } = path.turning;
    const u = unit(from), v = beside(towards, u), [c, s] = [Math.cos(rate_rad_s * t), Math.sin(rate_rad_s * t)];
    const [a, b] = [dot(start, u), dot(start, v)];
    return mix(1, start, 1, mix(a * (c - 1) - b * s, u, a * s + b * (c - 1), v));
  }
  const { towards, mean_motion_rad_s, eccentricity: e = 0, mean_anomaly_rad = 0 } = path.orbit;
  const u = unit(start), v = beside(towards, u), far = Math.hypot(...start);
  // Kepler's equation E - e sin E = M, by Newton's method from a start for which it converges.
  const M = (mean_anomaly_rad + mean_motion_rad_s * t) % (2 * Math.PI);
  let E = M + Math.sign(Math.sin(M)) * 0.85 * e;
  for (let k = 0; k < 20; k += 1) E -= (E - e * Math.sin(E) - M) / (1 - e * Math.cos(E));
  return mix(far * (Math.cos(E) - e), u, far * Math.sqrt(1 - e * e) * Math.sin(E), v);
}

// How long to wait for the next picture, in ms, after one that took a time to come onto the screen. Where this takes longer
// than a frame, as with many windows or without a graphics card, pictures take a third of the time; a window that is not in
// front shows 20 a second at most.
function resting(took_ms) {
  const busy = took_ms > 25 ? Math.min(400, 2 * took_ms) : 0;
  return document.hasFocus() ? busy : Math.max(busy, 50 - took_ms);
}

// What an answer holds of each sample of a body, and whether only one of several bodies has it.
const LISTS = { attitude: false, body_momentum: false, angular_velocity: false, position: true, velocity: true };

// The first three numbers of a vector of any length.
const three = v => [v[0] ?? 0, v[1] ?? 0, v[2] ?? 0];
const unit = v => v.map(x => x / (Math.hypot(...v) || 1));

// Distance of the eye from the middle of the scene, in pixels.
const EYE = 1100;

function times(matrix, v) {
  return matrix.map(row => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
}

// Rows of the matrix of a unit quaternion (w, x, y, z).
function rotation([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// The faces of a box. Two equal edges and a third are the inertia of a cylinder or a disc, which is easier to know by its
// shape: a^2 / 12 = r^2 / 4. Its quarters differ, so that one sees it turn.
function faces({ position, orientation, size }) {
  const turn = rotation(orientation);
  const at = place => position.map((x, i) => x + turn[i][0] * place[0] + turn[i][1] * place[1] + turn[i][2] * place[2]);
  const half = size.map(edge => edge / 2);
  // A place by its coordinates along the axes k, k + 1, k + 2.
  const around = (k, a, b, c) => { const place = [0, 0, 0]; [place[k], place[(k + 1) % 3], place[(k + 2) % 3]] = [a, b, c]; return at(place); };
  const axis = [0, 1, 2].find(k => {
    const [w, u, v] = [size[k], size[(k + 1) % 3], size[(k + 2) % 3]];
    return Math.abs(u - v) < 1e-6 * u && Math.abs(u - w) > 1e-3 * u;
  });
  if (axis === undefined) {
    return [0, 1, 2].flatMap(k => [1, -1].map(side => ({ points: [[1, 1], [1, -1], [-1, -1], [-1, 1]]
      .map(([b, c]) => around(k, side * half[k], b * half[(k + 1) % 3], c * half[(k + 2) % 3])) })));
  }
  const [radius, sides] = [size[(axis + 1) % 3] / Math.sqrt(3), 48];
  const rim = (k, side) => around(axis, side * half[axis], radius * Math.cos(2 * Math.PI * k / sides), radius * Math.sin(2 * Math.PI * k / sides));
  const tone = k => Math.floor(4 * k / sides) % 2 ? 0.78 : 1;
  const steps = Array.from({ length: sides }, (_, k) => k);
  const mantle = steps.map(k => ({ tone: tone(k), points: [rim(k, 1), rim(k + 1, 1), rim(k + 1, -1), rim(k, -1)] }));
  const quarter = sides / 4;
  const ends = [1, -1].flatMap(side => [0, 1, 2, 3].map(q => ({ tone: tone(q * quarter),
    points: [around(axis, side * half[axis], 0, 0), ...steps.slice(0, quarter + 1).map(k => rim(q * quarter + k, side))] })));
  return [...mantle, ...ends];
}
