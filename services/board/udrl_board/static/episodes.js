// The finished episodes: commanded and obtained returns, as a table and a plot.
import { count, number } from "./format.js";
import { $, legend, setText } from "./page.js";
import { Plane } from "./plane.js";

export class Episodes {
  constructor() {
    this.ended = [];
    this.plot = new Plane($("obeyed"), { x: "commanded return", y: "obtained return", label: "Commanded and obtained returns", describedBy: "obeyed-said" });
    legend($("obeyed-legend"), [["episode", "dot", "episode"], ["command changed during the episode", "dot", "episode pale"], ["obtained = commanded", "line", "even"]]);
  }

  add(m) {
    this.ended.push(m);
    $("ended").hidden = false;
    const how = [m.temperature === 0 ? "greedy" : "sampled", m.is_changed ? "command changed" : "", m.truncated ? "step limit" : ""].filter(Boolean).join(", ");
    const row = $("episodes").tBodies[0].insertRow(0);
    for (const value of [number(m.commanded_return), number(m.obtained), number(m.commanded_horizon), number(m.step), m.seed, m.version, how]) row.insertCell().textContent = value;
    this.draw();
  }

  draw() {
    const both = this.ended.flatMap((m) => [m.commanded_return, m.obtained]);
    const low = Math.min(0, ...both), high = Math.max(1, ...both), room = 0.08 * (high - low);
    const ends = [low - room, high + room];
    this.plot.draw(() => {
      this.plot.axes(ends, ends);
      this.plot.line(ends[0], ends[0], ends[1], ends[1], "even");
      for (const m of this.ended) this.plot.dot(m.commanded_return, m.obtained, { class: m.is_changed ? "episode pale" : "episode", r: 4 });
    });
    setText($("obeyed-said"), `${count(this.ended.length, "episode")}.`);
  }
}
