// The page: simulates frame after frame, draws between two of them, and lets one drag, pin and blow.

const PATCH = 0.1; // radius of what a drag holds [diagonals]
const FASTEST_HAND = 0.08; // largest way of a hand per frame [diagonals]
const MOST_PINS = 8; // three modes each
const CLICK = 6, FLICK = 250; // largest way of a click [pixels], longest flick [ms]
const REACH = 14; // how near to a Gaussian one has to press [pixels]
const GUSTS = [[0.35, 0.3], [0.8, 2.1], [1.7, 4.4]]; // of the wind: frequencies [Hz] and phases
const SLOW_FRAME = 36, FAST_FRAME = 20, LEAST_SHARPNESS = 0.35; // bounds of the time of a picture [ms], of pixels
const MOST_BEHIND = 4; // frames that are simulated for one picture at most

class Page {
  constructor(facts) {
    const arrays = readArrays(content("content"), facts.arrays), find = (id) => document.getElementById(id);
    this.facts = facts;
    this.body = new Body(arrays, facts);
    const units = facts.units + 1, restCentres = new Float32Array(3 * units); // the last unit never moves
    restCentres.set(arrays.centres);
    this.splats = { unitOf: arrays.unit_of_kernel, units, restCentres, rest: arrays.rest, rotations: arrays.quats,
      scales: arrays.scales, opacities: arrays.opacities, base: arrays.base, sh: arrays.sh, sh_scales: facts.sh_scales };
    this.lists = restLists(this.splats);
    this.canvas = find("view"); this.marks = find("marks");
    this.painter = new Painter(this.canvas, this.splats, this.lists, facts.background);
    this.order = new Order(this.splats, this.lists[0]);
    this.orbit = new Orbit(facts.camera);
    this.placed = new Float32Array(24 * units);
    this.controls = Object.fromEntries(["play", "reset", "start", "hand", "speed", "home", "unpin", "stiffness", "damping",
      "gravity", "wind", "frames", "seen", "now", "status", "more"].map((id) => [id, find(id)]));
    Object.assign(this, { playing: true, stale: true, part: 0, frame: 0, pins: new Map(), grab: null, impulse: null });
    Object.assign(this, { sharpness: Math.min(window.devicePixelRatio || 1, 2), adapts: true, lag: 30, drawn: 0 });
    this.fill(find);
    this.listen();
    this.reset();
    this.wake();
  }

  fill(find) {
    const { facts } = this;
    find("name").textContent = facts.name;
    for (const [heading, text] of facts.about) {
      find("facts").append(Object.assign(document.createElement("dt"), { textContent: heading }),
        Object.assign(document.createElement("dd"), { textContent: text }));
    }
    facts.starts.forEach((start, i) =>
      this.controls.start.append(Object.assign(document.createElement("option"), { value: i, textContent: start.name })));
    if (window.innerWidth < 600) this.controls.more.open = false;
  }

  // ---- Time ----------------------------------------------------------------------------------------------------------

  get start() { return this.facts.starts[this.controls.start.value]; }
  get up() { return this.facts.camera.up; }

  reset() {
    this.start ? this.body.begin(this.start) : this.body.rest();
    Object.assign(this, { frame: 0, part: 1, impulse: null, grab: null, stale: true, limited: 0, limitedAt: -Infinity });
    this.pins.clear();
  }

  play(on) { this.playing = on; this.controls.play.textContent = on ? "Pause" : "Play"; }

  // One frame under all that acts.
  advance() {
    const { body, facts, controls } = this, unit = facts.gravity / facts.fps ** 2; // weight / mass, per frame
    const pushes = [], steady = Number(controls.gravity.value), wind = Number(controls.wind.value);
    if (steady) pushes.push(body.pushAll(this.up.map((value) => -steady * unit * value)));
    if (wind) {
      const gust = GUSTS.reduce((sum, [hz, phase]) => sum + Math.sin(2 * Math.PI * hz * this.frame / facts.fps + phase), 0);
      const strength = wind * unit * (1 + 0.4 * gust / GUSTS.length);
      pushes.push(body.blow(this.windward.map((value) => strength * value)));
    }
    const grab = this.grab?.way && this.grab;
    if (grab?.pulls) pushes.push(body.push(grab.units, grab.way.map((value) => value * grab.strength)));
    if (this.impulse) pushes.push(this.impulse);
    this.impulse = null;
    const push = pushes.length ? pushes.reduce((sum, next) => mixed(sum, next, 1)) : null;
    body.step(push, this.held(grab && !grab.pulls ? grab : null));
    this.frame++;
    this.stale = true;
  }

  // What pins and a moving hand hold: rows of displacements, where they are and where they go.
  held(grab) {
    const holds = [...this.pins.values()].map(({ rows, to }) => ({ rows, from: to, to }));
    if (grab) {
      const from = times(grab.rows, this.body.z, 3), way = mixed(mixed(grab.from, grab.way, 1), from, -1);
      const most = FASTEST_HAND * this.facts.diagonal, length = Math.hypot(...way);
      holds.push({ rows: grab.rows, from, to: mixed(from, way, Math.min(1, most / Math.max(length, 1e-30))) });
    }
    if (!holds.length) return null;
    const joined = (name) => Float64Array.from(holds.flatMap((hold) => [...hold[name]]));
    return { rows: joined("rows"), from: joined("from"), to: joined("to") };
  }

  wake() { this.last = performance.now(); requestAnimationFrame((now) => this.tick(now)); }

  tick(now) {
    if (document.hidden) return; // listen() wakes it
    const passed = Math.max(0, now - this.last);
    this.last = now;
    if (this.playing) {
      this.part += Math.min(passed / 1000, 0.5) * this.facts.fps * Number(this.controls.speed.value);
      for (let steps = 0; this.part > 1; steps++) {
        if (steps === MOST_BEHIND) { this.part = 1; break; }
        this.part -= 1;
        this.advance();
      }
      this.stale = true;
    }
    if (this.stale || this.resized()) {
      this.adapt(passed);
      this.draw();
    }
    requestAnimationFrame((later) => this.tick(later));
  }

  // Fewer pixels where pictures take too long.
  adapt(passed) {
    this.lag += 0.1 * (Math.min(passed, 200) - this.lag);
    if (!this.adapts) return;
    const sharpest = Math.min(window.devicePixelRatio || 1, 2), before = this.sharpness;
    if (this.lag > SLOW_FRAME) this.sharpness = Math.max(LEAST_SHARPNESS, 0.85 * before);
    else if (this.lag < FAST_FRAME) this.sharpness = Math.min(sharpest, 1.1 * before);
    if (this.sharpness !== before) this.lag = (SLOW_FRAME + FAST_FRAME) / 2;
  }

  // ---- Pictures ------------------------------------------------------------------------------------------------------

  resized() {
    const { canvas, marks } = this, sizes = [canvas.clientWidth, canvas.clientHeight];
    const [width, height] = sizes.map((size) => Math.max(1, Math.round(size * this.sharpness)));
    if (marks.width !== sizes[0] || marks.height !== sizes[1]) [marks.width, marks.height] = sizes;
    if (width === canvas.width && height === canvas.height) return false;
    Object.assign(canvas, { width, height });
    return true;
  }

  camera() { return this.orbit.camera(this.canvas.width, this.canvas.height); }

  // Modal coordinates between the last two frames.
  get shown() { return mixed(this.body.before, mixed(this.body.z, this.body.before, -1), Math.min(1, this.part)); }

  draw() {
    this.resized();
    const camera = this.camera();
    this.body.place(this.shown, this.placed);
    for (const [unit, { place }] of this.pins) this.placed.set(place, 24 * unit);
    this.painter.draw(this.placed, this.order.sort(this.placed, camera.view), camera);
    this.mark(camera);
    this.tell();
    this.stale = false;
    this.drawn++;
  }

  // Where a point is seen [CSS pixels], and its depth.
  seen(camera, point) {
    const [x, y, z] = [0, 4, 8].map((row) => dot(camera.view.slice(row, row + 3), point) + camera.view[row + 3]);
    const scale = this.canvas.clientWidth / this.canvas.width;
    return [(camera.focal * x / z + this.canvas.width / 2) * scale, (camera.focal * y / z + this.canvas.height / 2) * scale, z];
  }

  centre(unit) { return [3, 7, 11].map((at) => this.placed[24 * unit + at]); }

  mark(camera) {
    const ink = this.marks.getContext("2d");
    ink.clearRect(0, 0, this.marks.width, this.marks.height);
    this.marks.hidden = !this.grab && !this.pins.size;
    const ring = (unit, color) => {
      const [x, y] = this.seen(camera, this.centre(unit));
      Object.assign(ink, { strokeStyle: color, lineWidth: 2 });
      ink.beginPath(); ink.arc(x, y, 7, 0, 7); ink.stroke();
      return [x, y];
    };
    for (const unit of this.pins.keys()) ring(unit, "#ffcf5a");
    if (!this.grab) return;
    const place = ring(this.grab.unit, "#7ad0ff");
    ink.beginPath(); ink.moveTo(...place); ink.lineTo(this.grab.x, this.grab.y); ink.stroke();
  }

  tell() {
    const { controls, body, frame, start } = this, fps = Math.round(1000 / this.lag);
    controls.frames.style.visibility = start ? "visible" : "hidden";
    let text = `frame ${frame}`;
    if (start) {
      const end = start.frames - 1, where = frame < start.seen ? "in training" : frame <= end ? "not in training" : "beyond the recording";
      controls.seen.style.width = `${100 * Math.min(1, start.seen / start.frames)}%`;
      controls.now.style.left = `${100 * Math.min(1, frame / Math.max(end, 1))}%`;
      text += `, ${where}`;
    }
    if (body.limited !== this.limited) this.limitedAt = frame;
    this.limited = body.limited;
    if (frame - this.limitedAt < this.facts.fps) text += " · forces are reduced: far beyond the recorded motion";
    controls.status.textContent = this.note ?? `${text} · ${fps} pictures / s`;
  }

  // ---- Hands ---------------------------------------------------------------------------------------------------------

  // The unit of the nearest Gaussian to a press; null beside the object and on what never moves.
  picked(x, y) {
    const camera = this.camera(), { splats, placed, lists } = this, centres = lists[0];
    let best = null, nearest = Infinity;
    for (let k = 0; k < splats.unitOf.length; k++) {
      const u = 24 * splats.unitOf[k], o = centres.subarray(4 * k, 4 * k + 3);
      const at = [0, 4, 8].map((row) => dot(placed.subarray(u + row, u + row + 3), o) + placed[u + row + 3]);
      const [px, py, depth] = this.seen(camera, at);
      if (depth > 0 && depth < nearest && splats.opacities[k] > 0.1 && Math.hypot(px - x, py - y) < REACH) {
        [best, nearest] = [splats.unitOf[k], depth];
      }
    }
    const rows = best === null || best >= this.facts.units ? [0] : this.body.meanRows([best]);
    return rows.some((value) => value !== 0) ? { unit: best, depth: nearest } : null;
  }

  // Units near another at rest that can move.
  patch(unit) {
    const { centres } = this.body.arrays, at = (n) => centres.subarray(3 * n, 3 * n + 3);
    const near = (n) => Math.hypot(...at(n).map((value, c) => value - at(unit)[c])) < PATCH * this.facts.diagonal;
    return Array.from({ length: this.facts.units }, (_, n) => n).filter((n) => near(n) && this.body.meanRows([n]).some(Boolean));
  }

  claim(event) {
    const found = this.picked(event.clientX, event.clientY);
    if (!found || event.ctrlKey) return null;
    this.grab = this.held_by(found, event);
    const began = performance.now(), from = [event.clientX, event.clientY];
    return {
      move: (later) => {
        const camera = this.camera(), scale = found.depth / (camera.focal * this.canvas.clientWidth / this.canvas.width);
        const [dx, dy] = [later.clientX - from[0], later.clientY - from[1]];
        Object.assign(this.grab, { x: later.clientX, y: later.clientY, moved: Math.hypot(dx, dy) });
        if (this.grab.moved > CLICK) {
          this.grab.way = plus(camera.view.slice(0, 3).map((value) => value * dx * scale), camera.view.slice(4, 7), dy * scale);
        }
        this.stale = true;
      },
      end: (later, cancelled) => {
        const { grab } = this, frames = Math.max(1, (performance.now() - began) / 1000 * this.facts.fps);
        this.grab = null; this.stale = true;
        if (cancelled || !grab) return;
        if (!grab.way) this.pin(grab.unit);
        else if (grab.pulls && performance.now() - began < FLICK) this.flick(grab, grab.way.map((value) => value / frames));
      },
    };
  }

  // A hand at a unit. A pull is as strong as would hold the patch in the end where it is dragged to.
  held_by({ unit }, event) {
    const { body } = this, units = this.patch(unit), rows = body.meanRows(units);
    let yields = 0, gains = 0;
    for (let c = 0; c < 3; c++) {
      const change = body.push(units, [0, 1, 2].map((axis) => Number(axis === c)));
      const force = times(body.arrays.mass, change, body.modes);
      yields += times(rows, times(body.compliance, force, body.modes), 3)[c] / 3;
      gains += times(rows, body.pushed(change), 3)[c] / 3;
    }
    return { unit, units, rows, from: times(rows, body.z, 3), pulls: this.controls.hand.value === "force", strength: 1 / yields,
      gains, x: event.clientX, y: event.clientY };
  }

  // Gives a patch a velocity [scene units / frame].
  flick(grab, velocity) {
    const most = FASTEST_HAND * this.facts.diagonal, scale = Math.min(1, most / Math.max(Math.hypot(...velocity), 1e-30));
    this.impulse = this.body.push(grab.units, velocity.map((value) => value * scale / grab.gains));
  }

  // Pins a unit where it is, or lets it go.
  pin(unit) {
    this.note = null;
    if (this.pins.delete(unit)) return;
    if (this.pins.size >= Math.min(MOST_PINS, Math.floor(this.facts.modes / 6))) {
      this.note = `There can be ${this.pins.size} pins; unpin one first.`;
      return;
    }
    this.body.place(this.body.z, this.placed);
    const rows = this.body.meanRows([unit]);
    this.pins.set(unit, { rows, to: times(rows, this.body.z, 3), place: this.placed.slice(24 * unit, 24 * unit + 24) });
  }

  // ---- Controls ------------------------------------------------------------------------------------------------------

  listen() {
    const { controls } = this, keys = {
      " ": () => this.play(!this.playing), ".": () => { this.play(false); this.part = 1; this.advance(); },
      r: () => this.reset(), u: () => this.pins.clear(), f: () => this.next(controls.hand), s: () => this.next(controls.speed),
      g: () => this.slide("gravity", Number(controls.gravity.value) ? 0 : 1), w: () => this.slide("wind", Number(controls.wind.value) ? 0 : 1),
    };
    const changed = (act) => { act(); this.stale = true; };
    steer(this.canvas, this.orbit, changed, (event) => this.claim(event));
    controls.play.onclick = keys[" "]; controls.reset.onclick = controls.start.onchange = keys.r; controls.unpin.onclick = () => changed(keys.u);
    controls.home.onclick = () => changed(() => this.orbit.reset());
    for (const name of ["stiffness", "damping", "gravity", "wind"]) {
      controls[name].oninput = () => this.slide(name, controls[name].value);
      this.slide(name, 0);
    }
    window.onkeydown = (event) => {
      const act = keys[event.key.toLowerCase()], typing = ["SELECT", "INPUT", "BUTTON", "SUMMARY"].includes(event.target.tagName);
      if (!act || event.ctrlKey || event.metaKey || (event.key === " " && typing)) return;
      event.preventDefault();
      changed(act);
    };
    document.onvisibilitychange = () => { if (!document.hidden) this.wake(); };
  }

  next(select) {
    select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  }

  slide(name, value) {
    const { controls } = this, factor = name === "stiffness" || name === "damping";
    controls[name].value = value;
    controls[name].nextElementSibling.textContent = factor ? `${Number((2 ** value).toPrecision(2))} ×` : `${value} g`;
    if (factor) this.body.adjust(2 ** controls.stiffness.value, 2 ** controls.damping.value);
    // The wind blows from the left of the picture at the time that it is set.
    if (name === "wind") this.windward = unit(cross(this.orbit.camera(1, 1).view.slice(8, 11), this.up));
    this.stale = true;
  }
}

window.page = reported(() => new Page(JSON.parse(content("settings"))));
