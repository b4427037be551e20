// A learned body: modal coordinates z of two frames, their step, and the units that follow from them.

// Fractions of a force that are tried in turn, until the energy stays below its ceiling.
const PARTS = [1, 0.5, 0.25, 0.125, 0.0625, 0];
const BISECTIONS = 10;
// Corrections of a step: the most, the last one's size over the motion, how much smaller than the one before each is.
const CORRECTIONS = 12, ACCURACY = 1e-4, SLOW = 0.5;
const MIN_DETERMINANT = 0.2; // units that are flatter than this are drawn undeformed
const LEAST_LEFT = 0.1; // least part of an impulse that damping leaves in its first frame

class Body {
  constructor(arrays, facts) {
    const { modes, units, diagonal } = facts;
    Object.assign(this, { arrays, facts, modes, units });
    this.law = "cells" in arrays ? new Solid(arrays, facts) : new Springs(arrays, facts);
    this.gradients = arrays.gradients.map((value) => value / diagonal);
    this.unitOf = arrays.unit_of_kernel;
    this.rest();
    this.adjust(1, 1);
  }

  rest() { this.z = new Float64Array(this.modes); this.before = new Float64Array(this.modes); this.limited = this.weaker = 0; }

  // Begins at rest with the velocity of a recorded sequence.
  begin(start) { this.rest(); this.before = Float64Array.from(start.before); }

  // Multiplies stiffness and damping, as they were learned.
  adjust(stiffness, damping) {
    const { mass, stiffness: given, drag } = this.arrays, { viscosity, rate, fastest, growth, ceiling } = this.facts;
    const m = this.modes;
    Object.assign(this.law, { scale: stiffness, growth: growth * damping });
    this.ceiling = ceiling * stiffness; // the same motion
    this.stiffness = Float64Array.from(given, (value) => stiffness * value);
    this.inertia = Float64Array.from(mass);
    this.damping = Float64Array.from(drag, (value, i) => damping * (value + viscosity * this.stiffness[i]));
    for (let i = 0; fastest && i < m * m; i += m + 1) { // modes too fast for frames are slowed
      const slowed = Math.max(0, this.stiffness[i] / fastest ** 2 - mass[i]);
      this.inertia[i] += slowed; this.damping[i] += damping * rate * slowed;
    }
    const whole = mixed(this.inertia, this.stiffness, 1 / 4);
    this.linear = mixed(whole, this.damping, 1 / 2);
    this.factors = null;
    // An impulse begins with as much velocity as its frame reaches (overshoot in gausim/models/template/modal.py).
    const slow = inverse(this.stiffness, m), lost = dotOf(slow, this.damping) / (2 * dotOf(slow, whole));
    const reach = inverse(whole, m), left = Math.max(LEAST_LEFT, 1 - lost);
    this.pushed = (change) => times(reach, times(mass, change, m), m).map((value) => value / left);
    this.compliance = slow;
  }

  // Change of z by an acceleration [scene units / frame^2] of some units, each with a weight.
  push(units, acceleration) {
    const out = new Float64Array(this.modes), { modes, weights } = this.arrays, m = this.modes;
    for (const n of units) for (let c = 0; c < 3; c++) {
      const value = weights[n] * acceleration[c];
      for (let i = 0; i < m; i++) out[i] += value * modes[(3 * n + c) * m + i];
    }
    return out;
  }

  // The same for all units, and for the wind.
  pushAll(acceleration) { return this.push(Array.from({ length: this.units }, (_, n) => n), acceleration); }
  blow(acceleration) { return timesTransposed(this.arrays.wind, acceleration, this.modes); }

  // Rows (3, M) of the mean displacement of some units.
  meanRows(units) {
    const m = this.modes, out = new Float64Array(3 * m);
    for (const n of units) for (let i = 0; i < 3 * m; i++) out[i] += this.arrays.modes[3 * n * m + i] / units.length;
    return out;
  }

  // z at t + 1: a step of the trapezoidal rule, as in gausim/models/template/modal.py. Its corrections divide by factors of
  // an earlier step, which are computed anew where corrections do not become smaller fast. `held` are displacements to
  // be reached exactly, { rows (R, M), to (R,) }; they act by forces like those of hands.
  after(z, before, held) {
    const { law, modes: m } = this, speed = mixed(z, before, -1), onward = mixed(z, speed, 1);
    const force = mixed(times(this.stiffness, z, m), times(this.damping, speed, m), 1).map((value) => -value);
    const first = law.state(weighted(z, 0.5, before, 0.5));
    let bend = new Float64Array(m), size = Infinity, grip = held && this.factors && this.grip(held);
    for (let correction = 0; correction < CORRECTIONS; correction++) {
      const second = law.state(mixed(z, mixed(speed, bend, 1), 0.5));
      if (!this.factors) {
        this.factors = factorised(mixed(this.linear, law.stiffening(first, second), 1 / 4), m);
        grip = held && this.grip(held);
      }
      const missing = mixed(mixed(force, law.between(first, second), 1), times(this.linear, bend, m), -1);
      const next = mixed(bend, solve(this.factors, missing), 1);
      const change = mixed(grip ? grip(next, onward) : next, bend, -1);
      bend = mixed(bend, change, 1);
      const now = Math.sqrt(dotOf(change, change)), whole = Math.sqrt(dotOf(speed, speed) + dotOf(bend, bend));
      if (now <= ACCURACY * whole) break;
      if (!(now <= SLOW * size)) this.factors = null;
      if (!Number.isFinite(now)) break;
      size = now;
    }
    return mixed(onward, bend, 1);
  }

  // Moves `bend` to where what is held is held, by forces on it.
  grip({ rows, to }) {
    const { factors, modes: m } = this, count = to.length, answers = [], gram = new Float64Array(count * count);
    for (let r = 0; r < count; r++) answers.push(solve(factors, rows.subarray(r * m, (r + 1) * m)));
    for (let r = 0; r < count; r++) for (let s = 0; s < count; s++) {
      gram[r * count + s] = dotOf(rows.subarray(r * m, (r + 1) * m), answers[s]);
    }
    const most = gram.reduce((sum, value) => Math.max(sum, Math.abs(value)), 0);
    for (let r = 0; r < count; r++) gram[r * (count + 1)] += 1e-9 * most;
    const inner = factorised(gram, count);
    return (bend, onward) => {
      const missing = mixed(to, times(rows, mixed(onward, bend, 1), count), -1), forces = solve(inner, missing);
      return answers.reduce((sum, answer, r) => mixed(sum, answer, forces[r]), bend);
    };
  }

  // v^T M v / 2 + m^T K m / 2 + the nonlinear part, of the middle m of two frames.
  energy(z, before) {
    const middle = mixed(z, before, 1).map((value) => value / 2);
    const kinetic = quadraticForm(this.inertia, mixed(z, before, -1));
    return (kinetic + quadraticForm(this.stiffness, middle)) / 2 + this.law.potential(this.law.state(middle));
  }

  // Whether a step to z is below the ceiling: in motion, and below twice the ceiling at rest at its end, where fast modes
  // have more potential energy than in the middle. `standing` is the energy of standing still; what is above is allowed.
  isBelow(z, standing = 0) {
    const { ceiling } = this;
    return this.energy(z, this.z) <= Math.max(ceiling, standing) && this.energy(z, z) <= Math.max(2 * ceiling, standing);
  }

  // One frame under a change of z per frame (push) and with displacements that are held. Where they would let the energy
  // exceed the ceiling, the force, or the way of what is held, is reduced; at last the step is cut short
  // (energy_guard.py). The fractions begin one above that of the last frame.
  step(push = null, held = null) {
    const tried = (part) => {
      const from = push && part ? mixed(this.before, this.pushed(push), -part) : this.before;
      return this.after(this.z, from, held && { rows: held.rows, to: mixed(held.from, mixed(held.to, held.from, -1), part) });
    };
    const last = push || held ? PARTS.length - 1 : 0;
    let weaker = Math.min(last, Math.max(0, this.weaker - 1)), z = tried(PARTS[weaker]);
    let below = this.isBelow(z);
    while (!below && weaker < last) below = this.isBelow((z = tried(PARTS[++weaker])));
    if (!below) z = this.cutShort(z);
    if (!below || weaker) this.limited++;
    Object.assign(this, { before: this.z, z, weaker });
  }

  // The longest fraction of a step below the ceiling, by bisection.
  cutShort(z) {
    const standing = this.energy(this.z, this.z), way = mixed(z, this.z, -1);
    let low = 0, high = 1;
    for (let i = 0; i < BISECTIONS; i++) {
      const part = (low + high) / 2;
      if (this.isBelow(mixed(this.z, way, part), standing)) low = part; else high = part;
    }
    return mixed(this.z, way, low);
  }

  displacement(n, z = this.z) {
    return times(this.arrays.modes.subarray(3 * n * this.modes, 3 * (n + 1) * this.modes), z, 3);
  }

  // Rows of G with the centre beside, and rows of Q, 24 floats of every unit; the last unit never moves.
  place(z, out = new Float32Array(24 * (this.units + 1))) {
    const { units, arrays, facts } = this, moved = times(arrays.modes, z, 3 * units);
    const slopes = times(this.gradients, z, 9 * units), g = new Float64Array(9);
    for (let n = 0; n <= units; n++) {
      const at = 24 * n;
      for (let c = 0; c < 9; c++) g[c] = (n < units ? slopes[9 * n + c] : 0) + (c % 4 === 0 ? 1 : 0);
      const det = g[0] * (g[4] * g[8] - g[5] * g[7]) + g[1] * (g[5] * g[6] - g[3] * g[8]) + g[2] * (g[3] * g[7] - g[4] * g[6]);
      const flat = det < MIN_DETERMINANT, scale = facts.conserve_volume && !flat ? 1 / Math.cbrt(det) : 1;
      for (let c = 0; c < 9; c++) out[at + 4 * Math.floor(c / 3) + (c % 3)] = flat ? (c % 4 === 0 ? 1 : 0) : scale * g[c];
      for (let c = 0; c < 3; c++) out[at + 4 * c + 3] = n < units ? arrays.centres[3 * n + c] + moved[3 * n + c] : 0;
      rotationOf(out, at);
    }
    return out;
  }
}
