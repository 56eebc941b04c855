// The keyboard: every control can be operated with it, and the canvas itself once it has the focus.

const TURN = Math.PI / 24;

/** Returns what keys do anywhere in the page. */
function pageKeys(viewer) {
  const press = (id) => { const button = byId(id); if (button && !button.disabled && button.offsetParent) button.click(); };
  return {
    ' ': () => viewer.play(!viewer.playing),
    ArrowLeft: () => viewer.step(-1),
    ArrowRight: () => viewer.step(1),
    Home: () => viewer.show(0),
    End: () => viewer.show(viewer.scene.frames.length - 1),
    g: () => viewer.layerButtons.grid?.click(),
    p: () => viewer.layerButtons.points?.click(),
    f: () => viewer.layerButtons.flow?.click(),
    t: () => viewer.layerButtons.path?.click(),
    c: () => viewer.layerButtons.cameras?.click(),
    1: () => viewer.setView('behind'),
    2: () => viewer.setView('top'),
    3: () => press('follow'),
    w: () => press('worst'),
    d: () => press('theme'),
    Escape: () => viewer.unpick(),
  };
}

/** Returns what keys do while the canvas has the focus: they move the camera, and read the voxel in the middle. */
function canvasKeys(viewer) {
  const turn = (around, up) => { viewer.moved = true; viewer.panels.turn(around, up); };
  const zoom = (factor) => { viewer.moved = true; viewer.panels.zoom(factor); };
  return {
    'Shift+ArrowLeft': () => turn(-TURN, 0),
    'Shift+ArrowRight': () => turn(TURN, 0),
    'Shift+ArrowUp': () => turn(0, TURN),
    'Shift+ArrowDown': () => turn(0, -TURN),
    '+': () => zoom(0.85),
    '-': () => zoom(1 / 0.85),
    Enter: () => {
      const { x, y, width, height } = viewer.panels.boxes()[0];
      viewer.pick(x + width / 2, y + height / 2);
    },
  };
}

/** Listens to the keyboard. Elements that use a key themselves keep it: lists their letters and arrows, buttons the space bar. */
function listenToKeys(viewer) {
  const everywhere = pageKeys(viewer);
  const onCanvas = canvasKeys(viewer);
  window.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === 'SELECT') return;
    if (event.key === ' ' && event.target.tagName === 'BUTTON') return;
    const name = event.shiftKey && event.key.startsWith('Arrow') ? `Shift+${event.key}` : event.key;
    const action = (event.target === byId('canvas') && onCanvas[name]) || everywhere[name];
    if (!action) return;
    event.preventDefault();
    action();
  });
}
