// The form for commands: fields, presets and the map of the replay buffer.
import { outside, presets, ranges, Similar } from "./buffer.js";
import { command as text, nice } from "./format.js";
import { $, legend, made, setText } from "./page.js";
import { Plane } from "./plane.js";

const FIELDS = ["desired-return", "desired-horizon"];

// A value rounded to one digit more than the step.
const rounded = (x, step) => Number(Number(x).toFixed(Math.min(6, Math.max(1, 1 - Math.floor(Math.log10(step))))));

export class CommandForm {
  // onChange(): the chosen command has changed; onEnter(): handles the Enter key, returns true if it did.
  constructor({ onChange, onEnter }) {
    Object.assign(this, { contents: null, active: null, onChange });
    this.map = new Plane($("map"), { x: "desired return", y: "desired horizon, steps", label: "Map of commands and of the episodes in the replay buffer", describedBy: "similar" });
    for (const name of FIELDS) {
      const [slider, field] = [$(`${name}-slider`), $(name)];
      slider.addEventListener("input", () => { field.value = rounded(slider.value, Number(slider.step)); this.choose(); });
      field.addEventListener("input", () => { slider.value = field.value; this.choose(); });
      field.addEventListener("keydown", (event) => {
        if (event.key === "Enter" && onEnter()) event.preventDefault();
      });
    }
    this.map.svg.addEventListener("click", (event) => {
      if (this.contents) this.fill(...this.map.at(event));
    });
  }

  // Update fields, sliders, presets and map to the replay buffer.
  update({ hello, status, contents, obeyed }) {
    if (!contents.returns.length) return;
    const isFirst = !this.contents;
    this.contents = contents;
    this.follows = hello.config.horizon_equals_return;
    const [xs, ys] = ranges(contents);
    this.step = nice((xs[1] - xs[0]) / 200);
    Object.assign($("desired-return-slider"), { step: this.step, min: rounded(Math.floor(xs[0] / this.step) * this.step, this.step), max: rounded(Math.ceil(xs[1] / this.step) * this.step, this.step) });
    Object.assign($("desired-horizon-slider"), { min: 1, max: Math.max(2, Math.round(ys[1])) });
    for (const id of ["desired-horizon", "desired-horizon-slider"]) $(id).disabled = this.follows;
    this.showVersions(contents.versions);
    this.showPresets(presets(contents, status?.environment ?? ""));
    this.similar = new Similar(contents, xs, ys);
    this.showMap(contents, obeyed, xs, ys);
    // At first as in the run's evaluations.
    this.sampling = hello.config.eval_temperature || 1;
    if (isFirst) $("greedy").checked = hello.config.eval_temperature === 0;
    if (isFirst) this.fill(contents.desired_return, contents.desired_horizon);
    else this.choose();
  }

  showVersions(kept) {
    const versions = $("version"), chosen = versions.value;
    const known = ["latest", "best", ...kept.map(String).reverse()];
    if (known.join() !== [...versions.options].map((o) => o.value).join())
      versions.replaceChildren(...known.map((value) => new Option(value, value, false, value === chosen)));
  }

  showPresets(found) {
    const shown = JSON.stringify(found);
    if (shown === this.shownPresets) return;
    this.shownPresets = shown;
    $("presets").replaceChildren(
      ...found.map(([name, r, h]) => {
        const button = made("button", { type: "button", textContent: name, title: text(r, h) });
        button.addEventListener("click", () => this.fill(r, h));
        return button;
      }),
    );
  }

  showMap(contents, obeyed, xs, ys) {
    const obeys = obeyed && obeyed.low !== null;
    this.map.draw(() => {
      this.map.axes(xs, ys);
      this.similar.shade(this.map);
      if (obeys) this.map.band(obeyed.low, obeyed.high, "obeys");
      contents.returns.forEach((x, i) => this.map.dot(x, contents.lengths[i], { class: "episode", opacity: 0.5, r: 2 }));
    });
    legend($("map-legend"), [
      ["chosen command", "diamond", "chosen"],
      ["active command", "cross", "active"],
      ["episode in the buffer", "dot", "episode"],
      ["no similar episodes", "band", "unseen"],
      ...(obeys ? [["returns that the agent obtains", "band", "obeys"]] : []),
    ]);
    setText($("map-said"), `Click the map to choose a command. Arrows at the edge mark commands outside it.${outside(contents, this.map)}`);
  }

  fill(r, h) {
    for (const [name, value] of [["desired-return", rounded(r, this.step)], ["desired-horizon", Math.max(1, Math.round(h))]])
      for (const id of [name, `${name}-slider`]) $(id).value = value;
    this.choose();
  }

  // The command in the fields.
  get chosen() {
    const desired_return = Number($("desired-return").value);
    return {
      desired_return,
      desired_horizon: this.follows ? Math.max(0, Math.floor(desired_return)) : Math.round(Number($("desired-horizon").value)),
    };
  }

  get temperature() {
    return $("greedy").checked ? 0 : this.sampling;
  }

  // Show the chosen command on the map, and whether the buffer has similar episodes.
  choose() {
    if (!this.contents) return;
    const { desired_return: r, desired_horizon: h } = this.chosen;
    if (this.follows) for (const id of ["desired-horizon", "desired-horizon-slider"]) $(id).value = h;
    this.map.move("chosen", "diamond", r, h, 7);
    setText($("similar"), `${this.similar.has(r, h) ? "The buffer has similar episodes." : "No similar episodes: the agent has to generalise."}${this.map.has(r, h) ? "" : " This command is outside the map."}`);
    this.onChange();
  }

  // The command of the running episode, after the countdown; null: there is none.
  showActive(moment) {
    if (moment) this.map.move("active", "cross", moment.desired_return, moment.desired_horizon, 6);
    else this.map.move("active", "cross", null);
  }
}
