// The scores of all frames as lines; a click shows a frame, a button the worst one.

const SVG = 'http://www.w3.org/2000/svg';
const METRICS = { miou: 'mIoU', iou: 'IoU' };
const percent = (value) => (value === null || value === undefined ? '–' : `${(100 * value).toFixed(1)} %`);

function draw(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

class ScorePlot {
  /** `show` is called with the position of the frame that a user chooses. */
  constructor(scene, show) {
    this.scene = scene;
    this.show = show;
    this.metric = 'miou';
    this.position = 0;
    byId('scores').hidden = false;
    const select = byId('metric');
    for (const [name, label] of Object.entries(METRICS)) select.append(make('option', { value: name }, label));
    select.addEventListener('change', () => { this.metric = select.value; this.build(); });
    byId('worst').addEventListener('click', () => this.showWorst());
    this.svg = byId('plot');
    const jump = (event) => {
      const { left, width } = this.svg.getBoundingClientRect();
      const last = this.scene.frames.length - 1;
      this.show(Math.min(Math.max(Math.round(((event.clientX - left) / width) * last), 0), last));
    };
    this.svg.addEventListener('pointerdown', (event) => { this.svg.setPointerCapture(event.pointerId); jump(event); });
    this.svg.addEventListener('pointermove', (event) => { if (this.svg.hasPointerCapture(event.pointerId)) jump(event); });
    this.build();
  }

  /** Returns the position of the frame with the lowest score of the first run; null if no frame has a score. */
  worst() {
    const values = this.scene.scores[this.metric][0];
    let found = null;
    values.forEach((value, at) => { if (value !== null && (found === null || value < values[found])) found = at; });
    return found;
  }

  showWorst() {
    const worst = this.worst();
    if (worst !== null) this.show(worst);
  }

  build() {
    const runs = this.scene.scores[this.metric];
    const found = runs.flat().filter((value) => value !== null);
    const high = Math.max(Math.ceil(10 * Math.max(0, ...found)) / 10, 0.1);
    const low = Math.min(Math.floor(10 * Math.min(1, ...found)) / 10, high - 0.1);
    const last = Math.max(this.scene.frames.length - 1, 1);
    const lines = runs.map((values, run) => {
      const pieces = [];
      values.forEach((value, at) => {
        if (value === null) return;
        const joined = at > 0 && values[at - 1] !== null;
        pieces.push(`${joined ? 'L' : 'M'}${at},${(1 - (value - low) / (high - low)).toFixed(4)}`);
      });
      return draw('path', { d: pieces.join(''), class: `line run${run}` });
    });
    this.cursor = draw('path', { class: 'cursor' });
    this.svg.setAttribute('viewBox', `0 0 ${last} 1`);
    this.svg.replaceChildren(...lines.reverse(), this.cursor); // the first run is in front
    byId('plot-high').textContent = `${Math.round(100 * high)} %`;
    byId('plot-low').textContent = `${Math.round(100 * low)} %`;
    const worst = this.worst();
    byId('worst').disabled = worst === null;
    const mean = found.length ? runs[0].reduce((sum, value) => sum + (value ?? 0), 0) / runs[0].filter((value) => value !== null).length : null;
    const lowest = worst === null ? '' : `, lowest ${percent(runs[0][worst])} in frame ${this.scene.frames[worst]}`;
    this.svg.setAttribute('aria-label', `${METRICS[this.metric]} of ${this.scene.frames.length} frames: mean ${percent(mean)}${lowest}`);
    this.mark(this.position);
  }

  /** Marks the frame that is shown, and writes its scores. */
  mark(position) {
    this.position = position;
    this.cursor.setAttribute('d', `M${position},0V1`);
    byId('score').replaceChildren(...this.describe().map(([text, run]) => make('span', { class: `run${run}` }, text)));
  }

  /** Returns a text for each run, with its number. */
  describe() {
    const names = this.scene.runs.length > 1 ? this.scene.runs : [METRICS[this.metric]];
    return names.map((name, run) => [`${percent(this.scene.scores[this.metric][run][this.position])} ${name}`, run]);
  }
}
