// Finding, filling and creating elements of the page.
const SVG = "http://www.w3.org/2000/svg";

export const $ = (id) => document.getElementById(id);

// Set a text only if it differs: screen readers announce every change.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export const made = (name, properties = {}) => Object.assign(document.createElement(name), properties);

export function svg(name, attributes = {}, text = "") {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text) element.textContent = text;
  return element;
}

export function facts(list, entries) {
  list.replaceChildren(
    ...entries.map(([name, value]) => {
      const pair = made("div");
      pair.append(made("dt", { textContent: name }), made("dd", { textContent: value }));
      return pair;
    }),
  );
}

export const lines = (list, texts) => list.replaceChildren(...texts.map((textContent) => made("li", { textContent })));

// The path of a mark centred at (x, y).
const SHAPES = {
  line: (x, y, r) => `M${x - r},${y}h${2 * r}`,
  band: (x, y, r) => `M${x - r},${y - 5}h${2 * r}v10h${-2 * r}Z`,
  dot: (x, y, r) => `M${x - r},${y}a${r},${r} 0 1,0 ${2 * r},0a${r},${r} 0 1,0 ${-2 * r},0`,
  cross: (x, y, r) => `M${x - r},${y - r}l${2 * r},${2 * r}m0,${-2 * r}l${-2 * r},${2 * r}`,
  diamond: (x, y, r) => `M${x},${y - r}l${r},${r}l${-r},${r}l${-r},${-r}Z`,
  right: (x, y, r) => `M${x},${y}l${-r},${-r}v${2 * r}Z`,
  left: (x, y, r) => `M${x},${y}l${r},${-r}v${2 * r}Z`,
  up: (x, y, r) => `M${x},${y}l${-r},${r}h${2 * r}Z`,
  down: (x, y, r) => `M${x},${y}l${-r},${-r}h${2 * r}Z`,
};

export const mark = (shape, x, y, r, name) => svg("path", { class: `mark ${name}`, d: SHAPES[shape](x, y, r) });

// entries: [[label, shape, class, dash?]].
export function legend(list, entries) {
  list.replaceChildren(
    ...entries.map(([label, shape, name, dash]) => {
      const item = made("li"), picture = svg("svg", { width: 22, height: 14, "aria-hidden": "true" });
      const drawn = mark(shape, 11, 7, { line: 11, band: 9, dot: 4 }[shape] ?? 5, name);
      if (dash) drawn.setAttribute("stroke-dasharray", dash.join(" "));
      picture.append(drawn);
      item.append(picture, label);
      return item;
    }),
  );
}
