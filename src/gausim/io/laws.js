// What a body's forces are beyond those of small displacements, as gausim/models/template has it. A law gives
//   state(z)                      the body in a state of the modes
//   between(first, second)        the mean force from one state to another
//   stiffening(first, second)     twice its negative derivative with respect to the second state, (M, M) row by row
//   potential(state)              the potential energy
// `scale` is on its stiffness, `growth` the resistance to the growth of strain or length [frames].

// Finite strain as a polynomial (gausim/models/template/reduced.py): y = (z, z_i z_j and z_i^2 / 2), energy y^T G y / 2.
class Solid {
  constructor({ linear, mixed: cross, quadratic, pair_scales, cells, moduli }, { modes, diagonal }) {
    const pairs = pair_scales.length;
    Object.assign(this, { linear, cross, modes, pairs, moduli, scale: 1, growth: 0, units: moduli.length / 2 });
    this.table = new Int16Array(pairs * pairs); // G's block of pairs over the products of their scales: half the memory
    this.scales = Float64Array.from(pair_scales);
    for (let i = 0, at = 0; i < pairs; i++) for (let j = 0; j <= i; j++, at++) {
      this.table[i * pairs + j] = this.table[j * pairs + i] = quadratic[at];
    }
    this.cells = cells.map((value) => value / diagonal); // displacement gradients of the modes (N, 9, M)
    this.squares = new Float32Array(this.units * pairs); // of each unit sum_ij H_ij H_ij^T, lower triangles
    for (let n = 0, at = 0; n < this.units; n++) for (let i = 0; i < modes; i++) for (let j = 0; j <= i; j++, at++) {
      let sum = 0;
      for (let c = 9 * n; c < 9 * n + 9; c++) sum += this.cells[c * modes + i] * this.cells[c * modes + j];
      this.squares[at] = sum;
    }
  }

  state(z) {
    const pair = new Float64Array(this.pairs);
    for (let i = 0, at = 0; i < this.modes; i++) {
      for (let j = 0; j < i; j++) pair[at++] = z[i] * z[j];
      pair[at++] = z[i] * z[i] / 2;
    }
    return { z, pair };
  }

  // G's block of pairs times the state's; kept, as several forces ask for it.
  pulled(state) {
    return (state.pulled ??= product(this.scales, times(this.table, product(this.scales, state.pair), this.pairs)));
  }

  // Weights of the first and the second state in the mean strain, resistance to growth included.
  get parts() { return [0.5 - this.growth, 0.5 + this.growth]; }

  // Stress of the mean strain with e_ij, a symmetric matrix as a lower triangle.
  tension(first, second) {
    const [a, b] = this.parts, one = this.pulled(first), two = this.pulled(second);
    const out = timesTransposed(this.cross, weighted(first.z, a, second.z, b), this.pairs);
    for (let p = 0; p < this.pairs; p++) out[p] += a * one[p] + b * two[p];
    return out;
  }

  between(first, second) {
    const { modes, growth } = this, [a, b] = this.parts, tension = this.tension(first, second);
    const out = times(this.cross, weighted(first.pair, a, second.pair, b), modes);
    const middle = weighted(first.z, 0.5, second.z, 0.5);
    const linear = times(this.linear, weighted(first.z, -growth, second.z, growth), modes);
    for (let i = 0, at = 0; i < modes; i++) {
      out[i] += linear[i];
      for (let j = 0; j < i; j++, at++) { out[i] += tension[at] * middle[j]; out[j] += tension[at] * middle[i]; }
      out[i] += tension[at++] * middle[i];
    }
    return out.map((value) => -this.scale * value);
  }

  // T + J(mean z)^T G J(z_2) (1 + 2 growth) - linear, with J = dy/dz and T the stress with e_ij; in compressed cells an
  // isotropic tension makes it positive, as there.
  stiffening(first, second) {
    const { modes: m, pairs, cross, table } = this, out = new Float64Array(m * m), z = second.z;
    const middle = weighted(first.z, 0.5, z, 0.5);
    const row = new Float64Array(m), left = new Float64Array(m * m), known = new Float64Array(pairs);
    const [high, low] = [new Float64Array(pairs), new Float64Array(pairs)]; // derivatives of the scaled pairs by both modes
    for (let i = 0, p = 0; i < m; i++) for (let j = 0; j <= i; j++, p++) {
      high[p] = this.scales[p] * z[j]; low[p] = this.scales[p] * z[i];
    }
    for (let i = 0, p = 0; i < m; i++) for (let j = 0; j <= i; j++, p++) {
      // row = the pair's row of G J(z_2); with the pair's derivatives at the mean it goes to rows i and j.
      for (let k = 0, q = 0, at = p * pairs; k < m; k++) {
        let sum = 0, more = 0, l = 0;
        for (; l + 1 < k; l += 2, q += 2, at += 2) { // two sums at once, as in `times`
          const g = table[at], h = table[at + 1];
          sum += g * high[q]; more += h * high[q + 1];
          row[l] += g * low[q]; row[l + 1] += h * low[q + 1];
        }
        if (l < k) { const g = table[at++]; sum += g * high[q]; row[l] += g * low[q++]; }
        row[k] = sum + more + table[at++] * low[q++];
      }
      const own = this.scales[p];
      for (let k = 0; k < m; k++) row[k] = own * row[k] + cross[k * pairs + p];
      let sum = 0;
      for (let k = 0; k < m; k++) sum += (row[k] - cross[k * pairs + p]) * z[k];
      known[p] = sum / 2; // the pair's row of G times the pairs
      const zi = middle[i], zj = middle[j];
      for (let k = 0; k < m; k++) out[i * m + k] += zj * row[k];
      if (i !== j) for (let k = 0; k < m; k++) out[j * m + k] += zi * row[k];
    }
    second.pulled ??= known;
    for (let i = 0; i < m; i++) { // the modes' own rows of G J(z_2)
      for (let k = 0, p = 0; k < m; k++) {
        let sum = 0;
        for (let l = 0; l < k; l++, p++) { const g = cross[i * pairs + p]; sum += g * z[l]; left[i * m + l] += g * z[k]; }
        left[i * m + k] += sum + cross[i * pairs + p++] * z[k];
      }
    }
    const tension = this.tension(first, second), squares = this.stretched(first, second), grown = 1 + 2 * this.growth;
    for (let i = 0, p = 0; i < m; i++) for (let j = 0; j <= i; j++, p++) {
      const both = tension[p] + squares[p];
      for (const at of i === j ? [i * m + i] : [i * m + j, j * m + i]) {
        out[at] = this.scale * (both + grown * (out[at] + left[at]) + 2 * this.growth * this.linear[at]);
      }
    }
    return out;
  }

  // sum_n t_n of H_n^T H_n, with t_n >= 0 the tension that makes the mean stress of unit n positive (Gershgorin).
  stretched(first, second) {
    const { units, pairs, moduli, squares } = this, out = new Float64Array(pairs), [a, b] = this.parts;
    const one = this.strains(first), two = this.strains(second), s = new Float64Array(6);
    for (let n = 0; n < units; n++) {
      for (let c = 0; c < 6; c++) s[c] = a * one[6 * n + c] + b * two[6 * n + c];
      const pressure = moduli[2 * n + 1] * (s[0] + s[1] + s[2]);
      for (let c = 0; c < 6; c++) s[c] = moduli[2 * n] * s[c] + (c < 3 ? pressure : 0);
      const yz = Math.abs(s[3]), xz = Math.abs(s[4]), xy = Math.abs(s[5]);
      const least = Math.min(s[0] - xy - xz, s[1] - xy - yz, s[2] - xz - yz);
      if (least >= 0) continue;
      for (let p = 0, at = n * pairs; p < pairs; p++) out[p] -= least * squares[at++];
    }
    return out;
  }

  // Green's strain of every unit: xx, yy, zz, yz, xz, xy.
  strains(state) {
    if (state.strains) return state.strains;
    const h = times(this.cells, state.z, 9 * this.units), out = new Float64Array(6 * this.units);
    const at = [[0, 0], [1, 1], [2, 2], [1, 2], [0, 2], [0, 1]];
    for (let n = 0; n < this.units; n++) for (let c = 0; c < 6; c++) {
      const [i, j] = at[c], o = 9 * n;
      const turned = h[o + i] * h[o + j] + h[o + 3 + i] * h[o + 3 + j] + h[o + 6 + i] * h[o + 6 + j];
      out[6 * n + c] = (h[o + 3 * i + j] + h[o + 3 * j + i] + turned) / 2;
    }
    return (state.strains = out);
  }

  potential(state) {
    const once = dotOf(state.z, times(this.cross, state.pair, this.modes));
    return this.scale * (once + dotOf(state.pair, this.pulled(state)) / 2);
  }
}

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
