"use strict";
// The body in space: boxes, balls and arrows as CSS boxes, turned by matrix3d. Lengths in the log's units are
// scaled to pixels here and nowhere else.
class Stage {
  constructor(template) {
    this.root = template.content.firstElementChild.cloneNode(true);
    const find = name => this.root.querySelector(`.${name}`);
    [this.stage, this.space, this.body] = [find("stage"), find("space"), find("body")];
    [this.play, this.seek, this.time, this.rate, this.caption] =
      [find("play"), find("seek"), find("time"), find("rate"), find("caption")];
    [this.azimuth, this.elevation] = [-0.6, 0.35];
    this.balls = [];
    this.frames = { time_s: [], attitude: [] };
    [this.at, this.end, this.busy, this.playing] = [0, 0, false, false];
    this.play.onclick = () => this.run(!this.playing);
    this.seek.oninput = () => this.go(Number(this.seek.value));
    this.stage.onpointerdown = event => this.stage.setPointerCapture(event.pointerId);
    this.stage.onpointermove = event => {
      if (this.stage.hasPointerCapture(event.pointerId)) this.look(-event.movementX * 0.01, event.movementY * 0.01);
    };
    this.stage.onkeydown = event => {
      const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (turn) { this.look(...turn); event.preventDefault(); }
      if (event.key === " ") { this.run(!this.playing); event.preventDefault(); }
    };
  }

  // `load(from_s)` gives attitudes from a time on.
  async open(load) {
    this.load = load;
    await this.fetch(0);
    if (this.frames.time_s.length === 0) return false;
    this.draw(this.first.scene);
    this.show();
    this.run(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    return true;
  }

  async fetch(from) {
    if (this.busy) return;
    this.busy = true;
    try {
      const stretch = await this.load(from);
      this.first ??= stretch;
      this.end = stretch.end_s ?? stretch.time_s.at(-1) ?? 0;
      this.seek.max = this.end || 1;
      const { time_s, attitude } = this.frames;
      const last = time_s.at(-1) ?? -1;
      const fresh = stretch.time_s.findIndex(t => t > last);
      this.done = fresh < 0;
      if (fresh >= 0) {
        time_s.push(...stretch.time_s.slice(fresh));
        attitude.push(...stretch.attitude.slice(fresh));
      }
      const old = Math.max(0, Math.floor(this.at) - 600);
      time_s.splice(0, old);
      attitude.splice(0, old);
      this.at -= old;
    } finally { this.busy = false; }
  }

  // Jumps to a time.
  async go(time) {
    if (this.busy) { this.wanted = time; return; }
    this.frames = { time_s: [], attitude: [] };
    this.at = 0;
    await this.fetch(time);
    this.show();
    if (this.wanted !== undefined) { const wanted = this.wanted; this.wanted = undefined; await this.go(wanted); }
  }

  run(on) {
    this.playing = on;
    this.play.textContent = on ? "Pause" : "Play";
    let before;
    const tick = now => {
      if (!this.playing || !this.root.isConnected) return;
      // One sample at a sixtieth of a second: logs are made for that.
      this.at += Math.min(now - (before ?? now), 100) * 0.06 * Number(this.rate.value);
      before = now;
      const count = this.frames.time_s.length;
      if (this.at > count - 120 && !this.done && !this.busy) this.fetch(this.frames.time_s.at(-1) ?? 0).catch(() => this.run(false));
      if (this.at >= count) { if (this.done) this.go(0); this.at = Math.max(0, count - 1); }
      this.show();
      requestAnimationFrame(tick);
    };
    if (on) requestAnimationFrame(tick);
  }

  // Shapes as they stand in their frames; for bodies that have none, a cube of the first three axes.
  draw(scene) {
    const n = Math.round(Math.sqrt(this.frames.attitude[0].length));
    const axis = (turn, color) => ({ position: [0, 0, 0], orientation: turn, size: [1, 0.03, 0.03], color });
    const h = Math.SQRT1_2;
    const plain = [{ frame: "body", balls: [], boxes: [
      { position: [0, 0, 0], orientation: [1, 0, 0, 0], size: [1, 1, n > 2 ? 1 : 0.1], color: [0.62, 0.66, 0.72, 0.7] }],
      arrows: [axis([1, 0, 0, 0], [1, 0, 0, 1]), axis([h, 0, 0, h], [0, 1, 0, 1]), axis([h, 0, -h, 0], [0, 0, 1, 1])] }];
    if (n !== 3) this.caption.textContent = `SO(${n}): the first axes of the body, projected onto the first directions of space.`;
    const drawings = scene.length ? scene : plain;
    const reach = shape => Math.hypot(...shape.position) + 0.5 * Math.hypot(...shape.size);
    const far = drawings.flatMap(d => [...d.boxes.map(reach), ...d.balls.map(reach), ...d.arrows.map(a => a.size[0])]);
    this.scale = 135 / Math.max(1e-9, ...far);
    for (const { frame, boxes, balls, arrows } of drawings) {
      const parent = frame === "body" ? this.body : this.space;
      boxes.forEach(box => this.box(parent, box));
      arrows.forEach(arrow => this.arrow(parent, arrow));
      balls.forEach(ball => this.balls.push({ ...ball, frame, node: this.node(this.space, "ball", ball.color, 1) }));
    }
  }

  node(parent, kind, [r, g, b, a], light) {
    const node = document.createElement("div");
    node.className = `shape ${kind}`;
    const part = x => Math.round(255 * Math.min(1, x * light));
    node.style.background = `rgb(${part(r)} ${part(g)} ${part(b)} / ${a})`;
    return parent.appendChild(node);
  }

  place(node, [x, y, z], turn, width, height) {
    const s = this.scale;
    Object.assign(node.style, { width: `${width * s}px`, height: `${height * s}px` });
    node.style.transform = `${matrix3d(turn, [x * s, y * s, z * s])} translate(-50%, -50%)`;
  }

  box(parent, { position, orientation, size: [a, b, c], color }) {
    const turn = rotation(orientation);
    const face = (normal, u, v, half, light) => {
      const at = position.map((p, i) => p + turn[i][normal] * half);
      const columns = turn.map(row => [row[u], row[v], row[normal]]);
      const [width, height] = [[a, b, c][u], [a, b, c][v]];
      this.place(this.node(parent, "face", color, light), at, columns, width, height);
    };
    [[0, 1, 2, a, 0.85], [1, 0, 2, b, 1], [2, 0, 1, c, 1.2]].forEach(([n, u, v, edge, light]) => {
      face(n, u, v, edge / 2, light);
      face(n, u, v, -edge / 2, light * 0.9);
    });
  }

  arrow(parent, { position, orientation, size: [length, thick], color }) {
    const turn = rotation(orientation);
    const middle = position.map((p, i) => p + turn[i][0] * length / 2);
    // Two crossed planes: an arrow from every side.
    for (const [u, w] of [[1, 2], [2, 1]]) {
      const columns = turn.map(row => [row[0], row[u], row[w]]);
      this.place(this.node(parent, "arrow", color, u === 1 ? 1 : 0.8), middle, columns, length, Math.max(4 * thick, length * 0.07));
    }
  }

  look(right, up) {
    this.azimuth += right;
    this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + up));
    this.show();
  }

  // Puts everything where it is at sample `at`.
  show() {
    const { time_s, attitude } = this.frames;
    const k = Math.max(0, Math.min(Math.floor(this.at), time_s.length - 1));
    const flat = attitude[k];
    if (!flat || !this.scale) return;
    const n = Math.round(Math.sqrt(flat.length));
    const g = [0, 1, 2].map(i => [0, 1, 2].map(j => i < n && j < n ? flat[i * n + j] : Number(i === j)));
    const [sa, ca, se, ce] = [Math.sin(this.azimuth), Math.cos(this.azimuth), Math.sin(this.elevation), Math.cos(this.elevation)];
    // Right, down and towards the eye, as CSS counts; z of space is up.
    const view = [[ca, sa, 0], [-sa * se, ca * se, -ce], [sa * ce, -ca * ce, se]];
    this.space.style.transform = matrix3d(view, [0, 0, 0]);
    this.body.style.transform = matrix3d(g, [0, 0, 0]);
    for (const { node, position, frame, size } of this.balls) {
      const at = frame === "body" ? times(g, position) : position;
      // Turned to the eye by the inverse of the view.
      this.place(node, at, view[0].map((_, i) => view.map(row => row[i])), size[0], size[1]);
    }
    const step = (time_s.at(-1) - time_s[0]) / Math.max(1, time_s.length - 1);
    this.time.textContent = `t = ${time_s[k].toPrecision(4)} s`;
    this.time.title = `${(step * 60 * Number(this.rate.value)).toPrecision(2)} s of simulated time per second`;
    if (document.activeElement !== this.seek) this.seek.value = time_s[k];
  }
}

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

// CSS takes columns.
function matrix3d(rows, [x, y, z]) {
  const column = j => rows.map(row => row[j].toFixed(9)).join(",");
  return `matrix3d(${column(0)},0,${column(1)},0,${column(2)},0,${x},${y},${z},1)`;
}
