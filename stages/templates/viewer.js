// A small viewer of one textured mesh: drag to turn, wheel or pinch to zoom, shift-drag or right-drag to move,
// double-click to go back. Positions and UVs come quantised to 16 bits, normals to 8; Y is up.
(function () {
  "use strict";
  const canvas = document.getElementById("viewer");
  const note = document.getElementById("viewer-note");
  const source = document.getElementById("mesh-data");
  if (!canvas || !source) return;
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) {
    note.textContent = "This browser has no WebGL 2: see the pictures below.";
    return;
  }
  const mesh = JSON.parse(source.textContent);

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const shader = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, text);
    gl.compileShader(made);
    if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
    return made;
  };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `#version 300 es
    in vec3 position; in vec2 uv; in vec3 normal;
    uniform mat4 view, projection; uniform vec3 low, size;
    out vec2 at; out vec3 facing; out vec3 toEye;
    void main() {
      vec4 p = view * vec4(low + position * size, 1.0);
      gl_Position = projection * p;
      at = uv; facing = mat3(view) * normal; toEye = -p.xyz;
    }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `#version 300 es
    precision highp float;
    in vec2 at; in vec3 facing; in vec3 toEye;
    uniform sampler2D colors; uniform int mode;
    out vec4 pixel;
    void main() {
      vec3 base = mode == 1 ? vec3(0.75) : texture(colors, at).rgb;
      float light = mode == 0 ? 1.0 : 0.3 + 0.7 * abs(dot(normalize(facing), normalize(toEye)));
      pixel = vec4(base * light, 1.0);
    }`));
  gl.linkProgram(program);
  gl.useProgram(program);

  const attribute = (name, data, size, type, normalised) => {
    const at = gl.getAttribLocation(program, name);
    if (at < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, normalised, 0, 0);
  };
  attribute("position", bytes(mesh.positions), 3, gl.UNSIGNED_SHORT, true);
  attribute("uv", bytes(mesh.uvs), 2, gl.UNSIGNED_SHORT, true);
  attribute("normal", bytes(mesh.normals), 3, gl.BYTE, true);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, bytes(mesh.faces), gl.STATIC_DRAW);
  const uniform = (name) => gl.getUniformLocation(program, name);
  gl.uniform3fv(uniform("low"), mesh.low);
  gl.uniform3fv(uniform("size"), mesh.size);

  const center = mesh.low.map((v, i) => v + mesh.size[i] / 2);
  const radius = Math.hypot(...mesh.size) / 2 || 1;
  const start = () => ({ yaw: 0.6, pitch: 0.35, distance: radius * 3.2, pan: [0, 0] });
  let eye = start();
  let mode = 0;
  let waiting = false;

  function draw() {
    waiting = false;
    const dpr = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * dpr));
    const height = Math.max(1, Math.round(canvas.clientHeight * dpr));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const near = Math.max(eye.distance - radius * 1.5, radius * 0.01);
    const far = eye.distance + radius * 3;
    const f = 2.6 * Math.min(1, width / height);
    gl.uniformMatrix4fv(uniform("projection"), false, [
      (f * height) / width, 0, 0, 0, 0, f, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    ]);
    const [cy, sy, cp, sp] = [Math.cos(eye.yaw), Math.sin(eye.yaw), Math.cos(eye.pitch), Math.sin(eye.pitch)];
    const rows = [[cy, 0, -sy], [-sy * sp, cp, -cy * sp], [sy * cp, sp, cy * cp]];
    const move = rows.map((r) => -(r[0] * center[0] + r[1] * center[1] + r[2] * center[2]));
    gl.uniformMatrix4fv(uniform("view"), false, [
      rows[0][0], rows[1][0], rows[2][0], 0, rows[0][1], rows[1][1], rows[2][1], 0,
      rows[0][2], rows[1][2], rows[2][2], 0,
      move[0] + eye.pan[0], move[1] + eye.pan[1], move[2] - eye.distance, 1,
    ]);
    gl.uniform1i(uniform("mode"), mode);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  }
  const redraw = () => {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  };

  const pointers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    pointers.set(e.pointerId, e);
    canvas.setPointerCapture(e.pointerId);
  });
  const lift = (e) => pointers.delete(e.pointerId);
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointermove", (e) => {
    const last = pointers.get(e.pointerId);
    if (!last) return;
    const [dx, dy] = [e.clientX - last.clientX, e.clientY - last.clientY];
    if (pointers.size === 2) {
      const other = [...pointers.values()].find((p) => p.pointerId !== e.pointerId);
      const span = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
      zoom(span(last) / span(e));
    } else if (e.shiftKey || e.buttons & 2) {
      const step = (eye.distance * 0.8) / canvas.clientHeight;
      eye.pan = [eye.pan[0] + dx * step, eye.pan[1] - dy * step];
    } else {
      eye.yaw -= dx * 0.008;
      eye.pitch = Math.max(-1.55, Math.min(1.55, eye.pitch + dy * 0.008));
    }
    pointers.set(e.pointerId, e);
    redraw();
  });
  const zoom = (factor) => {
    eye.distance = Math.max(radius * 0.3, Math.min(radius * 20, eye.distance * factor));
    redraw();
  };
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp(e.deltaY * 0.001));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", () => {
    eye = start();
    redraw();
  });
  document.querySelectorAll("[data-mode]").forEach((button) => {
    button.addEventListener("click", () => {
      mode = Number(button.dataset.mode);
      document.querySelectorAll("[data-mode]").forEach((b) => b.setAttribute("aria-pressed", String(b === button)));
      redraw();
    });
  });
  window.addEventListener("resize", redraw);

  const image = new Image();
  image.onload = () => {
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    document.documentElement.dataset.viewer = "ready";
    redraw();
  };
  image.src = mesh.texture;
})();
