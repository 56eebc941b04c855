// Panels side by side on one canvas, all seen by the same camera. Two runs share a panel, on both sides of a divider.

const SUN = [-0.5, 0.78, 0.38];

class Panels {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.description = scene;
    this.side = scene.leftHanded ? 1 : -1;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, powerPreference: 'high-performance' });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.autoClear = false;
    this.palettes = Object.fromEntries(
      Object.entries(scene.tables).map(([name, classes]) => [name, colorTexture(classes.map(([, color]) => color), THREE.NearestFilter)]),
    );
    const first = scene.panels[0];
    const heights = first ? [first.lower[2], first.upper[2]] : [-2, 3];
    this.sun = new THREE.Vector3(...SUN).normalize();
    this.mode = MODES.class;
    this.most = 0;
    this.share = 0.5; // of the width of a panel with two runs, for the first
    this.path = new PathLayer();
    this.actorBoxes = new LineLayer(this.side, '#15171b');
    this.tracks = new LineLayer(this.side, '#c2410c');
    this.frustums = new LineLayer(this.side, '#2563eb');
    this.scan = new ScanLayer(this.side, this.palettes[scene.pointTable], heights, first);
    this.panels = (scene.panels.length ? scene.panels : [null]).map((panel) => this.makePanel(panel));
    for (const panel of this.panels) {
      panel.right = this.panels[panel.panel?.beside ?? -1] ?? null;
      if (panel.right) panel.right.isRight = true;
    }
    this.round = first?.coordinates === 'cylindrical';
    this.radius = this.round ? first.upper[0] : 30;
    this.target = new THREE.Vector3(0, -1.5, 0);
    if (first && !this.round) {
      this.target.set((this.side * (first.lower[1] + first.upper[1])) / 2, -1.5, -(first.lower[0] + first.upper[0]) / 2);
      this.radius = Math.max(first.upper[0] - first.lower[0], first.upper[1] - first.lower[1]) / 2;
    }
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.3, 2000);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.maxPolarAngle = Math.PI * 0.495;
    this.controls.addEventListener('change', () => this.invalidate());
    this.setShadows(!this.isSoftware());
    this.pickTarget = new THREE.WebGLRenderTarget(1, 1);
    this.changed = true;
  }

  makePanel(panel) {
    const scene = new THREE.Scene();
    const layer = panel && new VoxelLayer(panel, this.side, this.palettes[panel.table], this.sun);
    const vehicle = egoVehicle();
    if (layer) scene.add(layer.mesh, outline(panel, this.side));
    const path = this.path.object();
    scene.add(vehicle, path, this.actorBoxes.object(), this.tracks.object(), this.frustums.object(), ...this.scan.objects());
    return { panel, scene, layer, vehicle, path, shown: true };
  }

  /** The panels that have a rectangle of their own and are shown. */
  get shown() {
    return this.panels.filter((panel) => panel.shown && !panel.isRight);
  }

  setFrame({ grids, scan, arrows, boxes, tracks, cameras }) {
    this.most = Math.max(0, ...grids.map((grid) => this.mode.most(grid)));
    this.panels.forEach(({ layer }, number) => layer && layer.set(grids[number], this.most));
    this.scan.set(scan, arrows);
    this.actorBoxes.set(boxes);
    this.tracks.set(tracks);
    this.frustums.set(cameras);
    this.invalidate();
  }

  setPath(points, position) {
    this.path.set(points, position);
    this.invalidate();
  }

  setVisible(what, visible) {
    for (const { layer, vehicle, path } of this.panels) {
      if (what === 'grid' && layer) layer.mesh.visible = visible;
      if (what === 'path') path.visible = visible;
      if (what === 'vehicle') vehicle.visible = visible;
    }
    const objects = { points: this.scan.points, flow: this.scan.arrows, boxes: this.actorBoxes.lines, tracks: this.tracks.lines, cameras: this.frustums.lines }[what] ?? [];
    for (const object of objects) object.visible = visible;
    this.scan.thinArrows();
    this.invalidate();
  }

  setClass(table, id, visible) {
    const palette = this.palettes[table];
    palette.image.data[4 * id + 3] = visible ? 255 : 0;
    palette.needsUpdate = true;
    for (const { panel, layer } of this.panels) if (layer?.grid && panel.table === table) layer.shade();
    this.invalidate();
  }

  /** Colours the voxels in one of the MODES. */
  colorBy(mode) {
    this.mode = mode;
    this.most = Math.max(0, ...this.panels.map(({ layer }) => (layer?.grid ? mode.most(layer.grid) : 0)));
    for (const { layer } of this.panels) if (layer) layer.colorAs(mode, this.most);
    this.scan.uniforms.byHeight.value = mode === MODES.height;
    this.invalidate();
  }

  setBackground(color, ink) {
    this.renderer.setClearColor(new THREE.Color(color), 1);
    this.scan.arrowMaterial.color.set(ink);
    this.actorBoxes.material.color.set(ink);
    this.invalidate();
  }

  /** Sets the view from behind and above, or from straight above, so that the grid just fits into a panel. */
  setView(view) {
    const box = this.boxes()[0];
    this.camera.aspect = box.width / box.height;
    this.camera.updateProjectionMatrix();
    const elevation = view === 'top' ? Math.PI / 2 - 1e-4 : 0.66;
    const back = new THREE.Vector3(0, Math.sin(elevation), Math.cos(elevation));
    const target = this.target.clone();
    let distance = 2 * this.radius;
    for (let i = 0; i < 30; i++) { // changes the distance and the target until the corners touch the margins
      this.camera.position.copy(target).addScaledVector(back, distance);
      this.camera.lookAt(target);
      this.camera.updateMatrixWorld();
      const seen = this.corners().map((corner) => corner.project(this.camera));
      const [low, high] = [Math.min(...seen.map((p) => p.y)), Math.max(...seen.map((p) => p.y))];
      const wide = Math.max(...seen.map((p) => Math.abs(p.x)));
      target.z -= 0.25 * (high + low) * distance * Math.tan((this.camera.fov * Math.PI) / 360);
      distance *= 0.5 + 0.5 * Math.max(wide / 0.94, (high - low) / 2 / 0.86);
    }
    this.sun.set(...SUN).normalize();
    this.controls.target.copy(target);
    this.controls.update();
    this.invalidate();
  }

  /** Turns the camera, what it looks at, and the sun about the vehicle: the world then stays where it is while the vehicle turns. */
  turnWorld(angle) {
    const up = new THREE.Vector3(0, 1, 0);
    for (const vector of [this.camera.position, this.controls.target, this.sun]) vector.applyAxisAngle(up, angle);
    this.controls.update();
    this.invalidate();
  }

  /** Turns the camera around what it looks at, and up or down, radians. */
  turn(around, up) {
    const from = this.camera.position.clone().sub(this.controls.target);
    const elevation = Math.asin(from.y / from.length());
    const lift = Math.min(Math.max(elevation + up, 0.02), Math.PI / 2 - 1e-4) - elevation;
    const sideways = new THREE.Vector3(from.z, 0, -from.x).normalize();
    from.applyAxisAngle(sideways, -lift).applyAxisAngle(new THREE.Vector3(0, 1, 0), around);
    this.camera.position.copy(this.controls.target).add(from);
    this.controls.update();
  }

  /** Changes the distance of the camera from what it looks at. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }

  /** Returns the corners of the floor and of the ceiling of the grid. */
  corners() {
    const { x, z } = this.target;
    const around = this.round ? Array.from({ length: 24 }, (_, i) => (i * Math.PI) / 12) : [1, 3, 5, 7].map((i) => (i * Math.PI) / 4);
    const reach = this.round ? this.radius : this.radius * Math.SQRT2;
    return around.flatMap((angle) => [-2, 1].map((y) => new THREE.Vector3(x + reach * Math.sin(angle), y, z - reach * Math.cos(angle))));
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.invalidate();
  }

  /** Returns the rectangles of the panels that are shown, in CSS pixels from the top left. */
  boxes() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const shown = this.shown;
    const upright = clientHeight > clientWidth * 1.15; // narrow screens: one panel above the other
    return shown.map((panel, i) => {
      const [from, to] = [i / shown.length, (i + 1) / shown.length];
      return upright
        ? { panel, x: 0, y: Math.round(from * clientHeight), width: clientWidth, height: Math.round(to * clientHeight) - Math.round(from * clientHeight) }
        : { panel, x: Math.round(from * clientWidth), y: 0, width: Math.round(to * clientWidth) - Math.round(from * clientWidth), height: clientHeight };
    });
  }

  invalidate() {
    this.changed = true;
  }

  draw() {
    if (!this.changed) return;
    this.changed = false;
    const total = this.canvas.parentElement.clientHeight;
    this.renderer.setScissorTest(true);
    for (const { panel, x, y, width, height } of this.boxes()) {
      this.renderer.setViewport(x, total - y - height, width, height);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
      this.scan.uniforms.scale.value = (0.1 * height * this.renderer.getPixelRatio()) / Math.tan((this.camera.fov * Math.PI) / 360);
      const left = panel.right ? Math.round(this.share * width) : width;
      this.drawPart(panel, x, total - y - height, left, height);
      if (panel.right) this.drawPart(panel.right, x + left, total - y - height, width - left, height);
    }
  }

  /** Draws the part of a panel in a rectangle of the canvas, in CSS pixels from the bottom left. */
  drawPart({ scene }, x, y, width, height) {
    if (width <= 0) return;
    this.renderer.setScissor(x, y, width, height);
    this.renderer.clear();
    this.renderer.render(scene, this.camera);
  }

  /** Returns whether pictures are computed without a GPU: shadows would then take seconds. */
  isSoftware() {
    const gl = this.renderer.getContext();
    const names = gl.getExtension('WEBGL_debug_renderer_info');
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  }

  setShadows(on) {
    for (const { layer } of this.panels) if (layer) layer.material.uniforms.shadows.value = on;
    this.invalidate();
  }

  /** Returns the voxel at a position on the canvas: draws that pixel with the numbers of the voxels as colours. */
  pick(x, y) {
    const box = this.boxes().find((b) => x >= b.x && x < b.x + b.width && y >= b.y && y < b.y + b.height);
    const panel = box?.panel.right && x - box.x >= this.share * box.width ? box.panel.right : box?.panel;
    const layer = panel?.layer;
    if (!layer?.grid || !layer.mesh.visible) return null;
    this.camera.aspect = box.width / box.height;
    this.camera.setViewOffset(box.width, box.height, x - box.x, y - box.y, 1, 1);
    const others = panel.scene.children.filter((child) => child !== layer.mesh && child.visible);
    for (const child of others) child.visible = false;
    layer.mesh.material = layer.pickMaterial;
    const background = this.renderer.getClearColor(new THREE.Color());
    this.renderer.setClearColor(0, 0);
    this.renderer.setScissorTest(false);
    this.renderer.setRenderTarget(this.pickTarget);
    this.renderer.clear();
    this.renderer.render(panel.scene, this.camera);
    const pixel = new Uint8Array(4);
    this.renderer.readRenderTargetPixels(this.pickTarget, 0, 0, 1, 1, pixel);
    this.renderer.setRenderTarget(null);
    this.renderer.setClearColor(background, 1);
    layer.mesh.material = layer.material;
    for (const child of others) child.visible = true;
    this.camera.clearViewOffset();
    const instance = pixel[0] + 256 * pixel[1] + 65536 * pixel[2] - 1;
    return instance < 0 || instance >= layer.drawn.length ? null : { panel, instance, index: layer.grid.index[layer.drawn[instance]] };
  }

  /** Marks a cell in every panel that draws it and has the same cells as the one that was picked; null marks no cell. */
  mark(index, picked) {
    for (const { panel, layer } of this.panels) {
      if (!layer?.grid) continue;
      const at = index === null || !sameCells(panel, picked.panel) ? -1 : layer.drawn.findIndex((i) => layer.grid.index[i] === index);
      layer.material.uniforms.picked.value = at;
    }
    this.invalidate();
  }
}

/** Returns whether the cells of two panels are the same. */
function sameCells(panel, other) {
  return ['size', 'lower', 'upper'].every((name) => panel[name].every((value, axis) => value === other[name][axis]));
}
