// The probabilities of the next action: a bar for every value, or a histogram where there are many.
import { percent } from "./format.js";
import { $, made, svg } from "./page.js";

const MOST_BARS = 8, MOST_COMPONENTS = 12, HEIGHT = 36;

export class Actions {
  constructor() {
    this.components = [];
  }

  // The names of an episode's actions: [{name, values}].
  setComponents(components) {
    if (JSON.stringify(components) === JSON.stringify(this.components)) return;
    this.components = components;
    let first = 0;
    this.parts = components.slice(0, MOST_COMPONENTS).map(({ name, values }) => {
      const part = values.length > MOST_BARS ? new Histogram(name, values) : new Bars(name, values);
      part.range = [first, (first += values.length)];
      return part;
    });
    const more = components.length - MOST_COMPONENTS;
    $("actions").replaceChildren(...this.parts.map((p) => p.element), ...(more > 0 ? [made("p", { className: "said", textContent: `and ${more} more components` })] : []));
  }

  show(probabilities) {
    for (const part of this.parts ?? []) part.show(probabilities.slice(...part.range));
  }

  // Names of the values of an action.
  text(action) {
    return action == null ? "–" : [action].flat().slice(0, MOST_COMPONENTS).map((value, k) => this.components[k]?.values[value] ?? value).join(", ");
  }
}

class Bars {
  constructor(name, values) {
    this.element = made("ul", { className: "bars" });
    this.element.setAttribute("aria-label", name || "Probabilities of the next action");
    if (name) this.element.append(made("li", { className: "component", textContent: name }));
    this.rows = values.map((value) => {
      const row = made("li"), track = made("span", { className: "track" }), bar = made("span", { className: "bar" }), share = made("span", { className: "share" });
      track.append(bar);
      row.append(made("span", { className: "value", textContent: value }), track, share);
      this.element.append(row);
      return [bar, share];
    });
  }

  show(shares) {
    this.rows.forEach(([bar, share], i) => {
      bar.style.width = `${100 * (shares[i] ?? 0)}%`;
      share.textContent = shares.length ? percent(shares[i]) : "–";
    });
  }
}

class Histogram {
  constructor(name, values) {
    this.values = values;
    this.element = made("figure", { className: "histogram" });
    this.caption = made("figcaption");
    this.name = name;
    this.picture = svg("svg", { role: "img", viewBox: `0 0 ${values.length} ${HEIGHT}`, preserveAspectRatio: "none", "aria-label": `Probabilities of ${name || "the next action"}, ${values[0]} to ${values.at(-1)}` });
    this.columns = values.map((_, i) => svg("rect", { class: "column", x: i + 0.1, width: 0.8, y: HEIGHT, height: 0 }));
    this.picture.append(...this.columns);
    const ends = made("p", { className: "ends" });
    ends.append(made("span", { textContent: values[0] }), made("span", { textContent: values.at(-1) }));
    this.element.append(this.caption, this.picture, ends);
  }

  show(shares) {
    const most = Math.max(...shares, 0);
    this.columns.forEach((column, i) => {
      const height = most ? (HEIGHT * (shares[i] ?? 0)) / most : 0;
      column.setAttribute("y", HEIGHT - height);
      column.setAttribute("height", height);
    });
    const likeliest = shares.length ? `most likely ${this.values[shares.indexOf(most)]} (${percent(most)})` : "–";
    this.caption.textContent = this.name ? `${this.name}: ${likeliest}` : likeliest;
  }
}
