// A scatter plot as SVG: axes, dots, marks, ranges.
import { labels, nice } from "./format.js";
import { mark, svg } from "./page.js";

const LEFT = 52, BOTTOM = 34, TOP = 10, RIGHT = 12;

const MOST_TICKS = 20;

function ticks([low, high]) {
  const step = nice((high - low) / 5);
  const found = [];
  // The number is limited because adding 1 to a huge number may not change it.
  for (let k = Math.ceil(low / step); k * step <= high && found.length < MOST_TICKS; k += 1) found.push(k * step);
  return found;
}

const bounded = (value, [low, high]) => Math.min(high, Math.max(low, value));
const within = (value, [low, high]) => value >= low && value <= high;

// One unit of the SVG is one pixel of the page, so that text has its usual size.
export class Plane {
  constructor(place, { x, y, label, describedBy }) {
    Object.assign(this, { place, names: { x, y }, paint: null, marks: new Map() });
    this.svg = svg("svg", { role: "img", "aria-label": label, "aria-describedby": describedBy });
    place.append(this.svg);
    new ResizeObserver(() => {
      if (this.paint && this.place.clientWidth !== this.drawnWidth) this.draw(this.paint);
    }).observe(place);
  }

  // Draw everything, now and whenever the width changes; paint() calls axes(), then the other methods.
  draw(paint) {
    this.paint = paint;
    this.drawnWidth = this.place.clientWidth;
    this.width = bounded(this.drawnWidth || 520, [260, 640]);
    this.height = Math.round(bounded(0.58 * this.width, [230, 330]));
    this.svg.setAttribute("viewBox", `0 0 ${this.width} ${this.height}`);
    this.svg.replaceChildren();
    paint();
    for (const [name, drawn] of this.marks) this.move(name, ...drawn);
  }

  axes(xs, ys) {
    this.xs = xs;
    this.ys = ys;
    const bottom = this.height - BOTTOM, right = this.width - RIGHT;
    const [across, up] = [ticks(xs), ticks(ys)];
    labels(across).forEach((label, i) => {
      const x = this.x(across[i]);
      this.svg.append(svg("line", { class: "axis", x1: x, x2: x, y1: TOP, y2: bottom }));
      this.svg.append(svg("text", { x, y: bottom + 14, "text-anchor": "middle" }, label));
    });
    labels(up).forEach((label, i) => {
      const y = this.y(up[i]);
      this.svg.append(svg("line", { class: "axis", x1: LEFT, x2: right, y1: y, y2: y }));
      this.svg.append(svg("text", { x: LEFT - 5, y: y + 4, "text-anchor": "end" }, label));
    });
    this.svg.append(svg("text", { x: right, y: this.height - 4, "text-anchor": "end" }, this.names.x));
    this.svg.append(svg("text", { x: 12, y: TOP, transform: `rotate(-90 12 ${TOP})`, "text-anchor": "end" }, this.names.y));
  }

  x(value) {
    return LEFT + ((value - this.xs[0]) / (this.xs[1] - this.xs[0])) * (this.width - LEFT - RIGHT);
  }

  y(value) {
    return this.height - BOTTOM - ((value - this.ys[0]) / (this.ys[1] - this.ys[0])) * (this.height - BOTTOM - TOP);
  }

  has(x, y) {
    return within(x, this.xs) && within(y, this.ys);
  }

  // The coordinates of a mouse event.
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [
      this.xs[0] + ((point.x - LEFT) / (this.width - LEFT - RIGHT)) * (this.xs[1] - this.xs[0]),
      this.ys[0] + ((this.height - BOTTOM - point.y) / (this.height - BOTTOM - TOP)) * (this.ys[1] - this.ys[0]),
    ];
  }

  // A dot; nothing is drawn outside the axes.
  dot(x, y, attributes) {
    if (this.has(x, y)) this.svg.append(svg("circle", { cx: this.x(x), cy: this.y(y), r: 3, ...attributes }));
  }

  // A mark; outside the axes it becomes an arrow at their edge.
  mark(shape, x, y, name, size = 5) {
    const arrow = x > this.xs[1] ? "right" : x < this.xs[0] ? "left" : y > this.ys[1] ? "up" : y < this.ys[0] ? "down" : null;
    const found = mark(arrow ?? shape, this.x(bounded(x, this.xs)), this.y(bounded(y, this.ys)), size, arrow ? `${name} outside` : name);
    this.svg.append(found);
    return found;
  }

  // Move the mark of a name, of which there is one; without coordinates it disappears.
  move(name, shape, x, y, size) {
    this.marks.set(name, [shape, x, y, size]);
    this.svg.querySelector(`.${name}`)?.remove();
    if (x != null && this.xs) this.mark(shape, x, y, name, size);
  }

  // A range of the x-axis, clipped to it.
  band(low, high, name) {
    const [a, b] = [this.x(bounded(low, this.xs)), this.x(bounded(high, this.xs))];
    this.svg.append(svg("rect", { class: name, x: a, y: TOP, width: b - a, height: this.height - BOTTOM - TOP }));
  }

  cell(x, y, w, h, name) {
    this.svg.append(svg("rect", { class: name, x: this.x(x), y: this.y(y + h), width: this.x(x + w) - this.x(x), height: this.y(y) - this.y(y + h) }));
  }

  line(x1, y1, x2, y2, name) {
    this.svg.append(svg("line", { class: name, x1: this.x(x1), y1: this.y(y1), x2: this.x(x2), y2: this.y(y2) }));
  }
}
