// The page's 3D view, on three.js (global THREE): the mesh with its texture or a measure per vertex in colours, the
// cameras as pyramids, sparse and dense points, ground, region, and the next photos to take; the mesh in a light from all
// around, and what the material is; Gaussian splats in place of the mesh. Drawn when something changes only.
(function () {
  "use strict";
  const canvas = document.getElementById("viewer");
  const source = document.getElementById("view-data");
  if (!canvas || !source) return;
  const element = (id) => document.getElementById(id);
  const data = JSON.parse(source.textContent);
  const style = getComputedStyle(document.documentElement);
  const paint = (name) => new THREE.Color(style.getPropertyValue(name).trim());

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    document.documentElement.dataset.viewer = "none";
    element("view-missing").hidden = false;
    element("view").hidden = true;
    return;
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  element("view-controls").hidden = false;

  let waiting = true; // until the texture is there

  // ---------------------------------------------------------------- unpacking
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const positions = (packed) => {
    const fixed = new Uint16Array(bytes(packed.positions));
    return Float32Array.from(fixed, (v, i) => packed.low[i % 3] + (v / 65535) * packed.size[i % 3]);
  };
  const lines = (numbers, color) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(numbers), 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color, toneMapped: false }));
  };

  // ---------------------------------------------------------------- the mesh and its measures
  const scene = new THREE.Scene();
  const eye = new THREE.PerspectiveCamera(40, 1);
  const sparse = data.points ? positions(data.points) : [];
  const cloud = { positions: sparse, each: data.points_each, total: data.points_total };
  const region = addRegion({ given: data.region, cloud, scene, eye, canvas, paint, redraw, home: () => home() });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions(data), 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(new Uint16Array(bytes(data.uvs)), 2, true));
  geometry.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(bytes(data.normals)), 3, true));
  const Index = data.face_bits === 16 ? Uint16Array : Uint32Array;
  geometry.setIndex(new THREE.BufferAttribute(new Index(bytes(data.faces)), 1));
  const count = geometry.getAttribute("position").count;
  const colors = new THREE.BufferAttribute(new Float32Array(3 * count), 3);
  geometry.setAttribute("color", colors);
  const image = (colorSpace) => {
    const made = new THREE.Texture();
    Object.assign(made, { colorSpace, flipY: false, anisotropy: Math.min(4, renderer.capabilities.getMaxAnisotropy()) });
    return made;
  };
  const load = (into, source, show = (picture) => picture) => {
    const picture = new Image();
    picture.src = source;
    return picture.decode().then(() => {
      into.image = show(picture);
      into.needsUpdate = true;
    });
  };
  const texture = image(THREE.SRGBColorSpace);
  const side = THREE.DoubleSide;
  const materials = {
    texture: new THREE.MeshBasicMaterial({ map: texture, side }),
    shaded: new THREE.MeshLambertMaterial({ map: texture, side }),
    shape: new THREE.MeshLambertMaterial({ color: "#c8c8c8", side }),
    measure: new THREE.MeshLambertMaterial({ vertexColors: true, side }),
    lit: new THREE.MeshStandardMaterial({ map: texture, roughness: data.roughness, metalness: 0, side }),
  };
  const basic = ["color", "roughness", "metalness"];
  if (data.material) {
    for (const what of basic) materials[what] = new THREE.MeshBasicMaterial({ map: image(THREE.SRGBColorSpace), side });
    const packed = image(THREE.NoColorSpace);
    const maps = { map: materials.color.map, aoMap: packed, roughnessMap: packed, metalnessMap: packed };
    Object.assign(materials.lit, maps, { roughness: 1, metalness: 1 });
  }
  for (const what of basic) if (materials[what]) materials[what].toneMapped = false;
  Object.values(materials).forEach(region.dim);
  const mesh = new THREE.Mesh(geometry, materials.texture);
  scene.add(mesh);
  const splats = data.splats && addSplats({ packed: data.splats.spz, scene, renderer, redraw });

  // ---------------------------------------------------------------- light from all around, and the material's images
  const surroundings = {};
  const surround = (light) => {
    if (surroundings[light.key]) return surroundings[light.key];
    const pixels = new Uint16Array(bytes(light.pixels));
    const map = new THREE.DataTexture(pixels, light.width, light.width / 2, THREE.RGBAFormat, THREE.HalfFloatType);
    map.mapping = THREE.EquirectangularReflectionMapping;
    map.magFilter = map.minFilter = THREE.LinearFilter;
    map.needsUpdate = true;
    const sky = new THREE.Scene();
    sky.background = map;
    const blur = new THREE.PMREMGenerator(renderer);
    const blurred = blur.fromScene(sky).texture; // at more pixels than the map has, or rough surfaces show its corners
    blur.dispose();
    return (surroundings[light.key] = blurred);
  };
  const inLight = (light) => {
    lamp.visible = ambient.visible = !light;
    renderer.toneMapping = light ? THREE.NeutralToneMapping : THREE.NoToneMapping;
    element("light-controls").hidden = element("light-note").hidden = !light;
    if (!light) return;
    const turn = Number(element("light-turn").value);
    element("light-degrees").textContent = `${turn}°`;
    if (materials.lit.envMap !== surround(light)) materials.lit.needsUpdate = true;
    materials.lit.envMap = surround(light);
    // the map's angles grow from +X to +Z, which is a negative turn about +Y
    materials.lit.envMapRotation.y = (-(light.turn + turn) * Math.PI) / 180;
  };
  let told = null;
  const showMaterial = () => {
    if (!data.material || told) return told;
    const channel = (index) => (picture) => {
      const drawing = Object.assign(document.createElement("canvas"), { width: picture.width, height: picture.height });
      const pen = drawing.getContext("2d");
      pen.drawImage(picture, 0, 0);
      const grey = pen.getImageData(0, 0, drawing.width, drawing.height);
      for (let i = 0; i < grey.data.length; i += 4) grey.data.fill(grey.data[i + index], i, i + 3);
      pen.putImageData(grey, 0, 0);
      return drawing;
    };
    told = Promise.all([
      load(materials.color.map, data.material.color),
      load(materials.lit.roughnessMap, data.material.orm),
      load(materials.roughness.map, data.material.orm, channel(1)),
      load(materials.metalness.map, data.material.orm, channel(2)),
    ]).then(redraw);
    return told;
  };

  // Viridis (Smith and van der Walt, 2015): even steps to the eye, and to those who confuse red and green.
  const ramp = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"].map((c) => new THREE.Color(c));
  const unknown = new THREE.Color("#9a9a9a");
  const palette = Array.from({ length: 256 }, (_, i) => {
    if (i === 255) return unknown;
    const place = (i / 254) * (ramp.length - 1);
    const below = Math.min(Math.floor(place), ramp.length - 2);
    return ramp[below].clone().lerp(ramp[below + 1], place - below);
  });
  const show = (what) => {
    const overlay = data.overlays.find((each) => each.key === what);
    const light = data.lights.find((each) => each.key === what);
    const asSplats = Boolean(splats) && what === "splats";
    if (splats) splats.show(asSplats);
    mesh.visible = what !== "none" && !asSplats;
    mesh.material = overlay ? materials.measure : light ? materials.lit : materials[what] || materials.texture;
    inLight(light);
    if (light || basic.includes(what)) showMaterial();
    const legend = element("view-legend");
    legend.hidden = !overlay;
    if (overlay) {
      new Uint8Array(bytes(overlay.values)).forEach((v, i) => palette[v].toArray(colors.array, 3 * i));
      colors.needsUpdate = true;
      element("legend-label").textContent = overlay.label;
      element("legend-low").textContent = String(overlay.low);
      element("legend-high").textContent = overlay.high + (overlay.key === "invented" ? "" : " and more");
      element("legend-missing").hidden = !overlay.missing;
      element("legend-missing-label").textContent = overlay.missing;
    }
    element("surface").value = overlay || light || materials[what] || !mesh.visible ? what : "texture";
    redraw();
  };

  // ---------------------------------------------------------------- what stands around it
  const pyramid = ({ apex, corners }) => {
    const c = [0, 3, 6, 9].map((i) => corners.slice(i, i + 3));
    return [0, 1, 2, 3].flatMap((i) => [...apex, ...c[i], ...c[i], ...c[(i + 1) % 4]]);
  };
  const dots = (how) =>
    region.dim(new THREE.PointsMaterial({ ...how, size: 2, sizeAttenuation: false, toneMapped: false }));
  const used = data.cameras.filter((camera) => !camera.held_out);
  const layers = {
    cameras: lines(used.flatMap(pyramid), paint("--camera")),
    held: lines(data.cameras.filter((camera) => camera.held_out).flatMap(pyramid), paint("--held")),
    next: lines(data.next.flatMap(pyramid), paint("--next")),
    region: region.lines,
    ground: lines(data.ground || [], paint("--ground")),
    points: new THREE.Points(
      new THREE.BufferGeometry(),
      dots({ color: paint("--point") }),
    ),
  };
  layers.points.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(sparse), 3));
  if (data.dense) {
    const painted = new Float32Array(3 * data.dense.shown);
    const color = new THREE.Color();
    const shades = new Uint8Array(bytes(data.dense.colors));
    for (let i = 0; i < painted.length; i += 3) {
      const [r, g, b] = shades.subarray(i, i + 3);
      color.setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace).toArray(painted, i);
    }
    const material = dots({ vertexColors: true });
    layers.dense = new THREE.Points(new THREE.BufferGeometry(), material);
    layers.dense.geometry.setAttribute("position", new THREE.BufferAttribute(positions(data.dense), 3));
    layers.dense.geometry.setAttribute("color", new THREE.BufferAttribute(painted, 3));
  }
  scene.add(...Object.values(layers));
  const chosen = lines(new Array(48).fill(0), paint("--ink"));
  chosen.visible = false;
  chosen.frustumCulled = false;
  scene.add(chosen);

  // ---------------------------------------------------------------- the eye
  const middle = new THREE.Vector3(...data.low.map((v, i) => v + data.size[i] / 2));
  const radius = Math.hypot(...data.size) / 2 || 1;
  [eye.near, eye.far] = [radius * 0.01, radius * 100];
  const lamp = new THREE.DirectionalLight("#fff", 0.65 * Math.PI);
  eye.add(lamp);
  const ambient = new THREE.AmbientLight("#fff", 0.35 * Math.PI);
  scene.add(eye, ambient);
  const controls = new THREE.OrbitControls(eye, canvas);
  controls.minDistance = radius * 0.1;
  controls.maxDistance = radius * 30;
  // From the side that most photos are on; where they are all around, from any.
  const ahead = data.cameras
    .reduce((sum, { apex }) => sum.add(new THREE.Vector3(...apex).sub(middle).setY(0).normalize()), new THREE.Vector3())
    .divideScalar(data.cameras.length || 1);
  const start = ahead.length() > 0.5 ? ahead.setLength(0.94).setY(0.34) : new THREE.Vector3(0.53, 0.34, 0.78);
  const home = () => {
    const narrow = Math.max(1, canvas.clientHeight / Math.max(canvas.clientWidth, 1));
    controls.target.copy(middle);
    eye.position.copy(start).multiplyScalar(Math.max(radius, region.span(middle)) * 2.6 * narrow).add(middle);
    controls.update();
    redraw();
  };

  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }
  function draw() {
    waiting = false;
    renderer.render(scene, eye);
  }
  const fit = () => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    renderer.setSize(width, height, false);
    eye.aspect = width / height;
    eye.updateProjectionMatrix();
    redraw();
  };

  // ---------------------------------------------------------------- choosing a camera
  const markers = [
    ...data.cameras.map((camera, i) => ({ ...camera, key: `camera-${i}`, layer: camera.held_out ? "held" : "cameras" })),
    ...data.next.map((view, i) => ({ ...view, key: `next-${i}`, layer: "next", name: `Next photo ${i + 1}` })),
  ];
  let current = null;
  const describe = (marker) => {
    if (marker.sentence) return marker.sentence;
    const fit = marker.error === null ? "" : `reprojection error ${marker.error.toFixed(2)} px, ${marker.points} points`;
    const explained = marker.explained === null ? "" : `stereo explains ${(100 * marker.explained).toFixed(0)} %`;
    return [marker.held_out ? "held out from training and texture" : "used", fit, explained].filter(Boolean).join("; ");
  };
  const choose = (key) => {
    current = markers.find((marker) => marker.key === key) || null;
    element("view-card").hidden = !current;
    element("pick").value = current ? key : "";
    chosen.visible = Boolean(current);
    if (current) {
      chosen.geometry.getAttribute("position").set(pyramid(current));
      chosen.geometry.getAttribute("position").needsUpdate = true;
      element("card-name").textContent = current.name;
      element("card-text").textContent = describe(current);
      const picture = document.querySelector(`[data-key="${key}"] img`);
      element("card-picture").hidden = !picture;
      if (picture) element("card-picture").src = picture.src;
    }
    redraw();
  };
  const lookFrom = (marker) => {
    const apex = new THREE.Vector3(...marker.apex);
    const end = new THREE.Vector3();
    for (let i = 0; i < 12; i++) end.setComponent(i % 3, end.getComponent(i % 3) + marker.corners[i] / 4);
    const ahead = end.sub(apex).normalize();
    eye.position.copy(apex);
    controls.target.copy(apex).addScaledVector(ahead, Math.max(middle.clone().sub(apex).dot(ahead), radius * 0.2));
    controls.update();
    redraw();
  };
  const nearest = (event) => {
    const box = canvas.getBoundingClientRect();
    let [best, found] = [18, null];
    for (const marker of markers) {
      if (!layers[marker.layer].visible) continue;
      const place = new THREE.Vector3(...marker.apex).project(eye);
      if (place.z > 1) continue;
      const x = box.left + ((place.x + 1) / 2) * box.width - event.clientX;
      const y = box.top + ((1 - place.y) / 2) * box.height - event.clientY;
      if (Math.hypot(x, y) < best) [best, found] = [Math.hypot(x, y), marker];
    }
    return found;
  };

  // ---------------------------------------------------------------- controls
  for (const marker of markers) element("pick").add(new Option(marker.name, marker.key));
  element("pick").addEventListener("change", (e) => choose(e.target.value));
  element("card-close").addEventListener("click", () => choose(""));
  element("card-look").addEventListener("click", () => lookFrom(current));
  element("surface").addEventListener("change", (e) => show(e.target.value));
  element("light-turn").addEventListener("input", () => show(element("surface").value));
  element("view-home").addEventListener("click", home);
  document.querySelectorAll("[data-layer]").forEach((box) => {
    const sync = () => {
      layers[box.dataset.layer].visible = box.checked;
      if (box.dataset.layer === "cameras") layers.held.visible = box.checked;
      redraw();
    };
    box.addEventListener("change", sync);
    sync();
  });
  document.querySelectorAll("[data-show]").forEach((button) => {
    button.hidden = false;
    button.addEventListener("click", () => {
      choose(button.dataset.show);
      if (current.layer === "next") lookFrom(current);
      canvas.scrollIntoView({ block: "center" });
    });
  });
  let pressed = null;
  canvas.addEventListener("pointerdown", (e) => (pressed = e));
  canvas.addEventListener("pointerup", (e) => {
    const still = pressed && Math.hypot(e.clientX - pressed.clientX, e.clientY - pressed.clientY) < 5;
    const marker = still && nearest(e);
    if (marker) choose(marker.key);
  });
  canvas.addEventListener("dblclick", home);
  canvas.addEventListener("keydown", (e) => {
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
    const zoom = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[e.key];
    if (!turn && !zoom && e.key !== "Home" && e.key !== "0") return;
    e.preventDefault();
    if (!turn && !zoom) return home();
    const place = new THREE.Spherical().setFromVector3(eye.position.clone().sub(controls.target));
    if (turn) [place.theta, place.phi] = [place.theta + turn[0], place.phi + turn[1]];
    if (zoom) place.radius *= zoom;
    eye.position.setFromSpherical(place.makeSafe()).add(controls.target);
    controls.update();
  });
  controls.addEventListener("change", redraw);
  new ResizeObserver(fit).observe(canvas);

  fit();
  home();
  region.start();
  // report.html#show=seen&pick=camera-3 opens with that surface and that camera, #show=studio&turn=90 in a light that is
  // turned, #edit=region with the region's numbers
  const asked = new URLSearchParams(location.hash.slice(1));
  if (asked.get("edit") === "region") element("region-toggle").click();
  element("light-turn").value = asked.get("turn") || "0";
  show(asked.get("show") || "texture");
  choose(asked.get("pick") || "");
  Promise.all([load(texture, data.texture), told, splats && splats.ready()]).then(() => {
    draw();
    document.documentElement.dataset.viewer = "ready";
  });
})();
