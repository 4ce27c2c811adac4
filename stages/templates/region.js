// The region of interest in the 3D view: drawn, dimming what lies outside, and edited into a command to copy.
// Its numbers are in the world, the frame of the exported files; the view's frame is the scene's, turned +Y up.

// A number as the command says it: to a hundred thousandth of `size`, and no digit more.
function regionNumber(value, size) {
  return String(Number(value.toFixed(Math.min(Math.max(5 - Math.floor(Math.log10(size)), 0), 100))));
}

// What `place.region` is set to; configs/texts.py reads it.
function regionText({ form, center, radius, low, high }) {
  const numbers = form === "sphere" ? [...center, radius] : [...low, ...high];
  const size = form === "sphere" ? radius : Math.min(...low.map((from, k) => high[k] - from));
  return [form, ...numbers.map((value) => regionNumber(value, size))].join(" ");
}

function regionCommand(region, workspace) {
  return `hineus run --workspace ${shellWord(workspace)} --set ${shellWord("place.region=" + regionText(region))}`;
}

/* Draws the region and lets the person edit it.
   given: as view3d.py packs it. cloud: positions of the sparse points in the view's frame, and for how many each stands.
   home: puts the eye where it sees all, as `span` says.
   Returns the lines; `dim`, which makes a material fade outside the region while the lines are visible; `span`; and
   `start`, once the rest of the view is there. */
function addRegion({ given, cloud, scene, eye, canvas, paint, redraw, home }) {
  const element = (id) => document.getElementById(id);
  const vector = (numbers) => new THREE.Vector3(...numbers);
  const viewFromWorld = new THREE.Matrix4().set(...given.view_from_world);
  const copy = ({ form, center, radius, low, high }) =>
    ({ form, center: [...center], radius, low: [...low], high: [...high] });
  let region = copy(given);
  const middle = () => (region.form === "sphere" ? region.center : region.low.map((from, k) => (from + region.high[k]) / 2));
  const reach = () =>
    region.form === "sphere" ? Array(3).fill(region.radius) : region.low.map((from, k) => (region.high[k] - from) / 2);

  // ---------------------------------------------------------------- drawing
  const turned = (point, k) => point.map((_, i) => point[(i - k + 3) % 3]); // its first coordinate along axis k
  const circle = (k) =>
    Array.from({ length: 128 }, (_, i) => {
      const angle = (Math.floor((i + 1) / 2) / 64) * 2 * Math.PI;
      return turned([Math.cos(angle), Math.sin(angle), 0], k);
    });
  const signs = [-1, 1];
  const edges = (k) => signs.flatMap((a) => signs.flatMap((b) => signs.map((c) => turned([c, a, b], k))));
  const shape = (side) => new THREE.BufferAttribute(new Float32Array([0, 1, 2].flatMap(side).flat()), 3);
  const shapes = { sphere: shape(circle), box: shape(edges) };
  const lines = new THREE.LineSegments(
    new THREE.BufferGeometry(),
    new THREE.LineBasicMaterial({ color: paint("--region") }),
  );
  lines.frustumCulled = false;
  lines.matrixAutoUpdate = false;

  const shade = { viewToRegion: { value: new THREE.Matrix4() }, regionForm: { value: 0 }, fade: { value: paint("--panel") } };
  const dim = (material) => {
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, shade);
      shader.vertexShader = shader.vertexShader
        .replace("void main() {", "uniform mat4 viewToRegion; varying vec3 inRegion;\nvoid main() {")
        .replace("#include <project_vertex>", `#include <project_vertex>
          inRegion = (viewToRegion * vec4(transformed, 1.0)).xyz;`);
      shader.fragmentShader = shader.fragmentShader
        .replace("void main() {", "uniform int regionForm; uniform vec3 fade; varying vec3 inRegion;\nvoid main() {")
        .replace("#include <opaque_fragment>", `#include <opaque_fragment>
          vec3 side = abs(inRegion);
          float away = regionForm == 1 ? length(side) : max(side.x, max(side.y, side.z));
          if (regionForm > 0 && away > 1.0) gl_FragColor.rgb = mix(gl_FragColor.rgb, fade, 0.5);`);
    };
    return material;
  };
  scene.onBeforeRender = () => (shade.regionForm.value = lines.visible ? (region.form === "sphere" ? 1 : 2) : 0);

  // Handles: the middle, then the low and the high end of each axis.
  const handles = new THREE.Points(
    new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(new Float32Array(21), 3)),
    new THREE.PointsMaterial({ color: paint("--region"), size: 11, sizeAttenuation: false, depthTest: false }),
  );
  handles.frustumCulled = false;
  handles.renderOrder = 1;
  handles.visible = false;
  const handlePlaces = () => {
    const [at, ends] = [middle(), reach()];
    const moved = (k, by) => vector(at.map((value, i) => (i === k ? value + by : value)));
    const places = [vector(at), ...[0, 1, 2].flatMap((k) => [moved(k, -ends[k]), moved(k, ends[k])])];
    return places.map((place) => place.applyMatrix4(viewFromWorld));
  };
  scene.add(handles);

  const place = () => {
    lines.geometry.setAttribute("position", shapes[region.form]);
    lines.matrix.copy(viewFromWorld).multiply(new THREE.Matrix4().makeTranslation(...middle()));
    lines.matrix.multiply(new THREE.Matrix4().makeScale(...reach()));
    lines.matrixWorldNeedsUpdate = true;
    shade.viewToRegion.value.copy(lines.matrix).invert();
    handlePlaces().forEach((at, i) => at.toArray(handles.geometry.getAttribute("position").array, 3 * i));
    handles.geometry.getAttribute("position").needsUpdate = true;
    redraw();
  };

  // ---------------------------------------------------------------- fields, count and command
  const fields = [...document.querySelectorAll("[data-region]")];
  const [list, index] = [({ dataset }) => dataset.region, ({ dataset }) => Number(dataset.axis)];
  const get = (field) => (list(field) === "radius" ? region.radius : region[list(field)][index(field)]);
  const set = (field, value) => {
    if (list(field) === "radius") region.radius = value;
    else region[list(field)][index(field)] = value;
  };
  let workspace = "WORKSPACE";
  const sound = () => reach().every((side) => side > 0) && middle().every(Number.isFinite);
  const count = () => {
    const point = new THREE.Vector3();
    let inside = 0;
    for (let i = 0; i < cloud.positions.length; i += 3) {
      const side = point.fromArray(cloud.positions, i).applyMatrix4(shade.viewToRegion.value);
      const away = region.form === "sphere" ? side.length() : Math.max(...side.toArray().map(Math.abs));
      inside += away <= 1;
    }
    inside = Math.min(inside * cloud.each, cloud.total);
    const share = ((100 * inside) / Math.max(cloud.total, 1)).toFixed(1);
    return `${cloud.each > 1 ? "About " : ""}${inside} of ${cloud.total} sparse points are inside (${share} %).`;
  };
  const tell = () => {
    element("region-form").value = region.form;
    for (const part of document.querySelectorAll("[data-form]")) part.hidden = part.dataset.form !== region.form;
    const fine = sound();
    if (fine) place();
    element("region-copy").disabled = !fine;
    element("region-count").textContent = fine
      ? count()
      : "The radius must be positive, and each upper end larger than its lower one.";
    element("region-command").textContent = fine ? regionCommand(region, workspace) : "";
  };
  const fill = () => {
    const size = Math.max(...reach());
    for (const field of fields) {
      field.value = regionNumber(get(field), size);
      field.step = 10 ** Math.floor(Math.log10(size / 20));
    }
    tell();
  };
  for (const field of fields)
    field.addEventListener("input", () => {
      set(field, field.value === "" ? NaN : Number(field.value));
      tell();
    });
  // The other form keeps its size and comes to where this one is.
  element("region-form").addEventListener("change", (e) => {
    const from = middle();
    region.form = e.target.value;
    const by = middle().map((value, k) => from[k] - value);
    const move = (corner) => corner.map((value, k) => value + by[k]);
    if (region.form === "sphere") region.center = move(region.center);
    else [region.low, region.high] = [move(region.low), move(region.high)];
    fill();
  });
  element("region-reset").addEventListener("click", () => {
    region = copy(given);
    fill();
  });
  element("region-copy").addEventListener("click", async () => {
    const command = element("region-command");
    getSelection().selectAllChildren(command);
    try {
      await navigator.clipboard.writeText(command.textContent);
      element("region-copied").textContent = "Copied.";
    } catch {
      element("region-copied").textContent = "Selected: copy it with Ctrl+C.";
    }
  });
  element("region-toggle").addEventListener("click", () => {
    const open = element("region-panel").hidden;
    element("region-panel").hidden = !open;
    element("region-toggle").setAttribute("aria-expanded", String(open));
    handles.visible = open;
    home();
    for (const layer of ["region", "points"]) {
      const box = document.querySelector(`[data-layer="${layer}"]`);
      if (open && !box.checked) box.click();
    }
    redraw();
  });

  // ---------------------------------------------------------------- dragging
  const under = (event) => {
    const box = canvas.getBoundingClientRect();
    return [((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2];
  };
  const grabbed = (event) => {
    const [x, y] = under(event);
    let [best, found] = [14, null];
    handlePlaces().forEach((at, i) => {
      at.project(eye);
      const away = Math.hypot((at.x - x) * canvas.clientWidth, (at.y - y) * canvas.clientHeight) / 2;
      if (handles.visible && at.z < 1 && away < best) [best, found] = [away, i];
    });
    return found;
  };
  const ray = (event) => vector([...under(event), 0.5]).unproject(eye).sub(eye.position).normalize();
  // Where the pointer is in the plane through the middle that faces the eye, in the world.
  const onPlane = (event) => {
    const [ahead, along] = [eye.getWorldDirection(new THREE.Vector3()), ray(event)];
    const depth = handlePlaces()[0].sub(eye.position).dot(ahead) / along.dot(ahead);
    return along.multiplyScalar(depth).add(eye.position).applyMatrix4(viewFromWorld.clone().invert()).toArray();
  };
  // Where an axis through the middle comes nearest to the pointer's ray: its coordinate in the world, null if parallel.
  const onAxis = (event, k) => {
    const places = handlePlaces();
    const axis = places[2 * k + 2].sub(places[0]);
    const [along, offset] = [ray(event), places[0].sub(eye.position)];
    const unit = axis.clone().normalize();
    const cosine = unit.dot(along);
    if (1 - cosine ** 2 < 1e-4) return null;
    const t = (cosine * offset.dot(along) - offset.dot(unit)) / (1 - cosine ** 2);
    return middle()[k] + (t / axis.length()) * reach()[k];
  };
  const drag = (event, handle) => {
    const least = Math.max(...reach()) / 1000;
    if (handle === 0) {
      const at = middle();
      const by = onPlane(event).map((value, k) => value - at[k]);
      for (const corner of ["center", "low", "high"]) region[corner] = region[corner].map((value, k) => value + by[k]);
      return fill();
    }
    const [k, upper] = [(handle - 1) >> 1, (handle - 1) % 2];
    const to = onAxis(event, k);
    if (to === null) return;
    const away = upper ? to - middle()[k] : middle()[k] - to;
    if (region.form === "sphere") region.radius = Math.max(away, least);
    else if (upper) region.high[k] = Math.max(to, region.low[k] + least);
    else region.low[k] = Math.min(to, region.high[k] - least);
    fill();
  };
  // Before the view's own listeners: what takes hold of a handle neither turns the view nor chooses a camera.
  let held = null;
  const listen = (kind, act) => canvas.addEventListener(kind, act, { capture: true });
  listen("pointerdown", (e) => {
    held = e.button === 0 ? grabbed(e) : null;
    if (held === null) return;
    canvas.setPointerCapture(e.pointerId);
    e.stopImmediatePropagation();
  });
  listen("pointermove", (e) => {
    if (held === null) return void (canvas.style.cursor = e.buttons === 0 && grabbed(e) !== null ? "move" : "");
    drag(e, held);
    e.stopImmediatePropagation();
  });
  for (const kind of ["pointerup", "pointercancel"])
    listen(kind, (e) => {
      if (held !== null) e.stopImmediatePropagation();
      held = null;
    });

  // How far from a point of the view there is something to see: the mesh's middle, while the region is edited.
  const span = (from) => {
    if (!handles.visible) return 0;
    const point = new THREE.Vector3();
    const distances = new Float32Array(cloud.positions.length / 3)
      .map((_, i) => point.fromArray(cloud.positions, 3 * i).distanceTo(from))
      .sort();
    const corner = vector(middle()).add(vector(reach())).applyMatrix4(viewFromWorld);
    const [center] = handlePlaces();
    return Math.max(center.distanceTo(from) + corner.distanceTo(center), distances[Math.floor(0.8 * distances.length)] || 0);
  };
  const start = () => {
    fill();
    findWorkspace().then((found) => {
      workspace = found;
      tell();
    });
  };
  return { lines, dim, span, start };
}
