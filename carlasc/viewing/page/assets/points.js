// What is drawn besides voxels: points, arrows of moving actors, the ego vehicle, the outline of the grid.

const POINT_VERTEX = /* glsl */ `
  attribute float label;
  uniform sampler2D palette;
  uniform sampler2D ramp;
  uniform bool byHeight;
  uniform vec2 heights;
  uniform float scale;
  uniform float forward; // metres by which points are moved towards the camera, out of the voxels that contain them
  varying vec3 vColor;
  void main() {
    vec4 entry = texelFetch(palette, ivec2(int(label + 0.5), 0), 0);
    float height = clamp((position.y - heights.x) / (heights.y - heights.x), 0.0, 1.0);
    vColor = byHeight ? texture(ramp, vec2(height, 0.5)).rgb : entry.rgb;
    vec4 view = viewMatrix * vec4(position, 1.0);
    gl_PointSize = clamp(scale / -view.z, 1.5, 12.0);
    view.xyz *= 1.0 - min(forward / length(view.xyz), 0.5);
    gl_Position = entry.a < 0.5 ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * view;
  }`;

const POINT_FRAGMENT = /* glsl */ `
  varying vec3 vColor;
  void main() {
    vec2 place = 2.0 * gl_PointCoord - 1.0;
    float radius = dot(place, place);
    if (radius > 1.0) discard;
    gl_FragColor = vec4(vColor * (1.0 - 0.35 * smoothstep(0.45, 1.0, radius)), 1.0);
  }`;

/** The points and the arrows of a scan; all panels share one layer. */
class ScanLayer {
  constructor(side, palette, heights, panel) {
    this.side = side;
    this.panel = panel;
    const voxel = panel ? 1.2 * Math.max(panel.voxel[0], panel.voxel[2]) : 0;
    this.uniforms = {
      palette: { value: palette },
      ramp: { value: rampOf(MODES.height) },
      byHeight: { value: false },
      heights: { value: new THREE.Vector2(...heights) },
      scale: { value: 80 },
      forward: { value: voxel },
    };
    this.geometry = new THREE.BufferGeometry();
    this.material = new THREE.ShaderMaterial({ uniforms: this.uniforms, vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT });
    this.arrowMaterial = new THREE.MeshBasicMaterial({ color: '#15171b' });
    this.shaft = new THREE.CylinderGeometry(1, 1, 1, 10).translate(0, 0.5, 0);
    this.head = new THREE.ConeGeometry(1, 1, 14).translate(0, -0.5, 0);
    this.points = [];
    this.arrows = [];
  }

  /** Returns the objects for the scene of a panel. */
  objects() {
    const points = new THREE.Points(this.geometry, this.material);
    points.frustumCulled = false;
    const arrows = new THREE.Group();
    this.points.push(points);
    this.arrows.push(arrows);
    return [points, arrows];
  }

  set(scan, arrows) {
    const count = scan ? scan.points.length / 3 : 0;
    const positions = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      positions[3 * i] = this.side * scan.points[3 * i + 1];
      positions[3 * i + 1] = scan.points[3 * i + 2];
      positions[3 * i + 2] = -scan.points[3 * i];
    }
    this.geometry.dispose();
    this.geometry = new THREE.BufferGeometry();
    this.geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
    this.geometry.setAttribute('label', new THREE.BufferAttribute(Uint16Array.from(scan?.label ?? []), 1));
    for (const points of this.points) points.geometry = this.geometry;
    for (const group of this.arrows) {
      group.clear();
      for (let i = 0; i + 5 < arrows.length; i += 6) group.add(this.arrow(arrows.subarray(i, i + 6)));
    }
    this.thinArrows();
  }

  /** Hides the arrows outside the grid while no points are shown. */
  thinArrows() {
    const shown = this.points.some((points) => points.visible);
    for (const group of this.arrows) for (const arrow of group.children) arrow.visible = shown || arrow.userData.inside;
  }

  isInside(x, y) {
    if (!this.panel) return true;
    const axes = this.panel.coordinates === 'cylindrical' ? [Math.hypot(x, y), Math.atan2(y, x)] : [x, y];
    return axes.every((value, a) => value >= this.panel.lower[a] && value < this.panel.upper[a]);
  }

  arrow([x, y, z, vx, vy, vz]) {
    const along = new THREE.Vector3(this.side * vy, vz, -vx);
    const length = along.length();
    const head = Math.min(1.1, length / 2);
    const width = head / 9;
    const shaft = new THREE.Mesh(this.shaft, this.arrowMaterial);
    shaft.scale.set(width, length - head, width);
    const tip = new THREE.Mesh(this.head, this.arrowMaterial);
    tip.scale.set(3 * width, head, 3 * width);
    tip.position.y = length;
    const group = new THREE.Group();
    group.add(shaft, tip);
    group.userData.inside = this.isInside(x, y);
    group.position.set(this.side * y, z, -x);
    group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.divideScalar(length));
    return group;
  }
}

/** Returns a plain car under the sensor, which is mounted 0.5 m behind the middle of the car, 1.8 m above the ground. */
function egoVehicle() {
  const car = new THREE.Group();
  const parts = [ // colour, lower and upper corner in the axes of the scene
    ['#eef0f3', [-0.95, -1.62, -2.75], [0.95, -0.98, 1.75]],
    ['#78849a', [-0.8, -0.98, -1.3], [0.8, -0.5, 1.35]],
    ['#eef0f3', [-0.78, -0.5, -1.2], [0.78, -0.4, 1.25]],
  ];
  for (const [color, from, to] of parts) {
    const size = to.map((value, a) => value - from[a]);
    const box = new THREE.BoxGeometry(...size);
    const shades = [0.86, 0.86, 1, 0.6, 0.8, 0.8]; // right, left, top, bottom, back, front
    const mesh = new THREE.Mesh(box, shades.map((shade) => new THREE.MeshBasicMaterial({ color: new THREE.Color(color).multiplyScalar(shade) })));
    mesh.position.set(...to.map((value, a) => (value + from[a]) / 2));
    car.add(mesh);
  }
  return car;
}

/** Returns the outline of a grid's floor, with a mark ahead of the vehicle. */
function outline(panel, side) {
  const [x0, y0, z0] = panel.lower;
  const [x1, y1] = panel.upper;
  const polar = panel.coordinates === 'cylindrical';
  const corner = (a, b) => {
    const [x, y] = polar ? [a * Math.cos(b), a * Math.sin(b)] : [a, b];
    return new THREE.Vector3(side * y, z0, -x);
  };
  const steps = 96;
  const rim = [];
  const walk = (from, to) => {
    for (let i = 0; i < steps; i++) {
      const at = (t) => corner(from[0] + (to[0] - from[0]) * t, from[1] + (to[1] - from[1]) * t);
      rim.push(at(i / steps), at((i + 1) / steps));
    }
  };
  walk([x1, y0], [x1, y1]);
  if (!polar) walk([x0, y0], [x0, y1]);
  if (!polar || y1 - y0 < 2 * Math.PI - 1e-3) {
    walk([x0, y0], [x1, y0]);
    walk([x0, y1], [x1, y1]);
  }
  const ahead = new THREE.Vector3(0, z0, -x1);
  const wing = (dx) => new THREE.Vector3(dx, z0, -x1 - 0.8);
  rim.push(wing(-1), ahead.clone().setZ(-x1 - 2.4), wing(1), ahead.clone().setZ(-x1 - 2.4), wing(-1), wing(1));
  return new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(rim), new THREE.LineBasicMaterial({ color: '#8a93a1' }));
}
