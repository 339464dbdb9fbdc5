// The plane of returns and lengths: what the replay buffer has seen, and what somebody asks for.
import { labels, nice } from "./page.js";

const SVG = "http://www.w3.org/2000/svg";
const LEFT = 52, BOTTOM = 34, TOP = 8, RIGHT = 10;
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
  const step = nice((high - low) / 5);
  const found = [];
  for (let t = Math.ceil(low / step) * step; t <= high; t += step) found.push(Math.round(t / step) * step);
  return found;
}

const bounded = (value, [low, high]) => Math.min(high, Math.max(low, value));

// One unit of its picture is one pixel of the page, so that text is as large as elsewhere.
export class Plane {
  constructor(place, { x, y, label }) {
    Object.assign(this, { place, names: { x, y }, paint: null, marks: new Map() });
    this.svg = element("svg", { role: "img", "aria-label": label });
    place.append(this.svg);
    new ResizeObserver(() => {
      if (this.paint && this.place.clientWidth !== this.seenWidth) this.draw(this.paint);
    }).observe(place);
  }

  // Draw everything anew, now and whenever the page changes its width: paint() calls axes() and the others.
  draw(paint) {
    this.paint = paint;
    this.seenWidth = this.place.clientWidth;
    this.width = bounded(this.seenWidth || 520, [260, 640]);
    this.height = Math.round(bounded(0.58 * this.width, [230, 330]));
    this.svg.setAttribute("viewBox", `0 0 ${this.width} ${this.height}`);
    this.svg.replaceChildren();
    paint();
    for (const [name, [x, y, size]] of this.marks) this.mark(name, x, y, size);
  }

  axes(xs, ys) {
    this.xs = xs;
    this.ys = ys;
    const bottom = this.height - BOTTOM, right = this.width - RIGHT;
    const [across, up] = [ticks(xs), ticks(ys)];
    labels(across).forEach((label, i) => {
      const x = this.x(across[i]);
      this.svg.append(element("line", { class: "axis", x1: x, x2: x, y1: TOP, y2: bottom }));
      this.svg.append(element("text", { x, y: bottom + 14, "text-anchor": "middle" }, label));
    });
    labels(up).forEach((label, i) => {
      const y = this.y(up[i]);
      this.svg.append(element("line", { class: "axis", x1: LEFT, x2: right, y1: y, y2: y }));
      this.svg.append(element("text", { x: LEFT - 5, y: y + 4, "text-anchor": "end" }, label));
    });
    this.svg.append(element("text", { x: right, y: this.height - 4, "text-anchor": "end" }, this.names.x));
    this.svg.append(element("text", { x: 12, y: TOP, transform: `rotate(-90 12 ${TOP})`, "text-anchor": "end" }, this.names.y));
  }

  x(value) {
    return LEFT + ((value - this.xs[0]) / (this.xs[1] - this.xs[0])) * (this.width - LEFT - RIGHT);
  }

  y(value) {
    return this.height - BOTTOM - ((value - this.ys[0]) / (this.ys[1] - this.ys[0])) * (this.height - BOTTOM - TOP);
  }

  // The values at a place of the screen.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [
      this.xs[0] + ((point.x - LEFT) / (this.width - LEFT - RIGHT)) * (this.xs[1] - this.xs[0]),
      this.ys[0] + ((this.height - BOTTOM - point.y) / (this.height - BOTTOM - TOP)) * (this.ys[1] - this.ys[0]),
    ];
  }

  dot(x, y, attributes) {
    this.svg.append(element("circle", { cx: this.x(x), cy: this.y(y), r: 3, ...attributes }));
  }

  cross(x, y, name, size = 4) {
    const [a, b] = [this.x(bounded(x, this.xs)), this.y(bounded(y, this.ys))];
    const made = element("path", { class: name, d: `M${a - size},${b - size}l${2 * size},${2 * size}m0,${-2 * size}l${-2 * size},${2 * size}` });
    this.svg.append(made);
    return made;
  }

  // A cross that there is one of, and that moves; what lies beyond the axes is at their ends.
  mark(name, x, y, size = 8) {
    this.marks.set(name, [x, y, size]);
    this.svg.querySelector(`.${name}`)?.remove();
    if (x != null && this.xs) this.cross(x, y, name, size);
  }

  // A range of the horizontal axis, as far as it is in the picture.
  band(low, high, name) {
    const [a, b] = [this.x(bounded(low, this.xs)), this.x(bounded(high, this.xs))];
    this.svg.append(element("rect", { class: name, x: a, y: TOP, width: b - a, height: this.height - BOTTOM - TOP }));
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
