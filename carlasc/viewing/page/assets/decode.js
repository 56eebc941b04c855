// Decoding the bytes of a frame to typed arrays: the inverse of carlasc/viewing/page/contents.py.

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Response(stream).arrayBuffer();
}

const ARRAY_TYPES = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array, float32: Float32Array };

/** Returns the arrays of a block by name. Each is stored as byte planes. */
function unpackArrays(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  let start = 4 + length;
  for (const [name, type, size] of header) {
    const ArrayType = ARRAY_TYPES[type];
    const width = ArrayType.BYTES_PER_ELEMENT;
    const planes = new Uint8Array(buffer, start, size * width);
    const bytes = new Uint8Array(size * width);
    for (let plane = 0; plane < width; plane++) {
      for (let i = 0; i < size; i++) bytes[i * width + plane] = planes[plane * size + i];
    }
    arrays[name] = new ArrayType(bytes.buffer);
    start += size * width;
  }
  return arrays;
}

/** Returns the rising values of which the differences are given. */
function sumUp(gaps) {
  const values = new Uint32Array(gaps.length);
  let value = 0;
  for (let i = 0; i < gaps.length; i++) values[i] = value += gaps[i];
  return values;
}

/** Returns the voxels of a panel: C-order index, label, votes and evidence of each occupied cell, the labels of all cells, the unknown cells. */
function decodeGrid(arrays, prefix, panel) {
  const index = sumUp(arrays[`${prefix}/index`]);
  const label = arrays[`${prefix}/label`];
  const [nx, ny, nz] = panel.size;
  const volume = new Uint16Array(nx * ny * nz);
  for (let i = 0; i < index.length; i++) volume[index[i]] = label[i];
  let unknown = null;
  if (arrays[`${prefix}/unknown`]) {
    const turns = sumUp(arrays[`${prefix}/unknown`]);
    unknown = new Uint8Array(volume.length);
    for (let i = 0; i < turns.length; i += 2) unknown.fill(1, turns[i], i + 1 < turns.length ? turns[i + 1] : volume.length);
  }
  const [votes, occupied, views, flags, instance] = ['votes', 'occupied', 'views', 'flags', 'instance'].map((name) => arrays[`${prefix}/${name}`] ?? null);
  return { index, label, votes, occupied, views, flags, instance, volume, unknown };
}

/** Returns the points of a scan (x, y, z of each, metres), and their labels. */
function decodeScan(arrays, scene) {
  if (!arrays['scan/index']) return null;
  const index = sumUp(arrays['scan/index']);
  const [x0, y0, z0, , ny, nz] = arrays['scan/box'];
  const offset = arrays['scan/offset'];
  const count = index.length;
  const points = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const z = index[i] % nz;
    const y = Math.floor(index[i] / nz) % ny;
    const x = Math.floor(index[i] / (nz * ny));
    const cell = [x0 + x, y0 + y, z0 + z];
    for (let a = 0; a < 3; a++) points[3 * i + a] = (cell[a] + (offset[a * count + i] + 0.5) / scene.offsetSteps) * scene.pointCell;
  }
  return { points, label: arrays['scan/label'] ?? new Uint8Array(count) };
}
