// The replay buffer: ranges of the map, similar episodes, and suggested commands.
import { count } from "./format.js";

const CELLS = 36;
// Names of the three presets by environment, and the default names.
const PRESETS = [[/^LunarLander/, ["Land", "Hover", "Crash quickly"]], [/./, ["Best", "Longest", "Worst and quick"]]];

const sorted = (numbers) => numbers.toSorted((a, b) => a - b);
const quantile = (numbers, q) => sorted(numbers)[Math.round(q * (numbers.length - 1))];

const padded = (low, high) => {
  if (!(high > low)) [low, high] = [low - 1, high + 1];
  const room = 0.1 * (high - low);
  return [low - room, high + room];
};

// Commands with similar episodes: that of evaluations, the longest episode, the shortest of the worst.
function suggestions(contents) {
  const episodes = contents.returns.map((r, i) => [r, contents.lengths[i]]);
  const low = quantile(contents.returns, 0.1);
  const longest = episodes.toSorted(([r, l], [s, m]) => m - l || s - r)[0];
  const worst = episodes.filter(([r]) => r <= low).toSorted(([r, l], [s, m]) => l - m || r - s)[0];
  return [[contents.desired_return, contents.desired_horizon], longest, worst];
}

// The suggestions with names, without duplicates: [[name, return, horizon]].
export function presets(contents, environment) {
  const names = PRESETS.find(([pattern]) => pattern.test(environment))[1];
  const found = suggestions(contents).map((pair, i) => [names[i], ...pair]);
  return found.filter(([, r, h], i) => found.findIndex(([, s, g]) => s === r && g === h) === i);
}

// Ranges of returns and lengths. Outliers, very low returns or very long episodes, are outside
// unless they are suggested commands.
export function ranges(contents) {
  const { returns, lengths } = contents, more = suggestions(contents);
  const far = (numbers) => 0.25 * (quantile(numbers, 0.9) - quantile(numbers, 0.1)) || Infinity;
  const low = quantile(returns, 0.1) - far(returns), high = quantile(lengths, 0.9) + far(lengths);
  const xs = [...returns.filter((r) => r >= low), ...more.map(([r]) => r)];
  const ys = [...lengths.filter((l) => l <= high), ...more.map(([, h]) => h)];
  const [bottom, top] = padded(Math.min(...ys), Math.max(...ys));
  return [padded(Math.min(...xs), Math.max(...xs)), [Math.max(0, bottom), top]];
}

export function outside({ returns, lengths }, plane) {
  const n = returns.filter((r, i) => !plane.has(r, lengths[i])).length;
  return n ? ` ${count(n, "episode is", "episodes are")} outside the map.` : "";
}

// The cells of the plane with episodes in them or next to them.
export class Similar {
  constructor({ returns, lengths }, xs, ys) {
    Object.assign(this, { xs, ys });
    this.cells = new Set();
    returns.forEach((r, i) => {
      const [x, y] = this.cell(r, lengths[i]);
      for (const dx of [-1, 0, 1]) for (const dy of [-1, 0, 1]) this.cells.add(`${x + dx},${y + dy}`);
    });
  }

  cell(r, length) {
    const part = (value, [low, high]) => Math.floor(((value - low) / (high - low)) * CELLS);
    return [part(r, this.xs), part(length, this.ys)];
  }

  has(r, length) {
    return this.cells.has(this.cell(r, length).join());
  }

  // Shade the cells without similar episodes.
  shade(plane) {
    const [w, h] = [(this.xs[1] - this.xs[0]) / CELLS, (this.ys[1] - this.ys[0]) / CELLS];
    for (let i = 0; i < CELLS; i++)
      for (let j = 0; j < CELLS; j++)
        if (!this.cells.has(`${i},${j}`)) plane.cell(this.xs[0] + i * w, this.ys[0] + j * h, w, h, "unseen");
  }
}
