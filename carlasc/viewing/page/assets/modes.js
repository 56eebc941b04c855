// What the colours of voxels can show besides their classes: height, votes, and how certain each voxel is (docs/format.md#evidence).

const RAMP = ['#440154', '#3b528b', '#21918c', '#5ec962', '#fde725']; // viridis: lightness increases from the first to the last
const SEEN = 4; // the place of voxels without a flag in KNOWLEDGE
const KNOWLEDGE = [ // the first one of which the flag is set
  { flag: 1, name: 'inferred: no scan saw it', color: '#f0c828' },
  { flag: 2, name: 'contested: traffic passes', color: '#d54600' },
  { flag: 8, name: 'in the body of an actor', color: '#8a56c2' },
  { flag: 4, name: 'seen by this scan', color: '#3f8fd0' },
  { flag: 0, name: 'seen by other scans', color: '#b4bac4' },
];

const ACTORS = ['#b4bac4', '#0ab0f5', '#d54600', '#0aa558', '#8a56c2', '#f0c828', '#c8140a', '#16d0c0', '#e667b0', '#1045be', '#9a6a2f', '#7ac943', '#5e5253'];

/** Returns the place of an actor's colour in ACTORS; the first one is that of voxels without an actor. */
function colorOfActor(number) {
  return number ? 1 + (number % (ACTORS.length - 1)) : 0;
}

/** Returns the place in KNOWLEDGE of a voxel with these flags. */
function knowledgeOf(flags) {
  const place = KNOWLEDGE.findIndex(({ flag }) => flags & flag);
  return place < 0 ? SEEN : place;
}

/** Returns the largest number of a list, which may be absent. */
function largest(numbers) {
  let most = 0;
  for (const number of numbers ?? []) if (number > most) most = number;
  return most;
}

/** Returns a mode that shows a number of each voxel on a logarithmic ramp from 0 to the largest one. */
function logarithmic(label, title, field) {
  return {
    label,
    colors: RAMP,
    most: (grid) => largest(grid[field]),
    values(grid, drawn, panel, most) {
      const numbers = grid[field];
      return numbers && Uint8Array.from(drawn, (i) => (255 * Math.log1p(numbers[i])) / Math.max(Math.log1p(most), 1e-6));
    },
    legend: (grids, runs, heights, most) => rampScale(`${title} (logarithmic)`, '0', grouped(Math.round(most))),
  };
}

/**
 * The modes by name. `values` returns a number of each drawn voxel from 0 to 255 on the colours of the mode, or null where the grid does not have it:
 * the voxels then have the colours of their classes. `most` returns the largest value of a grid.
 */
const MODES = {
  class: { label: 'class', colors: RAMP, most: () => 0, values: () => null, legend: () => null },
  height: {
    label: 'height',
    colors: RAMP,
    most: () => 0,
    values(grid, drawn, panel) {
      const nz = panel.size[2];
      return Uint8Array.from(drawn, (i) => (255 * (grid.index[i] % nz)) / Math.max(nz - 1, 1));
    },
    legend: (grids, runs, heights) => rampScale('Height', `${heights.x.toFixed(1)} m`, `${heights.y.toFixed(1)} m`),
  },
  votes: logarithmic('votes', 'Votes', 'votes'),
  confidence: {
    label: 'confidence',
    colors: RAMP,
    most: () => 0,
    values: (grid, drawn) => grid.occupied && Uint8Array.from(drawn, (i) => Math.max(2 * grid.occupied[i] - 255, 0)),
    legend: () => rampScale('Confidence: probability of being occupied', '0.5 or less', '1'),
  },
  views: logarithmic('views', 'Views: scans that saw it', 'views'),
  actor: {
    label: 'actor',
    colors: ACTORS,
    stepped: true,
    most: () => 0,
    values: (grid, drawn) => grid.instance && Uint8Array.from(drawn, (i) => (255 * (colorOfActor(grid.instance[i]) + 0.5)) / ACTORS.length),
    legend(grids) {
      const counts = new Map();
      for (const grid of grids) for (const number of grid.instance ?? []) if (number) counts.set(number, (counts.get(number) ?? 0) + 1);
      const rows = [...counts].sort((a, b) => b[1] - a[1]).slice(0, ACTORS.length - 1).map(([number, count]) => {
        const name = make('th', { scope: 'row' }, swatch(ACTORS[colorOfActor(number)]), make('span', { class: 'name' }, `actor ${number}`));
        return make('tr', {}, name, make('td', { class: 'count' }, grouped(count)));
      });
      const table = make('table', { class: 'knowledge', 'aria-label': 'Actors with most voxels in this frame' }, make('tbody', {}, ...rows));
      return make('section', { id: 'ramp' }, make('h2', {}, 'Actors'), table);
    },
  },
  evidence: {
    label: 'inferred or seen',
    colors: KNOWLEDGE.map(({ color }) => color),
    stepped: true,
    most: () => 0,
    values(grid, drawn) {
      return grid.flags && Uint8Array.from(drawn, (i) => (255 * (knowledgeOf(grid.flags[i]) + 0.5)) / KNOWLEDGE.length);
    },
    legend(grids, runs) {
      const counts = grids.filter((grid) => grid.flags).map((grid) => countBy(grid.flags.map(knowledgeOf), KNOWLEDGE.length));
      const rows = KNOWLEDGE.map(({ name, color }, place) => {
        const cells = counts.map((count) => make('td', { class: 'count' }, grouped(count[place])));
        return make('tr', {}, make('th', { scope: 'row' }, swatch(color), make('span', { class: 'name' }, name)), ...cells);
      });
      const names = counts.length > 1 ? runs.map((name) => make('th', { scope: 'col', title: name }, make('span', {}, name))) : [];
      const head = make('thead', {}, make('tr', {}, ...(names.length ? [make('td'), ...names] : [])));
      const table = make('table', { class: 'knowledge', 'aria-label': 'Evidence of the voxels of this frame' }, head, make('tbody', {}, ...rows));
      return make('section', { id: 'ramp' }, make('h2', {}, 'Inferred or seen'), table);
    },
  },
};

/** Returns the names of the modes that a scene has data for. */
function modesOf(scene) {
  const has = (field) => scene.panels.some((panel) => panel.evidence.includes(field));
  const available = { votes: scene.panels.length > 0, confidence: has('occupied'), views: has('views'), actor: has('instance'), evidence: has('flags') };
  return Object.keys(MODES).filter((name) => available[name] ?? true);
}

const ramps = new Map();

/** Returns the texture of a mode's colours. */
function rampOf(mode) {
  if (!ramps.has(mode)) ramps.set(mode, colorTexture(mode.colors, mode.stepped ? THREE.NearestFilter : THREE.LinearFilter));
  return ramps.get(mode);
}
