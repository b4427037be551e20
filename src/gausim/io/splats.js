// Gaussians that follow units, as pictures: x_k = x_c + G_c (X_k - X_c), covariance G S G^T, colours looked up at Q^T d.
// Every frame, a first pass projects each Gaussian once into textures; a second draws them as triangles from back to front.
"use strict";

const SHIFT = 11, WIDTH = 1 << SHIFT; // of all textures that are lists [texels]
const content = (id) => document.getElementById(id).textContent;

const HALF = Float32Array.from({ length: 65536 }, (_, bits) => {
  const exponent = (bits >> 10) & 31, digits = bits & 1023, sign = bits >> 15 ? -1 : 1;
  return sign * (exponent ? 2 ** (exponent - 25) * (1024 + digits) : 2 ** -24 * digits);
});

// ---- The lists -------------------------------------------------------------------------------------------------------

// Typed arrays of the page by name, from the binary content and its index.
function readArrays(base64, index) {
  const bytes = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0)).buffer;
  const kinds = { f4: Float32Array, f2: Uint16Array, u4: Uint32Array, i2: Int16Array, i1: Int8Array };
  const read = ([kind, offset, size]) => {
    const values = new kinds[kind](bytes, offset, size);
    return kind === "f2" ? Float32Array.from(values, (bits) => HALF[bits]) : values;
  };
  return Object.fromEntries(Object.entries(index).map(([name, place]) => [name, read(place)]));
}

// The rotation of the polar decomposition by Newton's iteration R <- (R + R^-T) / 2; the last where G has no inverse.
function rotationOf(m, at) {
  let a = m[at], b = m[at + 1], c = m[at + 2], d = m[at + 4], e = m[at + 5], f = m[at + 6];
  let g = m[at + 8], h = m[at + 9], i = m[at + 10];
  for (let step = 0; step < 8; step++) {
    const [a1, b1, c1] = [e * i - f * h, f * g - d * i, d * h - e * g];
    const det = a * a1 + b * b1 + c * c1;
    if (Math.abs(det) < 1e-12) break;
    const [d1, e1, f1] = [c * h - b * i, a * i - c * g, b * g - a * h];
    const [g1, h1, i1] = [b * f - c * e, c * d - a * f, a * e - b * d];
    const far = Math.abs(a - a1 / det) + Math.abs(e - e1 / det) + Math.abs(i - i1 / det);
    a = (a + a1 / det) / 2; b = (b + b1 / det) / 2; c = (c + c1 / det) / 2;
    d = (d + d1 / det) / 2; e = (e + e1 / det) / 2; f = (f + f1 / det) / 2;
    g = (g + g1 / det) / 2; h = (h + h1 / det) / 2; i = (i + i1 / det) / 2;
    if (far < 1e-7) break;
  }
  m[at + 12] = a; m[at + 13] = b; m[at + 14] = c; m[at + 16] = d; m[at + 17] = e; m[at + 18] = f;
  m[at + 20] = g; m[at + 21] = h; m[at + 22] = i;
}

// Offsets from the centre with the unit, covariances with the opacity, base colours: four floats in each of four lists.
function restLists(motion) {
  const count = motion.unitOf.length, lists = [0, 1, 2, 3].map(() => new Float32Array(4 * count));
  for (let k = 0; k < count; k++) {
    const unit = motion.unitOf[k], [x, y, z, w] = motion.rotations.subarray(4 * k, 4 * k + 4);
    const s = motion.scales.subarray(3 * k, 3 * k + 3);
    const rows = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ].map((row) => row.map((value, j) => value * s[j]));
    const covariance = (i, j) => rows[i].reduce((sum, value, n) => sum + value * rows[j][n], 0);
    for (let i = 0; i < 3; i++) lists[0][4 * k + i] = motion.rest[3 * k + i] - motion.restCentres[3 * unit + i];
    lists[0][4 * k + 3] = unit;
    lists[1].set([covariance(0, 0), covariance(0, 1), covariance(0, 2), motion.opacities[k]], 4 * k);
    lists[2].set([covariance(1, 1), covariance(1, 2), covariance(2, 2), 0], 4 * k);
    lists[3].set(motion.base.subarray(3 * k, 3 * k + 3), 4 * k);
  }
  return lists;
}

// Orders the Gaussians from back to front by counting their depths in 65536 steps.
class Order {
  constructor(motion, offsets) {
    this.motion = motion; this.offsets = offsets;
    this.depths = new Float32Array(motion.unitOf.length);
    this.keys = new Uint16Array(motion.unitOf.length);
    this.indices = new Uint32Array(WIDTH * Math.ceil(motion.unitOf.length / WIDTH)); // whole rows of a texture
    this.rows = new Float32Array(4 * motion.units);
  }
  sort(units, view) {
    const { rows, depths, keys, offsets } = this, count = depths.length, [x, y, z, w] = view.slice(8, 12);
    for (let u = 0; u < this.motion.units; u++) {
      const m = 24 * u;
      for (let j = 0; j < 4; j++) rows[4 * u + j] = x * units[m + j] + y * units[m + 4 + j] + z * units[m + 8 + j];
      rows[4 * u + 3] += w;
    }
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < count; k++) {
      const r = 4 * this.motion.unitOf[k], o = 4 * k;
      const depth = rows[r] * offsets[o] + rows[r + 1] * offsets[o + 1] + rows[r + 2] * offsets[o + 2] + rows[r + 3];
      depths[k] = depth; low = Math.min(low, depth); high = Math.max(high, depth);
    }
    const starts = new Uint32Array(65537), scale = 65535 / Math.max(high - low, 1e-12);
    for (let k = 0; k < count; k++) { keys[k] = (high - depths[k]) * scale; starts[keys[k] + 1]++; }
    for (let i = 0; i < 65536; i++) starts[i + 1] += starts[i];
    for (let k = 0; k < count; k++) this.indices[starts[keys[k]]++] = k;
    return this.indices;
  }
}

// ---- The pictures ---------------------------------------------------------------------------------------------------

class Painter {
  constructor(canvas, motion, lists, background) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl || !gl.getExtension("EXT_color_buffer_float")) {
      throw new Error("This browser cannot draw: WebGL 2 with EXT_color_buffer_float is needed.");
    }
    const count = motion.unitOf.length, rows = (n) => Math.ceil(n / WIDTH), above = motion.sh_scales.length;
    if (rows(count * Math.max(above, 1)) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`${count} Gaussians do not fit into this machine's textures.`);
    }
    Object.assign(this, { gl, canvas, count, rows: rows(count), background });
    this.project = program(gl, "whole", "project");
    this.triangles = program(gl, "triangles", "blend");
    this.lists = lists.map((list) => texture(gl, list, this.rows));
    const higher = padded(motion.sh, above * count);
    this.harmonics = texture(gl, higher, Math.max(rows(above * count), 1), gl.RGBA8_SNORM, gl.BYTE);
    this.units = texture(gl, null, rows(6 * motion.units));
    this.unitRows = rows(6 * motion.units);
    this.made = [0, 1, 2].map(() => texture(gl, null, this.rows));
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    this.made.forEach((made, i) =>
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, made, 0));
    gl.drawBuffers([0, 1, 2].map((i) => gl.COLOR_ATTACHMENT0 + i));
    this.order = texture(gl, null, this.rows, gl.R32UI);
    gl.useProgram(this.project);
    const scales = Float32Array.from({ length: 15 }, (_, i) => 127 * (motion.sh_scales[i] || 0)); // of values in -1..1
    gl.uniform1fv(gl.getUniformLocation(this.project, "scales"), scales);
    gl.uniform1i(gl.getUniformLocation(this.project, "count"), count);
    gl.uniform1i(gl.getUniformLocation(this.project, "coefficients"), above);
  }

  draw(units, indices, camera) {
    const { gl } = this, { width, height } = this.canvas, size = [camera.focal, width, height];
    gl.bindTexture(gl.TEXTURE_2D, this.units);
    const list = new Float32Array(4 * WIDTH * this.unitRows);
    list.set(units);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.unitRows, gl.RGBA, gl.FLOAT, list);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, WIDTH, this.rows);
    gl.disable(gl.BLEND);
    const names = ["offsets", "covariances", "corners", "bases", "harmonics", "units", "order"];
    this.use(this.project, names, [...this.lists, this.harmonics, this.units, this.order], size);
    // Into `order`, which is the texture that was bound last.
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, indices);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.project, "view"), true, camera.view);
    gl.uniform3fv(gl.getUniformLocation(this.project, "eye"), camera.eye);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.use(this.triangles, ["places", "ellipses", "colors"], this.made, size);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.count); // one each: where GL is computed by software, more are slow
  }

  use(made, names, textures, size) {
    const { gl } = this;
    gl.useProgram(made);
    names.forEach((name, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, textures[i]);
      gl.uniform1i(gl.getUniformLocation(made, name), i);
    });
    gl.uniform3fv(gl.getUniformLocation(made, "camera"), size);
  }
}

function texture(gl, list, rows, format = gl.RGBA32F, type = gl.FLOAT) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, WIDTH, rows);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  if (list) {
    const whole = new list.constructor(4 * WIDTH * rows);
    whole.set(list);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RGBA, type, whole);
  }
  return made;
}

function padded(triples, count) {
  const out = new Int8Array(4 * count);
  for (let i = 0; i < count; i++) for (let j = 0; j < 3; j++) out[4 * i + j] = triples[3 * i + j];
  return out;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    const sizes = `#version 300 es\n#define WIDTH ${WIDTH}\n#define SHIFT ${SHIFT}\n`;
    gl.shaderSource(shader, sizes + content("common") + content(text));
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

// ---- The camera -----------------------------------------------------------------------------------------------------

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, scale = 1) => a.map((value, i) => value + scale * b[i]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

// Turns about a target; `up` stays vertical on the screen.
class Orbit {
  constructor(home) { this.home = home; this.reset(); }
  reset() { this.look(this.home); }
  look({ eye, target, up, fov }) {
    Object.assign(this, { target: [...target], up: unit(up), fov });
    const back = plus(eye, target, -1);
    this.distance = Math.hypot(...back);
    this.pitch = Math.asin(Math.max(-1, Math.min(1, dot(back, this.up) / this.distance)));
    const flat = plus(back, this.up, -dot(back, this.up));
    const [x, y, z] = this.up;
    this.front = unit(Math.hypot(...flat) > 1e-9 * this.distance ? flat : cross(this.up, [y, z, -x]));
    this.side = cross(this.up, this.front);
    this.yaw = 0;
  }
  turn(dx, dy) {
    this.yaw -= dx;
    this.pitch = Math.max(-1.55, Math.min(1.55, this.pitch + dy));
  }
  pan(dx, dy, height) {
    const { view } = this.camera(1, height), scale = (2 * this.distance * Math.tan(this.fov / 2)) / height;
    this.target = plus(plus(this.target, view.slice(0, 3), -dx * scale), view.slice(4, 7), -dy * scale);
  }
  zoom(factor) { this.distance *= factor; }
  camera(width, height) {
    const flat = plus(this.front.map((v) => v * Math.cos(this.yaw)), this.side, Math.sin(this.yaw));
    const back = plus(flat.map((v) => v * Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
    const eye = plus(this.target, back, this.distance), forward = back.map((v) => -v);
    const right = unit(cross(forward, this.up)), down = cross(forward, right);
    const rows = [right, down, forward].map((row) => [...row, -dot(row, eye)]);
    return { eye, view: [...rows.flat(), 0, 0, 0, 1], focal: Math.min(width, height) / (2 * Math.tan(this.fov / 2)) };
  }
}

// Turns, moves and zooms by mouse and touch and calls `changed` with each change. `claim` may take a press for itself:
// it returns what is called as `move(event)` and `end(event, cancelled)`.
function steer(canvas, orbit, changed, claim = () => null) {
  const fingers = new Map();
  let taken = null;
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.onpointerdown = (event) => {
    if (event.isTrusted) canvas.setPointerCapture(event.pointerId);
    if (taken) { taken.end(event, true); taken = null; }
    if (!fingers.size && event.button === 0 && !event.shiftKey) taken = claim(event);
    fingers.set(event.pointerId, event);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    fingers.delete(event.pointerId);
    if (taken) { taken.end(event, event.type === "pointercancel"); taken = null; }
  };
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
    fingers.set(event.pointerId, event);
    if (taken) taken.move(event);
    else if (other) {
      const gap = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
      changed(() => {
        orbit.zoom(gap(before) / Math.max(gap(event), 1));
        orbit.pan(dx / 2, dy / 2, canvas.clientHeight);
      });
    } else if (event.shiftKey || event.buttons & 6) changed(() => orbit.pan(dx, dy, canvas.clientHeight));
    else changed(() => orbit.turn(0.008 * dx, 0.008 * dy));
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    changed(() => orbit.zoom(Math.exp(Math.max(-0.5, Math.min(0.5, 0.0012 * event.deltaY)))));
  }, { passive: false });
}

// Shows why a page does not work.
function reported(make) {
  try {
    return make();
  } catch (error) {
    const trouble = document.getElementById("trouble");
    trouble.textContent = error.message;
    trouble.style.display = "grid";
    throw error;
  }
}
