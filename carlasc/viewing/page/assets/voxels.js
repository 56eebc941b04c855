// The voxels of a grid as instances of one cell, which the vertex shader bends into a wedge in cylindrical grids.
//
// The axes of the scene are right-handed: x to the right, y up, z backwards. CarlaSC's axes are left-handed (x forward, y right, z up), so
// axes only change their names (`side` is +1); in right-handed data (y left) y changes its sign too (`side` is -1).

const WIDEST_ARC = (4 * Math.PI) / 180; // wider cells are drawn in several flat pieces

const GRID_GLSL = /* glsl */ `
  uniform vec3 lower;    // lower bounds on the grid's axes
  uniform vec3 voxel;    // size of a cell
  uniform vec3 dims;     // number of cells along each axis
  uniform bool cylindrical;
  uniform float side;
  vec3 toScene(vec3 axes) {
    vec3 p = cylindrical ? vec3(axes.x * cos(axes.y), axes.x * sin(axes.y), axes.z) : axes;
    return vec3(side * p.y, p.z, -p.x);
  }
  vec3 toCells(vec3 p) {
    vec3 axes = vec3(-p.z, side * p.x, p.y);
    if (cylindrical) axes = vec3(length(axes.xy), atan(axes.y, axes.x), axes.z);
    if (cylindrical && axes.y < lower.y) axes.y += 6.2831853;
    return (axes - lower) / voxel;
  }`;

const VOXEL_VERTEX = /* glsl */ `
  precision highp sampler2D;
  precision highp sampler3D;
  uniform sampler3D occupancy; // of the voxels that are shown; its axes are z, y, x
  uniform bool closed;         // the azimuth covers a full turn
  attribute vec3 cell;
  attribute float label;
  attribute float value;   // 0..1 on the ramp
  uniform sampler2D palette; // colour and visibility of each class
  uniform sampler2D ramp;
  uniform bool byRamp;
  uniform float picked;
  varying vec3 vColor;
  varying vec3 vWithin;
  varying vec3 vFace;
  varying vec3 vNormal;
  varying vec3 vScene;
  flat varying float vPicked;
  flat varying int vInstance;
  ${GRID_GLSL}
  bool covered() { // whether a neighbour that is shown covers the face, which would otherwise be visible at its edges
    vec3 beside = cell + normal;
    if (closed) beside.y = mod(beside.y, dims.y);
    if (any(lessThan(beside, vec3(0.0))) || any(greaterThanEqual(beside, dims))) return false;
    return texelFetch(occupancy, ivec3(beside.zyx), 0).r > 0.5;
  }
  void main() {
    vec4 entry = texelFetch(palette, ivec2(int(label + 0.5), 0), 0);
    vec3 axes = lower + (cell + position) * voxel;
    vec3 flatNormal = normal;
    if (cylindrical) {
      float middle = axes.y;
      flatNormal = vec3(normal.x * cos(middle) - normal.y * sin(middle), normal.x * sin(middle) + normal.y * cos(middle), normal.z);
    }
    vNormal = vec3(side * flatNormal.y, flatNormal.z, -flatNormal.x);
    vScene = toScene(axes);
    vColor = byRamp ? texture(ramp, vec2(value, 0.5)).rgb : entry.rgb;
    vWithin = position;
    vFace = normal;
    vInstance = gl_InstanceID;
    vPicked = abs(picked - float(gl_InstanceID)) < 0.5 ? 1.0 : 0.0;
    gl_Position = entry.a < 0.5 || covered() ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * viewMatrix * vec4(vScene, 1.0);
  }`;

const VOXEL_FRAGMENT = /* glsl */ `
  precision highp sampler3D;
  uniform sampler3D occupancy;
  uniform bool closed;
  uniform vec3 sun;
  uniform bool shadows;
  varying vec3 vColor;
  varying vec3 vWithin;
  varying vec3 vFace;
  varying vec3 vNormal;
  varying vec3 vScene;
  flat varying float vPicked;
  flat varying int vInstance;
  ${GRID_GLSL}
  float solid(vec3 cells) {
    if (closed) cells.y = mod(cells.y, dims.y);
    if (any(lessThan(cells, vec3(0.0))) || any(greaterThan(cells, dims))) return 0.0;
    return texture(occupancy, (cells / dims).zyx).r;
  }
  void main() {
    vec3 normal = normalize(vNormal);
    float reach = min(min(voxel.x, cylindrical ? voxel.x : voxel.y), voxel.z);
    vec3 foot = vScene + normal * reach * 0.5;
    float near = solid(toCells(vScene + normal * reach * 0.55));
    float far = solid(toCells(vScene + normal * reach * 1.3));
    float open = 1.0 - 0.42 * near - 0.22 * far;

    float lit = max(dot(normal, sun), 0.0);
    float shadow = 0.0;
    if (shadows && lit > 0.0) {
      for (int i = 1; i <= 14; i++) shadow = max(shadow, solid(toCells(foot + sun * (reach * 0.75 * float(i)))));
    }
    lit *= 1.0 - smoothstep(0.35, 0.8, shadow);
    float level = sun.y; // a level face in the sun has exactly the colour of the legend
    vec3 color = vColor * open * (0.58 + 0.42 * min(lit / level, 1.25));

    vec3 step = max(fwidth(vWithin), 1e-5);
    vec3 away = min(vWithin, 1.0 - vWithin) / step + abs(vFace) * 1e6; // distance in pixels to the four edges of the face
    float edge = min(away.x, min(away.y, away.z));
    vec3 fine = clamp((1.0 / step - 3.0) / 6.0, 0.0, 1.0); // no lines where they would be only a few pixels apart, which flickers
    vec3 lines = fine * (1.0 - smoothstep(0.3, 1.3, away));
    color *= 1.0 - 0.22 * max(lines.x, max(lines.y, lines.z));
    if (vPicked > 0.5) color = mix(color, vec3(1.0, 0.62, 0.1), 0.35 + 0.65 * (1.0 - smoothstep(1.0, 2.5, edge)));
    gl_FragColor = vec4(color, 1.0);
  }`;

const PICK_FRAGMENT = /* glsl */ `
  flat varying int vInstance;
  void main() {
    int id = vInstance + 1;
    gl_FragColor = vec4(float(id & 255), float((id >> 8) & 255), float((id >> 16) & 255), 255.0) / 255.0;
  }`;

/** Returns a texture of colours ("#rrggbb"), one texel each, all visible. */
function colorTexture(colors, filter) {
  const texels = new Uint8Array(4 * colors.length);
  colors.forEach((color, i) => texels.set([1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16)).concat(255), 4 * i));
  const texture = new THREE.DataTexture(texels, colors.length, 1, THREE.RGBAFormat, THREE.UnsignedByteType);
  texture.minFilter = texture.magFilter = filter;
  texture.needsUpdate = true;
  return texture;
}

/** Draws the voxels of one panel. Classes can be hidden, and a voxel can be marked. */
class VoxelLayer {
  constructor(panel, side, palette, sun) {
    this.panel = panel;
    this.mode = MODES.class;
    this.most = 0;
    const [nx, ny, nz] = panel.size;
    const cylindrical = panel.coordinates === 'cylindrical';
    this.closed = cylindrical && panel.upper[1] - panel.lower[1] > 2 * Math.PI - 1e-3;
    const pieces = cylindrical ? Math.ceil(panel.voxel[1] / WIDEST_ARC) : 1;
    this.box = new THREE.BoxGeometry(1, 1, 1, 1, pieces, 1).translate(0.5, 0.5, 0.5);
    this.texels = new Uint8Array(nx * ny * nz);
    this.occupancy = new THREE.Data3DTexture(this.texels, nz, ny, nx);
    this.occupancy.format = THREE.RedFormat;
    this.occupancy.unpackAlignment = 1;
    this.occupancy.minFilter = this.occupancy.magFilter = THREE.LinearFilter;
    if (this.closed) this.occupancy.wrapT = THREE.RepeatWrapping;
    const uniforms = {
      lower: { value: new THREE.Vector3(...panel.lower) },
      voxel: { value: new THREE.Vector3(...panel.voxel) },
      dims: { value: new THREE.Vector3(...panel.size) },
      cylindrical: { value: cylindrical },
      closed: { value: this.closed },
      side: { value: side },
      palette: { value: palette },
      ramp: { value: rampOf(MODES.height) },
      byRamp: { value: false },
      occupancy: { value: this.occupancy },
      sun: { value: sun },
      shadows: { value: true },
      picked: { value: -1 },
    };
    // with left-handed data the change of axes mirrors the box, so that its faces are seen from the inside
    const face = side > 0 ? THREE.BackSide : THREE.FrontSide;
    this.material = new THREE.ShaderMaterial({ uniforms, vertexShader: VOXEL_VERTEX, fragmentShader: VOXEL_FRAGMENT, side: face });
    this.pickMaterial = new THREE.ShaderMaterial({ uniforms, vertexShader: VOXEL_VERTEX, fragmentShader: PICK_FRAGMENT, side: face });
    this.mesh = new THREE.Mesh(new THREE.InstancedBufferGeometry(), this.material);
    this.mesh.frustumCulled = false;
    this.grid = null;
    this.drawn = new Uint32Array(0);
  }

  /** Sets the voxels of a frame. */
  set(grid, most) {
    this.most = most;
    if (this.grid !== grid) {
      this.grid = grid;
      this.drawn = this.visible(grid);
    }
    this.build();
  }

  /** Returns the voxels that can be visible: one whose six neighbours have its own class never is, whichever classes are shown. */
  visible({ index, label, volume }) {
    const [nx, ny, nz] = this.panel.size;
    const rim = 0xffff; // outside the grid: no class
    const kept = [];
    for (let i = 0; i < index.length; i++) {
      const at = index[i];
      const z = at % nz;
      const y = Math.floor(at / nz) % ny;
      const x = Math.floor(at / (nz * ny));
      const own = label[i];
      const left = y > 0 ? volume[at - nz] : this.closed ? volume[at + nz * (ny - 1)] : rim;
      const right = y < ny - 1 ? volume[at + nz] : this.closed ? volume[at - nz * (ny - 1)] : rim;
      const buried =
        z > 0 && volume[at - 1] === own && z < nz - 1 && volume[at + 1] === own && left === own && right === own &&
        x > 0 && volume[at - nz * ny] === own && x < nx - 1 && volume[at + nz * ny] === own;
      if (!buried) kept.push(i);
    }
    return Uint32Array.from(kept);
  }

  build() {
    const { index, label } = this.grid;
    const [, ny, nz] = this.panel.size;
    const count = this.drawn.length;
    const cells = new Uint16Array(3 * count);
    const labels = new Uint16Array(count);
    for (let k = 0; k < count; k++) {
      const at = index[this.drawn[k]];
      cells[3 * k] = Math.floor(at / (nz * ny));
      cells[3 * k + 1] = Math.floor(at / nz) % ny;
      cells[3 * k + 2] = at % nz;
      labels[k] = label[this.drawn[k]];
    }
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.index = this.box.index;
    geometry.setAttribute('position', this.box.getAttribute('position'));
    geometry.setAttribute('normal', this.box.getAttribute('normal'));
    geometry.setAttribute('cell', new THREE.InstancedBufferAttribute(cells, 3));
    geometry.setAttribute('label', new THREE.InstancedBufferAttribute(labels, 1));
    const values = this.mode.values(this.grid, this.drawn, this.panel, this.most);
    const uniforms = this.material.uniforms;
    uniforms.byRamp.value = values !== null;
    if (values) uniforms.ramp.value = rampOf(this.mode);
    geometry.setAttribute('value', new THREE.InstancedBufferAttribute(values ?? new Uint8Array(count), 1, true));
    geometry.instanceCount = count;
    this.mesh.geometry.dispose();
    this.mesh.geometry = geometry;
    uniforms.picked.value = -1;
    this.shade();
  }

  /** Colours the voxels in one of the MODES; `most` is the largest value of the mode in any panel. */
  colorAs(mode, most) {
    this.mode = mode;
    this.most = most;
    if (this.grid) this.build();
  }

  /** Gives the shader the voxels of the classes that are shown: these cast shadows. */
  shade() {
    const shown = this.material.uniforms.palette.value.image.data;
    const { index, label } = this.grid;
    this.texels.fill(0);
    for (let i = 0; i < index.length; i++) if (shown[4 * label[i] + 3]) this.texels[index[i]] = 255;
    this.occupancy.needsUpdate = true;
  }
}
