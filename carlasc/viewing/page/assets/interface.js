// The elements around the canvas: buttons, the legend with its counts, the card of a picked voxel.

const byId = (id) => document.getElementById(id);
const grouped = (number) => number.toLocaleString('en-US');

/** Returns a new element with attributes and children. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Returns a button that is on or off. */
function toggleButton(label, on, change, attributes = {}) {
  const button = make('button', { 'aria-pressed': String(on), ...attributes }, label);
  button.addEventListener('click', () => {
    const now = button.getAttribute('aria-pressed') !== 'true';
    button.setAttribute('aria-pressed', String(now));
    change(now);
  });
  return button;
}

function swatch(color) {
  const element = make('span', { class: 'swatch', 'aria-hidden': 'true' });
  element.style.background = color;
  return element;
}

/** The legend of a class table: a row for each class that any frame so far contained, with its voxels and points in this frame. */
class Legend {
  constructor(title, table, classes, columns, change) {
    this.table = table;
    this.classes = classes;
    this.change = change;
    this.hidden = new Set();
    this.rows = new Map();
    const all = make('button', { title: `Show all ${title.toLowerCase()}`, 'aria-label': `Show all ${title.toLowerCase()}` }, 'all');
    const none = make('button', { title: `Hide all ${title.toLowerCase()}`, 'aria-label': `Hide all ${title.toLowerCase()}` }, 'none');
    all.addEventListener('click', () => this.setAll(true));
    none.addEventListener('click', () => this.setAll(false));
    this.body = make('tbody');
    const heads = columns.map((name) => make('th', { scope: 'col', title: name }, make('span', {}, name)));
    const rows = make('table', { 'aria-label': `${title} of this frame` }, make('thead', {}, make('tr', {}, make('td'), ...heads)), this.body);
    this.element = make('section', { 'data-table': table, 'aria-label': title }, make('div', { class: 'legend-head' }, make('h2', {}, title), all, none), rows);
  }

  /** Shows the counts of a frame: for each column, an array indexed by class id. */
  update(columns) {
    this.classes.forEach(([name, color], id) => {
      const counts = columns.map((column) => column[id] ?? 0);
      if (!this.rows.has(id)) {
        if (!counts.some((count) => count > 0)) return;
        this.addRow(id, name, color, columns.length);
      }
      this.rows.get(id).cells.forEach((cell, i) => { cell.textContent = grouped(counts[i]); });
    });
  }

  addRow(id, name, color, columns) {
    const toggle = toggleButton('', true, (on) => this.set(id, on), { class: 'toggle', 'data-class': String(id) });
    toggle.append(swatch(color), make('span', { class: 'name' }, name));
    const cells = Array.from({ length: columns }, () => make('td', { class: 'count' }));
    const row = make('tr', {}, make('td', {}, toggle), ...cells);
    this.rows.set(id, { row, toggle, cells });
    const after = [...this.rows.keys()].filter((other) => other > id).sort((a, b) => a - b)[0];
    this.body.insertBefore(row, after === undefined ? null : this.rows.get(after).row);
    if (this.hidden.has(id)) this.set(id, false);
  }

  set(id, on) {
    const entry = this.rows.get(id);
    if (entry) {
      entry.toggle.setAttribute('aria-pressed', String(on));
      entry.row.classList.toggle('off', !on);
    }
    this.hidden[on ? 'delete' : 'add'](id);
    this.change(this.table, id, on);
  }

  setAll(on) {
    this.classes.forEach((_, id) => this.set(id, on));
  }
}

/** Returns the scale of a colour ramp. */
function rampScale(title, from, to) {
  const bar = make('div', { class: 'ramp' });
  bar.style.background = `linear-gradient(to right, ${RAMP.join(', ')})`;
  return make('section', { id: 'ramp' }, make('h2', {}, title), bar, make('div', { class: 'ramp-ends' }, make('span', {}, from), make('span', {}, to)));
}

/** Fills the card of a voxel and returns its contents. */
function fillCard(card, scene, contents, picked) {
  const { panel, index } = picked;
  const spec = panel.panel;
  const [, ny, nz] = spec.size;
  const cell = [Math.floor(index / (nz * ny)), Math.floor(index / nz) % ny, index % nz];
  const axes = cell.map((c, a) => spec.lower[a] + (c + 0.5) * spec.voxel[a]);
  const polar = spec.coordinates === 'cylindrical';
  const center = polar ? [axes[0] * Math.cos(axes[1]), axes[0] * Math.sin(axes[1]), axes[2]] : axes;
  const nameOf = (number) => {
    const grid = contents.grids[number];
    const label = grid.volume[index];
    if (label) return scene.tables[scene.panels[number].table][label][0];
    return grid.unknown?.[index] ? 'unknown' : scene.panels[number].table === 'errors' ? 'free in both' : 'free';
  };
  const number = scene.panels.indexOf(spec);
  const own = contents.grids[number];
  const label = own.volume[index];
  const lines = [];
  scene.panels.forEach((other, i) => { if (i !== number && sameCells(other, spec)) lines.push([other.title, nameOf(i)]); });
  const place = own.index.indexOf(index);
  if (own.votes) {
    const votes = own.votes[place];
    lines.push(['votes', Number.isInteger(votes) ? grouped(votes) : votes.toFixed(2)]);
  }
  if (own.occupied) lines.push(['occupied with probability', (own.occupied[place] / 255).toFixed(2)]);
  if (own.views) lines.push(['views', grouped(own.views[place])]);
  if (own.instance?.[place]) lines.push(['actor', String(own.instance[place])]);
  if (own.flags) for (const { flag, name } of KNOWLEDGE) if (own.flags[place] & flag) lines.push(['evidence', name]);
  lines.push(['voxel', cell.join(', ')]);
  lines.push(['x, y, z', `${center.map((value) => value.toFixed(2)).join(', ')} m`]);
  if (polar) lines.push(['radius, azimuth', `${axes[0].toFixed(2)} m, ${((axes[1] * 180) / Math.PI).toFixed(1)}°`]);
  const [name, color] = scene.tables[spec.table][label];
  const list = make('dl', {}, ...lines.flatMap(([term, text]) => [make('dt', {}, term), make('dd', {}, text)]));
  card.replaceChildren(make('header', {}, swatch(color), make('span', {}, `${name} (${label})`)), list);
  card.hidden = false;
  return { class: name, label, panel: spec, cell, center, lines: Object.fromEntries(lines) };
}

/** Returns how many values are 0, 1, ... of a number of classes. */
function countBy(labels, classes) {
  const counts = new Uint32Array(classes);
  for (const label of labels) counts[label]++;
  return counts;
}
