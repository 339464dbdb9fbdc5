// Commanding the agent: what to ask for, the episode as it goes on, and what came of each.
import { Plane, Seen, spans } from "./map.js";
import { $, facts, nice, number } from "./page.js";

const FIELDS = ["desired-return", "desired-horizon"];
const round = (x) => (Math.abs(x) < 1 ? Number(Number(x).toPrecision(4)) : Math.round(x * 1000) / 1000);

// Probabilities of all values; of several components the likeliest value of each.
function nextAction({ probabilities, components }) {
  const share = (p, value) => `${value}: ${Math.round(100 * p)}\u00a0%`;
  if (!probabilities.length) return "–";
  if (components.length === 1) return probabilities.map(share).join(", ");
  let first = 0;
  return components.map((n) => {
    const shares = probabilities.slice(first, first += n);
    const likeliest = Math.max(...shares);
    return share(likeliest, shares.indexOf(likeliest));
  }).join(", ");
}

export class Command {
  constructor() {
    this.map = new Plane($("map"), { x: "desired return", y: "desired horizon", label: "Commands: what the replay buffer has seen, and what is asked for" });
    this.obeyed = new Plane($("obeyed"), { x: "asked", y: "obtained", label: "Asked against obtained returns" });
    this.ended = [];
    this.contents = null;
    this.moment = null;
    this.orders = [];
    this.url = null;
    for (const name of FIELDS) {
      const [slider, field] = [$(`${name}-slider`), $(name)];
      slider.addEventListener("input", () => { field.value = round(slider.value); this.choose(); });
      field.addEventListener("input", () => { slider.value = field.value; this.choose(); });
      // Enter means the button that is meant: an episode that goes on is told, not thrown away.
      field.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" || !this.acts()) return;
        event.preventDefault();
        this.tell();
      });
    }
    this.map.svg.addEventListener("click", (event) => {
      if (!this.contents) return;
      const [r, h] = this.map.at(event), step = Number($("desired-return-slider").step);
      this.fill(Math.round(r / step) * step, h);
    });
    $("order").addEventListener("submit", (event) => { event.preventDefault(); this.begin(); });
    $("tell").addEventListener("click", () => this.tell());
    $("pause").addEventListener("click", () => this.send({ do: "pause", paused: !this.moment?.paused }));
    $("step").addEventListener("click", () => this.send({ do: "step" }));
    $("greedy").addEventListener("change", () => { if (this.acts()) this.send({ do: "tell", temperature: this.temperature() }); });
    this.drawObeyed();
    this.buttons();
  }

  // What the run says of the buffer: fields, sliders and map follow.
  know({ hello, contents, obeyed }) {
    if (!contents.returns.length) return;
    const first = !this.contents;
    this.contents = contents;
    this.follows = hello.config.desired_horizon === "return";
    const [xs, ys] = spans(contents, [[0, 1]]);
    const step = nice((xs[1] - xs[0]) / 200), slider = $("desired-return-slider");
    Object.assign(slider, { step, min: round(Math.floor(xs[0] / step) * step), max: round(Math.ceil(xs[1] / step) * step) });
    Object.assign($("desired-horizon-slider"), { min: 1, max: Math.max(2, Math.round(ys[1])) });
    for (const id of ["desired-horizon", "desired-horizon-slider"]) $(id).disabled = this.follows;
    const versions = $("version"), chosen = versions.value;
    const known = ["latest", "best", ...contents.versions.map(String).reverse()];
    if (known.join() !== [...versions.options].map((o) => o.value).join())
      versions.replaceChildren(...known.map((value) => new Option(value, value, false, value === chosen)));
    this.seen = new Seen(contents, xs, ys);
    this.map.draw(() => {
      this.map.axes(xs, ys);
      this.seen.shade(this.map);
      if (obeyed && obeyed.low !== null) this.map.band(obeyed.low, obeyed.high, "obeys");
      contents.returns.forEach((x, i) => this.map.dot(x, contents.lengths[i], { class: "episode", opacity: 0.5, r: 2 }));
    });
    if (first) this.fill(contents.desired_return, contents.desired_horizon);
    else this.choose();
    this.buttons();
  }

  fill(r, h) {
    for (const [name, value] of [["desired-return", round(r)], ["desired-horizon", Math.max(1, Math.round(h))]])
      for (const id of [name, `${name}-slider`]) $(id).value = value;
    this.choose();
  }

  temperature() {
    return $("greedy").checked ? 0 : 1;
  }

  command() {
    const desired_return = Number($("desired-return").value);
    return {
      desired_return,
      desired_horizon: this.follows ? Math.max(0, Math.floor(desired_return)) : Math.round(Number($("desired-horizon").value)),
    };
  }

  // Show on the map what is chosen, and say whether the buffer has seen the like.
  choose() {
    if (!this.contents) return;
    const { desired_return: r, desired_horizon: h } = this.command();
    if (this.follows) for (const id of ["desired-horizon", "desired-horizon-slider"]) $(id).value = h;
    this.map.mark("told", r, h);
    $("unseen").textContent = this.seen.has(r, h)
      ? "The replay buffer has episodes like this."
      : "The replay buffer has no episode like this: the agent has to make do without an example.";
  }

  begin() {
    const version = $("version").value;
    this.send({
      do: "begin", ...this.command(), temperature: this.temperature(), seed: Number($("seed").value),
      version: /^\d+$/.test(version) ? Number(version) : version,
    });
  }

  tell() {
    if ($("order").reportValidity()) this.send({ do: "tell", ...this.command(), temperature: this.temperature() });
  }

  send(order) {
    $("outcome").textContent = "";
    if (this.socket?.readyState === WebSocket.OPEN) { this.socket.send(JSON.stringify(order)); return; }
    this.orders = order.do === "begin" ? [order] : [];
    if (this.socket?.readyState !== WebSocket.CONNECTING) this.connect();
  }

  connect() {
    const url = new URL("stage", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = new WebSocket(url);
    this.socket.binaryType = "blob";
    this.socket.addEventListener("open", () => this.orders.splice(0).forEach((o) => this.socket.send(JSON.stringify(o))));
    this.socket.addEventListener("message", ({ data }) => (data instanceof Blob ? this.picture(data) : this.said(JSON.parse(data))));
    this.socket.addEventListener("close", ({ reason }) => {
      if (this.moment && !this.moment.over) $("outcome").textContent = `${reason || "The board's server left"}; the episode is lost.`;
      this.moment = null;
      this.map.mark("left", null);
      this.buttons();
    });
  }

  picture(blob) {
    const image = $("picture");
    if (this.url) URL.revokeObjectURL(this.url);
    image.src = this.url = URL.createObjectURL(blob);
    image.hidden = false;
    $("no-picture").hidden = true;
  }

  said(message) {
    if (message.problem !== undefined) {
      $("outcome").textContent = message.problem;
      if (message.is_over) {
        this.moment = null;
        this.map.mark("left", null);
      }
      this.buttons();
      return;
    }
    const fresh = !this.moment?.over && message.over;
    this.moment = message;
    if (!message.picture) {
      $("picture").hidden = true;
      $("no-picture").hidden = false;
      $("no-picture").textContent = "This environment draws no pictures.";
    }
    facts($("moment"), [
      ["step", number(message.step)],
      ["obtained", number(message.obtained)],
      ["still desired", number(message.desired_return)],
      ["within", `${number(Math.max(message.desired_horizon, 1))} steps`],
      ["last action", [message.action ?? "–"].flat().join(", ")],
      ["next action", nextAction(message)],
    ]);
    if (message.over) this.map.mark("left", null);
    else this.map.mark("left", message.desired_return, message.desired_horizon, 5);
    if (fresh) this.end(message);
    this.buttons();
  }

  acts() {
    return Boolean(this.moment && !this.moment.over);
  }

  buttons() {
    const on = this.acts();
    $("begin").disabled = !this.contents;
    $("tell").disabled = $("pause").disabled = !on;
    $("step").disabled = !(on && this.moment.paused);
    $("pause").textContent = on && this.moment.paused ? "Go on" : "Pause";
    $("pause").setAttribute("aria-pressed", String(on && this.moment.paused));
  }

  end(m) {
    this.ended.push(m);
    const how = [m.temperature === 0 ? "greedy" : "sampled", m.was_told ? "told anew on the way" : "", m.truncated ? "cut" : ""].filter(Boolean).join(", ");
    const row = $("episodes").tBodies[0].insertRow(0);
    for (const value of [m.seed, m.version, number(m.asked_return), number(m.asked_horizon), number(m.obtained), number(m.step), how]) row.insertCell().textContent = value;
    $("outcome").textContent = `Asked for ${number(m.asked_return)} within ${number(m.asked_horizon)} steps, obtained ${number(m.obtained)} in ${number(m.step)}.`;
    this.drawObeyed();
  }

  drawObeyed() {
    const n = this.ended.length;
    const both = this.ended.flatMap((m) => [m.asked_return, m.obtained]);
    const low = Math.min(0, ...both), high = Math.max(1, ...both), room = 0.08 * (high - low);
    const ends = [low - room, high + room];
    this.obeyed.draw(() => {
      this.obeyed.axes(ends, ends);
      this.obeyed.line(ends[0], ends[0], ends[1], ends[1], "even");
      for (const m of this.ended) this.obeyed.dot(m.asked_return, m.obtained, { class: "episode", r: 4, opacity: m.was_told ? 0.4 : 0.9 });
    });
    if (n) $("obeyed-said").textContent = `${n} ${n === 1 ? "episode" : "episodes"}; on the dashed line asked and obtained are equal. Pale: told anew on the way.`;
  }
}
