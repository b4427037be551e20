// What a body's forces are beyond those of small displacements, as gausim/models/template has it. A law gives
//   state(z)                      the body in a state of the modes
//   between(first, second)        the mean force from one state to another
//   stiffening(first, second)     twice its negative derivative with respect to the second state, (M, M) row by row
//   potential(state)              the potential energy
// `scale` is on its stiffness, `growth` the resistance to the growth of strain or length [frames].

// Units of which the stiffening of a solid is computed; more are merged, as corrections need not divide by the exact one.
const COARSE = 128;

// Points (N, 3) in groups of neighbours: the largest is split at the median of its longest side.
function split(points, count, most) {
  const groups = [Array.from({ length: count }, (_, n) => n)];
  while (groups.length < most) {
    const group = groups.sort((a, b) => a.length - b.length).pop();
    const sides = [0, 1, 2].map((c) => Math.max(...group.map((n) => points[3 * n + c])) - Math.min(...group.map((n) => points[3 * n + c])));
    const axis = sides.indexOf(Math.max(...sides)), half = group.length >> 1;
    group.sort((a, b) => points[3 * a + axis] - points[3 * b + axis]);
    groups.push(group.slice(0, half), group.slice(half));
  }
  return groups;
}

// Green's strain of the cells near the units with Hooke's law (gausim/models/template/finite_strain.py).
class Solid {
  constructor({ cells, moduli, centres }, { modes }) {
    Object.assign(this, { cells, moduli, modes, scale: 1, growth: 0, units: moduli.length / 2 });
    Object.assign(this, { stress: new Float64Array(9 * this.units), turned: new Float64Array(9 * modes) });
    this.coarse = this.units > COARSE ? this.merged(split(centres, this.units, COARSE)) : this;
  }

  // The body with groups of units in place of units: their mean gradients, weighted by their moduli.
  merged(groups) {
    const size = 9 * this.modes, cells = new Float32Array(groups.length * size), moduli = new Float32Array(2 * groups.length);
    groups.forEach((group, at) => {
      for (const n of group) for (let c = 0; c < 2; c++) moduli[2 * at + c] += this.moduli[2 * n + c];
      for (const n of group) {
        const share = this.moduli[2 * n] / moduli[2 * at];
        for (let c = 0; c < size; c++) cells[at * size + c] += share * this.cells[n * size + c];
      }
    });
    return new Solid({ cells, moduli }, this);
  }

  // Displacement gradients h (N, 9), row by row, and strains e (N, 6): xx, yy, zz, yz, xz, xy.
  state(z) {
    const h = times(this.cells, z, 9 * this.units), e = new Float64Array(6 * this.units);
    for (let n = 0, o = 0, at = 0; n < this.units; n++, o += 9, at += 6) {
      const a = h[o], b = h[o + 1], c = h[o + 2], d = h[o + 3], f = h[o + 4], g = h[o + 5], p = h[o + 6], q = h[o + 7], r = h[o + 8];
      e[at] = a + (a * a + d * d + p * p) / 2;
      e[at + 1] = f + (b * b + f * f + q * q) / 2;
      e[at + 2] = r + (c * c + g * g + r * r) / 2;
      e[at + 3] = (g + q + b * c + f * g + q * r) / 2;
      e[at + 4] = (c + p + a * c + d * g + p * r) / 2;
      e[at + 5] = (b + d + a * b + d * f + p * q) / 2;
    }
    return { z, h, e };
  }

  // The mean stress of unit n with resistance to growth, six numbers as strains have.
  meanStress(first, second, n, out) {
    const shear = this.scale * this.moduli[2 * n], bulk = this.scale * this.moduli[2 * n + 1];
    const p = 0.5 - this.growth, q = 0.5 + this.growth, one = first.e, two = second.e;
    for (let c = 0, at = 6 * n; c < 6; c++, at++) out[c] = p * one[at] + q * two[at];
    const pressure = bulk * (out[0] + out[1] + out[2]);
    for (let c = 0; c < 6; c++) out[c] = shear * out[c] + (c < 3 ? pressure : 0);
  }

  between(first, second) {
    const { units, moduli, stress, scale } = this, s = new Float64Array(6);
    for (let n = 0, o = 0; n < units; n++, o += 9) {
      this.meanStress(first, second, n, s);
      const shear = scale * moduli[2 * n], bulk = scale * moduli[2 * n + 1], x = s[0], y = s[1], z = s[2], u = s[3], v = s[4], w = s[5];
      const at = (c) => (first.h[o + c] + second.h[o + c]) / 2;
      const a = at(0), b = at(1), c = at(2), d = at(3), f = at(4), g = at(5), p = at(6), q = at(7), r = at(8);
      const pressure = bulk * (a + f + r), yz = shear * (g + q) / 2, xz = shear * (c + p) / 2, xy = shear * (b + d) / 2;
      stress[o] = -(x + a * x + b * w + c * v - shear * a - pressure);
      stress[o + 1] = -(w + a * w + b * y + c * u - xy);
      stress[o + 2] = -(v + a * v + b * u + c * z - xz);
      stress[o + 3] = -(w + d * x + f * w + g * v - xy);
      stress[o + 4] = -(y + d * w + f * y + g * u - shear * f - pressure);
      stress[o + 5] = -(u + d * v + f * u + g * z - yz);
      stress[o + 6] = -(v + p * x + q * w + r * v - xz);
      stress[o + 7] = -(u + p * w + q * y + r * u - yz);
      stress[o + 8] = -(z + p * v + q * u + r * z - shear * r - pressure);
    }
    return timesTransposed(this.cells, stress, this.modes);
  }

  // sum_n H_n^T (H S + (1 + 2 growth) F sigma(sym(F_2^T H)) - sigma(sym H)), F and S the means; an isotropic tension makes
  // S of compressed cells positive (Gershgorin), as there.
  stiffening(first, second) {
    if (this.coarse !== this) {
      Object.assign(this.coarse, { scale: this.scale, growth: this.growth });
      return this.coarse.stiffening(this.coarse.state(first.z), this.coarse.state(second.z));
    }
    const { units, modes: m, cells, moduli, scale, turned } = this, out = new Float64Array(m * m), s = new Float64Array(6);
    const mean = new Float64Array(9), last = new Float64Array(9), grown = 1 + 2 * this.growth;
    for (let n = 0, o = 0; n < units; n++, o += 9) {
      this.meanStress(first, second, n, s);
      const yz = Math.abs(s[3]), xz = Math.abs(s[4]), xy = Math.abs(s[5]);
      const tension = Math.max(0, xy + xz - s[0], xy + yz - s[1], xz + yz - s[2]);
      const x = s[0] + tension, y = s[1] + tension, z = s[2] + tension, u = s[3], v = s[4], w = s[5];
      for (let c = 0; c < 9; c++) {
        const one = c % 4 === 0 ? 1 : 0;
        mean[c] = one + (first.h[o + c] + second.h[o + c]) / 2; last[c] = one + second.h[o + c];
      }
      const shear = scale * moduli[2 * n], bulk = scale * moduli[2 * n + 1], from = o * m;
      for (let k = 0; k < m; k++) {
        const h = (c) => cells[from + c * m + k];
        const a = h(0), b = h(1), c = h(2), d = h(3), f = h(4), g = h(5), p = h(6), q = h(7), r = h(8), l = last;
        // Stress of the strain sym(F_2^T H), and that of sym H.
        const sheared = grown * shear, half = sheared / 2;
        const xx = l[0] * a + l[3] * d + l[6] * p, yy = l[1] * b + l[4] * f + l[7] * q, zz = l[2] * c + l[5] * g + l[8] * r;
        const pressure = grown * bulk * (xx + yy + zz), small = bulk * (a + f + r);
        const tx = sheared * xx + pressure, ty = sheared * yy + pressure, tz = sheared * zz + pressure;
        const tu = half * (l[1] * c + l[4] * g + l[7] * r + l[2] * b + l[5] * f + l[8] * q);
        const tv = half * (l[0] * c + l[3] * g + l[6] * r + l[2] * a + l[5] * d + l[8] * p);
        const tw = half * (l[0] * b + l[3] * f + l[6] * q + l[1] * a + l[4] * d + l[7] * p);
        const su = shear * (g + q) / 2, sv = shear * (c + p) / 2, sw = shear * (b + d) / 2;
        turned[k] = a * x + b * w + c * v + mean[0] * tx + mean[1] * tw + mean[2] * tv - shear * a - small;
        turned[m + k] = a * w + b * y + c * u + mean[0] * tw + mean[1] * ty + mean[2] * tu - sw;
        turned[2 * m + k] = a * v + b * u + c * z + mean[0] * tv + mean[1] * tu + mean[2] * tz - sv;
        turned[3 * m + k] = d * x + f * w + g * v + mean[3] * tx + mean[4] * tw + mean[5] * tv - sw;
        turned[4 * m + k] = d * w + f * y + g * u + mean[3] * tw + mean[4] * ty + mean[5] * tu - shear * f - small;
        turned[5 * m + k] = d * v + f * u + g * z + mean[3] * tv + mean[4] * tu + mean[5] * tz - su;
        turned[6 * m + k] = p * x + q * w + r * v + mean[6] * tx + mean[7] * tw + mean[8] * tv - sv;
        turned[7 * m + k] = p * w + q * y + r * u + mean[6] * tw + mean[7] * ty + mean[8] * tu - su;
        turned[8 * m + k] = p * v + q * u + r * z + mean[6] * tv + mean[7] * tu + mean[8] * tz - shear * r - small;
      }
      addProduct(out, cells, from, turned, m);
      addProduct(out, cells, from + 3 * m, turned, m, 3 * m);
      addProduct(out, cells, from + 6 * m, turned, m, 6 * m);
    }
    return out;
  }

  potential({ h, e }) {
    let sum = 0;
    for (let n = 0, o = 0, at = 0; n < this.units; n++, o += 9, at += 6) {
      const shear = this.moduli[2 * n], bulk = this.moduli[2 * n + 1];
      const whole = shear * squareOf(e[at], e[at + 1], e[at + 2], e[at + 3], e[at + 4], e[at + 5]);
      const small = shear * squareOf(h[o], h[o + 4], h[o + 8], (h[o + 5] + h[o + 7]) / 2, (h[o + 2] + h[o + 6]) / 2, (h[o + 1] + h[o + 3]) / 2);
      sum += whole - small + bulk * ((e[at] + e[at + 1] + e[at + 2]) ** 2 - (h[o] + h[o + 4] + h[o + 8]) ** 2);
    }
    return this.scale * sum / 2;
  }
}

// E : E of a symmetric matrix.
const squareOf = (x, y, z, yz, xz, xy) => x * x + y * y + z * z + 2 * (yz * yz + xz * xz + xy * xy);

// Springs between units (gausim/models/template/springs.py).
class Springs {
  constructor({ ends, offset, spring, modes: basis }, { modes, units }) {
    Object.assign(this, { ends, offset, spring, basis, modes, units, scale: 1, growth: 0, count: spring.length });
    this.length = Float64Array.from(spring, (_, e) => Math.hypot(...offset.subarray(3 * e, 3 * e + 3)));
  }

  state(z) {
    const { count, ends, offset, length } = this, moved = times(this.basis, z, 3 * this.units);
    const state = { z, change: new Float64Array(3 * count) };
    for (const name of ["length", "stretch", "along"]) state[name] = new Float64Array(count);
    for (let e = 0; e < count; e++) {
      let along = 0, square = 0;
      for (let c = 0; c < 3; c++) {
        const change = moved[3 * ends[2 * e + 1] + c] - moved[3 * ends[2 * e] + c];
        state.change[3 * e + c] = change; along += offset[3 * e + c] * change; square += change * change;
      }
      const rest = length[e], grown = 2 * along + square;
      state.along[e] = along;
      state.length[e] = Math.sqrt(Math.max(rest * rest + grown, 1e-6 * rest * rest));
      state.stretch[e] = grown / (state.length[e] + rest);
    }
    return state;
  }

  // Tension over stiffness.
  tension(first, second, e) {
    return (first.stretch[e] + second.stretch[e]) / 2 + this.growth * (second.stretch[e] - first.stretch[e]);
  }

  between(first, second) {
    const { count, ends, offset, length } = this, nodes = new Float64Array(3 * this.units);
    for (let e = 0; e < count; e++) {
      const along = (first.along[e] + second.along[e]) / 2, k = this.scale * this.spring[e];
      const shrink = 2 * this.tension(first, second, e) / (first.length[e] + second.length[e]);
      for (let c = 0; c < 3; c++) {
        const change = (first.change[3 * e + c] + second.change[3 * e + c]) / 2;
        const force = k * (shrink * change + (shrink - along / length[e] ** 2) * offset[3 * e + c]);
        nodes[3 * ends[2 * e] + c] += force; nodes[3 * ends[2 * e + 1] + c] -= force;
      }
    }
    return timesTransposed(this.basis, nodes, this.modes);
  }

  stiffening(first, second) {
    const { count, ends, offset, length, basis, modes: m } = this, nodes = new Float64Array(3 * this.units * m);
    const block = new Float64Array(9), pull = new Float64Array(3), unit = new Float64Array(3);
    for (let e = 0; e < count; e++) {
      const k = this.scale * this.spring[e], mean = (first.length[e] + second.length[e]) / 2;
      const t = this.tension(first, second, e) / mean, grown = k * (1 + 2 * this.growth - t) / mean;
      for (let c = 0; c < 3; c++) {
        pull[c] = grown * ((first.change[3 * e + c] + second.change[3 * e + c]) / 2 + offset[3 * e + c]);
        unit[c] = (second.change[3 * e + c] + offset[3 * e + c]) / second.length[e];
      }
      for (let c = 0; c < 9; c++) {
        const i = Math.floor(c / 3), j = c % 3;
        block[c] = pull[i] * unit[j] - k * offset[3 * e + i] * offset[3 * e + j] / length[e] ** 2;
        if (i === j) block[c] += k * Math.max(t, 0);
      }
      const from = 3 * ends[2 * e] * m, to = 3 * ends[2 * e + 1] * m;
      for (let k = 0; k < m; k++) {
        const x = basis[to + k] - basis[from + k], y = basis[to + m + k] - basis[from + m + k];
        const z = basis[to + 2 * m + k] - basis[from + 2 * m + k];
        for (let c = 0, at = k; c < 9; c += 3, at += m) {
          const value = block[c] * x + block[c + 1] * y + block[c + 2] * z;
          nodes[to + at] += value; nodes[from + at] -= value;
        }
      }
    }
    const out = new Float64Array(m * m);
    for (let row = 0, at = 0; row < 3 * this.units; row++, at += m) for (let i = 0; i < m; i++) {
      const value = basis[at + i];
      if (value !== 0) for (let j = 0; j < m; j++) out[i * m + j] += value * nodes[at + j];
    }
    return out;
  }

  potential(state) {
    let sum = 0;
    for (let e = 0; e < this.count; e++) {
      sum += this.spring[e] * (state.stretch[e] ** 2 - (state.along[e] / this.length[e]) ** 2);
    }
    return this.scale * sum / 2;
  }
}
