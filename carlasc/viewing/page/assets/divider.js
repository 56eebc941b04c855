// The divider between two runs that are drawn in the same place: it is dragged, or moved with the arrow keys.

const STEP = 0.05; // of the width, for a key

class Divider {
  /** `place` contains the handles; `change` is called with the share of the width that belongs to the first run. */
  constructor(place, runs, change) {
    this.place = place;
    this.runs = runs;
    this.change = change;
    this.share = 0.5;
    this.handles = [];
  }

  /** Puts a handle into each rectangle that shows two runs. */
  layOut(boxes) {
    this.boxes = boxes;
    while (this.handles.length > boxes.length) this.handles.pop().remove();
    while (this.handles.length < boxes.length) this.handles.push(this.makeHandle(this.handles.length));
    this.set(this.share);
  }

  makeHandle(number) {
    const handle = make('div', {
      class: 'divider', role: 'slider', tabindex: '0', 'aria-orientation': 'horizontal', 'aria-valuemin': '0', 'aria-valuemax': '100',
      'aria-label': `Divider: ${this.runs[0]} on the left, ${this.runs[1]} on the right`,
    }, make('span', { class: 'grip', 'aria-hidden': 'true' }, '‹ ›'));
    handle.addEventListener('pointerdown', (event) => {
      event.preventDefault();
      handle.focus({ preventScroll: true });
      handle.setPointerCapture(event.pointerId);
    });
    handle.addEventListener('pointermove', (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      const { x, width } = this.boxes[number];
      this.set((event.clientX - this.place.getBoundingClientRect().left - x) / width);
    });
    handle.addEventListener('keydown', (event) => {
      const to = { ArrowLeft: this.share - STEP, ArrowRight: this.share + STEP, Home: 0, End: 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      event.stopPropagation(); // elsewhere these keys choose the frame
      this.set(to);
    });
    this.place.append(handle);
    return handle;
  }

  set(share) {
    this.share = Math.min(Math.max(share, 0), 1);
    const percent = Math.round(100 * this.share);
    this.handles.forEach((handle, number) => {
      const { x, y, width, height } = this.boxes[number];
      handle.style.left = `${x + this.share * width}px`;
      handle.style.top = `${y}px`;
      handle.style.height = `${height}px`;
      handle.setAttribute('aria-valuenow', String(percent));
      handle.setAttribute('aria-valuetext', `${percent} % ${this.runs[0]}, ${100 - percent} % ${this.runs[1]}`);
    });
    this.change(this.share);
  }
}
