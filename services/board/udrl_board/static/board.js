// Asks the board's server what is new, once a second, and shows it.
import { Chart, merge, short, thin } from "./charts.js";
import { Plane, spans } from "./map.js";
import { $, facts, number } from "./page.js";
import { Command } from "./stage.js";

const EVERY_MS = 1000;

const known = { hello: null, status: null, iterations: [], evaluations: [], contents: null };

const curve = new Chart($("curve"), [
  { label: "evaluation", colour: "evaluation", width: 2, points: true },
  { label: "95 % to", colour: "evaluation", width: 0 },
  { label: "from", colour: "evaluation", width: 0 },
  { label: "explored", colour: "explored" },
  { label: "asked, most", colour: "commanded", dash: [4, 4] },
  { label: "asked, least", colour: "commanded", dash: [4, 4] },
], [[1, 2, "evaluation"], [4, 5, "commanded"]]);
const speed = new Chart($("speed"), [{ label: "env steps/s", colour: "evaluation" }]);
const loss = new Chart($("loss"), [{ label: "loss", colour: "evaluation" }]);
const admitted = new Chart($("admitted"), [{ label: "episodes", colour: "evaluation" }]);
const buffer = new Plane($("buffer"), { x: "return", y: "length, steps", label: "Returns and lengths of the replay buffer's episodes" });
const command = new Command();

const time = (s) => {
  const whole = Math.round(s), minutes = Math.floor(whole / 60);
  const two = (n) => String(n).padStart(2, "0");
  return minutes >= 60 ? `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
};
const evaluated = (e) => (e ? `${number(e.mean)} ± ${number((e.ci95_high - e.ci95_low) / 2)}` : "none yet");

function showStatus(status) {
  const { hello } = known;
  $("title").textContent = `${status.environment}, run ${status.run_id}`;
  document.title = `${status.environment} · udrl board`;
  const exact = status.exact ? "exact" : `NOT exact: ${status.inexact_reason}`;
  $("state").textContent = `${status.state}; ${exact}`;
  const left = status.time_left_s == null ? [] : [["time left", time(status.time_left_s)]];
  facts($("facts"), [
    ["iteration", number(status.iteration)],
    ["env steps", `${number(status.env_steps)} of ${number(status.max_env_steps)}`],
    ["env steps/s", number(status.env_steps_per_s, 0)],
    ["last evaluation", evaluated(status.evaluation)],
    ...(status.closing_evaluation ? [["closing evaluation", evaluated(status.closing_evaluation)]] : []),
    ["weights", `version ${status.weights_version}`],
    ["weights' age", `${status.weights_lag} versions, ${number(status.weights_lag_s, 2)} s`],
    ["loss", number(status.loss, 3)],
    ["time", time(status.wall_s)],
    ...left,
    ["seed", String(hello?.config.seed ?? "")],
  ]);
  showActors(status);
}

function showActors(status) {
  const working = status.state === "running" || status.state === "closing";
  const none = status.actors.length === 0;
  $("no-actors").hidden = !none;
  if (none)
    $("no-actors").textContent = working
      ? "No actor is here. Start one: udrl actor --connect ENDPOINT. If nobody works on the run: udrl train ENV --run-dir RUN_DIR --resume."
      : "The run has ended, and its actors have left. To go on: udrl train ENV --run-dir RUN_DIR --resume --max-env-steps MORE.";
  $("actor-table").hidden = none;
  $("actor-table").tBodies[0].replaceChildren(
    ...status.actors.map((a) => {
      const row = document.createElement("tr");
      for (const value of [a.id, a.host, a.environments, number(a.env_steps_per_s, 0), a.weights_version, a.weights_lag, a.running, a.reruns, a.failures, `${number(a.last_seen_s)} s ago`])
        row.insertCell().textContent = value;
      return row;
    }),
  );
  const lines = (list, texts) =>
    list.replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  lines($("waiting"), status.waiting.map((w) => `${w.who} waits for ${w.for}: ${w.why} (${number(w.seconds)} s)`));
  lines($("quarantined"), status.quarantined.map((q) => `quarantined: ${q.id}: ${q.why}`));
  const { commands: c, episodes: e } = status;
  facts($("ledgers"), [
    ["commands issued", number(c.issued)],
    ["accepted, cancelled, outstanding", `${number(c.accepted)}, ${number(c.cancelled)}, ${number(c.outstanding)}`],
    ["episodes delivered", number(e.delivered)],
    ["accepted, again, rejected", `${number(e.accepted)}, ${number(e.duplicate)}, ${number(e.rejected)}`],
    ["environments failed", number(status.env_failures)],
  ]);
}

function showHistory() {
  const { iterations, evaluations } = known;
  if (!iterations.length) return;
  const rows = thin(iterations);
  const table = merge(
    [rows, "env_steps", { explored: (r) => r.explored_return, most: (r) => r.commanded_max ?? undefined, least: (r) => r.commanded_min ?? undefined }],
    [evaluations, "env_steps", { mean: (e) => e.mean, high: (e) => e.ci95_high, low: (e) => e.ci95_low }],
  );
  curve.show(table.xs, ["mean", "high", "low", "explored", "most", "least"].map(table.column));
  const xs = rows.map((r) => r.env_steps);
  const pace = rows.map((r, i) => {
    const before = rows[Math.max(0, i - 5)];
    return r.wall_s > before.wall_s ? (r.env_steps - before.env_steps) / (r.wall_s - before.wall_s) : undefined;
  });
  speed.show(xs, [pace]);
  loss.show(xs, [rows.map((r) => r.loss ?? undefined)]);
  const trained = rows.filter((r) => r.iteration > 0); // all of the warm-up's are the best so far
  admitted.show(trained.map((r) => r.env_steps), [trained.map((r) => r.admitted)]);
  const last = rows.at(-1), best = evaluations.reduce((b, e) => (b && b.mean >= e.mean ? b : e), null);
  $("curve-said").textContent = `After ${number(last.env_steps)} env steps: explored ${number(last.explored_return)}` +
    (last.commanded_min == null ? "" : `, asked for ${number(last.commanded_min)} to ${number(last.commanded_max)}`) +
    (best ? `; best evaluation ${evaluated(best)} after ${number(best.env_steps)}.` : "; no evaluation yet.");
  $("speed-said").textContent = `Over the last iterations ${number(pace.at(-1), 0)}, evaluations included.`;
  $("loss-said").textContent = last.loss == null ? "Nothing is trained yet." : `Now ${number(last.loss, 3)}.`;
  $("admitted-said").textContent = `Of the last iteration: ${last.admitted}.`;
}

function showContents(contents) {
  if (!contents.returns.length) return;
  const asked = contents.desired_returns.map((r, i) => [r, contents.desired_horizons[i]]);
  buffer.begin(...spans(contents, asked));
  const newest = Math.max(...contents.iterations), oldest = Math.min(...contents.iterations);
  contents.returns.forEach((r, i) => {
    const young = newest > oldest ? (contents.iterations[i] - oldest) / (newest - oldest) : 1;
    buffer.dot(r, contents.lengths[i], { class: "episode", opacity: 0.25 + 0.6 * young });
  });
  for (const [r, h] of asked) buffer.cross(r, h, "asked");
  buffer.cross(contents.desired_return, contents.desired_horizon, "told", 7);
  $("buffer-said").textContent = `${number(contents.returns.length)} episodes, returns from ${number(contents.returns[0])} to ${number(contents.returns.at(-1))}. ` +
    `Evaluations ask for ${number(contents.desired_return)} within ${number(contents.desired_horizon)} steps (M, large cross; S = ${number(contents.return_std)}); ${asked.length} exploratory commands are outstanding.`;
}

async function ask() {
  const after = known.iterations.at(-1)?.iteration ?? -1;
  const run = encodeURIComponent(known.hello?.run_id ?? "");
  const response = await fetch(`news?after=${after}&run=${run}`, { signal: AbortSignal.timeout(10_000) });
  if (!response.ok) throw new Error(await response.text());
  const news = await response.json();
  if (news.hello) Object.assign(known, { hello: news.hello, iterations: [], evaluations: [] });
  known.iterations.push(...news.iterations);
  known.evaluations.push(...news.evaluations);
  if (news.status) showStatus((known.status = news.status));
  if (news.hello || news.iterations.length) showHistory();
  if (news.contents) {
    showContents((known.contents = news.contents));
    command.know(known);
  }
  $("about").textContent = `udrl ${news.software}`;
  problem(news.problem);
}

function problem(text) {
  $("problem").hidden = !text;
  if ($("problem").textContent !== text) $("problem").textContent = text;
}

async function forever() {
  for (;;) {
    try {
      if (!document.hidden) await ask();
    } catch (error) {
      problem(`The board's server does not answer (${error.message}); asking again. Is udrl board still running?`);
    }
    await new Promise((done) => setTimeout(done, EVERY_MS));
  }
}

forever();
