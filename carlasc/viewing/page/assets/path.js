// The path of the ego vehicle through the world, as it is seen from one of its poses.

const PATH_HEIGHT = -1.2; // metres over the sensor: above the voxels of the road, so that they do not cover it
const PATH_WIDTH = 0.36;
const DRIVEN = '#2563eb';
const AHEAD = '#a9c1f5';

/** The poses of a sequence. Each has 12 numbers: the first three rows of world_T_ego, in the axes of the data. */
class Journey {
  constructor(poses, side) {
    this.poses = poses;
    this.side = side;
  }

  /** Returns the direction of travel about the vertical axis of the scene, radians, anticlockwise from above. */
  yaw(position) {
    const pose = this.poses[position];
    return Math.atan2(-this.side * pose[4], pose[0]);
  }

  /** Returns where the vehicle is at all poses, seen from one of them, in the axes of the scene. */
  seenFrom(position) {
    const own = this.poses[position];
    return this.poses.map((pose) => {
      const away = [3, 7, 11].map((at) => pose[at] - own[at]);
      const [x, y, z] = [0, 1, 2].map((column) => away[0] * own[column] + away[1] * own[column + 4] + away[2] * own[column + 8]);
      return new THREE.Vector3(this.side * y, z + PATH_HEIGHT, -x);
    });
  }
}

/** A ribbon along the path: what was driven is dark, what follows is light. All panels share it. */
class PathLayer {
  constructor() {
    this.material = new THREE.MeshBasicMaterial({ vertexColors: true });
    this.meshes = [];
  }

  /** Returns the object for the scene of a panel. */
  object() {
    const mesh = new THREE.Mesh(new THREE.BufferGeometry(), this.material);
    mesh.frustumCulled = false;
    this.meshes.push(mesh);
    return mesh;
  }

  /** Draws the path; `points` are the poses, `position` is the number of the one that is shown. */
  set(points, position) {
    const corners = [];
    const colors = [];
    const [driven, ahead] = [DRIVEN, AHEAD].map((color) => new THREE.Color(color));
    const add = (from, to, color) => {
      const along = new THREE.Vector3(to.x - from.x, 0, to.z - from.z);
      const length = along.length();
      if (length < 1e-3) return;
      const out = new THREE.Vector3(-along.z, 0, along.x).multiplyScalar(PATH_WIDTH / 2 / length); // to the right
      const [a, b, c, d] = [from.clone().sub(out), from.clone().add(out), to.clone().sub(out), to.clone().add(out)];
      for (const corner of [a, b, c, b, d, c]) {
        corners.push(corner.x, corner.y, corner.z);
        colors.push(color.r, color.g, color.b);
      }
    };
    for (let i = 0; i + 1 < points.length; i++) add(points[i], points[i + 1], i < position ? driven : ahead);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(Float32Array.from(corners), 3));
    geometry.setAttribute('color', new THREE.BufferAttribute(Float32Array.from(colors), 3));
    for (const mesh of this.meshes) {
      mesh.geometry.dispose();
      mesh.geometry = geometry;
    }
  }
}

/** Straight lines in the frame of the sensor: the edges of boxes, or the ways of actors. All panels share them. */
class LineLayer {
  constructor(side, color) {
    this.side = side;
    this.material = new THREE.LineBasicMaterial({ color });
    this.lines = [];
  }

  /** Returns the object for the scene of a panel. */
  object() {
    const lines = new THREE.LineSegments(new THREE.BufferGeometry(), this.material);
    lines.frustumCulled = false;
    this.lines.push(lines);
    return lines;
  }

  /** Draws lines; `ends` has x, y and z of both ends of each, in the axes of the data. */
  set(ends) {
    const corners = new Float32Array(ends.length);
    for (let i = 0; i < ends.length; i += 3) {
      corners[i] = this.side * ends[i + 1];
      corners[i + 1] = ends[i + 2];
      corners[i + 2] = -ends[i];
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(corners, 3));
    for (const lines of this.lines) {
      lines.geometry.dispose();
      lines.geometry = geometry;
    }
  }
}
