// The stage: the running episode, its controls, and the connection to the board's server.
import { Actions } from "./actions.js";
import { CommandForm } from "./command.js";
import { Episodes } from "./episodes.js";
import { command as text, count, number } from "./format.js";
import { $, facts, setText } from "./page.js";
import { shown } from "./runs.js";

export class Stage {
  constructor() {
    Object.assign(this, { moment: null, waiting: [], url: null, applied: null });
    this.actions = new Actions();
    this.episodes = new Episodes();
    this.form = new CommandForm({
      onChange: () => this.buttons(),
      // Enter changes the command of a running episode instead of starting a new one.
      onEnter: () => this.isActing && (this.change(), true),
    });
    $("command").addEventListener("submit", (event) => { event.preventDefault(); this.start(); });
    $("change").addEventListener("click", () => this.change());
    $("pause").addEventListener("click", () => this.send({ do: "pause", paused: !this.moment?.paused }));
    $("step").addEventListener("click", () => this.send({ do: "step" }));
    $("speed-of-episode").addEventListener("change", () => this.send(this.speed));
    $("greedy").addEventListener("change", () => { if (this.isActing) this.send({ do: "change", temperature: this.form.temperature }); });
    this.buttons();
  }

  update(known) {
    const isFirst = !this.form.contents;
    this.form.update(known);
    if (isFirst && this.form.contents) setText($("no-picture"), "Start an episode to watch the agent.");
    this.buttons();
  }

  get isActing() {
    return Boolean(this.moment && !this.moment.over);
  }

  get speed() {
    return { do: "speed", speed: Number($("speed-of-episode").value) };
  }

  start() {
    const version = $("version").value, { chosen, temperature } = this.form;
    this.applied = JSON.stringify(chosen);
    this.send({
      do: "start", ...chosen, temperature, seed: Number($("seed").value),
      version: /^\d+$/.test(version) ? Number(version) : version,
    });
  }

  change() {
    if (!$("command").reportValidity()) return;
    const { chosen, temperature } = this.form;
    this.applied = JSON.stringify(chosen);
    this.send({ do: "change", ...chosen, temperature });
    this.buttons();
  }

  send(request) {
    if (request.do !== "speed") setText($("outcome"), "");
    if (this.socket?.readyState === WebSocket.OPEN) { this.socket.send(JSON.stringify(request)); return; }
    if (request.do === "speed") return; // it is sent when the socket opens
    this.waiting = request.do === "start" ? [request] : [];
    if (this.socket?.readyState !== WebSocket.CONNECTING) this.connect();
  }

  connect() {
    const url = new URL(`stage?number=${shown}`, location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = new WebSocket(url);
    this.socket.binaryType = "blob";
    this.socket.addEventListener("open", () => {
      for (const request of [this.speed, ...this.waiting.splice(0)]) this.socket.send(JSON.stringify(request));
    });
    this.socket.addEventListener("message", ({ data }) => {
      if (data instanceof Blob) this.showPicture(data);
      else this.receive(JSON.parse(data));
    });
    this.socket.addEventListener("close", ({ reason }) => {
      if (this.isActing) setText($("outcome"), `${reason || "The connection to the board's server is lost"}; the episode is aborted.`);
      this.clearEpisode();
    });
  }

  clearEpisode() {
    this.moment = null;
    this.form.showActive(null);
    this.buttons();
  }

  receive(message) {
    if (message.problem !== undefined) {
      setText($("outcome"), message.problem);
      if (message.is_over) this.clearEpisode();
      return;
    }
    const isEnd = this.isActing && message.over;
    this.moment = message;
    if (message.actions) this.actions.setComponents(message.actions);
    this.actions.show(message.probabilities);
    if (!message.picture) this.showNoPicture();
    facts($("moment"), [
      ["step", number(message.step)],
      ["return so far", number(message.obtained)],
      ["desired return now", number(message.desired_return)],
      ["desired horizon now", count(Math.max(message.desired_horizon, 1), "step")],
      ["last action", this.actions.text(message.action)],
    ]);
    this.form.showActive(message.over ? null : message);
    if (isEnd) {
      setText($("outcome"), `Commanded ${text(message.commanded_return, message.commanded_horizon)}; obtained ${text(message.obtained, message.step)}.`);
      this.episodes.add(message);
    }
    this.buttons();
  }

  showPicture(blob) {
    const image = $("picture");
    if (this.url) URL.revokeObjectURL(this.url);
    image.src = this.url = URL.createObjectURL(blob);
    image.hidden = false;
    $("no-picture").hidden = true;
    $("screen").classList.remove("empty");
  }

  showNoPicture() {
    $("picture").hidden = true;
    $("no-picture").hidden = false;
    $("screen").classList.remove("empty");
    setText($("no-picture"), "This environment cannot be rendered.");
  }

  // The most likely action has the primary button.
  buttons() {
    const isActing = this.isActing, isPaused = isActing && this.moment.paused;
    const isNew = isActing && this.applied !== JSON.stringify(this.form.chosen);
    $("start").disabled = !this.form.contents;
    $("change").disabled = $("pause").disabled = !isActing;
    $("step").disabled = !isPaused;
    setText($("pause"), isPaused ? "Resume" : "Pause");
    const primary = !isActing ? "start" : isNew ? "change" : "pause";
    for (const id of ["start", "change", "pause"]) $(id).classList.toggle("primary", id === primary);
  }
}
