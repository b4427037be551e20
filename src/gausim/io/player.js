// Plays a motion of Gaussians that is stored frame by frame (splats.js draws them).

// ---- The file -------------------------------------------------------------------------------------------------------

function readMotion(facts) {
  const { unit_of_kernel: unitOf, quats: rotations, centres: restCentres, ...arrays } =
    readArrays(content("content"), facts.arrays);
  return { ...facts, ...arrays, unitOf, rotations, restCentres };
}

// ---- The motion -----------------------------------------------------------------------------------------------------

// Centre, G and Q of every unit at a time between two frames, 24 floats: rows of G with the centre beside, rows of Q.
function unitsAt(motion, time, out) {
  const { units, frames, diagonal, moved, origins, restCentres } = motion;
  const first = Math.min(Math.floor(time), frames - 1), second = Math.min(first + 1, frames - 1), part = time - first;
  const a = first * units * 12, b = second * units * 12, now = new Float64Array(12);
  for (let u = 0; u < units; u++) {
    for (let i = 0; i < 12; i++) {
      now[i] = (1 - part) * moved[a + 12 * u + i] + part * moved[b + 12 * u + i];
    }
    for (let i = 0; i < 3; i++) {
      const origin = (1 - part) * origins[3 * first + i] + part * origins[3 * second + i];
      for (let j = 0; j < 3; j++) out[24 * u + 4 * i + j] = now[3 + 3 * i + j] + (i === j ? 1 : 0);
      out[24 * u + 4 * i + 3] = restCentres[3 * u + i] + origin + diagonal * now[i];
    }
    rotationOf(out, 24 * u);
  }
  return out;
}

// ---- The page -------------------------------------------------------------------------------------------------------

class Player {
  constructor(motion, settings) {
    const lists = restLists(motion), find = (id) => document.getElementById(id);
    this.canvas = document.querySelector("canvas");
    Object.assign(this, { motion, orbit: new Orbit(settings.camera), order: new Order(motion, lists[0]), drawn: 0 });
    this.painter = new Painter(this.canvas, motion, lists, settings.background);
    this.units = new Float32Array(24 * motion.units);
    Object.assign(this, { time: 0, playing: true, stale: true });
    Object.assign(this, { bar: find("time"), clock: find("clock"), button: find("play") });
    this.bar.max = motion.frames - 1;
    this.speed = find("speed"); this.loop = find("loop");
    this.listen(find("home"));
    this.last = performance.now();
    requestAnimationFrame((now) => this.tick(now));
  }

  play(on) { this.playing = on; this.button.textContent = on ? "Pause" : "Play"; }

  // Stands still at a time [frames].
  show(time) { this.play(false); this.seek(time); this.draw(); }

  seek(time) { this.time = Math.max(0, Math.min(this.motion.frames - 1, time)); this.stale = true; }

  tick(now) {
    const seconds = Math.min((now - this.last) / 1000, 0.5), end = this.motion.frames - 1;
    this.last = now;
    if (this.playing && end > 0) {
      const next = this.time + seconds * this.motion.fps * Number(this.speed.value);
      if (next > end && !this.loop.checked) this.play(false);
      this.seek(next <= end ? next : this.loop.checked ? 0 : end);
    }
    if (this.stale || this.resized()) this.draw();
    requestAnimationFrame((later) => this.tick(later));
  }

  resized() {
    const scale = window.devicePixelRatio || 1;
    const width = Math.round(this.canvas.clientWidth * scale), height = Math.round(this.canvas.clientHeight * scale);
    if (width === this.canvas.width && height === this.canvas.height) return false;
    Object.assign(this.canvas, { width, height });
    return true;
  }

  draw() {
    this.resized();
    const camera = this.orbit.camera(this.canvas.width, this.canvas.height), { fps, frames } = this.motion;
    unitsAt(this.motion, this.time, this.units);
    this.painter.draw(this.units, this.order.sort(this.units, camera.view), camera);
    this.bar.value = this.time;
    const number = Math.floor(this.time + 1e-6);
    this.clock.textContent = `${(this.time / fps).toFixed(2)} s · frame ${number} / ${frames - 1}`;
    this.stale = false;
    this.drawn++;
  }

  listen(home) {
    const changed = (act) => { act(); this.stale = true; };
    this.button.onclick = () => this.play(!this.playing);
    this.bar.oninput = () => { this.play(false); this.seek(Number(this.bar.value)); };
    home.onclick = () => changed(() => this.orbit.reset());
    steer(this.canvas, this.orbit, changed);
    window.onkeydown = (event) => {
      if (event.target !== document.body) return;
      if (event.key === " ") this.play(!this.playing);
      else if (event.key === "ArrowRight" || event.key === "ArrowLeft") {
        this.play(false);
        this.seek(Math.round(this.time) + (event.key === "ArrowRight" ? 1 : -1));
      } else return;
      event.preventDefault();
    };
  }
}

window.player = reported(() => {
  const settings = JSON.parse(content("settings"));
  return new Player(readMotion(settings), settings);
});
