// The viewer: connects the interface with the panels. `window.carlasc` is the viewer, for scripts and tests.

class Viewer {
  constructor(scene) {
    this.scene = scene;
    this.store = new FrameStore(scene);
    this.panels = new Panels(byId('canvas'), scene);
    this.position = 0;
    this.contents = null;
    this.picked = null;
    this.playing = false;
    this.layers = { grid: scene.panels.length > 0, points: scene.panels.length === 0, flow: true, vehicle: true };
    this.makeHeader();
    this.makeLayers();
    this.makeLegends();
    this.makePlayer();
    this.listen();
  }

  async start() {
    this.setTheme(window.matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light');
    new ResizeObserver(() => this.resize()).observe(byId('stage'));
    this.panels.resize();
    this.panels.setView('behind');
    await this.show(0);
    byId('message').textContent = '';
    const tick = () => { this.panels.draw(); requestAnimationFrame(tick); };
    tick();
  }

  resize() {
    this.panels.resize();
    if (!this.moved) this.panels.setView(this.view ?? 'behind');
    this.placeTitles();
  }

  makeHeader() {
    const { name, panels, frames } = this.scene;
    byId('title').textContent = name;
    const first = panels[0];
    const cells = first ? `${first.coordinates} ${first.size.join(' × ')}` : 'scan';
    byId('subtitle').textContent = `${cells} · ${frames.length} ${frames.length === 1 ? 'frame' : 'frames'}`;
    if (panels.length > 1) {
      this.panels.panels.forEach((panel) => {
        const title = panel.panel.title;
        const button = toggleButton(title[0].toUpperCase() + title.slice(1), true, (on) => this.showPanel(panel, on, button), { 'data-panel': title });
        byId('panel-buttons').append(button);
      });
    }
    byId('view-behind').addEventListener('click', () => this.setView('behind'));
    byId('view-top').addEventListener('click', () => this.setView('top'));
    byId('theme').addEventListener('click', () => this.setTheme(this.theme === 'dark' ? 'light' : 'dark'));
  }

  makeLayers() {
    const names = { grid: 'Grid', points: 'Points', flow: 'Flow', vehicle: 'Vehicle' };
    this.layerButtons = {};
    for (const [layer, label] of Object.entries(names)) {
      const available = { grid: this.scene.panels.length > 0, points: this.scene.hasPoints, flow: this.scene.hasFlow, vehicle: true };
      if (!available[layer]) continue;
      const button = toggleButton(label, this.layers[layer], (on) => this.setLayer(layer, on), { 'data-layer': layer });
      this.layerButtons[layer] = button;
      byId('layer-buttons').append(button);
      this.panels.setVisible(layer, this.layers[layer]);
    }
    const select = byId('color-by');
    for (const mode of ['class', 'height', ...(this.scene.panels.length ? ['votes'] : [])]) select.append(make('option', { value: mode }, mode));
    select.addEventListener('change', () => this.colorBy(select.value));
  }

  makeLegends() {
    this.legends = Object.entries(this.scene.tables).map(([name, classes]) => {
      const panels = this.scene.panels.map((panel, number) => ({ panel, number })).filter(({ panel }) => panel.table === name);
      const columns = panels.map(({ panel }) => (panels.length > 1 ? panel.title : 'voxels'));
      const counted = this.scene.hasPoints && name === this.scene.pointTable && panels.length < 2; // a third column does not fit
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
    const keys = {
      ' ': () => this.play(!this.playing),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      g: () => this.layerButtons.grid?.click(),
      p: () => this.layerButtons.points?.click(),
      f: () => this.layerButtons.flow?.click(),
      1: () => this.setView('behind'),
      2: () => this.setView('top'),
      d: () => byId('theme').click(),
      Escape: () => this.unpick(),
    };
    window.addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key] || event.target.tagName === 'SELECT') return;
      event.preventDefault();
      keys[event.key]();
    });
    const canvas = byId('canvas');
    let pressed = null;
    canvas.addEventListener('pointerdown', (event) => { pressed = [event.clientX, event.clientY]; });
    canvas.addEventListener('pointerup', (event) => {
      if (event.button || !pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) {
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
    const contents = await this.store.get(position);
    if (this.wanted !== position) return; // another frame was requested in the meantime
    this.position = position;
    this.contents = contents;
    this.panels.setFrame(contents);
    for (const { legend, counted, panels } of this.legends) {
      const columns = panels.map((number) => countBy(contents.grids[number].label, legend.classes.length));
      if (counted) columns.push(contents.scan ? countBy(contents.scan.label, legend.classes.length) : []);
      legend.update(columns);
    }
    const time = this.scene.times[position];
    byId('slider').value = String(position);
    byId('frame-label').textContent = `frame ${this.scene.frames[position]}${time === null ? '' : ` · ${time.toFixed(1)} s`}`;
    if (this.picked) this.unpick();
    this.showRamp();
    if (this.scene.frames.length > 1) this.store.get((position + 1) % this.scene.frames.length); // decoded in advance, for playing
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
    while (this.playing) { // a frame takes 0.1 s, or longer if drawing it does
      const due = performance.now() + 100;
      await this.step(1);
      await new Promise((done) => requestAnimationFrame(done));
      await new Promise((done) => setTimeout(done, Math.max(0, due - performance.now())));
    }
    this.runs = false;
  }

  setLayer(layer, on) {
    this.layers[layer] = on;
    this.panels.setVisible(layer, on);
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
    this.panels.colorBy(mode);
    this.showRamp();
  }

  showRamp() {
    byId('ramp')?.remove();
    const layer = this.panels.panels[0].layer;
    const heights = this.panels.scan.uniforms.heights.value;
    if (this.mode === 'height') byId('layers').after(rampScale('Height', `${heights.x.toFixed(1)} m`, `${heights.y.toFixed(1)} m`));
    if (this.mode === 'votes' && layer?.grid?.votes) byId('layers').after(rampScale('Votes (logarithmic)', '0', grouped(Math.round(layer.mostVotes()))));
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

  pick(x, y) {
    const found = this.panels.pick(x, y);
    this.panels.mark(found ? found.index : null);
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

  placeTitles() {
    const boxes = this.scene.panels.length > 1 ? this.panels.boxes() : [];
    byId('titles').replaceChildren(...boxes.flatMap(({ panel, x, y, width }, i) => {
      const title = make('span', {}, panel.panel.title);
      title.style.left = `${x + width / 2}px`;
      title.style.top = `${y + 12}px`;
      const line = make('i');
      line.style.left = `${x}px`;
      return i && x ? [title, line] : [title];
    }));
  }
}

function countBy(labels, classes) {
  const counts = new Uint32Array(classes);
  for (const label of labels) counts[label]++;
  return counts;
}

(async () => {
  try {
    if (typeof DecompressionStream === 'undefined') throw new Error('this browser is too old: Chrome 80, Firefox 113, Safari 16.4 or later is needed');
    window.carlasc = new Viewer(JSON.parse(byId('scene').textContent));
    await window.carlasc.start();
    document.documentElement.dataset.ready = 'true';
  } catch (error) {
    byId('message').textContent = `This page cannot be drawn: ${error.message}`;
    console.error(error);
  }
})();
