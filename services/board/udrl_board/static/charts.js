// Lines against env steps, drawn by uPlot: bands, values at the cursor, zoom by dragging.
import { labels } from "./format.js";
import { made, setText } from "./page.js";
import uPlot from "./vendor/uplot/uPlot.esm.js";

const MOST_POINTS = 1500;
// Distances between the ticks of an axis of counts, e.g. env steps.
const WHOLE = [...Array(15).keys()].flatMap((power) => [1, 2, 5].map((m) => m * 10 ** power));

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const faded = (name, share) => `color-mix(in srgb, ${colour(name)} ${share}%, transparent)`;

// Every n-th row, and always the last one: a chart has about a thousand pixels.
export function thin(rows) {
  const n = Math.ceil(rows.length / MOST_POINTS);
  return n < 2 ? rows : rows.filter((_, i) => (rows.length - 1 - i) % n === 0);
}

// Moving average over up to n values.
export function smooth(values, n) {
  let sum = 0;
  return values.map((value, i) => {
    sum += value - (i >= n ? values[i - n] : 0);
    return sum / Math.min(i + 1, n);
  });
}

// One sorted axis for rows that were measured at different env steps; missing values are undefined.
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
  const names = new Set(tables.flatMap(([, , columns]) => Object.keys(columns)));
  const column = (name) => {
    if (!names.has(String(name))) throw new Error(`no column ${name}`);
    return xs.map((x) => at.get(x)[name]);
  };
  return { xs, column };
}

export class Chart {
  // lines: [{colour, width?, dash?, points?, hollow?, pale?, quiet?, counts?}], quiet: without a dot at the cursor;
  // bands: [[upper, lower, colour]] by the lines' numbers.
  constructor(place, said, lines, bands = []) {
    Object.assign(this, { place, said, lines, bands });
    this.height = place.classList.contains("small") ? 150 : 300;
    this.data = [[], ...lines.map(() => [])];
    this.reset = made("button", { type: "button", className: "reset", textContent: "Reset zoom", hidden: true });
    this.reset.addEventListener("click", () => this.plot.setData(this.data));
    place.before(this.reset);
    new ResizeObserver(() => (this.plot ? this.resize() : this.redraw())).observe(place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  // summary: the text below the chart; read(i): its text while the cursor is at point i.
  show(xs, columns, summary, read) {
    this.data = [xs, ...columns];
    this.place.dataset.points = xs.length;
    Object.assign(this, { summary, read });
    if (!xs.length) return;
    if (this.plot) this.update();
    else this.redraw();
    this.showText(this.plot?.cursor.idx);
  }

  isZoomed(xs) {
    const { min, max } = this.plot.scales.x;
    return min > xs[0] || max < xs.at(-1);
  }

  // Keeps the zoom.
  update() {
    const { min, max } = this.plot.scales.x, isZoomed = this.isZoomed(this.plot.data[0]);
    this.plot.setData(this.data, !isZoomed);
    if (isZoomed) this.plot.setScale("x", { min, max });
  }

  showText(place) {
    setText(this.said, place == null || place >= this.data[0].length ? this.summary : this.read(place));
  }

  resize() {
    if (this.place.clientWidth) this.plot.setSize({ width: this.place.clientWidth, height: this.height });
  }

  // The last value of a line at the cursor or before it.
  lastAt(plot, line, place) {
    if (line === 0) return place;
    while (place >= 0 && plot.data[line][place] == null) place--;
    return place >= 0 && plot.data[0][place] >= plot.scales.x.min ? place : null;
  }

  redraw() {
    if (!this.data[0].length || !this.place.clientWidth) return;
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
        axes: [
          { ...axis, incrs: WHOLE },
          { ...axis, size: 56, space: 24, ...(this.lines.every((line) => line.counts) && { incrs: WHOLE }) },
        ],
        series: [
          {},
          ...this.lines.map((line) => ({
            stroke: line.pale ? faded(line.colour, 35) : colour(line.colour),
            width: line.width ?? 1,
            dash: line.dash,
            spanGaps: true,
            paths: line.hollow ? () => null : undefined,
            points: { show: line.points ?? line.hollow ?? false, size: line.hollow ? 12 : 5, width: line.hollow ? 2 : 1, fill: colour("card") },
          })),
        ],
        bands: this.bands.map(([upper, lower, name]) => ({ series: [upper + 1, lower + 1], fill: faded(name, 22) })),
        legend: { show: false },
        cursor: {
          y: false,
          dataIdx: (plot, line, place) => this.lastAt(plot, line, place),
          points: {
            show: (_, line) => (line && !this.lines[line - 1].quiet ? made("div") : undefined),
            fill: (_, line) => colour(this.lines[line - 1].colour),
            size: 7,
          },
        },
        hooks: {
          setCursor: [(plot) => this.showText(plot.cursor.idx)],
          setScale: [(plot, key) => { if (key === "x" && this.plot === plot) this.reset.hidden = !this.isZoomed(plot.data[0]); }],
        },
      },
      this.data,
      this.place,
    );
    this.reset.hidden = true;
  }
}
