// Asks the board's server what is new, once a second, and shows it.
import { Chart, merge, thin } from "./charts.js";
import { Plane, spans } from "./map.js";
import { $, facts, number } from "./page.js";
import { Command } from "./stage.js";

const EVERY_MS = 1000;
// The board waits for a replay service that hangs, and says so; it must not be given up before.
const LONGEST_MS = 20_000;

const known = { place: {}, hello: null, status: null, iterations: [], evaluations: [], contents: null, obeyed: null };

const curve = new Chart($("curve"), $("curve-said"), [
  { colour: "evaluation", width: 2, points: true },
  { colour: "evaluation", width: 0 },
  { colour: "evaluation", width: 0 },
  { colour: "explored" },
  { colour: "commanded", dash: [4, 4] },
  { colour: "commanded", dash: [4, 4] },
  { colour: "evaluation", hollow: true },
], {
  bands: [[1, 2, "evaluation"], [4, 5, "commanded"]],
  legend: [["evaluations, mean with its 95 % interval", "evaluation", "line"], ["closing evaluation", "evaluation", "dot"],
    ["exploratory episodes, mean of an iteration", "explored", "line"], ["what these were asked for", "commanded", "band"]],
});
const speed = new Chart($("speed"), $("speed-said"), [{ colour: "evaluation" }]);
const loss = new Chart($("loss"), $("loss-said"), [{ colour: "evaluation" }]);
const admitted = new Chart($("admitted"), $("admitted-said"), [{ colour: "evaluation" }]);
const buffer = new Plane($("buffer"), { x: "return", y: "length, steps", label: "Returns and lengths of the replay buffer's episodes" });
const command = new Command();

const time = (s) => {
  const whole = Math.round(s), minutes = Math.floor(whole / 60);
  const two = (n) => String(n).padStart(2, "0");
  return minutes >= 60 ? `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
};
const evaluated = (e) => (e ? `${number(e.mean)} ± ${number((e.ci95_high - e.ci95_low) / 2)}` : "none yet");

// Shell commands that go on from here, as far as the board knows what they are called.
function commands() {
  const { run_dir, endpoint } = known.place, env = known.status.environment;
  const keys = endpoint.startsWith("tls/") ? " --keys DIR" : "";
  const word = (text) => (/^[\w./:-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
  const directory = run_dir ? word(run_dir) : "RUN_DIR";
  return {
    run_dir: directory,
    service: (role) => `udrl ${role} --connect ${endpoint || "ENDPOINT"}${keys}`,
    obedience: `udrl obedience ${directory}`,
    resume: (more = "") => `udrl train ${word(env)} --run-dir ${directory} --resume${more}${keys}`,
  };
}

function showStatus(status) {
  const { hello } = known;
  $("title").textContent = `${status.environment}, run ${status.run_id}`;
  document.title = `${status.environment} · udrl board`;
  const exact = status.exact ? "exact" : `NOT exact: ${status.inexact_reason}`;
  // Why it failed stands below, with the command that helps.
  const because = { ended: `ended: ${status.ended_because}`, stopped: status.ended_because };
  $("state").textContent = `${because[status.state] || status.state}; ${exact}`;
  const left = status.time_left_s == null ? [] : [["time left", (status.stop_return == null ? "" : "at most ") + time(status.time_left_s)]];
  facts($("facts"), [
    ["iteration", number(status.iteration)],
    ["env steps", `${number(status.env_steps)} of ${number(status.max_env_steps)}`],
    ...(status.state === "running" || status.state === "closing" ? [["env steps/s", number(status.env_steps_per_s, 0)]] : []),
    ["last evaluation", evaluated(status.evaluation)],
    ...(status.closing_evaluation ? [["closing evaluation", evaluated(status.closing_evaluation)]] : []),
    ["weights", `version ${status.weights_version}`],
    ["weights' age", `${status.weights_lag} versions, ${number(status.weights_lag_s, 2)} s`],
    ["loss of these", number(status.loss, 3)],
    ["time", time(status.wall_s)],
    ...left,
    ["seed", String(hello?.config.seed ?? "")],
  ]);
  showActors(status);
}

function showActors(status) {
  const none = status.actors.length === 0, { service, resume } = commands();
  const why = {
    running: `No actor is here. Start one: ${service("actor")}`,
    closing: `No actor is here, and the closing evaluation is missing. Start one: ${service("actor")}`,
    stopped: `Nobody works on this run. It goes on where it was: ${resume()}`,
    ended: `The run has ended, and its actors have left. To go on: ${resume(" --max-env-steps MORE")}`,
    failed: `The run has failed, and its actors have left. When the cause is mended: ${resume()}`,
  };
  $("no-actors").hidden = !none;
  if (none) $("no-actors").textContent = why[status.state];
  $("actor-table").hidden = none;
  $("actor-table").tBodies[0].replaceChildren(
    ...status.actors.map((a) => {
      const row = document.createElement("tr");
      for (const value of [a.id, a.host, a.environments, number(a.env_steps_per_s, 0), a.weights_version, a.weights_lag, a.running, a.reruns, a.failures, `${number(a.last_seen_s, 1)} s ago`])
        row.insertCell().textContent = value;
      return row;
    }),
  );
  const lines = (list, texts) =>
    list.replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  const missing = status.waiting.some((w) => w.why.includes("no learner is here"));
  lines($("waiting"), [
    ...status.waiting.map((w) => `${w.who} waits for ${w.for}: ${w.why} (${number(w.seconds, 1)} s)`),
    ...(missing ? [`No learner is here. Start one: ${service("learner")}`] : []),
  ]);
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
  const { iterations, evaluations } = known, closing = known.status?.closing_evaluation;
  if (!iterations.length) return;
  const rows = thin(iterations);
  const { xs, column } = merge(
    [rows, "env_steps", { explored: (r) => r.explored_return, most: (r) => r.commanded_max ?? undefined, least: (r) => r.commanded_min ?? undefined }],
    [evaluations, "env_steps", { mean: (e) => e.mean, high: (e) => e.ci95_high, low: (e) => e.ci95_low }],
    [closing ? [closing] : [], "env_steps", { closing: (e) => e.mean }],
  );
  const columns = ["mean", "high", "low", "explored", "most", "least", "closing"].map(column);
  const last = rows.at(-1), all = closing ? [...evaluations, closing] : evaluations;
  const best = all.reduce((b, e) => (b && b.mean >= e.mean ? b : e), null);
  const asked = (least, most) => (least == null ? "" : `, asked for ${number(least)} to ${number(most)}`);
  curve.show(xs, columns,
    `After ${number(last.env_steps)} env steps: explored ${number(last.explored_return)}${asked(last.commanded_min, last.commanded_max)}` +
      (best ? `; best evaluation ${evaluated(best)} after ${number(best.env_steps)}.` : "; no evaluation yet."),
    // Evaluations are fewer than iterations: the last one up to there is what the cursor is at.
    (i) => {
      const row = rows.findLast((r) => r.env_steps <= xs[i]), made = all.findLast((e) => e.env_steps <= xs[i]);
      const parts = [
        made ? `${made === closing ? "closing evaluation" : "evaluation"} ${evaluated(made)} after ${number(made.env_steps)}` : "",
        row ? `explored ${number(row.explored_return)}${asked(row.commanded_min, row.commanded_max)}` : "",
      ];
      return `After ${number(xs[i])} env steps: ${parts.filter(Boolean).join("; ")}.`;
    });
  const steps = rows.map((r) => r.env_steps);
  const pace = rows.map((r, i) => {
    const before = rows[Math.max(0, i - 5)];
    return r.wall_s > before.wall_s ? (r.env_steps - before.env_steps) / (r.wall_s - before.wall_s) : undefined;
  });
  const after = (text, of) => (i) => `After ${number(of[i].env_steps)} env steps: ${text(i)}.`;
  speed.show(steps, [pace], `Over the last iterations ${number(pace.at(-1), 0)}, evaluations included.`, after((i) => number(pace[i], 0), rows));
  loss.show(steps, [rows.map((r) => r.loss ?? undefined)], last.loss == null ? "Nothing is trained yet." : `Of the weights of the last complete iteration: ${number(last.loss)}.`,
    after((i) => number(rows[i].loss), rows));
  const trained = rows.filter((r) => r.iteration > 0); // all of the warm-up's are the best so far
  admitted.show(trained.map((r) => r.env_steps), [trained.map((r) => r.admitted)], `Of the last iteration: ${last.admitted}.`,
    after((i) => trained[i].admitted, trained));
}

function showContents(contents) {
  if (!contents.returns.length) return;
  const asked = contents.desired_returns.map((r, i) => [r, contents.desired_horizons[i]]);
  const newest = Math.max(...contents.iterations), oldest = Math.min(...contents.iterations);
  buffer.draw(() => {
    buffer.axes(...spans(contents, asked));
    contents.returns.forEach((r, i) => {
      const young = newest > oldest ? (contents.iterations[i] - oldest) / (newest - oldest) : 1;
      buffer.dot(r, contents.lengths[i], { class: "episode", opacity: 0.25 + 0.6 * young });
    });
    for (const [r, h] of asked) buffer.cross(r, h, "asked");
    buffer.cross(contents.desired_return, contents.desired_horizon, "told", 7);
  });
  const held = known.status?.buffer, recent = known.hello?.config.recent_size;
  $("buffer-said").textContent = (held ? `The ${number(held.episodes)} best episodes have returns from ${number(held.return_min)} to ${number(held.return_max)}` : "") +
    (recent ? `; the newest ${number(recent)} are kept and shown besides. ` : ". ") +
    `Evaluations ask for ${number(contents.desired_return)} within ${number(contents.desired_horizon)} steps (M, large cross; S = ${number(contents.return_std)}); outstanding exploratory commands: ${asked.length}.`;
}

function showObeyed() {
  const { obeyed, status } = known;
  if (!status?.weights_version) return;
  const others = obeyed && obeyed.weights_version !== status.weights_version;
  const said = obeyed
    ? obeyed.answer + (others ? ` Measured with weights version ${obeyed.weights_version}; the latest are ${status.weights_version}.` : "")
    : `Measure which returns the agent delivers when they are commanded: ${commands().obedience}`;
  if ($("obeys").textContent !== said) $("obeys").textContent = said;
}

async function ask() {
  const after = known.iterations.at(-1)?.iteration ?? -1;
  const run = encodeURIComponent(known.hello?.run_id ?? "");
  const response = await fetch(`news?after=${after}&run=${run}`, { signal: AbortSignal.timeout(LONGEST_MS) });
  if (!response.ok) throw new Error(await response.text());
  const news = await response.json();
  if (news.hello) Object.assign(known, { hello: news.hello, iterations: [], evaluations: [] });
  known.place = news.place;
  known.iterations.push(...news.iterations);
  known.evaluations.push(...news.evaluations);
  const ended = news.status?.state !== known.status?.state;
  if (news.status) showStatus((known.status = news.status));
  if (news.hello || news.iterations.length || ended) showHistory();
  const measured = JSON.stringify(news.obeyed) !== JSON.stringify(known.obeyed);
  known.obeyed = news.obeyed;
  if (news.contents) showContents((known.contents = news.contents));
  if (known.contents && (news.contents || measured)) command.know(known);
  showObeyed();
  $("about").textContent = `udrl ${news.software}`;
  const why = news.status?.problem.replace("RUN_DIR", commands().run_dir);
  problem([news.problem, why, news.status?.advice].filter(Boolean).join(" "));
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
