// Lines against env steps, drawn by uPlot: lines with bands, a cursor that reads them, zoom by dragging.
import uPlot from "./vendor/uplot/uPlot.esm.js";
import { labels } from "./page.js";

const MOST_POINTS = 1500;

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

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

export class Chart {
  // lines: [{colour, width?, dash?, points?, hollow?}]; bands: [[upper, lower, colour]] by the lines' numbers;
  // legend: [[label, colour, "line" | "dot" | "band"]].
  constructor(place, said, lines, { bands = [], legend = [] } = {}) {
    Object.assign(this, { place, said, lines, bands });
    this.height = place.classList.contains("small") ? 150 : 300;
    this.data = [[], ...lines.map(() => [])];
    if (legend.length) place.before(this.legend(legend));
    new ResizeObserver(() => this.resize()).observe(place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  legend(entries) {
    const list = Object.assign(document.createElement("ul"), { className: "legend" });
    for (const [label, name, kind] of entries) {
      const item = Object.assign(document.createElement("li"), { textContent: label });
      item.prepend(Object.assign(document.createElement("span"), { className: `swatch ${kind} ${name}` }));
      list.append(item);
    }
    return list;
  }

  // summary: what is said below; read(i): what is said of the i-th place, under the cursor.
  show(xs, columns, summary, read) {
    this.data = [xs, ...columns];
    this.place.dataset.points = xs.length;
    Object.assign(this, { summary, read });
    if (!xs.length) return;
    if (this.plot) this.update();
    else this.redraw();
    this.say(this.plot.cursor.idx);
  }

  // A part that somebody dragged open stays open.
  update() {
    const { min, max } = this.plot.scales.x, shown = this.plot.data[0];
    const isWhole = min <= shown[0] && max >= shown.at(-1);
    this.plot.setData(this.data, isWhole);
    if (!isWhole) this.plot.setScale("x", { min, max });
  }

  say(place) {
    const text = place == null ? this.summary : this.read(place);
    if (this.said.textContent !== text) this.said.textContent = text;
  }

  resize() {
    this.plot?.setSize({ width: this.place.clientWidth, height: this.height });
  }

  redraw() {
    if (!this.data[0].length) return;
    this.plot?.destroy();
    const axis = {
      stroke: colour("faint"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") },
      values: (_, at) => labels(at),
    };
    this.plot = new uPlot(
      {
        width: this.place.clientWidth,
        height: this.height,
        scales: { x: { time: false } },
        axes: [axis, { ...axis, size: 56, space: 24 }],
        series: [
          {},
          ...this.lines.map((line) => ({
            stroke: colour(line.colour),
            width: line.width ?? 1,
            dash: line.dash,
            spanGaps: true,
            paths: line.hollow ? () => null : undefined,
            points: { show: line.points ?? line.hollow ?? false, size: line.hollow ? 12 : 5, width: line.hollow ? 2 : 1, fill: colour("card") },
          })),
        ],
        bands: this.bands.map(([upper, lower, name]) => ({ series: [upper + 1, lower + 1], fill: `color-mix(in srgb, ${colour(name)} 22%, transparent)` })),
        legend: { show: false },
        cursor: { y: false, points: { fill: (_, line) => colour(this.lines[line - 1].colour), size: 7 } },
        hooks: { setCursor: [(plot) => this.say(plot.cursor.idx)] },
      },
      this.data,
      this.place,
    );
  }
}
