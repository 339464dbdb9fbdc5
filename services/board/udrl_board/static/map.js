// The plane of returns and lengths: what the replay buffer has seen, and what somebody asks for.
const SVG = "http://www.w3.org/2000/svg";
const WIDTH = 520, HEIGHT = 300, LEFT = 52, BOTTOM = 34, TOP = 8, RIGHT = 10;
const CELLS = 36;

function element(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  return made;
}

const span = (numbers, pad) => {
  let low = Math.min(...numbers), high = Math.max(...numbers);
  if (!(high > low)) [low, high] = [low - 1, high + 1];
  const room = pad * (high - low);
  return [low - room, high + room];
};

function ticks([low, high]) {
  const rough = (high - low) / 5, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
  const found = [];
  for (let t = Math.ceil(low / step) * step; t <= high; t += step) found.push(Math.round(t / step) * step);
  return found;
}

export class Plane {
  constructor(place, { x, y, label }) {
    this.names = { x, y };
    this.svg = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": label });
    place.append(this.svg);
  }

  // Draw the axes anew for some spans; what was drawn is gone.
  begin(xs, ys) {
    this.xs = xs;
    this.ys = ys;
    this.svg.replaceChildren();
    const bottom = HEIGHT - BOTTOM;
    for (const t of ticks(xs)) {
      this.svg.append(element("line", { class: "axis", x1: this.x(t), x2: this.x(t), y1: TOP, y2: bottom }));
      this.svg.append(element("text", { x: this.x(t), y: bottom + 14, "text-anchor": "middle" }, `${+t.toPrecision(6)}`));
    }
    for (const t of ticks(ys)) {
      this.svg.append(element("line", { class: "axis", x1: LEFT, x2: WIDTH - RIGHT, y1: this.y(t), y2: this.y(t) }));
      this.svg.append(element("text", { x: LEFT - 5, y: this.y(t) + 4, "text-anchor": "end" }, `${+t.toPrecision(6)}`));
    }
    this.svg.append(element("text", { x: WIDTH - RIGHT, y: HEIGHT - 4, "text-anchor": "end" }, this.names.x));
    this.svg.append(element("text", { x: 12, y: TOP, transform: `rotate(-90 12 ${TOP})`, "text-anchor": "end" }, this.names.y));
  }

  x(value) {
    return LEFT + ((value - this.xs[0]) / (this.xs[1] - this.xs[0])) * (WIDTH - LEFT - RIGHT);
  }

  y(value) {
    return HEIGHT - BOTTOM - ((value - this.ys[0]) / (this.ys[1] - this.ys[0])) * (HEIGHT - BOTTOM - TOP);
  }

  // The values at a place of the screen.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [
      this.xs[0] + ((point.x - LEFT) / (WIDTH - LEFT - RIGHT)) * (this.xs[1] - this.xs[0]),
      this.ys[0] + ((HEIGHT - BOTTOM - point.y) / (HEIGHT - BOTTOM - TOP)) * (this.ys[1] - this.ys[0]),
    ];
  }

  dot(x, y, attributes) {
    this.svg.append(element("circle", { cx: this.x(x), cy: this.y(y), r: 3, ...attributes }));
  }

  cross(x, y, name, size = 4) {
    const [a, b] = [this.x(x), this.y(y)];
    this.svg.append(element("path", { class: name, d: `M${a - size},${b - size}l${2 * size},${2 * size}m0,${-2 * size}l${-2 * size},${2 * size}` }));
  }

  line(x1, y1, x2, y2, name) {
    this.svg.append(element("line", { class: name, x1: this.x(x1), y1: this.y(y1), x2: this.x(x2), y2: this.y(y2) }));
  }
}

// Which cells of the plane the buffer has episodes in, or next to.
export class Seen {
  constructor(contents, xs, ys) {
    Object.assign(this, { xs, ys });
    this.cells = new Set();
    contents.returns.forEach((r, i) => {
      const [x, y] = this.cell(r, contents.lengths[i]);
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

  shade(plane) {
    const [w, h] = [(this.xs[1] - this.xs[0]) / CELLS, (this.ys[1] - this.ys[0]) / CELLS];
    for (let i = 0; i < CELLS; i++)
      for (let j = 0; j < CELLS; j++) {
        if (this.cells.has(`${i},${j}`)) continue;
        const [x, y] = [this.xs[0] + i * w, this.ys[0] + j * h];
        plane.svg.append(element("rect", { class: "unseen", x: plane.x(x), y: plane.y(y + h), width: plane.x(x + w) - plane.x(x), height: plane.y(y) - plane.y(y + h) }));
      }
  }
}

export function spans(contents, more = []) {
  const returns = [...contents.returns, ...more.map(([r]) => r)];
  const lengths = [...contents.lengths, ...more.map(([, h]) => h)];
  return [span(returns, 0.12), span(lengths, 0.12)];
}
