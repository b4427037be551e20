// Small dense matrices, row by row in Float64Array: factors, solutions, inverses.

// out = A x for a matrix of `rows` rows. Four sums at once: one alone would wait for each of its additions.
function times(a, x, rows, out = new Float64Array(rows)) {
  const columns = x.length, whole = columns - (columns % 4);
  for (let i = 0, at = 0; i < rows; i++) {
    let s0 = 0, s1 = 0, s2 = 0, s3 = 0, j = 0;
    for (; j < whole; j += 4, at += 4) {
      s0 += a[at] * x[j]; s1 += a[at + 1] * x[j + 1]; s2 += a[at + 2] * x[j + 2]; s3 += a[at + 3] * x[j + 3];
    }
    for (; j < columns; j++) s0 += a[at++] * x[j];
    out[i] = s0 + s1 + s2 + s3;
  }
  return out;
}

// out = A^T x for a matrix with as many rows as x has entries, a multiple of three.
function timesTransposed(a, x, columns, out = new Float64Array(columns)) {
  out.fill(0);
  for (let i = 0; i < x.length; i += 3) {
    const u = x[i], v = x[i + 1], w = x[i + 2];
    let at = i * columns, second = at + columns, third = second + columns;
    for (let j = 0; j < columns; j++) out[j] += u * a[at++] + v * a[second++] + w * a[third++];
  }
  return out;
}

// out (M, M) += A^T B of three rows of both, which begin at `from` and `start`.
function addProduct(out, a, from, b, m, start = 0) {
  for (let i = 0, at = 0; i < m; i++) {
    const u = a[from + i], v = a[from + m + i], w = a[from + 2 * m + i];
    let first = start, second = start + m, third = start + 2 * m;
    for (let j = 0; j < m; j++) out[at++] += u * b[first++] + v * b[second++] + w * b[third++];
  }
}

// The factors of a square matrix, with partial pivoting, by which `solve` divides.
function factorised(matrix, size) {
  const a = Float64Array.from(matrix), order = Int32Array.from({ length: size }, (_, i) => i);
  for (let k = 0; k < size; k++) {
    let best = k;
    for (let i = k + 1; i < size; i++) if (Math.abs(a[i * size + k]) > Math.abs(a[best * size + k])) best = i;
    if (best !== k) {
      for (let j = 0; j < size; j++) {
        const kept = a[k * size + j];
        a[k * size + j] = a[best * size + j]; a[best * size + j] = kept;
      }
      const kept = order[k];
      order[k] = order[best]; order[best] = kept;
    }
    const pivot = a[k * size + k];
    for (let i = k + 1; i < size; i++) {
      const factor = (a[i * size + k] /= pivot);
      if (factor === 0) continue;
      for (let j = k + 1, at = i * size + k + 1, from = k * size + k + 1; j < size; j++) a[at++] -= factor * a[from++];
    }
  }
  return { a, order, size };
}

function solve({ a, order, size }, b) {
  const x = new Float64Array(size);
  for (let i = 0; i < size; i++) {
    let sum = b[order[i]];
    for (let j = 0, at = i * size; j < i; j++) sum -= a[at++] * x[j];
    x[i] = sum;
  }
  for (let i = size - 1; i >= 0; i--) {
    let sum = x[i];
    for (let j = i + 1; j < size; j++) sum -= a[i * size + j] * x[j];
    x[i] = sum / a[i * size + i];
  }
  return x;
}

function inverse(matrix, size) {
  const factors = factorised(matrix, size), out = new Float64Array(size * size), one = new Float64Array(size);
  for (let j = 0; j < size; j++) {
    one.fill(0); one[j] = 1;
    const column = solve(factors, one);
    for (let i = 0; i < size; i++) out[i * size + j] = column[i];
  }
  return out;
}

// x^T A x.
const quadraticForm = (a, x) => dotOf(x, times(a, x, x.length));

function dotOf(x, y) {
  let sum = 0;
  for (let i = 0; i < x.length; i++) sum += x[i] * y[i];
  return sum;
}

// p a + q b
function weighted(a, p, b, q) {
  const out = new Float64Array(a.length);
  for (let i = 0; i < a.length; i++) out[i] = p * a[i] + q * b[i];
  return out;
}

// a + scale * b
const mixed = (a, b, scale) => weighted(a, 1, b, scale);
