"use strict";
// The 3D view: the head under the light of the clip (order-2 harmonics) and one lamp that can be moved.
// Hair that stands off it is a second mesh with an alpha of its own.
// Drag turns the head, or moves the lamp when that is chosen; wheel or pinch zooms. Facial actions: one at a time.
function startViewer(canvas, data) {
  const gl = data && canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    canvas.hidden = true;
    document.getElementById("viewer-absent").hidden = false;
    return;
  }
  const vertexSource = `
    attribute vec3 position; attribute vec4 normal; attribute vec2 uv;
    uniform vec3 low, size, centre; uniform mat3 turn; uniform float zoom, aspect;
    varying vec3 n, p; varying vec2 st; varying float eye;
    void main() {
      p = turn * (low + size * position - centre);
      n = turn * normal.xyz; st = uv; eye = normal.w;
      float depth = 3.2 - p.z;
      vec2 xy = p.xy * zoom * 3.2;
      gl_Position = vec4(aspect > 1.0 ? xy.x / aspect : xy.x, aspect > 1.0 ? xy.y : xy.y * aspect,
                         (depth - 3.2) / 2.0 * depth, depth);
    }`;
  const fragmentSource = `
    precision highp float;
    varying vec3 n, p; varying vec2 st; varying float eye;
    uniform sampler2D albedo, alpha; uniform vec3 harmonics[9], lamp; uniform float clip, power, plain, least;
    uniform vec2 skin, wet;  // roughness and specular intensity
    vec3 toLinear(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
    vec3 toCodes(vec3 c) { return mix(12.92 * c, 1.055 * pow(max(c, 1e-5), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
    void main() {
      float there = texture2D(alpha, st).r;
      if (there < least) discard;
      vec3 N = normalize(gl_FrontFacing ? n : -n), V = normalize(vec3(0.0, 0.0, 3.2) - p), L = normalize(lamp);
      vec3 H = normalize(L + V), m = N;
      vec3 base = mix(toLinear(texture2D(albedo, st).rgb), vec3(0.5), plain);
      vec3 sky = harmonics[0] + harmonics[1] * m.y + harmonics[2] * m.z + harmonics[3] * m.x + harmonics[4] * m.x * m.y
        + harmonics[5] * m.y * m.z + harmonics[6] * (3.0 * m.z * m.z - 1.0) + harmonics[7] * m.x * m.z
        + harmonics[8] * (m.x * m.x - m.y * m.y);
      vec2 finish = eye > 0.5 ? wet : skin;
      float nl = max(dot(N, L), 0.0), nv = max(dot(N, V), 0.05), nh = dot(N, H), a = finish.x * finish.x, a2 = a * a;
      float d = a2 / (3.14159 * pow(nh * nh * (a2 - 1.0) + 1.0, 2.0));
      float f = 0.04 + 0.96 * pow(1.0 - max(dot(V, H), 0.0), 5.0), k = a / 2.0;
      float g = 1.0 / ((nl * (1.0 - k) + k) * (nv * (1.0 - k) + k));
      vec3 colour = base * max(sky, 0.0) * clip + (base + 3.14159 * finish.y * d * f * g / 4.0) * nl * power;
      gl_FragColor = vec4(toCodes(clamp(colour, 0.0, 1.0)), there);
    }`;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  function attribute(name, text, size, type, normalised, stride) {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, bytes(text), gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, normalised, stride, 0);
    return buffer;
  }
  const mesh = data.mesh, hair = data.hair;
  function upload(own) {  // a mesh's buffers, bound together
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const positions = attribute("position", own.positions, 3, gl.UNSIGNED_SHORT, true, 8);
    const normals = attribute("normal", own.normals, 4, gl.BYTE, true, 4);
    attribute("uv", own.uvs, 2, gl.UNSIGNED_SHORT, true, 4);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, bytes(own.faces), gl.STATIC_DRAW);
    return { array, positions, normals, mesh: own };
  }
  const strands = hair && upload(hair.mesh), head = upload(mesh);
  const all = hair ? [mesh, hair.mesh] : [mesh];
  const low = mesh.low.map((_, i) => Math.min(...all.map((own) => own.low[i])));
  const size = low.map((x, i) => Math.max(...all.map((own) => own.low[i] + own.size[i])) - x);
  const scale = 2 / Math.max(...size);
  gl.uniform3fv(uniform("centre"), low.map((x, i) => (x + size[i] / 2) * scale));
  gl.uniform3fv(uniform("harmonics"), data.harmonics.flat());
  gl.uniform2fv(uniform("wet"), data.wet);
  gl.uniform1i(uniform("albedo"), 0);
  gl.uniform1i(uniform("alpha"), 1);
  gl.enable(gl.DEPTH_TEST);
  const solid = gl.createTexture();  // a head's alpha
  gl.bindTexture(gl.TEXTURE_2D, solid);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([255, 255, 255]));
  gl.generateMipmap(gl.TEXTURE_2D);

  const state = { yaw: 0.35, pitch: 0.05, lampYaw: -0.9, lampPitch: 0.5, zoom: 0.95, ready: false };
  function drawPart(part, albedo, alpha, roughness, specular) {
    gl.bindVertexArray(part.array);
    for (const [k, texture] of [albedo, alpha].entries()) {
      gl.activeTexture(gl.TEXTURE0 + k);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    }
    gl.uniform3fv(uniform("low"), part.mesh.low.map((x) => x * scale));
    gl.uniform3fv(uniform("size"), part.mesh.size.map((x) => x * scale));
    gl.uniform2f(uniform("skin"), roughness, specular);
    gl.drawElements(gl.TRIANGLES, part.mesh.count, gl.UNSIGNED_INT, 0);
  }
  function drawHair() {  // its alpha as the share of a pixel's samples, whatever the order; without samples cut at a half
    const samples = gl.getParameter(gl.SAMPLES) > 1;
    gl.uniform1f(uniform("least"), samples ? 0.05 : 0.5);
    if (samples) gl.enable(gl.SAMPLE_ALPHA_TO_COVERAGE);
    gl.colorMask(true, true, true, false);  // the page must not shine through
    drawPart(strands, textures.hair, textures.alpha, 0.5, 0);
    gl.colorMask(true, true, true, true);
    gl.disable(gl.SAMPLE_ALPHA_TO_COVERAGE);
  }
  const control = (id) => document.getElementById(id);
  const rotation = (yaw, pitch) => {  // column-major: first about y, then about x
    const [c, s, d, t] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    return [c, t * s, -d * s, 0, d, t, s, -t * c, d * c];
  };
  function draw() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.2, 0.2, 0.2, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!state.ready) return;
    gl.uniformMatrix3fv(uniform("turn"), false, rotation(state.yaw, state.pitch));
    gl.uniform1f(uniform("zoom"), state.zoom);
    gl.uniform1f(uniform("aspect"), canvas.width / canvas.height);
    gl.uniform3f(uniform("lamp"), Math.sin(state.lampYaw) * Math.cos(state.lampPitch),
      Math.sin(state.lampPitch), Math.cos(state.lampYaw) * Math.cos(state.lampPitch));
    gl.uniform1f(uniform("clip"), +control("viewer-clip").value);
    gl.uniform1f(uniform("power"), +control("viewer-lamp").value);
    gl.uniform1f(uniform("plain"), control("viewer-plain").checked ? 1 : 0);
    gl.uniform1f(uniform("least"), 0);
    drawPart(head, textures.head, solid, data.roughness, data.specular);
    if (hair && (control("viewer-hair")?.checked ?? true)) drawHair();
    canvas.dataset.drawn = "yes";
  }
  const update = (buffer, values) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
  };
  const faces = new Uint32Array(bytes(mesh.faces).buffer);
  function faceNormals(q) {  // sums of the faces' normals at each vertex, of unit length
    const step = mesh.size.map((x) => x / 65535), n = new Float32Array(q.length / 4 * 3);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [faces[f], faces[f + 1], faces[f + 2]];
      const [u, v] = [b, c].map((k) => step.map((s, i) => s * (q[4 * k + i] - q[4 * a + i])));
      for (let i = 0; i < 3; i++) {
        const [j, l] = [(i + 1) % 3, (i + 2) % 3], x = u[j] * v[l] - u[l] * v[j];
        n[3 * a + i] += x; n[3 * b + i] += x; n[3 * c + i] += x;
      }
    }
    for (let k = 0; k < n.length; k += 3) {
      const length = Math.hypot(n[k], n[k + 1], n[k + 2]) || 1;
      for (let i = 0; i < 3; i++) n[k + i] /= length;
    }
    return n;
  }
  function act() {
    const action = mesh.actions[control("viewer-action").selectedIndex], w = +control("viewer-weight").value;
    const q = new Uint16Array(bytes(mesh.positions).buffer), n = new Int8Array(bytes(mesh.normals).buffer);
    const before = faceNormals(q), which = new Uint32Array(bytes(action.vertices).buffer);
    const [full, half] = [action.offsets, action.half].map((text) => new Int16Array(bytes(text).buffer));
    const [share, bend] = half.length ? [Math.max(0, 2 * w - 1), 1 - Math.abs(2 * w - 1)] : [w, 0];
    which.forEach((k, row) => {
      for (let i = 0; i < 3; i++) {
        const moved = data.action_step * (share * full[3 * row + i] + (bend ? bend * half[3 * row + i] : 0));
        q[4 * k + i] = Math.max(0, Math.min(65535, Math.round(q[4 * k + i] + moved / mesh.size[i] * 65535)));
      }
    });
    const after = faceNormals(q);
    for (let k = 0; 4 * k < n.length; k++) {
      const turned = [0, 1, 2].map((i) => n[4 * k + i] + 127 * (after[3 * k + i] - before[3 * k + i]));
      const length = Math.hypot(...turned) || 1;
      turned.forEach((x, i) => { n[4 * k + i] = Math.round(127 * x / length); });
    }
    update(head.positions, q);
    update(head.normals, n);
    canvas.dataset.action = action.name + " " + w;
    draw();
  }
  for (const id of ["viewer-action", "viewer-weight"]) control(id)?.addEventListener("input", act);
  const pictures = { head: data.albedo, ...(hair ? { hair: hair.albedo, alpha: hair.alpha } : {}) }, textures = {};
  for (const [name, source] of Object.entries(pictures)) {
    const image = new Image();
    image.onload = () => {
      textures[name] = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, textures[name]);
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      state.ready = Object.keys(textures).length === Object.keys(pictures).length;
      draw();
    };
    image.src = source;
  }
  const limit = (x, reach) => Math.max(-reach, Math.min(reach, x));
  const pointers = new Map();
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); pointers.set(e.pointerId, e); });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const last = pointers.get(e.pointerId);
    if (!last) return;
    if (pointers.size === 2) {
      const other = [...pointers.values()].find((q) => q.pointerId !== e.pointerId);
      const span = (q) => Math.hypot(q.clientX - other.clientX, q.clientY - other.clientY) || 1;
      zoomBy(span(e) / span(last));
    } else {
      const dx = (e.clientX - last.clientX) / 150, dy = (e.clientY - last.clientY) / 150;
      if (control("viewer-moves-lamp").checked) {
        state.lampYaw += dx;
        state.lampPitch = limit(state.lampPitch - dy, 1.5);
      } else {
        state.yaw += dx;
        state.pitch = limit(state.pitch + dy, 1.5);
      }
    }
    pointers.set(e.pointerId, e);
    draw();
  });
  const zoomBy = (factor) => { state.zoom = Math.max(0.5, Math.min(6, state.zoom * factor)); draw(); };
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoomBy(Math.exp(-e.deltaY / 500)); }, { passive: false });
  for (const id of ["viewer-clip", "viewer-lamp", "viewer-plain", "viewer-hair"]) {
    control(id)?.addEventListener("input", draw);
  }
  window.addEventListener("resize", draw);
  draw();
}
