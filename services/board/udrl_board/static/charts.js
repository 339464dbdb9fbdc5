// Lines against env steps, drawn by uPlot: lines with bands, a cursor that reads them, zoom by dragging.
import uPlot from "./vendor/uplot/uPlot.esm.js";

const MOST_POINTS = 1500;

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

export const short = (x) =>
  x == null ? "" : Math.abs(x) >= 1e6 ? `${(x / 1e6).toFixed(2)}M` : Math.abs(x) >= 1e4 ? `${Math.round(x / 1e3)}K` : `${Math.round(x * 100) / 100}`;

// Every n-th row, the last one always: a chart has a thousand pixels.
export function thin(rows) {
  const n = Math.ceil(rows.length / MOST_POINTS);
  return n < 2 ? rows : rows.filter((_, i) => (rows.length - 1 - i) % n === 0);
}

// One sorted axis for rows that were measured at different env steps; what a row lacks is undefined.
export function merge(...tables) {
  const at = new Map();
  for (const [rows, x, columns] of tables)
    for (const row of rows) {
      const key = row[x];
      const held = at.get(key) ?? {};
      for (const [name, get] of Object.entries(columns)) held[name] = get(row);
      at.set(key, held);
    }
  const xs = [...at.keys()].sort((a, b) => a - b);
  return { xs, column: (name) => xs.map((x) => at.get(x)[name]) };
}

// lines: [{label, colour, width?, dash?, points?}]; bands: [[upper, lower, colour]] by the lines' numbers.
export class Chart {
  constructor(place, lines, bands = []) {
    this.place = place;
    this.height = place.classList.contains("small") ? 130 : 280;
    this.lines = lines;
    this.bands = bands;
    this.data = [[], ...lines.map(() => [])];
    new ResizeObserver(() => this.resize()).observe(place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  show(xs, columns) {
    this.data = [xs, ...columns];
    this.place.dataset.points = xs.length;
    if (!xs.length) return;
    if (this.plot) this.plot.setData(this.data);
    else this.redraw();
  }

  resize() {
    this.plot?.setSize({ width: this.place.clientWidth, height: this.height });
  }

  redraw() {
    if (!this.data[0].length) return;
    this.plot?.destroy();
    const axis = { stroke: colour("faint"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") } };
    this.plot = new uPlot(
      {
        width: this.place.clientWidth,
        height: this.height,
        scales: { x: { time: false } },
        axes: [
          { ...axis, values: (_, at) => at.map(short) },
          { ...axis, size: 56, values: (_, at) => at.map(short) },
        ],
        series: [
          { label: "env steps", value: (_, x) => short(x) },
          ...this.lines.map((line) => ({
            label: line.label,
            stroke: colour(line.colour),
            width: line.width ?? 1,
            dash: line.dash,
            spanGaps: true,
            points: { show: line.points ?? false, size: 5 },
            value: (_, y) => short(y),
          })),
        ],
        bands: this.bands.map(([upper, lower, name]) => ({ series: [upper + 1, lower + 1], fill: `color-mix(in srgb, ${colour(name)} 22%, transparent)` })),
        cursor: { y: false },
      },
      this.data,
      this.place,
    );
  }
}
