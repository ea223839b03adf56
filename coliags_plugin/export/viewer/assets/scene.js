// Gaussians and meshes of a run in WebGL 2, along the path of its video. Cameras: x right, y down, z forward.
"use strict";

const scene = JSON.parse(document.getElementById("scene").textContent);
const byId = (id) => document.getElementById(id);

// ---- Data

/** Bytes of a base 64 text, decompressed by "gzip" or "deflate". */
async function unpacked(text, form) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(form));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Gaussians of a layer, whose data are an SPZ file of version 3, in the scene's axes and unit: what the shader reads, three texels each. */
async function gaussiansOf(layer) {
  const bytes = await unpacked(layer.data, "gzip"), unit = layer.unit;
  const { low, span, farthest, data } = layer.attenuation ?? { low: [0, 0], span: [0, 0], farthest: 0 }, fall = data && (await unpacked(data, "deflate"));
  const header = new DataView(bytes.buffer, bytes.byteOffset, 16);
  const count = header.getUint32(8, true), degree = header.getUint8(12), step = unit / 2 ** header.getUint8(13);
  let place = 16;
  const column = (width) => bytes.subarray(place, (place += width * count));
  const positions = column(9), alphas = column(1), colors = column(3), scales = column(3), rotations = column(4);
  const bands = (degree + 1) ** 2 - 1, harmonics = column(3 * bands);
  const centers = new Float32Array(3 * count), texels = new Float32Array(12 * count);
  const quaternion = new Float64Array(4), axes = new Float64Array(9);
  for (let index = 0; index < count; index++) {
    for (let axis = 0; axis < 3; axis++) {
      const at = 9 * index + 3 * axis;
      const value = ((positions[at] | (positions[at + 1] << 8) | (positions[at + 2] << 16)) << 8) >> 8;
      centers[3 * index + axis] = texels[12 * index + axis] = (axis ? -step : step) * value; // SPZ: y up, z back
    }
    let bits = 0, rest = 1;
    for (let byte = 3; byte >= 0; byte--) bits = bits * 256 + rotations[4 * index + byte];
    const largest = Math.floor(bits / 2 ** 30);
    for (let part = 3; part >= 0; part--) {
      if (part === largest) continue;
      const value = ((bits & 511) / 511) * Math.SQRT1_2;
      quaternion[part] = bits & 512 ? -value : value;
      rest -= value * value;
      bits = Math.floor(bits / 1024);
    }
    quaternion[largest] = Math.sqrt(Math.max(0, rest));
    const [x, y, z, w] = [quaternion[0], -quaternion[1], -quaternion[2], quaternion[3]];
    const turn = [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
    for (let entry = 0; entry < 9; entry++)
      axes[entry] = turn[entry] * unit * Math.exp(scales[3 * index + (entry % 3)] / 16 - 10);
    const dot = (a, b) => axes[3 * a] * axes[3 * b] + axes[3 * a + 1] * axes[3 * b + 1] + axes[3 * a + 2] * axes[3 * b + 2];
    const color = colors[3 * index] + 256 * colors[3 * index + 1] + 65536 * colors[3 * index + 2];
    texels.set([alphas[index] / 255, dot(0, 0), dot(0, 1), dot(0, 2), dot(1, 1), dot(1, 2), dot(2, 2), color], 12 * index + 3);
    if (fall) texels[12 * index + 11] = fall[index] + 256 * fall[count + index];
  }
  return { centers, texels, bands, harmonics, low, span, farthest };
}

/** A mesh: corners as 16-bit shares of its box, colours, triangles. */
async function meshOf(layer) {
  const bytes = await unpacked(layer.data, "deflate");
  const corners = 6 * layer.vertices, colors = 3 * layer.vertices;
  const triangles = new Uint32Array(bytes.slice(corners + colors).buffer);
  return { ...layer, corners: bytes.slice(0, corners), colors: bytes.slice(corners, corners + colors), triangles };
}

// ---- Drawing

const LENS = `
uniform mat3 uTurn;  // world to camera
uniform vec3 uEye;
uniform vec4 uLens;  // focal lengths and principal point, pixels
uniform vec2 uSize, uRange;  // of the canvas, pixels; nearest and farthest z
vec4 placed(vec2 pixel, float z) {
  float depth = (uRange.y + uRange.x - 2.0 * uRange.x * uRange.y / z) / (uRange.y - uRange.x);
  return vec4(2.0 * pixel.x / uSize.x - 1.0, 1.0 - 2.0 * pixel.y / uSize.y, depth, 1.0) * z;
}`;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D uTexels;
uniform highp usampler2D uHarmonics;
uniform int uWidth, uBands;
uniform float uBlur;  // variance added, square pixels
uniform vec2 uLow, uSpan;  // of the logarithm of the distance to the lamp where colours are as given, and of the exponent
uniform float uFarthest;  // largest difference of such logarithms
layout(location = 0) in uint aIndex;
out vec2 vAway;
out vec4 vColor;
${LENS}
vec3 harmonic(int index, int band) {
  int place = index * uBands + band, width = textureSize(uHarmonics, 0).x;
  return (vec3(texelFetch(uHarmonics, ivec2(place % width, place / width), 0).rgb) - 128.0) / 128.0;
}
vec3 shaded(int index, vec3 d) {  // real spherical harmonics in the order and with the signs of 3DGS
  // SPZ holds them half a turn about x away.
  float x = d.x, y = -d.y, z = -d.z;
  vec3 sum = vec3(0.0);
  if (uBands >= 3) sum += 0.4886025119 * (-y * harmonic(index, 0) + z * harmonic(index, 1) - x * harmonic(index, 2));
  if (uBands >= 8) sum += 1.0925484306 * (x * y * harmonic(index, 3) - y * z * harmonic(index, 4) - x * z * harmonic(index, 6))
    + 0.3153915653 * (2.0 * z * z - x * x - y * y) * harmonic(index, 5) + 0.5462742153 * (x * x - y * y) * harmonic(index, 7);
  if (uBands >= 15) sum += -0.5900435899 * y * (3.0 * x * x - y * y) * harmonic(index, 8) + 2.8906114426 * x * y * z * harmonic(index, 9)
    - 0.4570457995 * y * (4.0 * z * z - x * x - y * y) * harmonic(index, 10)
    + 0.3731763326 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * harmonic(index, 11)
    - 0.4570457995 * x * (4.0 * z * z - x * x - y * y) * harmonic(index, 12)
    + 1.4453057213 * z * (x * x - y * y) * harmonic(index, 13) - 0.5900435899 * x * (x * x - 3.0 * y * y) * harmonic(index, 14);
  return sum;
}
void main() {
  int index = int(aIndex), texel = 3 * index;
  vec4 first = texelFetch(uTexels, ivec2(texel % uWidth, texel / uWidth), 0);
  vec4 second = texelFetch(uTexels, ivec2((texel + 1) % uWidth, (texel + 1) / uWidth), 0);
  vec4 third = texelFetch(uTexels, ivec2((texel + 2) % uWidth, (texel + 2) / uWidth), 0);
  vec3 away = first.xyz - uEye, local = uTurn * away;
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (local.z < uRange.x) return;
  vec2 slope = local.xy / local.z, edge = 1.3 * max(uLens.zw, uSize - uLens.zw) / uLens.xy;
  vec2 held = clamp(slope, -edge, edge);
  mat3 covariance = mat3(second.x, second.y, second.z, second.y, second.w, third.x, second.z, third.x, third.y);
  covariance = uTurn * covariance * transpose(uTurn);
  vec3 right = vec3(uLens.x, 0.0, -uLens.x * held.x) / local.z, down = vec3(0.0, uLens.y, -uLens.y * held.y) / local.z;
  float a = dot(right, covariance * right) + uBlur, b = dot(right, covariance * down), c = dot(down, covariance * down) + uBlur;
  float middle = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
  float large = middle + spread, small = max(middle - spread, 0.1 * uBlur);
  vec2 axis = a < c ? vec2(b, large - a) : vec2(large - c, b);
  axis = spread < 1e-6 * middle ? vec2(1.0, 0.0) : normalize(axis);
  float alpha = first.w;
  float reach = sqrt(max(0.0, 2.0 * log(255.0 * alpha)));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vAway = reach * corner;
  vec2 pixel = uLens.xy * slope + uLens.zw + vAway.x * sqrt(large) * axis + vAway.y * sqrt(small) * vec2(-axis.y, axis.x);
  uint color = uint(third.z);
  vec3 base = (vec3(color & 255u, (color >> 8u) & 255u, (color >> 16u) & 255u) / 255.0 - 0.5) / 0.15;
  vec3 rgb = 0.5 + 0.2820947918 * base;
  if (uBands > 0) rgb += shaded(index, normalize(away));
  uint bits = uint(third.w);
  vec2 fall = uLow + uSpan * vec2(bits & 255u, bits >> 8u) / 255.0;
  rgb = max(rgb, 0.0) * exp(-fall.y * clamp(log(length(away)) - fall.x, -uFarthest, uFarthest));
  vColor = vec4(rgb, alpha);
  gl_Position = placed(pixel, local.z);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 vAway;
in vec4 vColor;
out vec4 oColor;
void main() {
  float alpha = min(0.99, vColor.a * exp(-0.5 * dot(vAway, vAway)));
  if (alpha < 1.0 / 255.0) discard;
  oColor = vec4(alpha * vColor.rgb, alpha);
}`;

const MESH_VERTEX = `#version 300 es
precision highp float;
uniform vec3 uLow, uSpan;
layout(location = 0) in vec3 aCorner;
layout(location = 1) in vec3 aColor;
out vec3 vLocal, vColor;
${LENS}
void main() {
  vLocal = uTurn * (uLow + uSpan * aCorner - uEye);
  vColor = aColor;
  vec4 place = placed(uLens.xy * vLocal.xy / vLocal.z + uLens.zw, vLocal.z);
  gl_Position = vLocal.z > 0.0 ? place : vec4(2.0 * sign(vLocal.xy) * vec2(1.0, -1.0) * (1.0 - vLocal.z), -2.0, 1.0);
}`;

const MESH_FRAGMENT = `#version 300 es
precision highp float;
uniform float uShade;
in vec3 vLocal, vColor;
out vec4 oColor;
void main() {
  vec3 normal = normalize(cross(dFdx(vLocal), dFdy(vLocal)));
  float facing = abs(dot(normal, normalize(vLocal)));
  oColor = vec4(vColor * mix(1.0, 0.25 + 0.75 * facing, uShade), 1.0);
}`;

function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const names = Array.from({ length: gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) }, (_, index) => gl.getActiveUniform(program, index).name);
  return { program, at: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)])) };
}

/** A texture of rows of a data array, `channels` values to a texel, filled up with zeros. */
function textureOf(gl, unit, values, channels, internal, format, type) {
  const width = 2048;  // what every WebGL 2 has
  const height = Math.max(1, Math.ceil(values.length / channels / width));
  const filled = new values.constructor(width * height * channels);
  filled.set(values);
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, filled);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  return width;
}

/** Draws a cloud of Gaussians, sorted by a worker. */
function splatLayer(gl, cloud, changed) {
  const { program, at } = programOf(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
  const width = textureOf(gl, 0, cloud.texels, 4, gl.RGBA32F, gl.RGBA, gl.FLOAT);
  textureOf(gl, 1, cloud.harmonics, 3, gl.RGB8UI, gl.RGB_INTEGER, gl.UNSIGNED_BYTE);
  const array = gl.createVertexArray(), order = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  const worker = new Worker(URL.createObjectURL(new Blob([`(${sorting})()`], { type: "text/javascript" })));
  worker.postMessage({ centers: cloud.centers });
  let shown = 0, isBusy = false, sorted = "";
  worker.onmessage = ({ data }) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, order);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    shown = data.length;
    isBusy = false;
    changed();
  };
  return {
    isSorted: (view) => shown > 0 && sorted === String(view.forward),
    draw(view) {
      if (!isBusy && sorted !== String(view.forward)) {
        isBusy = true;
        sorted = String(view.forward);
        worker.postMessage({ forward: view.forward });
      }
      gl.useProgram(program);
      setLens(gl, at, view);
      gl.uniform1i(at.uTexels, 0);
      gl.uniform1i(at.uHarmonics, 1);
      gl.uniform1i(at.uWidth, width);
      gl.uniform1i(at.uBands, cloud.bands);
      gl.uniform2fv(at.uLow, cloud.low);
      gl.uniform2fv(at.uSpan, cloud.span);
      gl.uniform1f(at.uFarthest, cloud.farthest);
      gl.uniform1f(at.uBlur, scene.blur * Math.max(1, view.magnified ** 2));
      gl.disable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.bindVertexArray(array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shown);
    },
  };
}

/** The worker: indices of centres from the farthest along a direction to the nearest, by counting. */
function sorting() {
  let centers;
  onmessage = ({ data }) => {
    if (data.centers) { centers = data.centers; return; }
    const [x, y, z] = data.forward, count = centers.length / 3, depths = new Float32Array(count);
    let low = Infinity, high = -Infinity;
    for (let index = 0; index < count; index++) {
      const depth = x * centers[3 * index] + y * centers[3 * index + 1] + z * centers[3 * index + 2];
      depths[index] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const bins = 1 << 18, starts = new Uint32Array(bins + 1), scale = (bins - 1) / Math.max(high - low, 1e-30);
    const keys = new Uint32Array(count), order = new Uint32Array(count);
    for (let index = 0; index < count; index++) {
      keys[index] = (high - depths[index]) * scale;
      starts[keys[index] + 1]++;
    }
    for (let bin = 0; bin < bins; bin++) starts[bin + 1] += starts[bin];
    for (let index = 0; index < count; index++) order[starts[keys[index]]++] = index;
    postMessage(order, [order.buffer]);
  };
}

/** Draws a mesh, lit from the camera as far as its layer says. */
function meshLayer(gl, mesh) {
  const { program, at } = programOf(gl, MESH_VERTEX, MESH_FRAGMENT);
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  for (const [index, values, type] of [[0, mesh.corners, gl.UNSIGNED_SHORT], [1, mesh.colors, gl.UNSIGNED_BYTE]]) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, 3, type, true, 0, 0);
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.triangles, gl.STATIC_DRAW);
  return {
    isSorted: () => true,
    draw(view) {
      gl.useProgram(program);
      setLens(gl, at, view);
      gl.uniform3fv(at.uLow, mesh.low);
      gl.uniform3fv(at.uSpan, mesh.span);
      gl.uniform1f(at.uShade, mesh.shade);
      gl.enable(gl.DEPTH_TEST);
      gl.disable(gl.BLEND);
      gl.bindVertexArray(array);
      gl.drawElements(gl.TRIANGLES, mesh.triangles.length, gl.UNSIGNED_INT, 0);
    },
  };
}

function setLens(gl, at, view) {
  gl.uniformMatrix3fv(at.uTurn, false, view.turn);
  gl.uniform3fv(at.uEye, view.eye);
  gl.uniform4fv(at.uLens, view.lens);
  gl.uniform2fv(at.uSize, view.size);
  gl.uniform2fv(at.uRange, scene.range);
}

// ---- Camera: a centre, and axes as the columns right, down, forward

const times = (axes, [x, y, z]) => [0, 1, 2].map((row) => x * axes[row][0] + y * axes[row][1] + z * axes[row][2]);
const sum = (a, b, factor = 1) => a.map((value, index) => value + factor * b[index]);
const column = (axes, index) => axes.map((row) => row[index]);
const dot = (a, b) => a.reduce((total, value, index) => total + value * b[index], 0);

/** Axes turned about the camera's own right and down axes, radians. */
function turned(axes, pitch, yaw) {
  const [p, q, s, t] = [Math.cos(pitch), Math.sin(pitch), Math.cos(yaw), Math.sin(yaw)];
  return orthonormal(axes.map(([x, y, z]) => [s * x - t * z, q * (t * x + s * z) + p * y, p * (t * x + s * z) - q * y]));
}

function orthonormal(axes) {
  const unit = (vector) => vector.map((value) => value / Math.hypot(...vector));
  const forward = unit(column(axes, 2)), across = column(axes, 0);
  const right = unit(sum(across, forward, -dot(across, forward)));
  const down = [0, 1, 2].map((i) => forward[(i + 1) % 3] * right[(i + 2) % 3] - forward[(i + 2) % 3] * right[(i + 1) % 3]);
  return [0, 1, 2].map((row) => [right[row], down[row], forward[row]]);
}

/** The pose between two frames of the video, at a fractional index. */
function poseAt(index) {
  const low = Math.floor(index), share = index - low;
  const [from, to] = [scene.frames[low], scene.frames[Math.min(low + 1, scene.frames.length - 1)]];
  const axes = from.axes.map((row, i) => row.map((value, j) => (1 - share) * value + share * to.axes[i][j]));
  return { center: sum(from.center.map((value) => (1 - share) * value), to.center, share), axes: orthonormal(axes) };
}

/** Index of the frame whose pose is nearest: distances in shares of the look distance, turns in radians. */
function nearestFrame({ center, axes }) {
  const cost = (frame) =>
    Math.hypot(...sum(center, frame.center, -1)) / scene.distance + Math.acos(Math.max(-1, Math.min(1, dot(column(axes, 2), column(frame.axes, 2)))));
  const costs = scene.frames.map(cost);
  return costs.indexOf(Math.min(...costs));
}

// ---- Page

/** A colour (RGB) and what it means. */
function legendItem([label, color]) {
  const item = document.createElement("li"), swatch = document.createElement("i");
  swatch.style.background = `rgb(${color})`;
  item.append(swatch, label);
  return item;
}

async function start() {
  const canvas = byId("canvas"), slider = byId("frame"), play = byId("play");
  const gl = canvas.getContext("webgl2", { alpha: false });
  if (!gl) throw new Error("This browser has no WebGL 2.");
  let pose = poseAt(scene.start), place = scene.start, isDue = false, isPlaying = false, chosen = 0;
  const changed = () => {
    if (!isDue) requestAnimationFrame(draw);
    isDue = true;
  };
  const layers = [];
  for (const layer of scene.layers)
    layers.push(layer.kind === "gaussians" ? splatLayer(gl, await gaussiansOf(layer), changed) : meshLayer(gl, await meshOf(layer)));

  function view() {
    const [width, height] = [canvas.width, canvas.height], k = scene.camera;
    const scale = Math.min(width / k.width, height / k.height);
    const lens = [scale * k.fx, scale * k.fy, 0.5 * width + scale * (k.cx - 0.5 * k.width), 0.5 * height + scale * (k.cy - 0.5 * k.height)];
    return { turn: pose.axes.flat(), eye: pose.center, forward: column(pose.axes, 2), lens, size: [width, height], magnified: scale };
  }

  function draw() {
    isDue = false;
    const box = canvas.getBoundingClientRect(), density = Math.min(devicePixelRatio, 2);
    [canvas.width, canvas.height] = [Math.round(box.width * density), Math.round(box.height * density)];
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const seen = view();
    layers[chosen].draw(seen);
    canvas.dataset.drawn = layers[chosen].isSorted(seen);
  }

  function tell(index) {
    const frame = scene.frames[index];
    slider.value = index;
    if (frame.picture) byId("picture").src = frame.picture;
    byId("name").textContent = frame.name + (frame.held_out ? ", held out" : "");
  }

  function goTo(index) {
    place = index;
    pose = poseAt(index);
    tell(Math.round(index));
    changed();
  }

  function moved() {
    pause();
    place = nearestFrame(pose);
    tell(place);
    changed();
  }

  function choose(index) {
    chosen = index;
    byId("about").textContent = scene.layers[index].about;
    byId("legend").replaceChildren(...scene.layers[index].legend.map(legendItem));
    changed();
  }

  function pause() {
    isPlaying = false;
    play.textContent = "Play";
  }

  function advance(since) {
    if (!isPlaying) return;
    requestAnimationFrame((now) => {
      const last = scene.frames.length - 1;
      const passed = Math.max(0, Math.min(now - since, 200));  // a frame may have begun before the click
      if (isPlaying) goTo(Math.min(last, place + (scene.rate * passed) / 1000));
      if (place >= last) pause();
      advance(now);
    });
  }

  play.addEventListener("click", () => {
    if (isPlaying) return pause();
    isPlaying = true;
    play.textContent = "Pause";
    if (place >= scene.frames.length - 1) goTo(0);
    advance(performance.now());
  });
  slider.addEventListener("input", () => { pause(); goTo(Number(slider.value)); });
  for (const radio of document.querySelectorAll("input[name=layer]"))
    radio.addEventListener("change", () => choose(Number(radio.value)));

  const pointers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const pixel = view().lens[0] / Math.min(devicePixelRatio, 2);
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const shift = (right, down, forward) => (pose.center = sum(pose.center, times(pose.axes, [right, down, forward])));
    if (pointers.size > 1) {
      const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      const nearer = (apart(event) - apart(before)) / pixel;
      shift((-0.5 * x * scene.distance) / pixel, (-0.5 * y * scene.distance) / pixel, scene.distance * nearer);
    } else if (event.shiftKey || event.buttons === 2) shift((-x * scene.distance) / pixel, (-y * scene.distance) / pixel, 0);
    else pose.axes = turned(pose.axes, y / pixel, -x / pixel);
    pointers.set(event.pointerId, event);
    moved();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    pose.center = sum(pose.center, column(pose.axes, 2), -Math.sign(event.deltaY) * 0.05 * scene.distance);
    moved();
  }, { passive: false });

  new ResizeObserver(changed).observe(canvas);
  choose(0);
  goTo(scene.start);
}

start().catch((error) => {
  byId("about").textContent = `The scene cannot be drawn. ${error.message}`;
  throw error;
});
