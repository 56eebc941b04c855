// The viewer: connects the interface with the panels. `window.carlasc` is the viewer, for scripts and tests.

const AHEAD_FETCHED = 3; // frames after the one that is shown
const NARROW = 180; // pixels
const reducedMotion = window.matchMedia('(prefers-reduced-motion: reduce)');
const darkScheme = window.matchMedia('(prefers-color-scheme: dark)');

class Viewer {
  constructor(scene) {
    this.scene = scene;
    this.store = new FrameStore(scene);
    this.panels = new Panels(byId('canvas'), scene);
    this.journey = scene.poses && new Journey(scene.poses, this.panels.side);
    this.position = 0;
    this.contents = null;
    this.picked = null;
    this.playing = false;
    this.follows = false;
    this.layers = { grid: scene.panels.length > 0, points: scene.panels.length === 0, flow: true, boxes: true, tracks: true, cameras: true, path: true, vehicle: true };
    this.photos = new PhotoStrip(byId('photos'), scene.cameras);
    this.makeHeader();
    this.makeLayers();
    this.makeLegends();
    this.makePlayer();
    this.plot = scene.scores && new ScorePlot(scene, (position) => this.show(position));
    this.divider = new Divider(byId('titles'), scene.runs, (share) => { this.panels.share = share; this.panels.invalidate(); });
    listenToKeys(this);
    this.listen();
  }

  async start() {
    this.setTheme(darkScheme.matches ? 'dark' : 'light');
    new ResizeObserver(() => this.resize()).observe(byId('stage'));
    this.panels.resize();
    this.showWhatFits();
    this.panels.setView('behind');
    await this.show(0);
    if (!this.contents) return;
    const tick = () => { this.panels.draw(); requestAnimationFrame(tick); };
    tick();
  }

  /** Shows only the first panel if all of them would be too narrow; the buttons show the others. */
  showWhatFits() {
    if (this.panels.boxes().every(({ width }) => width >= NARROW)) return;
    byId('panel-buttons').querySelectorAll('button').forEach((button, number) => { if (number > 0) button.click(); });
  }

  resize() {
    this.panels.resize();
    if (!this.moved && !this.follows) this.panels.setView(this.view ?? 'behind');
    this.placeTitles();
  }

  makeHeader() {
    const { name, panels, frames, poses } = this.scene;
    byId('title').textContent = name;
    const first = panels[0];
    const cells = first ? `${first.coordinates} ${first.size.join(' × ')}` : 'scan';
    byId('subtitle').textContent = `${cells} · ${frames.length} ${frames.length === 1 ? 'frame' : 'frames'}`;
    const own = this.panels.panels.filter((panel) => !panel.isRight);
    if (own.length > 1) {
      own.forEach((panel) => {
        const title = panel.panel.name;
        const button = toggleButton(title[0].toUpperCase() + title.slice(1), true, (on) => this.showPanel(panel, on, button), { 'data-panel': title });
        byId('panel-buttons').append(button);
      });
    }
    byId('view-behind').addEventListener('click', () => this.setView('behind'));
    byId('view-top').addEventListener('click', () => this.setView('top'));
    byId('follow').hidden = !poses || frames.length < 2;
    byId('follow').addEventListener('click', () => this.follow(!this.follows));
    byId('theme').addEventListener('click', () => { this.themeChosen = true; this.setTheme(this.theme === 'dark' ? 'light' : 'dark'); });
    byId('options').addEventListener('click', () => this.showOptions(document.body.classList.contains('folded')));
  }

  makeLayers() {
    const { panels, hasPoints, hasFlow, hasBoxes, hasTracks, cameras, frames, poses } = this.scene;
    const names = { grid: 'Grid', points: 'Points', flow: 'Flow', boxes: 'Boxes', tracks: 'Tracks', cameras: 'Cameras', path: 'Path', vehicle: 'Car' };
    const available = { grid: panels.length > 0, points: hasPoints, flow: hasFlow, boxes: hasBoxes, tracks: hasTracks, cameras: cameras.length > 0, path: Boolean(poses) && frames.length > 1, vehicle: true };
    this.layerButtons = {};
    for (const [layer, label] of Object.entries(names)) {
      if (!available[layer]) continue;
      const button = toggleButton(label, this.layers[layer], (on) => this.setLayer(layer, on), { 'data-layer': layer });
      this.layerButtons[layer] = button;
      byId('layer-buttons').append(button);
      this.setLayer(layer, this.layers[layer]);
    }
    const select = byId('color-by');
    for (const mode of modesOf(this.scene)) select.append(make('option', { value: mode }, MODES[mode].label));
    select.addEventListener('change', () => this.colorBy(select.value));
    select.value = this.scene.colorBy;
    this.colorBy(this.scene.colorBy);
  }

  makeLegends() {
    const { tables, panels: described, hasPoints, pointTable, runs } = this.scene;
    this.legends = Object.entries(tables).map(([name, classes]) => {
      const panels = described.map((panel, number) => ({ panel, number })).filter(({ panel }) => panel.table === name);
      const columns = panels.map(({ panel }) => (panels.length < 2 ? 'voxels' : runs.length > 1 && panel.name !== 'truth' ? runs[panel.run] : panel.title));
      const counted = hasPoints && name === pointTable && panels.length < 2; // a third column does not fit
      if (counted) columns.push('points');
      const change = (table, id, on) => { this.panels.setClass(table, id, on); this.unpick(); };
      const legend = new Legend(name === 'errors' ? 'Errors' : 'Classes', name, classes, columns, change);
      byId('legends').append(legend.element);
      return { legend, counted, panels: panels.map(({ number }) => number) };
    });
  }

  makePlayer() {
    const slider = byId('slider');
    slider.max = String(this.scene.frames.length - 1);
    slider.addEventListener('input', () => this.show(Number(slider.value)));
    byId('previous').addEventListener('click', () => this.step(-1));
    byId('next').addEventListener('click', () => this.step(1));
    byId('play').addEventListener('click', () => this.play(!this.playing));
    for (const id of ['previous', 'next', 'play', 'slider']) byId(id).disabled = this.scene.frames.length < 2;
  }

  listen() {
    darkScheme.addEventListener('change', () => { if (!this.themeChosen) this.setTheme(darkScheme.matches ? 'dark' : 'light'); });
    const canvas = byId('canvas');
    let pressed = null;
    canvas.addEventListener('pointerdown', (event) => { pressed = event.isPrimary ? [event.clientX, event.clientY] : null; });
    canvas.addEventListener('pointerup', (event) => {
      const tolerance = event.pointerType === 'touch' ? 10 : 4; // pixels: a finger is not as steady
      if (event.button || !pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > tolerance) {
        this.moved = true;
        return;
      }
      const { left, top } = canvas.getBoundingClientRect();
      this.pick(event.clientX - left, event.clientY - top);
    });
    canvas.addEventListener('wheel', () => { this.moved = true; }, { passive: true });
  }

  /** Shows the frame at a position of the range. */
  async show(position) {
    this.wanted = position;
    let contents;
    try {
      contents = await this.store.get(position);
    } catch (error) {
      if (this.wanted === position) this.fail(position, error);
      return;
    }
    if (this.wanted !== position) return; // another frame was requested in the meantime
    byId('message').textContent = '';
    const before = this.contents ? this.position : position;
    this.position = position;
    this.contents = contents;
    this.panels.setFrame(contents);
    this.photos.show(contents.photos);
    this.drive(before, position);
    for (const { legend, counted, panels } of this.legends) {
      const columns = panels.map((number) => countBy(contents.grids[number].label, legend.classes.length));
      if (counted) columns.push(contents.scan ? countBy(contents.scan.label, legend.classes.length) : []);
      legend.update(columns);
    }
    this.label(position);
    if (this.picked) this.unpick();
    this.showRamp();
    const count = this.scene.frames.length;
    this.store.prepare(Array.from({ length: Math.min(AHEAD_FETCHED, count - 1) }, (_, i) => (position + 1 + i) % count));
  }

  /** Draws the path as it is seen from a frame. While the camera follows the vehicle, the world keeps its direction. */
  drive(before, position) {
    if (!this.journey) return;
    this.panels.setPath(this.journey.seenFrom(position), position);
    if (this.follows) this.panels.turnWorld(this.journey.yaw(before) - this.journey.yaw(position));
  }

  /** Writes the number, the time and the scores of a frame. */
  label(position) {
    const time = this.scene.times[position];
    const text = `frame ${this.scene.frames[position]}${time === null ? '' : ` · ${time.toFixed(1)} s`}`;
    byId('slider').value = String(position);
    byId('slider').setAttribute('aria-valuetext', text);
    byId('frame-label').textContent = text;
    this.plot?.mark(position);
    const scores = this.plot ? `, ${this.plot.describe().map(([words]) => words).join(', ')}` : '';
    byId('canvas').setAttribute('aria-label', `${this.scene.name}: voxels and points of ${text} in three dimensions. Press Enter to read the voxel in the middle.`);
    if (!this.playing) byId('status').textContent = text + scores; // read aloud
  }

  /** Says that a frame cannot be shown; the one before stays. */
  fail(position, error) {
    const what = this.contents ? `Frame ${this.scene.frames[position]} cannot be shown` : 'This page cannot be drawn';
    byId('message').textContent = `${what}: ${error.message}`;
    this.playing = false;
    byId('play').textContent = 'Play';
    if (this.contents) byId('slider').value = String(this.position);
  }

  step(by) {
    const count = this.scene.frames.length;
    return this.show((this.position + by + count) % count);
  }

  async play(on) {
    this.playing = on && this.scene.frames.length > 1;
    byId('play').textContent = this.playing ? 'Stop' : 'Play';
    if (this.runs) return;
    this.runs = true;
    while (this.playing) { // a frame takes 0.1 s, or longer if drawing it does; 1 s for those who asked for less motion
      const due = performance.now() + (reducedMotion.matches ? 1000 : 100);
      await this.step(1);
      await new Promise((done) => requestAnimationFrame(done));
      await new Promise((done) => setTimeout(done, Math.max(0, due - performance.now())));
    }
    this.runs = false;
  }

  /** Lets the camera travel with the vehicle without turning with it, or turn with it again. */
  follow(on) {
    this.follows = on && Boolean(this.journey);
    byId('follow').setAttribute('aria-pressed', String(this.follows));
    if (!this.follows) this.setView(this.view ?? 'behind');
  }

  setLayer(layer, on) {
    this.layers[layer] = on;
    this.panels.setVisible(layer, on);
    if (layer === 'cameras') this.photos.setVisible(on);
    if (layer === 'grid') this.unpick();
  }

  showPanel(panel, on, button) {
    if (!on && this.panels.shown.length === 1) {
      button.setAttribute('aria-pressed', 'true'); // at least one panel is shown
      return;
    }
    panel.shown = on;
    this.unpick();
    this.resize();
  }

  colorBy(mode) {
    this.mode = mode;
    this.panels.colorBy(MODES[mode]);
    this.showRamp();
  }

  showRamp() {
    byId('ramp')?.remove();
    const legend = this.panels.mode.legend(this.contents?.grids ?? [], this.scene.runs, this.panels.scan.uniforms.heights.value, this.panels.most);
    if (legend) byId('layers').after(legend);
  }

  setView(view) {
    this.view = view;
    this.moved = false;
    this.panels.setView(view);
  }

  setTheme(theme) {
    this.theme = theme;
    document.documentElement.dataset.theme = theme;
    byId('theme').textContent = theme === 'dark' ? 'Light' : 'Dark';
    this.panels.setBackground(getComputedStyle(document.documentElement).getPropertyValue('--ground').trim(), theme === 'dark' ? '#f2f4f8' : '#15171b');
  }

  /** Shows or hides the layers and legends, which take much of a small screen. */
  showOptions(on) {
    document.body.classList.toggle('folded', !on);
    byId('options').setAttribute('aria-expanded', String(on));
  }

  pick(x, y) {
    const found = this.panels.pick(x, y);
    this.panels.mark(found ? found.index : null, found?.panel);
    this.picked = found && fillCard(byId('card'), this.scene, this.contents, found);
    byId('card').hidden = !found;
    this.panels.invalidate();
    return this.picked;
  }

  unpick() {
    this.picked = null;
    byId('card').hidden = true;
    this.panels.mark(null);
  }

  /** Writes the titles of the panels, draws lines between them, and puts the dividers in their places. */
  placeTitles() {
    const boxes = this.panels.boxes();
    const named = this.scene.panels.length > 1 ? boxes : [];
    byId('titles').querySelectorAll(':scope > :not(.divider)').forEach((element) => element.remove());
    byId('titles').append(...named.flatMap(({ panel, x, y, width }, i) => {
      const shown = panel.right ? [panel, panel.right] : [panel];
      const titles = shown.map(({ panel: { title } }, part) => {
        const element = make('span', {}, title);
        element.style.left = `${x + (width * (2 * part + 1)) / (2 * shown.length)}px`;
        element.style.top = `${y + 12}px`;
        element.style.maxWidth = `${width / shown.length - 12}px`;
        return element;
      });
      const line = make('i');
      line.style.left = `${x}px`;
      return i && x ? [...titles, line] : titles;
    }));
    this.divider.layOut(boxes.filter(({ panel }) => panel.right));
  }
}

(async () => {
  try {
    if (typeof DecompressionStream === 'undefined') throw new Error('this browser is too old: Chrome 87, Firefox 113, Safari 16.4 or later is needed');
    window.carlasc = new Viewer(JSON.parse(byId('scene').textContent));
    await window.carlasc.start();
    if (window.carlasc.contents) document.documentElement.dataset.ready = 'true';
  } catch (error) {
    byId('message').textContent = `This page cannot be drawn: ${error.message}`;
    console.error(error);
  }
})();
