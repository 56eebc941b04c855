// The frames of the page: where their bytes are, and how many of them are kept decoded.

const KEPT = 8; // decoded frames: some megabytes each

/** Decodes frames when they are needed, and keeps the last few. They are in the page itself, or in files beside it. */
class FrameStore {
  constructor(scene) {
    this.scene = scene;
    this.kept = new Map();
  }

  /** Returns a promise of the grids and the scan of a frame. */
  get(position) {
    let entry = this.kept.get(position);
    this.kept.delete(position);
    if (!entry) {
      const stop = new AbortController();
      entry = { stop, contents: this.decode(position, stop.signal) };
      entry.contents.catch(() => { if (this.kept.get(position) === entry) this.kept.delete(position); }); // so that it is tried again
    }
    this.kept.set(position, entry); // the last one is the one that was asked for last
    while (this.kept.size > KEPT) {
      const [oldest, { stop }] = this.kept.entries().next().value;
      this.kept.delete(oldest);
      stop.abort(); // of no effect if it has arrived
    }
    return entry.contents;
  }

  /** Fetches frames that are needed soon. */
  prepare(positions) {
    for (const position of positions) if (!this.kept.has(position)) this.get(position).catch(() => {}); // told when it is shown
  }

  async decode(position, signal) {
    const bytes = this.scene.embedded ? this.unwrap(position) : await this.fetch(position, signal);
    const arrays = unpackArrays(await inflate(bytes));
    const grids = this.scene.panels.map((panel, number) => decodeGrid(arrays, `panel${number}`, panel));
    const [arrows, boxes, tracks, cameras] = ['arrows', 'boxes', 'tracks', 'cameras'].map((name) => arrays[`actors/${name}`] ?? new Float32Array(0));
    const photos = Object.fromEntries(this.scene.cameras.map((name) => [name, arrays[`photos/${name}`]]));
    return { grids, scan: decodeScan(arrays, this.scene), arrows, boxes, tracks, cameras, photos };
  }

  /** Returns the bytes of a frame that is part of the page. */
  unwrap(position) {
    return Uint8Array.from(atob(document.getElementById(`frame${position}`).textContent), (letter) => letter.charCodeAt(0));
  }

  async fetch(position, signal) {
    const file = `frames/${String(position).padStart(6, '0')}.bin`;
    if (location.protocol === 'file:') {
      throw new Error('its frames are files beside it, which a browser reads from a web server only: run "python -m http.server" in the folder of the page, and open http://localhost:8000');
    }
    const answer = await fetch(file, { signal });
    if (!answer.ok) throw new Error(`the server answers ${answer.status} for ${file}`);
    return answer.arrayBuffer();
  }
}
